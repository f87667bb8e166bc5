"""Pacing: when each frame of a run is to be begun, when its light leaves, and what shows it.

A pacer hands the frame loop one moment after another. `ClockPacer` keeps a grid of this host's clock, for a run without a
screen; `screen.display_pacer` follows a display's refresh.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

from hilstar.attitude.clock.timeline import Attitude
from hilstar.bench.frame import Drawn
from hilstar.monitor.response import Levels
from hilstar.run.host_clock import HOST_CLOCK, HostClock
from hilstar.run.shown import HEADLESS, OnScreen


@dataclass(frozen=True, slots=True)
class Moment:
    """When a frame is to be shown; host times, ns.

    It is begun at `begin_ns` and late after `due_ns` (None: never late). `swap_ns` is its predicted swap onto a screen, and
    `light_ns` when its middle row lights (None: as soon as it is begun). The pacer gives all of these; the frame loop counts
    `missed_before`, the refresh periods just before it without a frame of their own, and whether it `may_be_given_up`.
    """

    slot: int = 0
    begin_ns: int = 0
    due_ns: int | None = None
    swap_ns: int | None = None
    light_ns: int | None = None
    missed_before: int = 0
    may_be_given_up: bool = True

    def light_if_begun_at(self, host_ns: int) -> int:
        """When the light of the frame leaves if it is begun at `host_ns`."""
        return host_ns if self.light_ns is None else self.light_ns

    @property
    def starts_ns(self) -> int | None:
        """When the frame starts where that is known before it is drawn: paced, and without a screen's swap to wait for."""
        return self.due_ns if self.swap_ns is None else None


AT_ONCE = Moment()


@dataclass(frozen=True, slots=True)
class Presented:
    """How a frame was shown: when (host time, ns), by which clock, and the photodiode square's light in it."""

    swap_ns: int
    timestamp_source: str = "headless"
    marker: int | None = None


class Operator:
    """What an operator changes in the frames: nothing without a screen."""

    @property
    def paused(self) -> bool:
        """Whether the attitude is frozen."""
        return False

    def look(self) -> OnScreen:
        """The state of the keys and the window now."""
        return HEADLESS

    def attitude(self, t_ns: int, attitude: Attitude | None) -> Attitude | None:
        """The attitude to show at `t_ns` of the timeline."""
        return attitude

    def laid_over(self, levels: Levels) -> Levels:
        """The levels of a frame that no screen changes, with what lies over them."""
        return levels

    def count(self, shown: OnScreen, swap_ns: int) -> None:
        """Count a frame by how it was shown."""


class Pacer(Protocol):
    """Decides when frames are due, and shows them."""

    @property
    def clock(self) -> HostClock:
        """The clock of all its moments."""

    @property
    def stop(self) -> threading.Event:
        """Set to end the run."""

    @property
    def operator(self) -> Operator:
        """The operator at the screen."""

    @property
    def moves_stars(self) -> bool:
        """Whether stars move within a frame here: rows of a screen light one after another."""

    def moments(self) -> Iterator[Moment]:
        """The moments of a run, without end; each is the first that can be reached when it is asked for."""

    def steady(self) -> AbstractContextManager[object]:
        """While this is open, the process does not interrupt its frames."""

    def show(self, number: int, drawn: Drawn, moment: Moment, begun_ns: int, enter: Callable[[str], None]) -> Presented:
        """Show a frame that was begun at `begun_ns`; `enter` is called with the name of each stage."""

    def idle(self) -> None:
        """Called while no frame is due."""

    def summary(self, swaps: dict[str, Any]) -> dict[str, Any]:
        """What the run's summary says of the screen and its `swaps`; {} without a screen."""


class ClockPacer:
    """Frames at a steady rate of this host's clock, without a screen: their levels are read back."""

    moves_stars = False

    def __init__(self, period_ns: float, clock: HostClock = HOST_CLOCK, operator: Operator | None = None) -> None:
        self.clock = clock
        self.stop = threading.Event()
        self.operator = Operator() if operator is None else operator
        self._period_ns = period_ns

    def moments(self) -> Iterator[Moment]:
        """One each period from now on; those already past when the next is asked for are skipped."""
        start_ns = self.clock.now_ns()
        slot = 0
        while True:
            due_ns = start_ns + round(slot * self._period_ns)
            yield Moment(slot, due_ns, due_ns)
            passed = int((self.clock.now_ns() - start_ns) // self._period_ns)
            slot = max(slot, passed) + 1

    def steady(self) -> AbstractContextManager[object]:
        """Nothing to do without a screen."""
        return nullcontext()

    def show(self, number: int, drawn: Drawn, moment: Moment, begun_ns: int, enter: Callable[[str], None]) -> Presented:
        """Read the levels back, with what the operator lays over them."""
        drawn.levels = self.operator.laid_over(drawn.levels)
        return Presented(self.clock.now_ns())

    def idle(self) -> None:
        """Take in what the operator wishes."""
        self.operator.look()

    def summary(self, swaps: dict[str, Any]) -> dict[str, Any]:
        """There is no screen."""
        return {}
