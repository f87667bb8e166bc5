"""What the examples' tests share: a copy of the folder to run in, and the commands that its
README gives.
"""

from __future__ import annotations

import math
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.rotation import propagate
from tests.support.benches import ROOT
from tests.support.compilers import compiled
from tests.support.waiting import PATIENCE_S

EXAMPLES = ROOT / "examples"
README = (EXAMPLES / "README.md").read_text()
HEADER = Path("firmware_protocol") / "hilstar_protocol.h"


def copied(folder: Path) -> Path:
    """The examples, with the C header where they look for it: outputs stay out of the checkout."""
    shutil.copytree(EXAMPLES, folder / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    (folder / HEADER.parent).mkdir()
    shutil.copy(ROOT / HEADER, folder / HEADER)
    return folder / "examples"


def section(heading: str) -> str:
    """The README's section of that heading."""
    (text,) = re.findall(rf"(?ms)^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", README)
    return text


def commands(heading: str) -> list[list[str]]:
    """The words of each line that a section gives to type."""
    (block,) = re.findall(r"(?s)```sh\n(.*?)```", section(heading))
    return [shlex.split(line.removesuffix(" &")) for line in block.splitlines()]


def compiled_by_readme(words: list[str], target: Path, *more: str) -> Path:
    """The program of a line of the README, `-o NAME` at its end, with more options; its path."""
    compiler, *rest, flag, _ = words
    assert flag == "-o"
    return compiled(target, compiler, *more, *rest, cwd=EXAMPLES)


def assert_refused_in_one_line(program: Path, cases: list[tuple[list[str], int]]) -> None:
    """Fail unless a program ends with each exit code, and says why in one line."""
    for arguments, code in cases:
        command = [str(program), *arguments]
        ended = subprocess.run(
            command, capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
        assert (ended.returncode, len(ended.stderr.splitlines())) == (code, 1), arguments


def assert_turns(samples: list[AttitudeSample], rate_deg_s: float) -> None:
    """Fail unless samples turn about z from (0.5, 0.5, -0.5, 0.5) as their rate says."""
    rate_rad_s = np.array([0.0, 0.0, math.radians(rate_deg_s)])
    assert [sample.sequence for sample in samples] == list(range(len(samples)))
    for sample in samples:
        after_s = (sample.t_ns - samples[0].t_ns) / 1e9
        expected = propagate(np.array([0.5, 0.5, -0.5, 0.5]), rate_rad_s, after_s)
        assert np.abs(sample.q_icrs_to_cam - expected).max() < 1e-14
        assert sample.rate_cam_rad_s.tolist() == rate_rad_s.astype(np.float32).tolist()
