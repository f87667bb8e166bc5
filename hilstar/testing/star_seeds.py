"""Which stars of an image are to be fitted: those of a truth table, those found in the image, near ones as one blend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hilstar.arrays import FloatArray, IntArray
from hilstar.errors import InputError
from hilstar.testing.star_fit import RIPPLE_SHARE, around, bright_pixels, star_sigma_px

# Two stars nearer than this are one blend: apart they would be known 10 times worse than alone (at 0.4 px; 5 at 0.85 px).
BLEND_SIGMAS, BLEND_PX = 1.5, 1.25
KNOWN_STARS = 20  # the brightest, at least half of which a truth table must have

# Rows of bench.truth.TRUTH_DTYPE.
Truth = npt.NDArray[np.void]


@dataclass(frozen=True, slots=True)
class Seeds:
    """Stars to be fitted: places (n, 2), px, and the HIP numbers of each (a body's name), none where no table has it."""

    places_px: FloatArray
    hip: list[tuple[int | str, ...]]

    @property
    def stars(self) -> int:
        """How many stars there are, each of a blend counted."""
        return sum(max(len(hip), 1) for hip in self.hip)

    def only(self, kept: npt.NDArray[np.bool_]) -> Seeds:
        """The seeds (n,) that are `kept`."""
        return Seeds(self.places_px[kept], [hip for hip, keep in zip(self.hip, kept, strict=True) if keep])


def find_seeds(golden: FloatArray, truth: Truth | None, sigma_px: tuple[float, float]) -> Seeds:
    """The table's stars, and the image's where the table has none. Raises InputError for a table of another sky."""
    found = bright_pixels(golden, RIPPLE_SHARE * around(golden, sigma_px))
    if truth is None:
        return nameless_seeds(found, sigma_px)
    blend_px = blend_distance_px(sigma_px)
    if not _has(truth, found, blend_px):
        raise InputError(
            "compare: the truth table's stars are not where the golden image has them; give the table of that frame"
        )
    table = truth[np.argsort(-truth["electrons_per_s"], kind="stable")]
    places = _places_px(table)
    listed = _blended(Seeds(places, [_designation(row) for row in table]), blend_px)
    # The light of a star off the image is brightest at the image's edge.
    shown = np.clip(places, 0, np.array([golden.shape[1], golden.shape[0]]) - 1)
    away = _nearest(shown, found)[0] > blend_px
    unlisted = nameless_seeds(found[away], sigma_px)
    return Seeds(np.concatenate([listed.places_px, unlisted.places_px]), listed.hip + unlisted.hip)


def nameless_seeds(places_px: FloatArray, sigma_px: tuple[float, float]) -> Seeds:
    """Seeds at places (n, 2), px, brightest first; those closer than a blend are one."""
    return _blended(Seeds(places_px, [()] * len(places_px)), blend_distance_px(sigma_px))


def blend_distance_px(sigma_px: tuple[float, float]) -> float:
    """The distance within which two stars are one blend."""
    return max(BLEND_SIGMAS * max(sigma_px), BLEND_PX)


def describes(truth: Truth, image: FloatArray) -> bool:
    """Whether a table (TRUTH_DTYPE) has at least half of the brightest stars of a linear image (height, width)."""
    sigma_px = star_sigma_px(image)
    return _has(truth, bright_pixels(image, RIPPLE_SHARE * around(image, sigma_px)), blend_distance_px(sigma_px))


def names_at(places_px: FloatArray, truth: Truth | None, blend_px: float) -> list[tuple[int | str, ...]]:
    """The HIP number of the table's star at each place (n, 2), px, where it has one."""
    if truth is None or not len(truth) or not len(places_px):
        return [()] * len(places_px)
    distance, nearest = _nearest(_places_px(truth), places_px)
    return [_designation(truth[k]) if d <= blend_px else () for d, k in zip(distance, nearest, strict=True)]


def _designation(row: np.void) -> tuple[int | str, ...]:
    return (str(row["name"]) or int(row["hip"]),)


def _has(truth: Truth, found_px: FloatArray, blend_px: float) -> bool:
    if not len(truth) or not len(found_px):
        return False
    return bool(np.median(_nearest(_places_px(truth), found_px[:KNOWN_STARS])[0]) <= blend_px)


def _places_px(truth: Truth) -> FloatArray:
    return np.column_stack([truth["x_px"], truth["y_px"]])


def _nearest(known_px: FloatArray, places_px: FloatArray) -> tuple[FloatArray, IntArray]:
    """For each of places (n, 2): the distance to the nearest known one, px, and its index."""
    distance_px, nearest = cKDTree(known_px).query(places_px)
    return np.asarray(distance_px), np.asarray(nearest, dtype=np.intp)


def _blended(seeds: Seeds, blend_px: float) -> Seeds:
    """One seed for each chain of near ones, at the place of its first, which is its brightest."""
    size = len(seeds.places_px)
    pairs = cKDTree(seeds.places_px).query_pairs(blend_px, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    group = np.asarray(connected_components(links, directed=False)[1], dtype=np.intp) if size else np.zeros(0, dtype=np.intp)
    _, first = np.unique(group, return_index=True)
    hips: dict[int, tuple[int | str, ...]] = {}
    for label, hip in zip(group.tolist(), seeds.hip, strict=True):
        hips[label] = hips.get(label, ()) + hip
    return Seeds(seeds.places_px[first], [hips[label] for label in group[first].tolist()])
