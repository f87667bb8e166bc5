"""A photodiode before the square on the display: what was shown, and what it saw of that."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from msgspec.structs import replace

from hilstar.bench.bench_file import BenchFile
from hilstar.calibrate.first_light.sight.display import Display
from hilstar.calibrate.latency import Edges, capture_edges

KIND = "code"  # a square that toggles leaves pairs of frames open


@dataclass(frozen=True, slots=True)
class Watched:
    """The changes of the square, at their swaps, and the edges that the photodiode saw."""

    shown: Edges
    seen: Edges


@dataclass(frozen=True, slots=True)
class SerialDiode:
    """A photodiode's device on a serial port."""

    port: str
    baud: int

    def watch(self, display: Display, file: BenchFile, seconds: float) -> Watched:
        """Show the square for so long and listen. Raises InputError without edges, MachineError, Stopped."""
        with ThreadPoolExecutor(1) as pool:
            listening: list[Future[Edges]] = []

            def begin() -> Callable[[], bool]:
                listening.append(pool.submit(capture_edges, self.port, self.baud, seconds))
                return listening[0].done

            shown = display.blink(with_code(file), begin)
            return Watched(shown, listening[0].result())


def with_code(file: BenchFile) -> BenchFile:
    """The same bench with a square whose frames tell themselves apart."""
    monitor = replace(file.config.monitor, photodiode=KIND)
    return dataclasses.replace(file, config=replace(file.config, monitor=monitor))
