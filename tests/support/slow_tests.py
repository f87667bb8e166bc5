"""Measure the CPU time of every test, and write those that take longest into tests/slow.txt.

    python -m tests.support.slow_tests [--from FOLDER]

A function is slow when all its cases together take over MAX_CPU_S, and until they take under
BACK_CPU_S: one machine measures twice what another does. The bare command `pytest` leaves it out,
but for the cases that fit in KEPT_CPU_S, the longest first: the quickest may be an empty one; and
but for those under CASE_CPU_S: a table of refusals is long, and each of its cases is a claim.
`--from` reads a run that was measured before; functions that it has not keep what stands there.
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
from tests.support.selection import CASE_INDENT, REASONS_BY_FOLDER, SLOW

# What lets the bare command pass in three minutes on two idle cores.
MAX_CPU_S, BACK_CPU_S, KEPT_CPU_S = 0.4, 0.2, 0.2
CASE_CPU_S = 0.02
# Functions that the bare command runs however long they take: each finds a fault of
# tools/planted_faults.toml that no other of its tests finds (tools/mutants.py).
NEVER_SLOW = frozenset(
    {
        "tests/study/test_study_models.py::test_the_note_of_spectra_counts_those_beyond_its_dashed_line",
        "tests/study/test_study_models.py::test_the_thesis_s_tables_stand_beside_what_is_here",
        "tests/unit/instruments/calibrate/test_first_light_steps.py"
        "::test_the_geometry_is_where_the_camera_has_the_screen",
        "tests/unit/instruments/campaign/test_acceptance_verdicts.py"
        "::test_failures_of_all_levels_of_a_sweep_count_together_and_each_level_has_its_folder",
        "tests/unit/instruments/compare/test_report.py::test_the_table_and_the_page_have_each_star",
        "tests/unit/instruments/simulate/test_budget_lines.py"
        "::test_a_budget_s_table_has_a_column_for_each_kind_and_its_chart_the_errors_of_what_shows",
        "tests/unit/server/bench/test_sensor_by_name.py::test_budget_says_whose_figures_stand",
        "tests/unit/test_pytest_plugin.py"
        "::test_a_golden_frame_is_written_where_it_differs_by_more_than_its_limits",
    }
)
# What takes less was skipped, or another test's fixture did its work: what stands there is kept.
MIN_CPU_S = 0.05
SLOW_TESTS = ROOT / "tests" / "slow.txt"


def measure(folder: Path) -> None:
    """Run every test, each worker writing its rows into `folder`."""
    command = [sys.executable, "-m", "pytest", "-q", "--all", "-p", "tests.support.cpu_times"]
    subprocess.run(command, cwd=ROOT, env=os.environ | {FOLDER: str(folder)}, check=False)


def seconds_by_case(folder: Path) -> dict[str, dict[str, float]]:
    """CPU seconds of each case, as `[4.0]`, by test function."""
    seconds: defaultdict[str, dict[str, float]] = defaultdict(dict)
    for path in sorted(folder.glob("*.tsv")):
        for row in path.read_text(encoding="utf-8").splitlines():
            cpu_s, nodeid = row.split("\t", 1)
            function, bracket, case = nodeid.partition("[")
            seconds[function][bracket + case] = float(cpu_s)
    return seconds


def kept_cases(seconds: dict[str, float]) -> frozenset[str]:
    """Which of a slow function's cases the bare command runs, by the seconds of each."""
    kept: set[str] = set()
    left_s = KEPT_CPU_S
    for case, cpu_s in sorted(seconds.items(), key=lambda row: -row[1]):
        if cpu_s <= left_s:
            kept.add(case)
            left_s -= cpu_s
        elif cpu_s < CASE_CPU_S:
            kept.add(case)
    return frozenset(kept)


def main() -> None:
    """Write tests/slow.txt, and say what it leaves to the bare command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--from", dest="measured", type=Path, help="rows of an earlier run")
    measured = parser.parse_args().measured
    with tempfile.TemporaryDirectory() as temporary:
        folder = measured or Path(temporary)
        if measured is None:
            measure(folder)
        seconds = seconds_by_case(folder)
    slow = dict(SLOW)
    bare_s = 0.0
    for function, cases in seconds.items():
        folders = function.partition("::")[0].split("/")
        if any(name in REASONS_BY_FOLDER for name in folders):
            continue
        cpu_s = sum(cases.values())
        if function in slow and cpu_s < MIN_CPU_S:
            continue
        max_cpu_s = BACK_CPU_S if function in SLOW else MAX_CPU_S
        kept = kept_cases(cases)
        if cpu_s > max_cpu_s and function not in NEVER_SLOW and len(kept) < len(cases):
            slow[function] = kept
            bare_s += sum(cases[case] for case in kept)
        else:
            slow.pop(function, None)
            bare_s += cpu_s
    lines: list[str] = []
    for function, kept in sorted(slow.items()):
        if measured is None and function not in seconds:
            continue  # it is gone
        lines += [function, *[CASE_INDENT + case for case in sorted(kept)]]
    SLOW_TESTS.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"{len(slow)} functions are slow; what was measured takes {bare_s:.0f} s of CPU without")


if __name__ == "__main__":
    main()
