"""Places of dots to a bench's deviations of place: a lens, its residuals' structure, and
polynomials where no lens will do.

The lens is fitted to directions as the bench file has them, so that it is the identity where the
file is right; its rotation is the tracker's alignment. A screen and a lens are smooth: structure of
the size of a dot's noise that such a lens leaves is an error of the dots, as from the pattern of
the tracker's pixels. It stays in no place that is stated, and counts by what the fit takes up of
it. Structure that is larger is of the bench: polynomials follow it.
"""

import math
from dataclasses import dataclass

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
# are then within 0.0013 arcsec, with decentring of the fifth order; without that within 0.03.
BESIDE_DEGREE = 3
DEGREES = (7, 9, 11, 13)
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
        of_degree = _terms(lens, flat, wanted[usable], (x, y), degree)
        terms = np.concatenate([of_degree, phases], axis=2).reshape(2 * len(x), -1)
        scale = np.maximum(np.linalg.norm(terms, axis=0), TINY)
        vectors, size, across = np.linalg.svd(terms / scale, full_matrices=False)
        is_told = size > SAME * size[0]
        told_vectors = vectors[:, is_told]
        coefficients = told_vectors.T @ both_axes
        rest = (both_axes - told_vectors @ coefficients).reshape(2, -1)
        basis = told_vectors.reshape(2, len(x), -1)
        structure = in_place(x, y, rest, basis)
        dof = float(2 * len(x) - is_told.sum())
        # By what the residuals show: the variance of a structure as long as the field is hardly
        # known.
        largest = (1 + DOT_VARIANCE) * structure.noise_variance
        if float((rest**2).sum()) / dof <= largest:
            break
    mix = across[is_told].T / size[is_told] / scale[:, None]
    cells = Cells(x, y)
    return LensFit(geometry, flat, lens, degree, mix, coefficients, basis, cells, structure, dof)


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
    return fits.fit(problem, fits.Model(fits.BROWN_CONRADY), 0, matched)


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
    return np.concatenate([np.stack(columns, axis=2), polynomials, _decentring(wanted)], axis=2)


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
