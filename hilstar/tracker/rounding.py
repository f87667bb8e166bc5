"""What an ADC's rounding and its lowest code do to light.

Rounding counts where too little noise spreads a level over the ADC's steps.

A level that noise of 0.6 DN or more spreads is read right in the mean. With less noise, all pixels
of one light are rounded alike: their errors add up, and no number of images takes them away. They
follow from where the dark level is between two steps, which is not known. So they are taken at
STEP_PHASES places of it, and their spread over these is the error.

Without an offset the ADC cuts a dark pixel's noise off at code 0, which makes the dark brighter in
the mean; light on that pixel lifts it away from code 0.
"""

import math

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from hilstar.basics.arrays import FloatArray, IntArray

# of the reading of a level that noise spreads over the steps, beside that noise
VARIANCE_DN2 = 1 / 12
# Readings of a level half way between two codes have a variance of a quarter, without any noise: up
# to this, their variance does not tell the noise before the ADC.
AMBIGUOUS_DN2 = 1 / 4 + VARIANCE_DN2
STEP_PHASES = 16  # places of a dark level between two steps
PLACES_DN = np.arange(STEP_PHASES) / STEP_PHASES
HARMONICS = np.arange(1, 9)  # of the sawtooth that rounding is: eight hold 93 % of its variance
UNCUT_SIGMAS = 4.0  # of a dark level above code 0: what is cut off is under 1e-5 of the noise
DITHERED_DN = 0.6  # of noise: the largest harmonic is then 3e-4 DN


def before_adc_dn(variance_dn2: float, stated_dn: float) -> float:
    """The noise of a pixel before the ADC, DN, by the variance of its readings.

    Where that does not tell it, it is the noise that is stated, if that is smaller: the less noise,
    the larger is the error of rounding.
    """
    read_dn = math.sqrt(max(variance_dn2 - VARIANCE_DN2, 0.0))
    if variance_dn2 < AMBIGUOUS_DN2:
        return min(read_dn, stated_dn)
    return read_dn


def rounding_error(level_dn: FloatArray, noise_dn: FloatArray) -> FloatArray:
    """The mean error of a level that is rounded to whole DN, with normal noise before the ADC, DN;
    all of one shape.

    The sawtooth of rounding by its harmonics, each of which noise damps (Widrow and Kollar,
    Quantization Noise, 2008).
    """
    total = np.zeros(np.broadcast_shapes(level_dn.shape, noise_dn.shape))
    for order in HARMONICS:
        wave = _amplitude_dn(order) * np.sin(2 * math.pi * order * level_dn)
        total += wave * _damping(order, noise_dn)
    return total


def mean_rounding_error(
    places_dn: FloatArray, light_dn: FloatArray, noise_dn: FloatArray
) -> FloatArray:
    """The mean (m,) over pixels of `rounding_error`, DN: light (n,) with noise (n,) on a dark level
    at places (m,) between two steps.
    """
    total = np.zeros(len(places_dn))
    for order in HARMONICS:
        # sin(a + b) of a place and a pixel's light: sums over pixels are the same for all places
        turns_rad = 2 * math.pi * order * light_dn
        damping = _damping(order, noise_dn)
        cosine = float((damping * np.cos(turns_rad)).mean())
        sine = float((damping * np.sin(turns_rad)).mean())
        place_rad = 2 * math.pi * order * places_dn
        total += _amplitude_dn(order) * (np.sin(place_rad) * cosine + np.cos(place_rad) * sine)
    return total


def _amplitude_dn(order: np.intp) -> float:
    """The amplitude of a harmonic of rounding's sawtooth."""
    return float((-1) ** order / (math.pi * order))


def _damping(order: IntArray | np.intp, noise_dn: FloatArray | float) -> FloatArray:
    """What noise leaves of harmonics of rounding's sawtooth."""
    return np.asarray(np.exp(-2 * (math.pi * order * noise_dn) ** 2))


def rounding_rms(noise_dn: float) -> float:
    """The rms of `rounding_error` over all levels, DN: 1 / sqrt 12 without noise."""
    damped = _damping(HARMONICS, noise_dn) / (math.pi * HARMONICS)
    mean_square = float((damped**2).sum()) / 2
    return math.sqrt(mean_square)


def rounded_light(light_dn: FloatArray, dark_noise_dn: float, dn_per_e: float) -> FloatArray:
    """What rounding adds on average to pixels of `light_dn` (n,) above a dark frame,
    (STEP_PHASES,), DN.

    `dark_noise_dn` is the noise of a dark pixel before the ADC; light adds its shot noise, of
    variance `dn_per_e` a DN.
    """
    if dark_noise_dn > DITHERED_DN:
        return np.zeros(STEP_PHASES)
    noise_dn = np.sqrt(dark_noise_dn**2 + dn_per_e * light_dn)
    lit_dn = mean_rounding_error(PLACES_DN, light_dn, noise_dn)
    return lit_dn - rounding_error(PLACES_DN, np.array(dark_noise_dn))


def cut_mean_dn(level_dn: FloatArray, noise_dn: FloatArray) -> FloatArray:
    """The mean (n,) of levels (n,) with normal noise (n,), DN, rounded and cut off at 0.

    The last term is that of whole codes in place of a continuous level (Euler and Maclaurin).
    """
    ratio = level_dn / noise_dn
    density = np.exp(-(ratio**2) / 2) / math.sqrt(2 * math.pi)
    above_zero_dn = level_dn * ndtr(ratio) + noise_dn * density
    return np.asarray(above_zero_dn - density / noise_dn / 24)


def uncut_level_dn(mean_dn: float, noise_dn: float) -> float:
    """The level whose mean is `mean_dn` when its noise is cut off at 0, DN."""
    lowest_dn = -5.0 * noise_dn
    highest_dn = mean_dn + noise_dn

    def excess_dn(level_dn: float) -> float:
        mean = cut_mean_dn(np.array(level_dn), np.array(noise_dn))
        return float(mean) - mean_dn

    if excess_dn(lowest_dn) >= 0:  # darker than any level that is told apart
        return lowest_dn
    return float(brentq(excess_dn, lowest_dn, highest_dn))


def cut_light(light_dn: FloatArray, dark_mean_dn: float, noise_dn: float, dn_per_e: float) -> float:
    """What the cut at code 0 adds on average to pixels of `light_dn` (n,) above a dark frame, DN;
    below 0 where the dark is made brighter than the light.

    `dark_mean_dn` is the mean of the dark frame as it is read, `noise_dn` a dark pixel's noise
    before the ADC.
    """
    if noise_dn <= 0 or dark_mean_dn > UNCUT_SIGMAS * noise_dn:
        return 0.0
    dark_dn = uncut_level_dn(dark_mean_dn, noise_dn)
    spread_dn = np.sqrt(noise_dn**2 + dn_per_e * light_dn)
    level_dn = dark_dn + light_dn
    added_to_light_dn = cut_mean_dn(level_dn, spread_dn) - level_dn
    added_to_dark_dn = dark_mean_dn - dark_dn
    return float((added_to_light_dn - added_to_dark_dn).mean())
