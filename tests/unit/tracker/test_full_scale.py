"""What a pixel holds at most and at least: full wells, an ADC's codes, gains, dark currents and
the noise before rounding, each on both sides of its limit.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import norm

from hilstar.tracker.centroids import CLIPPED_SIGMA, estimate_background
from hilstar.tracker.detector import Detector
from hilstar.tracker.mosaic import uneven_dark_dn
from hilstar.tracker.rounding import before_adc_dn
from hilstar.tracker.settings import DetectorSettings

SIZE_PX = (256, 192)
PIXELS = 256 * 192
SIGMAS = 5.0  # of a share's own error; the seeds are fixed


@pytest.mark.parametrize(
    ("bits", "gain_e_per_dn", "saturation_dn"),
    [
        (8, 1.0, 255.0),  # the last code; the well would give 1010 DN
        (12, 1.0, 1010.0),  # the well above the offset
        (8, 8.0, 135.0),
        (16, 0.01, 65_535.0),
    ],
)
def test_a_pixel_saturates_at_its_last_code_or_its_full_well(bits, gain_e_per_dn, saturation_dn):
    settings = DetectorSettings(
        bits=bits, gain_e_per_dn=gain_e_per_dn, offset_dn=10.0, full_well_e=1000.0
    )
    assert settings.saturation_dn == pytest.approx(saturation_dn)


@pytest.mark.parametrize(
    ("bits", "glow_e", "wanted_dn"),
    [
        (8, (0.0, 0.9), None),  # even within a DN
        (8, (0.0, 4.0), (20.0, 22.0)),
        (8, (400.0, 900.0), (220.0, 255.0)),  # the brighter part is beyond the last code
        (8, (500.0, 900.0), None),  # both are
        (12, (500.0, 900.0), (270.0, 470.0)),
    ],
)
def test_a_glow_is_uneven_by_what_the_adc_still_tells_apart(bits, glow_e, wanted_dn):
    """20 DN of offset and 2 electrons a DN."""
    detector = DetectorSettings(bits=bits, gain_e_per_dn=2.0, offset_dn=20.0)
    dark_dn = uneven_dark_dn(np.tile(glow_e, (3, 1)), detector)
    if wanted_dn is None:
        assert dark_dn is None
    else:
        assert dark_dn == pytest.approx(np.tile(wanted_dn, (3, 1)))


@pytest.mark.parametrize(
    ("variance_dn2", "stated_dn", "noise_dn"),
    [
        (0.05, 0.3, 0.0),  # less than rounding alone
        (0.2, 0.1, 0.1),
        (0.2, 0.9, math.sqrt(0.2 - 1 / 12)),
        (0.34, 0.1, math.sqrt(0.34 - 1 / 12)),  # more than any place between two codes gives
        (0.34, 0.9, math.sqrt(0.34 - 1 / 12)),
    ],
)
def test_the_noise_before_the_adc_is_the_smaller_where_readings_do_not_tell_it(
    variance_dn2, stated_dn, noise_dn
):
    assert before_adc_dn(variance_dn2, stated_dn) == pytest.approx(noise_dn)


@pytest.mark.parametrize(
    ("settings", "map_name", "mean", "sigma", "independent"),
    [
        (DetectorSettings(prnu=0.8), "gain_map", 1.0, 0.8, PIXELS),
        (
            DetectorSettings(dark_e_per_s=100.0, dsnu_e_per_s=80.0),
            "dark_map_e_per_s",
            100.0,
            80.0,
            PIXELS,
        ),
        (
            DetectorSettings(fixed_pattern="cmos", dark_e_per_s=100.0, column_dark_e_per_s=80.0),
            "dark_map_e_per_s",
            100.0,
            80.0,
            SIZE_PX[0],  # a column's pixels are alike
        ),
    ],
    ids=["gains", "dark currents", "columns"],
)
def test_what_a_normal_law_has_below_0_is_0(settings, map_name, mean, sigma, independent):
    values = getattr(Detector(settings, SIZE_PX), map_name)
    assert values.min() == 0.0
    share = norm.cdf(-mean / sigma)
    error = math.sqrt(share * (1 - share) / independent)
    assert (values == 0).mean() == pytest.approx(share, abs=SIGMAS * error)
    assert values.max() > mean + sigma


def test_noise_under_a_step_keeps_the_codes_on_both_sides_of_the_level():
    """Of 100 pixels 60 have code 10, 25 code 11 and 15 code 9: a median deviation of 0."""
    codes = np.repeat([9, 10, 11], [15, 60, 25]).astype(np.uint16).reshape(10, 10)
    background = estimate_background(codes)
    assert background.level == pytest.approx(10.1)
    assert background.noise == pytest.approx(math.sqrt(0.4 - 0.1**2) / CLIPPED_SIGMA)


def test_noise_is_at_least_that_of_rounding_where_there_are_steps():
    even = np.full((8, 8), 7, dtype=np.uint16)
    assert estimate_background(even).noise == pytest.approx(1 / math.sqrt(12))
    assert estimate_background(even, step=4.0).noise == pytest.approx(4 / math.sqrt(12))
    assert estimate_background(even.astype(float)).noise == 0.0
