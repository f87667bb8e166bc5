"""`hilstar tracker` before a running display, over real sockets and a pty; a watcher that stands
still holds up no frame.
"""

from __future__ import annotations

import json
import os
import select
import shlex
import socket
import subprocess
import sys
from itertools import chain

import numpy as np
import pytest
import zmq

from hilstar.attitude.logs.telemetry import read_telemetry
from hilstar.attitude.wire.shown_frames import FrameHead, FrameSender, ShownFrame
from hilstar.basics.rotation import (
    conjugate,
    from_radec_roll_deg,
    multiply,
    propagate,
    to_rotation_vector,
)
from tests.support.benches import ROOT, TWIN, bench_text
from tests.support.commands import HILSTAR, assert_refused, run_hilstar_here, typed
from tests.support.forks import Started
from tests.support.senders import free_port
from tests.support.servers import sending_replay
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.wire.ptys import serial_line

pytestmark = pytest.mark.e2e

ARCSEC = 180 * 3600 / np.pi
SPIN_RAD_S = np.radians(0.2)
# Of the tracker alone, before anything is planted: 400 x 400 pixels of 107 arcsec, some 20 stars;
# measured 0.6 and 6 arcsec.
OWN_ARCSEC = (5.0, 5.0, 40.0)
BIAS = (100.0, -50.0, 300.0)


def turn_log(path, seconds=30.0):
    """A slow turn about the boresight and across it from Orion's belt."""
    q, lines = from_radec_roll_deg(84.057, -1.2, 0.0), ["t_s,qw,qx,qy,qz"]
    for k in range(round(seconds * 20) + 1):
        turned = propagate(q, SPIN_RAD_S * np.array([0.6, 0.0, 0.8]), k / 20)
        lines.append(f"{k / 20}," + ",".join(repr(float(part)) for part in turned))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def display(tmp_path_factory):
    """A replay that sends its frames: the bench file, and the endpoint."""
    folder = tmp_path_factory.mktemp("display")
    with sending_replay(folder, turn_log(folder / "log.csv", 300.0)) as sending:
        yield sending


def tracker_of_display(display, *options):
    bench, endpoint = display
    command = [*HILSTAR, "tracker", str(bench), "--watch", endpoint, *options]
    return Started(
        [*map(str, command), "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def summary(process):
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    return json.loads(out)


def test_lost_in_space_then_tracking_its_answers_are_the_attitude_that_was_lit_and_what_was_planted(
    display, tmp_path
):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.setblocking(False)
        told = typed(f"--answer udp://127.0.0.1:{ear.getsockname()[1]} --format json --duration 2")
        planted = (
            "--bias",
            ",".join(map(str, BIAS)),
            "--clock-offset",
            7,
            "--record",
            tmp_path / "answers.csv",
        )
        with tracker_of_display(display, *told, *planted) as process:
            found = summary(process)
        answers = [json.loads(ear.recv(65536)) for _ in range(found["answers"])]
    assert len(answers) >= 5
    assert answers[0]["mode"] == "lost in space"
    # all but the first, unless the machine is too busy to follow
    assert found["modes"]["tracking"] >= len(answers) / 2
    assert np.all(np.abs(found["own_bias_arcsec"]) < OWN_ARCSEC)
    assert np.all(np.array(found["own_sigma_arcsec"]) < OWN_ARCSEC)
    rows = read_telemetry(tmp_path / "answers.csv")
    assert rows.t_ns.tolist() == pytest.approx([answer["t_ns"] for answer in answers], abs=1)
    # The turn from answer to answer is that of the log, about the same axes.
    first, last = answers[1], answers[-1]
    seconds = (last["t_ns"] - first["t_ns"]) / 1e9
    turned = (
        to_rotation_vector(multiply(np.array(last["q"]), conjugate(np.array(first["q"])))) / seconds
    )
    assert np.linalg.norm(turned) == pytest.approx(
        SPIN_RAD_S, abs=2 * max(OWN_ARCSEC) / ARCSEC / seconds
    )


def test_planted_silence_garbage_latency_and_wrong_answers_over_a_serial_line(display):
    planted = typed("--silent 0.7s@0.6s --babble --wrong 50% --latency 0.5 --solver truth --seed 2")
    heard = b""
    with serial_line() as (ours, name):
        words = ("--answer", f"serial:{name}@921600", "--format", "json", "--duration", 2)
        with tracker_of_display(display, *words, *planted) as process:
            while process.poll() is None or select.select([ours], [], [], 0)[0]:
                if select.select([ours], [], [], 0.05)[0]:
                    heard += os.read(ours, 65536)
            found = summary(process)
    assert found["wrong"] > 0.2 * found["valid"]
    assert found["latency_ms"]["p50"] >= 500
    assert 3 < found["answers"] < 20 - 5  # 0.7 s of ten answers a second are missing
    assert found["link"]["babbled"] == found["answers"]
    whole = [part for part in heard.split(b"\n") if part.rpartition(b'{"t_ns"')[1]]
    assert len(whole) == found["answers"]
    assert len(heard) > sum(map(len, whole))


def test_an_outside_command_finds_the_attitude_and_prediction_follows_it(display):
    """The example's solver gets a FITS file; on a busy machine it takes seconds, and the
    exposure after that one follows.
    """
    program = shlex.join([sys.executable, str(ROOT / "examples" / "star_solver.py")])
    solver = f"{program} {{image}} {25e3 / 13}"
    with tracker_of_display(
        display, "--answer", f"udp://127.0.0.1:{free_port()}", "--duration", 4, "--solver", solver
    ) as process:
        found = summary(process)
    assert found["modes"]["lost in space"] >= 1
    assert found["modes"]["tracking"] >= 1
    assert np.all(np.abs(found["own_bias_arcsec"]) < OWN_ARCSEC)


def test_a_watcher_that_never_reads_loses_frames_and_holds_up_none():
    """64 frames of 4 MB: the sockets' buffers and the few that are kept for it are full after
    some.
    """
    head = FrameHead(0, 0, 4096, 256, 8)
    big = ShownFrame(
        head, np.arange(4096 * 256, dtype=np.uint32), np.ones(4096 * 256, dtype=np.uint8)
    )
    context = zmq.Context()
    asleep = context.socket(zmq.SUB)
    asleep.setsockopt(zmq.RCVHWM, 1)
    asleep.setsockopt(zmq.SUBSCRIBE, b"")
    with FrameSender("tcp://127.0.0.1:*") as sender:
        asleep.connect(sender.endpoint)
        wait_for(sender.look, "the subscription")
        for _ in range(64):
            sender.put_frame(big)  # returns, or the test's time is over
        got = 0
        while asleep.poll(300):
            asleep.recv_multipart()
            got += 1
    asleep.close(linger=0)
    context.term()
    assert 0 < got < 64


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--rate", "20"], "an exposure takes 0.1 s"),
        (["--bias", "1,2"], "--bias 1,2: write 3 finite numbers"),
        (["--silent", "x"], "such as 5s or 5s@20s"),
        (["--wrong", "2"], "--wrong 2: write a fraction"),
        (["--format", "xml"], "--format xml: write packet or json"),
        (["--solver", "solve it"], "names no image"),
        (["--answer", "udp://127.0.0.1"], "write udp://HOST:PORT"),
        (["--watch", "tcp://192.168.1.2:5"], "non-loopback endpoints require CURVE keys"),
    ],
)
def test_what_is_wrong_gets_one_line(tmp_path, options, said):
    (tmp_path / "bench.toml").write_text(bench_text(TWIN))
    right = {"--watch": "tcp://127.0.0.1:1", "--answer": "udp://127.0.0.1:9"}
    given = right | {options[0]: options[1]}
    words = ["tracker", tmp_path / "bench.toml", *chain.from_iterable(given.items())]
    assert_refused(run_hilstar_here(*words), 2, said)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["--frames", "0"], "'--frames': 0 is not in the range x>=1"),
        (["--feed", "tcp://127.0.0.1:x"], "not an endpoint"),
        (["--frames", "tcp://127.0.0.1:x"], "not an endpoint"),
        (["--feed", "tcp://*:5"], "non-loopback"),
    ],
)
def test_frames_that_cannot_be_counted_or_sent_get_one_line(tmp_path, asked, said):
    (tmp_path / "bench.toml").write_text(
        bench_text(TWIN, {"attitude": {"source": "udp", "bind": f"127.0.0.1:{free_port()}"}})
    )
    assert_refused(
        run_hilstar_here("serve", tmp_path / "bench.toml", "--headless", *asked),
        2,
        said,
    )
