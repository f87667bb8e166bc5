"""What a stream does to the receiver: what waited, who sends, what hangs, what breaks. Times are
simulated: known exactly.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import takewhile

import numpy as np
import pytest

from hilstar.attitude.clock.rate_causes import AS_PACKETS, ReadAs
from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.receiver import QUEUED_NS, Receiver, Traffic
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import (
    AttitudeSample,
    Packet,
    Refusal,
    Status,
    TimeReply,
    TimeRequest,
    encode,
)
from hilstar.attitude.wire.source import Convention
from hilstar.basics.notices import Notice, Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, UNDISCIPLINED_NS, UnixOffset
from hilstar.basics.rotation import from_radec_roll_deg, propagate
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.basics.wrong_sky import CONVENTION
from tests.support.waiting import PATIENCE_S

PERIOD_NS = 5 * NS_PER_MS
LEAD_NS = NS_PER_S  # from when the frames begin to the first message
ORION = from_radec_roll_deg(84.0, -1.0, 0.0)
LYRA = from_radec_roll_deg(283.0, 35.0, 30.0)
STALE_AFTER_NS = 250 * NS_PER_MS
Q = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass
class Clock:
    """The host's clock, which stands at the newest arrival."""

    now_ns: int = 10**15

    def __call__(self) -> int:
        return self.now_ns


@dataclass
class Script:
    """A link that hands out what it was given, what was read at the same time at once; and what
    its user does after each.
    """

    arrivals: list[Arrival]
    clock: Clock
    after: Callable[[Arrival], None] = lambda arrival: None
    fails: list[BaseException] = field(default_factory=list)
    two_way: bool = False
    stamped: bool = False

    def __post_init__(self) -> None:
        self.done = threading.Event()
        self._last: Arrival | None = None

    def wait_for_message(self, timeout_ms: int) -> bool:
        return False

    def receive(self, timeout_ms: int) -> list[Arrival]:
        if self._last is not None:
            self.after(self._last)
            self._last = None
        if self.fails:
            raise self.fails.pop()
        if not self.arrivals:
            self.done.set()
            return []
        host_ns = self.arrivals[0].host_ns
        self.clock.now_ns = max(self.clock.now_ns, host_ns)
        together = list(takewhile(lambda arrival: arrival.host_ns == host_ns, self.arrivals))
        del self.arrivals[: len(together)]
        self._last = together[-1]
        return together

    def send(self, packet: Packet) -> None:
        pass

    def wire_ns(self, packet: Packet) -> int:
        return 0


@dataclass
class Sender:
    """A simulated one: its packets, and when each arrives."""

    q: np.ndarray = field(default_factory=lambda: ORION)
    first: int = 0
    offset_ns: int = 0
    counts: bool = True
    number: int = 0
    address: tuple[str, int] | None = None

    def packets(self, host0_ns: int, times: range, delay_ns: int = 50_000) -> list[Arrival]:
        found = []
        for k, after_ns in enumerate(times):
            host_ns = host0_ns + after_ns
            sequence = self.first + k * self.counts
            sample = AttitudeSample(
                host_ns + self.offset_ns, self.q, np.zeros(3), sequence, sender=self.number
            )
            raw = encode(sample)
            found.append(Arrival(host_ns + delay_ns, sample, raw, address=self.address))
        return found


def seconds(begin_s: float, end_s: float, period_ns: int = PERIOD_NS) -> range:
    return range(round(begin_s * NS_PER_S), round(end_s * NS_PER_S), period_ns)


class ReceiverRun:
    """A whole script through a receiver; `ages_ms` and `shown` are of the attitude shown just
    after each message.
    """

    def __init__(
        self,
        make: Callable[[int], list[Arrival]],
        traffic: Traffic | None = None,
        unix_offset=HOST_CLOCK.unix_offset,
        read_as: ReadAs = AS_PACKETS,
        **script,
    ) -> None:
        clock = Clock()
        self.host0_ns = clock.now_ns + LEAD_NS
        arrivals = sorted(
            make(self.host0_ns), key=lambda arrival: (arrival.host_ns, arrival.event.t_ns)
        )
        self.notices = Notices()
        self.told: list[Notice] = []
        self.received_when_told = 0
        self.notices.listen(self._hear)
        self.timeline = Timeline(Policy(STALE_AFTER_NS, STALE_AFTER_NS))
        self.ages_ms: list[float] = []
        self.shown: list[np.ndarray] = []
        self.link = Script(arrivals, clock, self._look, **script)
        kept = {"now_ns": clock, "unix_offset": unix_offset, "read_as": read_as}
        self.receiver = Receiver(
            self.link, self.timeline, traffic or Traffic(), notices=self.notices, **kept
        )
        self.receiver.learn()
        if self.link.fails:
            self._run_on_its_thread(clock)
        while not self.link.done.is_set():
            self.receiver.listen()
        self.receiver.release()
        self.counts, self.events = self.receiver.counts, self.notices.counts()

    def _run_on_its_thread(self, clock: Clock) -> None:
        self.receiver.start()
        deadline_s = time.monotonic() + PATIENCE_S
        while not self.link.done.wait(0.001) and time.monotonic() < deadline_s:
            clock.now_ns += 10 * NS_PER_MS
            self.receiver.tend()
        self.receiver.close()

    def _hear(self, notice: Notice) -> None:
        self.told.append(notice)
        self.received_when_told = self.receiver.counts.received

    def _look(self, arrival: Arrival) -> None:
        attitude = self.timeline.at(self.receiver.clock.to_sender_ns(arrival.host_ns))
        if attitude is not None:
            self.ages_ms.append(attitude.age_ns / NS_PER_MS)
            self.shown.append(attitude.q_icrs_to_cam)

    @property
    def accepted(self) -> int:
        return self.counts.received - self.counts.refused


def test_a_plain_stream_is_no_event():
    run = ReceiverRun(lambda t0: Sender().packets(t0, seconds(0, 6)))
    assert (run.accepted, run.counts.refused, run.events) == (1200, 0, {})
    assert run.receiver.clock_summary().uncertainty_ms < 0.2


@pytest.mark.parametrize("repeat_hz", [50, 200, 1000])
@pytest.mark.parametrize("same", [True, False])
def test_a_sender_that_hangs_is_stale_and_taken_up_again_at_once(repeat_hz, same):
    """The last packet over and over for two seconds, or a clock that stands while the attitude
    turns.
    """
    hung_s = seconds(2.0, 4.0, NS_PER_S // repeat_hz)

    def make(t0: int) -> list[Arrival]:
        good = Sender().packets(t0, seconds(0, 2)) + Sender(first=400).packets(t0, seconds(4, 5))
        last = good[399].event
        repeats = []
        for k, after_ns in enumerate(hung_s):
            turned = propagate(last.q_icrs_to_cam, np.array([0, 0, 1e-3]), 0.0 if same else k)
            sample = AttitudeSample(
                last.t_ns, turned, np.zeros(3), last.sequence if same else last.sequence + 1 + k
            )
            repeats.append(Arrival(t0 + after_ns + 50_000, sample, encode(sample)))
        if not same:
            good[400:] = Sender(first=400 + len(hung_s)).packets(t0, seconds(4, 5))
        return good + repeats

    run = ReceiverRun(make)
    assert run.accepted == 600
    assert run.counts.refused_by["time"] == run.counts.refused == len(hung_s)
    assert run.receiver.jumps.jumps == 0
    assert run.events == {"source-frozen": 1, "source-resumed": 1}
    ages_ms = np.array(run.ages_ms[400 : 400 + len(hung_s)])
    assert (np.diff(ages_ms) > 0).all()
    assert ages_ms[-1] == pytest.approx(2000, abs=40)
    assert max(run.ages_ms[-190:]) < 10
    if same:
        assert np.ptp(run.shown, axis=0).max() == 0  # no roll goes to and fro


def test_a_clock_that_goes_on_from_where_it_stood_is_taken_up_and_is_no_jump():
    def make(t0: int) -> list[Arrival]:
        stopped = Sender().packets(t0, seconds(0, 3))
        last = stopped[-1].event
        stood = [Arrival(t0 + ns, last, stopped[-1].raw) for ns in seconds(3, 5)]
        return (
            stopped + stood + Sender(first=600, offset_ns=-2 * NS_PER_S).packets(t0, seconds(5, 7))
        )

    run = ReceiverRun(make)
    assert run.receiver.jumps.jumps == 0
    assert run.events == {"source-frozen": 1, "source-resumed": 1}
    assert run.accepted == 1000
    assert max(run.ages_ms[-380:]) < 10


@pytest.mark.parametrize("old_s", [0.02, 0.5, 3.0])
def test_bursts_of_one_old_packet_change_nothing(old_s):
    def make(t0: int) -> list[Arrival]:
        good = Sender().packets(t0, seconds(0, 6))
        old = good[round((4.5 - old_s) * 200)]
        return good + [
            Arrival(t0 + 4_502_000_000 + k * 20_000, old.event, old.raw) for k in range(50)
        ]

    run = ReceiverRun(make)
    assert run.accepted == 1200
    assert run.counts.refused_by["time"] == 50
    assert run.receiver.jumps.jumps == 0
    assert max(run.ages_ms[200:]) < 10


def late_sender(first: int, counts: bool = True, offset_ns: int = 0) -> Sender:
    return Sender(LYRA, first, offset_ns, counts)


@pytest.mark.parametrize(
    ("first", "counts"),
    [(0, True), (398, True), (100_000, True), (398, False), (100_000, False)],
)
def test_of_two_senders_the_first_is_shown_and_the_other_refused(counts, first):
    """The second begins after two seconds, on the same clock, and ends after six."""
    run = ReceiverRun(
        lambda t0: (
            Sender(counts=counts).packets(t0, seconds(0, 8))
            + late_sender(first, counts).packets(t0 + 2_300_000, seconds(2, 6))
        )
    )
    assert run.events["second-sender"] == 1
    assert run.counts.refused_by["source"] > 760
    assert run.counts.refused == run.counts.refused_by["source"]
    flips = np.abs(np.diff([q @ ORION for q in run.shown])) > 0.1
    assert flips.sum() < 50
    assert not flips[500:].any()
    assert abs(run.shown[-1] @ ORION) > 0.999
    assert run.receiver.jumps.jumps == 0


@pytest.mark.parametrize("offset_s", [-3600, 3600])
def test_a_second_sender_with_a_clock_of_its_own_and_four_times_the_rate_is_kept_out(offset_s):
    def make(t0: int) -> list[Arrival]:
        other = late_sender(100_000, offset_ns=offset_s * NS_PER_S)
        return Sender().packets(t0, seconds(0, 6, 20_000_000)) + other.packets(
            t0 + 2_300_000, seconds(3, 6)
        )

    run = ReceiverRun(make)
    assert run.events["second-sender"] == 1
    assert run.counts.refused_by["source"] > 500
    assert abs(run.shown[-1] @ ORION) > 0.999
    assert max(run.ages_ms[-300:]) < 40


def test_two_senders_that_do_not_count_on_one_clock_are_not_told():
    run = ReceiverRun(
        lambda t0: (
            Sender(counts=False).packets(t0, seconds(0, 4))
            + late_sender(0, counts=False).packets(t0 + 2_300_000, seconds(2, 4))
        )
    )
    assert (run.accepted, run.events) == (1200, {})


def test_a_second_sender_that_begins_at_the_first_one_s_next_count_takes_its_place():
    """It is told that there are two."""
    run = ReceiverRun(
        lambda t0: (
            Sender().packets(t0, seconds(0, 4))
            + late_sender(401).packets(t0 + 2_300_000, seconds(2, 4))
        )
    )
    assert run.events == {"second-sender": 1}
    assert abs(run.shown[-1] @ LYRA) > 0.999


HERE, THERE = ("127.0.0.1", 4001), ("127.0.0.1", 4002)


def test_one_number_from_another_address_is_the_same_sender():
    def make(t0: int) -> list[Arrival]:
        moved = Sender(first=400, number=3, address=THERE).packets(t0, seconds(2, 4))
        return Sender(number=3, address=HERE).packets(t0, seconds(0, 2)) + moved

    run = ReceiverRun(make)
    assert (run.accepted, run.events) == (800, {})


def in_bursts(found: list[Arrival], burst: int) -> list[Arrival]:
    """The same messages, so many of them sent together when the last of them is due."""
    last = [
        found[min(k // burst * burst + burst, len(found)) - 1].host_ns for k in range(len(found))
    ]
    return [replace(each, host_ns=last[k] + k % burst * 30_000) for k, each in enumerate(found)]


def beside(first: Sender, second: Sender, burst: int) -> Callable[[int], list[Arrival]]:
    """Two that were started together, a third of a burst apart, and send for three seconds."""

    def make(t0: int) -> list[Arrival]:
        apart_ns = burst * PERIOD_NS // 3
        one, other = (
            each.packets(t0 + k * apart_ns, seconds(0, 3)) for k, each in enumerate((first, second))
        )
        return in_bursts(one, burst) + in_bursts(other, burst)

    return make


A_DAY_NS = 86_400 * NS_PER_S


@pytest.mark.parametrize(
    ("offset_ns", "burst"),
    [
        (0, 1),
        (0, 10),
        (1, 2),
        (7 * NS_PER_MS, 3),
        (300 * NS_PER_MS, 10),
        (3 * A_DAY_NS, 1),
        (-NS_PER_S, 2),
        (-3 * A_DAY_NS, 3),
    ],
)
def test_two_senders_of_one_design_are_told_apart_however_they_alternate(burst, offset_ns):
    """Equal counters, two skies, clocks that are nanoseconds or days apart: the second one is
    never shown.
    """
    run = ReceiverRun(beside(Sender(), Sender(LYRA, offset_ns=offset_ns), burst))
    assert run.events == {"second-sender": 1}
    assert (run.accepted, run.counts.refused_by["source"] + run.counts.refused_by["time"]) == (
        600,
        600,
    )
    assert max(abs(q @ LYRA) for q in run.shown) < 0.99
    told = next(notice for notice in run.told if notice.kind == "second-sender")
    assert run.received_when_told < 2 * NS_PER_S // PERIOD_NS, told  # a second of both


@pytest.mark.parametrize("burst", [1, 4])
@pytest.mark.parametrize("offset_ns", [3600 * NS_PER_S, -3 * A_DAY_NS])
def test_two_senders_of_one_sky_and_two_clocks_are_two(burst, offset_ns):
    run = ReceiverRun(beside(Sender(), Sender(offset_ns=offset_ns), burst))
    assert run.events == {"second-sender": 1}
    assert (run.accepted, run.counts.refused_by["source"], run.receiver.jumps.jumps) == (
        600,
        600,
        0,
    )


@pytest.mark.parametrize("counts", [True, False])
@pytest.mark.parametrize("burst", [1, 3])
def test_one_sender_that_mixes_packets_and_json_is_one(burst, counts):
    """Turning at 3 deg/s; the JSON says neither a rate nor, in one case, a count."""
    rate = np.radians([0.0, 0.0, 3.0])

    def make(t0: int) -> list[Arrival]:
        found = []
        for k, after_ns in enumerate(seconds(0, 4)):
            q = propagate(ORION, rate, after_ns / NS_PER_S)
            as_json = k // burst % 2
            sample = AttitudeSample(
                t0 + after_ns, q, None if as_json else rate, (k if counts else 0) if as_json else k
            )
            found.append(Arrival(t0 + after_ns + 50_000, sample, encode(sample)))
        return found

    run = ReceiverRun(make)
    assert (run.accepted, run.events) == (800, {})


@pytest.mark.parametrize(
    ("offset_s", "pause_s"), [(0, 0.0), (0, 1.0), (5, 0.0), (5, 0.1), (-3600, 0.1), (-3600, 1.0)]
)
@pytest.mark.parametrize("q", [ORION, LYRA], ids=["same sky", "another sky"])
def test_a_sender_that_restarts_takes_over(pause_s, offset_s, q):
    """Its count begins anew, and its clock and sky may be others."""
    run = ReceiverRun(
        lambda t0: (
            Sender(first=5000).packets(t0, seconds(0, 3))
            + Sender(q, offset_ns=offset_s * NS_PER_S).packets(t0, seconds(3 + pause_s, 6))
        )
    )
    assert run.counts.refused == 0
    assert set(run.events) <= {"jump"}
    assert abs(run.shown[-1] @ q) > 0.999
    assert max(run.ages_ms[-300:]) < 10


@pytest.mark.parametrize("offset_ns", [3 * NS_PER_MS, 3600 * NS_PER_S])
def test_the_first_sender_that_pauses_gives_way_and_is_the_second_when_it_resumes(offset_ns):
    def make(t0: int) -> list[Arrival]:
        first = Sender().packets(t0, seconds(0, 2)) + Sender(first=800).packets(t0, seconds(4, 6))
        return in_bursts(first, 3) + in_bursts(
            Sender(LYRA, offset_ns=offset_ns).packets(t0 + 8_000_000, seconds(0, 6)), 3
        )

    run = ReceiverRun(make)
    assert run.events["second-sender"] == 2
    assert run.events["second-sender-gone"] == 1
    assert abs(run.shown[-1] @ LYRA) > 0.999
    flips = np.abs(np.diff([q @ ORION for q in run.shown])) > 0.1
    assert flips.sum() == 1


def test_the_other_sender_is_taken_up_when_the_first_falls_silent():
    run = ReceiverRun(
        lambda t0: (
            Sender().packets(t0, seconds(0, 4))
            + late_sender(9).packets(t0 + 2_300_000, seconds(2, 6))
        ),
    )
    assert run.events == {"second-sender": 1, "second-sender-gone": 1}
    assert abs(run.shown[-1] @ LYRA) > 0.999
    assert max(run.ages_ms[-200:]) < 10


def test_a_sender_that_hangs_gives_way_to_another():
    """The first repeats its last packet to the end; the second begins a second later."""

    def make(t0: int) -> list[Arrival]:
        good = Sender().packets(t0, seconds(0, 2))
        hung = [Arrival(t0 + ns, good[-1].event, good[-1].raw) for ns in seconds(2, 6, 10_000_000)]
        return good + hung + late_sender(70).packets(t0 + 2_300_000, seconds(3, 6))

    run = ReceiverRun(make)
    assert run.counts.refused == run.counts.refused_by["time"] == 400
    assert abs(run.shown[-1] @ LYRA) > 0.999
    assert max(run.ages_ms[-800:]) < 15
    assert run.receiver.jumps.jumps == 0


def test_a_receiver_that_was_stopped_does_not_think_that_the_first_sender_was_silent():
    """1.2 s of both senders' packets are read at once, the second one's first."""

    def make(t0: int) -> list[Arrival]:
        both = Sender().packets(t0, seconds(0, 8)) + late_sender(9).packets(
            t0 - 2_300_000, seconds(2, 8)
        )
        begin_ns, end_ns = t0 + 4_006_000_000, t0 + 5_200_000_000
        return [
            (
                Arrival(end_ns, arrival.event, arrival.raw)
                if begin_ns < arrival.host_ns < end_ns
                else arrival
            )
            for arrival in both
        ]

    run = ReceiverRun(make)
    assert run.events == {"second-sender": 1}
    assert abs(run.shown[-1] @ ORION) > 0.999
    assert run.receiver.jumps.jumps == 0


def many(
    t0: int,
    qs: list[np.ndarray],
    sequences: list[int],
    discontinuity: Callable[[int], bool] = lambda k: False,
):
    samples = [
        AttitudeSample(t0 + k * PERIOD_NS, q, np.zeros(3), sequence, discontinuity(k))
        for k, (q, sequence) in enumerate(zip(qs, sequences, strict=True))
    ]
    return [Arrival(sample.t_ns + 50_000, sample, encode(sample)) for sample in samples]


@pytest.mark.parametrize("every", [1, 2, 7, 300])
@pytest.mark.parametrize("how", ["counted", "said"])
def test_one_sender_that_retargets_to_and_fro_is_one(every, how):
    """By its count, or, where it does not count, because it says so."""
    qs = [LYRA if (k // every) % 2 else ORION for k in range(1000)]
    sequences = list(range(1000)) if how == "counted" else [0] * 1000
    run = ReceiverRun(
        lambda t0: many(t0, qs, sequences, lambda k: how == "said" and k % every == 0)
    )
    assert (run.accepted, run.events) == (1000, {})


@pytest.mark.parametrize(
    "sequences",
    [
        list(range(500)) + list(range(500)),  # restarted
        list(range(1000, 0, -1)),  # counts down
        [k % 2 for k in range(1000)],
        [7] * 1000,
        [3 * k for k in range(1000)],
        np.random.default_rng(3).integers(0, 256, 1000).tolist(),
        np.sort(np.random.default_rng(3).integers(0, 10_000, 1000)).tolist(),  # nine in ten lost
    ],
)
def test_one_sender_however_it_counts_is_one(sequences):
    rng = np.random.default_rng(4)
    # noise of 200 arcsec
    qs = [propagate(ORION, rng.normal(size=3) * 1e-3, 1.0) for _ in range(1000)]
    run = ReceiverRun(lambda t0: many(t0, qs, sequences))
    assert (run.accepted, run.events) == (1000, {})


def test_packets_out_of_order_are_one_sender_s():
    def make(t0: int) -> list[Arrival]:
        found = Sender().packets(t0, seconds(0, 5))
        for k in range(10, 990, 10):
            a, b = found[k], found[k + 1]
            found[k], found[k + 1] = (
                Arrival(a.host_ns, b.event, b.raw),
                Arrival(b.host_ns, a.event, a.raw),
            )
        return found

    run = ReceiverRun(make)
    assert run.events == {}
    assert run.counts.refused == run.counts.refused_by["time"] == 98


def test_a_receiver_that_breaks_is_started_again_and_said():
    run = ReceiverRun(
        lambda t0: Sender().packets(t0, seconds(0, 1)),
        fails=[MemoryError(), OSError("no such\nsocket")],
    )
    assert run.accepted == 200
    assert run.events == {"receiver-failed": 2}


def test_a_receiver_that_breaks_again_and_again_is_started_ever_more_seldom():
    """As seldom as once a second, until it has run for over ten."""
    clock = Clock()
    link = Script([], clock, fails=[OSError("no such socket")] * 20)
    receiver = Receiver(link, Timeline(Policy(0, NS_PER_S)), now_ns=clock)
    receiver.start()
    waits_ms = []
    for after_ns in (0, 0, 0, 0, 0, 0, 0, 10 * NS_PER_S + 1, 0):
        broken = receiver._thread
        broken.join(PATIENCE_S)
        clock.now_ns += after_ns
        begun_ns = clock.now_ns
        receiver.tend()
        while receiver._thread is broken:
            clock.now_ns += NS_PER_MS
            receiver.tend()
        waits_ms.append((clock.now_ns - begun_ns) // NS_PER_MS)
    receiver.close()
    assert waits_ms == [50, 100, 200, 400, 800, 1000, 1000, 50, 100]


def test_a_receiver_that_is_stopped_while_it_is_broken_ends():
    link = Script([], Clock(), fails=[MemoryError()] * 5)
    receiver = Receiver(link, Timeline(Policy(0, NS_PER_S)))
    receiver.start()
    receiver.close()
    receiver.tend()
    assert threading.active_count() < 50


@pytest.mark.parametrize("jump_s", [-3600, 0.5, 10**9])
def test_the_summary_s_offset_is_that_of_the_clock_after_its_jumps(jump_s):
    def make(t0: int) -> list[Arrival]:
        return Sender().packets(t0, seconds(0, 3)) + Sender(
            first=600, offset_ns=round(jump_s * NS_PER_S)
        ).packets(t0, seconds(3, 6))

    run = ReceiverRun(make)
    told = run.receiver.clock_summary()
    assert (told.jumps, run.events, run.accepted) == (1, {"jump": 1}, 1200)
    assert told.offset_ms == pytest.approx(-1000 * jump_s + 0.05, abs=0.02)
    assert told.uncertainty_ms < 0.2


SHARED = Traffic(clock="shared")


def test_a_shared_clock_is_taken_as_it_is():
    run = ReceiverRun(lambda t0: Sender().packets(t0, seconds(0, 1), delay_ns=3_000_000), SHARED)
    told = run.receiver.clock_summary()
    assert (told.mode, told.offset_ms, told.uncertainty_ms, told.jumps) == ("shared", 0.0, 0.0, 0)
    assert run.receiver.latency_ms.percentile(50) == pytest.approx(3.0, rel=0.05)
    assert np.allclose(run.ages_ms, 3.0)
    assert run.events == {}


@pytest.mark.parametrize(("offset_s", "refused"), [(-50, False), (50, True), (0.3, False)])
def test_a_clock_that_is_not_shared_is_said_once(offset_s, refused):
    run = ReceiverRun(
        lambda t0: Sender(offset_ns=round(offset_s * NS_PER_S)).packets(t0, seconds(0, 4)), SHARED
    )
    assert run.events == {"clock-not-shared": 1}
    assert run.counts.refused_by["time"] == (800 if refused else 0)


@pytest.mark.parametrize(("packets", "told"), [(2, {}), (3, {"clock-not-shared": 1})])
def test_three_packets_ahead_of_a_shared_clock_are_told_and_two_are_not(packets, told):
    sender = Sender(offset_ns=NS_PER_S // 10)
    times = range(0, packets * NS_PER_S, NS_PER_S)
    assert ReceiverRun(lambda t0: sender.packets(t0, times), SHARED).events == told


class SteppingUnixTime:
    """This machine's clock of Unix time: `error_ns` as its kernel states it, and a step after so
    many readings.
    """

    def __init__(self, error_ns: int, step_ns: int = 0, steps_after: int = 10**9) -> None:
        self.error_ns, self.step_ns, self.left = error_ns, step_ns, steps_after

    def __call__(self) -> UnixOffset:
        self.left -= 1
        return UnixOffset(-UNIX_NOW_NS - (self.step_ns if self.left < 0 else 0), self.error_ns)


UNIX_NOW_NS = 1_795_000_000_123_456_789  # beyond what a float64 holds to 1 ns
UNIX = Traffic(clock="unix")


@pytest.mark.parametrize(
    ("error_ns", "events"), [(250_000, {}), (16 * NS_PER_S, {"clock-undisciplined": 1})]
)
def test_unix_time_has_the_offset_of_this_machine_s_clock_and_the_error_that_its_kernel_states(
    error_ns, events
):
    packets = partial(
        Sender(offset_ns=UNIX_NOW_NS).packets, times=seconds(0, 1), delay_ns=3_000_000
    )
    run = ReceiverRun(packets, UNIX, unix_offset=SteppingUnixTime(error_ns))
    told = run.receiver.clock_summary()
    assert (told.mode, told.uncertainty_ms, told.jumps, told.drift_ppm) == (
        "unix",
        error_ns / 1e6,
        0,
        0.0,
    )
    assert told.offset_ms == -UNIX_NOW_NS / 1e6
    assert run.receiver.latency_ms.percentile(50) == pytest.approx(3.0, rel=0.05)
    assert np.allclose(run.ages_ms, 3.0)
    assert run.events == events


def test_a_step_of_unix_time_is_followed_without_a_jump():
    def make(t0: int) -> list[Arrival]:
        stepped = Sender(first=600, offset_ns=UNIX_NOW_NS + NS_PER_S // 2).packets(
            t0, seconds(1, 3)
        )
        return Sender(offset_ns=UNIX_NOW_NS).packets(t0, seconds(0, 1)) + stepped

    run = ReceiverRun(make, UNIX, unix_offset=SteppingUnixTime(1000, NS_PER_S // 2, steps_after=5))
    assert run.receiver.clock_summary().jumps == 0 and run.counts.refused_by["time"] == 0
    assert np.abs(run.ages_ms[-100:]).max() < 1.0


def test_what_is_no_unix_time_is_said_once():
    """TAI, as PTP has it on the wire, is 37 s ahead."""
    ahead = Sender(offset_ns=UNIX_NOW_NS + 37 * NS_PER_S)
    run = ReceiverRun(
        lambda t0: ahead.packets(t0, seconds(0, 3)), UNIX, unix_offset=SteppingUnixTime(1000)
    )
    assert run.events == {"clock-not-shared": 1}
    assert run.counts.refused_by["time"] == 600


def test_a_clock_too_far_ahead_is_said_of_refused_packets_and_not_of_a_sky(caplog):
    ahead = Sender(offset_ns=3600 * NS_PER_S)
    run = ReceiverRun(lambda t0: ahead.packets(t0, seconds(0, 2)), SHARED)
    (line,) = [
        line for line in caplog.messages if "[attitude] clock" in line and "refused (" not in line
    ]
    assert "its packets are refused: stamp with that clock" in line and "sky drawn" not in line
    assert "3600.000 s ahead of CLOCK_MONOTONIC" in run.counts.shown["time"]
    assert run.counts.shown["time"].endswith('or write clock = "estimated"')


@pytest.mark.parametrize(
    ("ahead_s", "name"),
    [
        (37.0, "as TAI is"),
        (18.0, "as GPS time counted from 1970 is"),
        (7200.0, "local time of a zone 2 h east of UTC"),
        (3.0, None),
    ],
)
def test_another_clock_is_named_by_its_difference_from_unix_time(ahead_s, name, caplog):
    ahead = Sender(offset_ns=UNIX_NOW_NS + round(ahead_s * NS_PER_S))
    ReceiverRun(
        lambda t0: ahead.packets(t0, seconds(0, 1)), UNIX, unix_offset=SteppingUnixTime(1000)
    )
    (line,) = [line for line in caplog.messages if 'clock = "unix"' in line]
    assert f"{ahead_s:.3f} s ahead of CLOCK_REALTIME" in line
    assert (", as " not in line) if name is None else (name in line)


def test_how_far_a_clock_is_ahead_is_not_what_a_late_packet_says(caplog):
    """The packets about the moment of the notice are 60 ms late, as on a busy machine."""

    def make(t0: int) -> list[Arrival]:
        packets = Sender(offset_ns=UNIX_NOW_NS + NS_PER_S // 10).packets(t0, seconds(0, 1))
        late_ns = 60 * NS_PER_S // 1000
        return packets[:20] + [
            replace(each, host_ns=each.host_ns + late_ns) for each in packets[20:]
        ]

    run = ReceiverRun(make, UNIX, unix_offset=SteppingUnixTime(1000))
    assert run.events == {"clock-not-shared": 1}
    (line,) = [line for line in caplog.messages if 'clock = "unix"' in line]
    assert "0.100 s ahead of CLOCK_REALTIME" in line
    assert "; the sky drawn is 0.100 s old: " in line


@pytest.mark.parametrize("ahead_s", [0.1, 0.999])
def test_a_clock_ahead_is_a_wrong_sky_until_it_is_right_again(ahead_s):
    def make(t0: int) -> list[Arrival]:
        ahead = Sender(offset_ns=round(ahead_s * NS_PER_S)).packets(t0, seconds(0, 2))
        return ahead + Sender(first=2000).packets(t0, seconds(3, 6))

    run = ReceiverRun(make, SHARED)
    assert run.events == {"clock-not-shared": 1, "clock-shared": 1}
    assert run.receiver.latency_ms.percentile(1) < 0


def test_packets_that_are_always_late_by_a_known_clock_are_a_notice():
    late = ReceiverRun(lambda t0: Sender().packets(t0, seconds(0, 6), delay_ns=120_000_000), SHARED)
    assert late.events == {"clock-behind": 1}
    assert (
        ReceiverRun(
            lambda t0: Sender().packets(t0, seconds(0, 6), delay_ns=30_000_000), SHARED
        ).events
        == {}
    )


def test_the_kernel_states_how_well_it_keeps_unix_time():
    offset = HOST_CLOCK.unix_offset()
    assert 0 <= offset.error_ns <= UNDISCIPLINED_NS
    assert abs(time.time_ns() + offset.offset_ns - time.monotonic_ns()) < NS_PER_MS * 100


def test_what_was_queued_before_the_frames_teaches_nothing():
    """Two seconds of packets that waited are read at once; then the stream goes on. None
    refused, no jump, right at once.
    """

    def make(t0: int) -> list[Arrival]:
        queued = Sender().packets(t0 - 3 * NS_PER_S, seconds(0, 2))
        read = [Arrival(t0 - LEAD_NS, arrival.event, arrival.raw) for arrival in queued]
        return read + Sender(first=600).packets(t0, seconds(0, 3))

    run = ReceiverRun(make)
    assert (run.accepted, run.counts.refused, run.events) == (1000, 0, {})
    assert run.receiver.latency_ms.max < 0.01
    assert run.receiver.latency_ms.count == 600
    told = run.receiver.clock_summary()
    assert told.offset_ms == pytest.approx(0.05, abs=0.001)
    assert QUEUED_NS < NS_PER_S


def test_a_clock_that_agrees_for_half_a_second_is_not_believed_yet():
    def make(t0: int) -> list[Arrival]:
        ahead = Sender(offset_ns=NS_PER_S // 10).packets(t0, seconds(0, 2))
        return ahead + Sender(first=2000).packets(t0, seconds(3, 3.5))

    assert ReceiverRun(make, SHARED).events == {"clock-not-shared": 1}


@pytest.mark.parametrize("late_s", [0.6, None], ids=["late", "lost"])
@pytest.mark.parametrize("begins_s", [2.1, 2.4, 2.7, 3.0])
def test_a_packet_is_told_as_lost_once_it_has_not_come_for_a_second(begins_s, late_s):
    """Whenever it is late, between two looks or over one of them."""
    clock = Clock()
    arrivals = Sender().packets(clock.now_ns + LEAD_NS, seconds(0, 6, NS_PER_S // 20))
    late = arrivals.pop(round(20 * begins_s))
    if late_s is not None:
        came = replace(late, host_ns=late.host_ns + round(late_s * NS_PER_S))
        arrivals = sorted([*arrivals, came], key=lambda arrival: arrival.host_ns)
    link = Script(arrivals, clock)
    timeline = Timeline(Policy(STALE_AFTER_NS, STALE_AFTER_NS))
    receiver = Receiver(link, timeline, notices=Notices(), now_ns=clock)
    told: list[tuple[int, float]] = []
    receiver.tell_lost = lambda count: told.append((count, clock.now_ns - late.host_ns))
    receiver.learn()
    while not link.done.is_set():
        receiver.listen()
    receiver.release()
    if late_s is not None:
        assert told == []
    else:
        ((count, after_ns),) = told
        assert count == 1
        assert NS_PER_S <= after_ns <= 2.2 * NS_PER_S


def paced(t0: int, pace: float, until_s: float = 8.0) -> list[Arrival]:
    """A sender whose clock runs at so many times real time."""
    arrivals = []
    for k, after_ns in enumerate(seconds(0, until_s)):
        sample = AttitudeSample(t0 + round(pace * after_ns), ORION, np.zeros(3), k)
        arrivals.append(Arrival(t0 + after_ns + 50_000, sample, encode(sample)))
    return arrivals


@pytest.mark.parametrize(("pace", "kind"), [(0.8, "source-slow"), (1.4, "source-fast")])
def test_a_clock_of_another_pace_is_named_with_its_pace(pace, kind):
    run = ReceiverRun(lambda t0: paced(t0, pace))
    (notice,) = [each for each in run.told if each.kind.startswith("source-")]
    assert notice.kind == kind
    words = re.fullmatch(
        r"t_ns runs at (\S+) times real time; it is followed in small steps(.*)", notice.detail
    )
    assert float(words[1]) == pytest.approx(pace, rel=0.05)
    assert ("slow clock" in words[2]) == (pace < 1)
    # a slow one may be a step of 5 ms and the way to the next one behind
    more_ms = 10.0 if pace < 1 else 0.0
    told, line = run.receiver.clock_summary(), run.receiver.clock.summary()
    assert told.uncertainty_ms == pytest.approx(line.uncertainty_ms + more_ms, abs=1e-9)


def test_a_jump_of_the_sender_s_clock_is_told_with_all_that_it_jumped_so_far():
    """By 2 s and then by 1.5 s: their sum stands in the second line and in the offset."""
    jumps_ns = (2 * NS_PER_S, 3 * NS_PER_S // 2)

    def make(t0: int) -> list[Arrival]:
        arrivals = []
        for k, begin_s in enumerate((0, 4, 8)):
            sender = Sender(first=800 * k, offset_ns=sum(jumps_ns[:k]))
            arrivals += sender.packets(t0, seconds(begin_s, begin_s + 4))
        return arrivals

    run = ReceiverRun(make)
    told = [notice.detail for notice in run.told if notice.kind == "jump"]
    assert [re.search(r"by (\S+) s in all", line)[1] for line in told] == ["2.000", "3.500"]
    summary = run.receiver.clock_summary()
    assert summary.jumps == 2
    # host minus sender; 50 us is the way
    assert summary.offset_ms == pytest.approx(-3500 + 0.05, abs=0.2)


def test_the_sender_that_is_shown_is_the_one_that_is_answered():
    """Two at one port: the first is shown, and statuses go to it alone."""
    answered: dict[int, list[Packet]] = {1: [], 2: []}

    def make(t0: int) -> list[Arrival]:
        arrivals = Sender(number=1).packets(t0, seconds(0, 2))
        arrivals += Sender(q=LYRA, number=2).packets(t0 + NS_PER_MS, seconds(1, 2))
        return [replace(each, back=answered[each.event.sender].append) for each in arrivals]

    run = ReceiverRun(make, traffic=Traffic(status_hz=10), two_way=True)
    run.receiver.back.post(Status(0, 1, 1, 0, 0, 0, 0))
    run.receiver.back.talk(run.link.clock.now_ns + NS_PER_S, ask=False)
    assert [type(packet) for packet in answered[1]] == [Status]
    assert answered[2] == []


class SlowLink(Script):
    """A link that is being read for a while, as a busy one is."""

    def receive(self, timeout_ms: int) -> list[Arrival]:
        self.done.set()
        time.sleep(0.2)
        return []


def test_a_receiver_that_is_closed_has_left_its_link():
    """Whoever closes it closes the link next: nothing may still read it."""
    clock = Clock()
    link = SlowLink([], clock)
    timeline = Timeline(Policy(STALE_AFTER_NS, STALE_AFTER_NS))
    before = set(threading.enumerate())
    receiver = Receiver(link, timeline, Traffic(), notices=Notices(), now_ns=clock)
    receiver.start()
    assert link.done.wait(PATIENCE_S)
    (thread,) = set(threading.enumerate()) - before
    receiver.close()
    assert not thread.is_alive()


def test_what_is_no_attitude_is_counted_by_reason_told_once_and_watched():
    """Over a link that carries nothing back; a sample that is refused is watched with what it says."""
    good = AttitudeSample(10**15, ORION, None, 7)
    events = [
        TimeReply(1, 2, 3, 4),
        Refusal("crc", "JSON came", telling=True),
        Refusal("crc", "HTTP came", telling=True),
        TimeRequest(5, 6),
        good,
        replace(good, sequence=8),
    ]
    clock = Clock()
    arrivals = []
    for k, event in enumerate(events):
        arrivals.append(Arrival(clock.now_ns + k * NS_PER_S, event, b"raw %d" % k))
    sent = [*arrivals]
    link, notices, told, watched = Script(arrivals, clock), Notices(), [], []
    notices.listen(lambda notice: told.append((notice.kind, notice.detail)))
    receiver = Receiver(
        link,
        Timeline(Policy(STALE_AFTER_NS, STALE_AFTER_NS)),
        watch=lambda *message: watched.append(message),
        notices=notices,
        now_ns=clock,
    )
    while link.arrivals:
        receiver.listen()
    receiver.release()
    counts = receiver.counts
    assert (counts.received, counts.refused, counts.lost) == (6, 5, 0)
    assert {reason: count for reason, count in counts.refused_by.items() if count} == {
        "format": 2,
        "crc": 2,
        "time": 1,
    }
    assert counts.shown == {"crc": "JSON came"}
    details = [
        "(format): a TimeReply packet is not an attitude",
        "(crc): JSON came",
        f"(time): t_ns {good.t_ns} repeats that of the previous packet",
    ]
    assert told == [
        ("refused", f"packet refused {detail}; further ones are only counted") for detail in details
    ]
    assert [raw for _, raw, _, _ in watched] == [arrival.raw for arrival in sent]
    assert [host_ns for host_ns, *_ in watched] == [arrival.host_ns for arrival in sent]
    assert [sample for _, _, sample, _ in watched[:4]] == [None] * 4
    assert [sample.sequence for _, _, sample, _ in watched[4:]] == [7, 8]
    reasons = [refusal and refusal.reason for *_, refusal in watched]
    assert reasons == ["format", "crc", "crc", "format", None, "time"]


def test_a_stated_convention_that_the_rates_belie_is_told_against_what_was_sent():
    """The bench file says scalar last, and the sender has it first."""
    turn = np.radians([0.4, -0.9, 0.6])

    def make(t0: int) -> list[Arrival]:
        arrivals = []
        for number, after_ns in enumerate(seconds(0, 3, 10 * NS_PER_MS)):
            q = propagate(ORION, turn, after_ns / NS_PER_S)
            sample = AttitudeSample(t0 + after_ns, np.roll(q, 1), turn, number)
            arrivals.append(Arrival(sample.t_ns + 50_000, sample, encode(sample)))
        return arrivals

    run = ReceiverRun(make, read_as=ReadAs(Convention(scalar="last")))
    assert '{ scalar = "first" }' in run.notices.lasting[CONVENTION]
