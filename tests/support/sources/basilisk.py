"""Basilisk in a process of its own, and its truth as SciPy has it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support.forks import Started
from tests.support.waiting import PATIENCE_S

MODULE = "tests.support.sources.basilisk_run"


class Basilisk:
    """A running simulation, which waits until it is told to go."""

    def __init__(self, process: subprocess.Popen[str], said: Path) -> None:
        self._process, self._said = process, said

    def run(self, code: int = 0) -> str:
        """Let it go, wait for its end with that exit code; what it said."""
        self._process.communicate("go\n", timeout=PATIENCE_S)
        assert self._process.returncode == code, self._said.read_text()
        return self._said.read_text()


@contextmanager
def basilisk(folder: Path, **scenario: Any) -> Iterator[Basilisk]:
    """A scenario (see basilisk_run.py) that begins; its truth and pictures go into `folder`."""
    whole = {"truth": str(folder / "truth.npz"), "pictures": str(folder / "picture"), **scenario}
    path, said = folder / "scenario.json", folder / "basilisk.txt"
    path.write_text(json.dumps(whole))
    with said.open("w") as file:
        told = {"stdin": subprocess.PIPE, "stdout": file, "stderr": subprocess.STDOUT, "text": True}
        with Started([sys.executable, "-m", MODULE, str(path)], cwd=folder, **told) as process:
            try:
                yield Basilisk(process, said)
            finally:
                process.kill()


class Truth:
    """What Basilisk recorded: times (ns, since the beginning), attitudes, rates (rad/s, body), v
    and r (m/s and m, N).
    """

    def __init__(self, folder: Path) -> None:
        with np.load(folder / "truth.npz") as table:
            self.t_ns, self.sigma_bn = table["t_ns"].astype(np.int64), table["sigma_bn"]
            self.omega_bn_b, self.v_bn_n = table["omega_bn_b"], table["v_bn_n"]
            self.r_bn_n = table["r_bn_n"]
        # SciPy's MRPs turn the vector, Basilisk's the frame: [BN] is the inverse.
        self.body_from_n = Rotation.from_mrp(self.sigma_bn).inv()

    def row(self, t_ns: int) -> int:
        """The row of a recorded time."""
        found = int(np.searchsorted(self.t_ns, t_ns))
        assert self.t_ns[found] == t_ns
        return found

    def shadow_switches(self) -> int:
        """How often sigma_BN changed over to its shadow set."""
        return int((np.linalg.norm(np.diff(self.sigma_bn, axis=0), axis=1) > 1).sum())


def rotation(q: list[float]) -> Rotation:
    """SciPy's of a scalar-first quaternion of ours."""
    return Rotation.from_quat([*q[1:], q[0]])
