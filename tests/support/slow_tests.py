"""Measure the CPU time of every test, and write those that take longest into tests/slow.txt.

    python -m tests.support.slow_tests [--from FOLDER]

A function is slow when all its cases together take over MAX_CPU_S; the bare command `pytest` leaves
it out. A folder's fixture is charged to the first test that asks for it. `--from` reads a run that
was measured before.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

from tests.support.benches import ROOT
from tests.support.cpu_times import FOLDER
from tests.support.selection import REASONS_BY_FOLDER

# What lets the bare command pass in three minutes on two idle cores.
MAX_CPU_S = 0.8
SLOW_TESTS = ROOT / "tests" / "slow.txt"


def measure(folder: Path) -> None:
    """Run every test, each worker writing its rows into `folder`."""
    command = [sys.executable, "-m", "pytest", "-q", "--all", "-p", "tests.support.cpu_times"]
    subprocess.run(command, cwd=ROOT, env=os.environ | {FOLDER: str(folder)}, check=False)


def seconds_by_function(folder: Path) -> dict[str, float]:
    """CPU seconds of each test function, all its cases together."""
    seconds: defaultdict[str, float] = defaultdict(float)
    for path in folder.glob("*.tsv"):
        for row in path.read_text(encoding="utf-8").splitlines():
            cpu_s, nodeid = row.split("\t", 1)
            seconds[nodeid.partition("[")[0]] += float(cpu_s)
    return seconds


def main() -> None:
    """Write tests/slow.txt, and say what it leaves to the bare command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--from", dest="measured", type=Path, help="rows of an earlier run")
    measured = parser.parse_args().measured
    with tempfile.TemporaryDirectory() as temporary:
        folder = measured or Path(temporary)
        if measured is None:
            measure(folder)
        seconds = seconds_by_function(folder)
    slow: list[str] = []
    bare_s = 0.0
    for function, cpu_s in sorted(seconds.items()):
        folders = function.partition("::")[0].split("/")
        if any(name in REASONS_BY_FOLDER for name in folders):
            continue
        if cpu_s > MAX_CPU_S:
            slow.append(function)
        else:
            bare_s += cpu_s
    SLOW_TESTS.write_text("\n".join(slow) + "\n", encoding="utf-8")
    print(f"{len(slow)} functions are slow; the others take {bare_s:.0f} s of CPU")


if __name__ == "__main__":
    main()
