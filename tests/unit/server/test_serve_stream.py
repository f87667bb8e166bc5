"""The times of a live run's frames, on the sender's own clock."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

import hilstar
from hilstar.attitude import receiver
from hilstar.attitude.clock.jumps import JumpFilter
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import AttitudeSample, Status, TimeRequest, encode
from hilstar.attitude.wire.source import PACKETS
from hilstar.basics.process.scheduling import HOST_CLOCK
from hilstar.basics.units import NS_PER_S
from hilstar.server.loop import Limit
from hilstar.server.pacer import Shown
from hilstar.server.record.ledger_records import FrameRecord
from hilstar.server.serve import Outlet, serve
from tests.support.benches import SMALL_BENCH
from tests.support.waiting import wait_for

# each far more than a frame of a loaded machine takes
BEHIND_NS, JUMPED_NS = 500 * NS_PER_S, 1000 * NS_PER_S
NEAR_NS = 100 * NS_PER_S
FRAMES = 3


class Stream:
    """A sender in this process, whose clock stood BEHIND_NS behind the host's and jumped back by
    JUMPED_NS; what comes back to it.
    """

    steps, two_way, stamped = False, True, False
    endpoint, reconnects = "none", 2
    conventions = PACKETS
    link_counts = SimpleNamespace(summary=dict)

    def __init__(self) -> None:
        self.sequence = 0
        self.statuses: list[Status] = []
        self.requests: list[TimeRequest] = []
        self.is_silent = False

    def wait_for_message(self, timeout_ms: int) -> bool:
        return False

    def receive(self, timeout_ms: int) -> list[Arrival]:
        HOST_CLOCK.sleep(1e-3)
        if self.is_silent:
            return []
        host_ns = HOST_CLOCK.now_ns()
        self.sequence += 1
        q = np.array([0.5, 0.5, -0.5, 0.5])
        sample = AttitudeSample(host_ns - BEHIND_NS - JUMPED_NS, q, None, self.sequence)
        return [Arrival(host_ns, sample, encode(sample))]

    def send(self, packet: object) -> None:
        if isinstance(packet, Status):
            self.statuses.append(packet)
        elif isinstance(packet, TimeRequest):
            self.requests.append(packet)

    def wire_ns(self, packet: object) -> int:
        return 0


def test_frames_are_recorded_and_told_at_the_sender_s_time_after_a_jump(tmp_path, monkeypatch):
    """The timeline goes on as if the clock had not been set; records and statuses do not."""

    def jumped(*parts: object) -> JumpFilter:
        filtered = JumpFilter(*parts)
        filtered.correction_ns = JUMPED_NS
        return filtered

    monkeypatch.setattr(receiver, "JumpFilter", jumped)
    records: list[FrameRecord] = []
    ledger = SimpleNamespace(
        on=True,
        failure=None,
        packet=lambda *arrival: None,
        frame=records.append,
        lost=lambda number: None,
    )
    ledger.event = ledger.pulse = lambda *parts: None
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH + "[attitude]\nstatus_hz = 1000\n")
    link = Stream()

    def wait_for_status(shown: Shown) -> None:
        if records:  # the first frame's status was posted after its record
            wait_for(lambda: link.statuses)

    with hilstar.load(path) as bench:
        outlet = Outlet(ledger=ledger)
        limit = Limit(frames=FRAMES, from_first_attitude=True)
        summary = serve(bench, link, limit, wait_for_status, outlet)
    assert summary.reconnects == link.reconnects
    assert len(records) == FRAMES
    for record in records:
        assert record.t_ns - record.light_ns == JUMPED_NS
        assert abs(record.light_ns - (record.draw_ns - BEHIND_NS - JUMPED_NS)) < NEAR_NS
        # the attitude of that time, not of the host's
        assert record.age_ns is not None
        assert abs(record.age_ns) < NEAR_NS
    light_ns = {record.frame: record.light_ns for record in records}
    for status in link.statuses:
        assert status.light_t_ns == light_ns[status.frame]


STALE_AFTER_MS = 40


def test_once_frames_begin_the_clock_is_asked_and_a_sender_that_falls_silent_is_counted(tmp_path):
    """One silence of the sender is one stale event, however many frames it lasts."""
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH + f"[attitude]\nstale_after_ms = {STALE_AFTER_MS}\n")
    link = Stream()
    seen: list[Shown] = []

    def see(shown: Shown) -> None:
        seen.append(shown)
        if len(seen) == 1:
            # nobody is asked before the frames begin
            wait_for(lambda: link.requests, "a time request", poll_s=1e-3)
            link.is_silent = True
            silent_ns = HOST_CLOCK.now_ns()
            wait_for(
                lambda: HOST_CLOCK.now_ns() - silent_ns > 2e6 * STALE_AFTER_MS,
                "an attitude that is too old",
                poll_s=1e-3,
            )

    with hilstar.load(path) as bench:
        summary = serve(bench, link, Limit(frames=FRAMES, from_first_attitude=True), see)
    assert [shown.stale for shown in seen[1:]] == [True] * (FRAMES - 1)
    assert summary.stale_events == 1
    assert summary.duration_s > 2e-3 * STALE_AFTER_MS
    assert summary.clock.mode == "one-way"
    assert summary.receive_latency_ms is not None
