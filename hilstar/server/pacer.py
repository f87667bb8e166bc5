"""Pacing: when each frame of a run is to be begun, when its light leaves, and how it was shown.

A pacer hands the frame loop one moment after another. `Pacer` keeps a grid of this host's clock,
for a run without a screen; `DisplayPacer` (`screen/screen.py`) follows a display's refresh.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.optics.layers.fault_kinds import Now
from hilstar.server.bench.drawn import Drawn
from hilstar.server.operator import HEADLESS, Aids, OnScreen, Operator


@dataclass(frozen=True, slots=True)
class Moment:
    """When a frame is to be shown; host times, ns.

    It is begun at `begin_ns` and late after `due_ns` (None: never late). `swap_ns` is its predicted
    swap onto a screen, and `light_ns` when its middle row lights (None: as soon as it is begun).
    The pacer gives all of these; the frame loop counts `missed_before`, the refresh periods just
    before it without a frame of their own, and whether it `may_be_given_up`.
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
        if self.light_ns is None:
            return host_ns
        return self.light_ns

    def lit_at(self, light_ns: int) -> "Moment":
        """The same moment, with when the frame's light leaves: the time of its attitude."""
        return replace(self, light_ns=light_ns)

    def lit_on_grid(self) -> "Moment":
        """The same moment, of a log's frame: its time is the grid's, however late it is begun."""
        return self if self.starts_ns is None else self.lit_at(self.starts_ns)

    @property
    def starts_ns(self) -> int | None:
        """When the frame starts where that is known before it is drawn: paced, and without a
        screen's swap to wait for.
        """
        return self.due_ns if self.swap_ns is None else None


AT_ONCE = Moment()


@dataclass(frozen=True, slots=True)
class Presented:
    """How a frame was shown: when (host time, ns), by which clock, and the photodiode square's
    light in it.
    """

    swap_ns: int
    timestamp_source: str = "headless"
    marker: int | None = None


@dataclass(frozen=True, slots=True)
class Shown:
    """One frame of a run: its number, its time on the timeline, its attitude (None: blank) and what
    was drawn.

    Host times, ns: `draw_ns` when drawing began, `predicted_swap_ns` and `swap_ns` when the frame
    was to be swapped onto the screen and when it was; headless, with nothing predicted, when its
    levels were ready. `missed_before` counts the refresh periods just before it that had no frame
    of their own, and `marker` is the photodiode square's light, 0 or 1. `missing` is true where no
    attitude has come yet; `attitude` is None too where an operator's key hides the sky. `light_ns`
    is the time of its attitude, None where that is `draw_ns`. `fades`: without a screen, paced, and
    no fault dropped the frame before (see `light_times`).
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
    faults: tuple[Now, ...] = ()
    light_ns: int | None = None
    fades: bool = False

    @property
    def moment_ns(self) -> int:
        """The host time of its attitude: of a frame without a screen, what it is a sample of."""
        return self.draw_ns if self.light_ns is None else self.light_ns


FrameSink = Callable[[Shown], None]


def ignore(shown: Shown) -> None:
    """The sink of a run whose frames are not used."""


class Pacer:
    """Says when frames are due, and shows them: here at a steady rate of the host's clock, their
    levels read back.

    `stop` is set to end the run. `moves_stars`: whether stars move within a frame, as where rows of
    a screen light one by one.
    """

    moves_stars = False

    def __init__(
        self, period_ns: float, clock: HostClock = HOST_CLOCK, operator: Operator | None = None
    ) -> None:
        self.clock = clock
        self.stop = threading.Event()
        self.operator = Operator(Aids(), Notices()) if operator is None else operator
        self._period_ns = period_ns

    def moments(self) -> Iterator[Moment]:
        """The moments of a run, without end, each the first that can be reached when it is asked
        for.

        One each period from now on; those already past when the next is asked for are skipped.
        """
        start_ns = self.clock.now_ns()
        slot = 0
        while True:
            due_ns = start_ns + round(slot * self._period_ns)
            yield Moment(slot, due_ns, due_ns)
            passed = int((self.clock.now_ns() - start_ns) // self._period_ns)
            slot = max(slot, passed) + 1

    def steady(self) -> AbstractContextManager[object]:
        """A context in which frames have priority over other work; without a screen it does
        nothing.
        """
        return nullcontext()

    def show(
        self, number: int, drawn: Drawn, moment: Moment, begun_ns: int, enter: Callable[[str], None]
    ) -> Presented:
        """Show a frame that was begun at `begun_ns`; `enter` is called with the name of each
        stage.
        """
        drawn.levels = self.operator.laid_over(drawn.levels)
        return Presented(self.clock.now_ns())

    def idle(self) -> None:
        """Take in what the operator wishes while no frame is due."""
        self.operator.look()

    def summary(self, swaps: dict[str, Any]) -> dict[str, Any]:
        """What the run's summary says of the screen and its `swaps`; {} without a screen."""
        return {}
