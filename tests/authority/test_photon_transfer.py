"""The detector, measured as a laboratory would: photon transfer (Janesick 2007; EMVA 1288), and
Poisson's own law.

Nothing here looks inside the detector: flats, darks and bias frames go in, gain, noise and
non-uniformity come out.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from hilstar.basics.arrays import FloatArray
from hilstar.tracker.detector import Detector
from hilstar.tracker.settings import MAX_E, DetectorSettings

SIZE_PX = (256, 256)
SHAPE = (256, 256)
PIXELS = 256 * 256
ROUNDING_DN2 = 1 / 12  # the variance of an error that is even over one DN
LEVELS_E = np.array([500.0, 2000.0, 5000.0, 10_000.0, 20_000.0, 30_000.0])
FRAMES = 8  # per level, for maps

# The issue's own limits. What the estimators below can do, with these frames:
# - gain: a variance from 4 times 65536 differences is good to sqrt(2 / 262144) = 0.28 %, the mean
#   of 6 levels to 0.11 %:
#   a margin of 9 sigmas.
# - read noise: half of the relative error of the variance, 0.14 %, and the gain's 0.11 %: a margin
#   of 28.
# - PRNU, DSNU: 65536 pixels, 1 / sqrt(2 * 65536) = 0.28 %, and the subtraction of the noise left in
#   the mean of 8 frames
#   (PRNU at 30 000 e-: 61^2 against 900^2), nothing: a margin of 18.
# - dark current: the mean of 65536 pixels that scatter by DSNU / dark = 30 %: 0.12 %, a margin
#   of 40.
GAIN_TOLERANCE = 0.01
READ_NOISE_TOLERANCE = 0.05
PRNU_TOLERANCE = 0.05
DARK_TOLERANCE = 0.05
DSNU_TOLERANCE = 0.05

# A sensor like the thesis's CCD47-20 (table 4.2), with a finer ADC: at 24 e-/DN, 2 e- of read noise
# are 0.08 DN, which
# no photon transfer can see under rounding.
CCD = DetectorSettings(
    gain_e_per_dn=1.5,
    bits=16,
    offset_dn=200.0,
    read_noise_e=6.0,
    prnu=0.03,
    dark_e_per_s=203.0,
    dsnu_e_per_s=60.0,
    device_seed=47,
)


def frames_dn(
    detector: Detector, level_e: float, exposure_s: float, rng: np.random.Generator
) -> FloatArray:
    """FRAMES exposures, shape (FRAMES, height, width)."""
    return np.array(
        [detector.expose(np.full(SHAPE, level_e), exposure_s, rng) for _ in range(FRAMES)],
        dtype=np.float64,
    )


def temporal_variance(frames: FloatArray) -> float:
    """Half of the mean variance of differences of pairs: the fixed pattern cancels."""
    return float(np.mean((frames[::2] - frames[1::2]).var(axis=(1, 2))) / 2)


def spatial_variance(frames: FloatArray) -> float:
    """The variance over pixels of the mean frame, less the noise that is left in it."""
    return float(frames.mean(axis=0).var() - temporal_variance(frames) / len(frames))


def photon_transfer(settings: DetectorSettings, seed: int) -> dict[str, float]:
    """Gain (e-/DN), read noise (e-) and PRNU of a sensor, from bias frames and flats."""
    detector, rng = Detector(settings, SIZE_PX), np.random.default_rng(seed)
    bias = frames_dn(detector, 0.0, 0.0, rng)
    flats = [frames_dn(detector, level, 0.0, rng) for level in LEVELS_E]
    mean_dn = np.array([flat.mean() - bias.mean() for flat in flats])
    variance_dn2 = np.array([temporal_variance(flat) - temporal_variance(bias) for flat in flats])
    # Least squares through the origin, each level weighted by 1 / variance^2 ~ 1 / mean^2.
    gain_e_per_dn = 1 / np.mean(variance_dn2 / mean_dn)
    return {
        "gain_e_per_dn": float(gain_e_per_dn),
        "read_noise_e": float(gain_e_per_dn * math.sqrt(temporal_variance(bias) - ROUNDING_DN2)),
        "prnu": math.sqrt(spatial_variance(flats[-1])) / float(mean_dn[-1]),
    }


def dark_frames(settings: DetectorSettings, exposure_s: float, seed: int) -> dict[str, float]:
    """Dark current and DSNU (e-/s) of a sensor, from bias and dark frames; the gain is taken as
    known.
    """
    detector, rng = Detector(settings, SIZE_PX), np.random.default_rng(seed)
    bias, dark = (frames_dn(detector, 0.0, seconds, rng) for seconds in (0.0, exposure_s))
    e_per_s = settings.gain_e_per_dn / exposure_s
    return {
        "dark_e_per_s": float(dark.mean() - bias.mean()) * e_per_s,
        "dsnu_e_per_s": math.sqrt(spatial_variance(dark)) * e_per_s,
        "dark_shot_noise_e": (
            math.sqrt(temporal_variance(dark) - temporal_variance(bias)) * settings.gain_e_per_dn
        ),
    }


@pytest.mark.parametrize("gain_e_per_dn", [1.5, 6.0])
def test_photon_transfer_finds_gain_read_noise_and_prnu(gain_e_per_dn):
    settings = DetectorSettings(
        gain_e_per_dn=gain_e_per_dn, bits=16, offset_dn=200.0, read_noise_e=6.0, prnu=0.03
    )
    found = photon_transfer(settings, seed=1)
    assert found["gain_e_per_dn"] == pytest.approx(gain_e_per_dn, rel=GAIN_TOLERANCE)
    assert found["read_noise_e"] == pytest.approx(6.0, rel=READ_NOISE_TOLERANCE)
    assert found["prnu"] == pytest.approx(0.03, rel=PRNU_TOLERANCE)


def test_dark_frames_find_dark_current_and_dsnu():
    found = dark_frames(CCD, exposure_s=20.0, seed=2)
    assert found["dark_e_per_s"] == pytest.approx(203.0, rel=DARK_TOLERANCE)
    assert found["dsnu_e_per_s"] == pytest.approx(60.0, rel=DSNU_TOLERANCE)
    # Dark is Poisson: its noise is the root of its 4060 e-.
    assert found["dark_shot_noise_e"] == pytest.approx(math.sqrt(203.0 * 20.0), rel=GAIN_TOLERANCE)


def test_dsnu_grows_with_exposure_as_a_rate_does():
    # With the source's sqrt(I t) the rate would fall by sqrt 20 from the first to the second.
    short, long = (
        dark_frames(CCD, exposure_s, seed=3)["dsnu_e_per_s"] for exposure_s in (1.0, 20.0)
    )
    assert short == pytest.approx(long, rel=DSNU_TOLERANCE)


def test_prnu_is_proportional_to_the_signal():
    detector, rng = Detector(CCD, SIZE_PX), np.random.default_rng(4)
    bias_dn = CCD.offset_dn
    for level_e in (5000.0, 30_000.0):
        flats = frames_dn(detector, level_e, 0.0, rng)
        assert math.sqrt(spatial_variance(flats)) / (flats.mean() - bias_dn) == pytest.approx(
            0.03, rel=PRNU_TOLERANCE
        )


def test_the_adc_of_the_thesis_hides_its_read_noise():
    # 2 e- at 24 e-/DN: the offset decides whether a bias frame shows any noise at all. At a half DN
    # it is two codes.
    thesis = {"gain_e_per_dn": 24.0, "read_noise_e": 2.0}
    for offset_dn, codes in ((100.0, {100}), (100.5, {100, 101})):
        bias = Detector(DetectorSettings(offset_dn=offset_dn, **thesis), SIZE_PX).expose(
            np.zeros(SHAPE), 0.0, np.random.default_rng(5)
        )
        assert set(np.unique(bias)) == codes


@pytest.mark.parametrize("mean_e", [0.3, 4.0, 25.0, 400.0])
def test_electron_counts_follow_poissons_law(mean_e):
    detector = Detector(DetectorSettings(gain_e_per_dn=1.0, dark_e_per_s=mean_e / 2), SIZE_PX)
    counts = np.bincount(
        detector.expose(np.full(SHAPE, mean_e / 2), 1.0, np.random.default_rng(6)).ravel()
    )
    probability = stats.poisson.pmf(np.arange(len(counts)), mean_e)
    # Chi squared needs some 5 counts a bin: the tails are pooled into one.
    whole = probability * PIXELS >= 5
    observed = np.append(counts[whole], counts[~whole].sum())
    expected = np.append(probability[whole], 1 - probability[whole].sum()) * PIXELS
    # Chance alone falls under this once in 1000 seeds; a rounded normal law gives 1e-64 at 25.
    assert stats.chisquare(observed, expected).pvalue > 1e-3


def test_the_sampler_keeps_poissons_moments_up_to_the_largest_mean_that_is_taken():
    # MAX_E is a claim about numpy's sampler, and 16 bits cannot show 1e12 +- 1e6: so the sampler
    # itself is asked.
    counts = np.random.default_rng(7).poisson(np.full(PIXELS, MAX_E)) - MAX_E
    sigma_e = math.sqrt(MAX_E)
    assert abs(counts.mean()) < 5 * sigma_e / math.sqrt(PIXELS)
    assert counts.std() == pytest.approx(sigma_e, rel=5 / math.sqrt(2 * PIXELS))
    # The law's own skewness and excess kurtosis are 1e-6 and 1e-12; these are 5 errors of their
    # estimates.
    assert abs(stats.skew(counts)) < 5 * math.sqrt(6 / PIXELS)
    assert abs(stats.kurtosis(counts)) < 5 * math.sqrt(24 / PIXELS)
