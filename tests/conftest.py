"""What the tests share: the commands, bench files, and benches that fail on a GL error."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import hilstar

# A shell ignores SIGINT for what it runs with `&`, and what ignores it hands that on: a test's Ctrl-C would reach nobody.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).resolve().parent.parent

SMALL_BENCH = """
[tracker]
aperture_mm = 30
focal_length_mm = 70
pixel_pitch_um = 13
resolution_px = [1024, 1024]
quantum_efficiency = "ccd47-20"
transmission = "n-bk7-10mm"

[monitor]
resolution_px = [320, 240]
pixel_pitch_um = 57.65

[collimator]
focal_length_mm = 60
"""


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260101)


@pytest.fixture
def small_bench_file(tmp_path: Path) -> Path:
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH)
    return path


@pytest.fixture
def bench_with(tmp_path: Path) -> Iterator[Callable[[str], hilstar.Bench]]:
    """Benches made of the small one and more TOML; each must end without a GL error."""
    opened: list[hilstar.Bench] = []

    def make(more: str = "") -> hilstar.Bench:
        path = tmp_path / f"bench{len(opened)}.toml"
        path.write_text(SMALL_BENCH + more)
        bench = hilstar.load(path)
        assert bench.renderer.gl_error() == "GL_NO_ERROR"
        opened.append(bench)
        return bench

    yield make
    for bench in opened:
        assert bench.renderer.gl_error() == "GL_NO_ERROR"
        bench.close()


def run_hilstar(
    *arguments: str | Path, cwd: Path | None = None, timeout: float = 120, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """The command as a user runs it, in a process of its own."""
    command = [sys.executable, "-m", "hilstar", *map(str, arguments)]
    return subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False, env=os.environ if env is None else env
    )


def assert_refused(result: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """One line on stderr that has every word; nothing on stdout; no traceback."""
    assert result.returncode == code, result.stderr
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1, result.stderr
    for word in words:
        assert word in result.stderr
