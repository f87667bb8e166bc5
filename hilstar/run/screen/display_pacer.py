"""Frames at a display's own refresh: each begun as late as the last ones allow, for the first swap that it can reach."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from hilstar.bench.frame import Drawn
from hilstar.monitor.window.watch import presented_as
from hilstar.notices import Notices
from hilstar.process.scheduling import HOST_CLOCK, HostClock, steady_loop
from hilstar.run.operator import GAMMA, Operator, SwitchRequests
from hilstar.run.pacer import Moment, Pacer, Presented
from hilstar.run.screen.screen import Screen
from hilstar.units import NS_PER_MS, NS_PER_S

CHANGED = "another program changed the display's gamma ramp: codes make other light; stop it (night light, colord, redshift)"
log = logging.getLogger(__name__)


class DisplayPacer(Pacer):
    """Paces by a screen and shows frames on it; `stop` is set when its window closes."""

    moves_stars = True

    def __init__(
        self, screen: Screen, notices: Notices, clock: HostClock = HOST_CLOCK, requests: SwitchRequests | None = None
    ) -> None:
        operator = Operator(screen.aids, notices, lambda: screen.window.hidden, requests)
        super().__init__(screen.clock.period_ns, clock, operator)
        self.scheduling = "normal"
        self._screen = screen
        self._notices = notices
        self._gamma_frames, self._gamma_ns, self._last_swap_ns = 0, 0, 0

    def moments(self) -> Iterator[Moment]:
        """One for each swap that can still be reached."""
        swaps, budget, slot = self._screen.clock, self._screen.budget, 0
        due_ns = swaps.next_after(self.clock.now_ns() + budget.ns)
        while True:
            begin_ns = round(due_ns - budget.ns)
            yield Moment(slot, begin_ns, due_ns, swap_ns=due_ns, light_ns=due_ns + self._screen.swap_to_light_ns)
            following_ns = swaps.next_after(max(self.clock.now_ns() + budget.min_ns, due_ns + swaps.period_ns / 2))
            slot += max(1, round((following_ns - due_ns) / swaps.period_ns))
            due_ns = following_ns

    @contextmanager
    def steady(self) -> Iterator[None]:
        """Run this thread at real-time priority where that is allowed."""
        with steady_loop() as self.scheduling:
            if self.scheduling.startswith("normal"):
                log.warning("the frame loop runs at normal priority (%s)", self.scheduling.removeprefix("normal: "))
            yield

    def show(self, number: int, drawn: Drawn, moment: Moment, begun_ns: int, enter: Callable[[str], None]) -> Presented:
        """Put the frame on the screen at its moment."""
        enter("present")
        marker = self._screen.present(number)
        ready_ns, budget = self.clock.now_ns(), self._screen.budget
        budget.add(ready_ns - begun_ns)
        if moment.swap_ns is not None and not self._screen.clock.paced_by_screen:
            self.clock.wait_until(moment.swap_ns, self.stop)
        enter("swap")
        swap_ns = self._screen.swap()
        due_ns = moment.swap_ns
        if self._screen.clock.paced_by_screen and due_ns is not None and budget.add_flip(due_ns - ready_ns, swap_ns - due_ns):
            guard_ms = budget.guard_ns / NS_PER_MS
            self._notices.tell("guard-raised", f"the display's driver flips late: frames are ready {guard_ms:.2f} ms before")
        self._look_at_ramp(swap_ns)
        self._end_with_window()
        return Presented(swap_ns, self._screen.timestamp_source, marker)

    def _look_at_ramp(self, swap_ns: int) -> None:
        """Count a frame under another program's gamma ramp; tell of its beginning and its end."""
        if self._screen.window.ramp_changed:
            self._gamma_frames += 1
            self._gamma_ns += swap_ns - self._last_swap_ns if self._last_swap_ns else 0
            self._notices.begin(GAMMA, CHANGED)
        elif self._gamma_frames:
            self._notices.end(GAMMA, "gamma-straight", "the display's gamma ramp is straight again")
        self._last_swap_ns = swap_ns

    def _end_with_window(self) -> None:
        if self._screen.closing:
            self.stop.set()
        if self._screen.window.gone is not None:
            self._notices.begin("window-gone", f"{self._screen.window.gone}: the run ends")

    def idle(self) -> None:
        """Keep the window alive, and take in its keys."""
        self._screen.present(0)
        self._screen.swap()
        self.operator.look()
        self._end_with_window()

    def summary(self, swaps: dict[str, Any]) -> dict[str, Any]:
        """Where the times of swaps come from, scheduling, swaps, how long the sky was changed or hidden, and the output."""
        named: dict[str, Any] = {"timestamp_source": self._screen.timestamp_source, "scheduling": self.scheduling}
        named |= {"guard_ms": self._screen.budget.guard_ns / NS_PER_MS, "queued_frames": self._screen.queued}
        named |= swaps | self.operator.summary()
        named["gamma"] = {"frames": self._gamma_frames, "s": self._gamma_ns / NS_PER_S}
        shown = self._screen.window.presented
        output = self._screen.output
        return named | {"presented": presented_as(shown), "presented_frames": shown, "output": output and output.fields()}
