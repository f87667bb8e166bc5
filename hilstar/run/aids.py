"""What lies over the sky of a run, and whether it stands still: set by the keys at the display or from the operator's page."""

from __future__ import annotations

from hilstar.render.aids import BLANK, CROSSHAIR, GRID, PATCH

PATCHES = (0.0, 0.25, 0.5, 0.75, 1.0)  # of white
_BITS = {"blank": BLANK, "grid": GRID, "crosshair": CROSSHAIR}
SWITCHES = ("blank", "pause", "patch", "crosshair", "grid")


class Aids:
    """The state of the switches; written by the frame loop's thread alone."""

    def __init__(self) -> None:
        self.paused = False
        self._overlay = 0
        self._patch = -1

    @property
    def overlay(self) -> int:
        """The bits of `render.aids` that are on."""
        return self._overlay | (PATCH if self._patch >= 0 else 0)

    @property
    def patch_share(self) -> float:
        """The patch's part of white; 0 without one."""
        return PATCHES[self._patch] if self._patch >= 0 else 0.0

    @property
    def shows_sky(self) -> bool:
        """False under a blank or a test patch."""
        return not self._overlay & BLANK and self._patch < 0

    @property
    def text(self) -> str:
        """What is changed of the sky, such as "grid, pause"; "" for nothing."""
        on = [name for name, bit in _BITS.items() if self._overlay & bit]
        if self._patch >= 0:
            on.append(f"patch {PATCHES[self._patch]:.0%}")
        return ", ".join([*on, "pause"] if self.paused else on)

    def states(self) -> dict[str, bool]:
        """Which switches are on, by their names."""
        return {name: self.is_on(name) for name in SWITCHES}

    def is_on(self, name: str) -> bool:
        """Whether a switch is on."""
        if name == "pause":
            return self.paused
        return self._patch >= 0 if name == "patch" else bool(self._overlay & _BITS[name])

    def set(self, name: str, on: bool, share: float = 1.0) -> None:
        """Turn a switch; a patch shows the nearest to `share` of white."""
        if name == "pause":
            self.paused = on
        elif name == "patch":
            self._patch = min(range(len(PATCHES)), key=lambda k: abs(PATCHES[k] - share)) if on else -1
        else:
            self._overlay = self._overlay | _BITS[name] if on else self._overlay & ~_BITS[name]

    def toggle(self, name: str) -> None:
        """Turn a switch over; a patch goes on to the next, and after the last to none."""
        if name == "patch":
            self._patch = self._patch + 1 if self._patch + 1 < len(PATCHES) else -1
        else:
            self.set(name, not self.is_on(name))
