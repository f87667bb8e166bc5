"""The serial road: real ptys, real processes."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import threading
import time
import tty
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
from cobs import cobs

from hilstar.attitude.wire.links import MAX_PACKETS_PER_S
from hilstar.attitude.wire.serial_link import SerialLink
from hilstar.basics.rotation import angle_between_rad, from_radec_roll_deg, propagate
from hilstar.server.bench.build import load
from hilstar.server.loop import Limit
from hilstar.server.send_log import BadCable, Faults, send, spin_samples
from hilstar.server.sender import SerialSender
from hilstar.server.serve import serve
from tests.support.benches import LIVE_BENCH
from tests.support.commands import assert_refused, run_hilstar_here, sent
from tests.support.live_runs import attitudes, median_age_ns, serve_until
from tests.support.senders import packet
from tests.support.servers import interrupted, listening, summary_of, until_said
from tests.support.waiting import CoreWaits, best_of_three, in_time, real_time, repeating
from tests.support.wire.ptys import Cable

BAUD = 921_600
START_DEG = (84.057, -1.2, 0.0)
# A packet's float32 rate (0.35 rad/s) predicts over 100 ms; and rounding.
PREDICTED_RAD = 1e-7 * 0.35 + 1e-9
FLOOD_HZ, FLOOD_EACH_S = 6000, 0.001
LATE_S = 0.5  # a loaded machine wakes late


@pytest.fixture
def cable(tmp_path) -> Iterator[Cable]:
    with Cable(tmp_path) as cable:
        yield cable


@pytest.fixture
def wire_file(tmp_path, cable):
    path = tmp_path / "serial.toml"
    path.write_text(
        f'{LIVE_BENCH}\n[attitude]\nsource = "serial"\nport = "{cable.host}"\nbaud = {BAUD}\n'
    )
    return path


def test_two_hundred_a_second_arrive_none_lost_none_refused_and_both_sides_talk(cable, wire_file):
    with listening(wire_file, "reading serial:") as process:
        process.shows()
        told = sent(
            f"serial:{cable.sender}@{BAUD}", "--spin", "z,1", "--rate", "200", "--count", "400"
        )
        process.has_received(400)
        summary = interrupted(process)
    assert told["sent"] == summary["packets"]["accepted"] == summary["packets"]["received"] == 400
    assert summary["packets"]["refused"] == 0
    assert told["requests"] >= 2 and told["statuses"] >= 2, told
    clock = summary["clock"]
    assert clock["mode"] == "exchange"
    assert clock["exchanges"] >= 2, clock
    # Both processes have the same clock: the offset is its own error.
    assert abs(clock["offset_ms"]) <= clock["uncertainty_ms"] + 1.0
    assert summary["receive_latency_ms"]["p50"] is not None


def test_nothing_wrong_is_drawn_over_a_bad_cable(cable, wire_file):
    """A turn of 20 deg/s: every attitude drawn is that of its time, to what a packet's float32
    rate predicts in 100 ms.
    """
    rate = np.radians([0.0, 0.0, 20.0])
    with (
        load(wire_file) as bench,
        SerialLink(str(cable.host), BAUD) as link,
        SerialSender(str(cable.sender), BAUD) as road,
    ):
        faults = BadCable(Faults(0.10, 0.05, 0.05), np.random.default_rng(7), road.put)
        stop = threading.Event()
        samples = spin_samples(rate, 200.0, START_DEG)
        sender = threading.Thread(target=send, args=(faults, samples, stop))
        sender.start()

        def enough(frames, run) -> bool:
            return len(attitudes(frames)) > 120 and run.packets.refused > 10

        summary, frames = serve_until(bench, link, enough)
        stop.set()
        sender.join()
    shown = [(t_ns, attitude.q_icrs_to_cam) for t_ns, attitude in attitudes(frames)]
    assert len(shown) > 120
    assert summary.packets.refused > 10
    first_ns, first = shown[0]
    for t_ns, q in shown:
        assert angle_between_rad(q, propagate(first, rate, (t_ns - first_ns) / 1e9)) < PREDICTED_RAD
    # The first one, too, is on the turn from the start, however long the display took to begin.
    start = from_radec_roll_deg(*START_DEG)
    turned_s = angle_between_rad(start, first) / np.linalg.norm(rate)
    assert angle_between_rad(first, propagate(start, rate, turned_s)) < PREDICTED_RAD * (
        1 + 10 * turned_s
    )


def test_a_line_that_filled_up_while_the_display_was_made_ready_misleads_nobody(cable, wire_file):
    """A second and a half of packets in the kernel's buffer and at the sender, which had to wait
    for room.
    """
    with (
        load(wire_file) as bench,
        SerialLink(str(cable.host), BAUD) as link,
        SerialSender(str(cable.sender), BAUD) as road,
    ):
        stop = threading.Event()
        faults = BadCable(Faults(0, 0, 0), np.random.default_rng(7), road.put)
        sender = threading.Thread(
            target=send, args=(faults, spin_samples(np.zeros(3), 200.0, START_DEG), stop)
        )
        sender.start()
        time.sleep(1.5)
        shown = []
        summary = msgspec.to_builtins(serve(bench, link, Limit(slots=150), shown.append))
        age_ns = median_age_ns(shown)
        stop.set()
        sender.join()
    assert summary["packets"]["refused"] == 0
    assert summary["clock"]["jumps"] == 0
    # Both ends have one clock; what is left after the first seconds is the line's delay, or half of
    # an exchange's.
    assert abs(summary["clock"]["offset_ms"]) < summary["clock"]["uncertainty_ms"] + 2.0
    assert age_ns < 250_000_000
    assert summary["receive_latency_ms"]["p50"] < 30


@pytest.mark.timing
def test_a_device_that_goes_and_comes_back_is_picked_up_within_a_second(tmp_path, cable, wire_file):
    with listening(wire_file, "reading serial:") as process:
        process.shows()
        shown_s = time.monotonic()
        assert (
            sent(
                f"serial:{cable.sender}@{BAUD}", "--spin", "z,1", "--rate", "100", "--count", "50"
            )["sent"]
            == 50
        )
        process.has_received(50)
        cable.pull()
        time.sleep(0.6)
        cable.plug()
        with CoreWaits(process.pid) as waited:
            plugged_s = time.monotonic()
            until_said(process, "is back")
            took_s = time.monotonic() - plugged_s
        assert took_s - waited.s < 1.0 + LATE_S, (took_s, waited.s)
        assert (
            sent(
                f"serial:{cable.sender}@{BAUD}", "--spin", "z,1", "--rate", "100", "--count", "50"
            )["sent"]
            == 50
        )
        process.has_received(100)
        lasted_s = time.monotonic() - shown_s
        summary = interrupted(process)
    assert summary["reconnects"] == 1
    assert summary["packets"]["accepted"] == 100
    # the last packet is old before the line is back
    assert summary["stale_events"] >= 1, summary
    # Frames go on at 60 Hz through the 0.6 s without a line and the rest, to the last one
    # begun.
    assert lasted_s > 1.6
    assert summary["frames"] + summary["missed_frames"] >= 60 * lasted_s - 2


def test_a_line_of_garbage_without_an_end_is_one_refusal_and_the_next_frame_is_taken(
    cable, wire_file
):
    # an answer would end the garbage
    wire_file.write_text(wire_file.read_text() + "time_requests = false\n")
    with listening(wire_file, "reading serial:") as process:
        with SerialSender(str(cable.sender), BAUD) as road:
            for _ in range(50):
                road.send_bytes(b"\x55" * 1000, 1.0)
                time.sleep(0.002)
        sent(f"serial:{cable.sender}@{BAUD}", "--spin", "z,1", "--rate", "100", "--count", "20")
        process.has_accepted(20)
        summary = interrupted(process)
    assert summary["packets"]["refused_by"]["format"] == 1
    assert summary["packets"]["accepted"] == 20


def test_a_port_that_is_not_there_or_no_port_gets_one_line(tmp_path):
    bench = tmp_path / "bench.toml"
    for port, code, said in (("/dev/ttyNowhere", 3, "plug it in"), ("/dev/null", 2, "ttyUSB0")):
        bench.write_text(f'{LIVE_BENCH}\n[attitude]\nsource = "serial"\nport = "{port}"\n')
        assert_refused(
            run_hilstar_here("serve", bench, "--headless", "--duration", "1"), code, port, said
        )
    bench.write_text(f'{LIVE_BENCH}\n[attitude]\nsource = "serial"\n')
    assert_refused(run_hilstar_here("serve", bench, "--headless", "--duration", "1"), 2, "port")
    assert_refused(
        run_hilstar_here("send", "--spin", "z,1", "--to", "serial:/dev/ttyNowhere@115200"),
        3,
        "ttyNowhere",
    )
    assert_refused(
        run_hilstar_here("send", "--spin", "z,1", "--to", "serial:@115200"),
        2,
        "serial:/dev/ttyX@BAUD",
    )


@pytest.mark.timing
@best_of_three("a machine without real-time priorities writes less than a flood to its pty")
def test_more_packets_than_a_run_looks_at_are_passed_over_and_the_run_ends_in_order(tmp_path):
    """Every packet in a write of its own, as a USB-CDC device sends them, whatever its baud
    rate, to the end.

    A pty holds 62 packets: where writer or reader waits 20 ms for a core, no flood can pass it.
    """
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    bench, ledger = tmp_path / "flood.toml", tmp_path / "run.mcap"
    bench.write_text(f'{LIVE_BENCH}\n[attitude]\nsource = "serial"\nport = "{os.ttyname(slave)}"\n')
    sequences, cut = itertools.count(), []

    def put() -> None:
        for _ in range(round(FLOOD_HZ * FLOOD_EACH_S)):
            frame = cobs.encode(packet(next(sequences), time.monotonic_ns())) + b"\0"
            with contextlib.suppress(BlockingIOError):
                if os.write(master, frame) < len(frame):  # the pty is nearly full
                    cut.append(frame)

    command = "reading serial:", "--ledger", str(ledger)
    with real_time(), listening(bench, *command) as process:
        process.shows()
        with repeating(put, FLOOD_EACH_S):
            process.has_received(2 * MAX_PACKETS_PER_S)
            process.send_signal(signal.SIGTERM)
            summary = summary_of(process)
    os.close(master)
    os.close(slave)
    assert summary["packets"]["refused"] <= len(cut)
    assert summary["ledger"]["failure"] is None
    in_time(summary["link"]["flooded"] > 0, summary["link"])  # a busy machine sends less
    in_time(summary["attitude_age_ms"]["p50"] < 100, summary["attitude_age_ms"])
    in_time("stale" not in summary["events"], summary["events"])
