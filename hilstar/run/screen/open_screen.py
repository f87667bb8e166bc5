"""The bench of a file on its display."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import open_bench, orientation_of
from hilstar.monitor.window.window import Window, WindowSettings
from hilstar.render.driver import sleep_in_waits
from hilstar.render.presenter import window_context
from hilstar.run.screen.gate import pass_gate
from hilstar.run.screen.screen import Screen

log = logging.getLogger(__name__)


@contextmanager
def open_screen(file: BenchFile, *, windowed: bool, force: bool) -> Iterator[Screen]:
    """The bench of a file on its display, past the gate. Raises InputError or MachineError."""
    monitor = file.config.monitor
    display = None if windowed else monitor.display
    size_px = orientation_of(monitor).screen_px(monitor.resolution_px)
    sleep_in_waits()
    settings = WindowSettings(size_px, monitor.bits, display, monitor.refresh_hz)
    with Window(settings) as window, open_bench(file, window_context()) as bench:
        wanted, draws = file.config.render.gpu, bench.renderer.gl_renderer
        if isinstance(wanted, str) and wanted.lower() not in draws.lower():
            log.warning("[render] gpu = %r is for headless frames; %s draws this window", wanted, draws)
        screen = Screen(window, bench)
        bench.warm_up()
        pass_gate(screen, force)
        bench.output.update({} if screen.output is None else screen.output.fields())
        yield screen
