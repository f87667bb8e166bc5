"""A turning camera's stars: flux conserved, paths exact, and no more sprites than needed."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg, propagate, to_matrix
from hilstar.display.geometry import monitor_camera
from hilstar.display.render.reference import linear_image
from hilstar.optics import exposure_motion as smear
from hilstar.optics.exposure_motion import MIDDLE_S, Motion, smeared_sprites
from hilstar.optics.psf import MAX_CUT, GaussianPsf
from hilstar.optics.scan import Scan
from hilstar.optics.sprites import join_sprites, make_sprites
from tests.support.refusals import refusal
from tests.support.stars import stars_at
from tests.support.turned_cameras import turned_attitude, turned_cameras

IDENTITY = np.array([1.0, 0, 0, 0])
SIZE = (320, 240)
CAMERA = monitor_camera(SIZE, 13.0, 70.0, IDENTITY)
# The module's promise: 1e-6 of a star's flux in any pixel, and the footprints' cut.
PIXEL_LIMIT = 1e-6 + MAX_CUT
SIGMA = (0.85, 0.6)
AXES_PX = 1e-8  # rounding of a few rotations more, at 1000 px from the axis


def motion(rate_deg_s, exposure_s=1.0, radec=(84.0, -1.0, 20.0)) -> Motion:
    return Motion(
        from_radec_roll_deg(*radec), np.radians(np.array(rate_deg_s, dtype=float)), exposure_s
    )


def star_on(pixel, at: Motion, flux=1.0):
    """One star that is at `pixel` in the middle of the exposure."""
    image = np.array(
        [
            [
                pixel[0] - CAMERA.principal_point_px[0],
                pixel[1] - CAMERA.principal_point_px[1],
                CAMERA.focal_length_px,
            ]
        ]
    )
    return stars_at(image @ at.icrs_to_image(MIDDLE_S, CAMERA)[0], np.array([flux]))


def brute_force(stars, at: Motion, steps: int) -> np.ndarray:
    """The mean of `steps` instants, each drawn whole by the oracle."""
    instants = []
    for k in range(steps):
        seconds = ((k + 0.5) / steps - 0.5) * at.exposure_s
        q = propagate(at.q_icrs_to_cam, at.rate_cam_rad_s, seconds)
        instants.append(make_sprites(stars, to_matrix(q), CAMERA, GaussianPsf(SIGMA).footprint_px))
    return (
        linear_image(
            join_sprites(instants, GaussianPsf(SIGMA).footprint_px), SIZE, GaussianPsf(SIGMA)
        )
        / steps
    )


@pytest.mark.parametrize("scan", [Scan(), Scan((0, 1), 0.05)], ids=["at once", "rolling"])
def test_an_exposure_does_not_depend_on_the_axes_in_which_its_turn_is_told(scan, rng):
    """Attitude, rate and mounting in axes that are turned draw the same paths."""
    at = motion((0.1, -0.2, 3.0))
    stars, psf = star_on((200.3, 90.6), at), GaussianPsf(SIGMA)
    drawn = smeared_sprites(stars, at, CAMERA, psf, scan)
    assert len(drawn) > 1
    for turned, camera in turned_cameras(CAMERA, rng):
        rate = turned.apply(at.rate_cam_rad_s)
        other = Motion(turned_attitude(turned, at.q_icrs_to_cam), rate, at.exposure_s)
        again = smeared_sprites(stars, other, camera, psf, scan)
        assert np.stack([again.x_px, again.y_px]) == pytest.approx(
            np.stack([drawn.x_px, drawn.y_px]), abs=AXES_PX
        )


@pytest.mark.parametrize(
    "rate",
    [
        (0.0005, 0, 0),
        (0.003, 0.002, 0),
        (0.05, 0, 0),
        (0, 0.1, 0.3),
        (0.1, -0.2, 3.0),
        (0, 0, 40.0),
        (1.0, 0.5, 0),
    ],
)
def test_a_path_is_the_mean_of_its_instants(rate):
    at = motion(rate)
    stars = star_on((200.3, 90.6), at)
    drawn = linear_image(
        smeared_sprites(stars, at, CAMERA, GaussianPsf(SIGMA)), SIZE, GaussianPsf(SIGMA)
    )
    path_px = np.radians(np.hypot(*rate[:2]) * CAMERA.focal_length_px + abs(rate[2]) * SIZE[0] / 4)
    exact = brute_force(stars, at, max(400, round(38 * path_px)))
    # The mean of midpoints is itself off by (path / steps)^2 / 24 times the PSF's curvature: 1e-7
    # for 38 steps a pixel,
    # but for the footprints' edges, which pass pixels in steps of 1 / steps times the cut.
    assert np.abs(drawn - exact).max() < PIXEL_LIMIT


def test_flux_is_conserved_along_every_path():
    for rate in ((0.01, 0, 0), (0.1, 0.05, 0.3), (0, 0, 30.0)):
        at = motion(rate)
        sprites = smeared_sprites(star_on((160.2, 120.7), at, 1e6), at, CAMERA, GaussianPsf(SIGMA))
        # Gauss-Legendre weights and float32 fluxes: a few 1e-8.
        assert sprites.data["electrons_per_s"].sum(dtype=np.float64) == pytest.approx(1e6, rel=3e-7)
        assert linear_image(sprites, SIZE, GaussianPsf(SIGMA)).sum() == pytest.approx(
            1e6, rel=3e-7 + MAX_CUT
        )


def test_a_camera_at_rest_has_one_sprite_a_star():
    at = motion((0, 0, 0))
    sprites = smeared_sprites(star_on((160, 120), at), at, CAMERA, GaussianPsf(SIGMA))
    assert len(sprites) == 1
    none = motion((5, 0, 0), exposure_s=0.0)
    assert len(smeared_sprites(star_on((160, 120), none), none, CAMERA, GaussianPsf(SIGMA))) == 1


def test_a_star_on_the_axis_of_rotation_needs_one_sprite_and_a_far_one_more():
    at = motion((0, 0, 0.5))
    centre, corner = star_on((159.5, 119.5), at), star_on((300, 220), at)
    assert len(smeared_sprites(centre, at, CAMERA, GaussianPsf(SIGMA))) == 1
    count = len(smeared_sprites(corner, at, CAMERA, GaussianPsf(SIGMA)))
    # 0.5 deg at 172 px is 1.5 px, 2.5 of the smaller sigma: 1.02 * 2.5 + 3, rounded up by at most
    # 15 %.
    assert 5 <= count <= 8


def test_a_star_that_enters_during_the_exposure_is_drawn_in_part():
    at = motion((0, -2.0, 0))
    # 2 deg/s is 188 px in a second: half of its path is inside
    stars = star_on((-30.0, 100.0), at, 1.0)
    sprites = smeared_sprites(stars, at, CAMERA, GaussianPsf(SIGMA))
    inside = linear_image(sprites, SIZE, GaussianPsf(SIGMA)).sum()
    path_px = CAMERA.focal_length_px * np.radians(2.0)
    assert inside == pytest.approx((path_px / 2 - 29.5) / path_px, rel=0.02)


def test_a_whole_turn_in_one_exposure_makes_rings():
    at = motion((0, 0, 360.0))
    sprites = smeared_sprites(star_on((159.5 + 60, 119.5), at, 1.0), at, CAMERA, GaussianPsf(SIGMA))
    image = linear_image(sprites, SIZE, GaussianPsf(SIGMA))
    assert image.sum() == pytest.approx(1.0, rel=3e-7 + MAX_CUT)
    y, x = np.mgrid[0:240, 0:320]
    radius = np.hypot(x - 159.5, y - 119.5)
    assert image[np.abs(radius - 60) > 6].max() < 1e-9
    # The axis meets a pixel corner, so the ring is the same after half a turn.
    square = image[20:220, 60:260]
    assert np.abs(square - np.rot90(square, 2)).max() < PIXEL_LIMIT


def test_a_spin_that_sweeps_the_sky_past_the_camera_ends(rng):
    vectors = rng.normal(size=(2000, 3))
    at = motion((30.0, 20.0, 0.0))
    sprites = smeared_sprites(stars_at(vectors, np.ones(2000)), at, CAMERA, GaussianPsf(SIGMA))
    assert 0 < sprites.data["electrons_per_s"].sum() < 2000
    assert np.isfinite(sprites.x_px).all()


@pytest.mark.parametrize("rate", [(1e9, 0, 0), (0, 0, 1e12), (3e5, 1e5, 0)])
def test_a_turn_too_long_to_draw_is_refused_with_what_can_be(rate):
    at = motion(rate)
    with pytest.raises(
        InputError, match=r"turns by .* deg is too long; at most .* deg can be drawn"
    ):
        smeared_sprites(star_on((160.2, 120.7), motion((0, 0, 0))), at, CAMERA, GaussianPsf(SIGMA))


def longest_turn_deg(sigma_px: tuple[float, float]) -> float:
    """What the refusal of a turn about the boresight of 1000 revolutions says can be drawn."""
    at = motion((0, 0, 360_000.0))
    line = refusal(smeared_sprites, star_on((160.2, 120.7), at), at, CAMERA, GaussianPsf(sigma_px))
    return float(line.partition("at most ")[2].partition(" deg")[0])


def test_a_turn_as_long_as_its_refusal_says_is_drawn_and_a_longer_one_is_not(monkeypatch):
    """The narrower axis of the PSF limits it, whichever that is."""
    monkeypatch.setattr(smear, "MAX_PIECES", 6)
    said_deg = longest_turn_deg(SIGMA)
    monkeypatch.setattr(smear, "MAX_PIECE_SIGMA", 10.0)  # the path, and not the angle, is too long
    narrow_deg = longest_turn_deg((0.6, 0.6))
    assert narrow_deg < 0.9 * longest_turn_deg((0.85, 0.85))
    for sigma_px in (SIGMA, SIGMA[::-1]):
        assert longest_turn_deg(sigma_px) == pytest.approx(narrow_deg)
    monkeypatch.undo()
    monkeypatch.setattr(smear, "MAX_PIECES", 6)
    just_drawn, too_long = (motion((0, 0, 0.999 * said_deg)), motion((0, 0, 1.002 * said_deg)))
    psf = GaussianPsf(SIGMA)
    assert len(smeared_sprites(star_on((160.2, 120.7), just_drawn), just_drawn, CAMERA, psf)) > 1
    star = star_on((160.2, 120.7), too_long)
    assert "is too long" in refusal(smeared_sprites, star, too_long, CAMERA, psf)


@pytest.mark.parametrize("down_px_s", [200.0, -200.0])
def test_a_star_that_goes_with_the_shutter_is_exposed_for_longer(down_px_s):
    """Rows begin a millisecond apart. A star that stays exposed from row to row has 1 / (1 - v row_s)
    of the light that it has at rest, v its speed along the scan.
    """
    scan = Scan((0, 1), scanout_s=0.24)
    row_s = scan.scanout_s / SIZE[1]
    at = motion((np.degrees(down_px_s / CAMERA.focal_length_px), 0, 0), 0.1)
    stars = star_on((CAMERA.principal_point_px[0], 120.0), at)
    drawn = smeared_sprites(stars, at, CAMERA, GaussianPsf(SIGMA), scan)
    moved_px_s = np.sign(drawn.y_px[-1] - drawn.y_px[0]) * abs(down_px_s)
    light = drawn.data["electrons_per_s"].sum(dtype=np.float64)
    # 10 px off the principal point its speed is another by (10 px / focal length)^2: 3e-6
    assert light == pytest.approx(1 / (1 - moved_px_s * row_s), rel=1e-5)


def test_more_sprites_than_the_bound_are_made_fewer_with_their_light_kept(monkeypatch, rng):
    at = motion((10.0, 0, 0))
    stars = stars_at(rng.normal(size=(20_000, 3)), np.ones(20_000))
    whole = smeared_sprites(stars, at, CAMERA, GaussianPsf(SIGMA))
    monkeypatch.setattr(smear, "MAX_SPRITES", len(whole) // 2)
    coarse = smeared_sprites(stars, at, CAMERA, GaussianPsf(SIGMA))
    assert len(coarse) <= len(whole) // 2
    assert (whole.capped, coarse.capped) == (0, len(np.unique(whole.star)))
    light = [
        float(sprites.data["electrons_per_s"].sum(dtype=np.float64)) for sprites in (whole, coarse)
    ]
    # paths end at the image's edge, a node more or less
    assert light[1] == pytest.approx(light[0], rel=0.02)


def test_the_same_turn_is_drawn_alike_however_long_it_takes():
    """A tenth of the time at ten times the rate: the same path of the same light."""
    slow = motion((0.05, -0.1, 0.3))
    fast = motion((0.5, -1.0, 3.0), exposure_s=0.1)
    drawn = []
    for at in (slow, fast):
        stars = star_on((200.3, 90.6), at, 1e6)
        drawn.append(smeared_sprites(stars, at, CAMERA, GaussianPsf(SIGMA)))
    assert len(drawn[0]) == len(drawn[1]) > 1
    np.testing.assert_allclose(drawn[1].x_px, drawn[0].x_px, atol=1e-6)
    np.testing.assert_allclose(drawn[1].y_px, drawn[0].y_px, atol=1e-6)
    np.testing.assert_allclose(
        drawn[1].data["electrons_per_s"], drawn[0].data["electrons_per_s"], rtol=1e-6
    )


@pytest.mark.parametrize(("px_a_row", "is_drawn"), [(0.45, True), (0.55, False)])
def test_a_turn_may_cross_half_a_row_while_one_is_read_and_its_line_says_how_much(
    px_a_row, is_drawn
):
    """About the boresight of an image that is wider than high: the corner is the fastest."""
    scan = Scan((0, 1), scanout_s=0.24)
    corner_px = np.hypot(*(np.array(SIZE) / 2))
    row_s = scan.scanout_s / SIZE[1]
    rate_deg_s = np.degrees(px_a_row / row_s / corner_px)
    at = motion((0.0, 0.0, rate_deg_s), 0.01)
    stars, psf = star_on((100.0, 60.0), at), GaussianPsf(SIGMA)
    if is_drawn:
        assert len(smeared_sprites(stars, at, CAMERA, psf, scan)) > 1
        return
    with pytest.raises(InputError) as refused:
        smeared_sprites(stars, at, CAMERA, psf, scan)
    line = str(refused.value)
    said_px = float(line.removeprefix("the camera turns by ").partition(" px")[0])
    assert said_px == pytest.approx(px_a_row, rel=0.02)
    assert line.endswith(" px while a row is read; shorten row_time_us or turn more slowly")
