"""The budget for a person, and as a table and a chart."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.bench.white import named
from hilstar.charts import chart, write_csv
from hilstar.twin.budget import CENTROID_LIMIT_PX, FLUX_LIMITS_MAG, Budget

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_NAMED = 20
MIN_ERROR = 1e-6  # as drawn


def write_report(directory: Path, found: Budget) -> None:
    """budget.csv and budget.png. Raises InputError where one cannot be written."""
    columns = list(asdict(found.rows[0]))
    write_csv(directory / "budget.csv", columns, [["" if v is None else v for v in asdict(row).values()] for row in found.rows])
    reach = found.within[f"{FLUX_LIMITS_MAG[1]:g}_mag"]
    finding = f"{found.bits} bits, {found.method}: from V = {found.clips_v_mag:.1f}, where stars clip, within "
    finding += f"{FLUX_LIMITS_MAG[1]:g} mag over {'no' if reach is None else f'{reach:g}'} magnitudes"
    shown = [row for row in found.rows if row.flux_max_mag is not None]
    v_mag = np.array([row.v_mag for row in shown])
    with chart(directory / "budget.png", finding, 2) as axes:
        for axis, kind, limits, label in (
            (axes[0], "flux", FLUX_LIMITS_MAG, "flux error [mag]"),
            (axes[1], "centroid", (CENTROID_LIMIT_PX,), "centroid error [monitor px]"),
        ):
            unit = "mag" if kind == "flux" else "px"
            for name, style in (("max", "C0-"), ("rms", "C0--")):
                values = np.array([getattr(row, f"{kind}_{name}_{unit}") for row in shown])
                axis.semilogy(v_mag, np.maximum(values, MIN_ERROR), style, label=f"{name} over sub-pixel phases")
            _draw_limits(axis, found, limits, unit)
            axis.set_ylabel(label)
            axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9)
        axes[1].set_xlabel("V of a star of the Sun's colour [mag]")


def _draw_limits(axis: Axes, found: Budget, limits: tuple[float, ...], unit: str) -> None:
    for limit, style in zip(limits, (":", "-."), strict=False):
        axis.axhline(limit, color="tab:red", linestyle=style, linewidth=1, label=f"limit: {limit:g} {unit}")
    axis.axvline(found.clips_v_mag, color="0.4", linewidth=1, label=f"clips: brighter than V = {found.clips_v_mag:.2f}")
    dark = f"shows nothing: fainter than V = {found.nothing_v_mag:.2f}"
    axis.axvline(found.nothing_v_mag, color="0.4", linestyle="--", linewidth=1, label=dark)


def budget_lines(found: Budget) -> list[str]:
    """The budget for a person."""

    def number(value: float | None, form: str) -> str:
        return "-" if value is None else f"{value:{form}}"

    within = ", ".join(f"{number(value, 'g')} mag within {limit.replace('_', ' ')}" for limit, value in found.within.items())
    each = ", ".join(f"{kind} {number(value, '.4f')}" for kind, value in found.centroid_rms_px.items()) + " px rms"
    lines = [
        f"{'method':22}{found.method}, {found.bits} bits",
        f"{'clips at':22}V = {found.clips_v_mag:.2f} in the middle of a pixel, {found.clips_v_mag_at_best:.2f} on a corner",
        f"{'shows nothing':22}from V = {found.nothing_v_mag:.2f}, a range of {found.range_mag:.1f} mag",
        f"{'below full scale':22}{within}",
        f"{'centroider':22}{found.centroider}, after the tracker's blur; 6 mag below full scale each is off by: {each}",
        f"{'clipped stars':22}{named(found.clipped_hip, MAX_NAMED)}",
        f"{'not drawn':22}{found.left_out.stars} stars, too faint: {found.left_out.flux_share:.2e} of all light",
        f"{'black':22}{found.black_e_per_s_px:.4g} e-/s in a monitor pixel",
        "",
        f"{'V':>6}{'flux rms':>12}{'max mag':>10}{'centroid rms':>14}{'max px':>9}{'max arcsec':>12}",
    ]
    for row in found.rows:
        lines.append(
            f"{row.v_mag:6.2f}{number(row.flux_rms_mag, '.4f'):>12}{number(row.flux_max_mag, '.4f'):>10}"
            f"{number(row.centroid_rms_px, '.4f'):>14}{number(row.centroid_max_px, '.4f'):>9}"
            f"{number(row.centroid_max_arcsec, '.2f'):>12}"
        )
    return lines
