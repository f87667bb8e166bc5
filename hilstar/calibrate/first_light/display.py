"""The bench's own display for a session: past its start-up gate, then a pattern for as long as the tracker looks at it."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import open_bench
from hilstar.bench.orientation import orientation_of
from hilstar.calibrate.first_light.patterns import Pattern
from hilstar.errors import HilstarError, MachineError
from hilstar.render.presenter import Presenter, View, level_texture, window_context
from hilstar.render.renderer import leave_contexts
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

    def show_until(self, file: BenchFile, pattern: Pattern, done: Callable[[], bool]) -> None:
        """Show a pattern until `done`, which is first asked when the panel has settled.

        Raises Stopped where the window is closed, MachineError where the display goes away.
        """
        monitor = file.config.monitor
        window = self._window_for(file)
        view = View(monitor.resolution_px, window.size_px, monitor.bits, orientation_of(monitor))
        texture = level_texture(window_context(), pattern.codes)
        presenter = Presenter(texture, view)
        start_s = time.monotonic()
        try:
            while time.monotonic() - start_s < SETTLE_S or not done():
                presenter.present()
                window.swap()
                window.look_at_events()
                if window.gone is not None:
                    raise MachineError(window.gone)
                if window.closing or any(key in {"q", "escape"} for key in window.keys):
                    raise Stopped("stopped at the display; run the same command again to go on")
                window.keys.clear()
                time.sleep(POLL_S)
        finally:
            texture.release()

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
