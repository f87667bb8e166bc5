"""What a campaign on the bench says beside its budget: cases without answers, wrong answers, and
the drift of the bench.
"""

from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.charts import write_csv
from hilstar.instruments.campaign.bench_run import CHECKS, NO_ANSWER, drift_of
from hilstar.instruments.campaign.case_table import read_cases

WRONG_COLUMNS = ("case", "order", "begun_utc", "wrong", "off_deg")
MAX_NAMED = 10


def bench_summary(table: Path) -> dict[str, Any]:
    """Write wrong.csv; the keys `no_answer`, `wrong_cases` and `drift` of `hilstar campaign
    --json`. Raises InputError.
    """
    cases = read_cases(table)
    numbers = cases.numbers
    some = np.flatnonzero(np.nan_to_num(cases.numbers["wrong"]) > 0)
    wrong = [
        (
            int(numbers["case"][k]),
            int(numbers["order"][k]),
            cases.texts["begun_utc"][k],
            int(numbers["wrong"][k]),
            off_deg,
        )
        for k in some
        if np.isfinite(off_deg := float(numbers["wrong_deg"][k]))
    ]
    write_csv(table.with_name("wrong.csv"), WRONG_COLUMNS, wrong)
    checks = table.with_name(CHECKS)
    return {
        "no_answer": cases.texts["status"].count(NO_ANSWER),
        "wrong_cases": [dict(zip(WRONG_COLUMNS, row, strict=True)) for row in wrong],
        "drift": drift_of(checks) if checks.exists() else None,
    }


def bench_lines(summary: dict[str, Any]) -> list[str]:
    """The same on the terminal."""
    if summary["no_answer"]:
        lines = [f"{summary['no_answer']} cases without an answer"]
    else:
        lines = []
    wrong = summary["wrong_cases"]
    drift = summary["drift"]
    if wrong:
        named = ", ".join(
            f"case {case['case']} by {case['off_deg']:.3g} deg" for case in wrong[:MAX_NAMED]
        )
        lines.append(
            f"wrong answers in {len(wrong)} cases:"
            f" {named}{', ...' if len(wrong) > MAX_NAMED else ''}"
        )
    if drift is not None:
        parts = []
        for value, sigma in zip(drift["arcsec"], drift["sigma_arcsec"], strict=True):
            parts.append(f"{value:.3g}{_sigma(sigma)}")
        if drift["mag"] is None:
            mag = ""
        else:
            mag = f", {drift['mag']:.3g}{_sigma(drift['sigma_mag'])} mag"
        lines.append(
            f"{'drift of the bench':20}{', '.join(parts)} arcsec about x, y, z{mag}, by"
            f" {drift['checks']} check cases"
        )
    return lines


def _sigma(sigma: float | None) -> str:
    return "" if sigma is None else f" +- {sigma:.2g}"
