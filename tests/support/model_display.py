"""A model of a display, its driver and the kernel's time stamps, on a clock that moves only when
somebody waits.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

from hilstar.display.window.x11 import BackBuffer, SwapStamps
from hilstar.optics.layers.view import View
from hilstar.server.bench.config import parse_config
from hilstar.server.bench.monitor import scan_of
from hilstar.server.screen.screen import Screen
from tests.support.benches import SMALL_BENCH
from tests.support.fake_clock import FakeClock, WellGpu

FIRST_NS = 1_000_000_000
DRAW_NS = 1_000_000  # of a frame


def plain_window(hz: float = 60.0, **changes: object) -> SimpleNamespace:
    """What a window on a display that is as the small bench has it says of it, but for
    `changes`.
    """
    plain = {
        "size_px": (320, 240),
        "by_wayland": False,
        "ramp_refused": False,
        "composited": False,
        "mirrored": None,
        "others": (),
        "scaled": False,
        "back_buffer": BackBuffer(8, 0),
        "screen_bits": 8,
        "ramp_size": 256,
        "modes_hz": (50, 60),
        "output": None,
        "ramp_changed": False,
        "presented": {},
        "gone": None,
        "display": SimpleNamespace(refresh_hz=hz),
    }
    return SimpleNamespace(**plain | changes)


def model_screen(
    folder: Path, hz: float = 60, monitor: str = "", **display: object
) -> tuple[Screen, ModelDisplay]:
    """The small bench on a model display, before the gate: all but the window and what is drawn
    on it is real. `monitor` are more keys of its monitor.
    """
    clock = FakeClock(FIRST_NS + 123_456)
    model = ModelDisplay(clock, round(1e9 / hz), **display)
    config = parse_config(
        folder / "bench.toml",
        SMALL_BENCH.replace("[collimator]", f"refresh_hz = {hz}\n{monitor}[collimator]"),
    )
    bench = SimpleNamespace(
        config=config,
        scan=scan_of(config.monitor),
        camera=SimpleNamespace(boresight_px=(0.0, 0.0)),
        calibration=SimpleNamespace(response=SimpleNamespace(rgb=None)),
        renderer=WellGpu(model.wait),
        effort=SimpleNamespace(is_chosen=False),
        draw=lambda q: None,
        view=View,
        light=lambda view, faults: clock.work(DRAW_NS),
        draw_sprites=lambda sprites, number: SimpleNamespace(
            levels=None, star_count=0, clipped_hip=(), capped=0
        ),
    )
    return Screen(model.window, bench), model


class ModelDisplay:
    """A window whose frames flip at vertical blanks, `period_ns` apart.

    A frame is flipped at the first blank that is `deadline_ns` after its swap, one frame a blank.
    The driver has `buffers` with the one on the screen: with two of them whoever asks for the next
    one waits for the flip. `stamp_ns` is how far the driver's time stamp of a flip lies after its
    blank, None where it gives none; `stampless` are flips without one. A `variable` display has no
    grid: it shows a frame at once, a period after the last one at the earliest.
    """

    def __init__(
        self,
        clock: FakeClock,
        period_ns: int,
        *,
        buffers: int = 2,
        deadline_ns: int = 0,
        stamp_ns: int | None = None,
        stampless: Callable[[int], bool] = lambda number: False,
        variable: bool = False,
        **window: object,
    ) -> None:
        self.clock, self.period_ns, self.deadline_ns = clock, period_ns, deadline_ns
        self.flips_ns: list[int] = []
        self._variable = variable
        self._held, self._stamp_ns, self._stampless = buffers - 2, stamp_ns, stampless
        stamp = None if stamp_ns is None else self._stamp
        self._stamps = SwapStamps(stamp, period_ns, clock.now_ns)
        own = {
            "swap": self.swap,
            "look_at_events": lambda: None,
            "hidden": "",
            "closing": False,
            "keys": [],
        }
        self.window = plain_window(round(1e9 / period_ns), **own | window)

    @property
    def timestamp_source(self) -> str:
        return self._stamps.source

    def swap(self, wait: Callable[[], None]) -> int:
        """Queue the frame, and wait as `Window.swap` does."""
        earliest = -(-(self.clock.ns + self.deadline_ns - FIRST_NS) // self.period_ns)
        after_last = (
            (self.flips_ns[-1] - FIRST_NS) // self.period_ns + 1 if self.flips_ns else earliest
        )
        flip_ns = FIRST_NS + max(earliest, after_last) * self.period_ns
        if self._variable:
            flip_ns = max(
                self.clock.ns + self.deadline_ns,
                self.flips_ns[-1] + self.period_ns if self.flips_ns else 0,
            )
        self.flips_ns.append(flip_ns)
        self.window.timestamp_source = self.timestamp_source
        swapped_ns = self._stamps.after_swap(wait)
        self.window.timestamp_source = self.timestamp_source
        return swapped_ns

    def wait(self) -> None:
        """Wait for the next back buffer, as the presenter does: no more frames than are held
        wait for their flip.
        """
        if len(self.flips_ns) > self._held:
            self._until(self.flips_ns[-1 - self._held])

    def _stamp(self) -> int | None:
        """The driver's own wait for the last flip, and its time; the wait ends at the blank,
        whatever its stamp says.
        """
        if self._stamp_ns is None or self._stampless(len(self.flips_ns)):
            return None
        self._until(self.flips_ns[-1])
        return self.flips_ns[-1] + self._stamp_ns

    def _until(self, ns: int) -> None:
        self.clock.ns = max(self.clock.ns, ns)
