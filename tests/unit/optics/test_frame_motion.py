"""A frame of a screen that lights row by row: each star on its path while its own row is lit."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg, propagate, to_matrix
from hilstar.display.geometry import monitor_camera
from hilstar.display.render.reference import linear_image
from hilstar.optics import sprites as sprites_module
from hilstar.optics.frame_motion import EXTRA_PX, EXTRA_SPRITES, CameraTurn, swept_sprites
from hilstar.optics.paths import MAX_NODES
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.scan import Orientation, Scan
from hilstar.optics.sprites import clipped_sprites, make_sprites
from tests.support.stars import stars_at
from tests.support.turned_cameras import turned_attitude, turned_cameras

SIZE = (320, 240)
CAMERA = monitor_camera(SIZE, 13.0, 70.0, np.array([1.0, 0, 0, 0]))
SIGMA = (0.85, 0.6)
FOOTPRINT = GaussianPsf(SIGMA).footprint_px
Q = from_radec_roll_deg(84.0, -1.0, 20.0)
FRAME_S = 1 / 60
PIXEL_LIMIT = 1e-3  # of a star's flux: what the module's node counts promise
# Two passes leave (px crossed / rows)^2 of the scan-out, here (8 / 240)^2 of at most 8 px.
ROW_LIMIT_PX = 0.01
EXACT_PX = 1e-9
AXES_PX = 1e-8  # rounding of a few rotations more, at 1000 px from the axis


def stars_on(pixels):
    """Stars that are at `pixels` at the attitude Q."""
    offsets = np.asarray(pixels, dtype=float) - CAMERA.principal_point_px
    image = np.column_stack([offsets, np.full(len(offsets), CAMERA.focal_length_px)])
    return stars_at(image @ (CAMERA.cam_to_image @ to_matrix(Q)), np.ones(len(offsets)))


def turn(rate_deg_s) -> CameraTurn:
    return CameraTurn(Q, np.radians(np.array(rate_deg_s, dtype=float)))


def place_px(stars, at: CameraTurn, seconds: float):
    """Where the stars are so long after Q, by the quaternion's own way."""
    q = propagate(at.q_icrs_to_cam, at.rate_cam_rad_s, seconds)
    sprites = make_sprites(stars, to_matrix(q), CAMERA, FOOTPRINT)
    order = np.argsort(sprites.star)
    return np.column_stack([sprites.x_px, sprites.y_px])[order]


def swept(stars, at, scan):
    return swept_sprites(stars, at, scan, CAMERA, GaussianPsf(SIGMA))


PIXELS = [(30.0, 12.0), (160.0, 120.0), (290.3, 229.5)]


@pytest.mark.parametrize(
    ("down", "axis", "sign", "rows"),
    [((0, 1), 1, 1, 240), ((0, -1), 1, -1, 240), ((1, 0), 0, 1, 320), ((-1, 0), 0, -1, 320)],
)
def test_each_star_is_where_it_is_when_its_own_row_lights(down, axis, sign, rows):
    stars, at = stars_on(PIXELS), turn((1.0, -1.0, 3.0))
    sprites = swept(stars, at, Scan(down, FRAME_S, 0.0))
    order = np.argsort(sprites.star)
    found = np.column_stack([sprites.x_px, sprites.y_px])[order]
    for k in range(len(found)):
        late_s = sign * (found[k, axis] - (SIZE[axis] - 1) / 2) / rows * FRAME_S
        assert found[k] == pytest.approx(place_px(stars, at, late_s)[k], abs=ROW_LIMIT_PX)
    moved = np.abs(found - place_px(stars, at, 0.0)).max()
    assert moved > 0.5  # the middle row's moment would be wrong by so much


@pytest.mark.parametrize("scanout_s", [0.0, 0.9 * FRAME_S])
def test_a_frame_does_not_depend_on_the_axes_in_which_its_turn_is_told(scanout_s, rng):
    """Attitude, rate and mounting in axes that are turned draw the same paths."""
    scan = Scan((0, 1), scanout_s, FRAME_S)
    stars, at = stars_on(PIXELS), turn((0.5, -2.0, 6.0))
    drawn = swept(stars, at, scan)
    assert len(drawn) > len(PIXELS)
    for turned, camera in turned_cameras(CAMERA, rng):
        rate = turned.apply(at.rate_cam_rad_s)
        other = CameraTurn(turned_attitude(turned, at.q_icrs_to_cam), rate)
        again = swept_sprites(stars, other, scan, camera, GaussianPsf(SIGMA))
        assert again.star.tolist() == drawn.star.tolist()
        assert np.stack([again.x_px, again.y_px]) == pytest.approx(
            np.stack([drawn.x_px, drawn.y_px]), abs=AXES_PX
        )


@pytest.mark.parametrize("rate", [(0.05, 0, 0), (1.0, 0.3, 0), (2.0, -2.0, 20.0), (30.0, 10.0, 0)])
def test_a_path_is_the_mean_of_its_instants_and_keeps_its_flux(rate):
    stars, at = stars_on([(160.3, 120.6)]), turn(rate)
    sprites = swept(stars, at, Scan(hold_s=FRAME_S))
    drawn = linear_image(sprites, SIZE, GaussianPsf(SIGMA))
    steps = 1000
    exact = np.zeros_like(drawn)
    for k in range(steps):
        q = propagate(Q, at.rate_cam_rad_s, (k + 0.5) / steps * FRAME_S)
        exact += (
            linear_image(
                make_sprites(stars, to_matrix(q), CAMERA, FOOTPRINT), SIZE, GaussianPsf(SIGMA)
            )
            / steps
        )
    assert np.abs(drawn - exact).max() < PIXEL_LIMIT
    assert drawn.sum() == pytest.approx(exact.sum(), rel=1e-5)
    assert sprites.star_count == 1


def test_paths_of_following_frames_join():
    """Where one frame's path ends the next one's begins: the streak has no gap and no overlap
    along a row.
    """
    stars, at = stars_on([(160.3, 20.0)]), turn((0.0, 2.0, 0.0))
    following = CameraTurn(propagate(Q, at.rate_cam_rad_s, FRAME_S), at.rate_cam_rad_s)
    path, begins = Scan((0, 1), FRAME_S, FRAME_S), Scan((0, 1), FRAME_S, 0.0)
    first, second = (float(swept(stars, frame, begins).x_px[0]) for frame in (at, following))
    drawn = swept(stars, at, path)
    assert abs(second - first) > 3
    assert np.average(drawn.x_px, weights=drawn.data["electrons_per_s"]) == pytest.approx(
        (first + second) / 2, abs=ROW_LIMIT_PX
    )


def test_a_camera_at_rest_draws_the_same_points_as_ever():
    stars = stars_on(PIXELS)
    still = make_sprites(stars, CAMERA.cam_to_image @ to_matrix(Q), CAMERA, FOOTPRINT)
    sprites = swept(stars, turn((0, 0, 0)), Scan((0, 1), FRAME_S, FRAME_S))
    assert sprites.x_px == pytest.approx(still.x_px, abs=EXACT_PX)
    assert (sprites.data["electrons_per_s"] == still.data["electrons_per_s"]).all()
    assert sprites.per_star == 1


def test_stars_that_come_in_during_the_frame_are_drawn():
    """One that is 30 px outside at the first row's light and inside when the last row lights."""
    at = turn((30.0, 0, 0))
    inside_later = np.diff(
        [place_px(stars_on([(160.0, 120.0)]), at, s)[0, 1] for s in (0.0, FRAME_S)]
    )[0]
    outside = -30.0 if inside_later > 0 else SIZE[1] + 30.0
    stars = stars_on([(160.0, outside)])
    assert len(make_sprites(stars, CAMERA.cam_to_image @ to_matrix(Q), CAMERA, FOOTPRINT)) == 0
    assert len(swept(stars, at, Scan(hold_s=FRAME_S))) > 0


def test_a_bright_path_is_called_clipped_by_its_light_together():
    stars, at = stars_on([(160.3, 120.6)]), turn((1.0, 0, 0))
    sprites = swept(stars, at, Scan(hold_s=FRAME_S))
    peak = float(linear_image(sprites, SIZE, GaussianPsf(SIGMA)).max())
    assert sprites.per_star > 2
    assert len(clipped_sprites(sprites, GaussianPsf(SIGMA), 0.9 * peak, SIZE)) > 0
    assert len(clipped_sprites(sprites, GaussianPsf(SIGMA), 1.1 * peak, SIZE)) == 0


def crowd(count: int, rng: np.random.Generator):
    """Stars all over the image and as far around it again."""
    return stars_on(
        rng.uniform((-SIZE[0], -SIZE[1]), (2 * SIZE[0], 2 * SIZE[1]), size=(9 * count, 2))
    )


@pytest.mark.parametrize("speed", [0.5, 1.0, 10.0, 57.0, 900.0, 1e6, 1e9])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 0, 1), (0.6, -0.7, 0.2)])
@pytest.mark.parametrize(
    "scan", [Scan((0, 1), FRAME_S, FRAME_S), Scan((1, 0), 100.0, 1e9), Scan(hold_s=FRAME_S)]
)
def test_no_turn_makes_more_than_its_budget_of_sprites(speed, axis, scan, rng):
    stars = crowd(1000, rng)
    still = len(make_sprites(stars, CAMERA.cam_to_image @ to_matrix(Q), CAMERA, FOOTPRINT))
    sprites = swept(stars, CameraTurn(Q, speed * np.array(axis) / np.linalg.norm(axis)), scan)
    assert np.isfinite(sprites.x_px).all()
    assert sprites.per_star <= MAX_NODES
    # A path of half the field's radius takes that many more stars across the image.
    assert 0 < len(sprites) <= 2 * still + EXTRA_SPRITES
    assert sprites.capped > 0


@pytest.mark.parametrize("rate", [(0.0, 0.0, 0.0), (1.0, 0.5, 0.0), (900.0, 0.0, 0.0)])
def test_of_more_stars_than_a_frame_has_room_for_the_brightest_are_drawn(rate, rng, monkeypatch):
    monkeypatch.setattr(sprites_module, "MAX_COVERED_PX", 100 * FOOTPRINT**2)
    stars = stars_on(rng.uniform((10, 10), (310, 230), size=(300, 2)))
    stars.electrons_per_s[:] = rng.permutation(300) + 1.0
    sprites = swept(stars, turn(rate), Scan((0, 1), FRAME_S, FRAME_S))
    drawn = np.unique(sprites.star)
    assert len(drawn) <= 100
    if rate[0] < 10:
        assert sorted(stars.electrons_per_s[drawn]) == list(range(201, 301))
        assert sprites.capped == 200
    still = make_sprites(stars, CAMERA.cam_to_image @ to_matrix(Q), CAMERA, FOOTPRINT)
    assert (len(still), still.capped) == (100, 200)
    assert stars.electrons_per_s[still.star].min() == 201


def test_a_slow_turn_is_drawn_whole_and_none_is_capped(rng):
    sprites = swept(crowd(100, rng), turn((1.0, 0.5, 0)), Scan((0, 1), FRAME_S, FRAME_S))
    assert sprites.per_star > 1
    assert sprites.capped == 0


def test_a_star_whose_path_is_of_a_slower_turn_is_counted_though_it_has_all_its_nodes():
    """A wide star's path over half of the field's radius has fewer nodes than a path may have."""
    stars, scan = stars_on([(160.0, 120.0)]), Scan(hold_s=FRAME_S)
    wide = GaussianPsf((3.0, 3.0))
    for rate_deg_s, capped in ((900.0, 1), (40.0, 0)):
        sprites = swept_sprites(stars, turn((rate_deg_s, 0.0, 0.0)), scan, CAMERA, wide)
        assert 1 < sprites.per_star < MAX_NODES
        assert sprites.capped == capped


def test_a_path_that_is_too_coarse_still_has_all_its_light_in_its_middle(rng):
    """1000 stars in view at 20 deg/s: 50 px each, of which a share of EXTRA_SPRITES is drawn."""
    inside = rng.uniform((110, 90), (210, 150), size=(1000, 2))
    at, scan = turn((14.0, -14.0, 0)), Scan(hold_s=FRAME_S)
    stars = stars_on(inside)
    sprites = swept(stars, at, scan)
    assert sprites.capped == 1000
    wide = GaussianPsf((3.0, 3.0))
    few = EXTRA_PX // wide.footprint_px**2  # of sprites that cover many pixels
    large = swept_sprites(stars_on(inside[:100]), at, scan, CAMERA, wide)
    assert 0.5 * few < len(large) - 100 <= few < 0.6 * EXTRA_SPRITES
    light = np.bincount(sprites.star, sprites.data["electrons_per_s"])
    assert light == pytest.approx(1.0, rel=1e-6)
    x_px, y_px = (
        np.bincount(sprites.star, sprites.data["electrons_per_s"] * part)
        for part in (sprites.x_px, sprites.y_px)
    )
    middle = place_px(stars, at, FRAME_S / 2)
    # The mean of a path lies off its middle by its bend: (path / focal length)^2 / 24 of the
    # distance from the axis.
    assert np.hypot(x_px - middle[:, 0], y_px - middle[:, 1]).max() < 0.01


def test_nodes_belong_to_what_of_a_path_lies_on_the_image():
    """One star crosses the whole image, one only its corner, one passes outside: 1, a few and no
    sprites.
    """
    at, scan = turn((0, 120.0, 0)), Scan(hold_s=FRAME_S)  # 188 px in a frame
    crossing, cutting, outside = (
        stars_on([place]) for place in ((200.0, 120.0), (-20.0, 5.0), (160.0, -40.0))
    )
    towards = np.sign(place_px(crossing, at, FRAME_S)[0, 0] - 200.0)
    cutting = stars_on([(-180.0 if towards > 0 else 10.0, 5.0)])
    whole, part = swept(crossing, at, scan), swept(cutting, at, scan)
    assert len(swept(outside, at, scan)) == 0
    assert 2 < len(part) < len(whole) / 4
    assert np.abs(part.x_px + 0.5).max() < 30


@pytest.mark.parametrize(
    ("orientation", "down"),
    [
        (Orientation(), (0, 1)),
        (Orientation(flip_y=True), (0, -1)),
        (Orientation(flip_x=True), (0, 1)),
        (Orientation(quarter_turns=1), (1, 0)),
        (Orientation(quarter_turns=2), (0, -1)),
        (Orientation(quarter_turns=3), (-1, 0)),
        (Orientation(flip_y=True, quarter_turns=1), (-1, 0)),
    ],
)
def test_the_orientation_says_which_way_the_rows_go(orientation, down):
    assert orientation.down == down


@pytest.mark.parametrize("rate_deg_s", [30.0, -30.0])
def test_a_star_that_runs_with_the_rows_is_lit_for_longer_and_against_them_for_less(rate_deg_s):
    """The panel, which crosses the rows in a frame, overtakes a star that falls by a share s of
    them in a row's light: its row is lit for 1 / (1 - s) of that.
    """
    stars, at = stars_on([(160.0, 119.5)]), turn((rate_deg_s, 0.0, 0.0))
    fall_px = place_px(stars, at, FRAME_S)[0, 1] - 119.5
    assert abs(fall_px) > 40
    sprites = swept(stars, at, Scan((0, 1), FRAME_S, FRAME_S))
    lit = sprites.data["electrons_per_s"].sum()
    # the way is even to the angle of the turn squared
    assert lit == pytest.approx(1 / (1 - fall_px / 240), rel=1e-3)


@pytest.mark.parametrize(
    ("down", "rows", "sign"),
    [((0, 1), 30, 1), ((0, -1), 30, -1), ((1, 0), 40, 1), ((-1, 0), 40, -1)],
    ids=["down", "up", "to the right", "to the left"],
)
def test_a_pixel_beside_the_image_lights_up_with_its_nearest_row(down, rows, sign):
    """0.2 s for all rows, half of it before the middle one: beyond the first and the last row it
    does not go on.
    """
    row = np.array([-500.0, -3.0, -0.5, 0.0, 7.0, rows - 1.0, rows - 0.5, rows + 3.0, 900.0])
    elsewhere = np.full(len(row), 5.0)
    x_px, y_px = (row, elsewhere) if down[0] else (elsewhere, row)
    late_s = Scan(down, scanout_s=0.2).late_s(x_px, y_px, (40, 30))
    share = (np.array([-0.5, -0.5, -0.5, 0.0, 7.0, rows - 1.0, *[rows - 0.5] * 3]) + 0.5) / rows
    assert late_s == pytest.approx(sign * 0.2 * (share - 0.5), abs=1e-12)
