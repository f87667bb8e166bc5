"""A bench as an FMU, checked and driven by FMPy, which is another author's; with a tracker that
answers.
"""

from __future__ import annotations

import importlib
import json
import re
import socket
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from fmpy import read_model_description, simulate_fmu
from fmpy.validation import validate_fmu

from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.packet import AnswerPacket, TimeRequest, encode
from hilstar.basics.rotation import from_rotation_vector, multiply
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.cli import fmu
from hilstar.server.sender import Sender
from tests.e2e.console.test_scpi import instrument, scpi_run
from tests.support.benches import LIVE_BENCH, ORION_Q
from tests.support.commands import run_hilstar, run_hilstar_here
from tests.support.senders import free_port
from tests.support.waiting import wait_for

pytestmark = pytest.mark.e2e
BIAS_ARCSEC = np.array([30.0, -20.0, 60.0])
NEAR_ARCSEC = 0.5  # an attitude of seven digits is normalised: 0.02 arcsec
SECONDS, STEP_S = 1.5, 0.02


def tables(port: int, answers: int) -> str:
    attitude = f'[attitude]\nsource = "udp"\nbind = "127.0.0.1:{port}"\n'
    return (
        attitude
        + f'[answers]\nsource = "udp"\nbind = "127.0.0.1:{answers}"\nformat = "packet"\nclock ='
        ' "host"\n'
    )


@contextmanager
def resting_tracker(port: int) -> Iterator[np.ndarray]:
    """A tracker at rest that answers 20 times a second, off by its bias; what it answers."""
    q = multiply(
        from_rotation_vector(BIAS_ARCSEC / ARCSEC_PER_RAD),
        np.array(ORION_Q) / np.linalg.norm(ORION_Q),
    )
    stop = threading.Event()

    def answer() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
            sequence = 0
            while not stop.wait(0.05):
                sequence += 1
                packet = AnswerPacket(
                    sequence,
                    protocol.ANSWER_VALID,
                    time.monotonic_ns() - 150_000_000,
                    tuple(q),
                    stars=9,
                )
                sending.sendto(encode(packet), ("127.0.0.1", port))

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        yield q
    finally:
        stop.set()
        thread.join()


def attitudes_apart_arcsec(q: np.ndarray, other: np.ndarray) -> float:
    return 2 * float(np.arccos(min(1.0, abs(q @ other)))) * ARCSEC_PER_RAD


def test_as_json_it_is_where_it_sends_and_what_was_written(tmp_path):
    text = LIVE_BENCH + '[attitude]\nsource = "udp"\nbind = "127.0.0.1:5561"\nstatus_hz = 10\n'
    (tmp_path / "bench.toml").write_text(text)
    done = run_hilstar("fmu", "bench.toml", "-o", "display.fmu", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"address": "127.0.0.1:5561", "written": ["display.fmu"]}


def test_an_fmu_drives_a_bench_and_hears_what_the_tracker_answers(tmp_path):
    port, answers = free_port(), free_port()
    with (
        scpi_run(tmp_path, tables(port, answers)) as (served, found),
        resting_tracker(answers) as answered,
    ):
        done = run_hilstar_here("fmu", tmp_path / "bench.toml", "-o", tmp_path / "display.fmu")
        assert done.returncode == 0 and done.stdout == f"{tmp_path / 'display.fmu'}\n"
        assert validate_fmu(str(tmp_path / "display.fmu")) == []
        served.await_line("bound to")
        start = dict(zip(("q_w", "q_x", "q_y", "q_z"), ORION_Q, strict=True))
        result = simulate_fmu(
            str(tmp_path / "display.fmu"),
            stop_time=SECONDS,
            output_interval=STEP_S,
            step_size=STEP_S,
            start_values=start,
        )
        last = result[-1]
        assert last["frame"] > 10 and last["statuses"] >= 5 and last["answers"] >= 5
        assert int(last["health"]) & (protocol.HEALTH_BLANK | protocol.HEALTH_STALE) == 0
        assert int(last["health"]) & protocol.HEALTH_CLOCK_SYNCHRONISED
        assert (
            attitudes_apart_arcsec(
                np.array([last[f"answered_q_{axis}"] for axis in "wxyz"]), answered
            )
            < NEAR_ARCSEC
        )
        assert SECONDS - 1.0 < last["answered_t_s"] < SECONDS
        with instrument(int(found[2])) as stand, Sender(f"udp://127.0.0.1:{port}") as sender:
            wait_for(
                lambda: np.abs(stand.numbers("TRAC:RES?") - BIAS_ARCSEC).max() < NEAR_ARCSEC,
                served.lines,
            )

            def passed_on() -> bool:
                sender.send(np.array(ORION_Q), (0.0, 0.0, 0.0))
                return sender.answer is not None

            wait_for(passed_on, served.lines)
            assert (
                attitudes_apart_arcsec(np.array(sender.answer.q_icrs_to_cam), answered)
                < NEAR_ARCSEC
            )


def test_its_packets_are_those_of_the_wire(tmp_path, monkeypatch):
    """The FMU holds the generated table itself, and no layout of its own. What was imported to make
    it is not kept.
    """
    path = list(sys.path)
    with zipfile.ZipFile(fmu.build(tmp_path, "127.0.0.1:5560")) as made:
        table = made.read(f"resources/{fmu.PROTOCOL}.py")
        model = made.read(f"resources/{fmu.MODEL}.py").decode()
    assert sys.path == path and not {fmu.MODEL, fmu.PROTOCOL} & set(sys.modules)
    assert table == Path(protocol.__file__).read_bytes()
    assert re.findall(r'"<[BHIqdf0-9]{2,}"', model) == []
    monkeypatch.setitem(sys.modules, fmu.PROTOCOL, protocol)
    monkeypatch.delitem(sys.modules, "hilstar.server.fmu_model", raising=False)
    fmu_model = importlib.import_module("hilstar.server.fmu_model")
    assert fmu_model.unpacked(encode(TimeRequest(7, 11))) == (1, 2, 0, 7, 11)
    assert fmu_model.unpacked(b"\1\4" + bytes(38)) is None and fmu_model.unpacked(b"") is None


@pytest.mark.parametrize(
    ("attitude", "words"),
    [
        ("", ['source = "zmq"', 'write source = "udp"']),
        ('source = "serial"\nport = "/dev/ttyS0"', ['source = "serial"', 'write source = "udp"']),
        ('source = "udp"\nbind = "127.0.0.1:0"', ["port 0", "write the port"]),
        ('source = "udp"\nbind = "127.0.0.1:5560"\nstatus_hz = 0', ["status_hz = 0", "write 10"]),
    ],
)
def test_a_bench_that_no_fmu_can_drive_is_refused(tmp_path, attitude, words):
    bench = tmp_path / "bench.toml"
    bench.write_text(f"{LIVE_BENCH}[attitude]\n{attitude}\n")
    done = run_hilstar_here("fmu", bench, "-o", tmp_path / "display.fmu")
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert all(word in done.stderr for word in words), done.stderr
    assert not (tmp_path / "display.fmu").exists()


@pytest.mark.parametrize(
    ("bind", "address"),
    [
        ("10.0.0.7:5560", "10.0.0.7:5560"),
        ("0.0.0.0:5561", "127.0.0.1:5561"),
        ("[::]:5562", "[::1]:5562"),
        ("[fd00::7]:5563", "[fd00::7]:5563"),
    ],
)
def test_a_bench_that_listens_everywhere_is_sent_to_on_this_machine(
    tmp_path, monkeypatch, bind, address
):
    asked = []

    def build(folder, address):
        asked.append(address)
        (folder / "made.fmu").write_bytes(b"made")
        return folder / "made.fmu"

    monkeypatch.setattr(fmu, "build", build)
    bench = tmp_path / "bench.toml"
    allow = 'allow = ["10.0.0.0/8", "fd00::/8"]'
    bench.write_text(f'{LIVE_BENCH}[attitude]\nsource = "udp"\nbind = "{bind}"\n{allow}\n')
    done = run_hilstar_here("fmu", bench, "-o", tmp_path / "display.fmu")
    assert (done.returncode, asked) == (0, [address]), done.stderr
    assert done.stderr.endswith(f": sends to {address}; start hilstar serve {bench} there\n")
    assert (tmp_path / "display.fmu").read_bytes() == b"made"


def test_it_sends_where_the_bench_listens_and_says_what_it_needs(tmp_path):
    bench: Path = tmp_path / "bench.toml"
    bench.write_text(
        f'{LIVE_BENCH}[attitude]\nsource = "udp"\nbind = "0.0.0.0:5560"\nallow = ["10.0.0.0/8"]\n'
    )
    assert run_hilstar_here("fmu", bench, "-o", tmp_path / "display.fmu").returncode == 0
    described = read_model_description(str(tmp_path / "display.fmu"))
    start = {variable.name: variable.start for variable in described.modelVariables}
    assert (described.fmiVersion, start["address"], start["q_w"], start["t_s"]) == (
        "2.0",
        "127.0.0.1:5560",
        "1",
        "-1",
    )
