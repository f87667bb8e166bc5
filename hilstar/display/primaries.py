"""The matrix that gives the electrons in each channel of a tracker for each primary of a monitor,
computed from spectra.

The primaries' spectra come from a table, from an ArgyllCMS file of samples measured on the
display, or from CIE chromaticities.
"""

import itertools
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.reading import named_text
from hilstar.basics.text_tables import finite_numbers, read_rows
from hilstar.sky.electrons import Optics
from hilstar.sky.spectrum import (
    MAX_CURVE_BYTES,
    RANGE_NM,
    Curve,
    integration_nodes,
    refuse_other_units,
)

PRIMARIES = ("r", "g", "b")
COLUMNS = ("wavelength_nm", *PRIMARIES)
ADVICE = "write wavelength_nm,r,g,b: each primary's relative spectral power at full drive"
CCSS_ADVICE = "give a .ccss of this display (ccxxmake -S), or a CSV of wavelength_nm,r,g,b"
MAX_SAMPLES = 40
# Largest rms residual of a mixture, relative to its sample: a spectrometer's repeatability, and the
# additivity of a display without a fourth subpixel, stay below it.
MIXED_WITHIN = 0.03
# How much more light than its primaries' sum a sample may have, as a share: screens that dim with
# what they show are off by less, a white subpixel by more.
MAX_EXCESS = 0.15
DARK_SHARE = 0.02  # a sample with less light, relative to the brightest, is black or nearly so
# relative to the largest: pinv takes smaller singular values of a Gram matrix for rounding
SINGULAR = 1e-12
D65_XY = (0.3127, 0.3290)
# largest distance in xy from a Gaussian's chromaticity: the blue of sRGB is 0.03 from one of 30 nm
FAR_XY = 0.08
FWHM_SIGMAS = 2.3548  # a Gaussian's full width at half maximum, in units of its sigma
XY_NM = np.arange(380.0, 781.0, 1.0)
# The CIE 1931 colour matching functions x, y and z (2 degrees), each a sum of Gaussians with two
# sides (Wyman, Sloan and Shirley 2013, JCGT 2, 1). Of each Gaussian: its weight, its middle, nm,
# and 1 / sigma, 1/nm, below and above the middle.
MATCHING = (
    (
        (0.362, 442.0, 0.0624, 0.0374),
        (1.056, 599.8, 0.0264, 0.0323),
        (-0.065, 501.1, 0.0490, 0.0382),
    ),
    ((0.821, 568.8, 0.0213, 0.0247), (0.286, 530.9, 0.0613, 0.0322)),
    ((1.217, 437.0, 0.0845, 0.0278), (0.681, 459.0, 0.0385, 0.0725)),
)


@dataclass(frozen=True, slots=True)
class ChannelMatrix:
    """`e_per_s` (channels, 3): the electrons per second that each primary (r, g, b) of one pixel at
    full light causes in each of `channels`.

    `condition` is the matrix's condition number: the factor by which a relative error of the
    channels' light may grow in the primaries' light. It is None where two channels, or two
    primaries, have the same colour.
    """

    channels: tuple[str, ...]
    e_per_s: FloatArray
    condition: float | None


def read_primaries(path: Path) -> tuple[Curve, ...]:
    """The spectra of red, green and blue from a CSV file (columns wavelength_nm, r, g, b) or a
    .ccss: power per nm, all three in one arbitrary unit, and zero outside the file's wavelengths.

    Raises InputError for a file that is neither, wavelengths that do not rise, power below 0 and a
    primary without light.
    """
    if path.suffix.lower() == ".ccss":
        return read_ccss(path)
    rows: list[list[float]] = []
    last_nm = -np.inf
    for line, cells in read_rows(path, COLUMNS, ADVICE, MAX_CURVE_BYTES):
        row = finite_numbers(path, line, COLUMNS, cells[: len(COLUMNS)], ADVICE)
        row_nm, *row_power = row
        if min(row_power) < 0 or not RANGE_NM[0] < row_nm < RANGE_NM[1]:
            raise InputError(
                f"{path}:{line}: power below 0, or a wavelength that is not in nm; {ADVICE}"
            )
        if row_nm <= last_nm:
            raise InputError(
                f"{path}:{line}: wavelengths do not rise from row to row; sort them, each once"
            )
        rows.append(row)
        last_nm = row_nm
    nm, *power = np.array(rows).reshape(-1, len(COLUMNS)).T
    if len(rows) > 1:
        refuse_other_units(path, float(nm[0]), float(nm[-1]))
    dark = [name for name, light in zip(PRIMARIES, power, strict=True) if not light.any()]
    if dark:
        raise InputError(f"{path}: {len(rows)} rows, and no light of {', '.join(dark)}; {ADVICE}")
    return _curves(nm, np.array(power))


def _curves(nm: FloatArray, power: FloatArray) -> tuple[Curve, ...]:
    """A curve for each row of `power` (curves, n) at the wavelengths `nm` (n,), zero outside
    them.
    """
    # A curve is linear between its knots, so zeros stand at the next numbers outside `nm`.
    first, last = np.nextafter(nm[[0, -1]], [0.0, np.inf])
    knots = np.concatenate([[RANGE_NM[0], first], nm, [last, RANGE_NM[1]]])
    return tuple(Curve(knots, np.pad(channel_power, 2)) for channel_power in power)


def read_ccss(path: Path) -> tuple[Curve, ...]:
    """The spectra of red, green and blue from an ArgyllCMS .ccss (CGATS text): the three samples of
    which all other samples are mixtures.

    Of several samples of one colour, the brightest is the primary. Red is the primary with the
    longest mean wavelength, blue the one with the shortest. Raises InputError for another file, and
    where no three samples mix to the others, as with a panel that has a fourth subpixel.
    """
    nm, samples = _samples(path)
    power = samples.sum(axis=1)
    lit = samples[power > DARK_SHARE * power.max()]
    if len(lit) < 3:
        raise InputError(
            f"{path}: {len(lit)} samples with light, where three primaries are wanted;"
            f" {CCSS_ADVICE}"
        )
    size = np.linalg.norm(lit, axis=1)
    colours = lit / size[:, None]
    together = colours @ colours.T
    fits = []
    for candidates in itertools.combinations(range(len(lit)), 3):
        fit = _fit(together, list(candidates))
        if fit is not None:
            fits.append(fit)
    nearest = min([fit.worst for fit in fits], default=1.0)
    if nearest > MIXED_WITHIN:
        raise InputError(
            f"{path}: no three of its {len(lit)} samples are primaries of which the others are"
            f" mixtures (the nearest leave {100 * nearest:.0f} % of one): a white subpixel, or"
            f" samples of several displays; {CCSS_ADVICE}"
        )
    # Brighter and dimmer samples of one colour fit alike but for noise: of the fits within
    # MIXED_WITHIN squared of the best, the brightest counts.
    near_best = [fit for fit in fits if fit.worst <= nearest + MIXED_WITHIN**2]
    best = max(near_best, key=lambda fit: float(lit[fit.samples].sum()))
    drive = best.mixtures * size[:, None] / size[best.samples]
    if drive.max() > 1 + MAX_EXCESS:
        raise InputError(
            f"{path}: a sample has {drive.max():.2f} times the light of its primaries: a white"
            f" subpixel, as of a panel that is no sum of red, green and blue; {CCSS_ADVICE}"
        )
    primaries = lit[best.samples]
    mean_nm = (primaries @ nm) / primaries.sum(axis=1)
    return _curves(nm, primaries[np.argsort(-mean_nm)])


class _Fit(NamedTuple):
    """Three samples, by their indices `samples`, tried as primaries. `mixtures` (n, 3) are their
    amounts that come nearest to each of the n samples of norm 1; `worst` is the largest residual.
    """

    samples: list[int]
    mixtures: FloatArray
    worst: float


def _fit(together: FloatArray, samples: list[int]) -> _Fit | None:
    """The fit with three samples as primaries, from the inner products `together` (n, n) of all
    samples of norm 1; None where one of the three is nearly a mixture of the other two.
    """
    gram = together[np.ix_(samples, samples)]
    # The determinant is the square of their volume. Colours within MIXED_WITHIN of each other, by
    # which a mixture may be off, span its square at most.
    if np.linalg.det(gram) <= MIXED_WITHIN**4:
        return None
    wanted = together[:, samples]
    mixtures = nearest_mixtures(gram, wanted)
    # |sample - mixture|^2, of samples of norm 1
    across = (mixtures * wanted).sum(axis=1)
    squares = np.einsum("ni,ij,nj->n", mixtures, gram, mixtures)
    off = 1 - 2 * across + squares
    return _Fit(samples, mixtures, math.sqrt(max(float(off.max()), 0.0)))


def _samples(path: Path) -> tuple[FloatArray, FloatArray]:
    """The wavelengths (bands,), nm, and the spectra (samples, bands) of a .ccss. Raises InputError
    for text that is no .ccss, or a table that does not fit its header.
    """
    text = named_text(path, CCSS_ADVICE, MAX_CURVE_BYTES)
    if not text.lstrip().startswith("CCSS"):
        raise InputError(f"{path}: its first word is not CCSS; {CCSS_ADVICE}")
    try:
        head, _, rest = text.partition("BEGIN_DATA_FORMAT")
        names, _, rest = rest.partition("END_DATA_FORMAT")
        keys: dict[str, str] = {}
        for line in head.splitlines():
            key_and_value = shlex.split(line, comments=True)
            if len(key_and_value) == 2:
                keys[key_and_value[0]] = key_and_value[1]
        first = float(keys["SPECTRAL_START_NM"])
        last = float(keys["SPECTRAL_END_NM"])
        nm = np.linspace(first, last, int(keys["SPECTRAL_BANDS"]))
        fields = names.split()
        spectral = [k for k, name in enumerate(fields) if name.startswith("SPEC_")]
        _, _, data = rest.partition("BEGIN_DATA")
        cells = data.partition("END_DATA")[0].split()
        table = np.array(cells).reshape(-1, len(fields))
        samples = table[:, spectral].astype(np.float64)
        good = (
            len(spectral) == len(nm) > 1
            and RANGE_NM[0] < first < last < RANGE_NM[1]
            and np.isfinite(samples).all()
        )
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: {error} is wrong or missing; {CCSS_ADVICE}") from error
    if not good or not 0 < len(samples) <= MAX_SAMPLES:
        raise InputError(f"{path}: {len(samples)} samples of {len(spectral)} bands; {CCSS_ADVICE}")
    # a spectrometer's noise takes dark bands below 0, where no light can be
    return nm, np.maximum(samples, 0.0)


def chromatic_primaries(xy: Sequence[tuple[float, float]], fwhm_nm: float) -> tuple[Curve, ...]:
    """Gaussian spectra of width `fwhm_nm` whose CIE 1931 chromaticities are nearest to `xy` of red,
    green and blue, in such amounts that all three together are D65 white.

    Raises InputError where no Gaussian is within FAR_XY of one of them, and where D65 is not within
    their triangle.
    """
    matching = np.array([_matching_function(lobes) for lobes in MATCHING])
    middles_nm = np.arange(XY_NM[0], XY_NM[-1], 0.25)
    away_nm = XY_NM - middles_nm[:, None]
    spectra = np.exp(-(away_nm**2) / 2 * (FWHM_SIGMAS / fwhm_nm) ** 2)
    tristimulus = spectra @ matching.T
    total = tristimulus.sum(axis=1, keepdims=True)
    spectra_xy = (tristimulus / total)[:, :2]
    chosen = []
    for name, wanted in zip(PRIMARIES, xy, strict=True):
        off = np.hypot(*(spectra_xy - wanted).T)
        nearest = int(np.argmin(off))
        chosen.append(nearest)
        if off[nearest] > FAR_XY:
            near = ", ".join(f"{value:.3f}" for value in spectra_xy[nearest])
            raise InputError(
                f"[monitor.primaries] xy_{name} = {list(wanted)}: the nearest Gaussian of"
                f" {fwhm_nm:g} nm has [{near}]; write another width_nm, or measured spectra as file"
            )
    white_x, white_y = D65_XY
    white = np.array([white_x, white_y, 1 - (white_x + white_y)]) / white_y
    if len(set(chosen)) == len(chosen):
        amounts = np.linalg.solve(tristimulus[chosen].T, white)
    else:
        amounts = np.zeros(3)
    if not (amounts > 0).all():
        raise InputError(
            "[monitor.primaries] xy_r, xy_g and xy_b: D65 is not within their triangle; write those"
            " of r, g and b"
        )
    primaries = spectra[chosen] * amounts[:, None]
    return _curves(XY_NM, primaries)


def _matching_function(lobes: Sequence[tuple[float, float, float, float]]) -> FloatArray:
    """A colour matching function at XY_NM (n,), the sum of lobes (weight, middle in nm, and the
    inverse of sigma, 1/nm, below and above the middle).
    """
    values = np.zeros(len(XY_NM))
    for weight, middle_nm, below, above in lobes:
        values += weight * _lobe(middle_nm, below, above)
    return values


def _lobe(middle_nm: float, below: float, above: float) -> FloatArray:
    """A Gaussian of height 1 at XY_NM (n,), with one inverse sigma, 1/nm, below its middle and
    another above it.
    """
    away_nm = XY_NM - middle_nm
    inverse_sigma = np.where(away_nm < 0, below, above)
    sigmas = away_nm * inverse_sigma
    return np.asarray(np.exp(-(sigmas**2) / 2))


def reddest_nm(primaries: Sequence[Curve], least: float = 0.01) -> float:
    """The longest wavelength, nm, at which any primary has more than `least` of its largest
    power.
    """
    longest_nm = []
    for curve in primaries:
        is_lit = curve.value > least * curve.value.max()
        longest_nm.append(float(curve.wavelength_nm[is_lit].max()))
    return max(longest_nm)


def channel_matrix(
    primaries: Sequence[Curve], channels: Mapping[str, Optics], white_e_per_s: float
) -> ChannelMatrix:
    """The matrix of a monitor and a tracker, scaled so that the sum of its entries, a white pixel's
    electrons per second in all channels together, is `white_e_per_s`.

    An entry is in proportion to the integral of power, quantum efficiency, transmission and
    wavelength; the wavelength turns power into photons. Raises InputError where the tracker detects
    none of the primaries' light.
    """
    matrix = np.empty((len(channels), len(primaries)))
    for row, optics in enumerate(channels.values()):
        matrix[row] = [_electrons(primary, optics) for primary in primaries]
    if not matrix.any():
        raise InputError(
            "[monitor.primaries] file: the tracker detects none of this light; check that both are"
            " in nm"
        )
    condition = None
    if np.linalg.matrix_rank(matrix) == min(matrix.shape):
        condition = float(np.linalg.cond(matrix))
    scale = white_e_per_s / matrix.sum()
    return ChannelMatrix(tuple(channels), matrix * scale, condition)


def _electrons(primary: Curve, optics: Optics) -> float:
    """A primary's electrons in a channel, in arbitrary units: the integral of its detected
    photons.
    """
    curves = primary, optics.quantum_efficiency, optics.transmission
    nm, weight = integration_nodes(*curves)
    detected = np.prod([curve(nm) for curve in curves], axis=0)
    return float(detected * nm @ weight)


def nearest_mixtures(gram: FloatArray, wanted: FloatArray, *, whole: bool = False) -> FloatArray:
    """The amounts s (n, 3) of three parts, none below 0, that minimise s gram s - 2 s wanted:
    non-negative least squares from inner products.

    `gram` (3, 3) are the inner products of the three parts with each other, `wanted` (n, 3) those
    of the parts with each of n vectors to mix. With `whole` the amounts of a mixture add up to 1.
    Every set of parts is tried; the best without a negative amount is the solution.
    """
    scale = np.trace(gram)
    gram = gram / scale
    wanted = wanted / scale
    best = np.zeros_like(wanted)
    # No light at all costs 0. A mixture that must add up to 1 cannot be that.
    least = np.full(len(wanted), np.inf if whole else 0.0)
    for parts in _sets_of(len(gram)):
        mixtures = np.zeros_like(wanted)
        mixtures[:, parts] = _mixtures_of(gram[np.ix_(parts, parts)], wanted[:, parts], whole)
        squares = np.einsum("ni,ij,nj->n", mixtures, gram, mixtures)
        cost = squares - 2 * (mixtures * wanted).sum(axis=1)
        better = (mixtures.min(axis=1) >= 0) & (cost < least)
        best[better] = mixtures[better]
        least[better] = cost[better]
    return best


def _sets_of(count: int) -> Iterator[list[int]]:
    """Every set of indices below `count` except the empty one, smaller sets first."""
    for size in range(1, count + 1):
        yield from map(list, itertools.combinations(range(count), size))


def _mixtures_of(gram: FloatArray, wanted: FloatArray, whole: bool) -> FloatArray:
    """The amounts (n, k), of any sign, of k parts by linear least squares. With `whole` a Lagrange
    multiplier makes each mixture's amounts add up to 1.
    """
    size = len(gram)
    if whole:
        ones = np.ones((size, 1))
        gram = np.block([[gram, ones], [ones.T, np.zeros((1, 1))]])
        wanted = np.column_stack([wanted, np.ones(len(wanted))])
    inverse = np.linalg.pinv(gram, rcond=SINGULAR)
    return np.asarray((wanted @ inverse.T)[:, :size])
