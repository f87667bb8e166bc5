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

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import ARCSEC_PER_RAD, MAD_TO_SIGMA
from hilstar.display.calibration import weights_of_grid
from hilstar.instruments.certify.readings import (
    DotReadings,
    LightReadings,
    geometry_of,
    grey_response,
    white_of,
)
from hilstar.instruments.certify.structure import Cells, Structure, in_place, in_time, lasting_root
from hilstar.optics.camera import field_terms
from hilstar.server.bench.bench_file import BenchFile
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

    def weights(self, log_light: FloatArray) -> FloatArray:
        """What each code's value adds to the deviation at lights (n,): (n, k). Beyond the codes
        read it is held.
        """
        spline = CubicSpline(self.log_light, np.eye(len(self.log_light)), bc_type="natural")
        return np.asarray(spline(np.clip(log_light, self.log_light[0], self.log_light[-1])))

    def bent(self, log_light: FloatArray) -> FloatArray:
        """By how much the spline is above straight lines from code to code, at lights (n,)."""
        return np.asarray(
            self.weights(log_light) @ self.value - np.interp(log_light, self.log_light, self.value)
        )

    def rough(self, log_light: FloatArray) -> FloatArray:
        """How far single codes may be from the spline through those read, at lights (n,), one
        sigma; 0 where nothing tells it.

        Each code read is foretold by the others. Where they are further off than noise explains (F,
        one in a thousand), that of the codes around a light holds for those between them that were
        not read.
        """
        count = len(self.value)
        gaps = np.eye(count)
        for k in range(1, count - 1):
            others = np.arange(count) != k
            spline = CubicSpline(self.log_light[others], np.eye(count - 1), bc_type="natural")
            gaps[k, others] = -spline(self.log_light[k])
        step = np.diff(self.log_light)
        inner = np.flatnonzero((step[1:] < MAX_ROUGH_STEP) & (step[:-1] < MAX_ROUGH_STEP)) + 1
        if len(inner) < MIN_ROUGH_CODES:
            return np.zeros(len(log_light))
        own_factors = np.concatenate(
            [self.factors, self.dark_factors, self.lasting_factors], axis=1
        )
        noise = ((gaps @ own_factors) ** 2).sum(axis=1)[inner]
        off = (gaps @ self.value)[inner] ** 2
        if fdtrc(len(inner), self.dof, float((off / noise).mean())) > ROUGH_P:
            return np.zeros(len(log_light))
        excess = (off - noise) / (gaps[inner] ** 2).sum(axis=1)
        window = np.ones(ROUGH_CODES)
        around = np.convolve(excess, window, mode="same") / np.convolve(
            np.ones(len(excess)), window, mode="same"
        )
        local = np.interp(log_light, self.log_light[inner], np.maximum(around, 0.0))
        between = 1 + (self.weights(log_light) ** 2).sum(axis=1)
        read = (np.abs(log_light[:, None] - self.log_light) < SAME_LIGHT).any(axis=1)
        return np.asarray(np.where(read, 0.0, np.sqrt(local * between)))


def light_deviation(file: BenchFile, read: LightReadings) -> LightDeviation:
    """The deviation of a bench's light by readings. Raises InputError where they are too few, or
    have no light.

    A reading is the light of its code and of black, times a drift; its noise goes with all light
    that it sees, and has a floor where a black screen scatters by more than that.
    """
    codes, place, count = np.unique(read.code, return_inverse=True, return_counts=True)
    hours = (read.t_s - read.t_s[0]) / 3600
    timed = float(np.ptp(hours)) > 0
    dof = len(read.code) - len(codes) - timed
    if len(codes) <= MIN_LEVELS or codes[0] != 0 or dof < MIN_DOF:
        raise InputError(
            f"{len(read.code)} readings of {len(codes)} codes; read black and {MIN_LEVELS} codes or"
            " more, some of them again"
        )
    mean = np.bincount(place, read.light) / count
    design = np.zeros((len(read.code), len(codes) + timed))
    design[np.arange(len(read.code)), place] = 1.0
    if timed:
        design[:, -1] = hours * mean[place]
    # Light and dark share no readings, so that their scatters are two estimates, and weights take
    # nothing from their freedom.
    lit = np.maximum(mean[place] - mean[0], 0.0)
    bright, dark = lit > BRIGHT * lit.max(), place == 0
    by_shape = lit
    if read.noise is not None:
        # By light, and not by each reading's own: of two readings of a faint code that with less
        # light would count less, and their mean be too bright.
        relative = float(np.median(read.noise[bright] / lit[bright]))
        by_shape = np.where(dark, 0.0, read.noise / relative)
        # What a black image adds to a reading's noise is in it.
        bright = ~dark
    # A code whose readings average below black has no noise of light, only that of black.
    bright &= by_shape > 0
    noise, floor = 1.0, 0.0
    for _ in range(3):
        sigma = np.hypot(noise * by_shape, max(floor, 1e-9 * mean[-1] * noise))
        inverse = np.linalg.pinv(design / sigma[:, None])
        residual = read.light - design @ (solution := inverse @ (read.light / sigma))
        freedom = 1 - np.einsum("ij,ji->i", design / sigma[:, None], inverse)
        noise = math.sqrt(
            float(((residual / np.maximum(by_shape, 1e-300))[bright] ** 2).sum())
            / max(float(freedom[bright].sum()), 1e-9)
        )
        floor = math.sqrt(
            float((residual[dark] ** 2).sum()) / max(float(freedom[dark].sum()), 1e-9)
        )
    if freedom[bright].sum() < MIN_DOF / 2 or freedom[dark].sum() < MIN_DOF / 2:
        raise InputError(
            "white and black are read too seldom to know their scatter; read both three times or"
            " more"
        )
    by_light, by_dark = (
        inverse * part / sigma for part in (noise * by_shape, np.full(len(lit), floor))
    )
    when = np.asarray(hours if timed else np.arange(len(read.code)), dtype=np.float64)
    lasting = in_time(when, residual / sigma, design / sigma[:, None])
    # What is correlated is no noise of a reading by itself.
    alone = math.sqrt(lasting.noise_variance) if lasting.total else 1.0
    by_light, by_dark = alone * by_light, alone * by_dark
    lasts = inverse @ lasting_root(when, lasting)
    light, size = solution[1 : len(codes)] - solution[0], len(codes)
    lost = math.hypot(
        *(
            float(np.linalg.norm(factor_rows[size - 1] - factor_rows[0]))
            for factor_rows in (by_light, by_dark)
        )
    )
    if not light[-1] > FAINT_SIGMAS * lost:
        raise InputError(
            "white reads no light above black; look at what the screen shows, and expose longer"
        )
    grey, (width, height) = grey_response(file), file.config.monitor.resolution_px
    even = bench_calibration(file.config, file.folder).uniformity_map((width, height))
    square = read.square_px or (width // 2, height // 2, 1)
    left_px, top_px, side = square
    here = (
        1.0
        if even is None
        else float(even[top_px : top_px + side, left_px : left_px + side].mean())
    )
    common = np.zeros((len(codes), 0))
    if read.common is not None:
        common = np.stack(
            [np.bincount(place, factor_rows) / count for factor_rows in read.common.T], axis=1
        )
    expected = white_of(file) * here * grey.light[codes[1:]]
    return LightDeviation(
        log_light=np.log(grey.light[codes[1:]]),
        value=light / expected,
        factors=(by_light[1:size] - by_light[0]) / expected[:, None],
        dof=float(freedom[bright].sum()),
        noise=noise,
        dark_factors=(by_dark[1:size] - by_dark[0]) / expected[:, None],
        dark_dof=float(freedom[dark].sum()),
        dark=float(floor / light[-1]),
        lasting_factors=(lasts[1:size] - lasts[0]) / expected[:, None],
        lasting=lasting,
        square_px=square,
        common_factors=common[1:] * (light / expected)[:, None],
    )


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
        x, y = (
            (np.arange(n) + 0.5) * side / n - 0.5
            for n, side in zip(MAP, self.resolution_px, strict=True)
        )
        grid = (
            self.terms(*(part.ravel() for part in np.meshgrid(x, y))) @ self.value[:, 0]
        ).reshape(MAP[::-1])
        rows, columns = (
            weights_of_grid(side, n) for side, n in zip((high, wide), MAP[::-1], strict=True)
        )
        at = np.rint(y_px).astype(np.intp), np.rint(x_px).astype(np.intp)
        return np.asarray(
            self.terms(x_px, y_px) @ self.value[:, 0]
            - np.einsum("nr,rc,nc->n", rows[at[0]], grid, columns[at[1]])
        )


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
    kept = np.isfinite(values).all(axis=1)
    best: Surface | None = None
    best_squares = 0.0
    for degree in degrees:
        count = (degree + 1) * (degree + 2) // 2
        if kept.sum() < DOTS_A_TERM * count:
            break
        for _ in range(3):
            terms = field_terms(x_px, y_px, resolution_px, degree)
            q, r = np.linalg.qr(terms[kept])
            solution = np.linalg.solve(r, q.T @ values[kept])
            residual = np.abs(values - terms @ solution)
            spread = MAD_TO_SIGMA * np.median(residual[kept], axis=0)
            within = kept & (residual < WILD_SIGMAS * np.maximum(spread, 1e-12)).all(axis=1)
            if within.sum() == kept.sum():
                break
            kept = within
        dof = (int(kept.sum()) - count) * values.shape[1]
        squares = float((residual[kept] ** 2).sum())
        if best is not None:
            more = best.dof - dof
            if (
                more <= 0
                or fdtrc(
                    more, dof, max(best_squares - squares, 0.0) / more / max(squares / dof, 1e-30)
                )
                > BETTER_P
            ):
                break
        noise = math.sqrt(squares / dof)
        # r'r is the normal matrix, so its inverse's root is that of r.
        best = Surface(degree, resolution_px, solution, noise * np.linalg.inv(r), float(dof), noise)
        best_squares = squares
    if best is None:
        needed = DOTS_A_TERM * (degrees[0] + 1) * (degrees[0] + 2) // 2
        raise InputError(
            f"{int(kept.sum())} dots are seen and {needed} are needed; look at focus, exposure and"
            " [collimator]"
        )
    return best


def place_errors(file: BenchFile, read: DotReadings) -> FloatArray:
    """Where each dot is seen less where the bench file shows it (n, 2), arcsec along the image's
    x and y.
    """
    geometry = geometry_of(file)
    seen_rays = geometry.tracker.rays(read.seen_x_px, read.seen_y_px)
    shown = geometry.monitor.rays(read.x_px, read.y_px)
    return np.asarray(
        (seen_rays[:, :2] / seen_rays[:, 2:] - shown[:, :2] / shown[:, 2:]) * ARCSEC_PER_RAD
    )


def evenness(file: BenchFile, read: DotReadings) -> "Evenness":
    """log(light of dots / expected) over the screen; only its differences mean anything. Raises
    InputError.
    """
    size = file.config.monitor.resolution_px
    known = bench_calibration(file.config, file.folder).uniformity_map(size)
    at = np.rint(read.y_px).astype(np.intp), np.rint(read.x_px).astype(np.intp)
    if known is None:
        expected = np.ones(len(read.x_px))
    else:
        expected = known[at].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.log(read.light / expected)
    fit = surface(read.x_px, read.y_px, off[:, None], EVEN_DEGREES, size)
    residual = off - (fit.terms(read.x_px, read.y_px) @ fit.value)[:, 0]
    is_kept = np.isfinite(residual)
    is_kept &= np.abs(residual) <= WILD_SIGMAS * max(
        MAD_TO_SIGMA * float(np.median(np.abs(residual[is_kept]))), 1e-12
    )
    x = read.x_px[is_kept]
    y = read.y_px[is_kept]
    terms = fit.terms(x, y)
    structure = in_place(x, y, residual[None, is_kept], terms[None])
    return Evenness(fit, Cells(x, y), np.asarray(np.linalg.pinv(terms)), structure)


@dataclass(frozen=True, slots=True)
class Evenness:
    """The light over the screen: its surface, and what structure the dots have about it, which
    is the screen's own.
    """

    fit: Surface
    cells: Cells
    solve: FloatArray
    found: Structure

    def scatter(self, x_px: FloatArray, y_px: FloatArray, shares: FloatArray) -> FloatArray:
        """What the structure adds to sums of log light: factors (k, sums) at pixels (n,), whose
        shares are (sums, n).
        """
        terms = self.fit.terms(x_px, y_px)
        by_cell = self.cells.means(self.solve.T) * self.cells.count[:, None]
        weights = shares @ terms @ by_cell.T
        covariance = np.zeros((len(shares), len(shares)))
        apart = (x_px[:, None] - x_px) ** 2 + (y_px[:, None] - y_px) ** 2
        for length, variance in zip(self.found.length, self.found.variance, strict=True):
            if not variance:
                continue
            eigen, rows, columns = self.cells.basis(length)
            turned = self.cells.turned(rows, columns, weights.T)
            crossed = shares @ self.cells.towards(x_px, y_px, length) @ weights.T
            own_covariance = shares @ np.exp(-apart / (2 * length**2)) @ shares.T
            covariance += variance * (
                own_covariance - crossed - crossed.T + (turned.T * eigen) @ turned
            )
        size, vectors = np.linalg.eigh(covariance)
        return np.asarray((vectors * np.sqrt(np.maximum(size, 0.0))).T)
