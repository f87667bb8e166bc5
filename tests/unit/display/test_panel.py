"""A monitor's light: of a part of its image, of dim pixels, as errors of stars in tiles, and in the
boxes of a tracker that sees no blur.
"""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
from scipy.stats import norm

from hilstar.display.balance import Balance, Seen
from hilstar.display.footprints import FootprintMap, star_losses_mag
from hilstar.display.panel import Panel
from hilstar.display.phases import measure
from hilstar.display.quantise import shown_light
from hilstar.display.response import Levels, gamma_response
from hilstar.optics.psf import GaussianPsf
from tests.support.stars import sprites_at

SHAPE = (6, 9)
PSF = GaussianPsf((0.85, 0.85))
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


def test_a_star_on_pixels_of_half_the_light_is_075_mag_fainter(rng):
    """The same codes on a panel whose pixels all have half of it; and by each pixel's own share."""
    size_px = (24, 20)
    sprites = sprites_at(np.array([[11.3, 9.6]]), np.array([5000.0]), PSF.footprint_px)
    levels = Levels(rng.integers(60, 200, size_px[::-1]).astype(np.uint8))
    footprints = FootprintMap(size_px, PSF)
    full = Panel(gamma_response(8, 2.2), 1000.0)
    half = replace(full, uniformity=np.full(size_px[::-1], 0.5, dtype=np.float32))
    losses = [float(star_losses_mag(sprites, one, footprints, levels)[0]) for one in (full, half)]
    assert losses[1] - losses[0] == pytest.approx(2.5 * np.log10(2))
    # only the left half of the image is dim: between the two
    uneven = half.uniformity.copy()
    uneven[:, 12:] = 1.0
    between = float(
        star_losses_mag(sprites, replace(full, uniformity=uneven), footprints, levels)[0]
    )
    assert losses[0] < between < losses[1]


@pytest.mark.parametrize("moved_px", [(1, 0), (0, 1), (2, 3)])
def test_errors_of_stars_in_tiles_are_those_along_both_axes(moved_px):
    """Of stars of one pixel, of which each is moved and half as bright: hypot of both, 0.75 mag."""
    tile, count = 9, 3
    wanted, shown = np.zeros((2, count * tile, count * tile))
    for row in range(count):
        for column in range(count):
            y, x = row * tile + 3, column * tile + 4
            wanted[y, x] = 10.0
            shown[y + moved_px[1], x + moved_px[0]] = 5.0
    errors = measure(wanted, shown, tile)
    off_px, off_mag = np.hypot(*moved_px), 2.5 * np.log10(2)
    assert astuple(errors) == pytest.approx((off_mag, off_mag, off_px, off_px))
