"""What the examples' tests share: a copy of the folder to run in, and the commands that its
README gives.
"""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

from tests.support.benches import ROOT
from tests.support.compilers import compiled

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
