"""Stars through a tracker's glass: each by its place and its spectrum.

A star's PSF is a sum of basis images, each by a weight that is smooth over the field (radial basis
functions with polynomials up to the third degree), and over wavelength and focus (splines). All of
it is linear, so flux, centroid and second moments are interpolated as the images are. What the
pixels get at each place in a pixel is tabulated once, reduced again to few stamps, and these to
quadratic functions of the place: stars whose places are alike are one product of matrices.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.polynomial.polynomial import polyvander

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.optics.glass.psf_file import (
    MAX_NEGATIVE,
    TOLERANCE,
    Glass,
    moment_carriers,
    offsets,
    principal,
)
from hilstar.optics.psf import (
    BLACK_SAMPLES,
    MAX_FOOTPRINT_PX,
    MAX_UNEVEN,
    MIN_WIDTH_PX,
    ONE_PSF,
    PIXEL_VARIANCE,
    SPLINE_DEGREE,
    SampledPsf,
)

# share of any PSF's light that a footprint leaves out: at 10 px it moves a centroid by up to 3e-4
# px
MAX_CUT = 3e-5
# A pixel is cut into squares in each of which a star's pixels are quadratic in its place. They are
# as many along a side as keep what cubes would add in a row or column under CUBIC_TOLERANCE of a
# star's light, and fitted to up to MAX_STEPS steps each.
CUBIC_TOLERANCE, MIN_SQUARES, MAX_SQUARES = 6e-4, 3, 16
MAX_STEPS, MIN_STEPS, TABLE_SIDE, PLACES_A_PX = 4, 2, 1024, 32
# What the reduced stamps leave out of all tabulated ones, rms, relative to them. Flux, centroids
# and second moments are kept.
STAMP_TOLERANCE = 3e-4
FIRST_STAMPS, MAX_STAMPS = 48, 400  # the first number that is tried, doubled up to the last
MAX_DEGREE = 3  # splines over wavelength and focus, polynomials over a scattered field
MAX_GRID_DEGREE = 4  # of splines over a full grid
ON_EDGE_PX = 1e-6  # of the field's scale: rounding, by which a point on the hull is outside it
SMALLEST, DARK = 1e-15, 1e-12  # numbers, and illuminations, that count as none
SPRITES_AT_ONCE_PX = 2_000_000  # bounds the memory: their stamps take 8 MB
# samples to a pixel; rounds in which a weight becomes as wide as a PSF
MIN_REGRIDDED, WIDTH_ROUNDS = 4, 20
FINE_STEPS_A_PX = 4  # of the light whose Gaussian is sought
# basis images of the simpler glasses that may stand for one
COMPONENTS = (3, 6, 12)


Kernel = Literal["linear", "thin_plate_spline", "quintic"]


class NodeSpline:
    """Interpolation in one variable: for each of its `nodes` (k,), which rise, a function that is 1
    at that node and 0 at the others.

    Beyond the first and the last node the functions keep their values there.
    """

    def __init__(self, nodes: FloatArray, max_degree: int = MAX_DEGREE) -> None:
        # 0.2 s of every command that needs none of it
        from scipy.interpolate import make_interp_spline

        self._nodes = nodes
        self._spline = None
        first = nodes[0]
        last = nodes[-1]
        self._middle = (last + first) / 2
        self._half = (last - first) / 2 or 1.0
        if len(nodes) > max_degree + 1:
            self._spline = make_interp_spline(nodes, np.eye(len(nodes)), max_degree)
        else:  # one polynomial, which is quicker
            self._coefficients = np.linalg.inv(self._powers(nodes)).T

    def _powers(self, places: FloatArray) -> FloatArray:
        """The powers (n, k) of places (n,), which are scaled to -1 to 1 between the ends."""
        scaled = (places - self._middle) / self._half
        return polyvander(scaled, len(self._nodes) - 1)

    def __call__(self, at: FloatArray) -> FloatArray:
        """The functions (n, k) at places (n,)."""
        at = np.clip(at, self._nodes[0], self._nodes[-1])
        if self._spline is not None:
            return np.asarray(self._spline(at))
        return np.asarray((self._coefficients @ self._powers(at).T).T)


class Field:
    """Interpolation over the field: for each of its points (F, 2), px, a smooth function that is 1
    at that point and 0 at the others.

    On a full grid the functions are products of splines, elsewhere radial basis functions with
    polynomials. Beyond the points' convex hull they keep the values at the nearest place of its
    edge.
    """

    def __init__(self, places_px: FloatArray) -> None:
        self.places_px = places_px
        self._middle_px = places_px.mean(axis=0)
        farthest_px = float(np.abs(places_px - self._middle_px).max())
        self._scale = max(1.0, farthest_px)
        self._degree = 0
        for degree in range(MAX_DEGREE + 1):
            if self._holds(degree):
                self._degree = degree
        self.hull_px = places_px[self._corners()]
        columns = np.unique(places_px[:, 0])
        rows = np.unique(places_px[:, 1])
        # `places_px` is sorted by x, then y
        grid_x, grid_y = np.meshgrid(columns, rows, indexing="ij")
        grid = np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
        self._grid = None
        if grid.shape == places_px.shape and (grid == places_px).all():
            across = NodeSpline(columns, MAX_GRID_DEGREE)
            down = NodeSpline(rows, MAX_GRID_DEGREE)
            self._grid = (across, down)

    def _scaled(self, places_px: FloatArray) -> FloatArray:
        """Places from the points' mean, in units of the farthest point's distance."""
        return np.asarray((places_px - self._middle_px) / self._scale)

    def _holds(self, degree: int) -> bool:
        """Whether the points determine a polynomial of that degree with some to spare."""
        x, y = self._scaled(self.places_px).T
        products = []
        for i in range(degree + 1):
            for j in range(degree + 1 - i):
                products.append(x**i * y**j)
        terms = np.stack(products, axis=1)
        count = terms.shape[1]
        needed = count * 1.4 if degree > 1 else count
        rank = np.linalg.matrix_rank(terms, tol=1e-6 * len(x))
        return bool(needed <= len(x) and rank == count)

    def _corners(self) -> list[int]:
        """The points at the corners of the hull, in order; the two ends of a line."""
        if self._holds(1):
            from scipy.spatial import ConvexHull

            hull = ConvexHull(self.places_px)
            return [int(k) for k in hull.vertices]
        from_first_px = self.places_px - self.places_px[0]
        farthest = np.square(from_first_px).sum(axis=1).argmax()
        along = from_first_px @ from_first_px[farthest]
        return sorted({int(along.argmin()), int(along.argmax())})

    def within(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (n, 2) within the hull, the nearest for those beyond, and how far these are
        beyond it, px (n,).
        """
        places = np.stack([x_px, y_px], axis=1)
        beyond_px = np.zeros(len(places))
        begin = self.hull_px
        along = np.roll(begin, -1, axis=0) - begin
        off = places[:, None] - begin
        cross_px = along[:, 0] * off[..., 1] - along[:, 1] * off[..., 0]
        if len(begin) > 2:
            is_outside = (cross_px < -ON_EDGE_PX * self._scale).any(axis=1)
            outside = np.flatnonzero(is_outside)
        else:
            outside = np.arange(len(places))  # a line or a point has no inside
        if len(outside):
            length2 = np.maximum((along * along).sum(axis=1), 1e-300)
            advance = (off[outside] * along).sum(axis=2)
            part = np.clip(advance / length2, 0, 1)
            on_edges = begin + part[..., None] * along
            far_px = np.linalg.norm(on_edges - places[outside, None], axis=2)
            star = np.arange(len(outside))
            nearest_edge = far_px.argmin(axis=1)
            beyond_px[outside] = far_px[star, nearest_edge]
            places[outside] = on_edges[star, nearest_edge]
        return places, beyond_px

    @cached_property
    def _scattered(self) -> Callable[[FloatArray], FloatArray]:
        """The functions (n, F) at scaled places (n, 2), of points that are no grid."""
        from scipy.interpolate import RBFInterpolator

        kernels: tuple[Kernel, ...] = "linear", "thin_plate_spline", "quintic", "quintic"
        kernel = kernels[self._degree]
        interpolator: Callable[[FloatArray], FloatArray] = RBFInterpolator(
            self._scaled(self.places_px),
            np.eye(len(self.places_px)),
            kernel=kernel,
            degree=self._degree,
        )
        return interpolator

    def __call__(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """The functions (n, F) at places (n,)."""
        places, _ = self.within(x_px, y_px)
        if len(self.places_px) == 1 or not len(places):
            return np.ones((len(places), len(self.places_px)))
        if self._grid is not None:
            spline_x, spline_y = self._grid
            across = spline_x(places[:, 0])
            down = spline_y(places[:, 1])
            products = across.T[:, None] * down.T
            return np.asarray(products.reshape(-1, len(places)).T)
        return np.asarray(self._scattered(self._scaled(places)))


@dataclass(frozen=True, slots=True)
class _Stamps:
    """Images of the light of pixels, `stamps` (R, side^2), of which every star's image is a
    weighted sum.

    The weight of a stamp is a quadratic function of the star's place within its pixel, by squares
    of the pixel. `parts` (squares, 6 K, R) are its coefficients for each basis image, in the order
    of `_terms`. `sums` (R,) are the stamps' sums; `light` (K, n) is the light that pixels get of
    each basis image at all tabulated places.
    """

    stamps: Float32Array
    parts: Float32Array
    sums: Float32Array
    light: Float32Array


@dataclass(frozen=True, slots=True)
class Focused:
    """A glass at one focus: `basis` (K, height, width), and by field point and wavelength the
    `weights` (F, L, K) of PSFs.

    These sum to 1. `illumination` (F, L) is relative to the axis, and `inside` (F, L) the share of
    it within the images.
    """

    basis: FloatArray
    weights: FloatArray
    illumination: FloatArray
    inside: FloatArray


class _Measured(SampledPsf):
    """An image of which only the width is asked for. No star is drawn by it, so negative light is
    no fault.
    """

    max_negative = 1.0


@dataclass(frozen=True, eq=False)
class GlassPsf(SampledPsf):
    """A glass at one focus. Each star is drawn by its place and its spectrum, all other light by
    the mean PSF in the middle of the field.

    `mean_shares` (L,) are the shares that each wavelength has of light without a spectrum of its
    own. Make it with `glass_psf`.
    """

    optics: Focused = dataclasses.field(kw_only=True)
    field: Field = dataclasses.field(kw_only=True)
    mean_shares: FloatArray = dataclasses.field(kw_only=True)
    wavelengths_nm: FloatArray = dataclasses.field(kw_only=True)
    by_place, by_colour = True, True
    # stars keep what is negative: noise of a measured map then moves none on average
    max_negative = MAX_NEGATIVE

    def __post_init__(self) -> None:
        """Refuse what is no PSF, the mean and each of the others."""
        super().__post_init__()
        least = float((self._psf_weights @ self._stamps.light).min())
        if least < 1 - MAX_UNEVEN:
            raise InputError(
                f"a star's pixels get {least:.1%} of a PSF's light at one place in a pixel, and"
                " more at others: sample it more finely, or write PIXINT = F where no pixel is"
                " integrated in it"
            )

    @cached_property
    def _psf_weights(self) -> FloatArray:
        """The weights (F L, K) of the basis images by PSF."""
        return self.optics.weights.reshape(-1, len(self.optics.basis))

    @cached_property
    def width_px(self) -> tuple[float, float]:
        """The smaller of the mean's and the sharpest PSF's: paths are sampled for all."""
        basis = self.optics.basis
        psfs = self._psf_weights @ basis.reshape(len(basis), -1)
        highest = psfs.max(axis=1).argmax()
        sharpest = np.tensordot(self._psf_weights[highest], basis, axes=1)
        widths = []
        for samples in (self.samples, sharpest.clip(min=0)):
            image = _Measured(samples, self.per_px, self.pixel_integrated)
            widths.append(image.width_px)
        x, y = np.min(widths, axis=0).tolist()
        return x, y

    @cached_property
    def footprint_px(self) -> int:
        """The side of the smallest odd square outside which no PSF has more than MAX_CUT of its
        light.
        """
        _, height, width = self.optics.basis.shape
        down = np.abs(offsets(height))
        across = np.abs(offsets(width))
        ring = np.maximum(down[:, None], across).ravel()
        rings = []
        for image in self.optics.basis:
            rings.append(np.bincount(ring, image.ravel()))
        light = self._psf_weights @ np.stack(rings)
        light_within = np.cumsum(light, axis=1)
        cut = np.abs(1 - light_within).max(axis=0)
        too_much = np.flatnonzero(cut > MAX_CUT)
        last_ring = 0
        if len(too_much):
            last_ring = min(int(too_much[-1]) + 1, len(cut) - 1)
        # samples of which pixels are integrated have light from half a pixel around them
        pixel_half_px = 0.5 if self.pixel_integrated else 0.0
        reach_px = (last_ring + 0.5) / self.per_px + pixel_half_px
        side = 2 * math.ceil(reach_px) + 1
        if side > MAX_FOOTPRINT_PX:
            raise InputError(
                f"a PSF's light reaches over {side} px, more than {MAX_FOOTPRINT_PX}; cut off what"
                " lies further out"
            )
        return side

    @cached_property
    def peak_share(self) -> float:
        """The largest share that one pixel gets: of the sharpest PSF, for a star in the middle of a
        pixel, or of the mean PSF at any place.
        """
        of_mean = float(self._table.max())
        of_any = float(self._centred().max())
        return max(of_mean, of_any)

    def _centred(self) -> Float32Array:
        """The light (F L, side^2) of the pixels about a star in the middle of a pixel, by each of
        the PSFs.
        """
        weights = self._psf_weights.astype(np.float32)
        middle_px = np.zeros(len(weights))
        return self._parts(weights, middle_px, middle_px) @ self._stamps.stamps

    def _tabulated(self, steps: int) -> list[FloatArray]:
        """The light that pixels of the footprint collect from the rows and the columns of basis
        images, (steps + 1, side, samples) each, by the star's place within its pixel.
        """
        side = self.footprint_px
        star_px = np.arange(steps + 1)[:, None] / steps - 0.5
        at_px = (offsets(side) - star_px).ravel()
        tables = []
        for size in self.optics.basis.shape[1:]:
            pixels = _pixels_of(size, self.per_px, at_px, self.pixel_integrated)
            tables.append(pixels.reshape(steps + 1, side, -1))
        return tables

    @cached_property
    def _squares(self) -> int:
        """How many squares a pixel has along each side."""
        basis = self.optics.basis
        rows = self._psf_weights @ basis.sum(axis=2)
        columns = self._psf_weights @ basis.sum(axis=1)
        row_table, column_table = self._tabulated(PLACES_A_PX)
        largest = 0.0
        for line, table in ((rows, row_table), (columns, column_table)):
            differences = np.diff(table, 3, axis=0)
            of_lines = line @ differences.swapaxes(1, 2)
            largest = max(largest, float(np.abs(of_lines).max()))
        # over a square of 1 px, by Chebyshev's
        cubic = largest * PLACES_A_PX**3 / 192
        squares = math.ceil(np.cbrt(cubic / CUBIC_TOLERANCE))
        return int(np.clip(squares, MIN_SQUARES, MAX_SQUARES))

    @cached_property
    def _stamps(self) -> _Stamps:
        """The basis as pixels get it, tabulated by a star's place in its middle pixel and
        reduced to few stamps.
        """
        side = self.footprint_px
        squares = self._squares
        steps_a_pixel = min(TABLE_SIDE // side, MAX_STEPS * 6)
        steps_a_square = min(MAX_STEPS, max(MIN_STEPS, steps_a_pixel // squares))
        steps = steps_a_square * squares
        places_a_side = steps + 1
        count = len(self.optics.basis)
        row_table, column_table = self._tabulated(steps)
        down = _normal_floats(row_table.reshape(-1, row_table.shape[2]))
        across = _normal_floats(column_table.reshape(-1, column_table.shape[2]))
        # images are tabulated as strong as they are used: small ones need less care
        mean_squares = (self.optics.weights**2).mean(axis=(0, 1))
        used = np.maximum(np.sqrt(mean_squares), 1e-30).astype(np.float32)
        basis = _normal_floats(self.optics.basis)
        table = np.empty((count, places_a_side**2, side * side), dtype=np.float32)
        for image, scale, image_table in zip(basis, used, table, strict=True):
            pixels = down @ (scale * image) @ across.T
            by_axis = pixels.reshape(places_a_side, side, places_a_side, side)
            image_table[:] = by_axis.transpose(0, 2, 1, 3).reshape(image_table.shape)
        stamps, coefficients = _few(table.reshape(-1, side * side), side)
        by_place = coefficients.reshape(count, -1) / used[:, None]
        by_place = by_place.reshape(count, places_a_side, places_a_side, -1)
        places = np.linspace(-1, 1, steps_a_square + 1)
        y, x = np.meshgrid(places, places, indexing="ij")
        terms = _terms(x.ravel(), y.ravel())
        fit = np.linalg.pinv(terms).astype(np.float32)
        parts = np.empty((squares**2, fit.shape[0], count, len(stamps)), dtype=np.float32)
        for number, square_parts in enumerate(parts):
            row, column = divmod(number, squares)
            first_row = steps_a_square * row
            first_column = steps_a_square * column
            rows = slice(first_row, first_row + steps_a_square + 1)
            columns = slice(first_column, first_column + steps_a_square + 1)
            square = by_place[:, rows, columns].reshape(count, -1, len(stamps))
            square_parts[:] = np.tensordot(fit, square, axes=(1, 1))
        light = table.sum(axis=2) / used[:, None]
        by_square = parts.reshape(squares**2, -1, len(stamps))
        return _Stamps(stamps, by_square, stamps.sum(axis=1), light)

    def _mixed(self, x_px: FloatArray, y_px: FloatArray, shares: FloatArray) -> Float32Array:
        """The weights (n, K) of the basis images in the light of stars at places (n,); `shares` are
        spectra as in `Psf`.
        """
        by_field = self.field(x_px, y_px).T.astype(np.float32)
        shares = shares.T.astype(np.float32, order="C")
        by_point = by_field[:, None] * shares.reshape(shares.shape[0], -1)
        light = by_point.reshape(len(self._light), -1)
        return np.asarray(light.T @ self._light)

    @cached_property
    def _sums(self) -> Float32Array:
        """The light (K,) of each basis image."""
        return np.asarray(self.optics.basis.sum(axis=(1, 2)), dtype=np.float32)

    @cached_property
    def _light(self) -> Float32Array:
        """The weights (F L, K) of the basis images in the light of each field point and wavelength:
        those of its PSF, times its illumination inside the image.
        """
        optics = self.optics
        inside = optics.illumination * optics.inside
        light = optics.weights * inside[..., None]
        by_psf = light.reshape(-1, len(optics.basis))
        return np.asarray(by_psf, dtype=np.float32)

    def _parts(self, weights: Float32Array, x_px: FloatArray, y_px: FloatArray) -> Float32Array:
        """The coefficients (n, R) of the stamps for stars at places (n,), sorted by `_square`, with
        `weights` (n, K) of the basis images.
        """
        square, within_x, within_y = _square(x_px, y_px, self._squares)
        terms = _terms(within_x, within_y).astype(np.float32)[:, :, None]
        stamp_parts = self._stamps.parts
        counts = np.bincount(square, minlength=self._squares**2)
        parts = np.empty((len(terms), stamp_parts.shape[2]), dtype=np.float32)
        room = np.empty((counts.max(), terms.shape[1], weights.shape[1]), dtype=np.float32)
        end = 0
        for stamp_part, count in zip(stamp_parts, counts.tolist(), strict=True):
            if count:
                begin = end
                end = end + count
                stars = slice(begin, end)
                products = np.multiply(terms[stars], weights[stars, None], out=room[:count])
                np.matmul(products.reshape(count, -1), stamp_part, out=parts[stars])
        return parts

    @cached_property
    def moved_px(self) -> FloatArray:
        """The centroid of each PSF from its chief ray (F, L, 2), px."""
        _, height, width = self.optics.basis.shape
        basis = self.optics.basis
        moment_x = basis.sum(axis=1) @ offsets(width)
        moment_y = basis.sum(axis=2) @ offsets(height)
        moments = np.stack([moment_x, moment_y], axis=1)
        return np.asarray(self.optics.weights @ moments / self.per_px)

    def centroids_px(
        self, x_px: FloatArray, y_px: FloatArray, spectra: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The centroids (n,) of the light of stars at places (n,), px, and their illumination
        relative to the axis.

        What lies outside the images does not count.
        """
        optics = self.optics
        by_field = self.field(x_px, y_px)
        light = optics.illumination * optics.inside
        total = ((by_field @ light) * spectra).sum(axis=1)
        lit = total > DARK
        divisor = np.where(lit, total, 1)
        centroids = []
        moved_by_axis = np.moveaxis(self.moved_px, 2, 0)
        for place_px, moved_px in zip((x_px, y_px), moved_by_axis, strict=True):
            moment = ((by_field @ (light * moved_px)) * spectra).sum(axis=1)
            centroids.append(place_px + np.where(lit, moment / divisor, 0))
        x, y = centroids
        illumination = ((by_field @ optics.illumination) * spectra).sum(axis=1)
        return x, y, illumination

    def stamps_at(
        self,
        x_px: FloatArray,
        y_px: FloatArray,
        spectra: FloatArray,
        electrons_per_s: FloatArray | Float32Array | None = None,
    ) -> Float32Array:
        """See `Psf.stamps_at`: each by its place and spectrum."""
        rates = np.ones(len(x_px)) if electrons_per_s is None else electrons_per_s
        order = self._by_square(x_px, y_px)
        star_spectra = spectra[order] if spectra.ndim == 2 else spectra
        stamps, scale = self._drawn(x_px[order], y_px[order], star_spectra)
        factors = rates[order] * scale
        squares = np.empty_like(stamps)
        squares[order] = stamps * factors[:, None]
        side = self.footprint_px
        return squares.reshape(-1, side, side)

    def _by_square(self, x_px: FloatArray, y_px: FloatArray) -> IntArray:
        """The stars at places (n,) in the order of their squares, as `_drawn` wants them."""
        square, _, _ = _square(x_px, y_px, self._squares)
        return np.argsort(square)

    def _drawn(
        self, x_px: FloatArray, y_px: FloatArray, shares: FloatArray
    ) -> tuple[Float32Array, Float32Array]:
        """The light (n, side^2) of the pixels about stars at places (n,), sorted by `_square`, and
        factors (n,) by which it is to be multiplied.
        """
        weights = self._mixed(x_px, y_px, shares)
        parts = self._parts(weights, x_px, y_px)
        # Polynomials and reduced stamps keep all light but some 1e-5 of it; this restores the rest.
        light = weights @ self._sums
        whole = parts @ self._stamps.sums
        scale = light / np.where(whole > 0, whole, np.inf)
        return parts @ self._stamps.stamps, np.asarray(scale, dtype=np.float32)

    def unreduced(self, x_px: FloatArray, y_px: FloatArray, shares: FloatArray) -> FloatArray:
        """The light (n, side, side) about stars of 1 electron per second by the whole basis: what
        `_drawn` approximates, exact and some hundred times as slow.
        """
        side = self.footprint_px
        at_px = offsets(side)
        stamps = np.empty((len(x_px), side, side))
        mixed = self._mixed(x_px, y_px, shares)
        for stamp, weights, x, y in zip(stamps, mixed, x_px, y_px, strict=True):
            image = np.tensordot(weights.astype(np.float64), self.optics.basis, axes=1)
            height, width = image.shape
            down_px = at_px - _in_pixel(y)
            across_px = at_px - _in_pixel(x)
            down = _pixels_of(height, self.per_px, down_px, self.pixel_integrated)
            across = _pixels_of(width, self.per_px, across_px, self.pixel_integrated)
            stamp[:] = down @ image @ across.T
        return stamps

    def image(
        self,
        x_px: FloatArray,
        y_px: FloatArray,
        spectra: FloatArray,
        electrons_per_s: FloatArray | Float32Array,
        resolution_px: tuple[int, int],
    ) -> Float32Array:
        """See `Psf.image`: each by its place and spectrum."""
        # as `NodeSpline`; its product takes half the time of `np.add.at`
        from scipy.sparse import csc_array

        side = self.footprint_px
        width, height = resolution_px
        # with room for what falls beyond the edges
        across = width + 2 * side
        size = (height + 2 * side) * across
        pixel = np.arange(side, dtype=np.int32)
        stamp_pixels = (pixel[:, None] * across + pixel).ravel()
        at_once = max(1, SPRITES_AT_ONCE_PX // side**2)
        order = self._by_square(x_px, y_px)
        image = np.empty(0, np.float32)
        for begin in range(0, max(len(order), 1), at_once):
            star = order[begin : begin + at_once]
            star_spectra = spectra[star] if spectra.ndim == 2 else spectra
            stamps, scale = self._drawn(x_px[star], y_px[star], star_spectra)
            middle_column = np.floor(x_px[star] + 0.5).astype(np.int32)
            middle_row = np.floor(y_px[star] + 0.5).astype(np.int32)
            column = middle_column + side - side // 2
            row = middle_row + side - side // 2
            places = (row * across + column)[:, None] + stamp_pixels
            ends = np.arange(len(star) + 1, dtype=np.int32) * side**2
            content = (stamps.ravel(), places.ravel(), ends)
            sparse = csc_array(content, (size, len(star)))
            light = np.asarray(sparse @ (electrons_per_s[star] * scale))
            image = image + light if begin else light
        with_room = image.reshape(-1, across)
        return with_room[side:-side, side:-side]

    @property
    def in_the_middle(self) -> SampledPsf:
        """See `Psf.in_the_middle`: the mean PSF."""
        return SampledPsf(self.samples, self.per_px, self.pixel_integrated)

    def simpler(self) -> Iterator[tuple[str, Callable[[], SampledPsf]]]:
        """See `Psf.simpler`: one PSF, Gaussians over the field, few basis images."""
        yield ONE_PSF, lambda: self.in_the_middle
        if self.optics.weights.shape[:2] == (1, 1):
            return
        yield "Gaussians by field", partial(as_gaussians, self)
        for count in COMPONENTS:
            if count < self.components:
                yield f"a basis of {count}", partial(with_components, self, count)

    @property
    def components(self) -> int:
        """See `Psf.components`: the basis images."""
        return len(self.optics.basis)

    def blurred(self, sigma_px: float) -> "GlassPsf":
        """The basis convolved with a round Gaussian, with room for what spreads beyond it."""
        from scipy.ndimage import fourier_gaussian

        sigma = sigma_px * self.per_px
        more = math.ceil(6 * sigma)
        wide = np.pad(self.optics.basis, ((0, 0), (more, more), (more, more)))
        spread = []
        for image in wide:
            transformed = fourier_gaussian(np.fft.fft2(image), sigma)
            spread.append(np.fft.ifft2(transformed).real)
        return _of_optics(self, replace(self.optics, basis=np.stack(spread)))


def glass_psf(glass: Glass, focus_um: float, mean_shares: FloatArray) -> GlassPsf:
    """A glass at one of its focus positions, or between them. Raises InputError for PSFs that
    cannot be drawn.
    """
    over_focus = NodeSpline(glass.focuses_um)
    at_focus = over_focus(np.array([focus_um]))[0]
    weights = np.tensordot(glass.weights, at_focus, axes=(2, 0))
    illumination = np.tensordot(glass.illumination, at_focus, axes=(2, 0))
    inside = np.tensordot(1 - glass.outside, at_focus, axes=(2, 0))
    lateral_px = np.tensordot(glass.lateral_px, at_focus, axes=(2, 0))
    basis = glass.basis.astype(np.float64)
    optics = Focused(basis, weights, illumination, inside)
    if lateral_px.any() or len(glass.focuses_um) > 1:
        pixel_samples = 1 if glass.pixel_integrated else glass.per_px
        optics = _rebased(optics, lateral_px * glass.per_px, pixel_samples)
    field = Field(glass.places_px)
    return GlassPsf(
        _middle(optics, field, mean_shares),
        glass.per_px,
        glass.pixel_integrated,
        optics=optics,
        field=field,
        mean_shares=mean_shares,
        wavelengths_nm=glass.wavelengths_nm,
    )


def regridded(images: FloatArray, per_px: int, matrix: FloatArray) -> tuple[FloatArray, int]:
    """PSFs (n, height, width) by other pixels, and their samples a pixel: `matrix` (2, 2) takes
    offsets in pixels to these.

    There are at least as many samples to the same length as before, and MIN_REGRIDDED to a pixel.
    """
    from scipy.ndimage import map_coordinates

    _, height, width = images.shape
    area = abs(float(np.linalg.det(matrix)))
    new_per_px = max(MIN_REGRIDDED, math.ceil(per_px / math.sqrt(area)))
    to_samples = np.linalg.inv(matrix) * per_px / new_per_px
    old_half = np.array([width, height]) // 2
    new_half = np.ceil(np.abs(np.linalg.inv(to_samples)) @ old_half)
    half_x, half_y = new_half.astype(int).tolist()
    x, y = np.meshgrid(offsets(2 * half_x + 1), offsets(2 * half_y + 1))
    columns, rows = np.tensordot(to_samples, np.stack([x, y]), axes=1)
    at = np.stack([rows + height // 2, columns + width // 2])
    drawn = []
    for image in images:
        drawn.append(map_coordinates(image, at, np.float64, SPLINE_DEGREE))
    area_ratio = abs(float(np.linalg.det(to_samples)))
    return np.stack(drawn) * area_ratio, new_per_px


def _middle(optics: Focused, field: Field, shares: FloatArray) -> FloatArray:
    """The PSF (height, width) of the field's middle and of light with such shares (L,)."""
    middle_x, middle_y = field.places_px.mean(axis=0)[:, None]
    middle = field(middle_x, middle_y)[0]
    weights = np.einsum("f,l,flk->k", middle, shares, optics.weights)
    return np.asarray(np.tensordot(weights, optics.basis, axes=1))


def _of_optics(psf: GlassPsf, optics: Focused) -> GlassPsf:
    """A glass by other images or weights."""
    return replace(psf, samples=_middle(optics, psf.field, psf.mean_shares), optics=optics)


def with_components(psf: GlassPsf, count: int) -> GlassPsf:
    """A glass by so many basis images: the mean and the principal components of its PSFs' light.
    Each PSF still sums to 1.
    """
    optics = psf.optics
    flat = optics.weights.reshape(-1, len(optics.basis))
    basis = optics.basis.reshape(len(optics.basis), -1)
    mean = flat.mean(axis=0)
    values, vectors = np.linalg.eigh(basis @ basis.T)
    positive = np.maximum(values, 1e-12 * values[-1])
    # its square is the metric of weights
    scale = vectors * np.sqrt(positive)
    departures = (flat - mean) @ scale
    turned, sizes, components = np.linalg.svd(departures, full_matrices=False)
    independent = int((sizes > 1e-9 * sizes[0]).sum())
    component_count = min(count - 1, independent)
    component_weights = components[:component_count] @ np.linalg.pinv(scale)
    images = np.vstack([mean, component_weights]) @ basis
    of_components = turned[:, :component_count] * sizes[:component_count]
    weights = np.hstack([np.ones((len(flat), 1)), of_components])
    return _of_images(psf, images, weights)


def as_gaussians(psf: GlassPsf) -> GlassPsf:
    """A glass whose PSFs are Gaussians, each of its own axes and angle: the centroids, and
    widths by adaptive moments.
    """
    optics = psf.optics
    _, height, width = optics.basis.shape
    place = _grid_offsets(height, width) / psf.per_px
    # Whole pixels are too far apart for the weight, which is narrower than a PSF.
    at_px = offsets(psf.footprint_px * FINE_STEPS_A_PX | 1) / FINE_STEPS_A_PX
    down = _pixels_of(height, psf.per_px, at_px, psf.pixel_integrated)
    across = _pixels_of(width, psf.per_px, at_px, psf.pixel_integrated)
    fine_px = _grid_offsets(len(at_px), len(at_px)) / FINE_STEPS_A_PX
    centroids = psf.moved_px.reshape(-1, 2)
    images = []
    for weights, centroid in zip(psf._psf_weights, centroids, strict=True):
        image = np.tensordot(weights, optics.basis, axes=1)
        light = (down @ image @ across.T).ravel()
        spread = _adaptive_spread(light, fine_px - centroid)
        if not psf.pixel_integrated:
            spread = spread - np.eye(2) * PIXEL_VARIANCE
        images.append(_gaussian(place - centroid, spread))
    gaussians = np.stack(images)
    gaussians /= gaussians.sum(axis=1, keepdims=True)
    pixel_samples = 1 if psf.pixel_integrated else psf.per_px
    basis, weights, _ = principal(gaussians, optics.basis.shape[1:], TOLERANCE, pixel_samples)
    return _of_images(psf, basis.astype(np.float64), weights)


def _adaptive_spread(light: FloatArray, off: FloatArray) -> FloatArray:
    """The second moments (2, 2), px^2, of light (n,) at offsets (n, 2) from its centroid, as
    `SampledPsf.width_px` finds them; at least a pixel's and MIN_WIDTH_PX's.
    """
    least = PIXEL_VARIANCE + MIN_WIDTH_PX**2
    spread = np.eye(2)
    for _ in range(WIDTH_ROUNDS):
        weighted = light * _gaussian(off, spread)
        moments = 2 * (off.T * weighted) @ off
        spread = moments / weighted.sum()
        smallest = float(np.linalg.eigvalsh(spread)[0])
        spread += np.eye(2) * max(0.0, least - smallest)
    return spread


def _gaussian(off: FloatArray, spread: FloatArray) -> FloatArray:
    """A Gaussian of a covariance (2, 2) at offsets (n, 2) from its middle, where it is 1."""
    distance2 = np.einsum("ni,ij,nj->n", off, np.linalg.inv(spread), off)
    return np.asarray(np.exp(-0.5 * distance2))


def _of_images(psf: GlassPsf, images: FloatArray, weights: FloatArray) -> GlassPsf:
    """A glass by other images (K, m) and weights (n, K) of its PSFs."""
    basis = images.reshape(-1, *psf.optics.basis.shape[1:])
    light = weights @ images.sum(axis=1)
    fields, wavelengths, _ = psf.optics.weights.shape
    of_light = (weights / light[:, None]).reshape(fields, wavelengths, -1)
    return _of_optics(psf, replace(psf.optics, basis=basis, weights=of_light))


def _rebased(optics: Focused, lateral: FloatArray, width: int) -> Focused:
    """A glass whose PSFs are moved by `lateral` (F, L, 2) samples, right and down, on a basis made
    for its one focus, which needs fewer components.

    A pixel has `width` samples; 1 where pixels are integrated.
    """
    from scipy.ndimage import shift

    room = math.ceil(float(np.abs(lateral).max()))
    flat = optics.weights.reshape(-1, len(optics.basis))
    moves = lateral.reshape(-1, 2)
    padded = np.pad(optics.basis, ((0, 0), (room, room), (room, room)))
    moved = []
    for weight, move in zip(flat, moves, strict=True):
        image = np.tensordot(weight, padded, axes=1)
        if move.any():
            image = shift(image, move[::-1], order=5)
        moved.append(image)
    images = np.stack(moved)
    images /= images.sum(axis=(1, 2), keepdims=True)
    flat_images = images.reshape(len(images), -1)
    basis, weights, _ = principal(flat_images, images.shape[1:], TOLERANCE, width)
    light = weights @ basis.sum(axis=1, dtype=np.float64)
    weights /= light[:, None]
    new_basis = basis.reshape(-1, *images.shape[1:]).astype(np.float64)
    new_weights = weights.reshape(*optics.weights.shape[:2], -1)
    return replace(optics, basis=new_basis, weights=new_weights)


def _square(
    x_px: FloatArray, y_px: FloatArray, squares: int
) -> tuple[IntArray, FloatArray, FloatArray]:
    """In which square of its pixel each star (n,) is, and its place in it, -1 to 1 right and
    down.
    """
    at_x = (_in_pixel(x_px) + 0.5) * squares
    at_y = (_in_pixel(y_px) + 0.5) * squares
    column = np.minimum(at_x.astype(np.intp), squares - 1)
    row = np.minimum(at_y.astype(np.intp), squares - 1)
    within_x = 2 * (at_x - column) - 1
    within_y = 2 * (at_y - row) - 1
    return row * squares + column, within_x, within_y


def _in_pixel(place_px: FloatArray) -> FloatArray:
    """Places from the middles of the pixels that they are in, px."""
    return np.asarray(place_px - np.floor(place_px + 0.5))


def _grid_offsets(rows: int, columns: int) -> IntArray:
    """How far each sample of an image is right of the middle one and below it, (n, 2), row by
    row.
    """
    x, y = np.meshgrid(offsets(columns), offsets(rows))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _terms(x: FloatArray, y: FloatArray) -> FloatArray:
    """The terms (n, 6) of a quadratic function of places (n,)."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def _pixels_of(size: int, per_px: int, at_px: FloatArray, integrated: bool) -> FloatArray:
    """The light (n, size) that pixels centred at `at_px` (n,) along an axis collect from each of
    `size` samples, by the spline of `SampledPsf`.
    """
    from scipy.interpolate import make_interp_spline

    unit_images = np.pad(np.eye(size), ((BLACK_SAMPLES, BLACK_SAMPLES), (0, 0)))
    place_px = offsets(len(unit_images)) / per_px
    spline = make_interp_spline(place_px, unit_images, SPLINE_DEGREE)
    last_px = place_px[-1]
    if integrated:
        density = spline(np.clip(at_px, -last_px, last_px))
        return np.asarray(density * per_px)
    light = spline.antiderivative()
    low = light(np.clip(at_px - 0.5, -last_px, last_px))
    high = light(np.clip(at_px + 0.5, -last_px, last_px))
    return np.asarray((high - low) * per_px)


def _normal_floats(values: FloatArray) -> Float32Array:
    """Values in single precision, the smallest set to zero: products of subnormal numbers are
    slow.
    """
    return np.where(np.abs(values) < SMALLEST, 0, values).astype(np.float32)


def _few(table: Float32Array, side: int) -> tuple[Float32Array, Float32Array]:
    """Few rows (R, side^2) and coefficients (n, R), whose product is the table (n, side^2) to
    STAMP_TOLERANCE.

    Flux, centroids and second moments are kept exactly. Random projections find the principal
    components of the rest (Halko, Martinsson and Tropp 2011, algorithm 4.4), always the same ones.
    """
    exact_carriers, exact_terms = moment_carriers((side, side), 1.0)
    carriers = exact_carriers.astype(np.float32)
    terms = exact_terms.astype(np.float32)
    moments = table @ terms
    rest = table - moments @ carriers
    rng = np.random.default_rng(0)
    total = float(np.einsum("ij,ij->", table, table, dtype=np.float64))
    wanted = FIRST_STAMPS
    rest_energy = float(np.einsum("ij,ij->", rest, rest, dtype=np.float64))
    while True:
        wanted = min(wanted, *rest.shape)
        random = rng.standard_normal((rest.shape[1], wanted), dtype=np.float32)
        span = _orthonormal(rest.T @ _orthonormal(rest @ random))
        held = (rest @ span).astype(np.float64)
        eigenvalues, turn = np.linalg.eigh(held.T @ held)
        unexplained = rest_energy - np.cumsum(eigenvalues[::-1])
        enough = np.flatnonzero(unexplained <= STAMP_TOLERANCE**2 * total)
        if len(enough) or wanted in (MAX_STAMPS, *rest.shape):
            count = int(enough[0]) + 1 if len(enough) else wanted
            strongest_first = turn[:, ::-1]
            turn = strongest_first[:, :count].astype(np.float32)
            break
        wanted = min(2 * wanted, MAX_STAMPS)
    stamps = (span @ turn).T
    coefficients = np.concatenate([moments, rest @ stamps.T], axis=1)
    return np.concatenate([carriers, stamps]), coefficients


def _orthonormal(columns: Float32Array | FloatArray) -> Float32Array:
    """Orthonormal columns that span those given, by their products with each other: QR takes far
    longer on long ones.
    """
    products = columns.T @ columns
    values, vectors = np.linalg.eigh(products.astype(np.float64))
    good = values > 1e-9 * values[-1]
    to_orthonormal = vectors[:, good] / np.sqrt(values[good])
    return np.asarray(columns @ to_orthonormal, dtype=np.float32)
