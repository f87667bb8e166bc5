"""Two images of one sky, star by star: what a change of driver may do, and what it may not.

Stars are found in the golden image and fitted in both (see star_fit); what a fit cannot tell, for the rounding of the light
around a star, widens that star's limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hilstar.arrays import FloatArray, IntArray
from hilstar.errors import InputError
from hilstar.testing.common_difference import common_change
from hilstar.testing.sky_difference import CENTROID_PX, FLUX_MAG, MAG_PER_SHARE, Limits, SkyComparison, StarDifference
from hilstar.testing.star_fit import RIPPLE_SHARE, StarTemplates, around, bright_pixels, refined, shifts_px, star_sigma_px

__all__ = ["CENTROID_PX", "FLUX_MAG", "Limits", "SkyComparison", "Truth", "check_skies", "compare_skies", "describes"]

# Of a star's flux: what float32 may do to any pixel that the star reaches. Measured 7e-8 on llvmpipe against float64.
PIXEL_ERROR = 2e-7
# Two stars nearer than this are one blend: apart they would be known 10 times worse than alone (at 0.4 px; 5 at 0.85 px).
BLEND_SIGMAS, BLEND_PX = 1.5, 1.25
LEAST_IN_VIEW = 0.01  # of a star's light; the wing of a star off the image has no place
LARGEST_ERROR = 0.25  # of a star's flux, by rounding of brighter light on it: such a star is not compared
MISSING_SHARE = 0.01  # of its flux: 5 mag fainter is gone
MOVE_STEPS, SMALL_MOVE_PX = 4, 0.003  # a shift of this is first order within 1e-5 of the star's flux
FARTHEST_SIGMAS = 3.0  # a star that moved farther is missing here and extra there
KNOWN_STARS = 20  # the brightest, at least half of which a truth table must have

Truth = npt.NDArray[np.void]


@dataclass(frozen=True, slots=True)
class _Seeds:
    """Stars to be fitted: places (n, 2), px, and the HIP numbers of each, none where no table has it."""

    places_px: FloatArray
    hip: list[tuple[int, ...]]

    @property
    def stars(self) -> int:
        """How many stars there are, each of a blend counted."""
        return sum(max(len(hip), 1) for hip in self.hip)

    def only(self, kept: npt.NDArray[np.bool_]) -> _Seeds:
        return _Seeds(self.places_px[kept], [hip for hip, keep in zip(self.hip, kept, strict=True) if keep])


def compare_skies(
    frame: FloatArray,
    golden: FloatArray,
    limits: Limits,
    truth: Truth | None = None,
    frame_truth: Truth | None = None,
) -> SkyComparison:
    """Compare two linear images (height, width) star by star, named by their tables (TRUTH_DTYPE), `truth` the golden one's.

    Raises InputError for images of different size or with a pixel that is not finite, a golden one without a star, and a
    `truth` of another sky.
    """
    check_skies(frame, golden)
    sigma_px = star_sigma_px(golden)
    blend_px = _blend_px(sigma_px)
    seeds, unmeasured = _measurable(golden, _seeds(golden, truth, sigma_px), sigma_px)
    if not seeds.hip:
        raise InputError("compare: no star of the golden image has enough light in view; give one that has")
    fit = _Fit(golden, seeds.places_px, sigma_px)
    moved = fit.follow(frame)
    stars = _differences(seeds, fit, moved, limits)
    more, less = moved.residual - fit.residual, fit.residual - moved.residual
    for light, table, error in ((less, truth, math.inf), (more, truth if frame_truth is None else frame_truth, -math.inf)):
        places, flux = _unexplained(light, fit, moved)
        stars += [
            StarDifference(hip, float(x), float(y), float(f), error, 0.0, 0.0, limits)
            for hip, (x, y), f in zip(_names(places, table, blend_px), places, flux, strict=True)
        ]
    return SkyComparison(stars, limits, unmeasured, common_change(stars, (golden.shape[1], golden.shape[0])))


def describes(truth: Truth, image: FloatArray) -> bool:
    """Whether a table (TRUTH_DTYPE) has at least half of the brightest stars of a linear image (height, width)."""
    sigma_px = star_sigma_px(image)
    return _has(truth, bright_pixels(image, RIPPLE_SHARE * around(image, sigma_px)), _blend_px(sigma_px))


def _blend_px(sigma_px: tuple[float, float]) -> float:
    return max(BLEND_SIGMAS * max(sigma_px), BLEND_PX)


def check_skies(frame: FloatArray, golden: FloatArray) -> None:
    """Raise InputError where two images cannot be compared, as `compare_skies` does."""
    for name, image in (("frame", frame), ("golden", golden)):
        if image.ndim != 2 or min(image.shape) < 2:
            raise InputError(f"compare: the {name} image has the shape {image.shape}; give a linear image (height, width)")
        if not np.isfinite(image).all():
            raise InputError(f"compare: the {name} image has a pixel that is NaN or infinite; give finite numbers")
    if frame.shape != golden.shape:
        (height, width), (golden_height, golden_width) = frame.shape, golden.shape
        raise InputError(
            f"compare: {width} x {height} px against {golden_width} x {golden_height} px; give images of one monitor"
        )
    if not (golden > 0).any():
        raise InputError("compare: the golden image has no star; give one that has")


def _seeds(golden: FloatArray, truth: Truth | None, sigma_px: tuple[float, float]) -> _Seeds:
    """The table's stars, and the image's where the table has none; blends are one."""
    blend_px = _blend_px(sigma_px)
    found = bright_pixels(golden, RIPPLE_SHARE * around(golden, sigma_px))
    if truth is None:
        return _nameless(found, blend_px)
    if not _has(truth, found, blend_px):
        raise InputError(
            "compare: the truth table's stars are not where the golden image has them; give the table of that frame"
        )
    table = truth[np.argsort(-truth["electrons_per_s"], kind="stable")]
    places = _places_px(table)
    listed = _blended(_Seeds(places, [(int(hip),) for hip in table["hip"]]), blend_px)
    # The light of a star off the image is brightest at the image's edge.
    shown = np.clip(places, 0, np.array([golden.shape[1], golden.shape[0]]) - 1)
    away = _nearest(shown, found)[0] > blend_px
    unlisted = _nameless(found[away], blend_px)
    return _Seeds(np.concatenate([listed.places_px, unlisted.places_px]), listed.hip + unlisted.hip)


def _has(truth: Truth, found_px: FloatArray, blend_px: float) -> bool:
    if not len(truth) or not len(found_px):
        return False
    return bool(np.median(_nearest(_places_px(truth), found_px[:KNOWN_STARS])[0]) <= blend_px)


def _places_px(truth: Truth) -> FloatArray:
    return np.column_stack([truth["x_px"], truth["y_px"]])


def _nearest(known_px: FloatArray, places_px: FloatArray) -> tuple[FloatArray, IntArray]:
    """For each of places (n, 2): how far the nearest known one is, px, and which."""
    distance_px, nearest = cKDTree(known_px).query(places_px)
    return np.asarray(distance_px), np.asarray(nearest, dtype=np.intp)


def _nameless(places_px: FloatArray, blend_px: float) -> _Seeds:
    return _blended(_Seeds(places_px, [()] * len(places_px)), blend_px)


def _blended(seeds: _Seeds, blend_px: float) -> _Seeds:
    """One seed for each chain of near ones, at the place of its first, which is its brightest."""
    size = len(seeds.places_px)
    pairs = cKDTree(seeds.places_px).query_pairs(blend_px, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    group = np.asarray(connected_components(links, directed=False)[1], dtype=np.intp) if size else np.zeros(0, dtype=np.intp)
    _, first = np.unique(group, return_index=True)
    hips: dict[int, tuple[int, ...]] = {}
    for label, hip in zip(group.tolist(), seeds.hip, strict=True):
        hips[label] = hips.get(label, ()) + hip
    return _Seeds(seeds.places_px[first], [hips[label] for label in group[first].tolist()])


def _measurable(golden: FloatArray, seeds: _Seeds, sigma_px: tuple[float, float]) -> tuple[_Seeds, int]:
    """The seeds whose light can be told from the rounding of their neighbours', at their places; and how many stars cannot."""
    count, shape = seeds.stars, (golden.shape[0], golden.shape[1])
    seeds = _in_view(seeds, sigma_px, shape)
    seeds = _in_view(_Seeds(refined(golden, seeds.places_px, sigma_px), seeds.hip), sigma_px, shape)
    templates = StarTemplates(seeds.places_px, sigma_px, shape)
    flux = templates.fit(golden)[:, 0]
    seeds = seeds.only(flux > templates.errors(flux, PIXEL_ERROR)[0] / LARGEST_ERROR)
    return seeds, count - seeds.stars


def _in_view(seeds: _Seeds, sigma_px: tuple[float, float], shape: tuple[int, int]) -> _Seeds:
    return seeds.only(StarTemplates(seeds.places_px, sigma_px, shape).in_view >= LEAST_IN_VIEW)


class _Fit:
    """All stars of one image, fitted at `places_px`: what they are, and the light (height, width) that they leave."""

    def __init__(self, image: FloatArray, places_px: FloatArray, sigma_px: tuple[float, float]) -> None:
        self.light = image
        self.sigma_px = sigma_px
        self.templates = StarTemplates(places_px, sigma_px, (image.shape[0], image.shape[1]))
        fitted = self.templates.fit(image)
        self.flux = fitted[:, 0]
        self.places_px = places_px + shifts_px(fitted)
        self.model = self.templates.image(fitted)
        self.residual = image - self.model

    def follow(self, frame: FloatArray) -> _Fit:
        """The same stars in another image: the same templates, but for those that moved."""
        start = self.templates.places_px
        fit = _Fit(frame, start, self.sigma_px)
        for _ in range(MOVE_STEPS):
            shift = np.hypot(*(fit.places_px - self.places_px).T)
            there = fit.flux > MISSING_SHARE * self.flux
            moved = there & (shift > SMALL_MOVE_PX) & (shift <= FARTHEST_SIGMAS * max(self.sigma_px))
            if not moved.any():
                break
            fit = _Fit(frame, start + np.where(moved[:, None], fit.places_px - self.places_px, 0.0), self.sigma_px)
        return fit


def _differences(seeds: _Seeds, fit: _Fit, moved: _Fit, limits: Limits) -> list[StarDifference]:
    flux_error, place_error_px = fit.templates.errors(fit.flux, PIXEL_ERROR)
    limit_mag = np.maximum(MAG_PER_SHARE * flux_error / fit.flux, limits.flux_mag)
    limit_px = np.maximum(place_error_px, limits.centroid_px)
    shift = moved.places_px - fit.places_px
    gone = (moved.flux <= MISSING_SHARE * fit.flux) | (np.hypot(*shift.T) > FARTHEST_SIGMAS * max(fit.sigma_px))
    ratio = np.where(gone, 1.0, moved.flux / fit.flux)
    error_mag = np.where(gone, np.inf, -2.5 * np.log10(ratio))
    columns = (*fit.places_px.T, fit.flux, error_mag, *np.where(gone, 0.0, shift.T), limit_mag, limit_px)
    return [
        StarDifference(hip, x_px, y_px, flux, mag, dx_px, dy_px, Limits(own_mag, own_px))
        for hip, (x_px, y_px, flux, mag, dx_px, dy_px, own_mag, own_px) in zip(
            seeds.hip, np.column_stack(columns).tolist(), strict=True
        )
    ]


def _unexplained(light: FloatArray, fit: _Fit, moved: _Fit) -> tuple[FloatArray, FloatArray]:
    """Places (n, 2), px, and fluxes of stars in light that no star of either fit explains.

    What a changed star leaves, for it is no exact Gaussian, is under half of its change. A star off the image may be as bright
    as any on it, and its wing as far off as that one's rounding.
    """
    change = np.maximum(np.abs(moved.model - fit.model), np.abs(light))
    floor = RIPPLE_SHARE * np.maximum(fit.light, moved.light) + 0.5 * change
    rounding = PIXEL_ERROR * max(fit.flux.max(initial=0.0), moved.flux.max(initial=0.0))
    seeds = _nameless(bright_pixels(light, around(floor, fit.sigma_px) + rounding), _blend_px(fit.sigma_px)).places_px
    places = refined(light, seeds, fit.sigma_px)
    flux = StarTemplates(places, fit.sigma_px, (light.shape[0], light.shape[1])).fit(light)[:, 0]
    column, row = seeds.astype(np.intp).T
    return places, np.maximum(flux, light[row, column])  # two that lie on each other may share it as more and less than nothing


def _names(places_px: FloatArray, truth: Truth | None, blend_px: float) -> list[tuple[int, ...]]:
    """The HIP number of the table's star at each place, where it has one."""
    if truth is None or not len(truth) or not len(places_px):
        return [()] * len(places_px)
    distance, nearest = _nearest(_places_px(truth), places_px)
    return [(int(truth["hip"][k]),) if d <= blend_px else () for d, k in zip(distance, nearest, strict=True)]
