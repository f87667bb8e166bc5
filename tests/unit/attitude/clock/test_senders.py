"""Whose messages are shown: one sender's, whatever else comes on its link."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hilstar.attitude.clock.senders import ESTABLISHED_AFTER, MIN_RUN, OTHER_LIFE_NS, Senders
from hilstar.attitude.clock.stages import StreamState
from hilstar.attitude.wire.links import Arrival, SampleArrival
from hilstar.attitude.wire.packet import U32, AttitudeSample, encode
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import NS_PER_MS, NS_PER_S

ORION = from_radec_roll_deg(84.0, -1.0, 0.0)
LYRA = from_radec_roll_deg(283.0, 35.0, 30.0)
PERIOD_NS = 5 * NS_PER_MS
STALE_AFTER_NS = 250 * NS_PER_MS
HOST0_NS = 10**15
HOSTILE = 3000  # of each kind


def sample_message(
    sequence: int, t_ns: int, host_ns: int | None = None, q: np.ndarray = ORION
) -> SampleArrival:
    """A message of its time, which arrives at once where nothing else is said."""
    sample = AttitudeSample(t_ns, q, np.zeros(3), sequence)
    raw = b"%d %d" % (sequence, t_ns)
    return Arrival(t_ns if host_ns is None else host_ns, sample, raw)


class Shown:
    """What senders decide, in order: sequences shown, and (sequence, reason) refused."""

    def __init__(self) -> None:
        self.notices = Notices()
        self.senders = Senders(STALE_AFTER_NS, self.notices, StreamState())
        self.arrivals: list[SampleArrival] = []
        self.refused: list[tuple[int, str]] = []

    def take(self, arrival: SampleArrival) -> Shown:
        self._note(self.senders.take(arrival))
        return self

    def _note(self, arrivals: list[SampleArrival]) -> None:
        for arrival in arrivals:
            if arrival.refusal is None:
                self.arrivals.append(arrival)
            else:
                self.refused.append((arrival.event.sequence, arrival.refusal.reason))

    def expire(self, host_ns: int) -> Shown:
        self._note(self.senders.expire(host_ns))
        return self

    def release(self) -> Shown:
        self._note(self.senders.release())
        return self

    def run(self, count: int, first: int = 0) -> Shown:
        """So many messages of one sender, one each PERIOD_NS."""
        for k in range(first, first + count):
            self.take(sample_message(k, HOST0_NS + k * PERIOD_NS))
        return self

    @property
    def sequences(self) -> list[int]:
        return [arrival.event.sequence for arrival in self.arrivals]


Hostile = Callable[[np.random.Generator, int, int], tuple[int, int]]


def near(rng: np.random.Generator, spread: int) -> int:
    return int(rng.integers(-spread, spread + 1))


# the count and the time of a message beside a sender's next count, at a host time
KINDS: dict[str, Hostile] = {
    "any count, any time": lambda rng, k, ns: (int(rng.integers(U32)), ns + near(rng, 10**14)),
    "any count, near in time": lambda rng, k, ns: (int(rng.integers(U32)), ns + near(rng, 10**7)),
    "any count, now": lambda rng, k, ns: (int(rng.integers(U32)), ns),
    "near in count, any time": lambda rng, k, ns: (max(k + near(rng, 1000), 0), near(rng, 10**14)),
    "a count of before, now": lambda rng, k, ns: (max(k - 1 - abs(near(rng, 1000)), 0), ns),
    "no count, near in time": lambda rng, k, ns: (0, ns + near(rng, 10**7)),
    "no count, any time": lambda rng, k, ns: (0, ns + near(rng, 10**14)),
}


@pytest.mark.parametrize("at_once", [1, 20])
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_messages_beside_a_sender_are_never_shown_and_cost_it_none(kind, at_once):
    """One sender that loses no packet, with pauses of up to 150 ms; hostile ones between."""
    rng = np.random.default_rng(7)
    shown, host_ns = Shown(), HOST0_NS
    good = HOSTILE // at_once
    for k in range(good):
        pause_ms = int(rng.integers(150)) if rng.random() < 0.02 else 0
        host_ns += PERIOD_NS + pause_ms * NS_PER_MS
        shown.take(sample_message(k, host_ns))
        for j in range(at_once if k > ESTABLISHED_AFTER else 0):
            now_ns = host_ns + (j + 1) * PERIOD_NS // (at_once + 1)
            sequence, t_ns = KINDS[kind](rng, k + 1, now_ns)
            shown.take(sample_message(sequence, t_ns, now_ns, LYRA))
            shown.expire(now_ns)
    assert [arrival.event.q_icrs_to_cam is ORION for arrival in shown.arrivals] == [True] * good
    assert len(shown.refused) >= (good - ESTABLISHED_AFTER - 2) * at_once


FIRST, OTHER = 5, 9
NAMES = {
    "number": "showing number 5, refusing number 9",
    "port": "showing the one at ::1 port 5, refusing the one at ::1 port 9",
}


def message_of(who: int, by: str, sequence: int, host_ns: int, waited_ns: int = 0) -> SampleArrival:
    """A message of a sender that is known by its number, or by its address."""
    plain = sample_message(sequence, host_ns - waited_ns, host_ns)
    if by == "port":
        return replace(plain, address=("::1", who), waited_ns=waited_ns)
    return replace(plain, event=replace(plain.event, sender=who), waited_ns=waited_ns)


@pytest.mark.parametrize("by", NAMES)
def test_of_two_named_senders_the_first_is_shown_and_the_other_told_while_it_speaks(by):
    shown = Shown()
    for k in range(40):
        host_ns = HOST0_NS + k * PERIOD_NS
        shown.take(message_of(FIRST, by, k, host_ns))
        if k >= 20:
            shown.take(message_of(OTHER, by, 700 + k, host_ns + PERIOD_NS // 2))
        assert bool(shown.notices.active) == (k > 20)
    assert shown.sequences == list(range(40))
    assert shown.refused == [(700 + k, "source") for k in range(20, 40)]
    (told,) = shown.notices.lasting.values()
    assert NAMES[by] in told
    last_ns = HOST0_NS + 39 * PERIOD_NS + PERIOD_NS // 2
    for later_ns in (-1, 0):  # it counts as there for OTHER_LIFE_NS
        shown.take(message_of(FIRST, by, 40 + later_ns + 1, last_ns + OTHER_LIFE_NS + later_ns))
        assert bool(shown.notices.active) == (later_ns < 0)


@pytest.mark.parametrize("by", NAMES)
@pytest.mark.parametrize(
    ("silent_ns", "waited_ns", "is_shown"),
    [
        (STALE_AFTER_NS, 0, False),
        (STALE_AFTER_NS + 1, 0, True),
        (STALE_AFTER_NS + 1, 1, False),  # the first may have spoken until then, unread
        (STALE_AFTER_NS + 2, 1, True),
    ],
)
def test_another_named_sender_is_shown_once_the_first_is_silent(by, silent_ns, waited_ns, is_shown):
    shown = Shown()
    for k in range(20):
        shown.take(message_of(FIRST, by, k, HOST0_NS + k * PERIOD_NS))
    host_ns = HOST0_NS + 19 * PERIOD_NS + silent_ns
    shown.take(message_of(OTHER, by, 700, host_ns, waited_ns))
    assert shown.sequences == [*range(20), *[700] * is_shown]
    assert shown.refused == [(700, "source")] * (not is_shown)
    # then the other way round
    shown.take(message_of(FIRST, by, 20, host_ns + PERIOD_NS))
    assert (shown.sequences[-1] == 20) == (not is_shown)


@pytest.mark.parametrize("others", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(3))
def test_every_message_is_shown_or_refused_once_whoever_sends_and_pauses(others, seed):
    """Two named senders with three counters each, and pauses after which another one is shown."""
    rng = np.random.default_rng(seed)
    shown, host_ns, sent = Shown(), HOST0_NS, []
    for k in range(600):
        is_pause = rng.random() < 0.1
        host_ns += STALE_AFTER_NS + 1 if is_pause else PERIOD_NS
        who = OTHER if rng.random() < others else FIRST
        sequence = k + 10_000 * int(rng.integers(3))
        sent.append(sequence)
        t_ns = host_ns - PERIOD_NS * int(rng.integers(3))  # some have another's time
        message = sample_message(sequence, t_ns, host_ns)
        shown.take(replace(message, event=replace(message.event, sender=who)))
        if rng.random() < 0.1:
            shown.expire(host_ns + STALE_AFTER_NS)
    shown.release()
    refused = [sequence for sequence, _ in shown.refused]
    assert sorted([*shown.sequences, *refused]) == sorted(sent)


def test_a_sender_that_states_no_number_is_named_so_beside_one_that_does():
    shown = Shown()
    for k in range(20):
        host_ns = HOST0_NS + k * PERIOD_NS
        shown.take(sample_message(k, host_ns))
        shown.take(message_of(OTHER, "number", 700 + k, host_ns + PERIOD_NS // 2))
    assert shown.sequences == list(range(20))
    assert list(shown.notices.lasting.values()) == [
        "two senders on one link: showing the one without a number, refusing number 9 (source)"
    ]


def test_a_stray_message_is_refused_when_the_sender_goes_on_and_is_no_second_sender():
    shown = Shown().run(300)
    stray_ns = HOST0_NS + 300 * PERIOD_NS - PERIOD_NS // 2
    shown.take(sample_message(90_000, stray_ns, q=LYRA))
    assert shown.sequences == list(range(300))
    shown.run(10, first=300)
    assert shown.sequences == list(range(310))
    assert (shown.refused, shown.notices.counts()) == ([(90_000, "source")], {})


def test_a_time_off_the_others_is_left_to_the_clock_and_is_no_second_sender_s():
    off = sample_message(300, HOST0_NS + 3600 * NS_PER_S, HOST0_NS + 300 * PERIOD_NS)
    shown = Shown().run(300).take(off).run(10, first=301)
    assert shown.sequences == list(range(311))
    assert (shown.refused, shown.notices.counts()) == ([], {})


def test_a_count_that_comes_with_two_times_is_shown_with_the_one_that_goes_on():
    off = sample_message(300, HOST0_NS + 3600 * NS_PER_S, HOST0_NS + 300 * PERIOD_NS - 1)
    shown = Shown().run(300).take(off).run(10, first=300)
    assert shown.sequences == list(range(310))
    assert (shown.refused, shown.notices.counts()) == ([(300, "time")], {})


def test_a_second_counter_is_told_after_a_run_and_once_the_first_has_gone_on():
    shown = Shown().run(300)
    for k in range(MIN_RUN):
        assert shown.notices.counts() == {}
        shown.take(
            sample_message(7000 + k, HOST0_NS + (300 + k) * PERIOD_NS - PERIOD_NS // 2, q=LYRA)
        )
        shown.run(1, first=300 + k)
    assert shown.notices.counts() == {"second-sender": 1}
    assert shown.sequences == list(range(300 + MIN_RUN))


@pytest.mark.parametrize("paused_ns", [0, 100 * NS_PER_MS])
def test_a_restart_is_held_for_three_usual_silences_and_20_ms_and_released_in_order(paused_ns):
    """A pause of 100 ms is no usual silence any more after 400 messages (0.98^400 is 3e-4)."""
    shown = Shown().run(20)
    begun_ns = HOST0_NS + 20 * PERIOD_NS + paused_ns
    for k in range(400):
        shown.take(sample_message(20 + k, begun_ns + k * PERIOD_NS))
    restarted_ns = begun_ns + 400 * PERIOD_NS
    for k in range(6):
        shown.take(sample_message(k, restarted_ns + k * PERIOD_NS))
    assert shown.sequences == list(range(420))
    shown.take(sample_message(6, restarted_ns + 6 * PERIOD_NS + 1))
    assert shown.sequences == [*range(420), *range(7)]
    assert shown.refused == []


def test_of_a_sender_that_was_heard_for_less_than_a_second_no_silence_is_usual_yet():
    shown = Shown().run(100)
    last_ns = HOST0_NS + 99 * PERIOD_NS
    restart = [last_ns + (k + 1) * PERIOD_NS for k in range(12)]
    for k, host_ns in enumerate(restart):
        shown.take(sample_message(k, host_ns))
    assert shown.expire(last_ns + STALE_AFTER_NS).sequences == list(range(100))
    assert shown.expire(last_ns + STALE_AFTER_NS + 1).sequences == [*range(100), *range(12)]


def test_the_count_goes_on_from_its_largest_to_0_without_waiting():
    shown = Shown()
    counts = [(U32 - 30 + k) % U32 for k in range(60)]
    for k, count in enumerate(counts):
        shown.take(sample_message(count, HOST0_NS + k * PERIOD_NS))
        assert len(shown.arrivals) == k + 1
    assert shown.sequences == counts and not shown.refused


@pytest.mark.parametrize("count", [ESTABLISHED_AFTER - 2, ESTABLISHED_AFTER - 1])
def test_a_counter_decides_alone_from_its_eighth_message_on(count):
    """A stray message waits for one of the counter; at its eighth message it is refused."""
    shown = Shown().run(count)
    stray_ns = HOST0_NS + count * PERIOD_NS - PERIOD_NS // 2
    shown.take(sample_message(90_000, stray_ns, q=LYRA)).run(1, first=count)
    is_eighth = count + 1 == ESTABLISHED_AFTER
    assert shown.refused == [(90_000, "source")] * is_eighth
    assert shown.sequences == list(range(count + is_eighth))


def test_messages_that_waited_in_a_queue_are_one_sender_s_though_most_of_it_was_lost():
    """Twenty come at once after 300 ms, of which the queue has dropped all but every fifth."""
    shown = Shown().run(40)
    late_ns = HOST0_NS + 40 * PERIOD_NS + 300 * NS_PER_MS
    counts = [40, 60, 61, 85]
    for count in counts:
        shown.take(sample_message(count, HOST0_NS + count * PERIOD_NS, late_ns))
    assert shown.sequences == [*range(40), *counts] and not shown.refused


def test_one_long_step_is_not_the_period():
    """After a pause of 40 ms ten packets are lost at the usual 5 ms each."""
    shown = Shown().run(40)
    paused_ns = HOST0_NS + 39 * PERIOD_NS + 40 * NS_PER_MS
    shown.take(sample_message(40, paused_ns))
    shown.take(sample_message(51, paused_ns + 11 * PERIOD_NS))
    assert shown.sequences == [*range(41), 51]


def repeated(shown: Shown, count: int, host_ns: int, times: int, sequence_step: int = 0) -> None:
    """A packet with the same t_ns again and again, each 40 ms, after the counter's newest."""
    for k in range(1, times + 1):
        sample = AttitudeSample(
            HOST0_NS + count * PERIOD_NS, ORION, None, count + k * sequence_step
        )
        now_ns = host_ns + k * 40 * NS_PER_MS
        shown.take(Arrival(now_ns, sample, encode(sample)))


@pytest.mark.parametrize(
    ("sequence_step", "what"),
    [(0, "the sender repeats one packet"), (1, "the sender's clock has stopped at t_ns {t_ns}")],
)
def test_a_sender_that_hangs_is_told_after_ten_repeats_in_a_row(sequence_step, what):
    shown, last_ns = Shown(), HOST0_NS + 20 * PERIOD_NS
    for k in range(21):
        sample = AttitudeSample(HOST0_NS + k * PERIOD_NS, ORION, None, k)
        shown.take(Arrival(sample.t_ns, sample, encode(sample)))
    # nine, and it runs again: what follows begins to count anew
    repeated(shown, 20, last_ns, 9, sequence_step)
    again = AttitudeSample(HOST0_NS + 21 * PERIOD_NS, ORION, None, 21)
    again_ns = last_ns + 9 * 40 * NS_PER_MS + PERIOD_NS
    shown.take(Arrival(again_ns, again, encode(again)))
    repeated(shown, 21, again_ns, 9, sequence_step)
    assert shown.notices.counts() == {}
    repeated(shown, 21, again_ns + 9 * 40 * NS_PER_MS, 1, sequence_step)
    assert shown.notices.counts() == {"source-frozen": 1}
    said = what.format(t_ns=again.t_ns)
    assert shown.notices.lasting["source-frozen"] == (
        f"{said}: refused (time), and the attitude shown is getting old"
    )
    assert len(shown.refused) == 19 and {reason for _, reason in shown.refused} == {"time"}


def test_two_messages_that_nothing_follows_are_shown_when_the_first_sender_is_stale():
    shown = Shown().run(300)
    last_ns = HOST0_NS + 299 * PERIOD_NS
    for k in range(2):
        shown.take(sample_message(k, last_ns + (k + 1) * PERIOD_NS))
    assert shown.expire(last_ns + STALE_AFTER_NS).sequences == list(range(300))
    assert shown.expire(last_ns + STALE_AFTER_NS + 1).sequences == [*range(300), 0, 1]


@pytest.mark.parametrize("size", [100, 256])
def test_a_counter_that_wraps_is_held_once_and_known_from_then_on(size):
    shown, waits = Shown(), []
    for k in range(4 * size):
        shown.take(sample_message(k % size, HOST0_NS + k * PERIOD_NS))
        waits.append(k + 1 - len(shown.arrivals))
    assert shown.sequences == [k % size for k in range(4 * size)]
    assert shown.refused == []
    assert max(waits[: 2 * size]) > 0
    assert max(waits[2 * size :]) == 0


@pytest.mark.parametrize("times", [3, 10])
def test_a_count_that_several_messages_have_is_one_sender_s(times):
    shown = Shown()
    for k in range(40 * times):
        shown.take(sample_message(k // times, HOST0_NS + k * PERIOD_NS))
    assert len(shown.arrivals) == 40 * times


def test_counts_that_follow_no_other_are_shown_once_three_were_begun():
    """A sender that writes anything for its count: its first message is shown at once, the next
    two wait until the fourth, and no later one waits.
    """
    shown = Shown()
    counts = np.random.default_rng(5).integers(U32, size=40).tolist()
    waiting = []
    for k, count in enumerate(counts):
        shown.take(sample_message(count, HOST0_NS + k * PERIOD_NS))
        waiting.append(k + 1 - len(shown.sequences))
    assert waiting == [0, 1, 2] + [0] * 37
    assert shown.sequences == counts and not shown.refused


def test_uneven_times_are_one_sender_s_as_its_count_goes_on():
    """A sender on a busy machine: it stamps nothing for 80 ms, and then catches up at once."""
    shown, t_ns = Shown(), HOST0_NS
    for k in range(400):
        t_ns += 80 * NS_PER_MS if k % 17 == 0 else NS_PER_MS // 2
        shown.take(sample_message(k, t_ns))
    assert shown.sequences == list(range(400))


def test_times_of_a_simulation_a_hundred_times_as_fast_are_one_sender_s():
    shown = Shown()
    for k in range(400):
        shown.take(sample_message(k, HOST0_NS + 100 * k * PERIOD_NS, HOST0_NS + k * PERIOD_NS))
    assert shown.sequences == list(range(400))


def test_packets_lost_late_doubled_and_off_in_time_are_one_sender_s():
    """5 % of each, and delays of 4 ms in the mean, by which packets overtake each other."""
    rng = np.random.default_rng(6)
    arrivals = []
    for k in range(2000):
        if rng.random() < 0.05:
            continue
        t_ns = HOST0_NS + k * PERIOD_NS
        off_ns = near(rng, 5 * NS_PER_S) if rng.random() < 0.05 else 0
        late_ns = 8 * NS_PER_MS if rng.random() < 0.05 else 0
        host_ns = t_ns + late_ns + int(rng.exponential(4 * NS_PER_MS))
        arrivals.append(sample_message(k, t_ns + off_ns, host_ns))
        if rng.random() < 0.05:
            again_ns = host_ns + int(rng.integers(20 * NS_PER_MS))
            arrivals.append(sample_message(k, t_ns + off_ns, again_ns))
    shown = Shown()
    for arrival in sorted(arrivals, key=lambda arrival: arrival.host_ns):
        shown.take(arrival)
    assert "second-sender" not in shown.notices.counts()
    reasons = [reason for _, reason in shown.refused]
    assert reasons.count("source") < 0.02 * len(arrivals)
