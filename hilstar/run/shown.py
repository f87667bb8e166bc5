"""A frame of a run after it has been shown: what it was, when, and whether it could be seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hilstar.attitude.clock.timeline import Attitude
from hilstar.bench.frame import Drawn
from hilstar.frame.fault_kinds import Now


@dataclass(frozen=True, slots=True)
class OnScreen:
    """What changes a frame on the screen: an operator's keys ("" for none), and why it is hidden ("" if it is not).

    `sky` is false where the keys leave no sky at all.
    """

    operator: str = ""
    hidden: str = ""
    sky: bool = True


HEADLESS = OnScreen()


@dataclass(frozen=True, slots=True)
class Shown:
    """One frame of a run: its number, its time on the timeline, its attitude (None: blank) and what was drawn.

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
    faults: tuple[Now, ...] = ()


FrameSink = Callable[[Shown], None]


def ignore(shown: Shown) -> None:
    """The sink of a run whose frames are not used."""
