"""C and C++ of the examples and of tests, as strict as compilers are."""

from __future__ import annotations

import subprocess
from pathlib import Path

from tests.support.waiting import PATIENCE_S

STRICT = ("-Wall", "-Wextra", "-Werror", "-pedantic")
STRICT_CPP = (*STRICT, "-Wconversion", "-Wshadow", "-fno-exceptions")


def compiled(target: Path, *command: str | Path, cwd: Path | None = None) -> Path:
    """What a compiler's command makes without a word, at `target`; its path."""
    words = [*map(str, command), "-o", str(target)]
    result = subprocess.run(
        words, cwd=cwd, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert (result.returncode, result.stdout + result.stderr) == (0, "")
    return target
