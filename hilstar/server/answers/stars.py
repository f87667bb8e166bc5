"""Compares the single stars that a tracker reports with the stars that the display lit.

Reports are matched with all lit stars. The results are those of stars that stand alone, ALONE_PX
from any brighter star and from the edges: a tracker is not at fault where a star hides in the light
of another.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.rotation import to_matrix
from hilstar.basics.units import magnitude
from hilstar.optics.camera import Camera
from hilstar.server.answers.answer import ReportedStar
from hilstar.server.bench.cameras import tracker_camera
from hilstar.sky.stars import Stars

if TYPE_CHECKING:
    from hilstar.server.bench.frame import Bench

BoolArray = npt.NDArray[np.bool_]

MATCH_PX = 3.0  # a reported star farther from every lit one is a false star
ALONE_PX = 8.0
EDGE_PX = 1.0


@dataclass(frozen=True, slots=True)
class LitStars:
    """Stars (n,) that were lit within the detector: positions in tracker pixels, V magnitude,
    colour index B-V, and signal in electrons per second.
    """

    x_px: FloatArray
    y_px: FloatArray
    v_mag: FloatArray
    bv: FloatArray
    electrons_per_s: FloatArray

    @property
    def lit_mag(self) -> FloatArray:
        """The magnitude (n,) of each star's light, -2.5 log10 of its electrons per second."""
        return magnitude(self.electrons_per_s)

    def some(self, chosen: IntArray) -> "LitStars":
        """The stars with the indices `chosen` (m,)."""
        parts = (self.x_px, self.y_px, self.v_mag, self.bv, self.electrons_per_s)
        return LitStars(*(part[chosen] for part in parts))


@dataclass(frozen=True, slots=True)
class StarResiduals:
    """The residuals of the lit stars (n,) that stand alone: reported minus lit position, px, and
    the magnitude of the reported signal minus that of the star's light; NaN for a star that was not
    reported.

    The zero point of `signal_mag` is arbitrary. `false` counts reported stars that were not lit.
    """

    lit: LitStars
    dx_px: FloatArray
    dy_px: FloatArray
    signal_mag: FloatArray
    false: int


def judge_stars(
    reported: tuple[ReportedStar, ...], lit: LitStars, size_px: tuple[int, int]
) -> StarResiduals:
    """Match reported stars with lit stars within MATCH_PX, at most one report to a star, the
    brightest lit star first. `size_px` is the detector's (width, height).
    """
    order = np.argsort(-lit.electrons_per_s, kind="stable")
    lit = lit.some(order)
    dx_px, dy_px, signal_mag, false = _matched(reported, lit)
    alone = np.flatnonzero(_stands_alone(lit, size_px))
    return StarResiduals(lit.some(alone), dx_px[alone], dy_px[alone], signal_mag[alone], false)


def lit_by_report(
    reported: tuple[ReportedStar, ...], lit: LitStars, size_px: tuple[int, int]
) -> IntArray:
    """The index in `lit` of the star that each report (n,) is of, where reports are matched one at
    a time: the brightest within MATCH_PX, if it stands alone; -1 for any other report. `size_px` is
    the detector's (width, height).
    """
    indices = np.full(len(reported), -1)
    if not reported or not len(lit.x_px):
        return indices
    order = np.argsort(-lit.electrons_per_s, kind="stable")
    lit = lit.some(order)
    alone = _stands_alone(lit, size_px)
    places_px = np.array([(star.x_px, star.y_px) for star in reported])
    tree = KDTree(np.stack([lit.x_px, lit.y_px], axis=1))
    near: Any = tree.query_ball_point(places_px, MATCH_PX)
    for report, candidates in enumerate(near):
        if candidates and alone[min(candidates)]:
            indices[report] = order[min(candidates)]
    return indices


def lit_at(
    q_icrs_to_cam: FloatArray, stars: Stars, camera: Camera, faintest_e_per_s: float
) -> LitStars:
    """The stars that a tracker's `camera` sees on its detector at an attitude, without stars
    fainter than `faintest_e_per_s`, electrons per second.
    """
    axes = to_matrix(q_icrs_to_cam)
    near = stars.near(axes[2], camera.field_radius_rad(EDGE_PX))
    near = near[stars.electrons_per_s[near] >= faintest_e_per_s]
    rays = stars.directions(near) @ axes.T
    x_px, y_px = camera.project(rays @ camera.cam_to_image.T)
    width, height = camera.resolution_px
    with np.errstate(invalid="ignore"):
        inside = (np.abs(x_px - (width - 1) / 2) <= width / 2) & (
            np.abs(y_px - (height - 1) / 2) <= height / 2
        )
    seen = near[inside]
    light = (stars.v_mag[seen], stars.bv_mag[seen], stars.electrons_per_s[seen])
    return LitStars(x_px[inside], y_px[inside], *light)


class ShownStars:
    """The stars that a bench shows to its tracker: of the tracker's field what the display covers.
    `size_px` is the detector's (width, height).
    """

    def __init__(self, bench: "Bench") -> None:
        self._stars = bench.stars
        self._display = bench.camera
        self._faintest_e_per_s = bench.faintest_shown_e_per_s
        self._tracker = tracker_camera(bench.config.tracker, bench.file.folder)
        self.size_px = self._tracker.resolution_px

    def judged(
        self, reported: tuple[ReportedStar, ...], q_icrs_to_cam: FloatArray
    ) -> StarResiduals:
        """Reported stars against those that are lit at an attitude (w, x, y, z)."""
        lit = lit_at(q_icrs_to_cam, self._stars, self._tracker, self._faintest_e_per_s)
        x_px, y_px = self._display.pixels_from(self._tracker, lit.x_px, lit.y_px)
        covered = np.flatnonzero(self._display.contains_px(x_px, y_px))
        return judge_stars(reported, lit.some(covered), self.size_px)


def _stands_alone(lit: LitStars, size_px: tuple[int, int]) -> BoolArray:
    """Whether each star (n,), sorted by brightness, has neither a brighter star nor an edge within
    ALONE_PX.
    """
    alone = np.ones(len(lit.x_px), dtype=np.bool_)
    for place_px, side in zip((lit.x_px, lit.y_px), size_px, strict=True):
        alone &= (place_px >= ALONE_PX) & (place_px <= side - 1 - ALONE_PX)
    if len(lit.x_px):
        places = np.stack([lit.x_px, lit.y_px], axis=1)
        pairs: Any = KDTree(places).query_pairs(ALONE_PX, output_type="ndarray")
        # Stars are sorted by brightness: the larger index of a pair is the fainter star.
        alone[pairs.max(axis=1)] = False
    return alone


def _matched(
    reported: tuple[ReportedStar, ...], lit: LitStars
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """The position errors in x and y (n,), px, the signals (n,), mag, of the lit stars, and the
    number of reports that match no star.
    """
    dx_px, dy_px, signal_mag = np.full((3, len(lit.x_px)), np.nan)
    if not reported or not len(lit.x_px):
        return dx_px, dy_px, signal_mag, len(reported)
    x_px = np.array([star.x_px for star in reported])
    y_px = np.array([star.y_px for star in reported])
    dn = np.array([np.nan if star.dn is None else star.dn for star in reported])
    places = KDTree(np.stack([x_px, y_px], axis=1))
    near: Any = places.query_ball_point(np.stack([lit.x_px, lit.y_px], axis=1), MATCH_PX)
    taken = np.zeros(len(reported), dtype=np.bool_)
    for star, candidates in enumerate(near):
        free = [k for k in candidates if not taken[k]]
        if not free:
            continue
        off_px = np.hypot(x_px[free] - lit.x_px[star], y_px[free] - lit.y_px[star])
        best = free[int(np.argmin(off_px))]
        taken[best] = True
        dx_px[star] = x_px[best] - lit.x_px[star]
        dy_px[star] = y_px[best] - lit.y_px[star]
        if dn[best] > 0:
            signal_mag[star] = magnitude(dn[best] / lit.electrons_per_s[star])
    return dx_px, dy_px, signal_mag, int((~taken).sum())
