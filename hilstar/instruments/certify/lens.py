"""Places of dots to a bench's deviations of place: a lens, its residuals' structure, and
polynomials where no lens will do.

The lens is fitted to directions as the bench file has them, so that it is the identity where the
file is right; its rotation is the tracker's alignment. A screen and a lens are smooth: structure of
the size of a dot's noise that such a lens leaves is an error of the dots, as from the pattern of
the tracker's pixels. It stays in no place that is stated, and counts by what the fit takes up of
it. Structure that is larger is of the bench: polynomials follow it.

Polynomials of third degree stand beside the lens's numbers, for lenses of another form. They also
take up errors of dots that are smooth over a quarter of the field or more. So structure is told by
what the lens alone leaves, up to half of the field. Longer errors are those of the tracker's own
directions, which `[certify.tracker]` states.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.units import ARCSEC_PER_RAD, MAD_TO_SIGMA
from hilstar.instruments.calibrate.geometric import fit as fits
from hilstar.instruments.calibrate.geometric.dots import DotPlan
from hilstar.instruments.calibrate.geometric.observed import Observed
from hilstar.instruments.certify.bench_readings import DotReadings, geometry_of
from hilstar.instruments.certify.structure import TINY, Cells, Structure, in_place
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.optics.camera import Camera, field_terms
from hilstar.server.bench.bench_file import BenchFile

EXPECTED_NOISE_PX = 0.03  # of a dot, for the robust steps before its noise is known
WILD_SIGMAS = 6.0
MAX_LENS_DOTS = 1000
SMALL_ARCSEC = 1e-12  # residuals without any noise are not wild
DERIVATIVE_STEP = 1e-4  # of a parameter's number
HALF_TANGENT = 0.1  # scale of directions, so that decentring has numbers of order 1
SAME = 1e-7  # relative size of a combination of parameters that no dot tells
# relative to noise: larger structure is of the bench, and not an error of its dots
DOT_VARIANCE = 4.0
# Of polynomials beside the lens's numbers. Planted lenses in another form, with tilts of 1 degree,
# are then within 0.0005 arcsec, with decentring of the fifth order.
BESIDE_DEGREE = 3
DEGREES = (7, 9, 11, 13)
LONGEST = 1 / 2  # of structure, relative to the field
# Tilt and centre replace each other and a turn along a bent valley, down which a fit by steps goes
# far from what is true. They are in the linear fit, with the tilt's second order.
BY_STEPS = tuple(name for name in fits.BROWN_CONRADY if not name.startswith(("centre", "tilt")))
STILL = np.array([[1.0, 0.0, 0.0, 0.0]])  # the mount of the only image


@dataclass(frozen=True, slots=True)
class Places:
    """Deviations of place at some pixels (n,), arcsec along the image's x and y.

    `value` (n, 2); `noise` (m, n, 2) and `correlated` (k, n, 2) are standardised contributions of
    the dots' noise and of what is correlated, each with its freedom.
    """

    value: FloatArray
    noise: FloatArray
    noise_dof: float
    correlated: FloatArray
    structure: Structure


@dataclass(frozen=True, slots=True)
class LensFit:
    """A fit to the places of dots: its terms at the dots and at any pixel, and its covariance."""

    geometry: BenchGeometry
    flat: Camera
    fit: fits.Fit
    degree: int
    mix: FloatArray
    coefficients: FloatArray
    basis: FloatArray
    cells: Cells
    structure: Structure
    dof: float

    def at(self, x_px: FloatArray, y_px: FloatArray) -> Places:
        """The deviations at pixels (n,) of the monitor."""
        file_rays = self.geometry.monitor.rays(x_px, y_px)
        wanted = file_rays[:, :2] / file_rays[:, 2:]
        shown = _tangents(self.fit.geometry.monitor, self.flat, wanted)
        value = (shown - wanted) * ARCSEC_PER_RAD
        terms = _terms(self.fit, self.flat, wanted, (x_px, y_px), self.degree)
        # the pattern of the tracker's pixels moves no star
        terms = terms @ self.mix[: terms.shape[2]]
        value += (terms @ self.coefficients).T
        # The basis is orthonormal over the dots, so that each coefficient has the noise of one dot.
        noise = math.sqrt(self.structure.noise_variance) * terms.transpose(2, 1, 0)
        correlated = np.einsum("anp,pm->mna", terms, self._of_structure())
        return Places(value, noise, self.dof, correlated, self.structure)

    def _of_structure(self) -> FloatArray:
        """What the dots' structure does to the coefficients: factors (terms, k) of its
        covariance.
        """
        covariance = np.zeros((len(self.coefficients), len(self.coefficients)))
        by_cell = [self.cells.means(axis) * self.cells.count[:, None] for axis in self.basis]
        for length, variance in self.structure.parts():
            eigen, rows, columns = self.cells.basis(length)
            for axis in by_cell:
                turned = self.cells.turned(rows, columns, axis)
                covariance += variance * (turned.T * eigen) @ turned
        size, vectors = np.linalg.eigh(covariance)
        is_independent = size > SAME * max(float(size.max()), TINY)
        return np.asarray(vectors[:, is_independent] * np.sqrt(size[is_independent]))


def lens_fit(file: BenchFile, read: DotReadings, seen_off: FloatArray) -> LensFit:
    """Fit the places of dots, whose deviations from the bench file are `seen_off` (n, 2),
    arcsec.
    """
    geometry = geometry_of(file)
    usable: BoolArray = np.asarray(np.isfinite(seen_off).all(axis=1))
    monitor = geometry.monitor
    flat = Camera(
        monitor.resolution_px, monitor.focal_length_px, monitor.principal_point_px, np.eye(3), None
    )
    rays = monitor.rays(read.x_px, read.y_px)
    wanted = rays[:, :2] / rays[:, 2:]
    lens = _fitted(geometry, flat, wanted, read, _thinned(usable))
    shown = _tangents(lens.geometry.monitor, flat, wanted)
    residual = seen_off - (shown - wanted) * ARCSEC_PER_RAD
    usable = _tame(read, residual, usable, monitor.resolution_px)
    x = read.x_px[usable]
    y = read.y_px[usable]
    # Where the fit shows the dots: waves at the places as read would hold each dot's own noise, and
    # fit it.
    phases = _phases(*geometry.tracker.places_px(*shown[usable].T))
    both_axes = residual[usable].T.ravel()
    for degree in (0, *DEGREES):
        terms = _terms(lens, flat, wanted[usable], (x, y), degree)
        vectors, mix = _orthonormal(np.concatenate([terms, phases], axis=2))
        telling = vectors
        if not degree:
            of_lens = _lens_terms(lens, flat, wanted[usable])
            telling, _ = _orthonormal(np.concatenate([of_lens, phases], axis=2))
        structure = in_place(x, y, *_left_by(telling, both_axes), LONGEST)
        rest, basis = _left_by(vectors, both_axes)
        dof = float(rest.size - basis.shape[2])
        # By what the residuals show: the variance of a structure as long as the field is hardly
        # known.
        largest = (1 + DOT_VARIANCE) * structure.noise_variance
        if float((rest**2).sum()) / dof <= largest:
            break
    coefficients = vectors.T @ both_axes
    cells = Cells(x, y)
    return LensFit(geometry, flat, lens, degree, mix, coefficients, basis, cells, structure, dof)


def _orthonormal(terms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """An orthonormal basis (2 n, k) of terms (2, n, p) over the dots, and what turns the terms into
    it (p, k); combinations that no dot tells are in neither.
    """
    columns = terms.reshape(-1, terms.shape[2])
    scale = np.maximum(np.linalg.norm(columns, axis=0), TINY)
    vectors, size, across = np.linalg.svd(columns / scale, full_matrices=False)
    is_told = size > SAME * size[0]
    return vectors[:, is_told], across[is_told].T / size[is_told] / scale[:, None]


def _left_by(vectors: FloatArray, both_axes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What an orthonormal basis (2 n, k) leaves of values (2 n,), by axis (2, n), and the basis by
    axis (2, n, k).
    """
    rest = both_axes - vectors @ (vectors.T @ both_axes)
    by_axis = rest.reshape(2, -1)
    return by_axis, vectors.reshape(*by_axis.shape, -1)


def _thinned(usable: BoolArray) -> BoolArray:
    """Of the usable dots (n,) about MAX_LENS_DOTS, all over the field: the lens is fitted by steps,
    and what it leaves by all dots at once.
    """
    every = max(int(usable.sum()) // MAX_LENS_DOTS, 1)
    thinned = np.zeros_like(usable)
    thinned[np.flatnonzero(usable)[::every]] = True
    return thinned


def _tame(
    read: DotReadings, residual: FloatArray, usable: BoolArray, resolution_px: tuple[int, int]
) -> BoolArray:
    """Which of the usable dots (n,) are not wild by what the lens leaves of them (n, 2), arcsec.

    That is about polynomials, too: the lens alone may be off by more than noise, and a dot that it
    misses is not wild.
    """
    rough = field_terms(read.x_px, read.y_px, resolution_px, DEGREES[0])
    for _ in range(3):
        coefficients = np.linalg.lstsq(rough[usable], residual[usable], rcond=None)[0]
        off = np.abs(residual - rough @ coefficients)
        spread = MAD_TO_SIGMA * np.median(off[usable], axis=0)
        within = usable & (off < WILD_SIGMAS * np.maximum(spread, SMALL_ARCSEC)).all(axis=1)
        if within.sum() == usable.sum():
            break
        usable = within
    return usable


def _phases(x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """What the pattern of the tracker's pixels does to centroids (2, n, 4): waves of one pixel,
    along each axis by itself.
    """
    waves = np.zeros((2, len(x_px), 4))
    for axis, at in enumerate((x_px, y_px)):
        angle = 2 * np.pi * at
        waves[axis, :, 2 * axis] = np.sin(angle)
        waves[axis, :, 2 * axis + 1] = np.cos(angle)
    return waves


def _fitted(
    geometry: BenchGeometry, flat: Camera, wanted: FloatArray, read: DotReadings, usable: BoolArray
) -> fits.Fit:
    """The lens that turns directions of the bench file into those seen."""
    x, y = flat.places_px(*wanted[usable].T)
    count = len(x)
    none = np.zeros(count, dtype=np.intp)
    plan = DotPlan(x, y, np.ones((count, 1), dtype=bool))
    seen_px = read.seen_x_px[usable], read.seen_y_px[usable]
    observed = Observed(none, none, *seen_px, np.ones(count))
    nominal = fits.Nominal(flat, STILL[0], geometry.tracker)
    problem = fits.Problem(plan, nominal, STILL, EXPECTED_NOISE_PX)
    matched = fits.MatchedDots(observed, np.arange(count))
    by_steps = fits.fit(problem, fits.Model(BY_STEPS), 0, matched)
    number = dict(zip(BY_STEPS, by_steps.numbers, strict=True))
    numbers = np.array([number.get(name, 0.0) for name in fits.BROWN_CONRADY])
    return replace(by_steps, model=fits.Model(fits.BROWN_CONRADY), numbers=numbers)


def _tangents(fitted: Camera, flat: Camera, wanted: FloatArray) -> FloatArray:
    """Where the fitted lens shows the directions (n, 2) of the bench file, tangents in cam."""
    rays = fitted.rays(*flat.places_px(*wanted.T))
    return np.asarray(rays[:, :2] / rays[:, 2:])


def _terms(
    fit: fits.Fit,
    flat: Camera,
    wanted: FloatArray,
    at_px: tuple[FloatArray, FloatArray],
    degree: int,
) -> FloatArray:
    """Slopes (2, n, terms) of places, arcsec, by the lens's numbers, or polynomials in their
    place where there is a degree.
    """
    terms = field_terms(*at_px, flat.resolution_px, degree or BESIDE_DEGREE)
    nothing = np.zeros_like(terms)
    polynomials = np.stack([np.hstack([terms, nothing]), np.hstack([nothing, terms])])
    if degree:
        return polynomials
    return np.concatenate([_lens_terms(fit, flat, wanted), polynomials], axis=2)


def _lens_terms(fit: fits.Fit, flat: Camera, wanted: FloatArray) -> FloatArray:
    """Slopes (2, n, terms) of places, arcsec, by the lens's numbers, decentring and tilt."""
    nominal = fits.Nominal(flat, STILL[0], flat)
    tangents = _tangents(fit.geometry.monitor, flat, wanted)
    shown = np.append(tangents, np.ones((len(wanted), 1)), axis=1)

    def places(step: FloatArray) -> FloatArray:
        camera = fits.geometry_of(fit.model, nominal, STILL, fit.numbers + step).monitor
        return np.stack(camera.project(shown @ camera.cam_to_image.T))

    columns = []
    for step in DERIVATIVE_STEP * np.eye(fit.model.size):
        # A pixel that moves by the lens shows its direction elsewhere by the opposite.
        slope_px = (places(-step) - places(step)) / (2 * DERIVATIVE_STEP)
        columns.append(slope_px / flat.focal_length_px * ARCSEC_PER_RAD)
    slopes = np.stack(columns, axis=2)
    return np.concatenate([slopes, _decentring(wanted), _tilted(wanted)], axis=2)


def _decentring(wanted: FloatArray) -> FloatArray:
    """Decentring of the fifth order (2, n, 4) at directions (n, 2): a lens whose axis is not the
    screen's.
    """
    round_ = (wanted**2).sum(axis=1) / HALF_TANGENT**2
    place = wanted.T / HALF_TANGENT
    terms = np.zeros((2, len(wanted), 4))
    for axis in range(2):
        terms[:, :, axis] = round_ * place * place[axis]
        terms[axis, :, 2 + axis] = round_**2
    return terms


def _tilted(wanted: FloatArray) -> FloatArray:
    """What a tilted screen does beside the slopes of tilt and focal length (2, n, 5), at directions
    (n, 2): one scale along x and another along y, rows that lean, and the tilt's second order.
    """
    x, y = wanted.T / HALF_TANGENT
    second_order = np.stack([x * x, x * y, y * y], axis=1)
    along_x = np.column_stack([x, y, x[:, None] * second_order])
    along_y = np.column_stack([-y, x, y[:, None] * second_order])
    return np.stack([along_x, along_y])
