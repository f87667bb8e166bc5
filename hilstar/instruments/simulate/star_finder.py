"""From an image to stars: the centroider as wide as the bench's stars, and which of its finds is
which star.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import magnitude
from hilstar.instruments.simulate.glass import told_psf
from hilstar.optics.psf import GaussianPsf, Psf
from hilstar.server.bench.frame import Bench
from hilstar.tracker.centroiders import Centroider, psf_places, star_places
from hilstar.tracker.centroids import (
    Centroids,
    CentroidSettings,
    LocalBackground,
    find_stars,
    squares,
)
from hilstar.tracker.mosaic import software_psf_px

USUAL: Centroider = "window"
MATCH_PX = 3.0  # a find farther from a star's place is not that star
# Others' light in a star's window, as a share of its own. Both images have it, so its effect is of
# second order: at
# 0.02, a neighbour 0.1 mag off adds 0.002 mag.
CROWDED_SHARE = 0.02
# how far a neighbour's light reaches: 1e-9 of it, and Sirius is 4e3 times a star of the seventh
# magnitude
WING_SIGMAS = 6.0
MOSAIC_SHARE = 0.25  # least part of a star's light that a mosaic has: that of red alone
MIN_PEAK = 0.2  # a blob begins at this share of the faintest drawn star's peak


class Difference(NamedTuple):
    """Stars (n,) in one image against themselves in another: magnitudes too faint, px right and
    down; NaN if not found.
    """

    flux_mag: FloatArray
    x_px: FloatArray
    y_px: FloatArray


@dataclass(frozen=True, slots=True)
class Matched:
    """The sources found in an image, and the index of each star's source (n,); -1 for none."""

    found: Centroids
    index: IntArray

    def against(self, other: "Matched", k: IntArray) -> Difference:
        """Stars `k` (n,) against themselves in another image."""
        difference = Difference(*np.full((3, len(k)), np.nan))
        a = self.found
        b = other.found
        both = np.flatnonzero((self.index[k] >= 0) & (other.index[k] >= 0))
        i = self.index[k[both]]
        j = other.index[k[both]]
        ratio = a.flux[i] / b.flux[j]
        difference.flux_mag[both] = magnitude(np.maximum(ratio, 0.0))
        difference.x_px[both] = a.x_px[i] - b.x_px[j]
        difference.y_px[both] = a.y_px[i] - b.y_px[j]
        return difference


@dataclass(frozen=True, slots=True)
class StarFinder:
    """A centroider for a bench's stars: their PSF on the tracker, and the background for
    noiseless images.
    """

    settings: CentroidSettings
    psf: Psf
    background: LocalBackground
    centroider: Centroider = USUAL
    # a star's PSF as shown, where the tracker's is no Gaussian: what `psf` fits
    told: Psf | None = None

    def match(self, image_e: FloatArray, x_px: FloatArray, y_px: FloatArray) -> Matched:
        """The stars of a noiseless image (h, w) at their places (n,), where the bench's own
        centroider finds them.
        """
        matched = self.find(image_e, x_px, y_px)
        return self.placed(matched, image_e, (x_px, y_px), self.centroider)

    def find(self, image_e: FloatArray, x_px: FloatArray, y_px: FloatArray) -> Matched:
        """The stars of a noiseless image (h, w) at their places (n,), where a window finds them.

        A tracker subtracts the screen's glow around each star: here it is not added in the first
        place.
        """
        stars_found = find_stars(image_e, self.settings, self.background)
        return Matched(stars_found, nearest(stars_found, x_px, y_px))

    def placed(
        self,
        matched: Matched,
        image: npt.NDArray[Any],
        true_px: tuple[FloatArray, FloatArray],
        kind: Centroider,
        level: float = 0.0,
    ) -> Matched:
        """The stars that a window has found where another centroider has them, above the image's
        `level`.

        A box is about the pixel of the star's true place, or as many whole pixels aside as the star
        is.
        """
        stars_found = matched.found
        stars = np.flatnonzero(matched.index >= 0)
        if kind == "window" or not len(stars):
            return matched
        index = matched.index[stars]
        true_x_px, true_y_px = true_px[0][stars], true_px[1][stars]
        aside_x = np.rint(stars_found.x_px[index] - true_x_px)
        aside_y = np.rint(stars_found.y_px[index] - true_y_px)
        column = np.rint(true_x_px + aside_x).astype(np.intp)
        row = np.rint(true_y_px + aside_y).astype(np.intp)
        reach = self.settings.radius_px
        stamps = squares(image, level, column, row, reach)[0]
        middle = np.full(len(stars), reach)
        dx_px, dy_px = star_places(stamps, kind, self.psf.width_px, (middle, middle))
        if kind == "psf" and self.told is not None:
            stated_psf = told_psf(self.told, (row, column), 2 * reach + 1)
            dx_px, dy_px = psf_places(stamps, stated_psf, (dx_px, dy_px))
        x_px = stars_found.x_px.copy()
        y_px = stars_found.y_px.copy()
        x_px[index] = column + dx_px
        y_px[index] = row + dy_px
        centroids = replace(stars_found, x_px=x_px, y_px=y_px)
        return Matched(centroids, matched.index)


def star_finder(bench: Bench, monitor_px_per_px: float) -> StarFinder:
    """The finder for a bench's stars; `monitor_px_per_px` monitor pixels are as wide as a
    tracker pixel.
    """
    psf = seen_psf(bench, monitor_px_per_px)
    settings = CentroidSettings(window_sigma_px=max(1.0, *psf.width_px))
    peak_e = faintest_e_per_s(bench) * bench.config.tracker.exposure_s * psf.peak_share
    if bench.config.tracker.detector.bayer is not None:
        peak_e *= MOSAIC_SHARE
    under = LocalBackground(0.0, MIN_PEAK * peak_e / settings.threshold_sigma)
    centroider = bench.config.verify.centroider
    stated_psf = None
    if centroider == "psf" and not isinstance(bench.tracker_psf, GaussianPsf):
        variance_px2 = np.mean(_shown_px2(bench, monitor_px_per_px))
        stated_psf = bench.tracker_psf.blurred(float(np.sqrt(variance_px2)))
    return StarFinder(settings, psf, under, centroider or USUAL, stated_psf)


def seen_psf(bench: Bench, monitor_px_per_px: float) -> Psf:
    """The Gaussian nearest to a star on the tracker, in its pixels: sprite, monitor pixel and
    the tracker's own PSF.
    """
    shown_x_px2, shown_y_px2 = _shown_px2(bench, monitor_px_per_px)
    tracker_x_px, tracker_y_px = bench.tracker_psf.width_px
    x_px = math.sqrt(shown_x_px2 + tracker_x_px**2)
    y_px = math.sqrt(shown_y_px2 + tracker_y_px**2)
    return GaussianPsf(software_psf_px((x_px, y_px), bench.config.tracker.detector))


def _shown_px2(bench: Bench, monitor_px_per_px: float) -> list[float]:
    """Variances along x and y of a star's light on the monitor, px^2 of the tracker: two
    squares, sampled and shown.
    """
    return [(s**2 + 1 / 6) / monitor_px_per_px**2 for s in bench.psf.width_px]


def faintest_e_per_s(bench: Bench) -> float:
    """The rate of the faintest star or body that the bench draws."""
    rates = bench.shown_stars.electrons_per_s
    drawn = rates[rates >= bench.faintest_shown_e_per_s]
    if not len(drawn):
        return 1.0
    return float(drawn.min())


def nearest(found: Centroids, x_px: FloatArray, y_px: FloatArray) -> IntArray:
    """For each place (n,) the star found nearest within MATCH_PX, -1 for none."""
    places = np.stack([x_px, y_px], axis=1)
    centroids = np.stack([found.x_px, found.y_px], axis=1)
    place, centroid, distance = neighbours(places, centroids, MATCH_PX)
    index = np.full(len(x_px), -1, dtype=np.intp)
    order = np.argsort(-distance, kind="stable")
    index[place[order]] = centroid[order]  # the nearest is written last
    return index


def neighbours(
    places: FloatArray, others: FloatArray, within: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs (m,) of places (n, 2) and others (k, 2) within a distance of each other, and it, by a
    sweep along x; none of NaN.

    For the few thousand stars of a field it takes as long as a tree of SciPy's, whose import takes
    0.1 s.
    """
    order = np.argsort(others[:, 0])
    x = others[order, 0]
    at = np.nan_to_num(places[:, 0], nan=np.inf)
    first = np.searchsorted(x, at - within)
    end = np.searchsorted(x, at + within, side="right")
    count = end - first
    place_row = np.repeat(np.arange(len(places)), count)
    # the pairs of a place are `count` rows of `order` from its first on
    to_first = first - np.cumsum(count) + count
    other = order[np.arange(len(place_row)) + np.repeat(to_first, count)]
    offset = places[place_row] - others[other]
    distance = np.hypot(*offset.T)
    near = distance <= within
    return place_row[near], other[near], distance[near]


def shared(match: IntArray) -> npt.NDArray[np.bool_]:
    """True for places whose match is another one's too."""
    used, counts = np.unique(match, return_counts=True)
    counts_of_match = counts[np.searchsorted(used, match)]
    return np.asarray((match >= 0) & (counts_of_match > 1))


def inside_by(
    margin_px: float, x_px: FloatArray, y_px: FloatArray, resolution_px: tuple[int, int]
) -> npt.NDArray[np.bool_]:
    """True for places (n,) farther than a margin from the middles of an image's outermost
    pixels.
    """
    width, height = resolution_px
    across = (x_px > margin_px) & (x_px < width - 1 - margin_px)
    down = (y_px > margin_px) & (y_px < height - 1 - margin_px)
    return np.asarray(across & down)


def crowded(
    x_px: FloatArray, y_px: FloatArray, flux: FloatArray, radius_px: int, psf: Psf
) -> npt.NDArray[np.bool_]:
    """True for stars (n,) into whose window any other brings more than CROWDED_SHARE of their
    own light.
    """
    places = np.stack([x_px, y_px], axis=1)
    half = radius_px + 0.5
    result = np.zeros(len(flux), dtype=np.bool_)
    reach_px = math.sqrt(2) * half + WING_SIGMAS * max(psf.width_px)
    star, other, _ = neighbours(places, places, reach_px)
    star, other = star[star != other], other[star != other]
    offset_px = places[other] - np.rint(places[star])
    upper = ndtr((offset_px + half) / psf.width_px)
    lower = ndtr((offset_px - half) / psf.width_px)
    share = (upper - lower).prod(axis=1)
    is_crowded = flux[other] * share > CROWDED_SHARE * flux[star]
    result[star[is_crowded]] = True
    return result
