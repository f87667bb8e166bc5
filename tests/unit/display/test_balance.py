"""How `exact` weighs pixels: a tracker's boxes by SciPy's Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm, truncnorm

from hilstar.display.balance import SUMS, Balance, Seen, Weights
from hilstar.optics.psf import GaussianPsf

BLUR_PX = 0.6
AWAY_PX = np.arange(6.0)
EIGHTH_POWER = 0.033  # the largest difference of (1 + u / 8)^-8 from exp(-u), at u = 2.1


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


def test_each_sum_has_its_own_weight_of_a_pixel_s_error(rng):
    """Light, moments about the star, both under a Gaussian window, and what two boxes about the
    nearest pixel make of them, along x and y.
    """
    balance = Balance(GaussianPsf((0.6, 1.1)), Seen(BLUR_PX))
    weights = balance.weights
    offset_px = rng.integers(-3, 4, (2, 7, 2)).astype(np.float32)
    fraction_px = np.array([[0.3, -0.45], [-0.2, 0.4]], dtype=np.float32)
    arms = balance.arms(offset_px, fraction_px, np.array([5.0, 200.0], dtype=np.float32))
    assert arms.shape == (SUMS, 7, 2)
    d = offset_px - fraction_px[:, None]
    sigma_px = np.array(balance.window_px)[:, None, None]
    window = np.exp(-0.5 * ((d / sigma_px) ** 2).sum(axis=0))
    few = 1 + weights.few_steps / np.array([5.0, 200.0])
    assert arms[0] == pytest.approx(np.broadcast_to(weights.light * few, (7, 2)))
    assert arms[1:3] == pytest.approx(weights.moments * d, rel=1e-6)
    assert arms[3] / weights.window_light == pytest.approx(window, abs=EIGHTH_POWER)
    assert arms[4:6] / weights.window_moments == pytest.approx(
        arms[3] / weights.window_light * d, rel=1e-5
    )
    # the nearest pixel is the star's own
    for first, side, weight in ((6, 3, weights.box_3), (8, 5, weights.box_5)):
        follows = np.array(balance.follows(side))[:, None, None] * fraction_px[:, None]
        wanted = weight * balance.in_box(side, *offset_px) * (d + follows)
        assert arms[first : first + 2] == pytest.approx(wanted, rel=1e-5, abs=1e-6)
