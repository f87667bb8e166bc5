"""Bench files that are written and read."""

from __future__ import annotations

from pathlib import Path

from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from tests.support.benches import Tables, bench_text


def filed_bench(folder: Path, *changes: Tables, name: str = "bench.toml") -> BenchFile:
    """The small bench with other values and tables, as its file in `folder` has it."""
    path = folder / name
    path.write_text(bench_text(*changes))
    return read_bench_file(path)
