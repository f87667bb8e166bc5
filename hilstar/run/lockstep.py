"""Lockstep: one frame for each attitude that a simulation asks for. Its time is its own, and may run at any speed."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import msgspec

from hilstar.attitude.clock.rate_check import RateCheck
from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.receiver import PacketCounts
from hilstar.attitude.wire.links import LockstepLink
from hilstar.attitude.wire.packet import AttitudeSample, Event, Refusal, rate_refusal
from hilstar.bench.frame import Bench
from hilstar.run.frame_status import StatusMaker
from hilstar.run.loop import FrameLoop, Limit
from hilstar.run.record.ledger import LedgerSwitch
from hilstar.run.record.ledger_records import below_step, frame_record
from hilstar.run.shown import Shown
from hilstar.run.summary import RunSummary
from hilstar.running_statistics import RunningStatistics
from hilstar.units import NS_PER_MS, NS_PER_S

POLL_MS = 50


class LockstepRun:
    """The frames of a run up to its limit: each attitude is drawn at once, counted, and kept in the ledger."""

    def __init__(self, bench: Bench, limit: Limit, loop: FrameLoop, ledger: LedgerSwitch) -> None:
        self.counts = PacketCounts()
        self.last = Shown(0, 0, None, bench.draw(None), missing=True)
        self._bench, self._limit, self._loop, self._ledger = bench, limit, loop, ledger
        self._max_rate_rad_s = math.radians(bench.config.attitude.max_rate_deg_s)
        self._rates = RateCheck(bench.config.attitude.check_rates, loop.notices, used=False)
        self._turn_ms = RunningStatistics()
        self._begin_ns = time.monotonic_ns()
        self._end_ns = self._begin_ns + limit.slots / bench.config.monitor.refresh_hz * NS_PER_S

    def goes_on(self) -> bool:
        """False at the limit, and after a signal."""
        in_time = self._loop.tally.frames < self._limit.frames and time.monotonic_ns() < self._end_ns
        return in_time and not self._loop.stop.is_set()

    def take(self, host_ns: int, event: Event, raw: bytes) -> Refusal | None:
        """Show what a request says, or say why it is refused; the last frame then stays."""
        self.counts.received += 1
        refusal = self._refusal(event)
        sample = event if isinstance(event, AttitudeSample) else None
        if refusal is not None:
            self.counts.refused_by[refusal.reason] += 1
            if self.counts.refused_by[refusal.reason] == 1:
                line = f"message refused ({refusal.reason}): {refusal.detail}; further ones are only counted"
                self._loop.notices.mention("refused", line)
        shown = None if refusal is not None or sample is None else self._show(sample, host_ns)
        self.last = shown or self.last  # where a fault drops a frame, the previous one stays
        if self._ledger.on:
            self._ledger.packet(host_ns, raw, sample, refusal)
            if shown is not None:
                self._ledger.frame(frame_record(self.last, self.last.t_ns, 0, below_step(self._bench, self.last)))
        return refusal

    def answered(self, host_ns: int, shown_ns: int) -> None:
        """Note how long a request took."""
        self._turn_ms.add((shown_ns - host_ns) / NS_PER_MS)

    def summary(self) -> RunSummary:
        """The summary of the run so far."""
        duration_s = (time.monotonic_ns() - self._begin_ns) / NS_PER_S
        summary = self._loop.tally.summary(duration_s, self.counts, self._bench.renderer)
        return msgspec.structs.replace(summary, turn_ms=self._turn_ms.percentiles())

    def _refusal(self, event: Event) -> Refusal | None:
        if isinstance(event, Refusal):
            return event
        if isinstance(event, AttitudeSample):
            self._rates.see(event)
            return rate_refusal(self._rates.believed(event), self._max_rate_rad_s)
        return Refusal("format", f"a {type(event).__name__} packet; a request is an attitude, or a time request")

    def _show(self, sample: AttitudeSample, host_ns: int) -> Shown | None:
        attitude = replace(
            Attitude(sample.q_icrs_to_cam, 0, False, sample.sequence, host_ns),
            velocity_km_s=sample.velocity_km_s,
            place_km=sample.place_km,
        )
        return self._loop.draw(self._loop.tally.frames, sample.t_ns, attitude)


def serve_lockstep(link: LockstepLink, run: LockstepRun, loop: FrameLoop, statuses: StatusMaker) -> RunSummary:
    """Answer requests up to the limit, or until a signal; returns the summary. A refused request leaves the last frame."""
    while run.goes_on():
        arrival = link.receive(POLL_MS)
        if arrival is None:
            loop.idle()
            continue
        refusal = run.take(arrival.host_ns, arrival.event, arrival.raw)
        shown_ns = time.monotonic_ns()
        link.answer(statuses.status(run.last, run.last.t_ns, loop, run.counts, False), shown_ns, refusal)
        run.answered(arrival.host_ns, shown_ns)
    return run.summary()
