"""The place of a star field in the field of view, and smooth functions of that place.

A place is six numbers in pixels: the boresight (ICRS) times the focal length, and the camera's x
axis times the usual distance of a star from the boresight. The distance of two places is how far
the field moves on the detector between the two attitudes, so that the same attitude is the same
place however the run got there. A smooth function of the place is a sum of bumps (Wendland 1995), a
`spacing` apart wherever the run has been.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg, sparse
from scipy.spatial import cKDTree

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import ARCSEC_PER_RAD

ROLL_SHARE = 0.3  # usual distance of a star from the boresight, in sides of the detector
# radius of a bump, in spacings: a sine of four spacings or longer is then fitted to 1 %
REACH = 2.5
CLOSE = 0.7  # bumps nearer than this, in spacings, are one
RIDGE = 1e-7  # share of the mean diagonal, for bumps that few samples tell apart


@dataclass(frozen=True, slots=True)
class Scale:
    """A tracker's focal length and detector's sides, in pixels."""

    focal_px: float
    resolution_px: tuple[int, int]

    @property
    def roll_px(self) -> float:
        """The usual distance of a star from the boresight."""
        return ROLL_SHARE * min(self.resolution_px)

    @property
    def pixel_arcsec(self) -> float:
        """The angle of a pixel in the middle of the field."""
        return ARCSEC_PER_RAD / self.focal_px


def spread_rows(count: int, some: int) -> IntArray:
    """At most `some` rows of `count`, spread evenly over them."""
    places = np.linspace(0, count - 1, some)
    return np.unique(places.astype(int))


def places_of(axes: FloatArray, focal_px: float, roll_px: float) -> FloatArray:
    """The places (n, 6), px, of attitudes with axes (n, 3, 3)."""
    return np.concatenate([focal_px * axes[:, 2], roll_px * axes[:, 0]], axis=1)


def centres_of(place: FloatArray, spacing_px: float) -> FloatArray:
    """Centres (p, 6) about a spacing apart that cover the places (n, 6)."""
    cell = np.floor(place / spacing_px).astype(np.int64)
    _, first, inverse = np.unique(_numbers(cell), return_index=True, return_inverse=True)
    # cells in the order in which they were first seen
    inverse = np.argsort(np.argsort(first))[inverse]
    count = np.bincount(inverse)
    sums = []
    for column in place.T:
        sums.append(np.bincount(inverse, column))
    mean = np.stack(sums, axis=1) / count[:, None]
    is_kept = np.ones(len(mean), dtype=bool)
    close_pairs = cKDTree(mean).query_pairs(CLOSE * spacing_px)
    for a, b in sorted(close_pairs):
        if is_kept[a] and is_kept[b]:
            is_kept[b] = False
    return np.asarray(mean[is_kept])


def _numbers(cell: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """A number (n,) for each cell (n, 6): a multiplicative hash without collisions among
    thousands of cells.
    """
    mixed = np.zeros(len(cell), dtype=np.uint64)
    for column in (cell - cell.min(axis=0)).T.astype(np.uint64):
        # 2^64 over the golden ratio (Knuth 1998, 6.4)
        mixed = (mixed ^ column) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return mixed.astype(np.int64)


def bumps_at(place: FloatArray, centre: FloatArray, spacing_px: float) -> sparse.csr_matrix:
    """The values (n, p) of bumps with centres (p, 6) at places (n, 6).

    The bumps of a sample add to 1, so a constant fits up to the edge.
    """
    radius_px = REACH * spacing_px
    tree = cKDTree(place)
    near = tree.sparse_distance_matrix(cKDTree(centre), radius_px, output_type="ndarray")
    r = near["v"] / radius_px
    value = (1 - r) ** 4 * (4 * r + 1)
    samples = near["i"]
    total = np.bincount(samples, value, minlength=len(place))
    share = value / total[samples]
    shape = (len(place), len(centre))
    return sparse.csr_matrix((share, (samples, near["j"])), shape=shape)


class Projector:
    """Least squares fits by the columns of a sparse matrix (n, p), with a ridge too small to
    matter.

    `freedom` is the number of degrees of freedom that a fit takes.
    """

    def __init__(self, value: sparse.csr_matrix) -> None:
        self.value = value
        gram = np.asarray((value.T @ value).todense())
        size = len(gram)
        mean_diagonal = float(np.trace(gram)) / max(size, 1)
        ridge = RIDGE * max(mean_diagonal, 1e-30)
        gram[np.diag_indices_from(gram)] += ridge
        self._factor = linalg.cho_factor(gram, lower=True, overwrite_a=True, check_finite=False)
        inverse, _ = linalg.lapack.dpotri(self._factor[0], lower=1)
        self.freedom = size - ridge * float(np.trace(inverse))

    def fit(self, wanted: FloatArray) -> FloatArray:
        """The fit (n, k) to values (n, k)."""
        projected = self.value.T @ wanted
        coefficient = linalg.cho_solve(self._factor, projected, check_finite=False)
        return np.asarray(self.value @ coefficient)
