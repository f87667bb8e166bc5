"""The monitor's window: frames on it, their pacing by its refresh, the square that a photodiode
watches, and its keys.
"""

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock, steady_loop
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.display.render.backend import ScreenView
from hilstar.display.window.output_settings import OutputState
from hilstar.display.window.watch import presented_as
from hilstar.display.window.window import Window
from hilstar.server.bench.drawn import Drawn
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.monitor import orientation_of
from hilstar.server.operator import GAMMA, Aids, Operator, SwitchRequests
from hilstar.server.pacer import Moment, Pacer, Presented

HELP = "keys: q quit, b blank, space pause, c crosshair, g grid, t next test patch, h this line"
KEYS = {"b": "blank", "c": "crosshair", "g": "grid", "t": "patch", "space": "pause"}
# bits of the photodiode square: its light in any 7 successive frames tells which frames they are
CODE_BITS = 7
log = logging.getLogger(__name__)
CHANGED = (
    "another program changed the display's gamma ramp: codes make other light; stop it (night"
    " light, colord, redshift)"
)


def maximal_sequence() -> tuple[int, ...]:
    """The 127 bits of the shift register x^7 + x^6 + 1: any 7 in a row come once (Golomb, Shift
    Register Sequences, 1967).
    """
    state = 1
    bits = []
    for _ in range(2**CODE_BITS - 1):
        bits.append(state & 1)
        state = state >> 1 | ((state ^ state >> 1) & 1) << CODE_BITS - 1
    return tuple(bits)


CODE = maximal_sequence()


def marker_light(number: int, kind: str) -> int:
    """The square of a frame, 0 or 1: light in every other frame (`toggle`), or the bit of CODE at
    the frame's number.

    `toggle` gives a latency modulo two frames, `code` modulo 127 frames.
    """
    if kind == "toggle":
        return number % 2
    return CODE[number % len(CODE)]


class SwapClock:
    """The grid of moments at which a screen swaps: a phase and a period, fitted to measured time
    stamps.

    A second-order loop (Gardner, Phaselock Techniques, 2005): each swap pulls the phase by
    PHASE_SHARE of its error and the period by PERIOD_SHARE of it, damping 0.79; a swap that came
    whole periods late advances the phase by that many. With `paced_by_screen` false the grid is
    this program's own, and stamps do not move it.
    """

    PHASE_SHARE = 0.1
    PERIOD_SHARE = 0.004

    def __init__(self, first_ns: int, period_ns: float, paced_by_screen: bool) -> None:
        self.period_ns = period_ns
        self.paced_by_screen = paced_by_screen
        self._phase_ns = float(first_ns)

    @property
    def measured_hz(self) -> float | None:
        """The refresh rate of the screen; None where the grid is this program's own."""
        if not self.paced_by_screen:
            return None
        return NS_PER_S / self.period_ns

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
    """How long before its swap a frame is begun: as late as recent frames allow, so that its
    attitude is fresh.
    """

    FRAMES = 120
    # the third slowest counts: two outliers in two seconds are late rather than all others early
    SLOW = 3
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
        """Add a flip that was `late_ns` after its moment, of a frame that was ready `lead_ns`
        before it.

        True where the guard is raised: the third in FRAMES frames that was ready in time and a
        refresh late.
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
        self.guard_ns = min(
            max(before_ns, self.MORE * sorted(self._late_leads_ns)[1]), self._period_ns / 2
        )
        self._late_leads_ns.clear()
        return self.guard_ns > before_ns

    @property
    def min_ns(self) -> float:
        """The shortest of the last frames: with less time left than that, a swap cannot be
        reached.
        """
        return min(self._costs_ns, default=0)

    @property
    def ns(self) -> float:
        """The time that all but two of the last frames took, and a guard; at most a period, and
        a whole period at first.
        """
        if len(self._costs_ns) < self.FRAMES // 4:
            return self._period_ns
        return min(sorted(self._costs_ns)[-self.SLOW] + self.guard_ns, self._period_ns)


class Screen:
    """A window with a bench's frames on it.

    `clock` predicts its swaps, `budget` how early a frame has to be begun, and `swap_to_light_ns`
    is the time from a swap to the middle row's first light: half of the scan-out, the panel's own
    delay, and the frames `queued` in the driver. `output` is how the display's output was set when
    the gate was passed, None where that is not known; `forced` has what was wrong with the display
    or its monitor, and was shown by --force.
    """

    def __init__(self, window: Window, bench: Bench) -> None:
        monitor = bench.config.monitor
        self.window = window
        self.bench = bench
        self.output: OutputState | None = None
        self.forced: list[str] = []
        self.aids = Aids()
        self._flip_to_light_ns = round(
            (bench.scan.scanout_s / 2 * 1e3 + monitor.panel_delay_ms) * NS_PER_MS
        )
        self.keep_time(1000.0 / monitor.refresh_hz, False, time.monotonic_ns())
        self._quit = False
        view = ScreenView(
            resolution_px=monitor.resolution_px,
            screen_px=window.size_px,
            bits=monitor.bits,
            orientation=orientation_of(monitor),
            cross_px=bench.camera.boresight_px,
            triples=bench.calibration.response.rgb,
        )
        self._backend = bench.renderer
        self._backend.show_on(view)

    def keep_time(self, period_ms: float, by_screen: bool, swap_ns: int) -> None:
        """Predict swaps from the one at `swap_ns`, by the screen's own period where the screen
        keeps time.
        """
        if by_screen:
            period_ns = period_ms * NS_PER_MS
        else:
            period_ns = NS_PER_S / self.bench.config.monitor.refresh_hz
        self.clock = SwapClock(swap_ns, period_ns, by_screen)
        self.budget = DrawBudget(period_ns)
        self.queued = 0

    def keep_ahead(self, guard_ms: float, queued: int) -> None:
        """Have frames ready `guard_ms` before their swap; the driver holds `queued` of them back
        for a refresh each.
        """
        self.budget = DrawBudget(self.clock.period_ns, guard_ms * NS_PER_MS)
        self.queued = queued

    @property
    def swap_to_light_ns(self) -> int:
        """The time from a swap to the middle row's first light."""
        return self._flip_to_light_ns + round(self.queued * self.clock.period_ns)

    @property
    def closing(self) -> bool:
        """True once the window is to be closed."""
        return self.window.closing or self._quit

    @property
    def timestamp_source(self) -> str:
        """Where the times of swaps come from, and who paces them."""
        return self.window.timestamp_source + (
            "" if self.clock.paced_by_screen else ", software pacing"
        )

    def present(self, number: int) -> int | None:
        """Draw the bench's last frame on the back buffer; the photodiode square's light in frame
        `number`, None without one.
        """
        monitor = self.bench.config.monitor
        white = 2**monitor.bits - 1
        side_px = monitor.photodiode_px
        if side_px:
            marker = marker_light(number, monitor.photodiode)
        else:
            marker = None
        if self.window.gone is None:
            self._backend.present(
                self.aids.overlay,
                round(self.aids.patch_share * white),
                (side_px, white * (marker or 0)),
            )
        return marker

    def swap(self, timed: bool = True) -> int:
        """Swap what was presented, and take in keys; host time of the swap, ns, which moves the
        clock if `timed`.
        """
        swap_ns = self.window.swap(self._backend.take_back_buffer)
        if timed:
            self.clock.update(swap_ns)
        self.window.look_at_events()
        while self.window.keys:
            match self.window.keys.popleft():
                case "q" | "escape":
                    self._quit = True
                case "h" | "f1":
                    log.warning(HELP)
                case key if key in KEYS:
                    self.aids.toggle(KEYS[key])
        return swap_ns


class DisplayPacer(Pacer):
    """Paces by a screen and shows frames on it; `stop` is set when its window closes."""

    moves_stars = True

    def __init__(
        self,
        screen: Screen,
        notices: Notices,
        clock: HostClock = HOST_CLOCK,
        requests: SwitchRequests | None = None,
    ) -> None:
        operator = Operator(screen.aids, notices, lambda: screen.window.hidden, requests)
        super().__init__(screen.clock.period_ns, clock, operator)
        self.scheduling = "normal"
        self._screen = screen
        self._notices = notices
        self._gamma_frames = 0
        self._gamma_ns = 0
        self._last_swap_ns = 0

    def moments(self) -> Iterator[Moment]:
        """One for each swap that can still be reached."""
        swaps = self._screen.clock
        budget = self._screen.budget
        slot = 0
        due_ns = swaps.next_after(self.clock.now_ns() + budget.ns)
        while True:
            begin_ns = round(due_ns - budget.ns)
            yield Moment(
                slot,
                begin_ns,
                due_ns,
                swap_ns=due_ns,
                light_ns=due_ns + self._screen.swap_to_light_ns,
            )
            following_ns = swaps.next_after(
                max(self.clock.now_ns() + budget.min_ns, due_ns + swaps.period_ns / 2)
            )
            slot += max(1, round((following_ns - due_ns) / swaps.period_ns))
            due_ns = following_ns

    @contextmanager
    def steady(self) -> Iterator[None]:
        """Run this thread at real-time priority where that is allowed."""
        with steady_loop() as self.scheduling:
            if self.scheduling.startswith("normal"):
                log.warning(
                    "the frame loop runs at normal priority (%s)",
                    self.scheduling.removeprefix("normal: "),
                )
            yield

    def show(
        self, number: int, drawn: Drawn, moment: Moment, begun_ns: int, enter: Callable[[str], None]
    ) -> Presented:
        """Put the frame on the screen at its moment."""
        enter("present")
        marker = self._screen.present(number)
        ready_ns = self.clock.now_ns()
        budget = self._screen.budget
        budget.add(ready_ns - begun_ns)
        if moment.swap_ns is not None and not self._screen.clock.paced_by_screen:
            self.clock.wait_until(moment.swap_ns, self.stop)
        enter("swap")
        swap_ns = self._screen.swap()
        due_ns = moment.swap_ns
        if (
            self._screen.clock.paced_by_screen
            and due_ns is not None
            and budget.add_flip(due_ns - ready_ns, swap_ns - due_ns)
        ):
            guard_ms = budget.guard_ns / NS_PER_MS
            self._notices.tell(
                "guard-raised",
                f"the display's driver flips late: frames are ready {guard_ms:.2f} ms before",
            )
        self._look_at_ramp(swap_ns)
        self._end_with_window()
        return Presented(swap_ns, self._screen.timestamp_source, marker)

    def _look_at_ramp(self, swap_ns: int) -> None:
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
        """Where the times of swaps come from, scheduling, swaps, how long the sky was changed or
        hidden, and the output.
        """
        named: dict[str, Any] = {
            "timestamp_source": self._screen.timestamp_source,
            "scheduling": self.scheduling,
        }
        named |= {
            "guard_ms": self._screen.budget.guard_ns / NS_PER_MS,
            "queued_frames": self._screen.queued,
        }
        named |= swaps | self.operator.summary()
        named["gamma"] = {"frames": self._gamma_frames, "s": self._gamma_ns / NS_PER_S}
        shown = self._screen.window.presented
        output = self._screen.output
        named |= {
            "presented": presented_as(shown),
            "presented_frames": shown,
            "forced": self._screen.forced,
        }
        return named | {"output": output and output.fields()}
