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
from hilstar.optics.glass.psf_file import MAX_NEGATIVE, TOLERANCE, Glass, moment_carriers, principal
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
FIRST_STAMPS, MAX_STAMPS = 48, 400
MAX_DEGREE = 3  # splines over wavelength and focus, polynomials over a scattered field
MAX_GRID_DEGREE = 4
ON_EDGE_PX = 1e-6
SMALLEST, DARK = 1e-15, 1e-12  # numbers, and illuminations, that count as none
SPRITES_AT_ONCE_PX = 2_000_000
MIN_REGRIDDED, WIDTH_ROUNDS = 4, 20
# basis images of the simpler glasses that may stand for one
COMPONENTS = (3, 6, 12)


Kernel = Literal["linear", "thin_plate_spline", "quintic"]


class NodeSpline:
    """Functions of one variable, one of each of `nodes` (k,), rising: 1 there, 0 at the others.

    Beyond the nodes the values at their ends count.
    """

    def __init__(self, nodes: FloatArray, max_degree: int = MAX_DEGREE) -> None:
        # 0.2 s of every command that needs none of it
        from scipy.interpolate import make_interp_spline

        self._nodes = nodes
        self._of = None
        self._middle = (nodes[-1] + nodes[0]) / 2
        self._half = (nodes[-1] - nodes[0]) / 2 or 1.0
        if len(nodes) > max_degree + 1:
            self._of = make_interp_spline(nodes, np.eye(len(nodes)), max_degree)
        else:  # one polynomial, which is quicker
            self._terms = np.linalg.inv(
                polyvander((nodes - self._middle) / self._half, len(nodes) - 1)
            ).T

    def __call__(self, at: FloatArray) -> FloatArray:
        """The functions (n, k) at places (n,)."""
        at = np.clip(at, self._nodes[0], self._nodes[-1])
        if self._of is not None:
            return np.asarray(self._of(at))
        return np.asarray(
            (self._terms @ polyvander((at - self._middle) / self._half, len(self._nodes) - 1).T).T
        )


class Field:
    """Functions over the field, one of each of its points (F, 2): 1 there, 0 at the others, smooth
    between.

    On a full grid they are products of splines, elsewhere radial basis functions with polynomials.
    Beyond the points' convex hull they have the values of its nearest place.
    """

    def __init__(self, places_px: FloatArray) -> None:
        self.places_px = places_px
        self._scale = max(1.0, float(np.abs(places_px - places_px.mean(axis=0)).max()))
        self._degree = max((d for d in range(MAX_DEGREE + 1) if self._holds(d)), default=0)
        self.hull_px = places_px[self._corners()]
        columns, rows = (np.unique(axis) for axis in places_px.T)
        grid = np.stack([part.T.ravel() for part in np.meshgrid(columns, rows)], axis=1)
        self._grid = None  # `places_px` is sorted by x, then y
        if grid.shape == places_px.shape and (grid == places_px).all():
            self._grid = NodeSpline(columns, MAX_GRID_DEGREE), NodeSpline(rows, MAX_GRID_DEGREE)

    def _scaled(self, places_px: FloatArray) -> FloatArray:
        return np.asarray((places_px - self.places_px.mean(axis=0)) / self._scale)

    def _holds(self, degree: int) -> bool:
        """Whether the points determine a polynomial of that degree with some to spare."""
        x, y = self._scaled(self.places_px).T
        products = []
        for i in range(degree + 1):
            for j in range(degree + 1 - i):
                products.append(x**i * y**j)
        terms = np.stack(products, axis=1)
        if degree > 1:
            enough = terms.shape[1] * 1.4 <= len(x)
        else:
            enough = terms.shape[1] <= len(x)
        return bool(enough and np.linalg.matrix_rank(terms, tol=1e-6 * len(x)) == terms.shape[1])

    def _corners(self) -> list[int]:
        """The points at the corners of the hull, in order; the two ends of a line."""
        if self._holds(1):
            from scipy.spatial import ConvexHull

            return [int(k) for k in ConvexHull(self.places_px).vertices]
        along = self.places_px @ np.ptp(self.places_px, axis=0)
        return sorted({int(along.argmin()), int(along.argmax())})

    def within(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (n, 2) within the hull, the nearest for those beyond, and how far these are
        beyond it, px (n,).
        """
        places = np.stack([x_px, y_px], axis=1)
        beyond_px = np.zeros(len(places))
        begin = self.hull_px
        along = np.roll(self.hull_px, -1, axis=0) - self.hull_px
        off = places[:, None] - begin
        cross_px = along[:, 0] * off[..., 1] - along[:, 1] * off[..., 0]
        if len(begin) > 2:
            outside = np.flatnonzero((cross_px < -ON_EDGE_PX * self._scale).any(axis=1))
        else:
            outside = np.arange(len(places))  # a line or a point has no inside
        if len(outside):
            length2 = np.maximum((along * along).sum(axis=1), 1e-300)
            part = np.clip((off[outside] * along).sum(axis=2) / length2, 0, 1)
            nearest = begin + part[..., None] * along
            far = np.linalg.norm(nearest - places[outside, None], axis=2)
            which = far.argmin(axis=1)
            beyond_px[outside] = far[np.arange(len(outside)), which]
            places[outside] = nearest[np.arange(len(outside)), which]
        return places, beyond_px

    @cached_property
    def _scattered(self) -> Callable[[FloatArray], FloatArray]:
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
            across, down = (
                spline(place) for spline, place in zip(self._grid, places.T, strict=True)
            )
            return np.asarray((across.T[:, None] * down.T).reshape(-1, len(places)).T)
        return np.asarray(self._scattered(self._scaled(places)))


@dataclass(frozen=True, slots=True)
class _Stamps:
    """Stamps, images of the light of pixels, from which PSFs are mixed: `stamps` (R, side^2).

    The coefficient of a stamp is a polynomial of a star's place within its pixel. `parts` (squares,
    6 K, R) are the polynomials' coefficients for each basis image and each square of a pixel, in
    the order of `_terms`. `sums` (R,) are the stamps' sums; `light` (K, n) is the light of pixels
    by basis image at all tabulated places.
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
    """An image whose width is wanted, and which no star is drawn by."""

    max_negative = 1.0


@dataclass(frozen=True, eq=False)
class GlassPsf(SampledPsf):
    """A glass at one focus: stars are drawn each by place and spectrum, all else by the mean PSF in
    the field's middle.

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
        stamps = self._stamps
        weights = self.optics.weights.reshape(-1, len(self.optics.basis))
        least = float((weights @ stamps.light).min())
        if least < 1 - MAX_UNEVEN:
            raise InputError(
                f"a star's pixels get {least:.1%} of a PSF's light at one place in a pixel, and"
                " more at others: sample it more finely, or write PIXINT = F where no pixel is"
                " integrated in it"
            )

    @cached_property
    def width_px(self) -> tuple[float, float]:
        """The smaller of the mean's and the sharpest PSF's: paths are sampled for all."""
        flat = self.optics.weights.reshape(-1, len(self.optics.basis))
        peak = (flat @ self.optics.basis.reshape(len(self.optics.basis), -1)).max(axis=1)
        sharpest = np.tensordot(flat[peak.argmax()], self.optics.basis, axes=1).clip(min=0)
        widths = []
        for samples in (self.samples, sharpest):
            widths.append(_Measured(samples, self.per_px, self.pixel_integrated).width_px)
        x, y = np.min(widths, axis=0).tolist()
        return x, y

    @cached_property
    def footprint_px(self) -> int:
        """The side of the smallest odd square outside which no PSF has more than MAX_CUT of its
        light.
        """
        count, height, width = self.optics.basis.shape
        y, x = np.indices((height, width))
        ring = np.maximum(np.abs(y - height // 2), np.abs(x - width // 2)).ravel()
        light = np.stack([np.bincount(ring, image.ravel()) for image in self.optics.basis])
        light_within = np.cumsum(self.optics.weights.reshape(-1, count) @ light, axis=1)
        cut = np.abs(1 - light_within).max(axis=0)
        too_much = np.flatnonzero(cut > MAX_CUT)
        last_ring = min(int(too_much[-1]) + 1, len(cut) - 1) if len(too_much) else 0
        # samples of which pixels are integrated have light from half a pixel around them
        pixel_half_px = 0.5 if self.pixel_integrated else 0.0
        side = 2 * math.ceil((last_ring + 0.5) / self.per_px + pixel_half_px) + 1
        if side > MAX_FOOTPRINT_PX:
            raise InputError(
                f"a PSF's light reaches over {side} px, more than {MAX_FOOTPRINT_PX}; cut off what"
                " lies further out"
            )
        return side

    @cached_property
    def peak_share(self) -> float:
        """The largest of the sharpest PSF, where a star is in a pixel's middle, and of the mean."""
        return max(float(self._table.max()), float(self._centred().max()))

    def _centred(self) -> Float32Array:
        """The light (F L, side^2) of the pixels about a star in the middle of a pixel, by each of
        the PSFs.
        """
        weights = self.optics.weights.reshape(-1, len(self.optics.basis)).astype(np.float32)
        return self._parts(weights, *np.zeros((2, len(weights)))) @ self._stamps.stamps

    def _tabulated(self, steps: int) -> list[FloatArray]:
        """The light that pixels of the footprint collect from the rows and the columns of basis
        images, (steps + 1, side, samples) each, by the star's place within its pixel.
        """
        side = self.footprint_px
        at_px = np.arange(side) - side // 2 - (np.arange(steps + 1)[:, None] / steps - 0.5)
        shape = self.optics.basis.shape[1:]
        basis_pixels = (
            _pixels_of(size, self.per_px, at_px.ravel(), self.pixel_integrated) for size in shape
        )
        return [part.reshape(steps + 1, side, -1) for part in basis_pixels]

    @cached_property
    def _squares(self) -> int:
        """How many squares a pixel has along each side."""
        basis = self.optics.basis
        weights = self.optics.weights.reshape(-1, len(self.optics.basis))
        lines = (weights @ basis.sum(axis=axis) for axis in (2, 1))
        curvatures = []
        for line, table in zip(lines, self._tabulated(PLACES_A_PX), strict=True):
            curvatures.append(line @ np.diff(table, 3, axis=0).swapaxes(1, 2))
        # over a square of 1 px, by Chebyshev's
        cubic = (
            max(float(np.abs(curvature).max()) for curvature in curvatures) * PLACES_A_PX**3 / 192
        )
        return int(np.clip(math.ceil(np.cbrt(cubic / CUBIC_TOLERANCE)), MIN_SQUARES, MAX_SQUARES))

    @cached_property
    def _stamps(self) -> _Stamps:
        """The basis as pixels get it, tabulated by a star's place in its middle pixel and
        reduced to few stamps.
        """
        side = self.footprint_px
        squares = self._squares
        steps_a_square = min(
            MAX_STEPS, max(MIN_STEPS, min(TABLE_SIDE // side, MAX_STEPS * 6) // squares)
        )
        steps = steps_a_square * squares
        count = len(self.optics.basis)
        down, across = (
            _normal_floats(part.reshape(-1, part.shape[2])) for part in self._tabulated(steps)
        )
        used = np.maximum(np.sqrt((self.optics.weights**2).mean(axis=(0, 1))), 1e-30).astype(
            np.float32
        )
        table = np.empty((count, (steps + 1) ** 2, side * side), dtype=np.float32)
        for image, scale, table_part in zip(
            _normal_floats(self.optics.basis), used, table, strict=True
        ):
            pixels = (down @ (scale * image) @ across.T).reshape(steps + 1, side, steps + 1, side)
            table_part[:] = pixels.transpose(0, 2, 1, 3).reshape(table_part.shape)
        stamps, coefficients = _few(table.reshape(-1, side * side), side)
        by_place = (coefficients.reshape(count, -1) / used[:, None]).reshape(
            count, steps + 1, steps + 1, -1
        )
        places = np.linspace(-1, 1, steps_a_square + 1)
        y, x = (part.ravel() for part in np.meshgrid(places, places, indexing="ij"))
        fit = np.linalg.pinv(_terms(x, y)).astype(np.float32)
        parts = np.empty((squares**2, fit.shape[0], count, len(stamps)), dtype=np.float32)
        for number, table_part in enumerate(parts):
            row, column = (steps_a_square * place for place in divmod(number, squares))
            square = by_place[
                :, row : row + steps_a_square + 1, column : column + steps_a_square + 1
            ]
            table_part[:] = np.tensordot(fit, square.reshape(count, -1, len(stamps)), axes=(1, 1))
        light = table.sum(axis=2) / used[:, None]
        return _Stamps(
            stamps, parts.reshape(squares**2, -1, len(stamps)), stamps.sum(axis=1), light
        )

    def _mixed(self, x_px: FloatArray, y_px: FloatArray, shares: FloatArray) -> Float32Array:
        """How much stars at places (n,) have of each basis image (n, K); `shares` as
        spectra of `Psf`.
        """
        by_field = self.field(x_px, y_px).T.astype(np.float32)
        shares = shares.T.astype(np.float32, order="C")
        by_point = by_field[:, None] * shares.reshape(shares.shape[0], -1)
        return np.asarray(by_point.reshape(len(self._light), -1).T @ self._light)

    @cached_property
    def _sums(self) -> Float32Array:
        return np.asarray(self.optics.basis.sum(axis=(1, 2)), dtype=np.float32)

    @cached_property
    def _light(self) -> Float32Array:
        """The weights of each point's and wavelength's light (F L, K): a PSF's, times its
        illumination inside the image.
        """
        optics = self.optics
        light = optics.weights * (optics.illumination * optics.inside)[..., None]
        return np.asarray(light.reshape(-1, len(optics.basis)), dtype=np.float32)

    def _parts(self, weights: Float32Array, x_px: FloatArray, y_px: FloatArray) -> Float32Array:
        """The coefficients (n, R) of the stamps for stars at places (n,), sorted by `_square`, with
        `weights` (n, K) of the basis images.
        """
        square, *within = _square(x_px, y_px, self._squares)
        terms = _terms(*within).astype(np.float32)[:, :, None]
        stamp_parts = self._stamps.parts
        counts = np.bincount(square, minlength=self._squares**2)
        parts = np.empty((len(terms), stamp_parts.shape[2]), dtype=np.float32)
        room = np.empty((counts.max(), terms.shape[1], weights.shape[1]), dtype=np.float32)
        end = 0
        for stamp_part, count in zip(stamp_parts, counts.tolist(), strict=True):
            if count:
                begin = end
                end = end + count
                products = np.multiply(terms[begin:end], weights[begin:end, None], out=room[:count])
                np.matmul(products.reshape(count, -1), stamp_part, out=parts[begin:end])
        return parts

    @cached_property
    def moved_px(self) -> FloatArray:
        """The centroid of each PSF from its chief ray (F, L, 2), px."""
        _, height, width = self.optics.basis.shape
        x = np.arange(width) - width // 2
        y = np.arange(height) - height // 2
        firsts = np.stack(
            [self.optics.basis.sum(axis=1) @ x, self.optics.basis.sum(axis=2) @ y], axis=1
        )
        return np.asarray(self.optics.weights @ firsts / self.per_px)

    def centroids_px(
        self, x_px: FloatArray, y_px: FloatArray, spectra: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The centroids (n,) of the light of stars at places (n,), px, and their illumination
        relative to the axis.

        What lies outside the images does not count.
        """
        optics = self.optics
        by_field = self.field(x_px, y_px)
        falls = optics.illumination * optics.inside
        total = ((by_field @ falls) * spectra).sum(axis=1)
        lit = total > DARK
        off = [
            ((by_field @ (falls * off)) * spectra).sum(axis=1)
            for off in np.moveaxis(self.moved_px, 2, 0)
        ]
        x, y = (
            place + np.where(lit, first / np.where(lit, total, 1), 0)
            for place, first in zip((x_px, y_px), off, strict=True)
        )
        return x, y, ((by_field @ optics.illumination) * spectra).sum(axis=1)

    def stamps_at(
        self,
        x_px: FloatArray,
        y_px: FloatArray,
        spectra: FloatArray,
        electrons_per_s: FloatArray | Float32Array | None = None,
    ) -> Float32Array:
        """See `Psf.stamps_at`: each by its place and spectrum."""
        rates = np.ones(len(x_px)) if electrons_per_s is None else electrons_per_s
        order = np.argsort(_square(x_px, y_px, self._squares)[0])
        stamps, scale = self._drawn(
            x_px[order], y_px[order], spectra[order] if spectra.ndim == 2 else spectra
        )
        squares = np.empty_like(stamps)
        squares[order] = stamps * (rates[order] * scale)[:, None]
        return squares.reshape(-1, self.footprint_px, self.footprint_px)

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
        return parts @ self._stamps.stamps, np.asarray(
            light / np.where(whole > 0, whole, np.inf), dtype=np.float32
        )

    def unreduced(self, x_px: FloatArray, y_px: FloatArray, shares: FloatArray) -> FloatArray:
        """The same of stars of 1 electron per second, by the whole basis: exact, and some
        hundred times as slow.
        """
        side = self.footprint_px
        at_px = np.arange(side) - side // 2
        stamps = np.empty((len(x_px), side, side))
        for stamp, weights, x, y in zip(
            stamps, self._mixed(x_px, y_px, shares), x_px, y_px, strict=True
        ):
            image = np.tensordot(weights.astype(np.float64), self.optics.basis, axes=1)
            height, width = image.shape
            down_px = at_px - (y - np.floor(y + 0.5))
            across_px = at_px - (x - np.floor(x + 0.5))
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

        side, (width, height) = self.footprint_px, resolution_px
        across = width + 2 * side
        size = (height + 2 * side) * across
        near = np.arange(side, dtype=np.int32)
        near = (near[:, None] * across + near).ravel()
        at_once = max(1, SPRITES_AT_ONCE_PX // side**2)
        order = np.argsort(_square(x_px, y_px, self._squares)[0])
        room = np.empty(0, np.float32)
        for begin in range(0, max(len(order), 1), at_once):
            part = order[begin : begin + at_once]
            at_px = x_px[part], y_px[part]
            stamps, scale = self._drawn(*at_px, spectra[part] if spectra.ndim == 2 else spectra)
            columns, rows = (
                np.floor(place + 0.5).astype(np.int32) + side - side // 2 for place in at_px
            )
            places = (rows * across + columns)[:, None] + near
            ends = np.arange(len(part) + 1, dtype=np.int32) * side**2
            sparse = csc_array((stamps.ravel(), places.ravel(), ends), (size, len(part)))
            light = np.asarray(sparse @ (electrons_per_s[part] * scale))
            room = room + light if begin else light
        return room.reshape(-1, across)[side:-side, side:-side]

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
        spread = np.stack(
            [np.fft.ifft2(fourier_gaussian(np.fft.fft2(image), sigma)).real for image in wide]
        )
        optics = replace(self.optics, basis=spread)
        return replace(self, samples=_middle(optics, self.field, self.mean_shares), optics=optics)


def glass_psf(glass: Glass, focus_um: float, mean_shares: FloatArray) -> GlassPsf:
    """A glass at one of its focus positions, or between them. Raises InputError for PSFs that
    cannot be drawn.
    """
    at_focus = NodeSpline(glass.focuses_um)(np.array([focus_um]))[0]
    weights, illumination, inside = (
        np.tensordot(part, at_focus, axes=(2, 0))
        for part in (glass.weights, glass.illumination, 1 - glass.outside)
    )
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
    half_x, half_y = (
        np.ceil(np.abs(np.linalg.inv(to_samples)) @ (np.array([width, height]) // 2))
        .astype(int)
        .tolist()
    )
    y, x = np.indices((2 * half_y + 1, 2 * half_x + 1)) - np.array([half_y, half_x])[:, None, None]
    columns, rows = np.tensordot(to_samples, np.stack([x, y]), axes=1)
    at = np.stack([rows + height // 2, columns + width // 2])
    drawn: FloatArray = np.stack(
        [map_coordinates(image, at, np.float64, SPLINE_DEGREE) for image in images]
    )
    return drawn * abs(float(np.linalg.det(to_samples))), new_per_px


def _middle(optics: Focused, field: Field, shares: FloatArray) -> FloatArray:
    middle = field(*field.places_px.mean(axis=0)[:, None])[0]
    return np.asarray(
        np.tensordot(np.einsum("f,l,flk->k", middle, shares, optics.weights), optics.basis, axes=1)
    )


def with_components(psf: GlassPsf, count: int) -> GlassPsf:
    """A glass by so many basis images: the mean and the principal components of its PSFs' light.
    Each PSF still sums to 1.
    """
    optics = psf.optics
    flat = optics.weights.reshape(-1, len(optics.basis))
    basis = optics.basis.reshape(len(optics.basis), -1)
    mean = flat.mean(axis=0)
    values, vectors = np.linalg.eigh(basis @ basis.T)
    # its square is the metric of weights
    scale = vectors * np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    turned, sizes, components = np.linalg.svd((flat - mean) @ scale, full_matrices=False)
    component_count = min(count - 1, int((sizes > 1e-9 * sizes[0]).sum()))
    images = np.vstack([mean, components[:component_count] @ np.linalg.pinv(scale)]) @ basis
    weights = np.hstack(
        [np.ones((len(flat), 1)), turned[:, :component_count] * sizes[:component_count]]
    )
    return _of_images(psf, images, weights)


def as_gaussians(psf: GlassPsf) -> GlassPsf:
    """A glass whose PSFs are Gaussians, each of its own axes and angle: the centroids, and
    widths by adaptive moments.
    """
    optics = psf.optics
    side = psf.footprint_px
    pixel = np.stack([part.ravel() for part in np.indices((side, side))[::-1]], axis=1) - side // 2
    _, height, width = optics.basis.shape
    y, x = np.indices((height, width))
    place = np.stack([x.ravel() - width // 2, y.ravel() - height // 2], axis=1) / psf.per_px
    images = []
    for stamp, centroid in zip(
        psf._centred().astype(np.float64), psf.moved_px.reshape(-1, 2), strict=True
    ):
        off = pixel - centroid
        spread = np.eye(2)
        for _ in range(WIDTH_ROUNDS):  # as `SampledPsf.width_px`
            light = stamp * np.exp(-0.5 * np.einsum("ni,ij,nj->n", off, np.linalg.inv(spread), off))
            spread = 2 * (off.T * light) @ off / light.sum()
            spread += np.eye(2) * max(
                0.0, PIXEL_VARIANCE + MIN_WIDTH_PX**2 - float(np.linalg.eigvalsh(spread)[0])
            )
        if not psf.pixel_integrated:
            spread = spread - np.eye(2) * PIXEL_VARIANCE
        off = place - centroid
        images.append(np.exp(-0.5 * np.einsum("ni,ij,nj->n", off, np.linalg.inv(spread), off)))
    gaussians = np.stack(images)
    gaussians /= gaussians.sum(axis=1, keepdims=True)
    pixel_samples = 1 if psf.pixel_integrated else psf.per_px
    basis, weights, _ = principal(gaussians, optics.basis.shape[1:], TOLERANCE, pixel_samples)
    return _of_images(psf, basis.astype(np.float64), weights)


def _of_images(psf: GlassPsf, images: FloatArray, weights: FloatArray) -> GlassPsf:
    """A glass by other images (K, m) and weights (n, K) of its PSFs."""
    basis = images.reshape(-1, *psf.optics.basis.shape[1:])
    weights = (weights / (weights @ images.sum(axis=1))[:, None]).reshape(
        *psf.optics.weights.shape[:2], -1
    )
    optics = replace(psf.optics, basis=basis, weights=weights)
    return replace(psf, samples=_middle(optics, psf.field, psf.mean_shares), optics=optics)


def _rebased(optics: Focused, lateral: FloatArray, width: int) -> Focused:
    """PSFs moved by `lateral` (F, L, 2) samples, right and down, on a basis of their own: one focus
    needs fewer components.

    Pixels have `width` samples, 1 where they are integrated.
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
    basis, weights, _ = principal(
        images.reshape(len(images), -1), images.shape[1:], TOLERANCE, width
    )
    weights /= (weights @ basis.sum(axis=1, dtype=np.float64))[:, None]
    return replace(
        optics,
        basis=basis.reshape(-1, *images.shape[1:]).astype(np.float64),
        weights=weights.reshape(*optics.weights.shape[:2], -1),
    )


def _square(
    x_px: FloatArray, y_px: FloatArray, squares: int
) -> tuple[IntArray, FloatArray, FloatArray]:
    """In which square of its pixel each star (n,) is, and its place in it, -1 to 1 right and
    down.
    """
    at = [(place - np.floor(place + 0.5) + 0.5) * squares for place in (x_px, y_px)]
    column, row = (np.minimum(place.astype(np.intp), squares - 1) for place in at)
    return row * squares + column, 2 * (at[0] - column) - 1, 2 * (at[1] - row) - 1


def _terms(x: FloatArray, y: FloatArray) -> FloatArray:
    """The terms (n, 6) of a quadratic function of places (n,)."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def _pixels_of(size: int, per_px: int, at_px: FloatArray, integrated: bool) -> FloatArray:
    """The light (n, size) that pixels centred at `at_px` (n,) along an axis collect from each of
    `size` samples, by the spline of `SampledPsf`.
    """
    from scipy.interpolate import make_interp_spline

    unit_images = np.pad(np.eye(size), ((BLACK_SAMPLES, BLACK_SAMPLES), (0, 0)))
    place_px = (np.arange(len(unit_images)) - len(unit_images) // 2) / per_px
    spline = make_interp_spline(place_px, unit_images, SPLINE_DEGREE)
    last_px = place_px[-1]
    if integrated:
        return np.asarray(spline(np.clip(at_px, -last_px, last_px)) * per_px)
    light = spline.antiderivative()
    low, high = (light(np.clip(at_px + side, -last_px, last_px)) for side in (-0.5, 0.5))
    return np.asarray((high - low) * per_px)


def _normal_floats(values: FloatArray) -> Float32Array:
    """Values in single precision, the smallest set to zero: products of subnormal numbers are
    slow.
    """
    return np.where(np.abs(values) < SMALLEST, 0, values).astype(np.float32)


def _few(table: Float32Array, side: int) -> tuple[Float32Array, Float32Array]:
    """Rows (R, side^2), and the coefficients (n, R) by which they make those of a table to
    STAMP_TOLERANCE.

    Flux, centroids and second moments are kept exactly. Random projections find the principal
    components of the rest (Halko, Martinsson and Tropp 2011, algorithm 4.4), always the same.
    """
    carriers, terms = (part.astype(np.float32) for part in moment_carriers((side, side), 1.0))
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
        enough = np.flatnonzero(
            rest_energy - np.cumsum(eigenvalues[::-1]) <= STAMP_TOLERANCE**2 * total
        )
        if len(enough) or wanted in (MAX_STAMPS, *rest.shape):
            turn = turn[:, ::-1][:, : int(enough[0]) + 1 if len(enough) else wanted].astype(
                np.float32
            )
            break
        wanted = min(2 * wanted, MAX_STAMPS)
    stamps = (span @ turn).T
    return np.concatenate([carriers, stamps]), np.concatenate([moments, rest @ stamps.T], axis=1)


def _orthonormal(columns: Float32Array | FloatArray) -> Float32Array:
    """Orthonormal columns that span those given, by their products with each other: QR takes far
    longer on long ones.
    """
    values, vectors = np.linalg.eigh((columns.T @ columns).astype(np.float64))
    good = values > 1e-9 * values[-1]
    return np.asarray(columns @ (vectors[:, good] / np.sqrt(values[good])), dtype=np.float32)
