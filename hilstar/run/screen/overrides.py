"""How an operator's keys and the window's state change the frames: reported when it changes, counted while it lasts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from hilstar.attitude.clock.timeline import Attitude
from hilstar.notices import Notices
from hilstar.run.pacer import Operator
from hilstar.run.screen.screen import Screen
from hilstar.run.shown import HEADLESS, OnScreen
from hilstar.units import NS_PER_S


class Overrides(Operator):
    """Follows a screen's keys and window."""

    def __init__(self, screen: Screen, notices: Notices) -> None:
        self._screen = screen
        self._notices = notices
        self._told = HEADLESS
        self._held: tuple[Attitude, int] | None = None  # what a paused screen shows, and the time that it was for
        self._last_swap_ns: int | None = None
        self._frames = {"operator": 0, "hidden": 0}
        self._lasted_ns = {"operator": 0, "hidden": 0}

    @property
    def paused(self) -> bool:
        """Whether the operator has paused the sky."""
        return self._screen.paused

    def look(self) -> OnScreen:
        """The state of the keys and the window now; what has changed is told."""
        screen = self._screen
        now = OnScreen(screen.operator, screen.window.hidden, screen.shows_sky)
        if now != self._told:
            before, self._told = self._told, now
            if now.operator != before.operator:
                self._notices.tell("operator", f"operator's keys: {now.operator or 'the sky of the attitude again'}")
            if now.hidden != before.hidden:
                self._tell_hidden(now.hidden)
        return now

    def _tell_hidden(self, hidden: str) -> None:
        if hidden:
            self._notices.tell("hidden", f"the window is {hidden}: its frames are not fully visible")
        else:
            self._notices.tell("visible", "the window is visible again")

    def attitude(self, t_ns: int, attitude: Attitude | None) -> Attitude | None:
        """A frame's attitude after the keys: during a pause that of its start, which grows old; None where no sky is shown."""
        screen = self._screen
        if not screen.paused:
            self._held = None if attitude is None else (attitude, t_ns)
        elif self._held is None:
            attitude = None
        else:
            held, held_t_ns = self._held
            attitude = replace(held, rate_cam_rad_s=None, age_ns=max(0, held.age_ns + t_ns - held_t_ns))
        return attitude if screen.shows_sky else None

    def count(self, shown: OnScreen, swap_ns: int) -> None:
        """Count a frame by how it was shown."""
        since_ns = 0 if self._last_swap_ns is None else swap_ns - self._last_swap_ns
        self._last_swap_ns = swap_ns
        for name, lasts in (("operator", shown.operator), ("hidden", shown.hidden)):
            if lasts:
                self._frames[name] += 1
                self._lasted_ns[name] += since_ns

    def summary(self) -> dict[str, Any]:
        """How many frames an operator's keys changed or a hidden window kept from view, and for how long, s."""
        return {name: {"frames": self._frames[name], "s": self._lasted_ns[name] / NS_PER_S} for name in self._frames}
