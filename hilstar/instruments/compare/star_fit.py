"""Stars of a noiseless linear image: found, and fitted all at once, so that a neighbour's light
causes no error.

Each star is a Gaussian integrated over pixels, as the renderer draws it, with its derivatives along
x and y. Fluxes and shifts of all stars are one linear least-squares problem. A star that is dimmed
by any amount is measured exactly, a shifted one to first order in its shift. Light that no star
explains stays in the residual. The stars to fit come from a truth table or are found in the image;
near ones are one blend.
"""

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.sparse import coo_array, csc_array, eye_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu
from scipy.spatial import cKDTree
from scipy.special import ndtr

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.optics.psf import GaussianPsf, Psf
from hilstar.optics.psf_fit import XY, PointGaussians, PointImages, fit_each

# Around a bright star float32 leaves ripples of 2e-6 of its peak (4.4e-7 of its flux, see
# tests/gpu), which are no stars.
RIPPLE_SHARE = 1e-5
SIGMA_STARS = 30  # the brightest ones give the sigma; their median is no blend's
SIGMA_ROUNDS = 12
MAX_PLACE_STEPS, MAX_STEP_PX, MIN_STEP_PX = 12, 1.0, 1e-5
# a star lies within sqrt(1/2) px of the middle of its brightest pixel, unless a neighbour pulls it
MAX_OFFSET_PX = 1.0
# ... and one whose brightest pixel is the image's first or last may be this far outside
BEYOND_SIGMAS = 4.0
# along y and x: light, derivative by x, by y
COLUMNS = (("share", "share"), ("share", "slope"), ("slope", "share"))
# ridge on unit columns: two equal columns share the light, where the solver would otherwise fail
RIDGE = 1e-12
# Two stars nearer than this are one blend: apart they would be known 10 times worse than alone (at
# 0.4 px; 5 at 0.85 px).
BLEND_SIGMAS, BLEND_PX = 1.5, 1.25
KNOWN_STARS = 20  # the brightest, at least half of which a truth table must have

# Rows of frame.truth.TRUTH_DTYPE.
Truth = npt.NDArray[np.void]


class StarTemplates:
    """Stars of flux 1 at `places_px` (n, 2) on an image of `shape` (height, width), each with its
    derivatives along x and y.

    A star's share of light that falls on the image is in `in_view` (n,).
    """

    def __init__(self, places_px: FloatArray, psf: Psf, shape: tuple[int, int]) -> None:
        self.places_px = places_px
        self.shape = shape
        reach_px = psf.footprint_px // 2 + 1
        height, width = shape
        sigma_x, sigma_y = psf.width_px
        self._x = _Profiles(places_px[:, 0], sigma_x, reach_px, width)
        self._y = _Profiles(places_px[:, 1], sigma_y, reach_px, height)
        self.in_view = self._x.share.sum(axis=1) * self._y.share.sum(axis=1)

    @cached_property
    def _columns(self) -> csc_array:
        """The light of each star and its derivatives (pixels, 3 n)."""
        size = len(self.places_px)
        columns = []
        for y_name, x_name in COLUMNS:
            down = getattr(self._y, y_name)
            across = getattr(self._x, x_name)
            columns.append(down[:, :, None] * across[:, None, :])
        data = np.stack(columns, axis=1)
        height, width = self.shape
        pixel = self._y.clipped[:, :, None] * width + self._x.clipped[:, None, :]
        index = np.broadcast_to(pixel[:, None], data.shape)
        pixels_of_star = math.prod(data.shape[2:])
        ends = np.arange(3 * size + 1) * pixels_of_star
        content = (data.ravel(), index.ravel(), ends)
        return csc_array(content, shape=(height * width, 3 * size))

    @cached_property
    def normal(self) -> csc_array:
        """The columns' products with one another (3 n, 3 n): along x times along y, for the
        stars that overlap.
        """
        size = len(self.places_px)
        width = self._x.share.shape[1]
        middles = np.column_stack([self._x.middle, self._y.middle])
        pairs = cKDTree(middles).query_pairs(width - 1, p=np.inf, output_type="ndarray")
        first, second = pairs.astype(np.intp).T
        # each star with itself, and each pair both ways round
        itself = np.arange(size)
        star = np.concatenate([itself, first, second])
        other = np.concatenate([itself, second, first])
        along_x = self._x.overlaps(star, other)
        along_y = self._y.overlaps(star, other)
        number_of = {"share": 0, "slope": 1}
        entries = [(number_of[y], number_of[x]) for y, x in COLUMNS]
        products = []
        for (ya, xa), (yb, xb) in itertools.product(entries, entries):
            products.append(along_y[:, ya, yb] * along_x[:, xa, xb])
        blocks = np.stack(products, axis=1)
        row = 3 * star[:, None] + np.arange(9) // 3
        col = 3 * other[:, None] + np.arange(9) % 3
        places = (row.ravel(), col.ravel())
        return csc_array((blocks.ravel(), places), shape=(3 * size, 3 * size))

    @cached_property
    def _scale(self) -> FloatArray:
        """Factors (3 n,) that bring the columns to unit length."""
        squares = np.maximum(self.normal.diagonal(), np.finfo(float).tiny)
        return np.asarray(1 / np.sqrt(squares))

    @cached_property
    def _solver(self) -> SuperLU:
        """The factors of the normal equations of unit columns."""
        unit = self.normal.copy()
        row_scale = self._scale[unit.indices]
        column_scale = np.repeat(self._scale, np.diff(unit.indptr))
        unit.data *= row_scale * column_scale
        ridge = RIDGE * eye_array(len(self._scale), format="csc")
        return splu(csc_array(unit + ridge))

    def fit(self, image: FloatArray) -> FloatArray:
        """Flux, and flux times the shift along x and y, of each star (n, 3): least squares over
        all pixels.
        """
        if not len(self.places_px):
            return np.zeros((0, 3))
        wanted = np.asarray(self._columns.T @ image.ravel())
        of_unit_columns = self._solver.solve(self._scale * wanted)
        return (self._scale * of_unit_columns).reshape(-1, 3)

    def image(self, fitted: FloatArray) -> FloatArray:
        """The light (height, width) of a fit."""
        return np.asarray(self._columns @ fitted.ravel()).reshape(self.shape)

    def errors(self, flux: FloatArray, pixel_error: float) -> tuple[FloatArray, FloatArray]:
        """Errors of flux and of place, px, (n,): a pixel is off by `pixel_error` of the flux of
        all stars that reach it.
        """
        size = len(flux)
        entries = self.normal.tocoo()
        row_star, row_term = np.divmod(entries.row, 3)
        col_star, col_term = np.divmod(entries.col, 3)
        itself = np.flatnonzero(row_star == col_star)
        place = (row_star[itself], row_term[itself], col_term[itself])
        blocks = np.zeros((size, 3, 3))
        blocks[place] = entries.data[itself]
        covariance = np.linalg.pinv(blocks, hermitian=True)
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        fluxes = row_term + col_term == 0
        reaching = np.abs(flux)[col_star[fluxes]]
        near = np.bincount(row_star[fluxes], reaching, minlength=size)
        around = pixel_error * near
        with np.errstate(divide="ignore", invalid="ignore"):
            flux_error = np.sqrt(variance[:, 0]) * around
            shift_error = np.sqrt(variance[:, 1:].sum(axis=1)) * around
            place_error_px = shift_error / np.abs(flux)
        return flux_error, place_error_px


class _Profiles:
    """Stars along one axis (n, k): shares of light and their derivative by the place, both 0 off
    the image.

    `middle` (n,) is each star's middle pixel, `clipped` (n, k) the pixels, those off the image
    moved to its edge.
    """

    def __init__(self, place_px: FloatArray, sigma_px: float, reach_px: int, size_px: int) -> None:
        self.middle = np.rint(place_px).astype(np.intp)
        pixel = self.middle[:, None] + np.arange(-reach_px, reach_px + 1)
        from_star_px = pixel - place_px[:, None]
        near = (from_star_px - 0.5) / sigma_px
        far = (from_star_px + 0.5) / sigma_px
        inside = (pixel >= 0) & (pixel < size_px)
        self.share = (ndtr(far) - ndtr(near)) * inside
        self.slope = (_bell(near) - _bell(far)) / sigma_px * inside
        self.clipped = np.clip(pixel, 0, size_px - 1)

    def overlaps(self, star: IntArray, other: IntArray) -> FloatArray:
        """Products (m, 2, 2) of share and slope of the stars `star` (m,) with share and slope of
        `other` (m,).
        """
        width = self.share.shape[1]
        both = np.stack([self.share, self.slope], axis=1)
        # The pixel of the other star that is each pixel of this one; beyond its profile are zeros.
        apart = self.middle[star] - self.middle[other]
        place = width + np.arange(width) + apart[:, None]
        padded = np.pad(both, ((0, 0), (0, 0), (width, width)))
        return np.asarray(both[star] @ padded[other[:, None], :, place])


def _bell(u: FloatArray) -> FloatArray:
    """The standard normal density."""
    return np.asarray(np.exp(-0.5 * np.square(u)) / math.sqrt(2 * math.pi))


def bright_pixels(image: FloatArray, floor: FloatArray) -> FloatArray:
    """Places (n, 2), px, of pixels above `floor` that no neighbour outshines, brightest first."""
    is_peak = image == ndimage.maximum_filter(image, 3, mode="constant")
    top = (image > floor) & is_peak
    row, column = np.nonzero(top)
    order = np.argsort(-image[row, column], kind="stable")
    places = np.column_stack([column[order], row[order]])
    return places.astype(np.float64)


def around(image: FloatArray, psf: Psf) -> FloatArray:
    """The brightest pixel within a star's footprint around each pixel, the same shape."""
    return np.asarray(ndimage.maximum_filter(image, psf.footprint_px, mode="constant"))


def star_psf(image: FloatArray) -> GaussianPsf:
    """The Gaussian of an image's stars: that which the brightest have in common, from the image's
    correlation of neighbours.
    """
    # A Gaussian of sigma s and its copy one pixel on correlate by exp(-1 / 4 s^2); the pixel's own
    # 1/12 px^2 is subtracted.
    power = np.vdot(image, image)
    along_x = np.vdot(image[:, 1:], image[:, :-1]) / power
    along_y = np.vdot(image[1:], image[:-1]) / power
    x = _sigma_px(float(along_x))
    y = _sigma_px(float(along_y))
    first = GaussianPsf((x, y))
    bright = bright_pixels(image, RIPPLE_SHARE * around(image, first))
    height, width = image.shape
    places = _apart(bright, first.footprint_px, (width, height))
    points = star_points(image, places, first.footprint_px // 2 + 1)
    covariance = np.tile([x * x, y * y, 0.0], (len(places), 1))
    start = PointGaussians(places[:, 0], places[:, 1], covariance)
    fitted = fit_each(points, start, SIGMA_ROUNDS, alike=True)
    sigma_x, sigma_y = np.sqrt(fitted.covariance[0, :XY])
    return GaussianPsf((float(sigma_x), float(sigma_y)))


def _sigma_px(correlation: float) -> float:
    """The sigma of stars by the correlation of an image with itself one pixel on, kept to what a
    star can have.
    """
    of_pixels_px2 = -0.25 / math.log(np.clip(correlation, 0.05, 0.999))
    return math.sqrt(max(of_pixels_px2 - 1 / 12, 0.04))


def star_points(image: FloatArray, places_px: FloatArray, reach_px: int) -> PointImages:
    """The images of stars at places (n, 2), px, to `reach_px` about them; 0 off the image."""
    middle = np.rint(places_px).astype(np.intp)
    steps = np.arange(2 * reach_px + 1)
    padded = np.pad(image, reach_px)
    rows = middle[:, 1, None] + steps
    columns = middle[:, 0, None] + steps
    images = padded[rows[:, :, None], columns[:, None, :]]
    none_px = np.zeros(len(middle))
    weights = np.ones_like(images)
    return PointImages(images, weights, middle[:, 0], middle[:, 1], none_px, has_level=False)


def _apart(places_px: FloatArray, distance_px: float, size_px: tuple[int, int]) -> FloatArray:
    """The brightest places with neither a star nor the image's edge in their footprint; all of
    them if there is none.
    """
    bright = places_px[: 4 * SIGMA_STARS]
    distance = np.abs(bright[:, None] - places_px[None]).max(axis=2)
    last = np.array(size_px) - 1
    edge = np.minimum(bright, last - bright).min(axis=1)
    near_stars = (distance < distance_px).sum(axis=1)  # each is its own neighbour
    alone = (near_stars == 1) & (edge >= distance_px / 2)
    if alone.any():
        bright = bright[alone]
    return bright[:SIGMA_STARS].copy()


def refined(image: FloatArray, places_px: FloatArray, psf: Psf) -> FloatArray:
    """Places (n, 2) of stars, px, refined from their brightest pixels, or from places known
    well: all stars at once.
    """
    start = places_px
    height, width = image.shape
    last = np.array([width - 1, height - 1])
    outwards = BEYOND_SIGMAS * np.array(psf.width_px)
    first_outside = np.minimum(start, 0) - outwards
    last_outside = np.maximum(start, last) + outwards
    low = np.where(start < 0.5, first_outside, start - MAX_OFFSET_PX)
    high = np.where(start > last - 0.5, last_outside, start + MAX_OFFSET_PX)
    for _ in range(MAX_PLACE_STEPS):
        fitted = StarTemplates(places_px, psf, (height, width)).fit(image)
        step = np.clip(shifts_px(fitted), -MAX_STEP_PX, MAX_STEP_PX)
        before = places_px
        places_px = np.clip(places_px + step, low, high)
        if np.abs(places_px - before).max(initial=0.0) < MIN_STEP_PX:
            break
    return places_px


def shifts_px(fitted: FloatArray) -> FloatArray:
    """The shifts (n, 2) in a fit, px; 0 for a star without light."""
    flux = fitted[:, :1]
    moments = fitted[:, 1:]
    return np.divide(moments, flux, out=np.zeros_like(moments), where=flux > 0)


@dataclass(frozen=True, slots=True)
class Seeds:
    """Stars to be fitted: places (n, 2), px, and the HIP numbers of each (a body's name), none
    where no table has it.
    """

    places_px: FloatArray
    hip: list[tuple[int | str, ...]]

    @property
    def stars(self) -> int:
        """How many stars there are, each of a blend counted."""
        return sum(max(len(hip), 1) for hip in self.hip)

    def only(self, chosen: npt.NDArray[np.bool_]) -> "Seeds":
        """The seeds (n,) that are chosen."""
        hip = list(itertools.compress(self.hip, chosen))
        return Seeds(self.places_px[chosen], hip)


def find_seeds(golden: FloatArray, truth: Truth | None, psf: Psf) -> Seeds:
    """The table's stars, and the image's where the table has none. Raises InputError for a table
    of another sky.
    """
    bright = bright_pixels(golden, RIPPLE_SHARE * around(golden, psf))
    if truth is None:
        return nameless_seeds(bright, psf)
    blend_px = blend_distance_px(psf)
    if not _has(truth, bright, blend_px):
        raise InputError(
            "compare: the truth table's stars are not where the golden image has them; give the"
            " table of that frame"
        )
    table = truth[np.argsort(-truth["electrons_per_s"], kind="stable")]
    places = _places_px(table)
    names = list(map(_name_of, table))
    listed = _blended(Seeds(places, names), blend_px)
    # The light of a star off the image is brightest at the image's edge.
    height, width = golden.shape
    last = np.array([width - 1, height - 1])
    shown = np.clip(places, 0, last)
    distance_px, _ = nearest_places(shown, bright)
    unlisted = nameless_seeds(bright[distance_px > blend_px], psf)
    every_place = np.concatenate([listed.places_px, unlisted.places_px])
    return Seeds(every_place, listed.hip + unlisted.hip)


def nameless_seeds(places_px: FloatArray, psf: Psf) -> Seeds:
    """Seeds at places (n, 2), px, brightest first; those closer than a blend are one."""
    nameless = Seeds(places_px, [()] * len(places_px))
    return _blended(nameless, blend_distance_px(psf))


def blend_distance_px(psf: Psf) -> float:
    """The distance within which two stars are one blend."""
    widest_px = max(psf.width_px)
    return max(BLEND_SIGMAS * widest_px, BLEND_PX)


def describes(truth: Truth, image: FloatArray) -> bool:
    """Whether a table (TRUTH_DTYPE) has at least half of the brightest stars of a linear image
    (height, width).
    """
    psf = star_psf(image)
    bright = bright_pixels(image, RIPPLE_SHARE * around(image, psf))
    return _has(truth, bright, blend_distance_px(psf))


def names_at(
    places_px: FloatArray, truth: Truth | None, blend_px: float
) -> list[tuple[int | str, ...]]:
    """The HIP number of the table's star at each place (n, 2), px, where it has one."""
    if truth is None or not len(truth) or not len(places_px):
        return [()] * len(places_px)
    distances_px, nearest = nearest_places(_places_px(truth), places_px)
    names: list[tuple[int | str, ...]] = []
    for distance_px, row in zip(distances_px, truth[nearest], strict=True):
        names.append(_name_of(row) if distance_px <= blend_px else ())
    return names


def _name_of(row: np.void) -> tuple[int | str, ...]:
    """A star's HIP number, or a body's name."""
    return (str(row["name"]) or int(row["hip"]),)


def _has(truth: Truth, found_px: FloatArray, blend_px: float) -> bool:
    """Whether a table has at least half of the brightest of places (n, 2), px."""
    if not len(truth) or not len(found_px):
        return False
    distances_px, _ = nearest_places(_places_px(truth), found_px[:KNOWN_STARS])
    return bool(np.median(distances_px) <= blend_px)


def _places_px(truth: Truth) -> FloatArray:
    """The places (n, 2), px, of a table's stars."""
    return np.column_stack([truth["x_px"], truth["y_px"]])


def nearest_places(known_px: FloatArray, places_px: FloatArray) -> tuple[FloatArray, IntArray]:
    """The distance, px, and the row of the known place nearest to each place (n,)."""
    distance_px, nearest = cKDTree(known_px).query(places_px)
    return np.asarray(distance_px), np.asarray(nearest, dtype=np.intp)


def _blended(seeds: Seeds, blend_px: float) -> Seeds:
    """One seed for each chain of near ones, at the place of its first, which is its brightest."""
    size = len(seeds.places_px)
    pairs = cKDTree(seeds.places_px).query_pairs(blend_px, output_type="ndarray")
    ends = (pairs[:, 0], pairs[:, 1])
    links = coo_array((np.ones(len(pairs)), ends), shape=(size, size))
    group = np.zeros(size, dtype=np.intp)
    if size:
        _, labels = connected_components(links, directed=False)
        group = np.asarray(labels, dtype=np.intp)
    _, first = np.unique(group, return_index=True)
    hips: dict[int, tuple[int | str, ...]] = {}
    for label, hip in zip(group.tolist(), seeds.hip, strict=True):
        hips[label] = hips.get(label, ()) + hip
    first_hips = [hips[label] for label in group[first].tolist()]
    return Seeds(seeds.places_px[first], first_hips)
