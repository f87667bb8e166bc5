"""What the tests share: the commands, bench files, and benches that fail on a GL error."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import hilstar
from tests.support import leftovers

# A shell ignores SIGINT for what it runs with `&`, and what ignores it hands that on: a test's Ctrl-C would reach nobody.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

leftovers.adopt_orphans()

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


@pytest.fixture(scope="session", autouse=True)
def nothing_is_left_behind() -> Iterator[None]:
    """Whatever a test did, none of hilstar's commands runs on when the tests are over; the last one fails where one did."""
    yield
    left = leftovers.end_hilstar_leftovers()
    assert not left, f"left behind by some test, and killed now: {left}"


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
    env = dict(os.environ) if env is None else env
    # A group of its own: what the command has started (`demo` a sender) ends with it, however it ends.
    with subprocess.Popen(
        command, cwd=cwd, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            out, err = process.communicate(timeout=timeout)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def assert_refused(result: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """One line on stderr that has every word; nothing on stdout; no traceback."""
    assert result.returncode == code, result.stderr
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1, result.stderr
    for word in words:
        assert word in result.stderr
