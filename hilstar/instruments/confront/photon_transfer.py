"""The detector behind photographs by their background: gain, pedestal and read noise, by photon
transfer.

Shot noise goes as the light, and the pixels' response (PRNU) as its square: both are noise about
the neighbours in one photograph, and only what several photographs have in common tells them apart,
or levels that differ widely. A gain that they leave open is the bench file's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray, FloatArray
from hilstar.basics.units import MAD_TO_SIGMA
from hilstar.instruments.confront.background import NO_PATTERN, FixedPattern
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
    pattern: FixedPattern = NO_PATTERN
    gain_told: bool = False

    def variance_dn2(self, level_dn: FloatArray) -> FloatArray:
        """Variance of a pixel at a level."""
        light = np.maximum(level_dn - self.pedestal_dn, 0)
        noise = (
            light / self.gain_e_per_dn
            + (self.read_noise_e / self.gain_e_per_dn) ** 2
            + self.step_dn**2 / 12
        )
        return np.asarray(noise + self.pattern.variance_dn2(light))

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
    free = ~star
    parts = []
    for first, second, both in (
        (off[:, 1:], off[:, :-1], free[:, 1:] & free[:, :-1]),
        (off[1:], off[:-1], free[1:] & free[:-1]),
    ):
        height, width = (size // BLOCK_PX * BLOCK_PX for size in first.shape)
        shape = height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX
        difference = _in_blocks((first - second)[:height, :width], shape)
        use = _in_blocks(both[:height, :width], shape)
        middle = _in_blocks(level[:height, :width], shape).mean(axis=1)
        squares = (difference**2 * use).sum(axis=1) / np.maximum(use.sum(axis=1), 1)
        spread = np.sqrt(np.maximum(squares, 1e-12))
        use &= np.abs(difference) < 4 * spread[:, None]
        count = use.sum(axis=1)
        variance = (difference**2 * use).sum(axis=1) / np.maximum(count, 1) / 2
        full = count > BLOCK_PX**2 / 2
        parts.append(np.column_stack([middle, variance])[full])
    return np.concatenate(parts)


def _in_blocks(values: npt.NDArray[Any], shape: tuple[int, int, int, int]) -> npt.NDArray[Any]:
    """Values (height, width) by block: (blocks, BLOCK_PX^2)."""
    return values.reshape(shape).swapaxes(1, 2).reshape(-1, BLOCK_PX**2)


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
        if pedestal is None:
            offset = assumed.offset_dn
        else:
            offset = pedestal[0]
        bench = _of_bench(assumed, step_dn, points, pattern)
        return replace(bench, pedestal_dn=offset, notes=(note,))
    level, variance = points.T
    offset, offset_sigma, note = _pedestal(level, pedestal, assumed)
    light = level - offset
    *_, column, row = pattern.rms  # of which a difference along a row, or down a column, has one
    variance = variance - pattern.variance_dn2(np.maximum(light, 0)) + (column**2 + row**2) / 2
    bench = replace(
        _of_bench(assumed, step_dn, points, pattern),
        pedestal_dn=offset,
        sigma={"pedestal_dn": offset_sigma},
        notes=(note,) if note else (),
    )
    several = math.isfinite(pattern.errors[0])
    own_gain = _by_levels(bench, light, variance, several=several)
    own_gain = own_gain or _by_one_level(bench, light, variance, several=several)
    return own_gain or _by_response(bench, light, variance, assumed.dsnu_e / bench.gain_e_per_dn)


def _of_bench(
    assumed: DetectorSettings,
    step_dn: float,
    points: FloatArray,
    pattern: FixedPattern,
) -> PixelFit:
    gain = assumed.gain_e_per_dn
    read_e = assumed.read_noise_e
    return PixelFit(gain, assumed.offset_dn, read_e, step_dn, {}, points, (), pattern)


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
    read_dn = math.sqrt(max(line.at_zero - bench.step_dn**2 / 12, 0.0))
    read_sigma_dn = min(line.at_zero_sigma / max(2 * read_dn, 1e-9), math.sqrt(line.at_zero_sigma))
    sigma = bench.sigma | {
        "gain_e_per_dn": gain * line.slope_sigma / line.slope,
        "read_noise_e": gain * read_sigma_dn,
    }
    pattern = bench.pattern
    if not several and line.square > 0:
        pattern = _response_alone(line.square, line.square_sigma)
    return replace(
        bench,
        gain_e_per_dn=gain,
        read_noise_e=read_dn * gain,
        sigma=sigma,
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
    signal = float(np.median(light))
    noise2 = float(np.median(variance)) - bench.step_dn**2 / 12
    if not several or signal <= 0 or noise2 <= 0:
        return None
    read_e = bench.read_noise_e
    gain = (signal + math.sqrt(signal**2 + 4 * noise2 * read_e**2)) / (2 * noise2)
    sigma2 = math.hypot(_median_error(variance), signal**2 * bench.pattern.errors[0])
    read2 = (read_e / gain) ** 2
    shot2 = max(noise2 - read2, MIN_VARIANCE_DN2)
    error = math.hypot(sigma2, 2 * READ_NOISE_SHARE * read2) / shot2
    if error > MAX_GAIN_ERROR:
        return None
    note = (
        "the background has one level: the gain takes the bench file's pedestal,"
        f" {bench.pedestal_dn:g} DN, and"
        f" read noise, {read_e:g} e-"
    )
    sigma = bench.sigma | {"gain_e_per_dn": gain * error}
    return replace(
        bench, gain_e_per_dn=gain, sigma=sigma, notes=(*bench.notes, note), gain_told=True
    )


def _by_response(
    bench: PixelFit,
    light: FloatArray,
    variance: FloatArray,
    offsets_dn: float,
) -> PixelFit:
    """The bench file's gain; the noise left over is read noise, or the pixels' response."""
    signal = float(np.median(light))
    noise2 = float(np.median(variance)) - bench.step_dn**2 / 12
    gain = bench.gain_e_per_dn
    if signal <= 0:
        note = "the background is at the pedestal: the gain is the bench file's"
        read_e = math.sqrt(max(noise2, 0.0)) * gain
        return replace(bench, read_noise_e=read_e, notes=(*bench.notes, note))
    shot2 = signal / gain + (bench.read_noise_e / gain) ** 2
    left2 = noise2 - shot2 - offsets_dn**2
    error2 = _median_error(variance)
    note = (
        "these photographs do not tell the gain, which is the bench file's: one level of"
        " background has shot noise and the"
        " pixels' response in one"
    )
    if left2 < -TOLD_SIGMAS * error2:
        least = signal / max(noise2, MIN_VARIANCE_DN2)
        note += (
            f"; but the noise, {math.sqrt(max(noise2, 0.0)):.3g} DN, is less than its shot noise,"
            f" {math.sqrt(shot2):.3g} DN: write [tracker.detector] gain_e_per_dn = {least:.3g} or"
            " more"
        )
        return replace(bench, notes=(*bench.notes, note))
    if math.isfinite(bench.pattern.errors[0]):
        return replace(bench, notes=(*bench.notes, note))
    pattern = _response_alone(left2 / signal**2, error2 / signal**2, offsets_dn)
    if pattern.rms[0]:
        percent = 100 * pattern.rms[0]
        note += f"; the rest of the noise is a response of {percent:.2g} %, if no more are offsets"
    return replace(bench, pattern=pattern, notes=(*bench.notes, note))


def _response_alone(square: float, sigma: float, offsets_dn: float = 0.0) -> FixedPattern:
    """The response of one photograph's pixels, beside offsets that the bench file gives."""
    offsets_sigma = math.inf if offsets_dn == 0 else 0.0
    return FixedPattern(
        (max(square, 0.0), offsets_dn**2, 0.0, 0.0), (sigma, offsets_sigma, math.inf, math.inf)
    )


def _median_error(values: FloatArray) -> float:
    """One sigma of the median of values (n,)."""
    spread = MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))
    return math.sqrt(math.pi / 2 / len(values)) * spread


def _not_below_zero(design: FloatArray, target: FloatArray) -> FloatArray:
    from scipy.optimize import nnls

    return np.asarray(nnls(design, target)[0], dtype=np.float64)


def _free(design: FloatArray, target: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(design, target, rcond=None)[0], dtype=np.float64)


class _Curve(NamedTuple):
    slope: float
    at_zero: float
    square: float
    slope_sigma: float
    at_zero_sigma: float
    square_sigma: float


NO_CURVE = _Curve(*[math.nan] * 6)


def _curve(x: FloatArray, y: FloatArray, *, square: bool) -> _Curve:
    """Slope, value at 0 and share of the square, with sigmas, without outliers; errors go as y."""
    columns = [x, np.ones_like(x)]
    if square:
        columns.append(x**2)
    whole = np.column_stack(columns)
    near = np.ones(len(x), dtype=bool)
    scale = np.maximum(np.maximum(np.median(y) * 0.5, y), MIN_VARIANCE_DN2)
    values: FloatArray = np.zeros(3)
    sigma = np.full(3, math.nan)
    for _ in range(ROUNDS):
        if near.sum() < MIN_POINTS:  # levels without noise
            return NO_CURVE
        weight = 1 / scale[near]
        design = whole[near] * weight[:, None]
        size = np.linalg.norm(design, axis=0)
        least_squares = _not_below_zero if square else _free
        values = least_squares(design / size, y[near] * weight) / size
        off = y - whole @ values
        spread = MAD_TO_SIGMA * float(np.median(np.abs(off[near] * weight)))
        normal = np.linalg.pinv((design / size).T @ (design / size))
        sigma = spread * np.sqrt(np.diag(normal)) / size
        near = np.abs(off) < CLIP * spread * scale
    if square:
        squares = (float(values[2]), float(sigma[2]))
    else:
        squares = (0.0, 0.0)
    return _Curve(
        float(values[0]), float(values[1]), squares[0], float(sigma[0]), float(sigma[1]), squares[1]
    )


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
    from scipy.optimize import minimize_scalar

    plane = np.column_stack([np.ones(len(places)), places])

    def best(some: Sequence[FloatArray]) -> float:
        lowest = min(float(level.min()) for level in some)

        def loss(pedestal: float) -> float:
            logs = np.log(np.array(some) - pedestal)
            off = (logs - logs.mean(axis=0)).T
            off = off - plane @ np.linalg.lstsq(plane, off, rcond=None)[0]
            return float((off**2).sum())

        return float(
            minimize_scalar(
                loss, bounds=(lowest - 2 * abs(lowest), 0.98 * lowest), method="bounded"
            ).x
        )

    whole = best(levels)
    if len(levels) == 2:
        return whole, abs(whole) / 2
    parts = [best([*levels[:k], *levels[k + 1 :]]) for k in range(len(levels))]
    usable = [
        p
        for k, p in enumerate(parts)
        if max(m := medians[:k] + medians[k + 1 :]) > MIN_LEVEL_RANGE * min(m)
    ]
    if len(usable) > 1:
        sigma = float(np.std(usable)) * math.sqrt(max(len(usable) - 1, 1))
    else:
        sigma = abs(whole) / 2
    return whole, max(sigma, 0.01 * min(medians))
