"""Lockstep: one request is one attitude, one frame, one reply. The simulator's time is its own, and may run at any speed."""

from __future__ import annotations

import math
import time

import msgspec

from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.receiver import PacketCounts
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import AttitudeSample, Event, Refusal, TimeReply, TimeRequest, rate_refusal
from hilstar.attitude.wire.zmq_lockstep import ZmqLockstep
from hilstar.bench.frame import Bench
from hilstar.run.frame_status import StatusMaker
from hilstar.run.loop import FrameLoop, Limit
from hilstar.run.record.ledger import Ledger
from hilstar.run.record.ledger_records import below_step, frame_record
from hilstar.run.shown import Shown
from hilstar.run.summary import RunSummary
from hilstar.running_statistics import RunningStatistics
from hilstar.units import NS_PER_MS, NS_PER_S

POLL_MS = 50


def serve_lockstep(bench: Bench, link: ZmqLockstep, limit: Limit, loop: FrameLoop, ledger: Ledger | None = None) -> RunSummary:
    """Answer requests up to `limit`, or until a signal; returns the summary. A refused request leaves the last frame."""
    counts = PacketCounts()
    statuses = StatusMaker(ledger)
    turn_ms = RunningStatistics()
    last = Shown(0, 0, None, bench.draw(None), missing=True)
    begin_ns = time.monotonic_ns()
    end_ns = begin_ns + limit.slots / bench.config.monitor.refresh_hz * NS_PER_S
    while loop.tally.frames < limit.frames and time.monotonic_ns() < end_ns and not loop.stop.is_set():
        arrival = link.receive(POLL_MS)
        if arrival is None:
            loop.idle()
            continue
        if isinstance(arrival.event, TimeRequest):
            asked = arrival.event
            link.reply_time(TimeReply(asked.sequence, asked.t1_ns, arrival.host_ns, time.monotonic_ns()))
            continue
        counts.received += 1
        refusal = _refusal(arrival.event, math.radians(bench.config.attitude.max_rate_deg_s))
        if refusal is not None:
            counts.refused_by[refusal.reason] += 1
        else:
            last = _show(loop, arrival)
        if ledger is not None:
            _keep(ledger, arrival, refusal)
            if refusal is None:
                ledger.frame(frame_record(last, last.t_ns, 0, below_step(bench, last)))
        shown_ns = time.monotonic_ns()
        link.reply(statuses.status(last, last.t_ns, loop, counts, False), shown_ns, refusal)
        turn_ms.add((shown_ns - arrival.host_ns) / NS_PER_MS)
    duration_s = (time.monotonic_ns() - begin_ns) / NS_PER_S
    summary = loop.tally.summary(duration_s, counts, bench.renderer.gl_renderer)
    return msgspec.structs.replace(summary, turn_ms=turn_ms.percentiles())


def _refusal(event: Event, max_rate_rad_s: float) -> Refusal | None:
    if isinstance(event, Refusal):
        return event
    if isinstance(event, AttitudeSample):
        return rate_refusal(event, max_rate_rad_s)
    return Refusal("format", f"a {type(event).__name__} packet; a request is an attitude, or a time request")


def _keep(ledger: Ledger, arrival: Arrival[Event], refusal: Refusal | None) -> None:
    sample = arrival.event if isinstance(arrival.event, AttitudeSample) else None
    ledger.packet(arrival.host_ns, arrival.raw, sample, refusal)


def _show(loop: FrameLoop, arrival: Arrival[Event]) -> Shown:
    sample = arrival.event
    if not isinstance(sample, AttitudeSample):
        raise TypeError("only an attitude is shown")
    attitude = Attitude(sample.q_icrs_to_cam, 0, False, sample.sequence, arrival.host_ns)
    shown = loop.draw(loop.tally.frames, sample.t_ns, attitude)
    if shown is None:
        raise AssertionError("a frame in lockstep has no moment that can pass")
    return shown
