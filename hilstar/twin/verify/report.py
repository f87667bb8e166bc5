"""What `hilstar verify -o DIR` writes: a table of all stars, and charts of their errors."""

from __future__ import annotations

from dataclasses import astuple, fields
from pathlib import Path

import numpy as np

from hilstar.charts import chart, write_csv
from hilstar.twin.verify.display_errors import DisplayErrors, p95
from hilstar.twin.verify.measured import Star
from hilstar.twin.verify.verdict import Verdict

ARROW_SHARE = 0.06  # of the chart's width, for the residual that 95 % of stars are within


def write_report(directory: Path, verdict: Verdict) -> None:
    """stars.csv, errors.png and field.png. Raises InputError where one cannot be written."""
    errors = verdict.errors
    write_csv(directory / "stars.csv", [entry.name for entry in fields(Star)], map(astuple, errors.stars + errors.lost))
    _draw_field(directory / "field.png", errors, verdict.measured.camera.resolution_px)
    if errors.stars:
        _draw_errors(directory / "errors.png", verdict)


def _draw_errors(path: Path, verdict: Verdict) -> None:
    errors, limits = verdict.errors, verdict.measured.config.verify
    v_mag, flux, centroid = np.array([star.v_mag for star in errors.stars]), errors.flux_mag(), errors.centroid_px()
    word = "passes" if verdict.passed else "does not pass"
    finding = f"The bench {word}: flux within {np.percentile(np.abs(flux), 95):.3f} mag, centroids within "
    with chart(path, f"{finding}{np.percentile(centroid, 95):.3f} px, for 95 % of stars", 2) as axes:
        for axis, values, limit, label in (
            (axes[0], flux, limits.flux_mag, "flux error [mag], + too faint"),
            (axes[1], centroid, limits.centroid_px, "centroid error [tracker px]"),
        ):
            axis.plot(v_mag, values, ".", markersize=4, alpha=0.6)
            axis.axhline(limit, color="tab:red", linestyle="--", linewidth=1, label="limit, for 95 % of stars")
            axis.set_ylabel(label)
        axes[0].axhline(-limits.flux_mag, color="tab:red", linestyle="--", linewidth=1)
        axes[0].legend(loc="upper left")
        axes[1].set_xlabel("V [mag]")


def _draw_field(path: Path, errors: DisplayErrors, resolution_px: tuple[int, int]) -> None:
    x, y, dx, dy = (np.array([getattr(star, name) for star in errors.stars]) for name in ("x_px", "y_px", "dx_px", "dy_px"))
    longest, arrow_px = max(p95(np.hypot(dx, dy)), 1e-9), ARROW_SHARE * resolution_px[0]
    finding = f"Centroid errors of {len(x)} stars over the tracker's field; {len(errors.lost)} stars are lost"
    with chart(path, finding) as (axis,):
        axis.plot(x, y, ".", color="C0", markersize=3)
        arrows = axis.quiver(x, y, dx, dy, angles="xy", scale_units="xy", scale=longest / arrow_px, width=0.002, color="C0")
        axis.quiverkey(arrows, 1.12, 0.95, longest, f"{longest:.2g} px", labelpos="S")
        if errors.lost:
            axis.plot([s.x_px for s in errors.lost], [s.y_px for s in errors.lost], "x", color="tab:red", label="lost")
            axis.legend(loc="center left", bbox_to_anchor=(1.02, 0.5))
        axis.set_xlim(0, resolution_px[0])
        axis.set_ylim(resolution_px[1], 0)
        axis.set_aspect("equal")
        axis.set_xlabel("x [tracker px]")
        axis.set_ylabel("y [tracker px]")
