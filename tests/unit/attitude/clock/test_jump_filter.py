"""What a jump filter decides of a few messages, whose times are whole milliseconds."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.attitude.clock.jumps import (
    BEHIND,
    CLOCK,
    MAX_DOUBT_NS,
    MAX_FOUND_LATE_NS,
    TRUSTED_WAIT_NS,
    JumpFilter,
    KnownClockFilter,
)
from hilstar.attitude.clock.sender_clock import Exchange, SenderClock
from hilstar.attitude.clock.stages import Each, Stages, StreamState
from hilstar.attitude.wire.links import Arrival, SampleArrival
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import UnixOffset
from hilstar.basics.units import NS_PER_MS, NS_PER_S

HOST0_NS = 10**12
PERIOD_NS = 5 * NS_PER_MS
SETTLED = 600  # messages, three seconds
Q = np.array([1.0, 0.0, 0.0, 0.0])


def arrival(k: int, late_ns: int = 0, jump_ns: int = 0, waited_ns: int = 0) -> SampleArrival:
    """The k-th message of an even stream, whose sender's clock is back by `jump_ns`."""
    sent_ns = HOST0_NS + k * PERIOD_NS
    return Arrival(
        sent_ns + late_ns, AttitudeSample(sent_ns - jump_ns, Q, None, k), waited_ns=waited_ns
    )


@pytest.fixture
def clock() -> SenderClock:
    """That which the filter teaches."""
    return SenderClock()


@pytest.fixture
def settled(clock) -> JumpFilter:
    """A filter that has taken an even stream, without any delay."""
    jumps = JumpFilter(clock, StreamState())
    for k in range(SETTLED):
        (accepted,) = jumps.take(arrival(k))
        assert accepted.refusal is None
    assert jumps.settled
    return jumps


@pytest.mark.parametrize("jump_ms", [2000, -2000])
def test_a_clock_that_jumped_goes_on_where_the_earliest_of_three_says(settled, jump_ms):
    jump_ns = jump_ms * NS_PER_MS
    uneven_ns = [NS_PER_MS, 0, NS_PER_MS // 2]
    decided = []
    for k, late_ns in enumerate(uneven_ns, SETTLED):
        decided += settled.take(arrival(k, late_ns, jump_ns))
    assert settled.jumps == 1
    assert settled.correction_ns == jump_ns
    assert [each.event.t_ns for each in decided] == [
        HOST0_NS + k * PERIOD_NS for k in range(SETTLED, SETTLED + 3)
    ]
    assert settled.sender_ns(HOST0_NS) == HOST0_NS - jump_ns


def test_samples_whose_jumps_differ_do_not_agree_on_one(settled):
    """The two before are let go as they came, and the next three agree."""
    counts = []
    for k, jump_ms in enumerate((2000, 2000, 5000, 5000, 5000), SETTLED):
        counts.append(len(settled.take(arrival(k, jump_ns=jump_ms * NS_PER_MS))))
    assert counts == [0, 0, 2, 0, 3]
    assert (settled.jumps, settled.correction_ns) == (1, 5 * NS_PER_S)


def test_samples_in_doubt_are_let_go_when_nothing_has_followed_the_last(settled):
    jump_ns = 2 * NS_PER_S
    first, second = arrival(SETTLED, jump_ns=jump_ns), arrival(SETTLED + 20, jump_ns=jump_ns)
    assert [*settled.take(first), *settled.take(second)] == []
    assert settled.expire(first.host_ns + MAX_DOUBT_NS + 1) == []
    assert settled.expire(second.host_ns + MAX_DOUBT_NS) == []
    released = settled.expire(second.host_ns + MAX_DOUBT_NS + 1)
    assert [each.event.sequence for each in released] == [SETTLED, SETTLED + 20]
    assert settled.jumps == 0


def test_a_jump_adds_to_the_uncertainty_by_as_much_as_its_messages_differ(clock, settled):
    before_ms = clock.summary().uncertainty_ms
    uneven_ns = [NS_PER_MS, 0, NS_PER_MS // 2]
    for k, late_ns in enumerate(uneven_ns, SETTLED):
        settled.take(arrival(k, late_ns, 2 * NS_PER_S))
    clock._choose(HOST0_NS)
    assert settled.jumps == 1
    assert clock.summary().uncertainty_ms == pytest.approx(before_ms + 1.0, abs=1e-6)


def test_a_message_that_was_too_early_is_refused_with_by_how_much(settled):
    """The next one shows that the clock did not jump."""
    ahead = arrival(SETTLED, jump_ns=-3600 * NS_PER_S)
    assert settled.take(ahead) == []
    refused, accepted = settled.take(arrival(SETTLED + 1))
    assert refused.refusal.reason == "time"
    assert refused.refusal.detail == (
        f"t_ns {ahead.event.t_ns} is 3.6e+03 s ahead of the sender's clock so far"
    )
    assert accepted.refusal is None


def test_a_message_that_was_late_comes_before_the_next_that_is_not(settled):
    """It was in doubt; what is timely shows that the clock did not jump, and that it was late."""
    late = arrival(SETTLED, 2 * NS_PER_S)
    assert settled.take(late) == []
    timely = arrival(SETTLED + 1)
    assert settled.take(timely) == [late, timely]


def test_what_a_stage_held_passes_those_that_follow_it_in_the_end(settled):
    seen, shown = [], []

    def look(arrival: SampleArrival) -> SampleArrival:
        seen.append(arrival.event.sequence)
        return arrival

    stages = Stages([settled, Each(look)], shown.append)
    stages.take(arrival(SETTLED, jump_ns=2 * NS_PER_S))
    assert (seen, shown) == ([], [])
    stages.release()
    assert seen == [each.event.sequence for each in shown] == [SETTLED]


@pytest.mark.parametrize(("waited_ms", "is_doubted"), [(1500, False), (1400, True)])
def test_a_message_may_be_late_by_as_long_as_it_waited(settled, waited_ms, is_doubted):
    late = arrival(SETTLED, 1500 * NS_PER_MS, waited_ns=waited_ms * NS_PER_MS)
    assert settled.take(late) == ([] if is_doubted else [late])
    assert settled.expire(late.host_ns + MAX_DOUBT_NS + 1) == ([late] if is_doubted else [])


@pytest.mark.parametrize(("waited_ns", "teaches"), [(TRUSTED_WAIT_NS, True), (2 * 10**6, False)])
def test_a_message_teaches_the_clock_where_it_waited_no_longer_than_a_millisecond(
    clock, settled, waited_ns, teaches
):
    early = arrival(SETTLED, -NS_PER_MS, waited_ns=waited_ns)
    assert settled.take(early) == [early]
    late_ns = clock.late_ns(early.event.t_ns, early.host_ns)
    assert late_ns == (0 if teaches else -NS_PER_MS)


def test_before_a_clock_is_settled_a_message_may_be_a_second_early():
    for early_ns, is_doubted in ((MAX_FOUND_LATE_NS, False), (MAX_FOUND_LATE_NS + 1, True)):
        jumps = JumpFilter(SenderClock(), StreamState())
        jumps.take(arrival(0, late_ns=2 * NS_PER_S))
        early = arrival(0, late_ns=2 * NS_PER_S - early_ns)
        assert (jumps.take(early) == []) == is_doubted


def test_lateness_is_against_the_arrivals_whatever_exchanges_say():
    """Exchanges put the offset 2 ms below the line of the arrivals, which are all as late."""
    clock = SenderClock()
    late_ns = 2 * NS_PER_MS
    for k in range(40):
        host_ns = HOST0_NS + k * NS_PER_S // 4
        clock.observe(host_ns - late_ns, host_ns)
        clock.exchange(Exchange(host_ns, host_ns, host_ns, host_ns))
    assert clock.synchronised
    assert clock.latency_ns(host_ns - late_ns, host_ns) == late_ns
    assert clock.late_ns(host_ns - late_ns, host_ns) == 0


def known_clock_notices(late_ms: list[int], step_ms: int = 50) -> Notices:
    """What is told of a sender that has this machine's clock, and sends each `step_ms` from 1 s on."""
    notices = Notices()
    known = KnownClockFilter(notices, SenderClock(UnixOffset(0, 0), "shared"))
    for k, late in enumerate(late_ms):
        host_ns = NS_PER_S + step_ms * k * NS_PER_MS
        known.take(Arrival(host_ns, AttitudeSample(host_ns - late * NS_PER_MS, Q, None, k)))
    return notices


def test_a_clock_ahead_is_a_wrong_sky_from_its_first_packet_on():
    """It is told 0.3 s later."""
    (condition,) = known_clock_notices([0] * 10 + [-100] * 10).wrong_sky.now()
    assert condition.since_ns == 3 * NS_PER_S // 2


@pytest.mark.parametrize(("count", "is_told"), [(2, False), (3, True)])
def test_three_packets_that_are_off_a_known_clock_are_told_however_seldom_they_come(count, is_told):
    """Two seconds late, one each second."""
    notices = known_clock_notices([0, 0, *[2000] * count], step_ms=1000)
    assert (CLOCK in notices.lasting) == is_told


def test_of_packets_by_a_known_clock_the_quickest_of_some_seconds_is_told():
    """One in three comes 120 ms late, and the last ones before it is told do not."""
    notices = known_clock_notices([200, 120, 200] * 12 + [200] * 20)
    assert "comes 120 ms or more after its t_ns" in notices.lasting[BEHIND]


@pytest.mark.parametrize(("late_ms", "is_told"), [(49, False), (50, True)])
def test_packets_of_a_known_clock_may_come_50_ms_late(late_ms, is_told):
    notices = known_clock_notices([late_ms] * 50)
    assert (BEHIND in notices.lasting) == is_told
    assert "clock-behind-no-more" not in notices.counts()
