"""A monitor's light in a part of its image, and the pixels of a tracker that sees no blur."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from hilstar.display.balance import Balance, Seen
from hilstar.display.panel import Panel
from hilstar.display.quantise import shown_light
from hilstar.display.response import Levels, gamma_response
from hilstar.optics.psf import GaussianPsf

SHAPE = (6, 9)
PARTS = (np.s_[1:4, 2:7], np.s_[0:6, 8:9], np.s_[2:3, 0:9])


def panel_of(white_e_per_s: float, rng: np.random.Generator, primaries=()) -> Panel:
    uniformity = rng.uniform(0.5, 1.5, SHAPE).astype(np.float32)
    return Panel(gamma_response(8, 2.2), white_e_per_s, uniformity, primaries)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("channels", [1, 3])
def test_a_part_of_an_image_has_the_light_of_its_own_pixels(part, channels, rng):
    """Also where the primaries are driven apart, each with the light of its own pixels."""
    primaries = tuple(panel_of(white, rng) for white in (300.0, 600.0, 100.0)) * (channels == 3)
    panel = panel_of(1000.0, rng, primaries)
    shape = SHAPE if channels == 1 else (*SHAPE, 3)
    levels = Levels(rng.integers(0, 256, shape).astype(np.uint8))
    whole = shown_light(levels, panel)
    assert whole.shape == SHAPE
    np.testing.assert_array_equal(
        shown_light(Levels(levels[part]), panel.in_part(part)), whole[part]
    )


def test_a_box_without_blur_keeps_the_edge_of_a_pixel_that_lies_anywhere():
    """A quarter of a pixel, one sigma of a place that is not known within about one."""
    balance = Balance(GaussianPsf((0.85, 0.85)), Seen(0.0, 1.0))
    away_px = np.arange(4.0)
    along = norm.cdf((away_px + 1.5) / 0.25) - norm.cdf((away_px - 1.5) / 0.25)
    np.testing.assert_allclose(
        balance.in_box(3, away_px, np.zeros(4)), along * along[0], atol=1e-12
    )
