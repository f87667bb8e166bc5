"""A drawing of single stars for a page: detection against magnitude, and the map of place errors;
of an assessment and of an acceptance.
"""

from collections.abc import Iterator

import numpy as np

from hilstar.basics.charts import BLUE, MUTED, panels_of
from hilstar.basics.pages import drawing_of
from hilstar.instruments.assess.bounded_figures import clopper_pearson
from hilstar.instruments.assess.star_figures import StarTable, place_map

GRID = 8  # arrows along each side of the map of place errors
MAG_BINS = 12
END = 0.975  # confidence of each end of a 95 % interval


def star_drawing(stars: StarTable, resolution_px: tuple[int, int]) -> str:
    """The drawing. Raises TooFewCases for too few stars."""
    offsets_px = place_map(stars, resolution_px, GRID)
    bins = list(_detection(stars))
    at, share, below, above = np.array(bins).T
    distance_px = np.hypot(offsets_px.dx_px, offsets_px.dy_px)
    largest_px = float(distance_px.max())
    finding = f"Stars reported by magnitude; their places are off by at most {largest_px:.2g} px"
    with panels_of(finding, 1, 2, share_x=False, height_inch=3.6) as (curve, right):
        curve.errorbar(at, share, yerr=[below, above], fmt="o", capsize=3, color=BLUE, ecolor=MUTED)
        curve.set_ylim(-0.05, 1.05)
        curve.set_xlabel("V [mag]")
        curve.set_ylabel("share reported")
        arrows = (offsets_px.x_px, offsets_px.y_px, offsets_px.dx_px, offsets_px.dy_px)
        right.quiver(*arrows, angles="xy", color=BLUE)
        right.set_xlabel("x [px]")
        right.set_ylabel("y [px]")
        right.invert_yaxis()
        right.set_aspect("equal")
    return drawing_of(curve.figure, "detection against magnitude, and the map of place errors")


def _detection(stars: StarTable) -> Iterator[tuple[float, float, float, float]]:
    """Of bins of magnitude: middle, share of stars reported, and 95 % below and above that."""
    brightest_mag = float(stars.v_mag.min())
    faintest_mag = float(stars.v_mag.max())
    edges = np.linspace(brightest_mag, faintest_mag + 1e-6, MAG_BINS + 1)
    place = np.digitize(stars.v_mag, edges) - 1
    for k in range(MAG_BINS):
        in_bin = place == k
        lit = int(in_bin.sum())
        if not lit:
            continue
        reported = int((stars.found & in_bin).sum())
        low, high = clopper_pearson(reported, lit, END)
        share = reported / lit
        middle_mag = float(edges[k] + edges[k + 1]) / 2
        yield middle_mag, share, share - low, high - share
