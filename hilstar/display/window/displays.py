"""Displays as the system describes them: their names, modes and refresh rates, and which of them is
meant. Nothing here asks the window system, so all of it holds without one.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self


@dataclass(frozen=True, slots=True)
class Display:
    """A monitor of this machine as the system describes it; `refresh_hz` is 0 where it does not say
    (Xvfb).

    `bits` per colour are those of its mode: the minimum of the three.
    """

    index: int
    name: str
    resolution_px: tuple[int, int]
    refresh_hz: int
    position_px: tuple[int, int]
    size_mm: tuple[int, int]
    scale: float
    bits: int

    def is_named(self, wanted: int | str) -> bool:
        """Whether `[monitor] display` means it: its index, or a part of its name."""
        return wanted == self.index or (
            isinstance(wanted, str) and wanted.lower() in self.name.lower()
        )

    def line(self) -> str:
        """The display for a person."""
        width, height = self.resolution_px
        if self.refresh_hz:
            refresh = f"{self.refresh_hz} Hz"
        else:
            refresh = "refresh not known"
        return (
            f"{self.index}: {self.name}, {width} x {height}, {refresh}, {self.size_mm[0]} x"
            f" {self.size_mm[1]} mm"
        )

    def rates_hz(self, modes: Iterable[Any]) -> tuple[int, ...]:
        """The refresh rates, rising, of those of GLFW's video `modes` that have this display's
        size; without those that the system does not say.
        """
        known_hz = set()
        for mode in modes:
            if (mode.size.width, mode.size.height) == self.resolution_px:
                known_hz.add(int(mode.refresh_rate))
        return tuple(sorted(known_hz - {0}))

    def refresh_for(self, wanted_hz: float | None, modes_hz: tuple[int, ...]) -> int:
        """The refresh to ask for, Hz: the one that is wanted where a mode has it, or else the one
        that the display has now; 0 where neither is known.

        Modes are named in whole Hz: 59.94 Hz is that of 60.
        """
        nearest_hz = round(wanted_hz or 0)
        if nearest_hz in modes_hz:
            return nearest_hz
        return self.refresh_hz

    def mirrored_by(self, displays: Iterable[Self]) -> str | None:
        """The name of another of these displays that shows the same part of the desktop; None
        where there is none.
        """
        for display in displays:
            is_other = display.name != self.name
            if is_other and display.position_px == self.position_px:
                return display.name
        return None


def display_of(
    index: int,
    name: Any,
    mode: Any,
    position_px: tuple[int, int],
    size_mm: tuple[int, int],
    scale: float,
) -> Display:
    """The display of a name as GLFW gives it, in a video mode of GLFW's."""
    return Display(
        index=index,
        name=name.decode() if isinstance(name, bytes) else str(name),
        resolution_px=(int(mode.size.width), int(mode.size.height)),
        refresh_hz=int(mode.refresh_rate),
        position_px=position_px,
        size_mm=size_mm,
        scale=scale,
        bits=int(min(mode.bits.red, mode.bits.green, mode.bits.blue)),
    )
