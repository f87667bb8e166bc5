"""The bench's window: frames on it, keys from it, and a gate that refuses a display whose timing cannot be trusted."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.attitude.clock import NS_PER_S
from hilstar.bench.assembly import Bench
from hilstar.bench.config import Monitor, read_config
from hilstar.errors import MachineError
from hilstar.monitor.window import Window, WindowSettings
from hilstar.render.presenter import BLANK, CROSSHAIR, GRID, PATCH, Mount, Presenter, View, window_context

GATE_FRAMES = 120
REFRESH_TOLERANCE = 0.01
DROPPED = 1.5  # periods
MOST_DROPPED = 2  # of GATE_FRAMES: a desktop that is still busy with the new window
HELP = "keys: q quit, b blank, space pause, c crosshair, g grid, t next test patch, h this line"
PATCHES = (0.0, 0.25, 0.5, 0.75, 1.0)  # of white
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Timing:
    """What the gate saw: the median period, how many frames were late, and whether the screen itself keeps time."""

    period_ms: float
    dropped: int
    paced_by_screen: bool


class Screen:
    """A window with a bench's frames on it."""

    def __init__(self, window: Window, bench: Bench) -> None:
        monitor = bench.config.monitor
        self.window = window
        self.bench = bench
        self.paused = False
        self.timing = Timing(1000.0 / monitor.refresh_hz, 0, False)
        self._overlay = 0
        self._patch = -1
        self._shown = 0
        view = View(
            resolution_px=monitor.resolution_px,
            screen_px=window.size_px,
            bits=monitor.bits,
            mount=mount_of(monitor),
            cross_px=bench.camera.principal_point_px,
            triples=bench.calibration.response.rgb,
        )
        self._presenter = Presenter(bench.renderer.codes_texture, view)

    @property
    def closing(self) -> bool:
        """True once the window is to be closed."""
        return self.window.closing or self._quit

    _quit = False

    def show(self) -> int:
        """Put the bench's last frame on the monitor; the host's time after the swap, ns."""
        monitor = self.bench.config.monitor
        white = 2**monitor.bits - 1
        code = round(PATCHES[self._patch] * white) if self._patch >= 0 else 0
        overlay = self._overlay | (PATCH if self._patch >= 0 else 0)
        self._shown += 1
        marker = (monitor.photodiode_px, white if self._shown % 2 else 0)
        self._presenter.present(overlay, code, marker)
        swap_ns = self.window.swap()
        while self.window.keys:
            self._press(self.window.keys.popleft())
        return swap_ns

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
        """Measure GATE_FRAMES swaps and refuse (MachineError) a display that is not what the bench file says.

        With `force` what is wrong is only logged.
        """
        self.bench.draw(None)
        times = np.array([self.show() for _ in range(GATE_FRAMES + 1)])
        periods_ms = np.diff(times) / 1e6
        wanted_ms = 1000.0 / self.bench.config.monitor.refresh_hz
        period_ms = float(np.median(periods_ms))
        known_hz = 0 if self.window.display is None else self.window.display.refresh_hz
        # Without a refresh that the system knows of, and with swaps that do not wait, nothing keeps time but this program.
        by_screen = known_hz > 0 or abs(period_ms / wanted_ms - 1) < REFRESH_TOLERANCE
        self.timing = Timing(period_ms, int((periods_ms > DROPPED * wanted_ms).sum()), by_screen)
        if not by_screen:
            log.warning("the display has no refresh of its own (swaps take %.2f ms): frames are paced by software", period_ms)
        for fault in self._faults(wanted_ms):
            if not force:
                raise MachineError(f"{fault}; or add --force")
            log.warning("%s: shown all the same (--force)", fault)

    def _faults(self, wanted_ms: float) -> Iterator[str]:
        monitor, timing = self.bench.config.monitor, self.timing
        wanted_px = mount_of(monitor).screen_px(monitor.resolution_px)
        if self.window.size_px != wanted_px:
            (width, height), (wide, high) = self.window.size_px, wanted_px
            yield f"the display is {width} x {height} px and the bench {wide} x {high}; set [monitor] resolution_px or its mode"
        if self.window.scaled:
            yield "the display is scaled by its desktop; set its scale to 100 %"
        if timing.paced_by_screen and abs(timing.period_ms / wanted_ms - 1) > REFRESH_TOLERANCE:
            hz = f"{1000.0 / timing.period_ms:.2f} Hz and the bench says {monitor.refresh_hz:g}"
            yield f"the display refreshes at {hz}; set [monitor] refresh_hz or its mode"
        if timing.paced_by_screen and timing.dropped > MOST_DROPPED:
            yield f"the display dropped {timing.dropped} of {GATE_FRAMES} frames; close what else draws on it"
        depth = self.window.depth_bits
        if depth < monitor.bits:
            yield f"the window has {depth} bits a colour and the bench says {monitor.bits}; set [monitor] bits or a deeper mode"

    def period_ns(self) -> float:
        """From frame to frame: the screen's own where it keeps time, else the bench file's."""
        wanted = NS_PER_S / self.bench.config.monitor.refresh_hz
        return self.timing.period_ms * 1e6 if self.timing.paced_by_screen else wanted

    def lead_ns(self, draw_to_swap_ns: float) -> int:
        """From now to the moment of light of the middle row: drawing, half of the scan-out, and the panel's own delay."""
        panel_ns = self.bench.config.monitor.panel_delay_ms * 1e6
        return round(draw_to_swap_ns + self.period_ns() / 2 + panel_ns)


def mount_of(monitor: Monitor) -> Mount:
    """How the bench file says that the image lies on the screen."""
    return Mount(monitor.flip_x, monitor.flip_y, monitor.rotate_deg // 90)


@contextmanager
def open_screen(path: Path, *, windowed: bool, force: bool) -> Iterator[Screen]:
    """The bench of a file on its display, past the gate. Raises InputError or MachineError."""
    monitor = read_config(path).monitor
    display = None if windowed else monitor.display
    settings = WindowSettings(mount_of(monitor).screen_px(monitor.resolution_px), monitor.bits, display)
    with Window(settings) as window, Bench(path, window_context()) as bench:
        screen = Screen(window, bench)
        bench.warm_up()
        screen.pass_gate(force)
        yield screen
