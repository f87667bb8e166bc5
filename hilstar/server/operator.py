"""The operator of a run: switches over the sky (keys at the display, the page), who asks for them,
and what they change.

The frame loop turns switches and counts the frames that they change. Other threads ask through a
queue of `SwitchRequest`.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_S
from hilstar.display.render.aids import BLANK, CROSSHAIR, GRID, PATCH, AidLevels
from hilstar.display.response import Levels

PATCHES = (0.0, 0.25, 0.5, 0.75, 1.0)  # shares of white
_BITS = {"blank": BLANK, "grid": GRID, "crosshair": CROSSHAIR}
SWITCHES = ("blank", "pause", "patch", "crosshair", "grid")
GAMMA = "gamma"  # the kind of event while another program's gamma ramp lies on the display
SKY_AGAIN = "the sky of the attitude again"


class Aids:
    """Switches that cover or stop the sky. Written by the frame loop's thread alone."""

    def __init__(self) -> None:
        self.paused = False
        self._overlay = 0
        self._patch = -1

    @property
    def overlay(self) -> int:
        """Bits of `render.aids` that are on."""
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
        """Switches that are on, such as "grid, pause"; "" for none."""
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
        if name == "patch":
            return self._patch >= 0
        return bool(self._overlay & _BITS[name])

    def set(self, name: str, on: bool, share: float = 1.0) -> None:
        """Turn a switch; a patch shows the nearest to `share` of white."""
        if name == "pause":
            self.paused = on
        elif name == "patch":
            self._patch = (
                min(range(len(PATCHES)), key=lambda k: abs(PATCHES[k] - share)) if on else -1
            )
        else:
            self._overlay = self._overlay | _BITS[name] if on else self._overlay & ~_BITS[name]

    def toggle(self, name: str) -> None:
        """Toggle a switch. The patch steps through PATCHES, then turns off."""
        if name == "patch":
            self._patch = self._patch + 1 if self._patch + 1 < len(PATCHES) else -1
        else:
            self.set(name, not self.is_on(name))


@dataclass(eq=False, slots=True)
class SwitchRequest:
    """A request to turn one switch of `Aids`, and who asks. The frame loop sets `done`;
    `called_off` withdraws it.
    """

    name: str
    on: bool
    who: str
    share: float = 1.0
    called_off: bool = False
    done: bool = False

    @property
    def text(self) -> str:
        """The request in words, such as "blank on"."""
        return f"{self.name} {'on' if self.on else 'off'}"


# from any thread; the frame loop empties it once a frame and never waits
SwitchRequests = deque[SwitchRequest]


@dataclass(frozen=True, slots=True)
class OnScreen:
    """What changes a frame on the screen: an operator's keys ("" for none), and why it is hidden
    ("" if it is not).

    `sky` is false where the keys leave no sky at all.
    """

    operator: str = ""
    hidden: str = ""
    sky: bool = True


HEADLESS = OnScreen()


class Operator:
    """What covers the sky, and why the window is `hidden` ("" where it is visible, and without
    one).

    `requests` come from other threads. Without a screen, the aids are drawn into the `levels`.
    """

    def __init__(
        self,
        aids: Aids,
        notices: Notices,
        hidden: Callable[[], str] = str,
        requests: SwitchRequests | None = None,
        levels: AidLevels | None = None,
    ) -> None:
        self.aids = aids
        self._notices = notices
        self._hidden = hidden
        self._levels = levels
        self._requests = deque() if requests is None else requests
        self._told = HEADLESS
        # what a paused screen shows, and the time that it was for
        self._held: tuple[Attitude, int] | None = None
        self._last_swap_ns: int | None = None
        self._frames = {"operator": 0, "hidden": 0}
        self._lasted_ns = {"operator": 0, "hidden": 0}

    def look(self) -> OnScreen:
        """State of the switches and the window now, once what was requested is done. Reports
        what has changed.
        """
        while self._requests:
            request = self._requests.popleft()
            if not request.called_off:
                self.aids.set(request.name, request.on, request.share)
                shown = self.aids.text
                self._told = replace(self._told, operator=shown)
                self._notices.tell(
                    "operator",
                    f"{request.text}, by {request.who}: {shown or SKY_AGAIN}",
                    request.who,
                )
                request.done = True
        now = OnScreen(self.aids.text, self._hidden(), self.aids.shows_sky)
        if now != self._told:
            before = self._told
            self._told = now
            if now.operator != before.operator:
                self._notices.tell("operator", f"operator's keys: {now.operator or SKY_AGAIN}")
            if now.hidden and now.hidden != before.hidden:
                self._notices.tell(
                    "hidden", f"the window is {now.hidden}: its frames are not fully visible"
                )
            elif before.hidden and not now.hidden:
                self._notices.tell("visible", "the window is visible again")
        return now

    def attitude(self, t_ns: int, attitude: Attitude | None) -> Attitude | None:
        """Attitude to show: during a pause the one of its start, with a growing age; None where
        no sky is shown.
        """
        if not self.aids.paused:
            self._held = None if attitude is None else (attitude, t_ns)
        elif self._held is None:
            attitude = None
        else:
            held, held_t_ns = self._held
            attitude = replace(
                held, rate_cam_rad_s=None, age_ns=max(0, held.age_ns + t_ns - held_t_ns)
            )
        return attitude if self.aids.shows_sky else None

    def laid_over(self, levels: Levels) -> Levels:
        """The levels of a frame that no screen changes, with the aids over them."""
        if self._levels is None:
            return levels
        return self._levels.laid_over(levels, self.aids.overlay, self.aids.patch_share)

    def count(self, shown: OnScreen, swap_ns: int) -> None:
        """Count a frame by how it was shown."""
        if self._last_swap_ns is None:
            since_ns = 0
        else:
            since_ns = swap_ns - self._last_swap_ns
        self._last_swap_ns = swap_ns
        for name, lasts in (("operator", shown.operator), ("hidden", shown.hidden)):
            if lasts:
                self._frames[name] += 1
                self._lasted_ns[name] += since_ns

    def summary(self) -> dict[str, Any]:
        """Frames changed by the operator and frames hidden by the window: count, and duration in
        s.
        """
        return {
            name: {"frames": self._frames[name], "s": self._lasted_ns[name] / NS_PER_S}
            for name in self._frames
        }
