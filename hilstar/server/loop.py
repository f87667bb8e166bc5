"""The frame loop: an attitude at each frame's moment of light, drawn, counted, handed on.

It knows neither screens nor links: a pacer says when frames are due and shows them, and the caller
supplies
the attitudes. `FaultyFrames` says which frames a fault drops, freezes or blanks; a fault of light
is a layer of the frame.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import scipy.special  # noqa: F401 - takes 0.1 s, which the first star that might clip is not to cost its frame
from msgspec import UNSET, UnsetType

import hilstar.display.render.extended_drawing  # noqa: F401 - takes 5 ms, which the first body is not to cost its frame
from hilstar.attitude.clock.timeline import Attitude, Policy, StaleGate
from hilstar.basics.errors import GpuError
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.optics.layers.fault_kinds import Freeze, Now
from hilstar.optics.layers.fault_light import FaultView
from hilstar.optics.layers.faults import FaultLayer
from hilstar.optics.layers.view import View
from hilstar.optics.sprites import FrameLight
from hilstar.server.bench.config import AttitudeSettings
from hilstar.server.bench.drawn import Drawn
from hilstar.server.bench.frame import Bench
from hilstar.server.operator import OnScreen
from hilstar.server.pacer import AT_ONCE, FrameSink, Moment, Pacer, Shown, ignore
from hilstar.server.summary import RunTally
from hilstar.server.watchdog import AttitudeWatch, FrameWatch, GpuWatch

GIVEN_UP_PERIODS = 2.0
SHAKEN = 1.1  # a turn at what is claimed, shaken, is no faster one


@dataclass(frozen=True, slots=True)
class Limit:
    """When a paced run ends: after a number of refresh periods, or of frames drawn.

    With `from_first_attitude` a live run draws blank frames until an attitude has come, and counts
    from then on.
    """

    slots: float = math.inf
    frames: float = math.inf
    from_first_attitude: bool = False

    @property
    def shortest(self) -> float:
        """The smaller of the two."""
        return min(self.slots, self.frames)


@dataclass(frozen=True, slots=True)
class Held:
    """The last frame that was drawn: what stays when the next ones are frozen."""

    drawn: Drawn
    attitude: Attitude | None
    t_ns: int
    now: tuple[Now, ...]


class FaultyFrames:
    """The faults of a run, frame by frame; `source` says which are on in the frame whose light
    begins at a time, ns.
    """

    def __init__(self, source: Callable[[int], tuple[Now, ...]], view: FaultView) -> None:
        self.dropped = self.frozen = 0
        self.has_dropped = False  # since the last frame that was shown
        self.now: tuple[Now, ...] = ()  # faults of the last frame that was asked about
        self._source = source
        self._view = view
        self._held: Held | None = None

    def at(self, t_ns: int, attitude: Attitude | None) -> FaultLayer | None:
        """The faults of a frame as a layer; None without any, and before the run's first
        attitude.
        """
        if attitude is None and self._held is None:
            return None
        now = self.now = self._source(t_ns)
        return FaultLayer(self._view, now) if now else None

    def drops(self, effects: FaultLayer | None, number: int) -> bool:
        """Whether a fault drops the frame; it is counted."""
        if effects is None or self._held is None or not effects.drops(number):
            return False
        self.dropped += 1
        self.has_dropped = True
        return True

    def attitude(
        self, effects: FaultLayer | None, t_ns: int, attitude: Attitude | None
    ) -> Attitude | None:
        """The attitude that is shown in place of a frame's own."""
        if effects is None or attitude is None:
            return attitude
        if effects.frozen and self._held is not None:
            held = self._held.attitude
            if held is None:
                return None
            return replace(held, age_ns=max(0, held.age_ns + t_ns - self._held.t_ns))
        if effects.blank:
            return None
        turned = effects.turned(View(attitude.q_icrs_to_cam, attitude.rate_cam_rad_s))
        return replace(
            attitude, q_icrs_to_cam=turned.q_icrs_to_cam, rate_cam_rad_s=turned.rate_cam_rad_s
        )

    def frozen_frame(self, effects: FaultLayer | None, bench: Bench) -> Drawn | None:
        """What is on the display already, for a frame that is frozen."""
        if effects is None or not effects.frozen or self._held is None:
            return None
        self.frozen += 1
        return Drawn(bench.renderer, self._held.drawn.sprites, self._held.drawn.clipped_hip)

    def shown(
        self,
        effects: FaultLayer | None,
        drawn: Drawn,
        attitude: Attitude | None,
        t_ns: int,
        stays: bool,
    ) -> tuple[Now, ...]:
        """Remember a shown frame, and return its faults: of one that `stays` its first ones, and
        what freezes it now.
        """
        self.has_dropped = False
        now = () if effects is None else effects.now
        if stays and self._held is not None:
            return (
                *self._held.now,
                *(active for active in now if isinstance(active.fault, Freeze)),
            )
        self._held = Held(
            drawn,
            attitude,
            t_ns,
            tuple(active for active in now if not isinstance(active.fault, Freeze)),
        )
        return now


class FrameLoop:
    """Draws frames; a slow frame is missed, and never delays those after it.

    `moving` says whether stars are drawn along their paths; by default as the bench file has it,
    which is on a screen only. `on_frame` is called with each frame's number and time stamp, host
    ns: on a screen after its swap, else when it is due, and in an unpaced run once it is drawn.
    """

    def __init__(
        self,
        bench: Bench,
        sink: FrameSink = ignore,
        pacer: Pacer | None = None,
        moving: bool | None = None,
        notices: Notices | None = None,
        faults: FaultyFrames | None = None,
    ) -> None:
        settings = bench.config.attitude
        motion = bench.config.render.motion
        self._bench = bench
        self._sink = sink
        self._faults = faults
        self._period_ns = NS_PER_S / bench.config.monitor.refresh_hz
        self._blank_when_stale = settings.on_stale == "blank"
        self.pacer = Pacer(self._period_ns) if pacer is None else pacer
        self._moving = (
            (motion == "on" or (motion == "auto" and self.pacer.moves_stars))
            if moving is None
            else moving
        )
        self.on_frame: Callable[[int, int], None] = lambda number, frame_ns: None
        self.stop = self.pacer.stop
        self.tally = RunTally()
        self.gate = StaleGate(policy_of(settings).stale_after_ns)
        self.notices = Notices() if notices is None else notices
        # The turn that is told of; a bench that leaves nothing to its tolerance has no claim.
        if bench.effort.is_chosen:
            claimed_deg_s = bench.effort.claimed_turn_deg_s
        else:
            claimed_deg_s = 0.0
        self._told_above_deg_s = SHAKEN * claimed_deg_s or math.inf
        self._presence = AttitudeWatch(self.notices, self.pacer.clock)
        self.watch = FrameWatch(self._period_ns, self.notices, self.pacer.clock)
        self._gpu = GpuWatch(bench.renderer, self.notices, self.stop, self.pacer.clock)

    def draw(
        self, number: int, t_ns: int, attitude: Attitude | None, moment: Moment = AT_ONCE
    ) -> Shown | None:
        """Draw the frame for `t_ns` of the timeline's clock; without an attitude it is blank.

        None for a frame that is given up because its moment passed while its sprites were computed,
        or that a fault drops.
        """
        if moment.due_ns is None:  # else `paced` looks, between the frames
            self._gpu.look()
        self.watch.begin(number)
        if moment.starts_ns is not None:
            self.on_frame(number, moment.starts_ns)
        try:
            return self._draw(number, t_ns, attitude, moment)
        except GpuError as error:
            self._gpu.lost(str(error))
            raise
        finally:
            self.watch.end(timed=moment.due_ns is not None)

    def _draw(
        self, number: int, t_ns: int, attitude: Attitude | None, moment: Moment
    ) -> Shown | None:
        begun_ns = self.pacer.clock.now_ns()
        stale, missing = self.gate.update(attitude), attitude is None
        self._presence.see(attitude, stale)
        operator = self.pacer.operator
        on_screen = operator.look()
        attitude = operator.attitude(t_ns, attitude)
        if stale and self._blank_when_stale and not operator.aids.paused:
            attitude = None
        effects, faults, stays = None, self._faults, None
        if faults is not None:
            effects = faults.at(t_ns, attitude)
            if faults.drops(effects, number):
                return None
            attitude, stays = (
                faults.attitude(effects, t_ns, attitude),
                faults.frozen_frame(effects, self._bench),
            )
        light = None if stays is not None else self._light(attitude, t_ns, effects)
        if self._gives_up(number, moment):
            return None
        self.watch.enter("draw")
        is_sample = moment.starts_ns is not None
        stood = faults is not None and faults.has_dropped  # the frame before, as a fault has it
        drawn = self._bench.draw_sprites(light, number) if stays is None else stays
        now = (
            ()
            if faults is None
            else faults.shown(effects, drawn, attitude, t_ns, stays is not None)
        )
        presented = self.pacer.show(number, drawn, moment, begun_ns, self.watch.enter)
        if moment.starts_ns is None:
            self.on_frame(number, presented.swap_ns)
        shown = Shown(
            number=number,
            t_ns=t_ns,
            attitude=attitude,
            drawn=drawn,
            draw_ns=begun_ns,
            predicted_swap_ns=moment.swap_ns,
            swap_ns=presented.swap_ns,
            stale=stale,
            timestamp_source=presented.timestamp_source,
            missed_before=moment.missed_before,
            marker=presented.marker,
            missing=missing,
            on_screen=on_screen,
            faults=now,
            light_ns=moment.light_ns,
            fades=is_sample and not stood,
        )
        self._count(shown, on_screen)
        self.watch.enter("output")
        self._sink(shown)
        return shown

    def _light(
        self, attitude: Attitude | None, t_ns: int, faults: FaultLayer | None
    ) -> FrameLight | None:
        if attitude is None:
            return None
        rate = attitude.rate_cam_rad_s if self._moving else None
        if rate is not None:
            self._see_turn(math.degrees(math.hypot(*rate)))
        view = self._bench.view(
            attitude.q_icrs_to_cam, rate, t_ns, attitude.velocity_km_s, attitude.place_km
        )
        return self._bench.light(view, faults)

    def _see_turn(self, turn_deg_s: float) -> None:
        """Tell the first turn that is faster than those that the bench's errors are claimed of."""
        if turn_deg_s <= self._told_above_deg_s:
            return
        self._told_above_deg_s = math.inf
        claimed_deg_s = self._bench.effort.claimed_turn_deg_s
        self.notices.tell(
            "beyond-claim",
            f"the camera turns by {turn_deg_s:.2g} deg/s: errors are kept within [render]'s"
            f" tolerance up to {claimed_deg_s:g} deg/s; those of faster turns are larger (told"
            " once)",
        )

    def _gives_up(self, number: int, moment: Moment) -> bool:
        # Never two in a row, so that even a machine too slow for its display shows something.
        if moment.due_ns is None:
            late_ns = 0
        else:
            late_ns = self.pacer.clock.now_ns() - moment.due_ns
        if late_ns <= GIVEN_UP_PERIODS * self._period_ns or not moment.may_be_given_up:
            return False
        self.tally.given_up_frames += 1
        line = f"frame {number} was {late_ns / NS_PER_MS:.0f} ms late before it was drawn: given up"
        self.notices.tell("frame-given-up", line)
        return True

    def _count(self, shown: Shown, on_screen: OnScreen) -> None:
        drawn = shown.drawn
        attitude = shown.attitude
        age_ns = None if attitude is None else attitude.age_ns
        self.tally.add(shown.swap_ns - shown.draw_ns, age_ns, drawn.star_count, drawn.clipped_hip)
        if self.tally.first_swap_ns is None:
            self.tally.first_swap_ns = shown.swap_ns
        self.tally.stale_frames += shown.stale
        self.tally.blank_frames += shown.missing
        if drawn.capped:
            if not self.tally.capped_frames:
                line = (
                    f"frame {shown.number}: the turn is too fast for full paths; {drawn.capped}"
                    " stars are drawn coarser, with"
                )
                self.notices.tell(
                    "capped", f"{line} all their light (further such frames are only counted)"
                )
            self.tally.capped_frames += 1
        if shown.predicted_swap_ns is not None:
            if attitude is None:
                received_ns = None
            else:
                received_ns = attitude.received_ns
            self.tally.swaps.add(
                shown.swap_ns, shown.predicted_swap_ns, shown.missed_before, received_ns
            )
        self.pacer.operator.count(on_screen, shown.swap_ns)

    def idle(self) -> None:
        """Keep the window alive while no frame is due."""
        self._presence.see(None, True)
        self.watch.idle()
        self._gpu.look()
        self.pacer.idle()

    def screen_summary(self) -> dict[str, Any] | UnsetType:
        """What the summary of a run says of its screen; unset without one."""
        return self.pacer.summary(self.tally.swaps.summary()) or UNSET

    def paced(self, limit: Limit, draw_slot: Callable[[Moment], Shown | None]) -> None:
        """Call `draw_slot` at each of the pacer's moments up to `limit`; it returns what it drew,
        None for nothing.

        A slot whose moment has passed when its turn comes is missed, counted, and not drawn.
        """
        last: Moment | None = None
        gave_up = False
        with self.pacer.steady():
            for moment in self.pacer.moments():
                if last is not None:
                    missed = self._missed_between(last, moment.slot, gave_up, limit)
                    moment = replace(moment, missed_before=missed, may_be_given_up=not gave_up)
                over = (
                    moment.slot >= limit.slots
                    or self.tally.frames >= limit.frames
                    or self.stop.is_set()
                )
                if over or self.pacer.clock.wait_until(moment.begin_ns, self.stop):
                    return
                gave_up = draw_slot(moment) is None
                last = moment
                self._gpu.look()

    def lead_in(self, draw_blank: Callable[[Moment], object], over: Callable[[], bool]) -> None:
        """Call `draw_blank` at each of the pacer's moments until `over` is true; none of these
        frames is counted.
        """
        with self.pacer.steady():
            for moment in self.pacer.moments():
                if over() or self.pacer.clock.wait_until(moment.begin_ns, self.stop):
                    break
                draw_blank(moment)
                self._gpu.look()
        self.tally = RunTally()

    def _missed_between(self, last: Moment, slot: int, gave_up: bool, limit: Limit) -> int:
        if self.tally.frames >= limit.frames:
            return 0
        between = int(min(slot, limit.slots)) - last.slot - 1
        self.tally.missed_frames += between + gave_up
        # the slot of a frame given up had none either
        return between + (last.missed_before + 1 if gave_up else 0)


def policy_of(settings: AttitudeSettings) -> Policy:
    """The timeline's policy, from the bench file's milliseconds."""
    return Policy(
        max_extrapolation_ns=round(settings.max_extrapolation_ms * NS_PER_MS),
        stale_after_ns=round(settings.stale_after_ms * NS_PER_MS),
        max_rate_rad_s=math.radians(settings.max_rate_deg_s),
        prediction=settings.prediction,
    )
