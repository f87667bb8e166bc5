"""Readings to a bench's deviations from its file, with their covariances: light by code and place,
places, delay.

All fits are linear least squares without a prior, so that their intervals hold by Student's t: a
smoother curve would be nearer to the truth on the whole, and not hold it where its bias is larger
than its scatter. What their residuals have of structure (structure.py) counts beside their noise.
Places are lens.py's.

    light      read / expected at each code read, above black, joined by a cubic spline in log
    light; a drift in time.
               Scatter relative to light and scatter in the dark are two estimates, each with its
               own freedom
    evenness   log(light of a dot / expected) over the screen, Chebyshev polynomials, relative to
    the middle

A polynomial's degree rises from its first one as long as the next is better by an F test.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import fdtrc

from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import ARCSEC_PER_RAD, MAD_TO_SIGMA
from hilstar.display.calibration import weights_of_grid
from hilstar.instruments.certify.bench_readings import (
    BesideRatio,
    DotReadings,
    LightReadings,
    geometry_of,
    grey_response,
)
from hilstar.instruments.certify.effects import smooth_root
from hilstar.instruments.certify.structure import (
    Cells,
    Structure,
    in_place,
    in_time,
    lasting_root,
)
from hilstar.optics.camera import field_terms
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import full_scale_e_per_s
from hilstar.server.bench.monitor import bench_calibration

EVEN_DEGREES = (4, 6, 8, 10)
BETTER_P = 0.001  # by the F test: a larger degree is taken below it
WILD_SIGMAS = 6.0
DOTS_A_TERM = 4
MAP = (16, 9)  # fields of a usual map of light, columns and rows
MIN_LEVELS = 4
FAINT_SIGMAS = 5.0
# relative to white: light by which the relative noise of a reading is known; black tells its floor
BRIGHT = 0.05
MIN_DOF = 2
SMALL_FLOOR = 1e-9  # relative to white and its noise: the smallest floor of a dark reading
SMALL_SQUARE = 1e-30
SMALL_SPREAD = 1e-12  # of logs or arcsec: residuals without any noise are not wild
ROUGH_P, ROUGH_CODES, MIN_ROUGH_CODES = 0.001, 5, 8
# between codes read, in log light: across a wider gap a smooth response is off by itself
MAX_ROUGH_STEP = 0.35
SAME_LIGHT = 1e-9


@dataclass(frozen=True, slots=True)
class LightDeviation:
    """True over expected light at the codes read: `value` (k,) over `log_light` (k,), log of light
    relative to white.

    `factors` (k, m) times its transpose is the covariance by `noise`, which is relative to light;
    `dark_factors` by the scatter of dark readings, `dark` relative to white, `lasting_factors` by
    what correlates from one reading to the next, `lasting` in sigmas of a reading; `common_factors`
    by what readings have in common. It holds for the first reading's moment, and for the mean over
    `square_px` (left, top, side).
    """

    log_light: FloatArray
    value: FloatArray
    factors: FloatArray
    dof: float
    noise: float
    dark_factors: FloatArray
    dark_dof: float
    dark: float
    lasting_factors: FloatArray
    lasting: Structure
    square_px: tuple[int, int, int]
    common_factors: FloatArray
    beside: BesideRatio | None

    def weights(self, log_light: FloatArray) -> FloatArray:
        """What each code's value adds to the deviation at lights (n,): (n, k). Beyond the codes
        read it is held.
        """
        unit = np.eye(len(self.log_light))
        spline = CubicSpline(self.log_light, unit, bc_type="natural")
        faintest, brightest = self.log_light[0], self.log_light[-1]
        return np.asarray(spline(np.clip(log_light, faintest, brightest)))

    def bent(self, log_light: FloatArray) -> FloatArray:
        """By how much the spline is above straight lines from code to code, at lights (n,)."""
        straight = np.interp(log_light, self.log_light, self.value)
        return np.asarray(self.weights(log_light) @ self.value - straight)

    def rough(self, log_light: FloatArray) -> FloatArray:
        """How far single codes may be from the spline through those read, at lights (n,), one
        sigma; 0 where nothing tells it.

        Each code read is foretold by the others. Where they are further off than noise explains (F,
        one in a thousand), that of the codes around a light holds for those between them that were
        not read.
        """
        none = np.zeros(len(log_light))
        step = np.diff(self.log_light)
        is_near = step < MAX_ROUGH_STEP
        inner = np.flatnonzero(is_near[1:] & is_near[:-1]) + 1
        if len(inner) < MIN_ROUGH_CODES:
            return none
        gaps = self._gaps()[inner]
        factors = [self.factors, self.dark_factors, self.lasting_factors]
        by_cause = gaps @ np.concatenate(factors, axis=1)
        noise = (by_cause**2).sum(axis=1)
        off = (gaps @ self.value) ** 2
        ratio = float((off / noise).mean())
        if fdtrc(len(inner), self.dof, ratio) > ROUGH_P:
            return none
        excess = (off - noise) / (gaps**2).sum(axis=1)
        window = np.ones(ROUGH_CODES)
        count = np.convolve(np.ones(len(excess)), window, mode="same")
        around = np.convolve(excess, window, mode="same") / count
        local = np.interp(log_light, self.log_light[inner], np.maximum(around, 0.0))
        between = 1 + (self.weights(log_light) ** 2).sum(axis=1)
        apart = np.abs(log_light[:, None] - self.log_light)
        is_read = (apart < SAME_LIGHT).any(axis=1)
        return np.asarray(np.where(is_read, 0.0, np.sqrt(local * between)))

    def _gaps(self) -> FloatArray:
        """Each code's value less what the others foretell, as shares of all values (k, k); the
        first and the last are 1 by themselves.
        """
        count = len(self.value)
        gaps = np.eye(count)
        for k in range(1, count - 1):
            others = np.arange(count) != k
            spline = CubicSpline(self.log_light[others], np.eye(count - 1), bc_type="natural")
            gaps[k, others] = -spline(self.log_light[k])
        return gaps


def light_deviation(file: BenchFile, read: LightReadings) -> LightDeviation:
    """The deviation of a bench's light by readings. Raises InputError where they are too few, or
    have no light.

    A reading is the light of its code and of black, times a drift; its noise goes with all light
    that it sees, and has a floor where a black screen scatters by more than that.
    """
    fit = _LightFit(read)
    by_light = _above_black(fit.by_light(), fit.size)
    by_dark = _above_black(fit.by_dark(), fit.size)
    standardised = fit.residual / fit.sigma
    structure = in_time(fit.when, standardised, fit.design / fit.sigma[:, None])
    if structure.total:
        # What is correlated is no noise of a reading by itself.
        alone = math.sqrt(structure.noise_variance)
        by_light *= alone
        by_dark *= alone
    by_lasting = _above_black(fit.inverse @ lasting_root(fit.when, structure), fit.size)
    light = _above_black(fit.solution, fit.size)
    white_error = float(np.hypot(np.linalg.norm(by_light[-1]), np.linalg.norm(by_dark[-1])))
    if not light[-1] > FAINT_SIGMAS * white_error:
        raise InputError(
            "white reads no light above black; look at what the screen shows, and expose longer"
        )
    response = grey_response(file).light[fit.codes[1:]]
    square_px = _square(file, read)
    expected = full_scale_e_per_s(file) * _evenness_in(file, square_px) * response
    relative = 1 / expected[:, None]
    common = fit.means(read.common)[1:]
    return LightDeviation(
        log_light=np.log(response),
        value=light / expected,
        factors=relative * by_light,
        dof=fit.light_dof,
        noise=fit.noise,
        dark_factors=relative * by_dark,
        dark_dof=fit.dark_dof,
        dark=float(fit.floor / light[-1]),
        lasting_factors=relative * by_lasting,
        lasting=structure,
        square_px=square_px,
        common_factors=relative * common,
        beside=read.beside,
    )


def _above_black(rows: FloatArray, codes: int) -> FloatArray:
    """What is of the lit codes (codes - 1, ...) above black, in what is of all numbers of the
    fit.
    """
    return np.asarray(rows[1:codes] - rows[0])


def _square(file: BenchFile, read: LightReadings) -> tuple[int, int, int]:
    """The square that was read: left, top, side, px; the pixel at the middle without one."""
    width, height = file.config.monitor.resolution_px
    return read.square_px or (width // 2, height // 2, 1)


def _evenness_in(file: BenchFile, square_px: tuple[int, int, int]) -> float:
    """The mean of the light that a bench file has in a square, relative to its map's scale."""
    size = file.config.monitor.resolution_px
    even = bench_calibration(file.config, file.folder).uniformity_map(size)
    if even is None:
        return 1.0
    first_x, first_y, side = square_px
    square = even[first_y : first_y + side, first_x : first_x + side]
    return float(square.mean())


class _LightFit:
    """A light for each code (size,) and a drift, fitted to readings by weighted least squares.

    Lit and dark readings are apart, so that their scatters are two estimates, and weights take
    nothing from their freedom. Raises InputError where there are too few of either.
    """

    def __init__(self, read: LightReadings) -> None:
        codes, place, count = np.unique(read.code, return_inverse=True, return_counts=True)
        hours = (read.t_s - read.t_s[0]) / 3600
        timed = float(np.ptp(hours)) > 0
        dof = len(read.code) - len(codes) - timed
        if len(codes) <= MIN_LEVELS or codes[0] != 0 or dof < MIN_DOF:
            raise InputError(
                f"{len(read.code)} readings of {len(codes)} codes; read black and"
                f" {MIN_LEVELS} codes or more, some of them again"
            )
        self.codes, self.size = codes, len(codes)
        self._place, self._count = place, count
        mean = np.bincount(place, read.light) / count
        self.design = np.zeros((len(read.code), len(codes) + timed))
        self.design[np.arange(len(read.code)), place] = 1.0
        self.when = np.arange(len(read.code), dtype=np.float64)
        if timed:
            self.design[:, -1] = hours * mean[place]
            self.when = np.asarray(hours, dtype=np.float64)
        self._shape_of_noise(read, np.maximum(mean[place] - mean[0], 0.0))
        self._fit(read.light, SMALL_FLOOR * float(mean[-1]))

    def _shape_of_noise(self, read: LightReadings, lit: FloatArray) -> None:
        """How the noise of readings goes with light, up to a factor, and which of them tell it."""
        self._dark = self._place == 0
        self._shape, self._bright = lit, lit > BRIGHT * lit.max()
        if read.noise is not None:
            # By light, and not by each reading's own: of two readings of a faint code that with
            # less light would count less, and their mean be too bright.
            relative = float(np.median(read.noise[self._bright] / lit[self._bright]))
            self._shape = np.where(self._dark, 0.0, read.noise / relative)
            # What a black image adds to a reading's noise is in it.
            self._bright = ~self._dark
        # A code whose readings average below black has no noise of light, only that of black.
        self._bright = self._bright & (self._shape > 0)

    def _fit(self, light: FloatArray, least: float) -> None:
        """Fit with weights by the scatters, which the fit tells: three rounds settle them. `least`
        is the smallest floor relative to the noise.
        """
        self.noise, self.floor = 1.0, 0.0
        for _ in range(3):
            floor = max(self.floor, least * self.noise)
            self.sigma = np.hypot(self.noise * self._shape, floor)
            weighted = self.design / self.sigma[:, None]
            self.inverse = np.linalg.pinv(weighted)
            self.solution = self.inverse @ (light / self.sigma)
            self.residual = light - self.design @ self.solution
            freedom = 1 - np.einsum("ij,ji->i", weighted, self.inverse)
            self.light_dof = float(freedom[self._bright].sum())
            self.dark_dof = float(freedom[self._dark].sum())
            relative = self.residual[self._bright] / self._shape[self._bright]
            self.noise = _scatter(relative, self.light_dof)
            self.floor = _scatter(self.residual[self._dark], self.dark_dof)
        if min(self.light_dof, self.dark_dof) < MIN_DOF / 2:
            raise InputError(
                "white and black are read too seldom to know their scatter; read both three times"
                " or more"
            )

    def by_light(self) -> FloatArray:
        """What noise relative to light does to the fit's numbers: factors (numbers, n)."""
        return np.asarray(self.inverse * (self.noise * self._shape / self.sigma))

    def by_dark(self) -> FloatArray:
        """What noise in the dark does to the fit's numbers: factors (numbers, n)."""
        return np.asarray(self.inverse * (self.floor / self.sigma))

    def means(self, causes: FloatArray | None) -> FloatArray:
        """The means (size, causes) over each code's readings of what they have in common."""
        if causes is None:
            return np.zeros((self.size, 0))
        sums = np.zeros((self.size, causes.shape[1]))
        np.add.at(sums, self._place, causes)
        return np.asarray(sums / self._count[:, None])


def _scatter(residual: FloatArray, dof: float) -> float:
    """The standard deviation of residuals with so much freedom."""
    return math.sqrt(float((residual**2).sum()) / max(dof, SMALL_FLOOR))


@dataclass(frozen=True, slots=True)
class Surface:
    """Polynomials over the screen: coefficients (terms, columns), factors (terms, terms) of each
    column, their freedom.
    """

    degree: int
    resolution_px: tuple[int, int]
    value: FloatArray
    factors: FloatArray
    dof: float
    noise: float

    def terms(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """The polynomials (n, terms) at pixels (n,)."""
        return field_terms(x_px, y_px, self.resolution_px, self.degree)

    def bowed(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """How far the first column's surface and its own map of MAP fields, linear between them,
        are apart at pixels (n,).
        """
        wide, high = self.resolution_px
        fields_along, fields_down = MAP
        x = (np.arange(fields_along) + 0.5) * wide / fields_along - 0.5
        y = (np.arange(fields_down) + 0.5) * high / fields_down - 0.5
        grid_x, grid_y = np.meshgrid(x, y)
        coefficients = self.value[:, 0]
        at_fields = self.terms(grid_x.ravel(), grid_y.ravel()) @ coefficients
        grid = at_fields.reshape(grid_x.shape)
        rows = weights_of_grid(high, fields_down)[np.rint(y_px).astype(np.intp)]
        columns = weights_of_grid(wide, fields_along)[np.rint(x_px).astype(np.intp)]
        linear = np.einsum("nr,rc,nc->n", rows, grid, columns)
        smooth = self.terms(x_px, y_px) @ coefficients
        return np.asarray(smooth - linear)


def surface(
    x_px: FloatArray,
    y_px: FloatArray,
    values: FloatArray,
    degrees: tuple[int, ...],
    resolution_px: tuple[int, int],
) -> Surface:
    """Fit a surface to values (n, columns) at pixels; wild ones do not count. Raises InputError
    for too few dots.
    """
    usable: BoolArray = np.asarray(np.isfinite(values).all(axis=1))
    best: Surface | None = None
    best_squares = 0.0
    for degree in degrees:
        count = (degree + 1) * (degree + 2) // 2
        if usable.sum() < DOTS_A_TERM * count:
            break
        terms = field_terms(x_px, y_px, resolution_px, degree)
        solution, root, usable = _fit_without_wild(terms, values, usable)
        dof = (int(usable.sum()) - count) * values.shape[1]
        squares = float(((values - terms @ solution)[usable] ** 2).sum())
        if best is not None and not _is_better(best_squares, best.dof, squares, dof):
            break
        noise = math.sqrt(squares / dof)
        best = Surface(degree, resolution_px, solution, noise * root, float(dof), noise)
        best_squares = squares
    if best is None:
        first = degrees[0]
        needed = DOTS_A_TERM * (first + 1) * (first + 2) // 2
        raise InputError(
            f"{int(usable.sum())} dots are seen and {needed} are needed; look at focus, exposure"
            " and [collimator]"
        )
    return best


def _fit_without_wild(
    terms: FloatArray, values: FloatArray, usable: BoolArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Coefficients (terms, columns) of values (n, columns), a root (terms, terms) of their
    covariance for noise of 1, and which values are not wild (n,).
    """
    for _ in range(3):
        q, r = np.linalg.qr(terms[usable])
        solution = np.linalg.solve(r, q.T @ values[usable])
        residual = np.abs(values - terms @ solution)
        spread = MAD_TO_SIGMA * np.median(residual[usable], axis=0)
        tame = (residual < WILD_SIGMAS * np.maximum(spread, SMALL_SPREAD)).all(axis=1)
        within = usable & tame
        if within.sum() == usable.sum():
            break
        usable = within
    # r'r is the normal matrix, so its inverse's root is that of r.
    return solution, np.linalg.inv(r), usable


def _is_better(squares: float, dof: float, finer_squares: float, finer_dof: float) -> bool:
    """Whether a finer fit, with less freedom, is better than another by an F test."""
    more = dof - finer_dof
    if more <= 0:
        return False
    gain = max(squares - finer_squares, 0.0) / more
    return bool(
        fdtrc(more, finer_dof, gain / max(finer_squares / finer_dof, SMALL_SQUARE)) <= BETTER_P
    )


def place_errors(file: BenchFile, read: DotReadings) -> FloatArray:
    """Where each dot is seen less where the bench file shows it (n, 2), arcsec along the image's
    x and y.
    """
    geometry = geometry_of(file)
    seen = geometry.tracker.rays(read.seen_x_px, read.seen_y_px)
    shown = geometry.monitor.rays(read.x_px, read.y_px)
    seen_tangents = seen[:, :2] / seen[:, 2:]
    shown_tangents = shown[:, :2] / shown[:, 2:]
    return np.asarray((seen_tangents - shown_tangents) * ARCSEC_PER_RAD)


def evenness(file: BenchFile, read: DotReadings) -> "Evenness":
    """log(light of dots / expected) over the screen; only its differences mean anything. Raises
    InputError.
    """
    size = file.config.monitor.resolution_px
    known = bench_calibration(file.config, file.folder).uniformity_map(size)
    expected = np.ones(len(read.x_px))
    if known is not None:
        row = np.rint(read.y_px).astype(np.intp)
        column = np.rint(read.x_px).astype(np.intp)
        expected = known[row, column].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.log(read.light / expected)
    fit = surface(read.x_px, read.y_px, off[:, None], EVEN_DEGREES, size)
    fitted = fit.terms(read.x_px, read.y_px) @ fit.value[:, 0]
    residual = off - fitted
    usable = np.isfinite(residual)
    spread = MAD_TO_SIGMA * float(np.median(np.abs(residual[usable])))
    usable &= np.abs(residual) <= WILD_SIGMAS * max(spread, SMALL_SPREAD)
    x = read.x_px[usable]
    y = read.y_px[usable]
    terms = fit.terms(x, y)
    structure = in_place(x, y, residual[None, usable], terms[None])
    return Evenness(fit, Cells(x, y), np.asarray(np.linalg.pinv(terms)), structure)


@dataclass(frozen=True, slots=True)
class Evenness:
    """The light over the screen: its surface, and what structure the dots have about it, which
    is the screen's own.
    """

    fit: Surface
    cells: Cells
    solve: FloatArray
    structure: Structure

    def scatter(self, x_px: FloatArray, y_px: FloatArray, shares: FloatArray) -> FloatArray:
        """What the structure adds to sums of log light: factors (k, sums) at pixels (n,), whose
        shares are (sums, n).
        """
        terms = self.fit.terms(x_px, y_px)
        by_cell = self.cells.means(self.solve.T) * self.cells.count[:, None]
        weights = shares @ terms @ by_cell.T
        covariance = np.zeros((len(shares), len(shares)))
        right_px = x_px[:, None] - x_px
        down_px = y_px[:, None] - y_px
        apart = right_px**2 + down_px**2
        for length, variance in self.structure.parts():
            eigen, rows, columns = self.cells.basis(length)
            turned = self.cells.turned(rows, columns, weights.T)
            crossed = shares @ self.cells.towards(x_px, y_px, length) @ weights.T
            correlation = np.exp(-apart / (2 * length**2))
            at_stars = shares @ correlation @ shares.T
            of_fit = (turned.T * eigen) @ turned
            covariance += variance * (at_stars - crossed - crossed.T + of_fit)
        return smooth_root(covariance)
