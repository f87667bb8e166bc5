"""From measured patches to a response: a penalised spline of log light, with the black level as a
parameter.

The model of a patch is `black + base(s) exp(g(v(s)))`, with s = code / white. Residuals are
relative to the noise of each level's mean, so a faint level counts as much as a bright one. `g` is
a cubic spline, in one of three shapes:

    power   base s^2.2    g over log s, penalty on g''            a power law is left alone by the
                                                                  penalty
    srgb    base sRGB     g over log s, penalty on g''            so is sRGB with its linear toe, to
                                                                  a power
    smooth  base s^2.2    g over s plus a log s, penalty on g'''  S-curves of liquid crystals:
                                                                  analytic in s

The stiffness of the penalty and the shape are those of the maximum marginal likelihood (with weak
normal priors on the coefficients). The noise is that stated with the readings, and what the repeats
scatter beyond it. Black is a parameter with the repeats of code 0 as its prior. So is each cause of
errors that readings have in common, in units of its standard error.

Where the levels are further from the fit than their noise explains, the errors grow by the root of
chi-square over its freedom (Birge, Phys. Rev. 40 (1932) 207).
"""

import datetime
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import minimize_scalar

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, GREEN, INK, MUTED, RED, chart, label_ends
from hilstar.basics.errors import InputError
from hilstar.basics.units import MAG_PER_RELATIVE
from hilstar.display.calibration import (
    CalibrationHead,
    ErrorsTable,
    NotesTable,
    load_calibration,
    write_calibration,
)
from hilstar.display.identity import MonitorIdentity
from hilstar.display.response import srgb_light
from hilstar.instruments.calibrate import measurements

Curve = Callable[[FloatArray], FloatArray]

MIN_KNOTS, MAX_KNOTS = 8, 48
PRIOR_SIGMA = 1.0  # sigma of the spline's coefficients: one e-fold away from the base
PRIOR_SLOPE_SIGMA = 0.5  # sigma of the exponent, for the shape that has it separately
LOG_STIFFNESS = np.arange(-26.0, 15.0, 2.0)
MAX_STEPS = 20
SETTLED = 1e-6  # change of log light
STIFFNESS_STEPS = 8  # the stiffness is chosen anew in each of the first steps
# relative to white: how well a black level of zero is known, where its readings state no error
BLACK_FLOOR = 1e-6
STATED_FLOOR = 1e-9  # where they do, which may be none
MIN_RISE = 1e-6  # relative, between neighbouring codes: see `strictly_rising`
MIN_LIGHT = 1e-9  # relative to white, at code 1
# relative to white: in float64 it survives a black level a thousand times as bright
MIN_STEP = 1e-12
DECADES = (0, 1, 2, 3)  # below white, where the error of the response is stated
NOT_STATED = "not stated"
MIN_DRAWN_LIGHT = 1e-5  # relative to white, as drawn
COLOURS = {"w": INK, "r": RED, "g": GREEN, "b": BLUE}
NAMES = {"w": "white", "r": "red", "g": "green", "b": "blue"}


@dataclass(frozen=True, slots=True)
class Shape:
    """The base that the spline corrects, its coordinate, and the order of the penalised
    derivative.
    """

    name: str
    base: Curve
    coordinate: Curve
    order: int
    log_term: bool


SHAPES = (
    Shape("power", lambda signal: signal**2.2, np.log, 2, False),
    Shape("srgb", srgb_light, np.log, 2, False),
    Shape("smooth", lambda signal: signal**2.2, lambda signal: signal, 3, True),
)


@dataclass(frozen=True, slots=True)
class ChannelFit:
    """The response of one channel and its errors.

    `light` (2^bits,) is above black, 0 to 1 at white, strictly rising; `white` (above black) and
    `black` are in the unit of measurement, `black_error` the standard error of `black` beside
    white. `error` (2^bits,) is the relative standard error of `light`.

    Of each level but code 0 (levels - 1,): `residual` is its relative error in a fit without it,
    `residual_error` that residual's standard error; `level_off` is its light, corrected for common
    causes, over the fit's, less 1, and `level_error` its relative standard error. `lack_of_fit` is
    the factor by which the errors were raised, 1 for none.
    """

    light: FloatArray
    white: float
    black: float
    error: FloatArray
    levels: measurements.MeasuredLevels
    residual: FloatArray
    noise_relative: float
    shape: str
    parameters: float
    black_error: float
    residual_error: FloatArray
    level_off: FloatArray
    level_error: FloatArray
    lack_of_fit: float


@dataclass(frozen=True, slots=True)
class _Problem:
    """One shape's matrices: spline values at the levels and at all codes, penalty, prior; light
    in units of white.
    """

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
    common: FloatArray  # (levels - 1, causes), beside what each does to code 0


@dataclass(frozen=True, slots=True)
class _Solution:
    problem: _Problem
    shape: Shape
    theta: FloatArray
    causes: FloatArray
    black: float
    minus_log_evidence: float  # twice
    covariance: FloatArray  # for theta, for the common causes, and for black in units of its sigma
    design: FloatArray  # (levels - 1, parameters), rows in units of sigma
    misfit: FloatArray  # (levels - 1,), in units of sigma
    above: FloatArray  # (levels - 1,) light above black
    has_settled: bool

    @property
    def parameters(self) -> float:
        return float(_variances(self.design, self.covariance).sum())

    @property
    def lack_of_fit(self) -> float:
        """The misfit relative to what the noise explains, where that is less."""
        return math.sqrt(max(self.square_per_freedom, 1.0))

    @property
    def square_per_freedom(self) -> float:
        """Chi-square over its freedom."""
        freedom = max(len(self.misfit) - self.parameters, 1.0)
        return float(self.misfit @ self.misfit) / freedom


def fit_channel(measured: measurements.Measurements, channel: str) -> ChannelFit:
    """The response of one channel. Raises InputError for data that no response can be fitted to
    (`check_levels`).
    """
    levels = measurements.group_levels(measured, channel)
    measurements.check_levels(measured, channel, levels)
    try:
        return fit_levels(levels, measured.white)
    except np.linalg.LinAlgError as error:
        raise InputError(
            f"{measured.source}: channel {channel}: no smooth response fits these values; check"
            " them"
        ) from error


def fit_levels(levels: measurements.MeasuredLevels, white: int) -> ChannelFit:
    """The response to levels that have passed `check_levels`, for codes 0 to `white`."""
    noise = levels.relative_noise
    if math.isnan(noise):
        noise = 0.0
        if not levels.has_errors:
            noise = _residual_noise(levels, white)
    best = _best_solution(levels, white, noise)
    problem = best.problem
    scale = float(levels.mean[-1] - levels.mean[0])
    count = len(best.theta)
    shape_covariance = best.covariance[:count, :count]
    log_above = problem.log_base_codes + problem.at_codes @ best.theta
    above = np.exp(log_above)
    white_light = float(above[-1])
    light = strictly_rising(np.append(0.0, above / above[-1]))
    # relative to white, which is 1 whatever the parameters are
    from_white = problem.at_codes - problem.at_codes[-1]
    variance = _variances(from_white, shape_covariance)
    error = np.sqrt(np.maximum(variance, 0.0))
    lack = best.lack_of_fit
    level_off, level_error = _levels_about(best, white_light * light[levels.code[1:]])
    # a residual without its own level is larger by the share that the level has in the fit
    leverage = _variances(best.design, best.covariance)
    held_out_share = np.maximum(1 - leverage, 1e-6)
    level_sigma = problem.sigma / best.above
    held_out_residual = best.misfit / held_out_share * problem.sigma / best.above
    return ChannelFit(
        light=light,
        white=white_light * scale,
        black=best.black * scale,
        error=np.append(0.0, lack * error),
        levels=levels,
        residual=held_out_residual,
        noise_relative=noise,
        shape=best.shape.name,
        parameters=best.parameters,
        black_error=_black_error(best, levels, scale),
        residual_error=level_sigma / np.sqrt(held_out_share),
        level_off=level_off,
        level_error=lack * level_error,
        lack_of_fit=lack,
    )


def _black_error(best: "_Solution", levels: measurements.MeasuredLevels, scale: float) -> float:
    """The standard error of the black level, in the unit of measurement: its own, that of common
    causes, and that of white, relative to which it is stated.
    """
    problem = best.problem
    black_variance = float(best.covariance[-1, -1])
    own_error = scale * problem.black_sigma * math.sqrt(black_variance)
    common_error = float(np.linalg.norm(levels.common[0]))
    count = len(best.theta)
    shape_covariance = best.covariance[:count, :count]
    white_variance = _variances(problem.at_codes[-1:], shape_covariance)[0]
    white_error = math.sqrt(max(white_variance, 0.0))
    return math.hypot(own_error, common_error, best.black * scale * white_error)


def _residual_noise(levels: measurements.MeasuredLevels, white: int) -> float:
    """The relative noise of a reading where nothing was repeated: by the residuals of a first
    fit.
    """
    first = _best_solution(levels, white, measurements.ASSUMED_NOISE)
    noise = measurements.ASSUMED_NOISE * math.sqrt(first.square_per_freedom)
    return max(noise, measurements.NOISE_FLOOR)


def _variances(rows: FloatArray, covariance: FloatArray) -> FloatArray:
    """The variance (n,) of each of the sums `rows` (n, parameters)."""
    return np.asarray(np.einsum("ij,jk,ik->i", rows, covariance, rows))


def _levels_about(best: "_Solution", fitted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far levels (n,) are from the fit, and how well each is known; both relative.

    Their common causes are taken off. `fitted` (n,) is their light above black by the fit, in units
    of white.
    """
    problem = best.problem
    above = problem.light - problem.black - problem.common @ best.causes
    off = above / fitted - 1
    noise = np.hypot(problem.sigma, problem.black_sigma) / fitted
    # White's own share of a cause is full scale's.
    common = problem.common / fitted[:, None]
    common = common - common[-1]
    first = len(best.theta)
    shared = _variances(common, best.covariance[first:-1, first:-1])
    return off, np.sqrt(noise**2 + np.maximum(shared, 0.0))


def strictly_rising(light: FloatArray) -> FloatArray:
    """`light` (n,), 0 to 1, with each code at least 1e-6 (relative) above the code before, and code
    1 at least 1e-9.

    A response may be flat at its dark end, as over a link in limited range.
    """
    rising = light.copy()
    for code in range(1, len(rising)):
        minimum = rising[code - 1] * (1 + MIN_RISE) + MIN_STEP
        rising[code] = max(rising[code], minimum, MIN_LIGHT)
    return np.asarray(rising / rising[-1])


def _best_solution(levels: measurements.MeasuredLevels, white: int, noise: float) -> _Solution:
    """The shape and the stiffness with the largest evidence."""
    solutions: list[_Solution] = []
    for shape in SHAPES:
        problem = _problem(shape, levels, white, noise)
        solutions.append(_solve(shape, problem, is_whole=False))
        # Far from its place a stiff curve misfits and a soft one leads: from there on the whole
        # range of stiffness is looked at again. Where that has not settled it is no solution.
        again = _solve(shape, problem, is_whole=True)
        if again.has_settled:
            solutions.append(again)
    return min(solutions, key=lambda solution: solution.minus_log_evidence)


def _problem(
    shape: Shape, levels: measurements.MeasuredLevels, white: int, noise: float
) -> _Problem:
    """The matrices of a shape, of `noise` relative to a level."""
    codes = np.arange(1, white + 1) / white
    at = levels.code[1:] / white
    low, high = shape.coordinate(codes[[0, -1]])
    count = int(np.clip(len(at) // 2, MIN_KNOTS, MAX_KNOTS))
    knots = np.linspace(0, 1, count)

    def columns(signal: FloatArray) -> FloatArray:
        place = (shape.coordinate(signal) - low) / (high - low)
        spline = _spline(place, knots)
        if shape.log_term:
            return np.hstack([spline, np.log(signal)[:, None]])
        return spline

    fine = (np.arange(400) + 0.5) / 400
    roughness = _spline(fine, knots, shape.order)
    penalty = roughness.T @ roughness / len(fine)
    prior = np.eye(len(penalty)) / PRIOR_SIGMA**2
    if shape.log_term:
        penalty = np.pad(penalty, (0, 1))
        prior = np.pad(prior, (0, 1))
        prior[-1, -1] = 1 / PRIOR_SLOPE_SIGMA**2
    scale = levels.mean[-1] - levels.mean[0]
    floor = BLACK_FLOOR
    if levels.has_errors:
        floor = STATED_FLOOR
    level_error = levels.standard_error(noise) / scale
    sigma = np.hypot(level_error, floor)
    black = float(levels.mean[0] / scale)
    common = (levels.common[1:] - levels.common[0]) / scale
    return _Problem(
        at_levels=columns(at),
        at_codes=columns(codes),
        log_base_levels=np.log(shape.base(at)),
        log_base_codes=np.log(shape.base(codes)),
        penalty=penalty,
        prior=prior,
        light=levels.mean[1:] / scale,
        sigma=sigma[1:],
        black=black,
        black_sigma=float(sigma[0]),
        common=common,
    )


def _spline(place: FloatArray, knots: FloatArray, derivative: int = 0) -> FloatArray:
    """Cubic B-splines (places, knots + 2) over 0 to 1, or a derivative of them."""
    padded = np.concatenate([np.zeros(3), knots, np.ones(3)])
    basis = BSpline(padded, np.eye(len(knots) + 2), 3)
    return np.asarray(basis(np.clip(place, 0, 1), nu=derivative))


def _solve(shape: Shape, problem: _Problem, *, is_whole: bool) -> _Solution:
    """Gauss-Newton steps; each of the first ones takes the stiffness with the largest evidence.

    It is looked for over its whole range, or beside that of the step before.
    """
    black = problem.black
    stiffness = math.nan
    moved = math.inf
    lowest = 0.05 * np.maximum(problem.light, BLACK_FLOOR)
    start = np.maximum(problem.light - problem.black, lowest)
    # what the levels leave open is smooth
    weak_prior = 1e-6 * (problem.prior + problem.penalty)
    normal = problem.at_levels.T @ problem.at_levels + weak_prior
    target = np.log(start) - problem.log_base_levels
    theta = np.asarray(np.linalg.solve(normal, problem.at_levels.T @ target))
    causes = np.zeros(problem.common.shape[1])
    first = len(theta)
    for step in range(MAX_STEPS):
        log_light = problem.log_base_levels + problem.at_levels @ theta
        above = np.exp(np.clip(log_light, -60, 10))
        misfit = (problem.light - black - above - problem.common @ causes) / problem.sigma
        slope = problem.at_levels * above[:, None]
        dark = np.full((len(above), 1), problem.black_sigma)
        design = np.hstack([slope, problem.common, dark]) / problem.sigma[:, None]
        shift = (black - problem.black) / problem.black_sigma
        target = misfit + design @ np.concatenate([theta, causes, [shift]])
        if step < STIFFNESS_STEPS:
            before = math.nan if is_whole else stiffness
            stiffness = _stiffest(problem, design, target, before)
        evidence, precision = _evidence(problem, design, target, stiffness)
        covariance = np.linalg.inv(precision)
        new = covariance @ (design.T @ target)
        log_change = problem.at_levels @ (new[:first] - theta)
        moved = float(np.abs(log_change).max())
        theta = new[:first]
        causes = new[first:-1]
        black = max(problem.black + new[-1] * problem.black_sigma, 0.0)
        if moved < SETTLED and step >= 2:
            break
    return _Solution(
        problem=problem,
        shape=shape,
        theta=theta,
        causes=causes,
        black=black,
        minus_log_evidence=evidence,
        covariance=np.asarray(covariance),
        design=design,
        misfit=misfit,
        above=above,
        has_settled=moved < SETTLED,
    )


def _evidence(
    problem: _Problem, design: FloatArray, target: FloatArray, stiffness: float
) -> tuple[float, FloatArray]:
    """Minus twice the log marginal likelihood of the linearised problem, up to a constant, and
    the posterior precision.
    """
    prior = math.exp(stiffness) * problem.penalty + problem.prior
    precision = design.T @ design
    count = len(prior)
    precision[:count, :count] += prior
    precision[count:, count:] += np.eye(len(precision) - count)
    root = np.linalg.cholesky(precision)
    explained = np.linalg.solve(root, design.T @ target)
    _, log_prior_determinant = np.linalg.slogdet(prior)
    determinants = 2 * np.log(np.diag(root)).sum() - log_prior_determinant
    return float(target @ target - explained @ explained + determinants), precision


def _stiffest(problem: _Problem, design: FloatArray, target: FloatArray, before: float) -> float:
    """The logarithm of the stiffness with the largest evidence: over the whole range, or beside
    that of the step `before`, which is NaN before the first one.
    """

    def evidence(stiffness: float) -> float:
        return _evidence(problem, design, target, stiffness)[0]

    grid = LOG_STIFFNESS
    if not math.isnan(before):
        grid = before + np.array([-1.0, 0.0, 1.0])
    best = int(np.argmin([evidence(value) for value in grid]))
    low = grid[max(best - 1, 0)]
    high = grid[min(best + 1, len(grid) - 1)]
    optimum = minimize_scalar(
        evidence, bounds=(low, high), method="bounded", options={"xatol": 0.02}
    )
    return float(np.clip(optimum.x, LOG_STIFFNESS[0], LOG_STIFFNESS[-1]))


@dataclass(frozen=True, slots=True)
class Provenance:
    """Who measured, when (by default today), the instrument, and the unit."""

    who: str = ""
    when: str = ""
    instrument: str = ""
    unit: str = ""


def calibrate_photometric(
    measured: Path,
    output: Path,
    provenance: Provenance | None = None,
    bits: int | None = None,
    identity: MonitorIdentity | None = None,
) -> dict[str, Any]:
    """Fit a response to MEASURED.csv, write MONITOR.toml with its CSV beside it, and return the
    figures by the keys of --json.

    `channels` has each channel's; those of the first one in the calibration file stand at the top
    level, too.
    Raises InputError for files that cannot be read or written, and for data that are too few,
    saturated, falling or drifting.
    """
    data = measurements.read_measurements(measured, bits)
    fits = fit_all(data)
    drift = measurements.check_drift(data)
    # For the calibration file: r, g and b where known, else w, all with the mean black.
    names = measurements.PRIMARIES if "r" in fits else ("w",)
    black = float(np.mean([fits[name].black for name in names]))
    columns = {}
    noises = []
    for name in names:
        fit = fits[name]
        columns[name] = black + fit.white * fit.light
        noises.append(fit.levels.reading_noise(fit.noise_relative))
    noise = max(noises)
    drift_note = "not known: nothing was repeated"
    drift_percent = None
    if not math.isnan(drift):
        drift_note = f"{100 * drift:+.2f} % over the run"
        drift_percent = 100 * drift
    text = f"fitted to {measured.name}, sha256 {data.sha256}"
    response = output.with_suffix(".csv")
    if response.resolve() == measured.resolve():
        raise InputError(
            f"{output}: its response would be written over {measured}; choose another name"
        )
    head = CalibrationHead(
        kind="photometric", bits=data.bits, response=response.name, **_stated(provenance)
    )
    table = write_calibration(
        output,
        head,
        columns,
        noise,
        NotesTable(drift=drift_note, text=text),
        identity=identity,
        errors=errors_of(fits),
    )
    channels = {name: _channel_figures(fit) for name, fit in fits.items()}
    return channels[names[0]] | {
        "bits": data.bits,
        "channels": channels,
        "noise_relative": noise,
        **_additivity(fits),
        "drift_percent": drift_percent,
        "written": [str(output), str(table)],
        "sha256": load_calibration(output, data.bits).sha256,
    }


def _stated(provenance: Provenance | None) -> dict[str, str]:
    """Who measured, when and with what, for the calibration file."""
    stated = asdict(provenance or Provenance())
    if not stated["when"]:
        stated["when"] = datetime.date.today().isoformat()
    for name, text in stated.items():
        stated[name] = text or NOT_STATED
    return stated


def _additivity(fits: dict[str, ChannelFit]) -> dict[str, Any]:
    """How far r, g and b together are from w, above black, percent: at white, and at codes decades
    below it with their errors; null where not all four were measured.
    """
    if len(fits) < len(measurements.CHANNELS):
        return {
            "additivity_percent": None,
            "crosstalk_percent": None,
            "crosstalk_error_percent": None,
        }
    primaries = [fits[name] for name in measurements.PRIMARIES]
    white = fits["w"]
    together = np.sum([fit.white * fit.light for fit in primaries], axis=0)
    white_light = np.maximum(white.white * white.light, 1e-300)
    excess = 100 * (together / white_light - 1)
    places = list(_decades(white).values())
    errors = []
    for fit in primaries:
        share = fit.white * fit.light[places] / together[places]
        errors.append(share * _white_and_own_error(fit, places))
    errors.append(_white_and_own_error(white, places))
    error_percent = 100 * np.sqrt(np.square(errors).sum(axis=0))
    names = [f"1e-{decade}" for decade in _decades(white)]
    return {
        "additivity_percent": float(excess[-1]),
        "crosstalk_percent": dict(zip(names, excess[places].tolist(), strict=True)),
        "crosstalk_error_percent": dict(zip(names, error_percent.tolist(), strict=True)),
    }


def _white_and_own_error(fit: ChannelFit, places: list[int]) -> FloatArray:
    """Relative errors (n,) of a channel's light at codes.

    A channel's errors are relative to its white, which is as well known as its readings are many.
    """
    levels = fit.levels
    white_error = levels.standard_error(fit.noise_relative)[-1] / levels.mean[-1]
    return np.asarray(np.hypot(fit.error[places], white_error))


def errors_of(fits: dict[str, ChannelFit]) -> ErrorsTable | None:
    """How far white's levels are from the fit, and how well each is known; None where white or
    its repeats are missing.
    """
    fit = fits.get("w")
    if fit is None or "r" in fits:
        return None
    levels = fit.levels
    if math.isnan(levels.relative_noise) and not levels.has_errors:
        return None
    level_light = fit.light[levels.code[1:]]
    black = fit.black_error / fit.white
    common = levels.standard_error(fit.noise_relative)[0] / fit.white
    dof = float((levels.count - 1).sum())
    return ErrorsTable(
        light=_rounded(level_light),
        off=_rounded(fit.level_off),
        relative=_rounded(fit.level_error),
        dof=dof,
        black=_rounded(black)[0],
        common=_rounded(common)[0],
    )


def _rounded(values: FloatArray | float) -> list[float]:
    """Numbers of six digits, as the calibration file has them."""
    return [float(f"{value:.6g}") for value in np.atleast_1d(values).tolist()]


def fit_all(data: measurements.Measurements) -> dict[str, ChannelFit]:
    """The response of each channel that was measured. Raises InputError where it is neither w
    nor all of r, g and b.
    """
    channels = data.channels
    if "w" not in channels and channels != measurements.PRIMARIES:
        raise InputError(
            f"{data.source}: only channel {', '.join(channels)}; measure w, or all of r, g and b"
        )
    if len(channels) not in {1, 3, 4}:
        raise InputError(
            f"{data.source}: channels {', '.join(channels)}; measure w alone, or all of r, g and b"
        )
    return {name: fit_channel(data, name) for name in channels}


def _decades(fit: ChannelFit) -> dict[int, int]:
    """The code whose light is nearest to each decade below white."""
    log_light = np.log(np.maximum(fit.light, 1e-12))
    codes = {}
    for decade in DECADES:
        distance = np.abs(log_light + decade * math.log(10))
        codes[decade] = int(np.argmin(distance))
    return codes


def _channel_figures(fit: ChannelFit) -> dict[str, Any]:
    """One channel's figures: its black level over white and in the unit of measurement, and
    errors at decades below white.
    """
    count = fit.levels.count
    error_percent = {}
    for decade, code in _decades(fit).items():
        error_percent[f"1e-{decade}"] = 100 * float(fit.error[code])
    repeats = {"min": int(count.min()), "max": int(count.max())}
    black_level = {
        "relative": fit.black / fit.white,
        "unit": fit.black,
        "error": fit.black_error / fit.white,
    }
    return {
        "codes": len(count),
        "repeats": repeats,
        "black_level": black_level,
        "noise_relative": fit.levels.reading_noise(fit.noise_relative),
        "lack_of_fit": fit.lack_of_fit,
        "shape": fit.shape,
        "parameters": fit.parameters,
        "error_percent": error_percent,
        "holdout": held_out(fit),
    }


def held_out(fit: ChannelFit) -> dict[str, float]:
    """The errors of a fit's levels, each held out of the fit, from white to three decades below;
    light is above black.
    """
    level_light = fit.light[fit.levels.code[1:]]
    shown = level_light >= 10.0 ** -DECADES[-1]
    residual = np.abs(fit.residual[shown])
    sigmas = residual / fit.residual_error[shown]
    rms = float(np.sqrt((residual**2).mean()))
    p95 = float(np.percentile(residual, 95))
    p95_sigmas = float(np.percentile(sigmas, 95))
    largest = float(residual.max())
    return {
        "rms_percent": 100 * rms,
        "p95_percent": 100 * p95,
        "max_percent": 100 * largest,
        "rms_mag": MAG_PER_RELATIVE * rms,
        "max_mag": MAG_PER_RELATIVE * largest,
        "p95_sigmas": p95_sigmas,
    }


def draw_calibration(measured: Path, path: Path, bits: int | None = None) -> str:
    """Draw the response and the held-out residuals of MEASURED.csv into a PNG; returns the finding
    as a sentence.

    Raises InputError for the same data as the fit does, and where the PNG cannot be written.
    """
    return draw_fits(fit_all(measurements.read_measurements(measured, bits)), path)


def draw_fits(fits: dict[str, ChannelFit], path: Path) -> str:
    """Draw the response and the held-out residuals of channels; returns the finding on the one
    whose levels are farthest off. Raises InputError where the PNG cannot be written.
    """
    worst = max(fits.values(), key=lambda fit: held_out(fit)["rms_percent"])
    errors = held_out(worst)
    repeats_percent = 100 * worst.levels.reading_noise(worst.noise_relative)
    finding = (
        f"Levels held out of the fit are {errors['rms_percent']:.2g} % ({errors['rms_mag']:.2g}"
        f" mag) rms off, {errors['max_percent']:.2g} % at the maximum; a patch repeats to"
        f" {repeats_percent:.2g} %"
    )
    note = (
        "Lines: the fit. Dots: measured above, held out of the fit below. Dotted: black. Bands: the"
        " fit's error."
    )
    with chart(path, finding, panels=2, note=note) as (response, residual):
        for name, fit in fits.items():
            _draw_response(response, fit, name)
            _draw_residuals(residual, fit, COLOURS[name])
        response.set(yscale="log", ylim=(1e-5, 2), ylabel="light over white [share]")
        residual.axhline(0, color=MUTED, linewidth=0.8)
        residual.set(ylabel="held-out residual [%]", xlabel="code")
        label_ends(response)
    return finding


def _draw_response(axes: Any, fit: ChannelFit, channel: str) -> None:
    """Draw a channel's light over its code: the fit, the levels, and black."""
    colour = COLOURS[channel]
    codes = np.arange(1, len(fit.light))
    light = np.maximum(fit.light[1:], MIN_DRAWN_LIGHT)
    axes.plot(codes, light, color=colour, label=NAMES[channel])
    level = (fit.levels.mean[1:] - fit.black) / fit.white
    is_drawn = level > MIN_DRAWN_LIGHT
    drawn_codes = fit.levels.code[1:][is_drawn]
    axes.plot(drawn_codes, level[is_drawn], "o", color=colour, markersize=4, label="_measured")
    black = max(fit.black / fit.white, MIN_DRAWN_LIGHT)
    axes.axhline(black, color=colour, linewidth=0.8, linestyle=":", label="_black")


def _draw_residuals(axes: Any, fit: ChannelFit, colour: str) -> None:
    """Draw the levels' held-out residuals, and a band of the fit's error, from 1e-3 of white on."""
    is_shown = fit.light >= 1e-3
    codes = np.flatnonzero(is_shown)
    error_percent = 100 * fit.error[is_shown]
    axes.fill_between(codes, -error_percent, error_percent, color=colour, alpha=0.15, lw=0)
    code = fit.levels.code[1:]
    is_held = is_shown[code]
    axes.plot(code[is_held], 100 * fit.residual[is_held], "o", color=colour, markersize=4)
