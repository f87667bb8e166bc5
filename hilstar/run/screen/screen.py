"""The monitor's window: frames on it, and its operator's keys."""

from __future__ import annotations

import logging
import time
from typing import cast

from hilstar.bench.build import orientation_of
from hilstar.bench.frame import Bench
from hilstar.monitor.window.output_settings import OutputState
from hilstar.monitor.window.window import Window
from hilstar.render.presenter import Presenter, ScreenView, changed_codes
from hilstar.render.renderer import Renderer
from hilstar.run.operator import Aids
from hilstar.run.screen.photodiode import marker_light
from hilstar.run.screen.swap_clock import DrawBudget, SwapClock
from hilstar.units import NS_PER_MS, NS_PER_S

HELP = "keys: q quit, b blank, space pause, c crosshair, g grid, t next test patch, h this line"
KEYS = {"b": "blank", "c": "crosshair", "g": "grid", "t": "patch", "space": "pause"}
log = logging.getLogger(__name__)


class Screen:
    """A window with a bench's frames on it.

    `clock` predicts its swaps, `budget` how early a frame has to be begun, and `swap_to_light_ns` is the time from a swap to
    the middle row's first light: half of the scan-out, the panel's own delay, and the frames `queued` in the driver. `output`
    is how the display's output was set when the gate was passed, None where that is not known.
    """

    def __init__(self, window: Window, bench: Bench) -> None:
        monitor = bench.config.monitor
        self.window = window
        self.bench = bench
        self.output: OutputState | None = None
        self.aids = Aids()
        self.swap_to_light_ns = round((bench.scan.scanout_s / 2 * 1e3 + monitor.panel_delay_ms) * NS_PER_MS)
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
        self._renderer = cast(Renderer, bench.renderer)  # a window's bench has the window's context
        self._presenter = Presenter(self._renderer.codes_texture, view)
        self._renderer.tables.append(self._presenter.table)

    def keep_time(self, period_ms: float, by_screen: bool, swap_ns: int) -> None:
        """Predict swaps from the one at `swap_ns`, by the screen's own period where the screen keeps time."""
        period_ns = period_ms * NS_PER_MS if by_screen else NS_PER_S / self.bench.config.monitor.refresh_hz
        self.clock = SwapClock(swap_ns, period_ns, by_screen)
        self.budget = DrawBudget(period_ns)
        self.queued = 0

    def keep_ahead(self, guard_ms: float, queued: int) -> None:
        """Have frames ready `guard_ms` before their swap; the driver holds `queued` of them back for a refresh each."""
        self.budget = DrawBudget(self.clock.period_ns, guard_ms * NS_PER_MS)
        self.swap_to_light_ns += round((queued - self.queued) * self.clock.period_ns)
        self.queued = queued

    @property
    def closing(self) -> bool:
        """True once the window is to be closed."""
        return self.window.closing or self._quit

    @property
    def timestamp_source(self) -> str:
        """Where the times of swaps come from, and who paces them."""
        return self.window.timestamp_source + ("" if self.clock.paced_by_screen else ", software pacing")

    def changed_codes(self) -> str:
        """Which codes the driver draws otherwise than they are; "" for none."""
        return changed_codes(self._renderer.context, self.window.size_px, self.bench.config.monitor.bits)

    def present(self, number: int) -> int | None:
        """Draw the bench's last frame on the back buffer; the photodiode square's light in frame `number`, None without one."""
        monitor = self.bench.config.monitor
        white = 2**monitor.bits - 1
        side_px = monitor.photodiode_px
        marker = marker_light(number, monitor.photodiode) if side_px else None
        self._presenter.present(self.aids.overlay, round(self.aids.patch_share * white), (side_px, white * (marker or 0)))
        return marker

    def swap(self, timed: bool = True) -> int:
        """Swap what was presented onto the screen, and take in keys; host time of the swap, ns.

        One that is not `timed` does not move the clock.
        """
        swap_ns = self.window.swap(self._presenter.wait)
        if timed:
            self.clock.update(swap_ns)
        self.window.look_at_events()
        while self.window.keys:
            self._press(self.window.keys.popleft())
        return swap_ns

    def _press(self, key: str) -> None:
        match key:
            case "q" | "escape":
                self._quit = True
            case "h" | "f1":
                log.warning(HELP)
            case _ if key in KEYS:
                self.aids.toggle(KEYS[key])
