"""Light of a shape, as a camera that turns has it and as it is moved by part of a pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.rotation import propagate, to_matrix
from hilstar.display.render.reference import extended_image
from hilstar.optics.camera import Camera
from hilstar.optics.extended import (
    SMALL_SIGMAS,
    DiscLight,
    DiscView,
    GlowLight,
    LightMap,
    Pose,
    Shear,
    clipped,
    disc_lights,
    shifted,
    times,
)
from hilstar.optics.psf import GaussianPsf
from hilstar.sky.bodies.disc import AIR_TOP, Air, Disc

SIZE_PX, MIDDLE_PX = (96, 80), (47.5, 39.5)
CAMERA = Camera(SIZE_PX, 500.0, MIDDLE_PX, np.eye(3))
PSF = GaussianPsf((0.8, 1.0))
AT_REST = np.array([1.0, 0.0, 0.0, 0.0])
# A pixel lights up as late as its place in a camera at rest says: by 1.25 % of the move, at most
# 0.7 px, it has moved on since.
PLACE_PX = 0.01
# the square of half a pixel to the scale, 26 px, times half of the exponent: 6.5e-4
HALF_A_PIXEL = 1e-3


def centre_px(lights) -> np.ndarray:
    """The centre of mass of maps of light, px."""
    (light,) = lights
    assert isinstance(light, LightMap)
    rows, columns = np.indices(light.image.shape)
    moments = [(light.image * axis).sum(dtype=float) for axis in (columns, rows)]
    return np.array(moments) / light.image.sum(dtype=float) + light.corner_px


def uniform_disc(at_px: tuple[float, float], radius_px: float = 2.0) -> Disc:
    direction = CAMERA.rays(*np.array(at_px)[:, None])[0]
    direction /= np.linalg.norm(direction)
    distance = CAMERA.focal_length_px / radius_px
    pole = np.array([0.0, 1.0, 0.0])
    return Disc("x", direction, distance, 1.0, 1.0, pole, -direction, "uniform", 1e6)


def test_a_pixel_lights_up_as_late_as_its_columns_and_rows_from_the_middle_say():
    shear = Shear(np.zeros(3), (1e-3, 1e-5), MIDDLE_PX)
    x_px, y_px = np.array([47.5, 57.5, 47.5]), np.array([39.5, 39.5, 49.5])
    np.testing.assert_allclose(shear.late_s(x_px, y_px), [0.0, 1e-2, 1e-4])


@pytest.mark.parametrize("sigma_px", [(0.5, 0.5), (0.5, 2.0), (2.0, 0.5)])
@pytest.mark.parametrize(("share", "kind"), [(0.98, LightMap), (1.02, DiscLight)])
def test_a_disc_is_small_where_its_radius_is_under_so_many_of_the_wider_sigma(
    sigma_px, share, kind
):
    """A small one is drawn as its blurred map, a larger one as itself. A pixel's own width adds
    to sigma, 1/12 px^2.
    """
    psf = GaussianPsf(sigma_px)
    widest_px = np.sqrt(max(sigma_px) ** 2 + 1 / 12)
    disc = uniform_disc(MIDDLE_PX, share * SMALL_SIGMAS * widest_px)
    (light,) = disc_lights(disc, DiscView(CAMERA, psf, (Pose(np.eye(3)),), None), False)
    assert isinstance(light, kind)


@pytest.mark.parametrize("s_per_px", [(0.0, 1e-4), (1e-4, 0.0), (0.0, -1e-4), (5e-5, 1e-4)])
@pytest.mark.parametrize("at_px", [(20.0, 15.0), (70.0, 60.0), (25.0, 62.0)])
def test_a_disc_of_a_turning_camera_is_where_it_was_when_its_own_pixels_lit_up(s_per_px, at_px):
    """The exact turn from the moment of the attitude to that of the disc's place."""
    rate_rad_s = np.array([0.2, -0.25, 0.1])
    disc = uniform_disc(at_px)
    view = DiscView(CAMERA, PSF, (Pose(np.eye(3)),), Shear(rate_rad_s, s_per_px, MIDDLE_PX))
    place = np.array(at_px)
    for _ in range(20):  # its place when it lights up, which depends on the place
        late_s = float(np.dot(s_per_px, place - MIDDLE_PX))
        turned = to_matrix(propagate(AT_REST, rate_rad_s, late_s)) @ disc.direction
        place = np.concatenate(CAMERA.project(turned[None]))
    assert 0.1 < np.hypot(*(place - at_px)) < 0.7
    np.testing.assert_allclose(centre_px(disc_lights(disc, view, False)), place, atol=PLACE_PX)


@pytest.mark.parametrize("by_px", [(0.25, 0.0), (0.0, 0.25), (-0.3, 0.4)])
def test_a_map_moved_by_part_of_a_pixel_keeps_its_light_and_moves_its_middle(by_px):
    view = DiscView(CAMERA, PSF, (Pose(np.eye(3)),))
    (light,) = disc_lights(uniform_disc((30.0, 50.0)), view, True)
    moved = shifted(light, *by_px)
    assert moved.image.sum() == pytest.approx(light.image.sum(), rel=1e-3)
    assert moved.cover.shape == moved.image.shape
    np.testing.assert_allclose(centre_px([moved]), centre_px([light]) + by_px, atol=2e-3)
    assert shifted(light, 0.0, 0.0) is light


@pytest.mark.parametrize("exponent", [1.0, 2.0, 3.5])
def test_a_glow_falls_by_its_angle_from_its_direction_also_from_beside_the_image(exponent):
    """At the scale it has 2^(-exponent / 2) of its peak."""
    for middle_deg in (0.0, 40.0):  # the second is beside the field of 11 degrees
        middle_rad = np.radians(middle_deg)
        direction = np.array([np.sin(middle_rad), 0.0, np.cos(middle_rad)])
        scale_rad = np.radians(3.0)
        glow = GlowLight(direction, 5e3, scale_rad, exponent, CAMERA)
        image = extended_image((glow,), SIZE_PX)
        x_px = np.arange(SIZE_PX[0])
        away_rad = middle_rad - np.arctan((x_px - MIDDLE_PX[0]) / CAMERA.focal_length_px)
        # between the two rows in the middle, half a pixel from the plane of the direction
        along = image[39:41].mean(axis=0)
        wanted = 5e3 * (1 + (away_rad / scale_rad) ** 2) ** (-exponent / 2)
        assert along == pytest.approx(wanted, rel=HALF_A_PIXEL)


@pytest.mark.parametrize("down", [1, -1])
@pytest.mark.parametrize("axis", [0, 1], ids=["along rows", "along columns"])
def test_a_small_disc_that_moves_with_the_rows_has_the_light_of_those_it_meets_and_hides_all(
    axis, down
):
    """It crosses 3 % of the lines that light up meanwhile: with them it is lit in 1 / 0.97 of them,
    against them in 1 / 1.03. Its middle hides what is behind as a whole: the Sun may be there.
    """
    px_s, share = 150.0, 0.03
    rate = np.zeros(3)
    # a turn about y takes what is seen to the left, one about x down
    rate[1 - axis] = (-1 if axis == 0 else 1) * px_s / CAMERA.focal_length_px
    s_per_px = [0.0, 0.0]
    s_per_px[axis] = down * share / px_s
    shear = Shear(rate, tuple(s_per_px), MIDDLE_PX)
    disc = uniform_disc(MIDDLE_PX, 5.0).of_rate(1e6)
    (light,) = disc_lights(disc, DiscView(CAMERA, PSF, (Pose(np.eye(3)),), shear), covers=True)
    assert isinstance(light, LightMap)
    assert light.image.sum(dtype=float) == pytest.approx(1e6 / (1 - down * share), rel=2e-3)
    y, x = np.indices(light.cover.shape)
    off_px = np.hypot(x + light.corner_px[0] - MIDDLE_PX[0], y + light.corner_px[1] - MIDDLE_PX[1])
    assert (light.cover[off_px < 1.5] == 1).all()
    assert light.cover.sum() == pytest.approx(np.pi * 25 / (1 - down * share), rel=0.01)


def test_a_small_disc_hides_what_is_within_its_outline_far_off_the_axis():
    """At 39 degrees an outline is 1.3 times as long away from the axis, and its pixels are fewer
    to a steradian by the cube of the cosine.
    """
    camera = Camera((960, 800), 500.0, (47.5, 39.5), np.eye(3))
    direction = camera.rays(np.array([360.0]), np.array([300.0]))[0]
    direction /= np.linalg.norm(direction)
    pole = np.array([0.0, 1.0, 0.0])
    disc = Disc("x", direction, 125.0, 1.0, 1.0, pole, -direction, "uniform", 1e6)
    x_px, y_px = camera.project(disc.limb(360))
    outline_px2 = abs(x_px @ np.roll(y_px, -1) - y_px @ np.roll(x_px, -1)) / 2
    (light,) = disc_lights(disc, DiscView(camera, PSF, (Pose(np.eye(3)),)), covers=True)
    assert light.cover.sum(dtype=float) == pytest.approx(outline_px2, rel=0.01)


@pytest.mark.parametrize("air", [None, Air(0.05 * 6400.0, 0.3)])
def test_a_disc_s_pixels_are_those_of_its_limb_its_air_and_its_psf_s_reach(air):
    """Of a face of 12 px, which air of a twentieth of a radius makes larger by its top; the limb
    of a near sphere is a circle about the middle of the image.
    """
    distance_km = 6400.0 * CAMERA.focal_length_px / 12.0
    direction = np.array([0.0, 0.0, 1.0])
    pole = np.array([0.0, 1.0, 0.0])
    disc = Disc(
        "x", direction, distance_km, 6400.0, 6400.0, pole, -direction, "uniform", 1e6, 1.0, air
    )
    left, top, width, height = DiscLight(disc, np.eye(3), CAMERA, PSF).region(SIZE_PX)
    radius_px = 12.0 * (1 + (AIR_TOP * 0.05 if air else 0.0))
    for first, size, middle, sigma in (
        (left, width, MIDDLE_PX[0], 0.8),
        (top, height, MIDDLE_PX[1], 1.0),
    ):
        reach_px = radius_px + 4 * np.sqrt(sigma**2 + 1 / 12)
        assert reach_px < middle - first < reach_px + 3
        assert reach_px < first + size - middle < reach_px + 3


@pytest.mark.parametrize("at_px", [(20.0, 20.0), (75.0, 60.0)])
def test_a_turning_camera_s_disc_is_within_its_pixels(at_px):
    """Its limb's places, each while its own pixel is lit, 3 px and more from those at rest."""
    rate_rad_s = np.array([0.2, -1.6, 0.0])
    disc = uniform_disc(at_px, 14.0)
    shear = Shear(rate_rad_s, (0.0, 2e-4), MIDDLE_PX)
    limb = disc.limb(60)
    places = np.stack(CAMERA.project(limb))
    at_rest = places.copy()
    for _ in range(20):
        late_s = shear.late_s(*places)
        turned = limb - late_s[:, None] * np.cross(rate_rad_s, limb)
        places = np.stack(CAMERA.project(turned))
    assert np.hypot(*(places - at_rest)).max() > 3
    left, top, width, height = DiscLight(disc, np.eye(3), CAMERA, PSF, shear=shear).region(SIZE_PX)
    low, high = np.array([left, top]), np.array([left + width, top + height])
    on_image = np.clip(places, 0.0, np.array(SIZE_PX)[:, None] - 1.0)
    assert (on_image.min(axis=1) >= low).all()
    assert (on_image.max(axis=1) < high).all()


def test_a_large_disc_is_moved_with_its_camera_and_hides_at_the_middle_of_its_poses():
    disc = uniform_disc((40.0, 30.0), 20.0)
    light = DiscLight(disc, np.eye(3), CAMERA, PSF)
    x_px, y_px = MIDDLE_PX
    assert shifted(light, 0.4, -0.3).camera.principal_point_px == (x_px + 0.4, y_px - 0.3)
    turns = [to_matrix(propagate(AT_REST, np.array([0.0, 0.01, 0.0]), k)) for k in range(3)]
    shares = (0.2, 0.5, 0.3)
    poses = tuple(Pose(turn, share) for turn, share in zip(turns, shares, strict=True))
    covering, *drawn = disc_lights(disc, DiscView(CAMERA, PSF, poses), True)
    assert (covering.times, covering.covers) == (0.0, True)
    assert covering.icrs_to_image is turns[1]
    assert [(part.times, part.covers) for part in drawn] == [(share, False) for share in shares]
    assert [part.icrs_to_image for part in drawn] == turns
    assert len(disc_lights(disc, DiscView(CAMERA, PSF, poses), False)) == 3


def test_a_disc_is_spread_along_each_axis_by_its_own_sigma_and_hides_what_it_covers():
    psf = GaussianPsf((0.8, 1.6))
    light = DiscLight(uniform_disc((40.0, 30.0), 6.0), np.eye(3), CAMERA, psf)
    image = extended_image((light,), SIZE_PX)
    rows, columns = np.indices(image.shape)
    variances = []
    for axis in (columns, rows):
        mean = np.average(axis, weights=image)
        variances.append(np.average((axis - mean) ** 2, weights=image))
    # beside the Gaussian's they have the disc's own, 9 px^2, alike to a thousandth
    assert variances[1] - variances[0] == pytest.approx(1.6**2 - 0.8**2, abs=0.01)
    even = LightMap(np.ones(SIZE_PX[::-1], np.float32))
    for covers, behind in ((True, 0.0), (False, 1.0)):
        dark = replace(light, times=0.0, covers=covers)
        seen = extended_image((even, dark), SIZE_PX)
        # 6 px are 3.75 sigmas of the wider axis
        assert seen[30, 40] == pytest.approx(behind, abs=1e-3)
        assert seen[0, 0] == 1.0


def test_light_times_a_factor_has_so_much_more_of_it_and_hides_as_much():
    """Each kind in its own way."""
    cover = np.ones((2, 2), np.float32)
    glow = GlowLight(np.array([0.0, 0.0, 1.0]), 5.0, 0.1, 2.0, CAMERA)
    disc = DiscLight(uniform_disc((40.0, 30.0)), np.eye(3), CAMERA, PSF, times=5.0)
    assert times(glow, 3.0).peak_e_per_s == 15.0
    assert times(disc, 3.0).times == 15.0
    more = times(LightMap(cover, times=5.0, cover=cover), 3.0)
    assert (more.times, more.cover is cover, more.image is cover) == (15.0, True, True)


@pytest.mark.parametrize(
    ("edges_px", "wanted"),
    [
        ((1.2, 2.7, 5.1, 6.9), (1, 2, 5, 5)),
        ((1.0, 2.0, 5.0, 6.0), (1, 2, 4, 4)),
        ((-3.5, -1.0, 2.5, 4.0), (0, 0, 3, 4)),
        ((90.0, 70.5, 120.0, 99.0), (90, 70, 6, 10)),
        ((96.0, 10.0, 99.0, 20.0), None),
        ((10.0, 80.0, 20.0, 90.0), None),
        ((-9.0, 10.0, 0.0, 20.0), None),
        ((-9.0, -9.0, 999.0, 999.0), (0, 0, 96, 80)),
    ],
)
def test_a_rectangle_has_each_pixel_that_it_touches(edges_px, wanted):
    assert clipped(edges_px, SIZE_PX) == wanted


def test_a_disc_that_reaches_behind_the_camera_may_be_anywhere_on_the_image():
    """20 degrees wide, 75 degrees off the axis: its limb from 55 to 95."""
    direction = np.array([np.sin(np.radians(75)), 0.0, np.cos(np.radians(75))])
    pole = np.array([0.0, 1.0, 0.0])
    distance_km = 1 / np.sin(np.radians(20))
    disc = Disc("x", direction, distance_km, 1.0, 1.0, pole, -direction, "uniform", 1e6)
    assert DiscLight(disc, np.eye(3), CAMERA, PSF).region(SIZE_PX) == (0, 0, *SIZE_PX)
    beside = np.array([1.0, 0.0, 0.0])  # from 88 to 92 degrees
    narrow = Disc("x", beside, 28.7, 1.0, 1.0, pole, -beside, "uniform", 1e6)
    assert DiscLight(narrow, np.eye(3), CAMERA, PSF).region(SIZE_PX) == (0, 0, *SIZE_PX)
    narrow = Disc("x", direction, 100 * distance_km, 1.0, 1.0, pole, -direction, "uniform", 1e6)
    assert DiscLight(narrow, np.eye(3), CAMERA, PSF).region(SIZE_PX) is None
    glow = GlowLight(np.array([0.0, 0.0, -1.0]), 1.0, 0.1, 2.0, CAMERA)
    assert glow.region(SIZE_PX) == (0, 0, *SIZE_PX)


@pytest.mark.parametrize("s_per_px", [(0.0, 2e-4), (0.0, -2e-4), (-1e-4, 0.0), (1e-4, -1e-4)])
def test_a_sheared_disc_s_pixels_reach_as_far_as_the_turn_may_move_it(s_per_px):
    """From the middle to an edge: half of the rows, by the farthest pixel's lever, to either side
    and twice, whichever way the rows go.
    """
    sigma_px = (0.7, 2.1)
    disc = uniform_disc((30.0, 50.0), 12.0)
    rate = np.array([0.3, -0.4, 1.2])
    view = DiscLight(
        disc, np.eye(3), CAMERA, GaussianPsf(sigma_px), shear=Shear(rate, s_per_px, MIDDLE_PX)
    )
    late_s = (abs(s_per_px[0]) * SIZE_PX[0] + abs(s_per_px[1]) * SIZE_PX[1]) / 2
    moved_px = 2 * 1.3 * late_s * np.hypot(CAMERA.focal_length_px, max(SIZE_PX))
    left, top, width, height = view.region((1000, 1000))
    for first, size, middle, sigma in (
        (left, width, 30.0, sigma_px[0]),
        (top, height, 50.0, sigma_px[1]),
    ):
        reach_px = 12.0 + 4 * np.sqrt(sigma**2 + 1 / 12) + moved_px
        assert reach_px < first + size - middle < reach_px + 3
        assert first == max(0, first)
        assert first == 0 or reach_px < middle - first < reach_px + 3


def test_a_map_moved_by_part_of_a_pixel_is_nowhere_negative_and_hides_nowhere_more_than_all():
    """Beside hard edges, where cubic splines overshoot."""
    image = np.zeros((12, 9), dtype=np.float32)
    image[3:9, 2:7] = 100.0
    moved = shifted(LightMap(image, (4, 5), cover=image / 100), 0.4, -0.3)
    assert isinstance(moved, LightMap)
    assert moved.image.min() == 0.0
    assert moved.image.max() > 101
    assert (moved.cover.min(), moved.cover.max()) == (0.0, 1.0)
