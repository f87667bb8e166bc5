"""Sender time and host time: what is simulated is known exactly, so every figure is an error."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hilstar.attitude.clock.jumps import JumpFilter, clock_named
from hilstar.attitude.clock.sender_clock import (
    EXCHANGE_LIFE_NS,
    LOCAL_DELAY_NS,
    MAX_DRIFT,
    MIN_EXCHANGES,
    SLOT_NS,
    Exchange,
    SenderClock,
)
from hilstar.attitude.clock.stages import StreamState
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.process.scheduling import UnixOffset
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from tests.support.claims import holds

PERIOD_NS = 5_000_000
MIN_DELAY_MS = 0.05
HOST0_NS = 10**12
SLEW = 0.01  # a turn seems at most a hundredth faster or slower while a clock is put right
Q = np.array([1.0, 0.0, 0.0, 0.0])
Delay = Callable[[np.random.Generator, int], float]


def usual(rng: np.random.Generator, k: int) -> float:
    """A loopback's delay, ns: 0.05 ms and an exponential tail of 0.05 ms."""
    return MIN_DELAY_MS * 1e6 + rng.exponential(50_000)


class ClockRun:
    """A stream of 200 Hz through jump filter and clock, a frame every third packet; errors in ms
    of time shown.
    """

    def __init__(
        self, sender_ns: Callable[[int, int], int], delay: Delay = usual, count: int = 6000
    ) -> None:
        rng = np.random.default_rng(1)
        self.clock = SenderClock()
        self.jumps = JumpFilter(self.clock, StreamState())
        self.refused = self.accepted = 0
        errors = []
        newest_ns, newest = -(2**80), 0
        for k in range(count):
            host_ns = HOST0_NS + k * PERIOD_NS
            arrival_ns = host_ns + round(delay(rng, k))
            for each in self.jumps.take(
                Arrival(arrival_ns, AttitudeSample(sender_ns(host_ns, k), Q, None, k))
            ):
                if each.refusal is not None or each.event.t_ns <= newest_ns:
                    self.refused += 1
                    continue
                self.accepted += 1
                newest_ns, newest = each.event.t_ns, each.event.sequence
            if k % 3 == 2:
                frame_ns = host_ns + 4 * NS_PER_MS
                age_ns = frame_ns - (HOST0_NS + newest * PERIOD_NS)  # the truth
                errors.append((self.clock.to_sender_ns(frame_ns) - newest_ns - age_ns) / NS_PER_MS)
        self.error_ms = np.array(errors)
        self.step_ms = np.abs(np.diff(self.error_ms)).max()


@pytest.fixture(scope="module")
def plain() -> ClockRun:
    """A clock that is right but for its offset, on a loopback."""
    return ClockRun(lambda host, k: host - 5 * 10**11)


def test_a_one_way_stream_is_shown_late_by_its_minimum_delay_and_no_more(plain):
    assert np.abs(plain.error_ms[200:] + MIN_DELAY_MS).max() < 0.005
    assert plain.clock.summary().mode == "one-way"


@pytest.mark.parametrize("ppm", [100, -100, 1000, -1000])
def test_a_drift_is_followed_and_stated(ppm):
    """Within 5 us of the minimum delay for 100 ppm, which is 0.02 arcsec at 1 deg/s; and the
    drift to 1 ppm.
    """
    run = ClockRun(lambda host, k: host + (host - HOST0_NS) * ppm // 1_000_000)
    late_us = 1000 * np.abs(run.error_ms[600:] + MIN_DELAY_MS).max()
    holds("clock-drift", 100 * late_us / abs(ppm))
    assert run.clock.summary().drift_ppm == pytest.approx(ppm, abs=1.0)
    assert run.jumps.jumps == 0


@pytest.mark.parametrize("jump_ms", [20, -20, 300, -300, 3000, -3000, 10**9, -(10**9)])
def test_a_clock_that_jumps_is_carried_on_without_a_step(jump_ms):
    """0.01 ms is 0.04 arcsec at 1 deg/s. No sample is lost."""
    run = ClockRun(lambda host, k: host + (jump_ms * NS_PER_MS if k > 3000 else 0))
    assert run.jumps.jumps == 1
    assert (run.accepted, run.refused) == (6000, 0)
    assert run.step_ms < 0.01
    assert np.abs(run.error_ms[200:] + MIN_DELAY_MS).max() < 0.01
    # a moment's time by the sender's own clock, which has jumped
    host_ns = HOST0_NS + 6000 * PERIOD_NS
    own_ns = run.jumps.sender_ns(run.clock.to_sender_ns(host_ns))
    assert (own_ns - host_ns) / NS_PER_MS == pytest.approx(jump_ms - MIN_DELAY_MS, abs=0.02)


@pytest.mark.parametrize("ahead_s", [1, 3600, 10**9])
def test_one_packet_far_ahead_is_refused_and_changes_nothing(ahead_s):
    run = ClockRun(lambda host, k: host + (ahead_s * NS_PER_S if k == 3000 else 0))
    assert (run.accepted, run.refused, run.jumps.jumps) == (5999, 1, 0)
    assert np.abs(run.error_ms[200:] + MIN_DELAY_MS).max() < 0.005


@pytest.mark.parametrize(("uneven_ms", "jumps"), [(1.9, 1), (2.1, 0)])
def test_messages_within_two_milliseconds_of_each_other_agree_on_a_jump(uneven_ms, jumps):
    """Of a line whose delays were even, after a jump by 50 ms every other message is later."""
    jumped_at = 600

    def delay(rng: np.random.Generator, k: int) -> float:
        is_later = k > jumped_at and k % 2
        return 1e6 + (uneven_ms * NS_PER_MS if is_later else 0.0)

    def sender_ns(host_ns: int, k: int) -> int:
        return host_ns - (50 * NS_PER_MS if k >= jumped_at else 0)

    assert ClockRun(sender_ns, delay, jumped_at + 30).jumps.jumps == jumps


def test_a_queue_that_drains_is_no_jump():
    """60 packets held back for 300 ms and let go at once."""

    def held(rng: np.random.Generator, k: int) -> float:
        return usual(rng, k) + (3060 - k) * PERIOD_NS * (3000 <= k < 3060)

    run = ClockRun(lambda host, k: host, held)
    assert (run.accepted, run.jumps.jumps) == (6000, 0)
    assert np.abs(run.error_ms[200:] + MIN_DELAY_MS).max() < 0.005


def test_a_usb_adapter_that_gathers_for_16_ms_is_no_jump():
    def gathered(rng: np.random.Generator, k: int) -> float:
        return usual(rng, k) + -(k * PERIOD_NS) % 16_000_000

    run = ClockRun(lambda host, k: host, gathered)
    assert (run.accepted, run.jumps.jumps) == (6000, 0)
    assert np.abs(run.error_ms[300:] + MIN_DELAY_MS).max() < 0.03


def test_jitter_of_5_ms_costs_a_tenth_of_a_millisecond():
    run = ClockRun(lambda host, k: host, lambda rng, k: MIN_DELAY_MS * 1e6 + rng.exponential(5e6))
    assert np.abs(run.error_ms[300:] + MIN_DELAY_MS).max() < 0.1


def test_where_it_fails_a_jump_smaller_than_the_limit_is_a_step_until_the_line_forgets():
    """2 ms are under what a queue may do: the time shown is off by up to that, 7 arcsec at 1
    deg/s.
    """
    run = ClockRun(lambda host, k: host - (2 * NS_PER_MS if k > 3000 else 0))
    assert run.jumps.jumps == 0
    assert 1.5 < np.abs(run.error_ms[1100:1200]).max() < 2.1


@pytest.mark.parametrize("speed", [0.5, 0.9, 0.99])
def test_a_slow_clock_is_followed_in_small_steps_and_is_no_row_of_jumps(speed, plain):
    """A step of 5 ms, and what a packet's period adds. Known after three seconds; before, it is
    behind by what it is slow.
    """
    run = ClockRun(lambda host, k: round((host - HOST0_NS) * speed))
    assert run.accepted == 6000
    assert run.jumps.jumps == 0
    assert run.jumps.slowness == pytest.approx(1 - speed, rel=0.1)
    assert np.abs(run.error_ms[1000:]).max() < 12
    assert plain.jumps.slowness == 0


def test_a_fast_clock_is_known_to_be_one():
    run = ClockRun(lambda host, k: host * 3 // 2)
    assert (run.accepted, run.jumps.jumps) == (6000, 0)
    assert run.jumps.slowness == pytest.approx(-0.5, rel=0.05)


def exchanged(
    clock: SenderClock,
    rng: np.random.Generator,
    ppm: float = 0.0,
    wire_ns: tuple[int, int] = (0, 0),
    count: int = 40,
) -> None:
    """Exchanges twice a second with a sender 7 s ahead; delays as a loopback's, and what the
    wire takes.
    """
    for k in range(count):
        t1 = HOST0_NS + k * NS_PER_S // 2
        arrives = t1 + usual(rng, k) + wire_ns[0]
        answers = arrives + 30_000
        back = answers + usual(rng, k) + wire_ns[1]

        def sender(host_ns: float) -> int:
            return round(host_ns + 7 * NS_PER_S + (host_ns - HOST0_NS) * ppm * 1e-6)

        clock.exchange(Exchange(t1, sender(arrives), sender(answers), round(back), *wire_ns))


@pytest.mark.parametrize("ppm", [0.0, 100.0, -100.0])
def test_exchanges_give_the_offset_itself_and_its_bound(rng, ppm):
    clock = SenderClock()
    exchanged(clock, rng, ppm)
    end_ns = HOST0_NS + 20 * NS_PER_S
    error_ms = (
        clock.to_sender_ns(end_ns) - (end_ns + 7 * NS_PER_S + 20 * NS_PER_S * ppm * 1e-6)
    ) / NS_PER_MS
    summary = clock.summary()
    assert summary.mode == "exchange"
    assert abs(error_ms) < 0.05
    assert abs(error_ms) <= summary.uncertainty_ms
    assert summary.drift_ppm == pytest.approx(ppm, abs=5.0)


def test_a_slow_wire_s_longer_reply_is_allowed_for(rng):
    """9600 baud: 22.9 ms there and 39.6 ms back; half of the difference, 8 ms, would be the
    error.
    """
    wire_ns = (22_900_000, 39_600_000)
    clock = SenderClock()
    exchanged(clock, rng, wire_ns=wire_ns)
    end_ns = HOST0_NS + 20 * NS_PER_S
    assert abs(clock.to_sender_ns(end_ns) - end_ns - 7 * NS_PER_S) < 0.1 * NS_PER_MS


def test_exchanges_that_stop_give_way_to_the_stream(rng):
    clock = SenderClock()
    exchanged(clock, rng, count=MIN_EXCHANGES)
    assert clock.synchronised
    later_ns = HOST0_NS + 2 * NS_PER_S + EXCHANGE_LIFE_NS
    clock.observe(later_ns + 7 * NS_PER_S, later_ns)
    assert not clock.synchronised


def test_a_correction_enters_without_a_step():
    """After its first second, an offset that is found 20 ms smaller moves by no more than SLEW
    of the time that goes by.
    """
    clock = SenderClock()
    shown = []
    for k in range(1200):
        host_ns = HOST0_NS + k * PERIOD_NS
        clock.observe(host_ns - (0 if k > 600 else 20 * NS_PER_MS), host_ns)
        shown.append(clock.to_sender_ns(host_ns))
    steps = np.diff(shown)
    assert np.abs(steps[250:] - PERIOD_NS).max() <= SLEW * PERIOD_NS + 1
    assert shown[-1] == pytest.approx(HOST0_NS + 1199 * PERIOD_NS, abs=1e3)


@pytest.mark.parametrize("by_ms", [-60, -40, -5, 5, 40, 60])
def test_a_clock_that_is_set_is_followed_at_most_by_slew_below_50_ms_and_else_at_once(by_ms):
    """Packets without a delay and exchanges twice a second, of a sender that is set by `by_ms`
    after 4 s.
    """
    clock = SenderClock()
    shown = []
    for k in range(2200):
        host_ns = HOST0_NS + k * PERIOD_NS
        t_ns = host_ns + (by_ms * NS_PER_MS if k >= 800 else 0)
        clock.observe(t_ns, host_ns)
        if k % 100 == 0:
            clock.exchange(Exchange(host_ns, t_ns, t_ns, host_ns))
        shown.append(clock.to_sender_ns(host_ns))
    assert shown[799] == HOST0_NS + 799 * PERIOD_NS
    assert shown[-1] == t_ns
    step_ns = np.diff(shown) - PERIOD_NS
    fast_ns = step_ns[np.abs(step_ns) > SLEW * PERIOD_NS + 1]
    assert fast_ns.tolist() == ([by_ms * NS_PER_MS] if abs(by_ms) > 50 else [])


@pytest.mark.parametrize("by_exchanges", [True, False])
@pytest.mark.parametrize("ppm", [-2100, -1900, 1900, 2100])
def test_a_drift_over_two_thousandths_is_none(ppm, by_exchanges):
    """Exchanges take 0.5 ms each way: by less than that a sender's clock was not set."""
    clock = SenderClock()
    way_ns = NS_PER_MS // 2
    for k in range(40):
        host_ns = HOST0_NS + k * NS_PER_S // 4
        t_ns = host_ns + k * NS_PER_S // 4 * ppm // 10**6
        if by_exchanges:
            clock.exchange(Exchange(host_ns - way_ns, t_ns, t_ns, host_ns + way_ns))
        else:
            clock.observe(t_ns, host_ns)
    expected_ppm = ppm if abs(ppm) <= MAX_DRIFT * 1e6 else 0.0
    assert clock.summary().drift_ppm == pytest.approx(expected_ppm, abs=1e-3)


@pytest.mark.parametrize(
    ("late_us", "uncertainty_us"),
    [
        ([0, 100, 200, 400], 400 + 400 * 2 / 3),  # may rise on for two slots
        ([400, 200, 100, 0], 400),
        ([0, 300, 100, 0], 300),
        ([500] * 5 + [0] * 4, 500),  # the median of all slots
        ([0, 0, 0, 0, *[300] * 8], 300),  # the newest eight are all later
    ],
)
def test_the_uncertainty_of_a_stream_is_by_its_delays_above_the_line(late_us, uncertainty_us):
    """One message in each slot of 250 ms, those after the first four all in the next slot where
    they are late; then one that makes the clock look at them.
    """
    clock = SenderClock()
    host_ns = HOST0_NS
    for k, late in enumerate(late_us):
        host_ns += 10 * NS_PER_MS if len(late_us) > 9 and k > 4 else SLOT_NS
        clock.observe(host_ns - late * 1000, host_ns)
    if len(late_us) <= 9:
        clock.observe(host_ns + SLOT_NS, host_ns + SLOT_NS)
    known_us = clock.summary().uncertainty_ms * 1000
    assert known_us == pytest.approx(uncertainty_us + LOCAL_DELAY_NS / 1000)


@pytest.mark.parametrize("by_us", [-400, 400])
def test_exchanges_that_show_no_drift_yet_may_part_as_their_last_two_did(by_us):
    """Offsets of 0, 0 and d: two thirds of d above their mean, half a delay, and d once more."""
    clock = SenderClock()
    way_ns = NS_PER_MS // 2
    for k, offset_us in enumerate((0, 0, by_us)):
        host_ns = HOST0_NS + k * NS_PER_S // 2
        t_ns = host_ns + offset_us * 1000
        clock.exchange(Exchange(host_ns - way_ns, t_ns, t_ns, host_ns + way_ns))
    summary = clock.summary()
    assert summary.mode == "exchange"
    assert summary.uncertainty_ms == pytest.approx(0.5 + 0.4 * 5 / 3)


@pytest.mark.parametrize(
    ("way_us", "later_us", "counts"),
    [(0, 90, True), (0, 110, False), (500, 240, True), (500, 260, False)],
)
def test_an_exchange_counts_that_takes_a_quarter_or_a_tenth_of_a_ms_more(way_us, later_us, counts):
    """The third of three is later on its way there, by which its offset is off by half."""
    clock = SenderClock()
    for k, later in enumerate((0, 0, later_us)):
        t1_ns = HOST0_NS + k * NS_PER_S // 2
        t2_ns = t1_ns + (way_us + later) * 1000
        clock.exchange(Exchange(t1_ns, t2_ns, t2_ns, t2_ns + way_us * 1000))
    off_us = later_us / 2 / 3 if counts else 0.0
    assert clock.summary().offset_ms == pytest.approx(-off_us / 1000, abs=1e-9)


@pytest.mark.parametrize(
    ("behind_s", "name"),
    [
        (-37.9, "TAI"),
        (-36.1, "TAI"),
        (-38.1, None),
        (-35.9, None),
        (5.5 * 3600, "the local time of a zone 5.5 h west of UTC"),
        (-5.5 * 3600, "the local time of a zone 5.5 h east of UTC"),
        (14 * 3600 + 0.9, "the local time of a zone 14 h west of UTC"),
        (-14 * 3600 - 0.9, "the local time of a zone 14 h east of UTC"),
        (3600 + 1.1, None),
        (3600 - 1.1, None),
        (14.25 * 3600, None),
        (-14.25 * 3600, None),
        (0.0, None),
    ],
)
def test_a_clock_is_named_within_a_second_of_one_that_is_known(behind_s, name):
    assert clock_named(round(behind_s * NS_PER_S)) == name


@pytest.mark.parametrize("by_ms", [-3, 3])
def test_what_a_frame_was_off_adds_to_the_uncertainty(by_ms):
    clock = SenderClock(UnixOffset(7 * NS_PER_S, 500_000), "unix")
    clock.to_sender_ns(HOST0_NS)
    clock.know(UnixOffset(7 * NS_PER_S + by_ms * NS_PER_MS, 500_000))
    assert clock.summary().uncertainty_ms == pytest.approx(0.5 + 3)
    clock.to_sender_ns(HOST0_NS + PERIOD_NS)
    assert clock.summary().uncertainty_ms == pytest.approx(0.5)


def test_a_stream_that_came_sooner_is_forgotten_after_half_a_minute():
    """For a second without a delay, then 1 ms late: with that second it would be a drift."""
    clock = SenderClock()
    for k in range(4 * 33):
        host_ns = HOST0_NS + k * SLOT_NS
        late_ns = NS_PER_MS if k >= 4 else 0
        clock.observe(host_ns - late_ns, host_ns)
    assert clock.late_ns(host_ns - late_ns, host_ns) == pytest.approx(0, abs=1)
    assert clock.summary().drift_ppm == pytest.approx(0, abs=1e-6)


def test_before_any_message_sender_time_is_host_time():
    clock = SenderClock()
    assert clock.to_sender_ns(77) == 77
    assert clock.latency_ns(1, 2) is None
    assert clock.summary().mode == "none"


def test_a_sender_on_unix_time_keeps_its_nanoseconds():
    """1.7e18 ns in a float64 would be known to 256 ns only."""
    clock = SenderClock()
    for k in range(100):
        host_ns = HOST0_NS + k * PERIOD_NS
        clock.observe(1_700_000_000_000_000_001 + k * PERIOD_NS, host_ns)
    assert (
        clock.to_sender_ns(HOST0_NS + 99 * PERIOD_NS) == 1_700_000_000_000_000_001 + 99 * PERIOD_NS
    )


def test_a_jump_of_two_milliseconds_is_taken_for_delay():
    """The sky is late by as much: the turn in that time, at 1 deg/s."""
    jump_ns = 2 * NS_PER_MS
    run = ClockRun(lambda host_ns, k: host_ns - jump_ns * (k >= 3000))
    late_ms = np.abs(run.error_ms[1000:]).max()
    holds("small-jump", 3600 * late_ms / 1000)


# The sender runs 7 s ahead; the request takes 3 ms, the sender 40 ms, the reply 5 ms.
THERE_NS, HELD_NS, BACK_NS, AHEAD_NS = 3 * NS_PER_MS, 40 * NS_PER_MS, 5 * NS_PER_MS, 7 * NS_PER_S


def exchange_of(there_ns: int = 0, back_ns: int = 0, **changes: int) -> Exchange:
    """The exchange of these times, of which some are changed by so much."""
    t1_ns = HOST0_NS
    t2_ns = t1_ns + THERE_NS + AHEAD_NS
    t3_ns = t2_ns + HELD_NS
    times = {"t1_ns": t1_ns, "t2_ns": t2_ns, "t3_ns": t3_ns, "t4_ns": t3_ns - AHEAD_NS + BACK_NS}
    for name, by_ns in changes.items():
        times[name] += by_ns
    return Exchange(**times, there_ns=there_ns, back_ns=back_ns)


def test_an_exchange_s_delay_and_offset_leave_out_the_sender_s_own_time():
    """RFC 5905: delta = (t4 - t1) - (t3 - t2), theta = ((t2 - t1) + (t3 - t4)) / 2, here from the
    sender to the host.
    """
    one = exchange_of()
    assert one.delay_ns == THERE_NS + BACK_NS
    assert one.offset_ns(0) == -AHEAD_NS + (BACK_NS - THERE_NS) / 2
    assert one.offset_ns(-AHEAD_NS) == (BACK_NS - THERE_NS) / 2
    # the wire's own times are known: what they differ by is no offset
    assert exchange_of(NS_PER_MS, 3 * NS_PER_MS).offset_ns(0) == -AHEAD_NS
    # but where both took less than the wire would, it is no wire
    assert exchange_of(5 * NS_PER_MS, 9 * NS_PER_MS).offset_ns(0) == one.offset_ns(0)


@pytest.mark.parametrize(
    ("changes", "is_possible"),
    [
        ({}, True),
        ({"t3_ns": -HELD_NS}, True),
        ({"t3_ns": -HELD_NS - 1, "t4_ns": -HELD_NS}, False),
        ({"t4_ns": -THERE_NS - BACK_NS}, True),
        ({"t4_ns": -THERE_NS - BACK_NS - 1}, False),
    ],
)
def test_a_reply_leaves_after_its_request_came_and_arrives_after_it_left(changes, is_possible):
    assert exchange_of(**changes).possible is is_possible
    clock = SenderClock()
    for _ in range(MIN_EXCHANGES):
        clock.exchange(exchange_of(**changes))
    summary = clock.summary()
    assert (summary.mode == "exchange") is is_possible
    assert summary.exchanges == MIN_EXCHANGES * is_possible
