"""Footprints, projection and sprites."""

from __future__ import annotations

from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.display.geometry import monitor_camera
from hilstar.optics.camera import Camera
from hilstar.optics.extended import GlowLight, LightMap
from hilstar.optics.psf import (
    MAX_CUT,
    MAX_SHARE_ERROR,
    GaussianPsf,
    pixel_share,
    pixel_shares,
    share_polynomial,
)
from hilstar.optics.sprites import AddedLight, by_primary, by_share, clipped_sprites, make_sprites
from hilstar.sky.stars import BV_MAG, Stars, with_bodies
from tests.support.stars import sprites_at, stars_at

IDENTITY = np.array([1.0, 0, 0, 0])
SIGMA = (0.85, 0.85)


def stars_on_pixels(camera, pixels: np.ndarray, electrons_per_s: np.ndarray | None = None) -> Stars:
    """Stars whose images fall on given pixel positions (n, 2) at the identity attitude."""
    offset = pixels - np.array(camera.principal_point_px)
    vectors = np.column_stack((offset, np.full(len(pixels), camera.focal_length_px)))
    return stars_at(vectors, np.ones(len(pixels)) if electrons_per_s is None else electrons_per_s)


@pytest.mark.parametrize("sigma", [0.2, 0.4, 0.55, 0.85, 1.0, 3.0, 20.0])
def test_a_footprint_is_the_smallest_that_cuts_too_little_to_matter(sigma):
    size = GaussianPsf((sigma, sigma)).footprint_px
    assert (
        GaussianPsf((sigma, sigma)).cut_share(size)
        <= MAX_CUT
        < GaussianPsf((sigma, sigma)).cut_share(size - 1)
    )


def test_cut_share_is_the_light_outside_the_worst_footprint():
    for size in (3, 4, 9, 10):
        inside = [
            sum(pixel_share(k + 0.5 - size / 2 - 0.5, s) for k in range(size)) for s in (0.9, 1.4)
        ]
        # A sum of a few pixel shares: float64 rounding.
        assert GaussianPsf((0.9, 1.4)).cut_share(size) == pytest.approx(
            1 - inside[0] * inside[1], abs=1e-14
        )


def test_the_peak_is_that_of_a_centred_star():
    x, y = (2 * NormalDist(0, sigma).cdf(0.5) - 1 for sigma in (0.85, 0.55))
    assert GaussianPsf((0.85, 0.55)).peak_share == pytest.approx(x * y, rel=1e-14)


def test_an_absurd_sigma_is_refused():
    with pytest.raises(InputError, match="sigma"):
        assert GaussianPsf((1e6, 1e6)).footprint_px


def test_the_boresight_falls_on_the_principal_point():
    camera = monitor_camera((1920, 1080), 57.65, 350.0, IDENTITY)
    x, y = camera.project(np.array([[0.0, 0.0, 1.0]]))
    assert (x[0], y[0]) == (959.5, 539.5)


def test_a_star_behind_the_camera_has_no_pixel():
    camera = monitor_camera((100, 100), 10.0, 10.0, IDENTITY)
    x, y = camera.project(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    assert np.isnan(x).all()
    assert np.isnan(y).all()


def test_the_alignment_turns_the_image():
    """q_cam_to_mon of +90 degrees about the boresight takes cam +x to mon +y: right becomes
    down.
    """
    half = np.sqrt(0.5)
    camera = monitor_camera((1000, 1000), 10.0, 10.0, np.array([half, 0, 0, half]))
    x, y = camera.project((camera.cam_to_image @ np.array([0.1, 0.0, 1.0]))[None, :])
    assert x[0] == pytest.approx(499.5, abs=1e-9)
    assert y[0] == pytest.approx(499.5 + 100.0, abs=1e-9)


@pytest.mark.parametrize("footprint", [9, 10])
def test_sprites_are_whole_pixels_and_fractions(footprint, rng):
    camera = monitor_camera((640, 480), 10.0, 50.0, IDENTITY)
    pixels = rng.uniform([0, 0], [639, 479], size=(500, 2))
    stars = stars_on_pixels(camera, pixels)
    sprites = make_sprites(stars, np.eye(3), camera, footprint)
    assert len(sprites) == 500
    fraction = sprites.data["fraction_px"]
    low, high = (-0.5, 0.5) if footprint % 2 else (0.0, 1.0)
    assert fraction.min() >= low - 1e-7
    assert fraction.max() <= high
    truth = pixels[stars.hip[sprites.star]]
    restored = sprites.data["pixel"] + fraction.astype(np.float64)
    # float32 of a number below 1: 6e-8.
    assert np.abs(restored - truth).max() < 6e-8


@pytest.mark.parametrize("footprint", [9, 10])
def test_a_primary_s_sprites_are_listed_where_they_are_drawn(footprint, rng):
    """Its light lies a third of a pixel to a side: it is drawn as far to the other."""
    at_px = rng.uniform(10.0, 90.0, (50, 2))
    sprites = sprites_at(at_px, np.ones(50), footprint)
    places_px = np.array([[-1 / 3, 0.25], [0.0, 0.0], [1 / 3, -0.75]])
    for k, place_px in enumerate(places_px):
        drawn = by_primary(sprites, places_px, k)
        listed = np.column_stack([drawn.x_px, drawn.y_px])
        assert listed == pytest.approx(at_px - place_px, abs=1e-12)
        fraction_px = drawn.data["fraction_px"]
        assert drawn.data["pixel"] + fraction_px == pytest.approx(listed, abs=1e-6)  # float32
        low = -0.5 if footprint % 2 else 0.0
        assert ((fraction_px >= low) & (fraction_px <= low + 1)).all()


@pytest.mark.parametrize("footprint", [9, 10])
def test_a_star_is_kept_exactly_when_its_footprint_touches_the_image(footprint):
    camera = monitor_camera((64, 48), 10.0, 50.0, IDENTITY)
    edge = np.linspace(-8, 72, 641)
    for axis, length in ((0, 64), (1, 48)):
        pixels = np.full((len(edge), 2), 20.0)
        pixels[:, axis] = edge
        stars = stars_on_pixels(camera, pixels)
        sprites = make_sprites(stars, np.eye(3), camera, footprint)
        first = np.floor(edge + (0.5 if footprint % 2 else 0.0)) - (footprint - 1) // 2
        touching = (first <= length - 1) & (first + footprint - 1 >= 0)
        kept = np.isin(np.arange(len(edge)), stars.hip[sprites.star])
        # Where the edge falls on a pixel boundary to the last bit, either side is right.
        sure = np.abs(edge + 0.5 * (footprint % 2) - np.rint(edge + 0.5 * (footprint % 2))) > 1e-9
        assert np.array_equal(kept[sure], touching[sure])


def test_an_image_turned_to_the_pole_has_polaris_where_it_belongs():
    camera = monitor_camera((1000, 1000), 10.0, 20.0, IDENTITY)
    pole = stars_at(np.array([[0.0, 0.0, 1.0]]), np.ones(1))
    for ra in (0.0, 123.0):
        sprites = make_sprites(pole, to_matrix(from_radec_roll_deg(ra, 89.0, 0.0)), camera, 9)
        assert sprites.x_px[0] == pytest.approx(499.5, abs=1e-8)
        assert sprites.y_px[0] == pytest.approx(499.5 - 2000 * np.tan(np.radians(1.0)), abs=1e-8)


def test_a_star_clips_by_the_white_of_the_pixel_that_it_is_on(rng):
    """One in each tile of 20 px, at its own phase, on a monitor whose corners are as dark as 0.3
    of its brightest pixel.
    """
    psf = GaussianPsf((0.85, 0.6))
    columns, rows = np.meshgrid(np.arange(10, 100, 20), np.arange(10, 80, 20))
    middles = np.stack([columns.ravel(), rows.ravel()], axis=1)
    pixels = middles + rng.uniform(-0.5, 0.5, middles.shape)
    uniformity = rng.uniform(0.3, 1.0, (80, 100)).astype(np.float32)
    nearest = np.rint(pixels).astype(int)
    white = 7.0 * uniformity[nearest[:, 1], nearest[:, 0]]
    off = nearest - pixels
    own = pixel_shares(off[:, 0], 0.85) * pixel_shares(off[:, 1], 0.6)
    over = np.arange(len(pixels)) % 2 == 0
    lights = white / own * np.where(over, 1.01, 0.99)
    stars = sprites_at(pixels, lights, psf.footprint_px)
    darkest = float(uniformity.min())
    clipped = clipped_sprites(stars, psf, 7.0, (100, 80), uniformity, darkest)
    assert clipped.tolist() == np.flatnonzero(over).tolist()


def test_a_star_is_clipped_when_its_peak_is_over_white():
    camera = monitor_camera((64, 48), 10.0, 50.0, IDENTITY)
    white = GaussianPsf(SIGMA).peak_share
    pixels = np.array([[10.0, 10.0], [30.0, 10.0], [50.0, 10.0], [50.5, 10.0]])
    flux = np.array([1.0, 1.001, 0.9, 0.9])
    stars = stars_on_pixels(camera, pixels, flux)
    sprites = make_sprites(stars, np.eye(3), camera, 10)
    clipped = stars.hip[sprites.star[clipped_sprites(sprites, GaussianPsf(SIGMA), white, (64, 48))]]
    # 0 is white itself; 1 is over it; 2 and 3 are over it together.
    assert sorted(clipped.tolist()) == [1, 2, 3]


def test_all_light_is_divided_among_channels_by_its_own_star_body_or_colour():
    """Two stars, two bodies, and lights of faults of B-V 0.5 and -0.25, in three channels; what has
    no colour has the mean of the stars by their light.
    """
    two_stars = stars_at(np.eye(3)[:2], np.array([1.0, 3.0]))
    stars = with_bodies(two_stars, ("Moon", "Mars"), np.zeros(2))
    shares = np.array([[0.6, 0.3, 0.1], [0.2, 0.2, 0.6], [0.5, 0.4, 0.1], [0.1, 0.7, 0.2]])
    by_bv = np.stack([0.3 - 0.1 * BV_MAG, 0.3 + 0.02 * BV_MAG, 0.4 + 0.08 * BV_MAG], axis=1)
    bluer = np.array([0.325, 0.295, 0.38])
    redder = np.array([0.25, 0.31, 0.44])
    mean = (shares[0] + 3 * shares[1]) / 4
    image = np.ones((4, 4), np.float32)
    camera = Camera((64, 48), 100.0, (31.5, 23.5), np.eye(3))
    lights = (
        LightMap(image, name="Mars"),
        LightMap(image, times=2.0, name="Moon"),
        LightMap(image, bv_mag=0.5),
        LightMap(image),
        GlowLight(np.array([0.0, 0.0, 1.0]), 4.0, 0.1, 2.0, camera, bv_mag=-0.25),
    )
    rates = np.array([8.0, 4.0, 2.0, 16.0, 1.0])
    sprites = replace(
        sprites_at(np.arange(10.0).reshape(5, 2), rates, 9),
        star=np.array([1, -2, 3, -1, 0]),
        added=(AddedLight("redder", 1.0, 0.5, 16.0), AddedLight("bluer", 1.0, -0.25, 4.0)),
        extended=lights,
    )

    def of_sprites(by_bv: np.ndarray | None) -> np.ndarray:
        parts = by_share(sprites, stars, shares, by_bv)
        return np.stack([part.data["electrons_per_s"] / rates for part in parts], axis=1)

    def of_lights(by_bv: np.ndarray | None) -> np.ndarray:
        rows = []
        for part in by_share(sprites, stars, shares, by_bv):
            *maps, glow = part.extended
            rows.append([*(light.times for light in maps), glow.peak_e_per_s])
        return np.array(rows).T

    by_colour = np.stack([shares[1], bluer, shares[3], redder, shares[0]])
    assert of_sprites(by_bv) == pytest.approx(by_colour, rel=1e-6)  # float32
    without = np.stack([shares[1], mean, shares[3], mean, shares[0]])
    assert of_sprites(None) == pytest.approx(without, rel=1e-6)
    wide = np.stack([shares[3], 2 * shares[2], redder, mean, 4 * bluer])
    assert of_lights(by_bv) == pytest.approx(wide)
    wide_without = np.stack([shares[3], 2 * shares[2], mean, mean, 4 * mean])
    assert of_lights(None) == pytest.approx(wide_without)


@pytest.mark.parametrize("sigma", [0.5, 0.55, 0.7, 0.85, 1.3, 3.0, 20.0])
def test_a_share_s_polynomial_is_that_close_everywhere(sigma):
    """At places between those of the fit, in the float32 of a shader."""
    reach = GaussianPsf((sigma, sigma)).footprint_px / 2 + 0.5
    offset = np.linspace(0, reach, 3001)
    power = np.zeros(len(offset), dtype=np.float32)
    for term in share_polynomial(sigma, reach)[::-1]:
        power = power * np.float32(offset**2) + np.float32(term)
    # Float32 rounds the exponent, of a few units where the share is large, by 1e-7 of it.
    assert np.abs(np.exp2(power) - pixel_shares(offset, sigma)).max() < 2 * MAX_SHARE_ERROR


def test_a_narrow_star_has_no_polynomial():
    assert share_polynomial(0.3, 3.0) is None
