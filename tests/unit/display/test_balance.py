"""How `exact` weighs pixels: a tracker's boxes by SciPy's Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm, truncnorm

from hilstar.display.balance import Balance, Seen, Weights
from hilstar.optics.psf import GaussianPsf

BLUR_PX = 0.6
AWAY_PX = np.arange(6.0)


@pytest.mark.parametrize("pixel_px", [1.0, 2.0])
@pytest.mark.parametrize("side", [3, 5])
def test_a_pixel_is_in_a_box_as_far_as_its_blurred_light_is(side, pixel_px):
    balance = Balance(GaussianPsf((0.85, 0.7)), Seen(BLUR_PX, pixel_px))
    half_px = side * pixel_px / 2
    edges = (AWAY_PX + half_px) / BLUR_PX, (AWAY_PX - half_px) / BLUR_PX
    along = norm.cdf(edges[0]) - norm.cdf(edges[1])
    found = balance.in_box(side, AWAY_PX, np.full(6, 1.0))
    np.testing.assert_allclose(found, along * along[1], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("pixel_px", [1.0, 2.0])
@pytest.mark.parametrize("side", [3, 5])
def test_a_centre_of_mass_follows_its_box_as_a_truncated_gaussian_s_mean_does(side, pixel_px):
    psf = GaussianPsf((0.85, 0.7))
    balance = Balance(psf, Seen(BLUR_PX, pixel_px))
    step, wanted = 1e-4, []
    for variance_px2 in psf.variance_px2:
        half = side * pixel_px / 2 / np.sqrt(variance_px2 + BLUR_PX**2)
        means = [truncnorm.mean(off - half, off + half) for off in (-step, step)]
        wanted.append((means[1] - means[0]) / (2 * step))
    assert balance.follows(side) == pytest.approx(wanted, rel=1e-5)


def test_the_window_is_as_wide_as_the_star_and_some_of_the_blur_along_either_axis():
    balance = Balance(GaussianPsf((0.85, 0.5)), Seen(2.0), Weights(window_blurs=0.5))
    # the variances of the Gaussian, of a pixel, and half of the blur's
    wanted = np.sqrt([0.85**2 + 1 / 12 + 2.0, 0.5**2 + 1 / 12 + 2.0])
    assert balance.window_px == pytest.approx(wanted)
