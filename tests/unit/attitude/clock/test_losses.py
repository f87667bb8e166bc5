"""What the times and counts of packets say: how many were lost, and in which unit `t_ns` is."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.attitude.clock.losses import RECENT, UNIT, LossCount, TimeUnit
from hilstar.attitude.wire.packet import U32
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_S


def lost_of(*sequences: int) -> int:
    count = LossCount()
    for sequence in sequences:
        count.see(sequence)
    return count.lost


@pytest.mark.parametrize(
    ("sequences", "lost"),
    [
        ([1, 2, 3, 4], 0),
        ([1, 2, 5, 6], 2),
        ([1, 2, 5, 3, 6], 1),  # 3 came late
        ([1, 2, 5, 5, 5, 6], 2),  # 5 came twice
        ([1, 2, 5, 6, 5, 3, 3, 7], 1),  # late ones, too
        ([5, 6, 8, 5, 9], 1),  # and the first
        ([U32 - 2, U32 - 1, 0, 1], 0),
        ([U32 - 2, 1, 2], 2),
        ([0, 0, 0, 0], 0),  # it does not count
        ([10, 0, 11, 0, 12], 0),  # others among them do not
        ([10, 20, 30, 50, 60], 1),  # it counts by ten
        ([5000, 5001, 5003, 1, 2, 3], 1),  # begun anew
        ([5, 6, 8, 4_000_000_000, 4_000_000_001], 1),
    ],
)
def test_gaps_of_the_sequence_are_lost_packets(sequences, lost):
    assert lost_of(*sequences) == lost


def test_many_lost_of_a_shuffled_stream_are_counted_exactly():
    rng = np.random.default_rng(1)
    sent = np.arange(20_000)
    kept = rng.random(len(sent)) > 0.02
    kept[[0, -1]] = True
    order = np.argsort(sent[kept] + rng.uniform(0, RECENT / 8, int(kept.sum())))
    count = LossCount()
    count.see(0)
    for sequence in sent[kept][order].tolist():
        count.see((sequence + 1) % U32)
    assert count.lost == int((~kept).sum())


@pytest.mark.parametrize(
    ("divisor", "words"),
    [
        (10**9, "seconds"),
        (10**6, "milliseconds"),
        (10**4, "ticks of 10 us"),
        (10**3, "microseconds"),
        (100, "ticks of 100 ns"),
    ],
)
@pytest.mark.parametrize("hz", [10, 50, 200])
def test_the_unit_of_t_ns_is_named(divisor, words, hz):
    notices = Notices()
    unit = TimeUnit(notices)
    rng = np.random.default_rng(2)
    for k in range(8 * hz):
        t_ns = 10**15 + k * NS_PER_S // hz
        unit.see(t_ns // divisor, t_ns + round(rng.exponential(2e6)))
    assert unit.named == words and f"it is in {words}, not" in notices.lasting[UNIT]
    assert notices.lasting[UNIT].endswith(f"; send nanoseconds: multiply by {divisor}")


@pytest.mark.parametrize("pace", [1.0, 0.9, 0.5, 2.0, 0.1, 10.0, 0.002])
def test_a_clock_of_another_pace_is_of_no_unit(pace):
    notices = Notices()
    unit = TimeUnit(notices)
    for k in range(500):
        unit.see(round(pace * k * NS_PER_S / 100), k * NS_PER_S // 100)
    assert not unit.named and UNIT not in notices.counts()


def test_one_tick_in_seconds_tells_no_unit():
    """A clock that nearly stands is of no unit: one tick may be the end of any."""
    notices = Notices()
    unit = TimeUnit(notices)
    for k in range(700):
        unit.see(k // 310, k * NS_PER_S // 100)
    assert not unit.named and UNIT not in notices.counts()


def test_a_unit_that_was_named_stands_while_arrivals_are_uneven_and_goes_with_the_fault():
    """Of a busy machine: in windows of 0.5 s some ends are 60 ms late, so paces are 12 % off."""
    notices = Notices()
    unit = TimeUnit(notices)
    for k in range(2000):
        late_ns = 60_000_000 * (k // 50 % 2) if k > 200 else 0
        unit.see(k * 10_000, k * NS_PER_S // 100 + late_ns)
        assert unit.named == "microseconds" or k < 200
    assert notices.counts() == {UNIT: 1}
    for k in range(400):
        unit.see(10**12 + k * NS_PER_S // 100, 21 * NS_PER_S + k * NS_PER_S // 100)
    assert not unit.named and notices.counts() == {UNIT: 1, "time-unit-right": 1}


@pytest.mark.parametrize("windows", [2, 3])
def test_a_unit_goes_after_three_windows_of_another_pace_and_its_line_says_what_to_send(windows):
    """Half a second each; two of them may be uneven."""
    notices = Notices()
    unit = TimeUnit(notices)
    for k in range(200):
        unit.see(k * 10_000, k * NS_PER_S // 100)
    assert notices.lasting[UNIT] == (
        "t_ns runs at 0.001 times real time: it is in microseconds, not in nanoseconds; send"
        " nanoseconds: multiply by 1000"
    )
    for k in range(52 * windows):
        unit.see(k * NS_PER_S // 100, (200 + k) * NS_PER_S // 100)
    assert bool(unit.named) == (windows < 3)
    assert notices.counts().get("time-unit-right", 0) == (windows >= 3)


# Windows of half a second: at the pace of microseconds, at 0.8 of that, and in nanoseconds.
NAMED, NEAR, OTHER = 1e-3, 0.8e-3, 1.0


def unit_after(paces: list[float]) -> tuple[TimeUnit, Notices]:
    """What is said of a sender whose times run at these paces, half a second each."""
    notices = Notices()
    unit = TimeUnit(notices)
    t_ns = 0.0
    unit.see(0, 0)
    for k in range(1, 50 * len(paces) + 1):
        t_ns += paces[(k - 1) // 50] * NS_PER_S / 100
        unit.see(round(t_ns), k * NS_PER_S // 100)
    return unit, notices


@pytest.mark.parametrize(
    ("paces", "named"),
    [
        ([NAMED, OTHER, OTHER, OTHER], ""),
        ([NAMED, OTHER, OTHER, NEAR, OTHER, OTHER], "microseconds"),
        ([NAMED, OTHER, OTHER, NEAR, OTHER, OTHER, OTHER], ""),
        ([NAMED, OTHER, OTHER, NAMED, OTHER, OTHER], "microseconds"),
        ([NAMED, NEAR, NEAR, NEAR, NEAR], "microseconds"),
        ([NEAR, NEAR, NEAR, NEAR], ""),
    ],
)
def test_a_unit_goes_by_paces_in_a_row_and_not_by_their_number(paces, named):
    """Uneven windows come again and again on a busy machine: one right one between them counts."""
    unit, notices = unit_after(paces)
    assert unit.named == named
    assert bool(notices.lasting.get(UNIT)) is bool(named)


@pytest.mark.parametrize(("packets", "named"), [(5, ""), (6, "microseconds")])
def test_a_unit_is_told_by_five_intervals(packets, named):
    unit = TimeUnit(Notices())
    for k in range(packets):
        unit.see(k * 200_000, k * NS_PER_S // 5)
    assert unit.named == named


@pytest.mark.parametrize("pause_s", [0.2, 20.0, 200.0])
def test_a_pause_in_which_a_simulation_stands_is_of_no_unit(pause_s):
    """0.2 s of it are a thousandth of 200 s."""
    notices = Notices()
    unit = TimeUnit(notices)
    for k in range(200):
        waited_s = pause_s * (k // 20)
        unit.see(k * NS_PER_S // 100, k * NS_PER_S // 100 + round(waited_s * NS_PER_S))
    assert not unit.named and UNIT not in notices.counts()


def test_picoseconds_have_no_whole_factor():
    notices = Notices()
    unit = TimeUnit(notices)
    for k in range(200):
        unit.see(k * 10 * NS_PER_S, k * NS_PER_S // 100)
    assert notices.lasting[UNIT] == (
        "t_ns runs at 1e+03 times real time: it is in picoseconds, not in nanoseconds; send"
        " nanoseconds"
    )
