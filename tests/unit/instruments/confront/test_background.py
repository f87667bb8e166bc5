"""The background of a photograph and the sources above it, each planted in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.instruments.confront.background import (
    CLIP,
    KERNEL_PX,
    PATTERN_CLIP,
    THRESHOLD,
    _quiet,
    _single,
    find_sources,
    is_round,
    sky_level,
    source_mask,
)
from tests.support.confrontations import sources_at

HIGH_PX, WIDE_PX = 200, 320
NOISE_DN = 6.0
STEP_DN = 1.0
# a block of 16 px has 256 pixels: its mean is known to 6/16 DN and its sigma to 1 part in 22
BLOCK_SIGMAS = 5.0


def plane(slope_x: float, slope_y: float) -> np.ndarray:
    y, x = np.mgrid[:HIGH_PX, :WIDE_PX]
    return 100.0 + slope_x * x + slope_y * y


def spot(shape, x_px: float, y_px: float, sigma_px, peak: float) -> np.ndarray:
    """A Gaussian, one sigma along x and along y."""
    along, across = sigma_px
    y, x = np.indices(shape)
    return peak * np.exp(-(((x - x_px) / along) ** 2 + ((y - y_px) / across) ** 2) / 2)


@pytest.mark.parametrize("slopes", [(0.05, 0.0), (0.0, -0.05)])
def test_a_plane_is_its_own_sky_to_the_corners(slopes):
    """Along an axis: a corner that is above both of its neighbours by more than noise is a star's."""
    level = sky_level(plane(*slopes), STEP_DN).level
    assert level == pytest.approx(plane(*slopes), abs=1e-6)


def test_noise_is_that_of_the_pixels_and_never_under_a_step_s_own(rng):
    dn = plane(0.0, 0.0) + NOISE_DN * rng.standard_normal((HIGH_PX, WIDE_PX))
    sky = sky_level(dn, STEP_DN)
    assert np.median(sky.noise) == pytest.approx(NOISE_DN, rel=0.02)
    assert np.std(sky.above(dn)) == pytest.approx(1.0, rel=0.03)
    flat = sky_level(plane(0.0, 0.0), 2.0)
    # a uniform distribution's
    assert flat.noise == pytest.approx(2.0 / np.sqrt(12))
    assert flat.above(plane(0.0, 0.0) + 2.0) == pytest.approx(np.sqrt(12))


def test_a_block_full_of_a_star_s_light_is_as_its_neighbours(rng):
    dn = plane(0.0, 0.0) + NOISE_DN * rng.standard_normal((HIGH_PX, WIDE_PX))
    star = spot(dn.shape, 168.0, 104.0, (4.0, 4.0), 3000.0)
    sky = sky_level(dn + star, STEP_DN)
    assert sky.block_px == 16
    assert abs(sky.level[104, 168] - 100.0) < BLOCK_SIGMAS * NOISE_DN / 16
    assert sky.noise[104, 168] < 1.5 * NOISE_DN


def test_sources_come_by_their_peak_and_their_size():
    """A wide one of a third of the peak before a narrow one, but after one of eight times its
    peak.
    """
    size_px = (120, 160)
    dn = spot(size_px, 40.0, 30.0, (1.0, 1.0), 60.0) + spot(size_px, 20.0, 90.0, (1.0, 1.0), 400.0)
    dn += spot(size_px, 100.0, 80.0, (4.0, 4.0), 25.0)
    found = find_sources(dn)
    assert np.rint(found.places_px).tolist() == [[20, 90], [100, 80], [40, 30]]
    bright, wide, narrow = found.snr
    assert bright > narrow > wide


@pytest.mark.parametrize(
    ("size_px", "block_px"), [((100, 150), 16), ((360, 500), 30), ((780, 780), 64)]
)
def test_a_block_is_a_twelfth_of_the_shorter_side_in_bounds(size_px, block_px):
    assert sky_level(np.zeros(size_px), 1.0).block_px == block_px


def test_a_source_s_place_and_signal_are_those_of_its_smoothed_light():
    """A Gaussian convolved with the kernel is one of the summed variances; noise of one sigma a
    pixel is one sigma again where it is divided by the root of the kernel's squares, 1 over
    2 sqrt(pi) sigma.
    """
    sigma_px, peak = 1.5, 40.0
    dim = spot((60, 90), 20.0, 40.0, (sigma_px, sigma_px), peak / 2)
    found = find_sources(dim + spot((60, 90), 61.0, 15.0, (sigma_px, sigma_px), peak))
    assert found.places_px == pytest.approx(np.array([[61.0, 15.0], [20.0, 40.0]]), abs=1e-3)
    smoothed = peak * sigma_px**2 / (sigma_px**2 + KERNEL_PX**2)
    expected = smoothed * 2 * np.sqrt(np.pi) * KERNEL_PX
    assert found.snr == pytest.approx([expected, expected / 2], rel=1e-3)
    # pixels above half of a Gaussian's peak lie in a circle of 2.355 sigmas across; by whole pixels
    fwhm_px = 2.355 * np.hypot(sigma_px, KERNEL_PX)
    assert found.fwhm_px == pytest.approx(fwhm_px, rel=0.05)
    assert found.length_px == pytest.approx(found.width_px)
    assert not found.single.any()
    assert not found.trail.any()


@pytest.mark.parametrize("turned", [False, True])
def test_a_long_thin_source_is_a_trail_along_either_axis(turned):
    """A bar of one pixel's width, whose smoothed light is 40 px and its kernel's wings long."""
    dn = np.zeros((80, 80))
    dn[30, 20:60] = 30.0
    found = find_sources(dn.T if turned else dn)
    place = [30.0, 39.5] if turned else [39.5, 30.0]
    assert found.places_px == pytest.approx(np.array([place]), abs=1e-3)
    assert 40 < found.length_px[0] < 48
    assert found.width_px[0] < 8
    assert found.trail.tolist() == [True]


@pytest.mark.parametrize("slope", [1, -1])
def test_a_slanted_trail_is_as_long_as_it_is(slope):
    length_px = 40 * 2**0.5
    dn = np.zeros((80, 80))
    steps = np.arange(40)
    dn[20 + steps if slope > 0 else 59 - steps, 20 + steps] = 60.0
    found = find_sources(dn)
    assert length_px < found.length_px[0] < length_px + 8
    assert found.trail.tolist() == [True]


def test_one_pixel_s_light_is_the_detector_s():
    dn = spot((40, 60), 40.0, 12.0, (1.0, 1.0), 60.0)
    dn[25, 15] = 100.0
    found = find_sources(dn)
    assert found.places_px[found.single] == pytest.approx(np.array([[15.0, 25.0]]), abs=1e-3)
    assert len(found) == 2


@pytest.mark.parametrize(("beside", "is_single"), [(12.9, True), (13.1, False)])
def test_the_highest_pixel_of_nine_is_alone_by_what_its_four_neighbours_have(beside, is_single):
    """A pixel of 100 sigmas at each of the nine about a place: 4 of them a neighbour are a star's,
    of which noise has 0.75.
    """
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            sigmas = np.zeros((40, 60))
            sigmas[12 + row, 33 + column] = 100.0
            sigmas[12 + row, 33 + column + 1] = beside
            places_px = np.array([33.4]), np.array([11.6])
            assert _single(sigmas, *places_px).tolist() == [is_single]


def test_what_is_under_the_threshold_is_no_source():
    dn = np.zeros((40, 40))
    smoothed = 2 * np.sqrt(np.pi) * KERNEL_PX / (2 * np.pi * KERNEL_PX**2)  # a lone pixel's peak
    for share, count in ((0.97, 0), (1.03, 1)):
        dn[20, 20] = share * THRESHOLD / smoothed
        assert len(find_sources(dn)) == count


def test_a_mask_is_a_diamond_about_a_source_and_a_square_about_a_trail():
    grow_px = 3
    dn = np.zeros((80, 120))
    dn[20, 30] = 100.0
    sources = find_sources(dn)
    mask = source_mask(sources, dn, grow_px)
    y, x = np.indices(dn.shape)
    assert np.array_equal(mask, abs(y - 20) + abs(x - 30) <= grow_px)
    trail = np.zeros_like(dn)
    trail[50, 60:91] = 30.0
    sources = find_sources(trail)
    mask = source_mask(sources, trail, grow_px)
    half_px = round(float(sources.length_px[0]) / 2) + grow_px
    assert np.array_equal(mask, (abs(y - 50) <= half_px) & (abs(x - 75) <= half_px))


def all_sky(rng, sky_dn: float, radius: float, corner_dn: float = 0.0) -> np.ndarray:
    """A circle of sky in a frame, radius in half of its shorter side."""
    y, x = np.mgrid[:120, :160]
    away = np.hypot(x - 79.5, y - 59.5) / 60
    dn = np.where(away < radius, sky_dn, 0.0) + corner_dn * (away >= 1.2)
    return dn + rng.standard_normal(dn.shape)


def test_an_all_sky_lens_is_told_by_its_level_corners(rng):
    assert is_round(all_sky(rng, 20.0, 1.0))
    # sky all over, none at all, light in the far corners, half a circle, and no corners
    assert not is_round(all_sky(rng, 20.0, 2.0))
    assert not is_round(all_sky(rng, 0.0, 1.0))
    assert not is_round(all_sky(rng, 20.0, 1.0, corner_dn=4.0))
    assert not is_round(all_sky(rng, 20.0, 0.45))
    assert not is_round(np.zeros((40, 400)))


def test_sky_beyond_the_clip_is_a_star_s(rng):
    """A tenth of the pixels far above the rest leaves the level where it was, to the share of a
    normal distribution that is cut: none of it on one side alone.
    """
    dn = plane(0.0, 0.0) + NOISE_DN * rng.standard_normal((HIGH_PX, WIDE_PX))
    dn[::3, ::3] += 20 * CLIP * NOISE_DN
    level = sky_level(dn, STEP_DN).level
    assert np.mean(level) == pytest.approx(100.0, abs=5 * NOISE_DN / np.sqrt(dn.size))


@pytest.mark.parametrize(("length_px", "half_px"), [(100.0, 50), (160.0, 80), (400.0, 80)])
def test_what_is_left_out_about_a_long_source_is_bounded(length_px, half_px):
    """A trail across the whole image leaves the rest of it."""
    dark = np.zeros((300, 300))
    mask = source_mask(sources_at([(150.0, 140.0)], length_px=length_px), dark, 2)
    y, x = np.indices(dark.shape)
    reach_px = half_px + 2
    assert np.array_equal(mask, (abs(y - 140) <= reach_px) & (abs(x - 150) <= reach_px))


@pytest.mark.parametrize(("length_px", "is_trail"), [(14, False), (30, True)])
def test_a_thin_source_is_a_trail_where_it_is_long(length_px, is_trail):
    """A bar that is over the threshold in its middle row alone."""
    dn = np.zeros((60, 60))
    dn[30, 10 : 10 + length_px] = 3.7
    found = find_sources(dn)
    assert len(found) == 1
    assert found.length_px[0] > 5 * found.width_px[0]
    assert found.trail.tolist() == [is_trail]


def test_a_pattern_s_pixels_are_within_their_clip_to_either_side_at_their_own_light():
    """Pixels of 1 DN to either side where it is dim, and of 10 where it is bright: 9 DN is much in
    the dim part alone, with a sigma of 1.15 by 0.5 % that are so far off.
    """
    level = np.repeat([100.0, 1000.0], 1600).reshape(2, 1600) + np.arange(1600) / 1e4
    off = np.array([[1.0], [10.0]]) * np.tile([1.0, -1.0], 800)
    far = np.arange(0, 1600, 200)
    off[:, far] = np.array([[9.0, -9.0] * 4, [9.0, -9.0] * 4])
    mask = np.ones((2, 1600), dtype=bool)
    mask[1, 7] = False
    use = _quiet(off, level, mask)
    assert PATTERN_CLIP * 1.2 < 9.0
    assert np.flatnonzero(~use[0]).tolist() == far.tolist()
    assert np.flatnonzero(~use[1]).tolist() == [7]
