"""From measured patches to a response: a penalised spline of log light, with the black level as a parameter.

The model of a patch is `black + base(s) exp(g(v(s)))`, with s = code / white. Residuals are relative to the noise of each
level's mean, so a faint level counts as much as a bright one. `g` is a cubic spline, in one of three shapes:

    power   base s^2.2    g over log s, penalty on g''            a power law is left alone by the penalty
    srgb    base sRGB     g over log s, penalty on g''            so is sRGB with its linear toe, to a power
    smooth  base s^2.2    g over s plus a log s, penalty on g'''  S-curves of liquid crystals: analytic in s

The stiffness of the penalty and the shape are those of the maximum marginal likelihood (with weak normal priors on the
coefficients); the noise comes from the repeats. Black is a parameter with the repeats of code 0 as its prior.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import minimize_scalar

from hilstar.arrays import FloatArray
from hilstar.calibrate.measurements import NOISE_FLOOR, Levels, Measurements, check_levels, group_levels
from hilstar.errors import InputError
from hilstar.monitor.response import srgb_light

Curve = Callable[[FloatArray], FloatArray]

MIN_KNOTS, MAX_KNOTS = 8, 48
PRIOR_SIGMA = 1.0  # of the spline's coefficients: e-fold away from the base
PRIOR_SLOPE_SIGMA = 0.5  # of the exponent, for the shape that has it separately
LOG_STIFFNESS = np.arange(-26.0, 15.0, 2.0)
MAX_STEPS = 20
SETTLED = 1e-6  # of log light
STIFFNESS_STEPS = 8  # in each of the first ones the stiffness is chosen anew
ASSUMED_NOISE = 0.01  # where nothing was repeated, until the residuals tell
BLACK_FLOOR = 1e-6  # of white: how well a black level of zero is known
MIN_RISE = 1e-6  # relative, between neighbouring codes: see `strictly_rising`
MIN_LIGHT = 1e-9  # of white, at code 1
MIN_STEP = 1e-12  # of white: it survives a black level a thousand times as bright as white, in float64


@dataclass(frozen=True, slots=True)
class Shape:
    """The base that the spline corrects, its coordinate, and the order of the derivative that is penalised."""

    name: str
    base: Curve
    coordinate: Curve
    order: int
    log_term: bool


def _power(signal: FloatArray) -> FloatArray:
    return np.asarray(signal**2.2, dtype=np.float64)


def _signal(signal: FloatArray) -> FloatArray:
    return signal


SHAPES = (
    Shape("power", _power, np.log, 2, False),
    Shape("srgb", srgb_light, np.log, 2, False),
    Shape("smooth", _power, _signal, 3, True),
)


@dataclass(frozen=True, slots=True)
class ChannelFit:
    """The response of one channel, and how well it is known.

    `light` (2^bits,) is above black, 0 to 1 at white, strictly rising; `white` and `black` are in the unit of measurement
    (`white` above black). `error` (2^bits,) is the relative standard error of `light`. `residual` (levels - 1,) is what
    each level but code 0 has left of its light above black when the response is fitted without it, relative.
    """

    light: FloatArray
    white: float
    black: float
    error: FloatArray
    levels: Levels
    residual: FloatArray
    noise_relative: float
    shape: str
    parameters: float


@dataclass(frozen=True, slots=True)
class _Problem:
    """One shape's matrices: spline values at the levels and at all codes, penalty, prior; light in units of white."""

    at_levels: FloatArray
    at_codes: FloatArray
    log_base_levels: FloatArray
    log_base_codes: FloatArray
    penalty: FloatArray
    prior: FloatArray
    light: FloatArray
    sigma: FloatArray
    black: float
    black_sigma: float


@dataclass(frozen=True, slots=True)
class _Solution:
    problem: _Problem
    shape: Shape
    theta: FloatArray
    black: float
    minus_log_evidence: float  # twice
    covariance: FloatArray  # of theta and of black in units of its sigma
    design: FloatArray  # (levels - 1, parameters), rows in units of sigma
    misfit: FloatArray  # (levels - 1,), in units of sigma
    above: FloatArray  # (levels - 1,) light above black

    @property
    def parameters(self) -> float:
        """The effective number of parameters, given the penalty."""
        return float(np.einsum("ij,jk,ik->", self.design, self.covariance, self.design))


def fit_channel(measured: Measurements, channel: str) -> ChannelFit:
    """The response of one channel. Raises InputError for data that no response can be fitted to (`check_levels`)."""
    levels = group_levels(measured, channel)
    check_levels(measured, channel, levels)
    try:
        return fit_levels(levels, measured.white)
    except np.linalg.LinAlgError as error:
        raise InputError(f"{measured.source}: channel {channel}: no smooth response fits these values; check them") from error


def fit_levels(levels: Levels, white: int) -> ChannelFit:
    """The response to levels that have passed `check_levels`, for codes 0 to `white`."""
    noise = levels.relative_noise
    if math.isnan(noise):
        first = _best_solution(levels, white, ASSUMED_NOISE)
        left = max(len(first.misfit) - first.parameters, 1.0)
        noise = max(ASSUMED_NOISE * math.sqrt(float(first.misfit @ first.misfit) / left), NOISE_FLOOR)
    best = _best_solution(levels, white, noise)
    problem, scale = best.problem, float(levels.mean[-1] - levels.mean[0])
    above = np.exp(problem.log_base_codes + problem.at_codes @ best.theta)
    from_white = problem.at_codes - problem.at_codes[-1]
    covariance = best.covariance[:-1, :-1]
    error = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", from_white, covariance, from_white), 0.0))
    leverage = np.einsum("ij,jk,ik->i", best.design, best.covariance, best.design)
    return ChannelFit(
        light=strictly_rising(np.append(0.0, above / above[-1])),
        white=float(above[-1]) * scale,
        black=best.black * scale,
        error=np.append(0.0, error),
        levels=levels,
        residual=best.misfit / np.maximum(1 - leverage, 1e-6) * problem.sigma / best.above,
        noise_relative=noise,
        shape=best.shape.name,
        parameters=best.parameters,
    )


def strictly_rising(light: FloatArray) -> FloatArray:
    """`light` (n,), 0 to 1, with each code at least 1e-6 above the one before it (and code 1 at 1e-9 of white), 1 at white.

    A response that is flat at its dark end, as that of a link in limited range, has equal codes there.
    """
    rising = light.copy()
    for code in range(1, len(rising)):
        rising[code] = max(rising[code], rising[code - 1] * (1 + MIN_RISE) + MIN_STEP, MIN_LIGHT)
    return np.asarray(rising / rising[-1])


def _best_solution(levels: Levels, white: int, noise: float) -> _Solution:
    return min((_solve(shape, _problem(shape, levels, white, noise)) for shape in SHAPES), key=lambda s: s.minus_log_evidence)


def _problem(shape: Shape, levels: Levels, white: int, noise: float) -> _Problem:
    codes = np.arange(1, white + 1) / white
    at = levels.code[1:] / white
    low, high = shape.coordinate(codes[[0, -1]])
    knots = np.linspace(0, 1, int(np.clip(len(at) // 2, MIN_KNOTS, MAX_KNOTS)))

    def columns(signal: FloatArray) -> FloatArray:
        spline = _spline((shape.coordinate(signal) - low) / (high - low), knots)
        return np.hstack([spline, np.log(signal)[:, None]]) if shape.log_term else spline

    fine = (np.arange(400) + 0.5) / 400
    roughness = _spline(fine, knots, shape.order)
    penalty = roughness.T @ roughness / len(fine)
    prior = np.eye(len(penalty)) / PRIOR_SIGMA**2
    if shape.log_term:
        penalty, prior = np.pad(penalty, (0, 1)), np.pad(prior, (0, 1))
        prior[-1, -1] = 1 / PRIOR_SLOPE_SIGMA**2
    scale = levels.mean[-1] - levels.mean[0]
    sigma = np.hypot(levels.standard_error(noise) / scale, BLACK_FLOOR)
    return _Problem(
        at_levels=columns(at),
        at_codes=columns(codes),
        log_base_levels=np.log(shape.base(at)),
        log_base_codes=np.log(shape.base(codes)),
        penalty=penalty,
        prior=prior,
        light=levels.mean[1:] / scale,
        sigma=sigma[1:],
        black=float(levels.mean[0] / scale),
        black_sigma=float(sigma[0]),
    )


def _spline(place: FloatArray, knots: FloatArray, derivative: int = 0) -> FloatArray:
    """Cubic B-splines (places, knots + 2) over 0 to 1, or a derivative of them."""
    padded = np.concatenate([np.zeros(3), knots, np.ones(3)])
    return np.asarray(BSpline(padded, np.eye(len(knots) + 2), 3)(np.clip(place, 0, 1), nu=derivative))


def _solve(shape: Shape, problem: _Problem) -> _Solution:
    """Gauss-Newton; the stiffness of the largest evidence in each of the first steps."""
    black, stiffness = problem.black, math.nan
    theta = _start(problem)
    for step in range(MAX_STEPS):
        above = np.exp(np.clip(problem.log_base_levels + problem.at_levels @ theta, -60, 10))
        misfit = (problem.light - black - above) / problem.sigma
        slope = problem.at_levels * (above / problem.sigma)[:, None]
        design = np.hstack([slope, (problem.black_sigma / problem.sigma)[:, None]])
        shift = (black - problem.black) / problem.black_sigma
        target = misfit + design @ np.append(theta, shift)
        if step < STIFFNESS_STEPS:
            stiffness = _stiffest(problem, design, target, stiffness)
        evidence, precision = _evidence(problem, design, target, stiffness)
        covariance = np.linalg.inv(precision)
        new = covariance @ (design.T @ target)
        moved = float(np.abs(problem.at_levels @ (new[:-1] - theta)).max())
        theta, black = new[:-1], max(problem.black + new[-1] * problem.black_sigma, 0.0)
        if moved < SETTLED and step >= 2:
            break
    return _Solution(problem, shape, theta, black, evidence, np.asarray(covariance), design, misfit, above)


def _start(problem: _Problem) -> FloatArray:
    above = np.maximum(problem.light - problem.black, 0.05 * np.maximum(problem.light, BLACK_FLOOR))
    normal = problem.at_levels.T @ problem.at_levels + 1e-6 * (problem.prior + problem.penalty)
    return np.asarray(np.linalg.solve(normal, problem.at_levels.T @ (np.log(above) - problem.log_base_levels)))


def _evidence(problem: _Problem, design: FloatArray, target: FloatArray, stiffness: float) -> tuple[float, FloatArray]:
    """Minus twice the log marginal likelihood of the linearised problem (up to a constant), and the posterior's precision."""
    prior = math.exp(stiffness) * problem.penalty + problem.prior
    precision = design.T @ design
    precision[:-1, :-1] += prior
    precision[-1, -1] += 1.0
    root = np.linalg.cholesky(precision)
    explained = np.linalg.solve(root, design.T @ target)
    determinants = 2 * np.log(np.diag(root)).sum() - np.linalg.slogdet(prior)[1]
    return float(target @ target - explained @ explained + determinants), precision


def _stiffest(problem: _Problem, design: FloatArray, target: FloatArray, before: float) -> float:
    def evidence(stiffness: float) -> float:
        return _evidence(problem, design, target, stiffness)[0]

    grid = LOG_STIFFNESS if math.isnan(before) else before + np.array([-1.0, 0.0, 1.0])
    best = int(np.argmin([evidence(value) for value in grid]))
    bounds = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    found = minimize_scalar(evidence, bounds=bounds, method="bounded", options={"xatol": 0.02})
    return float(np.clip(found.x, LOG_STIFFNESS[0], LOG_STIFFNESS[-1]))
