"""When a screen swaps next, and how long before that a frame has to be begun."""

from __future__ import annotations

import math
from collections import deque

from hilstar.units import NS_PER_MS


class SwapClock:
    """The grid of moments at which a screen swaps: a phase and a period, fitted to measured time stamps.

    A second-order loop (Gardner, Phaselock Techniques, 2005): each swap pulls the phase by PHASE_SHARE of its error and the
    period by PERIOD_SHARE of it, damping 0.79; a swap that came whole periods late advances the phase by that many. With
    `paced_by_screen` false the grid is this program's own, and stamps do not move it.
    """

    PHASE_SHARE = 0.1
    PERIOD_SHARE = 0.004

    def __init__(self, first_ns: int, period_ns: float, paced_by_screen: bool) -> None:
        self.period_ns = period_ns
        self.paced_by_screen = paced_by_screen
        self._phase_ns = float(first_ns)

    def update(self, swap_ns: int) -> None:
        """Add the time of a swap."""
        if not self.paced_by_screen:
            return
        steps = round((swap_ns - self._phase_ns) / self.period_ns)
        if steps < 1:  # a swap that did not wait says nothing of the grid
            return
        error_ns = swap_ns - self._phase_ns - steps * self.period_ns
        self._phase_ns += steps * self.period_ns + self.PHASE_SHARE * error_ns
        self.period_ns += self.PERIOD_SHARE * error_ns / steps

    def next_after(self, host_ns: float) -> int:
        """The first moment of the grid at or after `host_ns`."""
        steps = math.ceil((host_ns - self._phase_ns) / self.period_ns)
        return round(self._phase_ns + steps * self.period_ns)


class DrawBudget:
    """How long before its swap a frame is begun: as late as recent frames allow, so that its attitude is fresh."""

    FRAMES = 120
    SLOW = 3  # the third slowest counts: two outliers in two seconds are late rather than all others early
    GUARD_NS = 1.0 * NS_PER_MS
    MORE = 1.25  # factor on the time that a driver was seen to need

    def __init__(self, period_ns: float, guard_ns: float = GUARD_NS) -> None:
        self._period_ns = period_ns
        self._costs_ns: deque[int] = deque(maxlen=self.FRAMES)
        self._late_leads_ns: deque[float] = deque(maxlen=self.SLOW)
        self._frames = 0
        self.guard_ns = guard_ns

    def add(self, cost_ns: int) -> None:
        """Add how long a frame took until it could be swapped."""
        self._costs_ns.append(cost_ns)

    def add_flip(self, lead_ns: float, late_ns: float) -> bool:
        """Add a flip that was `late_ns` after its moment, of a frame that was ready `lead_ns` before it.

        True where the guard is raised: the third in FRAMES frames that was ready in time and a refresh late.
        """
        self._frames += 1
        if self._frames >= self.FRAMES:
            self._frames = 0
            self._late_leads_ns.clear()
        if late_ns < self._period_ns / 2 or not 0 < lead_ns < self._period_ns / 2:
            return False
        self._late_leads_ns.append(lead_ns)
        if len(self._late_leads_ns) < self.SLOW:
            return False
        before_ns = self.guard_ns
        self.guard_ns = min(max(before_ns, self.MORE * sorted(self._late_leads_ns)[1]), self._period_ns / 2)
        self._late_leads_ns.clear()
        return self.guard_ns > before_ns

    @property
    def min_ns(self) -> float:
        """The shortest of the last frames: with less time left than that, a swap cannot be reached."""
        return min(self._costs_ns, default=0)

    @property
    def ns(self) -> float:
        """The time that all but two of the last frames took, and a guard; at most a period, and a whole period at first."""
        if len(self._costs_ns) < self.FRAMES // 4:
            return self._period_ns
        return min(sorted(self._costs_ns)[-self.SLOW] + self.guard_ns, self._period_ns)
