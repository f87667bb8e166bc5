"""The status that goes back to the sender, and the summary of a run."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.receiver import PacketCounts, Traffic
from hilstar.attitude.wire import protocol
from hilstar.basics.notices import Notices
from hilstar.server.bench.config import AttitudeSettings
from hilstar.server.operator import Aids, Operator
from hilstar.server.pacer import Shown
from hilstar.server.record.ledger import Ledger
from hilstar.server.replay import DrawnBy
from hilstar.server.serve import StatusMaker, traffic_of
from hilstar.server.summary import RunTally, SwapTally
from tests.support.drawn import drawn

FRESH = Attitude(np.array([1.0, 0.0, 0.0, 0.0]), 5_000_000, False, sequence=42)
MS = 1_000_000


RENDERER = DrawnBy("llvmpipe", "4.5", "points")
BLACK = np.zeros((3, 4), np.uint8)


def shown_frame(
    attitude: Attitude | None = FRESH, number: int = 9, clipped: tuple[int, ...] = (), **more
) -> Shown:
    return Shown(number, 0, attitude, drawn(BLACK, clipped_hip=clipped), **more)


def test_a_status_names_the_frame_its_light_and_the_attitude_behind_it(loop):
    counts = PacketCounts(received=10)
    counts.refused_by["crc"] = 3
    status = StatusMaker().status(shown_frame(), 123, loop, counts, True)
    assert (status.frame, status.light_t_ns, status.attitude_sequence, status.attitude_age_ns) == (
        9,
        123,
        42,
        5 * MS,
    )
    assert (status.accepted, status.refused) == (7, 3)
    assert status.health == protocol.HEALTH_CLOCK_SYNCHRONISED | protocol.HEALTH_REFUSED


def test_without_an_attitude_its_age_is_minus_one(loop):
    status = StatusMaker().status(shown_frame(None, missing=True), 0, loop, PacketCounts(), False)
    assert (status.attitude_age_ns, status.attitude_sequence) == (-1, 0)
    assert status.health == protocol.HEALTH_NO_ATTITUDE | protocol.HEALTH_BLANK


def test_an_attitude_that_was_there_and_is_stale_has_come(loop):
    """The timeline has none where its clock was set back to before the first."""
    loop.gate.stale = True
    status = StatusMaker().status(shown_frame(None, missing=True), 0, loop, PacketCounts(), False)
    assert status.health == protocol.HEALTH_STALE | protocol.HEALTH_BLANK


@pytest.mark.parametrize(
    ("keys", "wanted"),
    [
        ({"status_hz": 7.0}, Traffic(7.0, True, "estimated")),
        ({"time_requests": False}, Traffic(10.0, False, "estimated")),
        ({"clock": "shared"}, Traffic(10.0, False, "shared")),
        ({"clock": "unix", "status_hz": 0.0}, Traffic(0.0, False, "unix")),
        ({"source": "scpi"}, Traffic(10.0, False, "shared")),
    ],
)
def test_a_sender_whose_clock_is_known_is_asked_for_no_time(keys, wanted):
    assert traffic_of(AttitudeSettings(**keys)) == wanted


def test_missed_frames_and_refused_packets_are_told_once_each_time(loop):
    maker, counts = StatusMaker(), PacketCounts()
    loop.tally.missed_frames, counts.refused_by["norm"] = 2, 1
    bits = protocol.HEALTH_MISSED | protocol.HEALTH_REFUSED
    assert [maker.status(shown_frame(), 0, loop, counts, False).health for _ in range(2)] == [
        bits,
        0,
    ]
    loop.tally.missed_frames += 1
    assert maker.status(shown_frame(), 0, loop, counts, False).health == protocol.HEALTH_MISSED


def test_an_operator_s_keys_and_a_hidden_window_are_told_while_they_last(loop):
    maker = StatusMaker()

    def health() -> int:
        return maker.status(shown_frame(), 0, loop, PacketCounts(), False).health

    loop.pacer.operator.aids.toggle("grid")
    assert [health(), health()] == [protocol.HEALTH_OPERATOR_OVERRIDE] * 2
    loop.pacer.operator = Operator(Aids(), Notices(), lambda: "minimised")
    assert [health(), health()] == [protocol.HEALTH_HIDDEN] * 2


def test_a_failed_ledger_a_clipped_star_and_a_stale_attitude_are_told_while_they_last(
    loop, small_bench, tmp_path
):
    with Ledger(tmp_path / "run.mcap", small_bench) as ledger:
        maker = StatusMaker(ledger)
        assert maker.status(shown_frame(), 0, loop, PacketCounts(), False).health == 0
        ledger.failure, loop.gate.stale = "No space left on device", True
        clips = shown_frame(clipped=(32349,))
        health = maker.status(clips, 0, loop, PacketCounts(), False).health
    assert health == (
        protocol.HEALTH_LEDGER_FAILED | protocol.HEALTH_CLIPPED | protocol.HEALTH_STALE
    )


def test_a_second_sender_is_told_while_it_lasts_and_once_if_it_has_gone_since(loop):
    maker, notices = StatusMaker(), loop.notices

    def health() -> int:
        return maker.status(shown_frame(), 0, loop, PacketCounts(), False).health

    notices.begin("second-sender", "two senders")
    assert [health(), health()] == [protocol.HEALTH_SECOND_SENDER] * 2
    notices.end("second-sender", "one-sender", "one sender again")
    assert health() == 0
    notices.begin("second-sender", "two senders")
    notices.end("second-sender", "one-sender", "one sender again")
    assert [health(), health()] == [protocol.HEALTH_SECOND_SENDER, 0]


def test_a_run_without_a_frame_has_nulls_where_there_is_no_figure():
    summary = msgspec.to_builtins(RunTally().summary(0.0, PacketCounts(), RENDERER))
    assert summary["frames"] == 0 and summary["fps"] is None
    assert summary["frame_ms"] == {"p50": None, "p99": None, "max": None}
    assert summary["stars_drawn"] == {"mean": None, "max": None}
    assert summary["clipped"] == {"max": 0, "hip": [], "bodies": []}
    assert not {"clock", "turn_ms", "link", "screen", "ledger"} & set(summary)


def test_a_summary_has_the_figures_of_its_frames():
    tally = RunTally()
    for k in range(100):
        clipped = {8: (5, 3), 9: ("Venus",)}.get(k, ())
        tally.add((2 + k % 2) * MS, None if k == 0 else 7 * MS, 50 + k, clipped)
    counts = PacketCounts(received=30)
    counts.refused_by["crc"] = 10
    summary = msgspec.to_builtins(tally.summary(2.0, counts, RENDERER))
    assert (summary["frames"], summary["fps"]) == (100, 50)
    assert summary["frame_ms"]["max"] == 3.0
    assert summary["frame_ms"]["p50"] == pytest.approx(2.0, rel=2e-3)
    assert summary["attitude_age_ms"]["p99"] == pytest.approx(7.0, rel=2e-3)
    assert summary["stars_drawn"] == {"mean": pytest.approx(99.5), "max": 149}
    assert summary["clipped"] == {"max": 2, "hip": [3, 5], "bodies": ["Venus"]}
    assert summary["packets"]["accepted"] == 20
    # the reasons of every source, refused or not: a script that reads them finds each
    refused_by = {"crc": 10, "norm": 0, "nan": 0, "time": 0, "format": 0}
    assert summary["packets"]["refused_by"] == refused_by


def test_an_interval_over_missed_frames_is_no_jitter():
    swaps = SwapTally()
    assert swaps.summary() == {}
    at = 0
    for k in range(50):
        at += 40 * MS if k == 25 else 20 * MS
        swaps.add(at + (MS if k == 30 else 0), at, int(k == 25), at - 6 * MS)
    summary = swaps.summary()
    assert summary["swap_late_ms"]["max"] == 1.0
    assert summary["packet_to_swap_ms"]["p50"] == pytest.approx(6.0, rel=2e-3)
    # One swap a millisecond late makes one interval longer and one shorter: sqrt(2 / 48).
    assert summary["pacing_jitter_ms"] == pytest.approx((2 / 48) ** 0.5, rel=1e-6)
