"""A live run over a link: a free-running stream, or a simulation in lockstep."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from msgspec import UNSET, UnsetType
from msgspec.structs import replace as replaced

from hilstar.attitude.clock.sender_clock import ClockSummary
from hilstar.attitude.clock.timeline import Timeline
from hilstar.attitude.receiver import PacketCounts, Receiver, Traffic
from hilstar.attitude.wire.links import LockstepLink, Pictures, StreamLink, TrackerCamera
from hilstar.attitude.wire.source import Mounting
from hilstar.bench.config import AttitudeSettings
from hilstar.bench.frame import Bench
from hilstar.notices import Notices
from hilstar.process.interrupts import stop_on_signal
from hilstar.run.faults import AnyFaults
from hilstar.run.frame_pulse import FramePulse
from hilstar.run.frame_status import StatusMaker
from hilstar.run.lockstep import LockstepRun, serve_lockstep
from hilstar.run.loop import FrameLoop, Limit, policy_of
from hilstar.run.open_link import AnyLink
from hilstar.run.operator import HeadlessOverrides, SwitchRequests
from hilstar.run.pacer import ClockPacer, Moment, Pacer
from hilstar.run.record.ledger import LedgerSwitch
from hilstar.run.record.ledger_records import below_step, frame_record
from hilstar.run.screen.display_pacer import DisplayPacer
from hilstar.run.screen.screen import Screen
from hilstar.run.shown import FrameSink, Shown, ignore
from hilstar.run.summary import RunSummary, RunTally
from hilstar.run.sync import SyncSummary
from hilstar.units import NS_PER_S


@dataclass(frozen=True, slots=True)
class Running:
    """Counters and identity of a run in progress. Readable from any thread.

    `clock` gives the state of the sender's clock; None in a run without a sender.
    """

    loop: FrameLoop
    packets: PacketCounts
    clock: Callable[[], ClockSummary] | None = None

    @property
    def tally(self) -> RunTally:
        """The figures of its frames."""
        return self.loop.tally


Follower = Callable[[Running], None]  # called once, when a run begins


def nobody_follows(running: Running) -> None:
    """The follower of a run without an audience."""


@dataclass(frozen=True, slots=True)
class Outlet:
    """Where frames go besides their sink (a screen, a ledger), where events are reported, and who follows the run.

    `pictures` are sent to a simulation that asks for its camera's pictures. `requests` are those of the operator's page.
    `faults` are the scenario's and the stream's. `pulse` is started at each frame.
    """

    screen: Screen | None = None
    ledger: LedgerSwitch = field(default_factory=LedgerSwitch)
    notices: Notices = field(default_factory=Notices)
    pictures: Pictures | None = None
    follower: Follower = nobody_follows
    requests: SwitchRequests | None = None
    faults: AnyFaults | None = None
    pulse: FramePulse | None = None

    def on(self, loop: FrameLoop) -> FrameLoop:
        """The loop, whose frames start the pulse; the ledger counts them."""
        if self.pulse is not None:
            loop.on_frame = self.pulse.frame
            self.pulse.counted = self.ledger.pulse
        return loop

    def pulses(self) -> SyncSummary | UnsetType:
        """What the summary says of the pulses; unset without any."""
        return UNSET if self.pulse is None else self.pulse.summary()

    def pacer(self, bench: Bench) -> Pacer:
        """The pacer of the screen, or without one that of the bench's own rate."""
        if self.screen is not None:
            return DisplayPacer(self.screen, self.notices, requests=self.requests)
        operator = None if self.requests is None else HeadlessOverrides(bench, self.notices, self.requests)
        return ClockPacer(NS_PER_S / bench.config.monitor.refresh_hz, operator=operator)


def serve(bench: Bench, link: AnyLink, limit: Limit, sink: FrameSink = ignore, outlet: Outlet | None = None) -> RunSummary:
    """Show the live stream of `link` up to `limit`, or until a signal; returns the summary."""
    outlet = outlet or Outlet()
    faults = outlet.faults
    loop = outlet.on(
        FrameLoop(bench, sink, outlet.pacer(bench), None, outlet.notices, None if faults is None else faults.frames)
    )
    if link.conventions.of_body:
        for kind, line in Mounting(bench.config.tracker.q_body_to_cam).told:
            outlet.notices.tell(kind, line)
    with stop_on_signal(loop.stop), loop.watch:
        if link.steps:
            summary = _serve_lockstep(bench, link, limit, loop, outlet)
        else:
            summary = _serve_stream(bench, link, limit, loop, outlet)
    outlet.notices.sum_up()
    told: dict[str, str | int] = {"endpoint": link.endpoint}
    summary = replaced(summary, faults=UNSET if faults is None else faults.summary(), sync=outlet.pulses())
    return replaced(
        summary, events=outlet.notices.counts(), link=told | link.link_counts.summary(), screen=loop.screen_summary()
    )


def _serve_lockstep(bench: Bench, link: LockstepLink, limit: Limit, loop: FrameLoop, outlet: Outlet) -> RunSummary:
    bench.warm_up()
    steps = LockstepRun(bench, limit, loop, outlet.ledger)
    outlet.follower(Running(loop, steps.counts))
    link.show_camera(_tracker_camera(bench), outlet.pictures)
    return serve_lockstep(link, steps, loop, StatusMaker(outlet.ledger))


def _tracker_camera(bench: Bench) -> TrackerCamera:
    tracker = bench.config.tracker
    height_mm = tracker.resolution_px[1] * tracker.pixel_pitch_um * 1e-3
    field_deg = 2 * math.degrees(math.atan(height_mm / (2 * tracker.focal_length_mm)))
    return TrackerCamera(Mounting(tracker.q_body_to_cam).q_body_to_cam, tracker.resolution_px, field_deg)


def _serve_stream(bench: Bench, link: StreamLink, limit: Limit, loop: FrameLoop, outlet: Outlet) -> RunSummary:
    ledger = outlet.ledger
    timeline = Timeline(policy_of(bench.config.attitude))
    receiver = _receiver(bench.config.attitude, link, timeline, outlet)
    outlet.follower(Running(loop, receiver.counts, receiver.clock_summary))
    statuses = StatusMaker(ledger)

    def draw_blank(moment: Moment) -> None:
        receiver.tend()
        loop.draw(moment.slot, receiver.clock.to_sender_ns(time.monotonic_ns()), None, moment)

    def draw_slot(moment: Moment) -> Shown | None:
        receiver.tend()
        t_ns = receiver.clock.to_sender_ns(moment.light_if_begun_at(time.monotonic_ns()))
        shown = loop.draw(moment.slot, t_ns, timeline.at(t_ns), moment)
        if shown is None:
            return None
        light_ns = receiver.sender_ns(t_ns)
        if ledger.on:
            ledger.frame(frame_record(shown, light_ns, loop.tally.missed_frames, below_step(bench, shown)))
        if link.two_way:
            receiver.post(statuses.status(shown, light_ns, loop, receiver.counts, receiver.clock.synchronised))
        return shown

    receiver.start()
    try:
        bench.warm_up()
        receiver.learn()
        if limit.from_first_attitude:
            loop.lead_in(draw_blank, lambda: len(timeline) > 0)
        begin_ns = time.monotonic_ns()
        loop.paced(limit, draw_slot)
    finally:
        receiver.close()
    duration_s = (time.monotonic_ns() - begin_ns) / NS_PER_S
    summary = loop.tally.summary(duration_s, receiver.counts, bench.renderer)
    return replaced(
        summary,
        stale_events=loop.gate.events,
        receive_latency_ms=receiver.latency_ms.percentiles(),
        clock=receiver.clock_summary(),
        reconnects=link.reconnects,
    )


def _receiver(settings: AttitudeSettings, link: StreamLink, timeline: Timeline, outlet: Outlet) -> Receiver:
    shared = settings.clock == "shared"
    traffic = Traffic(settings.status_hz, settings.time_requests and not shared, shared)
    return Receiver(link, timeline, traffic, outlet.ledger.packet, outlet.notices, wrong_rates=settings.check_rates)
