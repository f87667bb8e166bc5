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
    is_wrong = np.nan_to_num(numbers["wrong"]) > 0
    is_wrong &= np.isfinite(numbers["wrong_deg"])
    rows = []
    wrong_cases = []
    for k in np.flatnonzero(is_wrong).tolist():
        case = int(numbers["case"][k])
        order = int(numbers["order"][k])
        begun_utc = cases.texts["begun_utc"][k]
        answers = int(numbers["wrong"][k])
        off_deg = float(numbers["wrong_deg"][k])
        row = (case, order, begun_utc, answers, off_deg)
        rows.append(row)
        wrong_cases.append(dict(zip(WRONG_COLUMNS, row, strict=True)))
    wrong_file = table.with_name("wrong.csv")
    write_csv(wrong_file, WRONG_COLUMNS, rows)
    checks = table.with_name(CHECKS)
    drift = None
    if checks.exists():
        drift = drift_of(checks)
    no_answer = cases.texts["status"].count(NO_ANSWER)
    return {"no_answer": no_answer, "wrong_cases": wrong_cases, "drift": drift}


def bench_lines(summary: dict[str, Any]) -> list[str]:
    """The lines of the summary on the terminal."""
    lines = []
    if summary["no_answer"]:
        lines.append(f"{summary['no_answer']} cases without an answer")
    wrong = summary["wrong_cases"]
    if wrong:
        named = []
        for case in wrong[:MAX_NAMED]:
            named.append(f"case {case['case']} by {case['off_deg']:.3g} deg")
        if len(wrong) > MAX_NAMED:
            named.append("...")
        names = ", ".join(named)
        lines.append(f"wrong answers in {len(wrong)} cases: {names}")
    drift = summary["drift"]
    if drift is not None:
        lines.append(_drift_line(drift))
    return lines


def _drift_line(drift: dict[str, Any]) -> str:
    parts = []
    for value, sigma in zip(drift["arcsec"], drift["sigma_arcsec"], strict=True):
        parts.append(f"{value:.3g}{_sigma(sigma)}")
    turn = ", ".join(parts)
    line = f"{'drift of the bench':20}{turn} arcsec about x, y, z"
    mag = drift["mag"]
    if mag is not None:
        line = f"{line}, {mag:.3g}{_sigma(drift['sigma_mag'])} mag"
    return f"{line}, by {drift['checks']} check cases"


def _sigma(sigma: float | None) -> str:
    if sigma is None:
        return ""
    return f" +- {sigma:.2g}"
