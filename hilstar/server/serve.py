"""A live run over a link: a free-running stream, or a simulation in lockstep, which waits for a
frame of each attitude.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial

from msgspec import UNSET
from msgspec.structs import replace as replaced

from hilstar.attitude.clock.rate_causes import ReadAs
from hilstar.attitude.clock.rate_check import RateCheck
from hilstar.attitude.clock.timeline import Attitude, Timeline
from hilstar.attitude.receiver import PacketCounts, Receiver, Traffic
from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.links import LockstepLink, Pictures, StreamLink, TrackerCamera
from hilstar.attitude.wire.packet import (
    AnswerPacket,
    AttitudeSample,
    Event,
    Refusal,
    Status,
    rate_refusal,
)
from hilstar.attitude.wire.source import Mounting
from hilstar.basics.notices import Notices
from hilstar.basics.process.interrupts import stop_on_signal
from hilstar.basics.running_statistics import RunningStatistics
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.server.answers.answer import Answer
from hilstar.server.bench.config import AttitudeSettings
from hilstar.server.bench.frame import Bench, aid_levels_of
from hilstar.server.faults import AnyFaults
from hilstar.server.frame_pulse import FramePulse
from hilstar.server.live_answers import LiveAnswers
from hilstar.server.loop import FrameLoop, Limit, policy_of
from hilstar.server.open_link import AnyLink
from hilstar.server.operator import Aids, Operator, SwitchRequests
from hilstar.server.pacer import FrameSink, Moment, Pacer, Shown, ignore
from hilstar.server.record.ledger import Ledger, LedgerSwitch
from hilstar.server.record.ledger_records import below_step, frame_record
from hilstar.server.run_progress import Follower, Running
from hilstar.server.screen.screen import DisplayPacer, Screen
from hilstar.server.summary import RunSummary, verdict_of

POLL_MS = 50


@dataclass(frozen=True, slots=True)
class Outlet:
    """Where frames go besides their sink (a screen, a ledger), where events are reported, and who
    follows the run.

    `pictures` are sent to a simulation that asks for its camera's pictures. `requests` are those of
    the operator's page. `faults` are the scenario's and the stream's. `pulse` is started at each
    frame. `answers` are compared with the frames.
    """

    screen: Screen | None = None
    ledger: LedgerSwitch = field(default_factory=LedgerSwitch)
    notices: Notices = field(default_factory=Notices)
    pictures: Pictures | None = None
    follower: Follower = lambda running: None
    requests: SwitchRequests | None = None
    faults: AnyFaults | None = None
    pulse: FramePulse | None = None
    answers: LiveAnswers | None = None

    def loop(self, bench: Bench, sink: FrameSink, moving: bool | None = None) -> FrameLoop:
        """The frame loop of a run, paced by the screen or else at the bench's own rate; its
        frames start the pulse.
        """
        if self.faults is None:
            faults = None
        else:
            faults = self.faults.frames
        if self.screen is not None:
            pacer: Pacer = DisplayPacer(self.screen, self.notices, requests=self.requests)
        else:
            operator = Operator(
                Aids(), self.notices, requests=self.requests, levels=aid_levels_of(bench)
            )
            pacer = Pacer(NS_PER_S / bench.config.monitor.refresh_hz, operator=operator)
        loop = FrameLoop(bench, sink, pacer, moving, self.notices, faults)
        if self.pulse is not None:
            loop.on_frame = self.pulse.frame
            self.pulse.counted = self.ledger.pulse
        return loop

    def record(self, bench: Bench, loop: FrameLoop, shown: Shown, light_ns: int) -> None:
        """Record a frame, in the ledger if there is one, and for answers; `light_ns` is on the
        sender's clock.
        """
        if self.answers is not None:
            self.answers.frame(shown, light_ns)
        if self.ledger.on:
            self.ledger.frame(
                frame_record(shown, light_ns, loop.tally.missed_frames, below_step(bench, shown))
            )

    def complete(self, summary: RunSummary, loop: FrameLoop) -> RunSummary:
        """The summary of a run with its faults, pulses, events and screen."""
        first_ns = loop.tally.first_swap_ns
        now_ns = loop.pacer.clock.now_ns()
        wrong_sky = self.notices.wrong_sky.total(now_ns if first_ns is None else first_ns, now_ns)
        return replaced(
            summary,
            wrong_sky=wrong_sky,
            verdict=verdict_of(replaced(summary, wrong_sky=wrong_sky)),
            faults=UNSET if self.faults is None else self.faults.summary(),
            sync=UNSET if self.pulse is None else self.pulse.summary(),
            answers=UNSET if self.answers is None else self.answers.figures,
            events=self.notices.counts(),
            screen=loop.screen_summary(),
        )


def serve(
    bench: Bench,
    link: AnyLink,
    limit: Limit,
    sink: FrameSink = ignore,
    outlet: Outlet | None = None,
) -> RunSummary:
    """Show the live stream of `link` up to `limit`, or until a signal; returns the summary."""
    outlet = outlet or Outlet()
    loop = outlet.loop(bench, sink)
    for kind, line in link.conventions.mounting_notices(
        Mounting(bench.config.tracker.q_body_to_cam)
    ):
        outlet.notices.tell(kind, line)
    with stop_on_signal(loop.stop), loop.watch:
        if link.steps:
            bench.warm_up()
            summary = LockstepRun(bench, limit, loop, outlet).serve(link)
        else:
            summary = _serve_stream(bench, link, limit, loop, outlet)
    outlet.notices.sum_up()
    link_fields: dict[str, str | int] = {"endpoint": link.endpoint}
    return replaced(outlet.complete(summary, loop), link=link_fields | link.link_counts.summary())


def _read_as(bench: Bench, link: AnyLink) -> ReadAs:
    """How a link's quaternions become the camera's."""
    config = bench.config
    return ReadAs.of(
        link.conventions, config.attitude.convention, Mounting(config.tracker.q_body_to_cam)
    )


def traffic_of(settings: AttitudeSettings) -> Traffic:
    """What goes back to the sender by the bench file; a clock that is known needs no requests."""
    if settings.source == "scpi":
        return Traffic(settings.status_hz, clock="shared")
    asks = settings.time_requests and settings.clock == "estimated"
    return Traffic(settings.status_hz, asks, settings.clock)


def _serve_stream(
    bench: Bench, link: StreamLink, limit: Limit, loop: FrameLoop, outlet: Outlet
) -> RunSummary:
    settings, clock = bench.config.attitude, loop.pacer.clock
    timeline = Timeline(policy_of(settings))
    traffic = traffic_of(settings)
    receiver = Receiver(
        link,
        timeline,
        traffic,
        outlet.ledger.packet,
        outlet.notices,
        wrong_rates=settings.check_rates,
        read_as=_read_as(bench, link),
    )
    receiver.tell_lost = outlet.ledger.lost
    outlet.follower(Running(loop, receiver.counts, receiver.clock_summary, outlet.answers))
    statuses = StatusMaker(outlet.ledger)
    if outlet.answers is not None and link.two_way:
        outlet.answers.passed_on = partial(_pass_on, receiver, itertools.count(1))

    def draw_blank(moment: Moment) -> None:
        receiver.tend()
        loop.draw(moment.slot, receiver.clock.to_sender_ns(clock.now_ns()), None, moment)

    def draw_slot(moment: Moment) -> Shown | None:
        receiver.tend()
        host_ns = moment.light_if_begun_at(clock.now_ns())
        t_ns = receiver.clock.to_sender_ns(host_ns)
        shown = loop.draw(moment.slot, t_ns, timeline.at(t_ns), moment.lit_at(host_ns))
        if shown is None:
            return None
        light_ns = receiver.jumps.sender_ns(t_ns)
        outlet.record(bench, loop, shown, light_ns)
        if link.two_way:
            receiver.back.post(
                statuses.status(shown, light_ns, loop, receiver.counts, receiver.clock.synchronised)
            )
        return shown

    receiver.start()
    try:
        bench.warm_up()
        receiver.learn()
        if limit.from_first_attitude:
            loop.lead_in(draw_blank, lambda: len(timeline) > 0)
        begin_ns = clock.now_ns()
        loop.paced(limit, draw_slot)
    finally:
        receiver.close()
    summary = loop.tally.summary(
        (clock.now_ns() - begin_ns) / NS_PER_S, receiver.counts, bench.renderer
    )
    return replaced(
        summary,
        stale_events=loop.gate.events,
        receive_latency_ms=receiver.latency_ms.percentiles(),
        clock=receiver.clock_summary(),
        reconnects=link.reconnects,
    )


def _pass_on(receiver: Receiver, numbers: Iterator[int], answer: Answer, middle_ns: int) -> None:
    """Pass an answer of the tracker on to the sender, with the next number."""
    packet = answer_packet(answer, middle_ns, receiver.clock_summary().offset_ms)
    if packet is not None:
        receiver.back.pass_on(replace(packet, sequence=next(numbers)))


def answer_packet(answer: Answer, middle_ns: int, offset_ms: float | None) -> AnswerPacket | None:
    """An answer of the tracker, stamped on the sender's clock, as a packet with the number 0; None
    where it is not valid or that clock is not known.
    """
    if answer.q_icrs_to_cam is None or not answer.valid or offset_ms is None:
        return None
    t_ns = middle_ns - round(offset_ms * NS_PER_MS)
    rate = answer.rate_cam_rad_s
    flags = protocol.ANSWER_VALID | (0 if rate is None else protocol.ANSWER_RATE_VALID)
    q = tuple(answer.q_icrs_to_cam.tolist())
    rates = (0.0, 0.0, 0.0) if rate is None else tuple(rate.tolist())
    return AnswerPacket(0, flags, t_ns, q, rates, answer.star_count or 0)


class LockstepRun:
    """The frames of a simulation in lockstep, up to its limit: each attitude that it asks for is
    drawn at once.

    Its time is its own, and may run at any speed.
    """

    def __init__(self, bench: Bench, limit: Limit, loop: FrameLoop, outlet: Outlet) -> None:
        self.counts = PacketCounts()
        self._last = Shown(0, 0, None, bench.draw(None), missing=True)
        self._bench = bench
        self._limit = limit
        self._loop = loop
        self._outlet = outlet
        self._clock = loop.pacer.clock
        self._max_rate_rad_s = math.radians(bench.config.attitude.max_rate_deg_s)

    def serve(self, link: LockstepLink) -> RunSummary:
        """Answer requests up to the limit, or until a signal; returns the summary. A refused
        request leaves the last frame.
        """
        check = self._bench.config.attitude.check_rates
        self._rates = RateCheck(
            check, self._loop.notices, used=False, read_as=_read_as(self._bench, link)
        )
        loop = self._loop
        statuses = StatusMaker(self._outlet.ledger)
        turn_ms = RunningStatistics()
        self._outlet.follower(Running(loop, self.counts, answers=self._outlet.answers))
        tracker = self._bench.config.tracker
        height_mm = tracker.resolution_px[1] * tracker.pixel_pitch_um * 1e-3
        field_deg = 2 * math.degrees(math.atan(height_mm / (2 * tracker.focal_length_mm)))
        camera = TrackerCamera(
            Mounting(tracker.q_body_to_cam).q_body_to_cam, tracker.resolution_px, field_deg
        )
        link.show_camera(camera, self._outlet.pictures)
        begin_ns = self._clock.now_ns()
        end_ns = begin_ns + self._limit.slots / self._bench.config.monitor.refresh_hz * NS_PER_S
        while (
            loop.tally.frames < self._limit.frames
            and self._clock.now_ns() < end_ns
            and not loop.stop.is_set()
        ):
            arrival = link.receive(POLL_MS)
            if arrival is None:
                loop.idle()
                continue
            refusal = self._take(arrival.host_ns, arrival.event, arrival.raw)
            shown_ns = self._clock.now_ns()
            status = statuses.status(self._last, self._last.t_ns, loop, self.counts, False)
            link.answer(status, shown_ns, refusal)
            turn_ms.add((shown_ns - arrival.host_ns) / NS_PER_MS)
        duration_s = (self._clock.now_ns() - begin_ns) / NS_PER_S
        return replaced(
            loop.tally.summary(duration_s, self.counts, self._bench.renderer),
            turn_ms=turn_ms.percentiles(),
        )

    def _take(self, host_ns: int, event: Event, raw: bytes) -> Refusal | None:
        """Show what a request says, or say why it is refused; the last frame then stays."""
        self.counts.received += 1
        if isinstance(event, AttitudeSample):
            sample = event
        else:
            sample = None
        refusal = event if isinstance(event, Refusal) else None
        if sample is not None:
            self._rates.see(sample, host_ns)
            refusal = rate_refusal(self._rates.believed(sample), self._max_rate_rad_s)
        elif refusal is None:
            refusal = Refusal(
                "format",
                f"a {type(event).__name__} packet; a request is an attitude, or a time request",
            )
        if refusal is not None and self.counts.refuse(refusal):
            line = (
                f"message refused ({refusal.reason}): {refusal.detail}; further ones are only"
                " counted"
            )
            self._loop.notices.mention("refused", line)
        shown = None
        if refusal is None and sample is not None:
            attitude = Attitude(
                sample.q_icrs_to_cam,
                0,
                False,
                sample.sequence,
                host_ns,
                velocity_km_s=sample.velocity_km_s,
                place_km=sample.place_km,
            )
            shown = self._loop.draw(self._loop.tally.frames, sample.t_ns, attitude)
        self._outlet.ledger.packet(host_ns, raw, sample, refusal)
        if shown is not None:  # where a fault drops a frame, the previous one stays
            self._last = shown
            self._outlet.record(self._bench, self._loop, shown, shown.t_ns)
        return refusal


class StatusMaker:
    """Makes the status that goes back to the sender: which frame its attitudes caused, and how the
    display is doing.

    Missed frames, refused packets and momentary events are reported once each.
    """

    def __init__(self, ledger: Ledger | LedgerSwitch | None = None) -> None:
        self._ledger = ledger
        self._missed = 0
        self._refused = 0
        self._told: dict[str, int] = {}

    def status(
        self,
        shown: Shown,
        light_t_ns: int,
        loop: FrameLoop,
        counts: PacketCounts,
        synchronised: bool,
    ) -> Status:
        """The status after a frame whose light leaves at `light_t_ns` of the sender's clock."""
        missed = loop.tally.missed_frames
        refused = counts.refused
        attitude = shown.attitude
        on_screen = loop.pacer.operator.look()
        health = {
            protocol.HEALTH_NO_ATTITUDE: shown.missing and not loop.gate.stale,
            protocol.HEALTH_STALE: loop.gate.stale,
            protocol.HEALTH_BLANK: attitude is None,
            protocol.HEALTH_CLOCK_SYNCHRONISED: synchronised,
            protocol.HEALTH_MISSED: missed > self._missed,
            protocol.HEALTH_REFUSED: refused > self._refused,
            protocol.HEALTH_CLIPPED: bool(shown.drawn.clipped_hip),
            protocol.HEALTH_LEDGER_FAILED: (
                self._ledger is not None and self._ledger.failure is not None
            ),
            protocol.HEALTH_OPERATOR_OVERRIDE: bool(on_screen.operator),
            protocol.HEALTH_HIDDEN: bool(on_screen.hidden),
            protocol.HEALTH_SECOND_SENDER: self._happens(loop.notices, "second-sender"),
            protocol.HEALTH_SOURCE_FROZEN: self._happens(loop.notices, "source-frozen"),
        }
        self._missed = missed
        self._refused = refused
        return Status(
            health=sum(bit for bit, is_set in health.items() if is_set),
            frame=shown.number,
            light_t_ns=light_t_ns,
            attitude_age_ns=-1 if attitude is None else attitude.age_ns,
            attitude_sequence=0 if attitude is None else attitude.sequence,
            accepted=counts.received - refused,
            refused=refused,
        )

    def _happens(self, notices: Notices, kind: str) -> bool:
        """True while an event lasts, and once after each momentary one."""
        before, self._told[kind] = self._told.get(kind, 0), notices.counts().get(kind, 0)
        return kind in notices.active or self._told[kind] > before
