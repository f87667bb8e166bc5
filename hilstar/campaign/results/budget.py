"""The error budget of a campaign's cases, by the same code as that of a run."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.config import BenchConfig
from hilstar.campaign.budget.budget import assess_cases
from hilstar.campaign.budget.scale import Scale
from hilstar.campaign.results.columns import Columns
from hilstar.charts import write_csv
from hilstar.errors import InputError
from hilstar.rotation import from_rotation_vectors, multiply
from hilstar.units import ARCSEC_PER_RAD

CSV_COLUMNS = ("quantity", "axis", "value", "unit", "low_95", "high_95")
PARTS = {"fov": "field-of-view error", "pixel": "pixel error", "noise": "noise", "scatter": "noise within a case"}
MAX_CASES = 20_000  # that the parts are told apart in; the fit's time grows with them


def reported_attitudes(cases: Columns) -> FloatArray:
    """The attitudes (n, 4) that the solver reported, NaN where none: a case's mean error put on its commanded attitude."""
    commanded = cases.vectors("q{}", "wxyz")
    error = cases.vectors("error_{}_arcsec", "xyz") / ARCSEC_PER_RAD
    known = np.isfinite(error).all(axis=1)
    reported = cases.vectors("solved_q{}", "wxyz")
    reported[known] = multiply(from_rotation_vectors(error[known]), commanded[known])
    return reported


def case_budget(cases: Columns, config: BenchConfig, rng: np.random.Generator) -> dict[str, Any]:
    """The budget as `hilstar assess` has it, with `scatter_arcsec` within cases of several frames, and notes.

    What too few answers cannot tell is None, and a note says why.
    """
    asked = np.nansum(cases.numbers["frames"])
    solved, wrong = (float(np.nansum(cases.numbers[name])) for name in ("solved", "wrong"))
    found: dict[str, Any] = {
        "bias_arcsec": None,
        "fov_arcsec": None,
        "pixel_arcsec": None,
        "noise_arcsec": None,
        "scatter_arcsec": _scatter(cases),
        "availability": (solved - wrong) / asked if asked else 0.0,
        "wrong": int(wrong),
        "centroids": _centroids(cases),
        "notes": [],
        "intervals": {},
    }
    tracker = config.tracker
    scale = Scale(tracker.focal_length_mm * 1e3 / tracker.pixel_pitch_um, tracker.resolution_px)
    commanded, reported = cases.vectors("q{}", "wxyz"), reported_attitudes(cases)
    step = -(-len(commanded) // MAX_CASES)
    try:
        parts = assess_cases(commanded[::step], reported[::step], scale, rng)
    except InputError as error:
        found["notes"] = [str(error)]
        return found
    found |= {name: asdict(getattr(parts, name)) for name in ("fov_arcsec", "pixel_arcsec", "noise_arcsec")}
    found |= {"bias_arcsec": parts.bias_arcsec.tolist(), "notes": list(parts.notes)}
    found["intervals"] = {name: getattr(parts.intervals, name).tolist() for name in ("bias", "fov", "pixel", "noise")}
    return found


def _scatter(cases: Columns) -> dict[str, float] | None:
    """One sigma across and about the boresight between the frames of a case, arcsec; None where cases have one frame."""
    scatter = cases.vectors("scatter_{}_arcsec", "xyz")
    scatter = scatter[np.isfinite(scatter).all(axis=1)]
    if not len(scatter):
        return None
    variance = (scatter**2).mean(axis=0)
    return {"cross": math.sqrt((variance[0] + variance[1]) / 2), "roll": math.sqrt(variance[2])}


def _centroids(cases: Columns) -> dict[str, float] | None:
    """What the centroider alone did: its mean error and one sigma, px, the share of stars found, and false finds a frame."""
    numbers = cases.numbers
    if "measured" not in numbers:
        return None
    weight = np.nan_to_num(numbers["measured"])
    some = weight > 1
    if not some.any():
        return None

    def mean(values: FloatArray) -> float:
        return float(np.average(values[some], weights=weight[some]))

    bias_px = [mean(numbers[f"centroid_d{axis}_px"]) for axis in "xy"]
    spread = [numbers[f"centroid_sigma_{axis}_px"] ** 2 + numbers[f"centroid_d{axis}_px"] ** 2 for axis in "xy"]
    sigma_px = [math.sqrt(max(0.0, mean(values) - bias**2)) for values, bias in zip(spread, bias_px, strict=True)]
    return {
        "bias_x_px": bias_px[0],
        "bias_y_px": bias_px[1],
        "sigma_x_px": sigma_px[0],
        "sigma_y_px": sigma_px[1],
        "found_share": float(np.nansum(numbers["matched"]) / max(np.nansum(numbers["stars"]), 1.0)),
        "false_a_frame": float(np.nansum(numbers["false"]) / max(np.nansum(numbers["frames"]), 1.0)),
    }


def write_budget(path: Path, budget: dict[str, Any]) -> None:
    """The budget as a table, with the columns of `hilstar assess`. Raises InputError where it cannot be written."""
    rows: list[tuple[Any, ...]] = []
    for k, axis in enumerate("xyz"):
        low, high = _interval(budget, "bias", k)
        rows.append(("bias", axis, (budget["bias_arcsec"] or [None] * 3)[k], "arcsec", low, high))
    for part, name in PARTS.items():
        for k, axis in enumerate(("cross", "roll")):
            low, high = _interval(budget, part, k)
            rows.append((name, axis, (budget[f"{part}_arcsec"] or {}).get(axis), "arcsec", low, high))
    rows.append(("availability", "", budget["availability"], "1", None, None))
    rows.append(("wrong answers", "", budget["wrong"], "1", None, None))
    for name, value in (budget["centroids"] or {}).items():
        unit = name.rpartition("_")[2] if name.endswith("_px") else "1"
        rows.append((f"centroids: {name}", "", value, unit, None, None))
    write_csv(path, CSV_COLUMNS, [["" if value is None else value for value in row] for row in rows])


def _interval(budget: dict[str, Any], part: str, k: int) -> tuple[float | None, float | None]:
    ends = budget["intervals"].get(part)
    return (None, None) if ends is None else (ends[0][k], ends[1][k])
