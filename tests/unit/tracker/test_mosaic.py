"""A mosaic's pixels and what a tracker's software makes of them, pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.tracker.mosaic import (
    CHANNELS,
    in_pixels,
    luminance,
    of_colour,
    software_psf_px,
    uneven_dark_dn,
)
from hilstar.tracker.settings import DetectorSettings

SHAPE = (5, 6)


@pytest.mark.parametrize("bayer", ["rggb", "bggr", "grbg", "gbrg"])
def test_each_pixel_of_a_mosaic_has_the_light_of_its_own_colour(bayer):
    """Its colours are those of the top left 2 x 2 pixels, row by row, again and again."""
    rows, columns = np.indices(SHAPE)
    images = [100.0 * (k + 1) + 10 * rows + columns for k in range(3)]
    mosaic = in_pixels(iter(images), bayer)
    counts = np.zeros(SHAPE)
    for row, column in np.ndindex(SHAPE):
        colour = bayer[2 * (row % 2) + column % 2]
        assert mosaic[row, column] == images[CHANNELS.index(colour)][row, column]
    for channel in CHANNELS:
        for part in of_colour(bayer, channel):
            counts[part] += 1
    assert (counts == 1).all()
    assert in_pixels(iter(images[:1]), None) is images[0]


def test_luminance_is_of_the_four_superpixels_of_each_pixel_and_mirrors_the_edges():
    image = np.arange(30.0).reshape(SHAPE) ** 2
    mirrored = np.pad(image, 1, mode="reflect")  # without the edge itself once more
    wanted = np.zeros(SHAPE)
    for down in (0, 1):
        for right in (0, 1):
            for row, column in np.ndindex(2, 2):
                top, left = down + row, right + column
                wanted += mirrored[top : top + 5, left : left + 6] / 16
    assert luminance(image) == pytest.approx(wanted, rel=1e-12)


def test_a_star_in_the_software_s_image_is_wider_by_the_superpixels():
    """By second moments of a sampled Gaussian, whose sums are its integrals for such widths."""
    detector = DetectorSettings(bayer="rggb", solver_image="superpixel")
    sigma_px = (1.2, 1.9)
    rows, columns = np.indices((41, 41)) - 20
    star = np.exp(-(columns**2) / (2 * 1.2**2) - rows**2 / (2 * 1.9**2))
    seen = luminance(star)
    moments = [np.sqrt(np.average(at**2, weights=seen)) for at in (columns, rows)]
    assert software_psf_px(sigma_px, detector) == pytest.approx(moments, rel=1e-6)
    assert software_psf_px(sigma_px, DetectorSettings()) == sigma_px


@pytest.mark.parametrize(("glow_dn", "is_even"), [(0.5, True), (1.0, True), (1.5, False)])
def test_a_dark_screen_is_even_within_a_step_and_never_brighter_than_the_adc(glow_dn, is_even):
    detector = DetectorSettings()
    under_e = np.zeros((4, 6))
    under_e[1:3, 2:5] = glow_dn * detector.gain_e_per_dn
    dark_dn = uneven_dark_dn(under_e, detector)
    assert (dark_dn is None) is is_even
    bright_dn = uneven_dark_dn(1e9 * (under_e > 0), detector)
    assert bright_dn is not None
    assert bright_dn.max() == 2**detector.bits - 1
