"""The monitor's window: frames, keys, and a gate that refuses a display whose timing cannot be trusted."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import open_bench
from hilstar.bench.frame import Bench
from hilstar.bench.orientation import orientation_of
from hilstar.errors import MachineError
from hilstar.monitor.window.window import Window, WindowSettings
from hilstar.render.presenter import BLANK, CROSSHAIR, GRID, PATCH, Presenter, View, window_context
from hilstar.run.screen.photodiode import marker_light
from hilstar.run.screen.swap_clock import DrawBudget, SwapClock
from hilstar.units import NS_PER_MS, NS_PER_S

GATE_FRAMES = 120
REFRESH_TOLERANCE = 0.01
DROPPED = 1.5  # periods
MAX_DROPPED = 2  # of GATE_FRAMES: a desktop that is still busy with the new window
HELP = "keys: q quit, b blank, space pause, c crosshair, g grid, t next test patch, h this line"
UNPACED = 0.1  # of the period that the system knows of: swaps faster by more do not wait for it
PATCHES = (0.0, 0.25, 0.5, 0.75, 1.0)  # of white
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Timing:
    """What the gate measured: the median period, how many frames were dropped, and whether the screen itself keeps time."""

    period_ms: float
    dropped: int
    paced_by_screen: bool


class Screen:
    """A window with a bench's frames on it.

    `clock` predicts its swaps, `budget` how early a frame has to be begun, and `swap_to_light_ns` is the time from a swap to
    the middle row's first light: half of the scan-out, and the panel's own delay.
    """

    def __init__(self, window: Window, bench: Bench) -> None:
        monitor = bench.config.monitor
        self.window = window
        self.bench = bench
        self.paused = False
        self.timing = Timing(1000.0 / monitor.refresh_hz, 0, False)
        self.swap_to_light_ns = round((bench.scan.scanout_s / 2 * 1e3 + monitor.panel_delay_ms) * NS_PER_MS)
        self._start_clock(time.monotonic_ns())
        self._overlay = 0
        self._patch = -1
        view = View(
            resolution_px=monitor.resolution_px,
            screen_px=window.size_px,
            bits=monitor.bits,
            orientation=orientation_of(monitor),
            cross_px=bench.camera.principal_point_px,
            triples=bench.calibration.response.rgb,
        )
        self._presenter = Presenter(bench.renderer.codes_texture, view)

    def _start_clock(self, swap_ns: int) -> None:
        wanted_ns = NS_PER_S / self.bench.config.monitor.refresh_hz
        by_screen = self.timing.paced_by_screen
        period_ns = self.timing.period_ms * NS_PER_MS if by_screen else wanted_ns
        self.clock = SwapClock(swap_ns, period_ns, by_screen)
        self.budget = DrawBudget(period_ns)

    @property
    def closing(self) -> bool:
        """True once the window is to be closed."""
        return self.window.closing or self._quit

    _quit = False

    @property
    def timestamp_source(self) -> str:
        """Where the times of swaps come from, and who paces them."""
        return self.window.timestamp_source + ("" if self.timing.paced_by_screen else ", software pacing")

    def present(self, number: int) -> int | None:
        """Draw the bench's last frame on the back buffer; the photodiode square's light in frame `number`, None without one."""
        monitor = self.bench.config.monitor
        white = 2**monitor.bits - 1
        code = round(PATCHES[self._patch] * white) if self._patch >= 0 else 0
        overlay = self._overlay | (PATCH if self._patch >= 0 else 0)
        side_px = monitor.photodiode_px
        marker = marker_light(number, monitor.photodiode) if side_px else None
        self._presenter.present(overlay, code, (side_px, white * (marker or 0)))
        return marker

    def swap(self) -> int:
        """Swap what was presented onto the screen, and take in keys; host time of the swap, ns."""
        swap_ns = self.window.swap(self._presenter.wait)
        self.clock.update(swap_ns)
        self.window.look_at_events()
        while self.window.keys:
            self._press(self.window.keys.popleft())
        return swap_ns

    @property
    def shows_sky(self) -> bool:
        """False where an operator's key leaves no sky: under a blank or a test patch."""
        return not self._overlay & BLANK and self._patch < 0

    @property
    def operator(self) -> str:
        """What an operator's keys change of the sky, such as "grid, pause"; "" for nothing."""
        names = {BLANK: "blank", GRID: "grid", CROSSHAIR: "crosshair"}
        on = [name for bit, name in names.items() if self._overlay & bit]
        if self._patch >= 0:
            on.append(f"patch {PATCHES[self._patch]:.0%}")
        return ", ".join([*on, "pause"] if self.paused else on)

    def _press(self, key: str) -> None:
        match key:
            case "q" | "escape":
                self._quit = True
            case "b":
                self._overlay ^= BLANK
            case "c":
                self._overlay ^= CROSSHAIR
            case "g":
                self._overlay ^= GRID
            case "t":
                self._patch = self._patch + 1 if self._patch + 1 < len(PATCHES) else -1
            case "space":
                self.paused = not self.paused
            case "h" | "f1":
                log.warning(HELP)

    def pass_gate(self, force: bool) -> None:
        """Measure GATE_FRAMES swaps and refuse (MachineError) a display that is not as the bench file has it.

        With `force` a fault is only logged.
        """
        self.bench.draw(None)
        times = np.array([self._gate_frame(number) for number in range(GATE_FRAMES + 1)])
        periods_ms = np.diff(times) / NS_PER_MS
        wanted_ms = 1000.0 / self.bench.config.monitor.refresh_hz
        period_ms = float(np.median(periods_ms))
        known_hz = 0 if self.window.display is None else self.window.display.refresh_hz
        # A display whose swaps come faster than any refresh does not wait for one: nothing keeps time but this program.
        on_time = abs(period_ms / wanted_ms - 1) < REFRESH_TOLERANCE
        by_screen = period_ms >= 1000.0 / known_hz * (1 - UNPACED) if known_hz else on_time
        self._waits = by_screen or not known_hz
        self.timing = Timing(period_ms, int((periods_ms > DROPPED * wanted_ms).sum()), by_screen)
        self._start_clock(int(times[-1]))
        if not by_screen:
            log.warning("the display has no refresh of its own (swaps take %.2f ms): frames are paced by software", period_ms)
        if self.window.gone is not None:
            raise MachineError(self.window.gone)
        for fault in self._faults(wanted_ms):
            if not force:
                raise MachineError(f"{fault}; or add --force")
            log.warning("%s: shown anyway (--force)", fault)

    _waits = True

    def _gate_frame(self, number: int) -> int:
        self.present(number)
        return self.swap()

    def _faults(self, wanted_ms: float) -> Iterator[str]:
        monitor, timing = self.bench.config.monitor, self.timing
        wanted_px = orientation_of(monitor).screen_px(monitor.resolution_px)
        if self.window.size_px != wanted_px:
            (width, height), (wide, high) = self.window.size_px, wanted_px
            sizes = f"{width} x {height} px and the bench file says {wide} x {high}"
            yield f"the display is {sizes}; set [monitor] resolution_px, or the display's mode"
        if self.window.composited:
            yield "a compositing manager draws this display and may hold frames back; stop it, or use a plain X session"
        if self.window.mirrored is not None:
            advice = "switch it off, or place it beside this one (xrandr --right-of)"
            yield f"the display {self.window.mirrored} mirrors this one; {advice}"
        if self.window.scaled:
            yield "the display is scaled by its desktop; set its scale to 100 %"
        if timing.paced_by_screen and abs(timing.period_ms / wanted_ms - 1) > REFRESH_TOLERANCE:
            hz = f"{1000.0 / timing.period_ms:.2f} Hz and the bench file says {monitor.refresh_hz:g}"
            yield f"the display refreshes at {hz}; set [monitor] refresh_hz, or the display's mode"
        if timing.paced_by_screen and timing.dropped > MAX_DROPPED:
            yield f"the display dropped {timing.dropped} of {GATE_FRAMES} frames; close other programs that draw on it"
        if not self._waits:
            yield "swaps do not wait for the display's refresh; switch vertical sync on in its driver"
        depth = self.window.depth_bits
        if depth < monitor.bits:
            depths = f"{depth} bits per colour and the bench file says {monitor.bits}"
            yield f"the window has {depths}; set [monitor] bits, or a deeper mode"


@contextmanager
def open_screen(file: BenchFile, *, windowed: bool, force: bool) -> Iterator[Screen]:
    """The bench of a file on its display, past the gate. Raises InputError or MachineError."""
    monitor = file.config.monitor
    display = None if windowed else monitor.display
    settings = WindowSettings(orientation_of(monitor).screen_px(monitor.resolution_px), monitor.bits, display)
    with Window(settings) as window, open_bench(file, window_context()) as bench:
        screen = Screen(window, bench)
        bench.warm_up()
        screen.pass_gate(force)
        yield screen
