"""What `hilstar verify -o DIR` writes: a table of all stars, and charts of their errors."""

from __future__ import annotations

from dataclasses import astuple, fields
from pathlib import Path

import numpy as np

from hilstar.charts import BLUE, MUTED, RED, SMALL_PT, chart, label_ends, write_csv
from hilstar.twin.verify.display_errors import DisplayErrors, p95
from hilstar.twin.verify.measured import Star
from hilstar.twin.verify.verdict import Verdict

MIN_SHARE = 1e-4  # of the limit: as drawn
ARROW_SHARE = 0.06  # of the chart's width, for the residual that 95 % of stars are within


def write_report(directory: Path, verdict: Verdict) -> None:
    """stars.csv, and the charts errors and field, each as PNG and SVG. Raises InputError where one cannot be written."""
    errors = verdict.errors
    write_csv(directory / "stars.csv", [entry.name for entry in fields(Star)], map(astuple, errors.stars + errors.lost))
    _draw_field(directory / "field", errors, verdict.measured.camera.resolution_px)
    if errors.stars:
        _draw_errors(directory / "errors", verdict)


def _draw_errors(path: Path, verdict: Verdict) -> None:
    errors, limits = verdict.errors, verdict.measured.config.verify
    v_mag, flux, centroid = np.array([star.v_mag for star in errors.stars]), errors.flux_mag(), errors.centroid_px()
    word = "passes" if verdict.passed else "does not pass"
    finding = (
        f"The bench {word}: flux within {p95(np.abs(flux)):.3f} mag, places within {p95(centroid):.3f} px, for 95 % of stars"
    )
    note = f"Each point is one of {len(v_mag)} stars. The limit is for 95 % of them."
    with chart(path, finding, 2, note=note) as axes:
        for axis, values, limit, label in (
            (axes[0], np.abs(flux), limits.flux_mag, "flux error [mag]"),
            (axes[1], centroid, limits.centroid_px, "place error [tracker px]"),
        ):
            axis.semilogy(v_mag, np.maximum(values, MIN_SHARE * limit), ".", color=MUTED, ms=5, alpha=0.7, label="_star")
            axis.axhline(limit, color=RED, linestyle="--", linewidth=1.4, label="limit")
            axis.axhline(max(p95(values), MIN_SHARE * limit), color=BLUE, linewidth=1.4, label="95 % of stars")
            axis.set_ylabel(label)
            label_ends(axis)
        axes[1].set_xlabel("V [mag]")


def _draw_field(path: Path, errors: DisplayErrors, resolution_px: tuple[int, int]) -> None:
    x, y, dx, dy = (np.array([getattr(star, name) for star in errors.stars]) for name in ("x_px", "y_px", "dx_px", "dy_px"))
    longest, arrow_px = max(p95(np.hypot(dx, dy)), 1e-9), ARROW_SHARE * resolution_px[0]
    finding = f"Centroid errors of {len(x)} stars over the tracker's field; {len(errors.lost)} stars are lost"
    note = f"Arrows are enlarged {arrow_px / longest:.0f} times." + (" Red crosses: lost stars." if errors.lost else "")
    with chart(path, finding, note=note, height_inch=7.4) as (axis,):
        axis.plot(x, y, ".", color=MUTED, markersize=3)
        arrows = axis.quiver(x, y, dx, dy, angles="xy", scale_units="xy", scale=longest / arrow_px, width=0.002, color=BLUE)
        key = {"labelpos": "E", "coordinates": "axes", "fontproperties": {"size": SMALL_PT}}
        axis.quiverkey(arrows, 0.86, 1.03, longest, f"{longest:.2g} px", **key)
        axis.plot([s.x_px for s in errors.lost], [s.y_px for s in errors.lost], "x", color=RED)
        axis.set_xlim(0, resolution_px[0])
        axis.set_ylim(resolution_px[1], 0)
        axis.set_aspect("equal")
        axis.set_xlabel("x [tracker px]")
        axis.set_ylabel("y [tracker px]")
        if errors.lost:
            axis.annotate("lost", (0.6, 1.015), xycoords="axes fraction", color=RED, fontsize=SMALL_PT)
