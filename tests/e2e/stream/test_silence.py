"""A stream that waits, falls silent, hangs, or is two: real sockets, and what is said of it."""

from __future__ import annotations

import json
import signal
import threading
import time

import msgspec
import pytest
import zmq

from hilstar.attitude.wire.zmq_links import ZmqReceiver
from hilstar.server.bench.build import load
from hilstar.server.loop import Limit
from hilstar.server.pacer import Shown
from hilstar.server.run_progress import Running
from hilstar.server.serve import serve
from tests.support.commands import run_hilstar_here
from tests.support.live_runs import median_age_ns, serve_until
from tests.support.senders import LYRA, ORION, free_port, packet, publisher, talking
from tests.support.servers import serving, summary_of, until_said

# The road's delay on a loaded machine; the sender's clock is this process's own, so the offset is
# that delay alone.
MAX_MIN_DELAY_MS = 2.0


@pytest.mark.parametrize("queued_s", [0.3, 1.5])
def test_packets_that_waited_for_the_display_mislead_nobody(small_bench_file, queued_s):
    """The link is open while the display is measured: what queues up there is shown, and teaches
    no clock.
    """
    with (
        publisher() as (sender, port),
        ZmqReceiver(f"tcp://127.0.0.1:{port}") as link,
        talking(sender),
        load(small_bench_file) as bench,
    ):
        time.sleep(queued_s)
        shown = []
        summary = msgspec.to_builtins(serve(bench, link, Limit(slots=100), shown.append))
        age_ns = median_age_ns(shown)
    assert summary["packets"]["refused"] == 0
    clock = summary["clock"]
    assert clock["jumps"] == 0
    assert -0.001 <= clock["offset_ms"] < MAX_MIN_DELAY_MS
    assert clock["offset_ms"] <= clock["uncertainty_ms"] + MAX_MIN_DELAY_MS
    assert age_ns < 250_000_000
    assert summary["receive_latency_ms"]["p50"] < 30
    assert summary["events"]["first-attitude"] == 1
    assert not {"jump", "source-slow", "second-sender"} & set(summary["events"])


def test_silence_and_its_end_are_said_while_they_happen(tmp_path):
    with publisher() as (sender, port), serving(tmp_path, port) as process:
        until_said(process, "no attitude yet")
        with talking(sender):
            until_said(process, "the first attitude has come")
            time.sleep(0.3)
        until_said(process, "the attitude is stale")
        with talking(sender):
            until_said(process, "the attitude is fresh again")
        process.send_signal(signal.SIGINT)
        summary = summary_of(process)
    events = summary["events"]
    assert (events["no-attitude"], events["first-attitude"]) == (1, 1)
    assert events["stale"] - events["fresh"] in {0, 1}  # silent again before the end
    assert events["fresh"] >= 1, events  # a busy machine's sender may fall silent for a moment more


def test_a_sender_that_hangs_is_stale_in_every_frame_and_nothing_flickers(small_bench_file):
    """A turn of 1 deg/s for a second, then its last packet at 500 Hz: shown as it was last
    predicted, and stale to the end.
    """
    rate = (0.0, 0.0, 0.0174533)
    with (
        publisher() as (sender, port),
        ZmqReceiver(f"tcp://127.0.0.1:{port}") as link,
        load(small_bench_file) as bench,
    ):
        stop, hangs = threading.Event(), threading.Event()

        def enough(frames: list[Shown], run: Running) -> bool:
            late = run.packets.refused > 200 and len(frames) > 120
            return hangs.is_set() and late and all(frame.stale for frame in frames[-61:])

        def talk() -> None:
            k, last = 0, b""
            while not stop.wait(0.005 if k < 200 else 0.002):
                if k < 200:
                    last = packet(k, time.monotonic_ns(), ORION, rate)
                    if k == 199:
                        hangs.set()
                sender.send(last)
                k += 1

        thread = threading.Thread(target=talk)
        thread.start()
        run, shown = serve_until(bench, link, enough)
        summary = msgspec.to_builtins(run)
        stop.set()
        thread.join()
    assert summary["clock"]["jumps"] == 0
    assert summary["packets"]["refused_by"]["time"] > 200
    assert summary["events"]["source-frozen"] == 1
    hung = max(k for k, frame in enumerate(shown) if not frame.stale) + 1
    assert len(shown) - hung > 60
    ages_ns = [frame.attitude.age_ns for frame in shown[hung:]]
    assert ages_ns == sorted(ages_ns)
    assert len({tuple(frame.attitude.q_icrs_to_cam) for frame in shown[hung:]}) == 1


def test_two_senders_on_one_port_are_told_apart_and_the_first_is_shown(tmp_path):
    context = zmq.Context()
    port = free_port()
    with serving(tmp_path, port, attitude="bind = true") as process:
        first, second = (context.socket(zmq.PUB) for _ in range(2))
        for sender in (first, second):
            sender.connect(f"tcp://127.0.0.1:{port}")
        assert process.stderr is not None
        with talking(first):
            until_said(process, "first attitude")
            with talking(second, q=LYRA, first=7):
                until_said(process, "two senders")
                process.has_refused(100)
        process.send_signal(signal.SIGINT)
        summary = summary_of(process)
        for sender in (first, second):
            sender.close(linger=0)
    context.term()
    assert summary["events"]["second-sender"] == 1
    assert summary["packets"]["refused_by"]["source"] > 50
    assert summary["clock"]["jumps"] == 0


def test_a_shared_clock_is_said_in_the_summary(tmp_path):
    with (
        publisher() as (sender, port),
        serving(tmp_path, port, attitude='clock = "shared"') as process,
    ):
        with talking(sender):
            until_said(process, "first attitude")
            time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        summary = summary_of(process)
    clock = summary["clock"]
    assert (clock["mode"], clock["offset_ms"], clock["uncertainty_ms"]) == ("shared", 0, 0)
    assert 0 < summary["receive_latency_ms"]["p50"] < 50


def test_a_replay_says_when_its_attitude_comes(tmp_path, small_bench_file):
    log = tmp_path / "log.csv"
    log.write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n0.1,1,0,0,0\n")
    result = run_hilstar_here("replay", small_bench_file, log, "--headless", "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["events"]["first-attitude"] == 1
    assert "the first attitude has come" in result.stderr
