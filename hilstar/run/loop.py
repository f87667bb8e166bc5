"""The frame loop: an attitude at each frame's time, drawn, counted, handed on."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import scipy.special  # noqa: F401 - takes 0.1 s, which the first star that might clip is not to cost its frame

from hilstar.attitude.clock.timeline import Attitude, Policy, StaleGate
from hilstar.bench.config import AttitudeSettings
from hilstar.bench.frame import Bench, Drawn
from hilstar.notices import Notices
from hilstar.process.priority import steady_loop
from hilstar.run.pacing import wait_until
from hilstar.run.presence import AttitudeWatch
from hilstar.run.screen.overrides import HEADLESS, OnScreen, Overrides
from hilstar.run.screen.screen import Screen
from hilstar.run.summary import RunStats
from hilstar.run.watchdog import FrameWatch
from hilstar.scene.sprites import Sprites
from hilstar.units import NS_PER_MS, NS_PER_S

GIVEN_UP_PERIODS = 2.0
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Shown:
    """One frame of a run: its number, its time on the timeline, its attitude (None: blank) and its levels.

    Host times, ns: `draw_ns` when drawing began, `predicted_swap_ns` and `swap_ns` when the frame was to be swapped onto the
    screen and when it was; headless, with nothing predicted, when its levels were ready. `missed_before` counts the refresh
    periods just before it that had no frame of their own, and `marker` is the photodiode square's light, 0 or 1. `missing`
    is true where no attitude has come yet; `attitude` is None too where an operator's key hides the sky.
    """

    number: int
    t_ns: int
    attitude: Attitude | None
    drawn: Drawn
    draw_ns: int = 0
    predicted_swap_ns: int | None = None
    swap_ns: int = 0
    stale: bool = False
    timestamp_source: str = "headless"
    missed_before: int = 0
    marker: int | None = None
    missing: bool = False
    on_screen: OnScreen = HEADLESS


FrameSink = Callable[[Shown], None]


def ignore(shown: Shown) -> None:
    """The sink of a run that nobody looks at."""


@dataclass(frozen=True, slots=True)
class Limit:
    """When a paced run ends: after so many refresh periods, or so many frames drawn."""

    slots: float = math.inf
    frames: float = math.inf


class FrameLoop:
    """Draws frames; one slow frame is missed, and never queues others.

    `moving` says whether stars are drawn along their paths; by default as the bench file says, which is on a screen only.
    """

    def __init__(
        self,
        bench: Bench,
        sink: FrameSink = ignore,
        screen: Screen | None = None,
        moving: bool | None = None,
        notices: Notices | None = None,
    ) -> None:
        settings = bench.config.attitude
        self.stats = RunStats()
        self.stop = threading.Event()
        self.gate = StaleGate(policy_of(settings).stale_after_ns)
        self.scheduling = "normal"
        self._bench = bench
        self._sink = sink
        self._screen = screen
        self.notices = Notices() if notices is None else notices
        self._presence = AttitudeWatch(self.notices)
        self._predicted_swap_ns: int | None = None
        self._missed_before = 0
        self._due_ns: int | None = None  # when the frame was to be begun, or on a screen swapped; None where nothing is late
        self._gave_up = False
        self._period_ns = NS_PER_S / bench.config.monitor.refresh_hz
        self.watch = FrameWatch(self._period_ns, self.notices)
        self.overrides = Overrides(screen, self.notices)
        self._blank_when_stale = settings.on_stale == "blank"
        wanted = bench.config.render.motion
        self._moving = (wanted == "on" or (wanted == "auto" and screen is not None)) if moving is None else moving

    def draw(self, number: int, t_ns: int, attitude: Attitude | None) -> Shown | None:
        """Draw the frame for `t_ns` of the timeline's clock; without an attitude it is blank.

        None for a frame that is given up, since its moment passed while its sprites were made.
        """
        self.watch.begin(number)
        try:
            return self._draw(number, t_ns, attitude)
        finally:
            self.watch.end(timed=self._due_ns is not None)

    def _draw(self, number: int, t_ns: int, attitude: Attitude | None) -> Shown | None:
        begin_ns = time.monotonic_ns()
        screen = self._screen
        stale, missing = self.gate.update(attitude), attitude is None
        self._presence.see(attitude, stale)
        on_screen = self.overrides.now
        attitude = self.overrides.attitude(t_ns, attitude)
        if stale and self._blank_when_stale and not (screen is not None and screen.paused):
            attitude = None
        sprites = self._sprites(attitude)
        if self._given_up(number):
            return None
        self.watch.enter("draw")
        drawn = self._bench.draw_sprites(sprites, number)
        predicted_ns = self._predicted_swap_ns
        if screen is None:
            _ = drawn.levels
            swap_ns = time.monotonic_ns()
        else:
            swap_ns = self._show(screen, number, begin_ns)
        shown = Shown(
            number=number,
            t_ns=t_ns,
            attitude=attitude,
            drawn=drawn,
            draw_ns=begin_ns,
            predicted_swap_ns=predicted_ns,
            swap_ns=swap_ns,
            stale=stale,
            timestamp_source="headless" if screen is None else screen.timestamp_source,
            missed_before=self._missed_before,
            marker=None if screen is None else screen.marker,
            missing=missing,
            on_screen=on_screen,
        )
        self._count(shown)
        self.overrides.count(on_screen, swap_ns)
        self.watch.enter("output")
        self._sink(shown)
        return shown

    def _sprites(self, attitude: Attitude | None) -> Sprites | None:
        if attitude is None:
            return None
        return self._bench.frame_sprites(attitude.q_icrs_to_cam, attitude.rate_cam_rad_s if self._moving else None)

    def _given_up(self, number: int) -> bool:
        """Whether the frame's moment has passed so far that the next is begun instead; never two in a row, so that even a
        machine too slow for its display shows something.
        """
        late_ns = 0 if self._due_ns is None else time.monotonic_ns() - self._due_ns
        if late_ns <= GIVEN_UP_PERIODS * self._period_ns or self._gave_up:
            self._gave_up = False
            return False
        self._gave_up = True
        self.stats.given_up_frames += 1
        self.notices.tell(
            "frame-given-up", f"frame {number} was {late_ns / NS_PER_MS:.0f} ms late before it was drawn: given up"
        )
        return True

    def _count(self, shown: Shown) -> None:
        drawn, attitude = shown.drawn, shown.attitude
        age_ns = None if attitude is None else attitude.age_ns
        self.stats.add(shown.swap_ns - shown.draw_ns, age_ns, drawn.star_count, drawn.clipped_hip)
        self.stats.stale_frames += shown.stale
        if drawn.capped:
            self._count_capped(shown.number, drawn.capped)
        if shown.predicted_swap_ns is not None:
            received_ns = None if attitude is None else attitude.received_ns
            self.stats.swaps.add(shown.swap_ns, shown.predicted_swap_ns, shown.missed_before, received_ns)

    def _count_capped(self, number: int, stars: int) -> None:
        if not self.stats.capped_frames:
            self.notices.tell(
                "capped",
                f"frame {number}: the turn is too fast for whole paths; {stars} stars are drawn coarser, with all their light"
                " (further such frames are only counted)",
            )
        self.stats.capped_frames += 1

    def _show(self, screen: Screen, number: int, begin_ns: int) -> int:
        """Put the frame on the screen at its moment; when that was."""
        self.watch.enter("present")
        screen.present(number)
        screen.budget.add(time.monotonic_ns() - begin_ns)
        if self._predicted_swap_ns is not None and not screen.clock.paced_by_screen:
            wait_until(self._predicted_swap_ns, self.stop)
        self.watch.enter("swap")
        swap_ns = screen.swap()
        self._look_at(screen)
        return swap_ns

    def _look_at(self, screen: Screen) -> None:
        """End the run with its window."""
        if screen.closing:
            self.stop.set()
        if screen.window.gone is not None:
            self.notices.begin("window-gone", f"{screen.window.gone}: the run ends")

    def screen_summary(self) -> dict[str, Any]:
        """What a run on a screen has to say besides; {} without one."""
        if self._screen is None:
            return {}
        named = {"timestamp_source": self._screen.timestamp_source, "scheduling": self.scheduling}
        return {"screen": named | self.stats.swaps.summary() | self.overrides.summary()}

    def idle(self) -> None:
        """Keep the window alive while no frame is due."""
        self._presence.see(None, True)
        if self._screen is not None:
            self._screen.present(0)
            self._screen.swap()
            _ = self.overrides.now
            self._look_at(self._screen)

    def light_ns(self, host_ns: int) -> int:
        """When the middle row of the frame that is begun at `host_ns` lights; that moment itself without a screen."""
        if self._screen is None:
            return host_ns
        swap_ns = host_ns if self._predicted_swap_ns is None else self._predicted_swap_ns
        return swap_ns + self._screen.swap_to_light_ns

    def paced(self, refresh_hz: float, limit: Limit, draw_slot: Callable[[int], object]) -> None:
        """Call `draw_slot(slot)` at `refresh_hz` up to `limit`, on a screen at its own pace.

        A slot whose moment has passed when its turn comes is missed, counted, and not drawn.
        """
        if self._screen is not None:
            with steady_loop() as self.scheduling:
                if self.scheduling.startswith("normal"):
                    log.warning("the frame loop runs at normal priority (%s)", self.scheduling.removeprefix("normal: "))
                self._paced_on_screen(self._screen, limit, draw_slot)
            return
        period_ns = NS_PER_S / refresh_hz
        start_ns = time.monotonic_ns()
        slot = 0
        while self._goes_on(slot, limit):
            self._due_ns = start_ns + round(slot * period_ns)
            if wait_until(self._due_ns, self.stop):
                return
            draw_slot(slot)
            late = int((time.monotonic_ns() - start_ns) // period_ns)
            slot = self._next_slot(slot, max(slot + 1, late + 1), limit)

    def _paced_on_screen(self, screen: Screen, limit: Limit, draw_slot: Callable[[int], object]) -> None:
        """Each frame is begun as late as the last ones allow, for the first swap that it can reach."""
        clock, budget = screen.clock, screen.budget
        slot = 0
        due_ns = clock.next_after(time.monotonic_ns() + budget.ns)
        while self._goes_on(slot, limit):
            if wait_until(round(due_ns - budget.ns), self.stop):
                break
            self._predicted_swap_ns = self._due_ns = due_ns
            draw_slot(slot)
            following_ns = clock.next_after(max(time.monotonic_ns() + budget.least_ns, due_ns + clock.period_ns / 2))
            slot = self._next_slot(slot, slot + max(1, round((following_ns - due_ns) / clock.period_ns)), limit)
            due_ns = following_ns
        self._predicted_swap_ns = None

    def _goes_on(self, slot: int, limit: Limit) -> bool:
        return slot < limit.slots and self.stats.frames < limit.frames and not self.stop.is_set()

    def _next_slot(self, slot: int, following: int, limit: Limit) -> int:
        """`following`, and the slots on the way there counted as missed."""
        before = self._missed_before + 1 if self._gave_up else 0  # the slot of a frame given up had none either
        self._missed_before = 0
        if self.stats.frames < limit.frames:
            self._missed_before = int(min(following, limit.slots)) - slot - 1
            self.stats.missed_frames += self._missed_before + self._gave_up
            self._missed_before += before
        return following


def policy_of(settings: AttitudeSettings) -> Policy:
    """The timeline's policy, from the bench file's milliseconds."""
    return Policy(
        max_extrapolation_ns=round(settings.max_extrapolation_ms * NS_PER_MS),
        stale_after_ns=round(settings.stale_after_ms * NS_PER_MS),
        max_rate_rad_s=math.radians(settings.max_rate_deg_s),
    )
