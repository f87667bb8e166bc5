"""What rounding and the lowest code do to a level in noise, by sums over the codes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.tracker.rounding import (
    STEP_PHASES,
    before_adc_dn,
    cut_light,
    cut_mean_dn,
    rounded_light,
    rounding_rms,
    uncut_level_dn,
)


def mean_code(level_dn: float, noise_dn: float) -> float:
    """The mean of a level in normal noise, rounded to codes from 0 on: each code by its share."""
    codes = np.arange(1, 100)
    above = 1 - ndtr((codes - 0.5 - level_dn) / noise_dn)
    return float(above.sum())


# With noise of 0.8 DN the first harmonic of rounding is 1e-6 DN; cut at 0 it is larger.
@pytest.mark.parametrize("level_dn", [-4.0, -1.0, 0.0, 0.7, 3.0])
@pytest.mark.parametrize("noise_dn", [1.0, 2.5])
def test_the_mean_of_what_is_cut_at_0_is_that_of_its_codes(level_dn, noise_dn):
    found = cut_mean_dn(np.array([level_dn]), np.array([noise_dn]))
    assert found == pytest.approx(mean_code(level_dn, noise_dn), abs=3e-3)


@pytest.mark.parametrize("sigmas", [-4.0, -2.0, 0.0, 3.0])
def test_a_level_is_found_again_by_the_mean_of_what_is_cut(sigmas):
    noise_dn = 2.0
    mean_dn = cut_mean_dn(np.array([sigmas * noise_dn]), np.array([noise_dn]))[0]
    assert uncut_level_dn(mean_dn, noise_dn) == pytest.approx(sigmas * noise_dn, abs=1e-6)


def test_the_dark_is_made_brighter_than_the_light():
    """Light of 8 DN on a dark level of 0 lifts it away from code 0."""
    noise_dn, light_dn, dn_per_e = 2.0, 8.0, 0.25
    dark_dn = mean_code(0.0, noise_dn)
    lit_dn = mean_code(light_dn, math.sqrt(noise_dn**2 + dn_per_e * light_dn))
    found = cut_light(np.array([light_dn]), dark_dn, noise_dn, dn_per_e)
    assert found == pytest.approx(lit_dn - dark_dn - light_dn, abs=3e-3) and found < -0.7


@pytest.mark.parametrize(
    ("variance_dn2", "stated_dn", "noise_dn"),
    [
        (0.3, 0.2, 0.2),  # a level half way between two codes has a quarter without any noise
        (0.3, 2.0, math.sqrt(0.3 - 1 / 12)),
        (1 / 12 + 1.0, 0.2, 1.0),
        (0.0, 2.0, 0.0),
    ],
)
def test_the_noise_before_the_adc_is_what_is_stated_where_readings_do_not_tell(
    variance_dn2, stated_dn, noise_dn
):
    assert before_adc_dn(variance_dn2, stated_dn) == pytest.approx(noise_dn)


def rounded_mean_dn(level_dn: float, noise_dn: float) -> float:
    """The mean of a level in normal noise, rounded to whole codes, by the share of each code."""
    codes = np.arange(-60, 61)
    edges = np.append(codes - 0.5, codes[-1] + 0.5)
    shares = np.diff(ndtr((edges - level_dn) / noise_dn))
    return float((codes * shares).sum())


# beyond the eighth harmonic: exp(-2 (9 pi 0.15)^2) / 9 pi of a DN
HARMONICS_DN = 1e-6


@pytest.mark.parametrize(("dark_noise_dn", "dn_per_e"), [(0.15, 0.002), (0.3, 0.05), (0.5, 1e-4)])
def test_what_rounding_adds_to_light_is_by_the_codes_of_both(dark_noise_dn, dn_per_e):
    """At each place of the dark level between two steps, beside what it adds to the dark."""
    light_dn = np.array([0.1, 0.35, 2.8, 7.45])
    noise_dn = np.sqrt(dark_noise_dn**2 + dn_per_e * light_dn)
    added = rounded_light(light_dn, dark_noise_dn, dn_per_e)
    assert len(added) == STEP_PHASES
    for place, found in enumerate(added.tolist()):
        dark_dn = place / STEP_PHASES
        lit = [
            rounded_mean_dn(dark_dn + light, noise) - dark_dn - light
            for light, noise in zip(light_dn.tolist(), noise_dn.tolist(), strict=True)
        ]
        wanted = np.mean(lit) - (rounded_mean_dn(dark_dn, dark_noise_dn) - dark_dn)
        assert found == pytest.approx(wanted, abs=HARMONICS_DN)


@pytest.mark.parametrize("noise_dn", [0.15, 0.3, 0.6])
def test_the_rms_of_rounding_is_that_over_all_levels(noise_dn):
    levels = (np.arange(400) + 0.5) / 400
    errors = [rounded_mean_dn(level, noise_dn) - level for level in levels.tolist()]
    assert rounding_rms(noise_dn) == pytest.approx(np.std(errors), rel=1e-5)
