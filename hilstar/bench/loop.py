"""The frame loop: an attitude at each frame's time, drawn, counted, handed on."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from hilstar.attitude.clock import NS_PER_MS, NS_PER_S
from hilstar.attitude.timeline import Attitude, Policy, StaleGate
from hilstar.bench.assembly import Bench, Drawn
from hilstar.bench.config import AttitudeSettings
from hilstar.bench.pacing import wait_until
from hilstar.bench.screen import Screen
from hilstar.bench.stats import RunStats


@dataclass(frozen=True, slots=True)
class Shown:
    """One frame of a run: its number, its time on the timeline, its attitude (None: blank) and its levels.

    `draw_ns` is when drawing began and `shown_ns` when the levels were ready, host time.
    """

    number: int
    t_ns: int
    attitude: Attitude | None
    drawn: Drawn
    draw_ns: int = 0
    shown_ns: int = 0
    stale: bool = False
    timestamp_source: str = "headless"


FrameSink = Callable[[Shown], None]


def ignore(shown: Shown) -> None:
    """The sink of a run that nobody looks at."""


@dataclass(frozen=True, slots=True)
class Limit:
    """When a paced run ends: after so many refresh periods, or so many frames drawn."""

    slots: float = math.inf
    frames: float = math.inf


SMOOTHING = 0.1  # of each new frame in the time from draw to swap


class FrameLoop:
    """Draws frames; one slow frame is missed, and never queues others."""

    def __init__(self, bench: Bench, sink: FrameSink = ignore, screen: Screen | None = None) -> None:
        settings = bench.config.attitude
        self.stats = RunStats()
        self.stop = threading.Event()
        self.gate = StaleGate(policy_of(settings).stale_after_ns)
        self._bench = bench
        self._sink = sink
        self._screen = screen
        self._draw_to_swap_ns = 0.0  # of the last frames
        self._held: Attitude | None = None  # what a paused screen shows
        self._blank_when_stale = settings.on_stale == "blank"

    def draw(self, number: int, t_ns: int, attitude: Attitude | None) -> Shown:
        """Draw the frame for `t_ns` of the timeline's clock; without an attitude it is blank."""
        begin_ns = time.monotonic_ns()
        if self._screen is not None and self._screen.paused:
            attitude = self._held
        self._held = attitude
        stale = self.gate.update(attitude)
        blank = attitude is None or (stale and self._blank_when_stale)
        drawn = self._bench.draw(None if attitude is None or blank else attitude.q_icrs_to_cam, number)
        end_ns = self._shown_ns(drawn)
        self._draw_to_swap_ns += SMOOTHING * (end_ns - begin_ns - self._draw_to_swap_ns)
        self.stats.add(end_ns - begin_ns, None if attitude is None else attitude.age_ns, drawn.star_count, drawn.clipped_hip)
        self.stats.stale_frames += stale
        source = "headless" if self._screen is None else "after-swap clock"
        shown = Shown(number, t_ns, None if blank else attitude, drawn, begin_ns, end_ns, stale, source)
        self._sink(shown)
        return shown

    def _shown_ns(self, drawn: Drawn) -> int:
        """When the frame's levels are ready in memory or, on a screen, swapped in."""
        if self._screen is None:
            _ = drawn.levels
            return time.monotonic_ns()
        swap_ns = self._screen.show()
        if self._screen.closing:
            self.stop.set()
        return swap_ns

    def idle(self) -> None:
        """Keep the window alive while no frame is due."""
        if self._screen is not None:
            self._screen.show()
            if self._screen.closing:
                self.stop.set()

    def light_ns(self, host_ns: int) -> int:
        """When the light of a frame that is begun at `host_ns` leaves the screen; that moment itself without a screen."""
        return host_ns if self._screen is None else host_ns + self._screen.lead_ns(self._draw_to_swap_ns)

    @property
    def _waits_for_screen(self) -> bool:
        return self._screen is not None and self._screen.timing.paced_by_screen

    def paced(self, refresh_hz: float, limit: Limit, draw_slot: Callable[[int], object]) -> None:
        """Call `draw_slot(slot)` at `refresh_hz` up to `limit`.

        A slot whose moment has passed when its turn comes is missed, counted, and not drawn.
        """
        period_ns = NS_PER_S / refresh_hz
        start_ns = time.monotonic_ns()
        slot = 0
        while slot < limit.slots and self.stats.frames < limit.frames and not self.stop.is_set():
            if not self._waits_for_screen and wait_until(start_ns + round(slot * period_ns), self.stop):
                return
            draw_slot(slot)
            late = int((time.monotonic_ns() - start_ns) // period_ns)
            following = max(slot + 1, late + 1)
            if self.stats.frames < limit.frames:
                self.stats.missed_frames += int(min(following, limit.slots)) - slot - 1
            slot = following


@contextmanager
def stop_on_signal(stop: threading.Event) -> Iterator[None]:
    """SIGINT and SIGTERM end the run in order while this is open (main thread only)."""

    def handle(number: int, frame: object) -> None:
        stop.set()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def policy_of(settings: AttitudeSettings) -> Policy:
    """The timeline's policy, from the bench file's milliseconds."""
    return Policy(
        max_extrapolation_ns=round(settings.max_extrapolation_ms * NS_PER_MS),
        stale_after_ns=round(settings.stale_after_ms * NS_PER_MS),
    )
