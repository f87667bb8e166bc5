"""How an operator and the window's state change the frames: reported when it changes, counted while it lasts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from hilstar.attitude.clock.timeline import Attitude
from hilstar.bench.frame import Bench
from hilstar.monitor.response import Codes
from hilstar.notices import Notices
from hilstar.render.aids import AidLevels
from hilstar.run.aids import Aids
from hilstar.run.desk import Desk, Wish
from hilstar.run.pacer import Operator
from hilstar.run.shown import HEADLESS, OnScreen
from hilstar.units import NS_PER_S

SKY_AGAIN = "the sky of the attitude again"


def always_seen() -> str:
    """Why the frames of a run without a window are hidden: they are not."""
    return ""


class Overrides(Operator):
    """Follows what lies over the sky, and why the window is hidden ("" where it is seen); `desk` has wishes from elsewhere."""

    def __init__(self, aids: Aids, notices: Notices, hidden: Callable[[], str] = always_seen, desk: Desk | None = None) -> None:
        self.aids = aids
        self._notices = notices
        self._hidden = hidden
        self._desk = Desk() if desk is None else desk
        self._told = HEADLESS
        self._held: tuple[Attitude, int] | None = None  # what a paused screen shows, and the time that it was for
        self._last_swap_ns: int | None = None
        self._frames = {"operator": 0, "hidden": 0}
        self._lasted_ns = {"operator": 0, "hidden": 0}

    @property
    def paused(self) -> bool:
        """Whether the operator has paused the sky."""
        return self.aids.paused

    def look(self) -> OnScreen:
        """The state of the switches and the window now; what has changed is told."""
        if self._desk.waiting:
            self._desk.act(self.aids, self._acted)
        now = OnScreen(self.aids.text, self._hidden(), self.aids.shows_sky)
        if now != self._told:
            before, self._told = self._told, now
            if now.operator != before.operator:
                self._notices.tell("operator", f"operator's keys: {now.operator or SKY_AGAIN}")
            if now.hidden != before.hidden:
                self._tell_hidden(now.hidden)
        return now

    def _acted(self, wish: Wish) -> None:
        shown = self.aids.text
        self._told = replace(self._told, operator=shown)
        self._notices.tell("operator", f"{wish.text}, by {wish.who}: {shown or SKY_AGAIN}", wish.who)

    def _tell_hidden(self, hidden: str) -> None:
        if hidden:
            self._notices.tell("hidden", f"the window is {hidden}: its frames are not fully visible")
        else:
            self._notices.tell("visible", "the window is visible again")

    def attitude(self, t_ns: int, attitude: Attitude | None) -> Attitude | None:
        """A frame's attitude after the keys: during a pause that of its start, which grows old; None where no sky is shown."""
        if not self.aids.paused:
            self._held = None if attitude is None else (attitude, t_ns)
        elif self._held is None:
            attitude = None
        else:
            held, held_t_ns = self._held
            attitude = replace(held, rate_cam_rad_s=None, age_ns=max(0, held.age_ns + t_ns - held_t_ns))
        return attitude if self.aids.shows_sky else None

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


def aid_levels_of(bench: Bench) -> AidLevels:
    """What aids are in a bench's levels."""
    x_px, y_px = bench.camera.boresight_px
    return AidLevels(bench.calibration.response, bench.config.monitor.bits, (round(x_px), round(y_px)))


class HeadlessOverrides(Overrides):
    """The operator of a run without a screen: the aids are laid over the levels themselves."""

    def __init__(self, bench: Bench, notices: Notices, desk: Desk | None = None) -> None:
        super().__init__(Aids(), notices, always_seen, desk)
        self._levels = aid_levels_of(bench)

    def laid_over(self, levels: Codes) -> Codes:
        """The levels with what the operator wants over them."""
        return self._levels.laid_over(levels, self.aids.overlay, self.aids.patch_share)
