"""What faults do to the frames of a run, besides their light: frames that are never shown, that stay, or are blank.

The loop asks once a frame. A replay asks a recording in place of a schedule, and draws the same light from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from hilstar.attitude.clock.timeline import Attitude
from hilstar.bench.frame import Bench, Drawn
from hilstar.frame.fault_kinds import Freeze, Now
from hilstar.frame.fault_light import FaultView
from hilstar.frame.faults import FaultLayer
from hilstar.frame.view import View


class FaultSource(Protocol):
    """Says which faults are on."""

    def at(self, t_ns: int) -> tuple[Now, ...]:
        """Those of the frame whose light begins at `t_ns`."""


@dataclass(frozen=True, slots=True)
class Held:
    """The last frame that was drawn: what stays when the next ones are frozen."""

    drawn: Drawn
    attitude: Attitude | None
    t_ns: int
    now: tuple[Now, ...]


class FaultyFrames:
    """The faults of a run, frame by frame."""

    def __init__(self, source: FaultSource, view: FaultView) -> None:
        self.dropped = self.frozen = 0
        self.now: tuple[Now, ...] = ()  # faults of the last frame that was asked about
        self._source, self._view = source, view
        self._held: Held | None = None

    def at(self, t_ns: int, attitude: Attitude | None) -> FaultLayer | None:
        """What is wrong in a frame; None where nothing is, and before the run's first attitude, from which time counts."""
        if attitude is None and self._held is None:
            return None
        now = self.now = self._source.at(t_ns)
        return FaultLayer(self._view, now) if now else None

    def drops(self, effects: FaultLayer | None, number: int) -> bool:
        """Whether a frame is never shown; it is counted."""
        if effects is None or self._held is None or not effects.drops(number):
            return False
        self.dropped += 1
        return True

    def attitude(self, effects: FaultLayer | None, t_ns: int, attitude: Attitude | None) -> Attitude | None:
        """The attitude that is shown in place of a frame's own."""
        if effects is None or attitude is None:
            return attitude
        if effects.frozen and self._held is not None:
            held = self._held.attitude
            return None if held is None else replace(held, age_ns=max(0, held.age_ns + t_ns - self._held.t_ns))
        if effects.blank:
            return None
        turned = effects.turned(View(attitude.q_icrs_to_cam, attitude.rate_cam_rad_s))
        return replace(attitude, q_icrs_to_cam=turned.q_icrs_to_cam, rate_cam_rad_s=turned.rate_cam_rad_s)

    def frozen_frame(self, effects: FaultLayer | None, bench: Bench) -> Drawn | None:
        """What is on the display already, for a frame that is frozen."""
        if effects is None or not effects.frozen or self._held is None:
            return None
        self.frozen += 1
        return Drawn(bench.renderer, self._held.drawn.sprites, self._held.drawn.clipped_hip)

    def shown(
        self, effects: FaultLayer | None, drawn: Drawn, attitude: Attitude | None, t_ns: int, stays: bool
    ) -> tuple[Now, ...]:
        """Take note of a frame; its faults, which of one that `stays` are those of its light and what freezes it."""
        now = () if effects is None else effects.now
        if stays and self._held is not None:
            return (*self._held.now, *(one for one in now if isinstance(one.fault, Freeze)))
        self._held = Held(drawn, attitude, t_ns, tuple(one for one in now if not isinstance(one.fault, Freeze)))
        return now
