"""The detector behind photographs by their background: gain, pedestal and read noise, by photon
transfer.

Shot noise goes as the light, and the pixels' response (PRNU) as its square: both are noise about
the neighbours in one photograph, and only what several photographs have in common tells them apart,
or levels that differ widely. A gain that they leave open is the bench file's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.units import MAD_TO_SIGMA
from hilstar.instruments.confront.background import FixedPattern
from hilstar.tracker.settings import DetectorSettings

BLOCK_PX = 32
CLIP, ROUNDS = 3.5, 8
MIN_VARIANCE_DN2 = 1e-9
MIN_POINTS = 4  # for a curve of three numbers
# by how much the shade of the sky's light differs from one photograph to another beyond a slope
SKY_CURVATURE = 0.03
MIN_LEVEL_RANGE = 1.25  # ratio of background levels from which their noise tells the gain
TOLD_SIGMAS = 5.0  # a gain is told where shot noise is so many of its sigmas
MAX_GAIN_ERROR = 0.1  # and at one level, where its sigma is no larger share of it
READ_NOISE_SHARE = 0.5  # one sigma of a read noise that is assumed, as a share of it


@dataclass(frozen=True, slots=True)
class PixelFit:
    """What pixels tell of the detector: gain, pedestal, read noise, with one sigma where known, and
    the points (n, 2) of it.

    Points are the background's level and its variance, DN, DN^2. `notes` say what was assumed.
    `gain_told` is whether the gain is the photographs' own; else it is the bench file's.
    """

    gain_e_per_dn: float
    pedestal_dn: float
    read_noise_e: float
    step_dn: float
    sigma: dict[str, float]
    points: FloatArray
    notes: tuple[str, ...] = ()
    pattern: FixedPattern = field(default_factory=FixedPattern)
    gain_told: bool = False

    def variance_dn2(self, level_dn: FloatArray) -> FloatArray:
        """Variance of a pixel at a level, DN^2: of its light, its read noise, and the rounding to
        steps.
        """
        light_dn = np.maximum(level_dn - self.pedestal_dn, 0)
        shot_dn2 = light_dn / self.gain_e_per_dn
        read_dn2 = (self.read_noise_e / self.gain_e_per_dn) ** 2
        rounding_dn2 = self.step_dn**2 / 12
        noise_dn2 = shot_dn2 + read_dn2 + rounding_dn2
        return np.asarray(noise_dn2 + self.pattern.variance_dn2(light_dn))

    @property
    def gain_words(self) -> str:
        """The gain with its sigma, or where it is from."""
        if self.gain_told:
            return f"{self.gain_e_per_dn:.4g} +- {self.sigma['gain_e_per_dn']:.2g} e- a DN"
        return f"{self.gain_e_per_dn:.4g} e- a DN (the bench file's)"


def transfer_points(dn: FloatArray, level: FloatArray, star: BoolArray) -> FloatArray:
    """Levels and variances (n, 2) of blocks of an image, by differences of neighbours, without
    pixels of stars.

    A shading within a block counts for nothing: the smooth level is taken off first.
    """
    off = dn - level
    is_free = ~star
    across = _block_points(np.diff(off, axis=1), is_free[:, 1:] & is_free[:, :-1], level)
    down = _block_points(np.diff(off, axis=0), is_free[1:] & is_free[:-1], level)
    return np.concatenate([across, down])


def _block_points(difference: FloatArray, use: BoolArray, level: FloatArray) -> FloatArray:
    """Levels and variances (n, 2) of blocks by differences (height, width) of two pixels each,
    where more than half of them count.
    """
    differences = _in_blocks(difference)
    uses = _in_blocks(use)
    levels = _in_blocks(level[: difference.shape[0], : difference.shape[1]])
    squares = (differences**2 * uses).sum(axis=1) / np.maximum(uses.sum(axis=1), 1)
    spread = np.sqrt(np.maximum(squares, 1e-12))
    uses &= np.abs(differences) < 4 * spread[:, None]
    count = uses.sum(axis=1)
    squares = (differences**2 * uses).sum(axis=1) / np.maximum(count, 1)
    # a difference has the noise of two pixels
    points = np.column_stack([levels.mean(axis=1), squares / 2])
    return np.asarray(points[count > BLOCK_PX**2 / 2])


def _in_blocks(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Values (height, width) by whole block: (blocks, BLOCK_PX^2)."""
    rows = values.shape[0] // BLOCK_PX
    columns = values.shape[1] // BLOCK_PX
    whole = values[: rows * BLOCK_PX, : columns * BLOCK_PX]
    blocks = whole.reshape(rows, BLOCK_PX, columns, BLOCK_PX).swapaxes(1, 2)
    return blocks.reshape(-1, BLOCK_PX**2)


def fit_pixels(
    points: FloatArray,
    step_dn: float,
    pedestal: tuple[float, float] | None,
    assumed: DetectorSettings,
    pattern: FixedPattern,
) -> PixelFit:
    """The detector by photon transfer, that of the bench file where photographs cannot tell it.

    `pedestal` comes with its sigma where levels told it. A fixed pattern is no noise of light.
    """
    if not len(points):
        note = "no part of the background is free of sources: the detector is the bench file's"
        offset_dn = assumed.offset_dn
        if pedestal is not None:
            offset_dn = pedestal[0]
        bench = _of_bench(assumed, step_dn, points, pattern)
        return replace(bench, pedestal_dn=offset_dn, notes=(note,))
    level_dn, all_variance = points.T
    offset_dn, offset_sigma_dn, note = _pedestal(level_dn, pedestal, assumed)
    light_dn = level_dn - offset_dn
    # a difference along a row, or down a column, has one of both patterns
    *_, column_dn, row_dn = pattern.rms
    line_variance = (column_dn**2 + row_dn**2) / 2
    pattern_variance = pattern.variance_dn2(np.maximum(light_dn, 0))
    variance = all_variance - pattern_variance + line_variance
    notes: tuple[str, ...] = ()
    if note:
        notes = (note,)
    bench = replace(
        _of_bench(assumed, step_dn, points, pattern),
        pedestal_dn=offset_dn,
        sigma={"pedestal_dn": offset_sigma_dn},
        notes=notes,
    )
    several = math.isfinite(pattern.errors[0])
    fit = _by_levels(bench, light_dn, variance, several=several)
    if fit is None:
        fit = _by_one_level(bench, light_dn, variance, several=several)
    if fit is None:
        fit = _by_response(bench, light_dn, variance, assumed.dsnu_e / bench.gain_e_per_dn)
    return fit


def _of_bench(
    assumed: DetectorSettings,
    step_dn: float,
    points: FloatArray,
    pattern: FixedPattern,
) -> PixelFit:
    """The detector as the bench file has it."""
    return PixelFit(
        gain_e_per_dn=assumed.gain_e_per_dn,
        pedestal_dn=assumed.offset_dn,
        read_noise_e=assumed.read_noise_e,
        step_dn=step_dn,
        sigma={},
        points=points,
        pattern=pattern,
    )


def _pedestal(
    level: FloatArray,
    pedestal: tuple[float, float] | None,
    assumed: DetectorSettings,
) -> tuple[float, float, str]:
    """The pedestal, its sigma, DN, and where it is from, if it is the bench file's."""
    bench = assumed.offset_dn
    whose = f"the pedestal is the bench file's, {bench:g} DN"
    if pedestal is None:
        return bench, math.nan, f"{whose}: levels of these photographs do not tell it"
    offset, sigma = pedestal
    sigma = math.hypot(sigma, SKY_CURVATURE * float(np.median(level)))
    if abs(offset - bench) < 3 * sigma:
        return bench, sigma, f"{whose} ({offset:.0f} +- {sigma:.0f} DN by the skies' levels)"
    return offset, sigma, ""


def _by_levels(
    bench: PixelFit,
    light: FloatArray,
    variance: FloatArray,
    *,
    several: bool,
) -> PixelFit | None:
    """The gain by the slope of the variance over levels that differ; None where they do not tell
    it.

    In one photograph the pixels' response is unknown: a square is fitted beside the slope.
    """
    low, high = np.percentile(light, [5, 95])
    if high < MIN_LEVEL_RANGE * low:
        return None
    line = _curve(light, variance, square=not several)
    if not line.slope > TOLD_SIGMAS * line.slope_sigma:
        return None
    gain = 1 / line.slope
    rounding_dn2 = bench.step_dn**2 / 12
    read_dn = math.sqrt(max(line.at_zero - rounding_dn2, 0.0))
    # of a root: its own error where it is far from 0, else the root of the square's
    far_sigma_dn = line.at_zero_sigma / max(2 * read_dn, 1e-9)
    read_sigma_dn = min(far_sigma_dn, math.sqrt(line.at_zero_sigma))
    gain_sigma = gain * line.slope_sigma / line.slope
    sigma = {"gain_e_per_dn": gain_sigma, "read_noise_e": gain * read_sigma_dn}
    pattern = bench.pattern
    if not several and line.square > 0:
        pattern = _response_alone(line.square, line.square_sigma)
    return replace(
        bench,
        gain_e_per_dn=gain,
        read_noise_e=read_dn * gain,
        sigma=bench.sigma | sigma,
        pattern=pattern,
        gain_told=True,
    )


def _by_one_level(
    bench: PixelFit,
    light: FloatArray,
    variance: FloatArray,
    *,
    several: bool,
) -> PixelFit | None:
    """The gain by the shot noise of one level; None where its fixed pattern is not known."""
    signal_dn = float(np.median(light))
    noise_dn2 = float(np.median(variance)) - bench.step_dn**2 / 12
    if not several or signal_dn <= 0 or noise_dn2 <= 0:
        return None
    read_e = bench.read_noise_e
    # noise^2 = signal / gain + (read noise / gain)^2
    root = math.sqrt(signal_dn**2 + 4 * noise_dn2 * read_e**2)
    gain = (signal_dn + root) / (2 * noise_dn2)
    response_error_dn2 = signal_dn**2 * bench.pattern.errors[0]
    noise_error_dn2 = math.hypot(_median_error(variance), response_error_dn2)
    read_dn2 = (read_e / gain) ** 2
    error_dn2 = math.hypot(noise_error_dn2, 2 * READ_NOISE_SHARE * read_dn2)
    error = error_dn2 / (signal_dn / gain)
    if error > MAX_GAIN_ERROR:
        return None
    note = (
        "the background has one level: the gain takes the bench file's pedestal,"
        f" {bench.pedestal_dn:g} DN, and"
        f" read noise, {read_e:g} e-"
    )
    return replace(
        bench,
        gain_e_per_dn=gain,
        sigma=bench.sigma | {"gain_e_per_dn": gain * error},
        notes=(*bench.notes, note),
        gain_told=True,
    )


def _by_response(
    bench: PixelFit,
    light: FloatArray,
    variance: FloatArray,
    offsets_dn: float,
) -> PixelFit:
    """The bench file's gain; the noise left over is read noise, or the pixels' response."""
    signal_dn = float(np.median(light))
    noise_dn2 = float(np.median(variance)) - bench.step_dn**2 / 12
    gain = bench.gain_e_per_dn
    if signal_dn <= 0:
        note = "the background is at the pedestal: the gain is the bench file's"
        read_e = math.sqrt(max(noise_dn2, 0.0)) * gain
        return replace(bench, read_noise_e=read_e, notes=(*bench.notes, note))
    shot_dn2 = signal_dn / gain + (bench.read_noise_e / gain) ** 2
    rest_dn2 = noise_dn2 - shot_dn2 - offsets_dn**2
    error_dn2 = _median_error(variance)
    note = (
        "these photographs do not tell the gain, which is the bench file's: one level of"
        " background has shot noise and the"
        " pixels' response in one"
    )
    if rest_dn2 < -TOLD_SIGMAS * error_dn2:
        minimum_gain = signal_dn / max(noise_dn2, MIN_VARIANCE_DN2)
        noise_dn = math.sqrt(max(noise_dn2, 0.0))
        note += (
            f"; but the noise, {noise_dn:.3g} DN, is less than its shot noise,"
            f" {math.sqrt(shot_dn2):.3g} DN: write [tracker.detector] gain_e_per_dn ="
            f" {minimum_gain:.3g} or more"
        )
        return replace(bench, notes=(*bench.notes, note))
    if math.isfinite(bench.pattern.errors[0]):
        return replace(bench, notes=(*bench.notes, note))
    square = rest_dn2 / signal_dn**2
    square_sigma = error_dn2 / signal_dn**2
    pattern = _response_alone(square, square_sigma, offsets_dn)
    if pattern.rms[0]:
        percent = 100 * pattern.rms[0]
        note += f"; the rest of the noise is a response of {percent:.2g} %, if no more are offsets"
    return replace(bench, pattern=pattern, notes=(*bench.notes, note))


def _response_alone(square: float, sigma: float, offsets_dn: float = 0.0) -> FixedPattern:
    """The response of one photograph's pixels, beside offsets that the bench file gives."""
    offsets_sigma = 0.0
    if offsets_dn == 0:
        offsets_sigma = math.inf
    squares = (max(square, 0.0), offsets_dn**2, 0.0, 0.0)
    return FixedPattern(squares, (sigma, offsets_sigma, math.inf, math.inf))


def _median_error(values: FloatArray) -> float:
    """One sigma of the median of values (n,)."""
    spread = MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))
    return math.sqrt(math.pi / 2 / len(values)) * spread


def _not_below_zero(design: FloatArray, target: FloatArray) -> FloatArray:
    from scipy.optimize import nnls

    return np.asarray(nnls(design, target)[0], dtype=np.float64)


def _free(design: FloatArray, target: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(design, target, rcond=None)[0], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class _Curve:
    """A curve of variances over levels: slope, value at 0 and share of the square, with sigmas."""

    slope: float = math.nan
    at_zero: float = math.nan
    square: float = math.nan
    slope_sigma: float = math.nan
    at_zero_sigma: float = math.nan
    square_sigma: float = math.nan


def _curve(x: FloatArray, y: FloatArray, *, square: bool) -> _Curve:
    """Slope, value at 0 and share of the square, with sigmas, without outliers; errors go as y."""
    columns = [x, np.ones_like(x)]
    if square:
        columns.append(x**2)
    all_rows = np.column_stack(columns)
    near = np.ones(len(x), dtype=bool)
    scale = np.maximum(np.maximum(np.median(y) * 0.5, y), MIN_VARIANCE_DN2)
    values: FloatArray = np.zeros(3)
    sigma = np.full(3, math.nan)
    for _ in range(ROUNDS):
        if near.sum() < MIN_POINTS:  # levels without noise
            return _Curve()
        weight = 1 / scale[near]
        rows = all_rows[near] * weight[:, None]
        size = np.linalg.norm(rows, axis=0)
        design = rows / size
        target = y[near] * weight
        if square:
            values = _not_below_zero(design, target) / size
        else:
            values = _free(design, target) / size
        off = y - all_rows @ values
        spread = MAD_TO_SIGMA * float(np.median(np.abs(off[near] * weight)))
        covariance = np.linalg.pinv(design.T @ design)
        sigma = spread * np.sqrt(np.diag(covariance)) / size
        near = np.abs(off) < CLIP * spread * scale
    curve = _Curve(
        slope=float(values[0]),
        at_zero=float(values[1]),
        square=0.0,
        slope_sigma=float(sigma[0]),
        at_zero_sigma=float(sigma[1]),
        square_sigma=0.0,
    )
    if square:
        curve = replace(curve, square=float(values[2]), square_sigma=float(sigma[2]))
    return curve


def fit_pedestal(levels: Sequence[FloatArray], places: FloatArray) -> tuple[float, float] | None:
    """The level without light, and its sigma, by skies of different brightness; None where they
    cannot tell.

    `levels` (blocks,) of each photograph at `places` (blocks, 2). A sky's light is one shade over
    the image, common to all photographs, times a slope of its own. Sigma is by leaving out a
    photograph at a time.
    """
    medians = [float(np.median(level)) for level in levels]
    if len(levels) < 2 or max(medians) < MIN_LEVEL_RANGE * max(min(medians), 1e-9):
        return None
    plane = np.column_stack([np.ones(len(places)), places])
    whole = _common_zero(levels, plane)
    sigma = abs(whole) / 2
    if len(levels) == 2:
        return whole, sigma
    usable = []
    for k in range(len(levels)):
        other_medians = medians[:k] + medians[k + 1 :]
        if max(other_medians) > MIN_LEVEL_RANGE * min(other_medians):
            usable.append(_common_zero([*levels[:k], *levels[k + 1 :]], plane))
    if len(usable) > 1:
        # of the jackknife
        sigma = float(np.std(usable)) * math.sqrt(max(len(usable) - 1, 1))
    return whole, max(sigma, 0.01 * min(medians))


def _common_zero(levels: Sequence[FloatArray], plane: FloatArray) -> float:
    """The level above which skies are most nearly one shade: their logarithms differ by a plane."""
    from scipy.optimize import minimize_scalar

    lowest = min(float(level.min()) for level in levels)

    def loss(pedestal: float) -> float:
        logs = np.log(np.array(levels) - pedestal)
        off = (logs - logs.mean(axis=0)).T
        slopes = np.linalg.lstsq(plane, off, rcond=None)[0]
        return float(((off - plane @ slopes) ** 2).sum())

    bounds = (lowest - 2 * abs(lowest), 0.98 * lowest)
    return float(minimize_scalar(loss, bounds=bounds, method="bounded").x)
