"""Frames of a run as files: a PNG each, and a table of what they show."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

from hilstar.bench.frame import Bench
from hilstar.bench.frame_files import write_codes_png
from hilstar.errors import cannot_write
from hilstar.files import make_directory, refuse_ledger
from hilstar.run.shown import Shown

COLUMNS = ("frame", "t_s", "qw", "qx", "qy", "qz", "stars_drawn", "clipped")


class FrameImages:
    """Writes `frame_000000.png` and on, and `frames.csv`; without a directory it writes nothing."""

    def __init__(self, directory: Path | None, bench: Bench) -> None:
        self._directory = directory
        self._bench = bench
        self._table = Path()
        self._bits = bench.config.monitor.bits
        self._stack = ExitStack()

    def __call__(self, shown: Shown) -> None:
        """Write one frame. A blank one has no quaternion."""
        if self._directory is None:
            return
        write_codes_png(
            self._directory / f"frame_{shown.number:06d}.png", self._bench.code_values(shown.drawn.levels), self._bits
        )
        q = ["", "", "", ""] if shown.attitude is None else [repr(float(v)) for v in shown.attitude.q_icrs_to_cam]
        row = [shown.number, f"{shown.t_ns / 1e9:.9f}", *q, shown.drawn.star_count, len(shown.drawn.clipped_hip)]
        with self._said():
            self._writer.writerow(row)

    @contextmanager
    def _said(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise cannot_write(self._table, error) from error

    def __enter__(self) -> Self:
        if self._directory is not None:
            self._table = make_directory(self._directory) / "frames.csv"
            refuse_ledger(self._table)
            with self._said():
                file = self._stack.enter_context(self._table.open("w", encoding="ascii", newline=""))
            self._writer = csv.writer(file, lineterminator="\n")
            self._writer.writerow(COLUMNS)
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        with self._said():
            self._stack.close()
