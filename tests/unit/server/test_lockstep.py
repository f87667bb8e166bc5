"""A simulation in lockstep on a clock of the test's own: what each request shows, what a refused
one leaves, and when the run ends.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import hilstar
from hilstar.attitude.receiver import PacketCounts
from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, TimeRequest
from hilstar.attitude.wire.source import PACKETS
from hilstar.basics.rotation import from_rotation_vector
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.basics.wrong_sky import RATES
from hilstar.server.loop import FrameLoop, Limit
from hilstar.server.pacer import Pacer, Presented
from hilstar.server.serve import LockstepRun, Outlet
from tests.support.benches import SMALL_BENCH
from tests.support.fake_clock import FakeClock

REFRESH_HZ = 60.0
ONE_SECOND = Limit(slots=REFRESH_HZ)
POLL_NS = 50 * NS_PER_MS  # between two looks of a run that nobody asks
TURN_MS = 4.0  # from a request to its answer: what drawing takes on the test's clock


class Simulation:
    """The other end of a link in lockstep: it asks what it is given, one after another, and is
    silent after that.
    """

    conventions = PACKETS

    def __init__(self, clock: FakeClock, *events: object) -> None:
        self.answers: list[tuple[object, Refusal | None]] = []
        self._clock = clock
        self._waiting = deque(events)

    def show_camera(self, camera, pictures) -> None:
        """It asks for none."""

    def receive(self, timeout_ms: int) -> Arrival | None:
        if not self._waiting:
            self._clock.work(timeout_ms * NS_PER_MS)
            return None
        return Arrival(self._clock.ns, self._waiting.popleft(), b"raw")

    def answer(self, status, shown_ns: int, refusal: Refusal | None) -> None:
        self.answers.append((status, refusal))


class Kept:
    """What a ledger would keep of packets and frames."""

    on, failure = True, None

    def __init__(self) -> None:
        self.packets: list[tuple[bytes, bool, str | None]] = []
        self.frames: list[object] = []

    def packet(self, host_ns, raw, sample, refusal) -> None:
        reason = None if refusal is None else refusal.reason
        self.packets.append((raw, sample is not None, reason))

    def frame(self, record) -> None:
        self.frames.append(record)


def sample(sequence: int, t_ns: int, turn_rad: float = 0.0, rate=None) -> AttitudeSample:
    """An attitude that is turned about the boresight."""
    q = from_rotation_vector(np.array([0.0, 0.0, turn_rad]))
    return AttitudeSample(t_ns, q, rate, sequence)


class SlowPacer(Pacer):
    """Shows a frame in TURN_MS of its clock."""

    def show(self, *frame) -> Presented:
        self.clock.work(TURN_MS * NS_PER_MS)
        return super().show(*frame)


@pytest.fixture(scope="module")
def small_bench(tmp_path_factory):
    path = tmp_path_factory.mktemp("lockstep") / "bench.toml"
    path.write_text(SMALL_BENCH)
    with hilstar.load(path) as bench:
        yield bench


@pytest.fixture
def run(small_bench):
    """Runs a simulation that asks for `events`; its answers, the summary, and what was kept."""
    clock = FakeClock()

    def asked(*events, limit=ONE_SECOND):
        kept = Kept()
        loop = FrameLoop(small_bench, pacer=SlowPacer(NS_PER_S / REFRESH_HZ, clock))
        outlet = Outlet(ledger=kept, notices=loop.notices)
        simulation = Simulation(clock, *events)
        began_ns = clock.ns
        summary = LockstepRun(small_bench, limit, loop, outlet).serve(simulation)
        return SimpleNamespace(
            answers=simulation.answers,
            summary=summary,
            kept=kept,
            lasted_s=(clock.ns - began_ns) / NS_PER_S,
        )

    return asked


def test_each_attitude_is_drawn_at_once_at_the_simulation_s_own_time(run):
    done = run(*(sample(7 + k, 10**15 + k) for k in range(3)), limit=Limit(frames=3))
    statuses = [status for status, _ in done.answers]
    assert [refusal for _, refusal in done.answers] == [None] * 3
    assert [status.attitude_sequence for status in statuses] == [7, 8, 9]
    assert [status.frame for status in statuses] == [0, 1, 2]
    assert [status.light_t_ns for status in statuses] == [10**15, 10**15 + 1, 10**15 + 2]
    assert [status.attitude_age_ns for status in statuses] == [0] * 3
    assert (done.summary.frames, done.summary.packets.accepted) == (3, 3)
    assert done.summary.turn_ms.p50 == pytest.approx(TURN_MS, rel=2e-3)
    assert [record.frame for record in done.kept.frames] == [0, 1, 2]


def test_a_frame_is_seen_from_where_the_simulation_s_craft_is_and_goes(run):
    moving = replace(sample(1, 10), velocity_km_s=np.array([0.0, 7.5, 1.0]))
    there = replace(moving, place_km=np.array([7000.0, -20.0, 1.0]))
    (record,) = run(there).kept.frames
    assert (record.velocity_km_s, record.place_km) == ((0.0, 7.5, 1.0), (7000.0, -20.0, 1.0))


def test_a_wrong_sky_counts_from_a_run_s_first_frame(small_bench):
    clock = FakeClock()
    loop = FrameLoop(small_bench, pacer=SlowPacer(NS_PER_S / REFRESH_HZ, clock))
    outlet = Outlet(notices=loop.notices)
    loop.notices.begin(RATES, "too fast", since_ns=clock.ns)
    loop.tally.first_swap_ns = clock.ns + 2 * NS_PER_S
    clock.work(5 * NS_PER_S)
    summary = loop.tally.summary(3.0, PacketCounts(), small_bench.renderer)
    assert outlet.complete(summary, loop).wrong_sky.seconds == pytest.approx(3.0)


def test_a_refused_request_leaves_the_last_frame_and_is_recorded_with_its_reason(run):
    too_fast = sample(3, 30, rate=np.array([0.0, 0.0, 2 * math.pi]))  # a turn a second
    refused = Refusal("norm", "the norm is 2")
    done = run(sample(1, 10), refused, TimeRequest(5, 6), too_fast, sample(2, 20))
    statuses = [status for status, _ in done.answers]
    reasons = [refusal and refusal.reason for _, refusal in done.answers]
    assert reasons == [None, "norm", "format", "rate", None]
    # as before, until the next good one
    assert [status.attitude_sequence for status in statuses] == [1, 1, 1, 1, 2]
    assert [status.light_t_ns for status in statuses] == [10, 10, 10, 10, 20]
    refused_bits = [bool(status.health & protocol.HEALTH_REFUSED) for status in statuses]
    assert refused_bits == [False, True, True, True, False]
    assert (done.summary.packets.received, done.summary.packets.refused) == (5, 3)
    assert done.kept.packets == [
        *((b"raw", True, None), (b"raw", False, "norm"), (b"raw", False, "format")),
        *((b"raw", True, "rate"), (b"raw", True, None)),
    ]
    assert len(done.kept.frames) == 2


def test_before_its_first_attitude_a_request_is_answered_by_a_blank_frame(run):
    ((status, refusal),) = run(Refusal("crc", "bytes changed")).answers
    assert refusal is not None and status.attitude_sequence == 0
    assert status.health & protocol.HEALTH_BLANK and status.health & protocol.HEALTH_NO_ATTITUDE


@pytest.mark.parametrize("slots", [30, 90])
def test_a_run_lasts_for_its_refresh_periods_whatever_the_simulation_asks(run, slots):
    done = run(sample(1, 10), limit=Limit(slots=slots))
    # it looks for the end once a poll of 50 ms
    assert slots / REFRESH_HZ <= done.lasted_s < slots / REFRESH_HZ + 0.05 + 1e-3 * TURN_MS
    assert done.summary.frames == 1


def test_a_run_that_nobody_asks_says_so_once_and_its_loop_is_alive_all_along(small_bench):
    """What systemd's watchdog hears of: else it ends a run whose simulation thinks for a while."""
    clock = FakeClock()
    loop = FrameLoop(small_bench, pacer=Pacer(NS_PER_S / REFRESH_HZ, clock))
    lockstep = LockstepRun(small_bench, Limit(slots=5 * REFRESH_HZ), loop, Outlet())
    summary = lockstep.serve(Simulation(clock))
    assert summary.frames == 0
    assert loop.notices.counts() == {"no-attitude": 1}
    assert clock.ns - loop.watch.alive_ns <= POLL_NS


def test_a_run_of_so_many_frames_answers_so_many(run):
    done = run(*(sample(k, k) for k in range(9)), limit=Limit(frames=4))
    assert len(done.answers) == done.summary.frames == 4
