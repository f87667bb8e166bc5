"""What an ADC's rounding does to light where too little noise spreads a level over its steps.

A level that noise of 0.6 DN or more spreads is read right in the mean. With less noise, all pixels
of one light are rounded alike: their errors add up, and no number of images takes them away. They
follow from where the dark level is between two steps, which is not known. So they are taken at
STEP_PHASES places of it, and their spread over these is the error.
"""

import math

import numpy as np

from hilstar.basics.arrays import FloatArray

VARIANCE_DN2 = 1 / 12  # of the reading of a level that noise spreads over the steps, beside that noise
STEP_PHASES = 16  # places of a dark level between two steps
PLACES_DN = np.arange(STEP_PHASES)[:, None] / STEP_PHASES
HARMONICS = np.arange(1, 9)  # of the sawtooth that rounding is: eight hold 93 % of its variance
DITHERED_DN = 0.6  # of noise: the largest harmonic is then 3e-4 DN


def before_adc_dn(variance_dn2: float) -> float:
    """The noise of a pixel before the ADC, DN, by the variance of its readings."""
    return math.sqrt(max(variance_dn2 - VARIANCE_DN2, 0.0))


def rounding_error(level_dn: FloatArray, noise_dn: FloatArray) -> FloatArray:
    """The mean error of a level that is rounded to whole DN, with normal noise before the ADC, DN;
    all of one shape.

    The sawtooth of rounding by its harmonics, each of which noise damps (Widrow and Kollar,
    Quantization Noise, 2008).
    """
    total = np.zeros(np.broadcast_shapes(level_dn.shape, noise_dn.shape))
    for order in HARMONICS:
        damped = np.exp(-2 * (math.pi * order * noise_dn) ** 2)
        total += (-1) ** order / (math.pi * order) * np.sin(2 * math.pi * order * level_dn) * damped
    return total


def rounding_rms(noise_dn: float) -> float:
    """The rms of `rounding_error` over all levels, DN: 1 / sqrt 12 without noise."""
    damped = np.exp(-2 * (math.pi * HARMONICS * noise_dn) ** 2) / (math.pi * HARMONICS)
    return math.sqrt(float((damped**2).sum()) / 2)


def rounded_light(light_dn: FloatArray, dark_noise_dn: float, dn_per_e: float) -> FloatArray:
    """What rounding adds on average to pixels of `light_dn` (n,) above a dark frame,
    (STEP_PHASES,), DN.

    `dark_noise_dn` is the noise of a dark pixel before the ADC; light adds its shot noise, of
    variance `dn_per_e` a DN.
    """
    if dark_noise_dn > DITHERED_DN:
        return np.zeros(STEP_PHASES)
    noise_dn = np.sqrt(dark_noise_dn**2 + dn_per_e * light_dn)
    lit = rounding_error(PLACES_DN + light_dn, noise_dn)
    return np.asarray((lit - rounding_error(PLACES_DN, np.array(dark_noise_dn))).mean(axis=1))
