"""What `hilstar compare -o DIR` writes: a table of all stars, and a chart."""

from __future__ import annotations

from pathlib import Path

from hilstar.charts import write_csv
from hilstar.testing.chart import draw
from hilstar.testing.sky_comparison import SkyComparison
from hilstar.testing.star_difference import StarDifference

COLUMNS = (
    "kind",
    "hip",
    "x_px",
    "y_px",
    "flux_e_per_s",
    "flux_error_mag",
    "dx_px",
    "dy_px",
    "centroid_error_px",
    "flux_limit_mag",
    "centroid_limit_px",
    "differs",  # 1 where the star differs from what is common to all
)


def write_report(directory: Path, comparison: SkyComparison) -> None:
    """compare.csv, a row for each star, and the chart compare, errors against magnitude, as PNG and SVG.

    Raises InputError where one cannot be written.
    """
    odd = {(star.hip, star.x_px, star.y_px) for star in comparison.differing}
    rows = ((*_row(star), int((star.hip, star.x_px, star.y_px) in odd)) for star in comparison.stars)
    write_csv(directory / "compare.csv", COLUMNS, rows)
    draw(directory / "compare", comparison)


def _row(star: StarDifference) -> tuple[object, ...]:
    hip = " ".join(map(str, star.hip))
    errors = star.flux_error_mag, star.dx_px, star.dy_px, star.centroid_error_px
    return star.kind, hip, star.x_px, star.y_px, star.flux_e_per_s, *errors, star.limits.flux_mag, star.limits.centroid_px
