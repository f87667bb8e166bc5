"""The bench's own display for a session: past its start-up gate, then a pattern for as long as the tracker looks at it."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import open_bench
from hilstar.bench.orientation import orientation_of
from hilstar.calibrate.first_light.patterns import CodeImage, Pattern
from hilstar.calibrate.latency import Edges, edges_of
from hilstar.errors import HilstarError, MachineError
from hilstar.render.context import leave_contexts
from hilstar.render.presenter import Presenter, View, level_texture, window_context
from hilstar.run.screen.gate import Timing, pass_gate
from hilstar.run.screen.screen import Screen

if TYPE_CHECKING:
    from hilstar.monitor.window.window import Window

POLL_S = 0.02
SETTLE_S = 0.25  # for a panel that is slow to change
SHOW_YOURSELF = "or show the patterns yourself: name {pattern} in --grab"


class Stopped(HilstarError):
    """The person at the display has closed the window: the session goes on there when it is run again."""

    exit_code = 1


def _go_on(window: Window, stopped: bool) -> None:
    if window.gone is not None:
        raise MachineError(window.gone)
    if window.closing or stopped:
        raise Stopped("stopped at the display; run the same command again to go on")


def _presenter(file: BenchFile, window: Window, codes: CodeImage) -> tuple[Presenter, Callable[[], None]]:
    """What shows codes (h, w) or (h, w, 3) in the window, and what frees its texture after it."""
    monitor, triples = file.config.monitor, None
    if codes.ndim == 3:
        packed = codes.astype(np.int64) @ np.array([1 << 32, 1 << 16, 1])
        colours, levels = np.unique(packed, return_inverse=True)
        triples = np.stack([colours >> 32, colours >> 16 & 0xFFFF, colours & 0xFFFF], axis=1).astype(np.uint16)
        codes = levels.reshape(codes.shape[:2]).astype(np.uint16)
    view = View(monitor.resolution_px, window.size_px, monitor.bits, orientation_of(monitor), triples=triples)
    texture = level_texture(window_context(), codes)
    return Presenter(texture, view), texture.release


class Display:
    """The window on the bench's display, opened with the first pattern. Free it with `close`, or use it as a context."""

    def __init__(self) -> None:
        self._window: Window | None = None
        self._screen_px = (0, 0)

    def gate(self, file: BenchFile) -> Timing:
        """Measure the display as `serve` does. Raises MachineError where it is not as the bench file has it."""
        self.close()
        try:
            window = self._window_for(file)
            with open_bench(file, window_context()) as bench:
                return pass_gate(Screen(window, bench), force=False)
        except MachineError as error:
            raise MachineError(f"{str(error).removesuffix('; or add --force')}; {SHOW_YOURSELF}") from error

    def show_until(
        self, file: BenchFile, pattern: Pattern, done: Callable[[], bool], on_key: Callable[[str], object] = lambda key: None
    ) -> None:
        """Show a pattern until `done`, which is first asked when the panel has settled; `on_key` is told of keys.

        Raises Stopped where the window is closed, MachineError where the display goes away.
        """
        window = self._window_for(file)
        pause_s = 0.5 / file.config.monitor.refresh_hz if pattern.later else POLL_S
        shown = [_presenter(file, window, codes) for codes in pattern.frames]
        start_s, number = time.monotonic(), 0
        window.keys.clear()  # of the pattern before
        try:
            while time.monotonic() - start_s < SETTLE_S or not done():
                shown[number % len(shown)][0].present()
                window.swap()
                number += 1
                window.look_at_events()
                _go_on(window, bool({"q", "escape"} & set(window.keys)))
                while window.keys:
                    on_key(window.keys.popleft())
                time.sleep(pause_s)
        finally:
            for _, release in shown:
                release()

    def blink(self, file: BenchFile, begin: Callable[[], Callable[[], bool]]) -> Edges:
        """Show the photodiode's square on black, frame by frame: its changes. Raises Stopped, MachineError.

        `begin` is called once the display has been timed, and gives back what tells that it is enough.
        """
        window = self._window_for(file)
        period_s = 1.0 / file.config.monitor.refresh_hz
        swap_ns: list[int] = []
        light: list[int] = []
        with open_bench(file, window_context()) as bench:
            screen = Screen(window, bench)
            pass_gate(screen, force=False)
            bench.draw(None)
            due_s, done = time.monotonic(), begin()
            while not done():
                light.append(screen.present(len(light)) or 0)
                if not screen.clock.paced_by_screen:
                    due_s += period_s
                    time.sleep(max(due_s - time.monotonic(), 0.0))
                swap_ns.append(screen.swap())
                _go_on(window, screen.closing)
        return edges_of(np.array(swap_ns, dtype=np.int64), np.array(light, dtype=np.int64))

    def _window_for(self, file: BenchFile) -> Window:
        from hilstar.monitor.window.window import Window, WindowSettings

        monitor = file.config.monitor
        screen_px = orientation_of(monitor).screen_px(monitor.resolution_px)
        leave_contexts()  # of what drew without a window since
        if self._window is None or self._screen_px != screen_px:
            self.close()
            self._window = Window(WindowSettings(screen_px, monitor.bits, monitor.display))
            self._screen_px = screen_px
        self._window.make_current()
        return self._window

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
