"""What layers of light hide, list and count, on cameras and skies of a few stars."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.rotation import from_rotation_vector, to_matrix
from hilstar.display.render.reference import extended_image, linear_image
from hilstar.optics.camera import Camera, Lens, bounded
from hilstar.optics.extended import LightMap
from hilstar.optics.layers.bodies import DiscDrawing, past_discs
from hilstar.optics.layers.layers import light_of
from hilstar.optics.layers.star_layer import StarLayer
from hilstar.optics.layers.truth import (
    TRUTH_DTYPE,
    brightest_in_view,
    clipped_in,
    designations,
    sprite_names,
    sprite_truth,
    with_channels,
)
from hilstar.optics.layers.view import Canvas, View
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.scan import Scan
from hilstar.optics.sprites import AddedLight, join_sprites
from hilstar.sky.bodies.disc import Air, Disc
from hilstar.sky.stars import Stars, with_bodies
from tests.support.stars import sprites_at, stars_at

CAMERA = Camera((96, 80), 500.0, (47.5, 39.5), np.eye(3))
CANVAS = Canvas(CAMERA, GaussianPsf((0.8, 0.8)))
AT_START = View(np.array([1.0, 0.0, 0.0, 0.0]))
AHEAD = np.array([0.0, 0.0, 1.0])
FOOTPRINT = 5
NO_LIGHT = join_sprites([], FOOTPRINT)


def sky_of(directions: np.ndarray) -> tuple[Stars, object]:
    """Stars in some directions, and a sprite of each, as bright."""
    stars = stars_at(directions, np.ones(len(directions)))
    order = np.argsort(stars.row)
    places = np.column_stack(CAMERA.project(stars.vectors[order]))
    return stars, replace(sprites_at(places, np.ones(len(order)), FOOTPRINT), star=order)


def test_stars_beside_a_limb_are_dimmed_by_the_air_to_its_top():
    """At the tangent heights of an exponential air: exp(-tau e^(-h / H)), tau that of a ray that
    touches the ground (Chapman's limit).
    """
    scale_km, depth, radius_km, distance_km = 8.0, 0.3, 6378.0, 6778.0
    air = Air(scale_km, depth)
    sphere = Disc(
        "Earth", AHEAD, distance_km, radius_km, radius_km, np.array([0.0, 1.0, 0.0]), -AHEAD,
        "lambert", 1.0, 1.0, air,
    )  # fmt: skip
    heights_km = np.array([-50.0, 1.0, 30.0, 50.0, 70.0, 200.0])
    angle = np.arcsin((radius_km + heights_km) / distance_km)
    directions = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    stars, light = sky_of(directions)
    stars = with_bodies(stars, ("Earth",), np.zeros(1))
    left = past_discs(light, stars, [sphere], np.array([distance_km]))
    tau = depth * np.sqrt(2 * np.pi * radius_km / scale_km)
    wanted = np.exp(-tau * np.exp(-np.maximum(heights_km, 0.0) / scale_km))
    wanted[heights_km < 0] = 0.0
    shown = np.zeros(len(heights_km))
    shown[stars.row[left.star]] = left.data["electrons_per_s"]
    assert 0.9 < wanted[3] < wanted[4] < 0.999  # the air's upper parts do dim
    # what lets through under half a percent is not drawn at all
    np.testing.assert_allclose(shown, np.where(wanted < 0.005, 0.0, wanted), rtol=2e-3)


MOUNTED = to_matrix(from_rotation_vector(np.array([0.03, -0.02, 0.7])))
WIDE = Camera((90, 60), 400.0, (40.0, 33.5), MOUNTED)
TURN = np.radians((1.5, -2.0, 6.0))
# radius^2 / 2 of the focal length by perspective, and a quadrature's share of the path
SAME_PLACE_PX = 0.05
# A star and a disc that fall by a share s of the rows meanwhile are lit until theirs are written
# again, 1 / (1 - s): s is up to 0.03 here, and known to its square.
ROW_SHARE = 2e-3
# of a face's variance, px^2: the quadratures of its places and of the camera's poses, and rows that
# the face runs with for a share s of its light, up to 0.03, twice
FACE_PX2 = 0.2
ROWS = [(0, 1), (0, -1), (1, 0), (-1, 0)]


@pytest.mark.parametrize(
    "view",
    [
        *[View(AT_START.q_icrs_to_cam, TURN, scan=Scan(down, 0.1, 0.02)) for down in ROWS],
        View(AT_START.q_icrs_to_cam, TURN, scan=Scan(hold_s=0.2)),
        View.exposure(AT_START.q_icrs_to_cam, TURN, 0.2),
        View(AT_START.q_icrs_to_cam, None, scan=Scan(hold_s=0.2)),
    ],
    ids=["down", "up", "right", "left", "held", "exposed", "still"],
)
def test_a_disc_goes_where_a_star_in_its_middle_goes(view):
    """A face of 4 px under the Sun and a star, by a camera that turns: row after row in each
    direction of a screen's rows, held, in an exposure, and at rest. Each has its middle of light
    at the same place, off the middle of an image that is not square.
    """
    canvas = Canvas(WIDE, GaussianPsf((0.8, 1.0)))
    towards = MOUNTED.T @ np.array([0.06, -0.045, 1.0])
    towards /= np.linalg.norm(towards)
    face = Disc(
        "Moon", towards, 100.0, 1.0, 1.0, np.array([0.0, 1.0, 0.0]), -towards, "lambert"
    ).of_rate(1e6)
    stars = stars_at(towards[None], np.full(1, 1e6))
    none = join_sprites([], canvas.psf.footprint_px)
    lights = (
        light_of(canvas, [StarLayer(canvas)], stars, view),
        DiscDrawing(canvas).drawn(none, [face], view),
    )
    images = [linear_image(light, WIDE.resolution_px, canvas.psf) for light in lights]
    y, x = np.indices(images[0].shape)
    middles = [(image * [x, y]).sum(axis=(1, 2)) / image.sum() for image in images]
    assert images[1].sum() == pytest.approx(images[0].sum(), rel=ROW_SHARE)
    assert middles[1] == pytest.approx(middles[0], abs=SAME_PLACE_PX)
    # and as wide along its way, but for the face's own width: of 4 px under the Sun, 4^2 / 5
    for axis in (0, 1):
        spread = [
            (image * ([x, y][axis] - middle[axis]) ** 2).sum() / image.sum()
            for image, middle in zip(images, middles, strict=True)
        ]
        assert spread[1] - spread[0] == pytest.approx(3.2, abs=FACE_PX2)


def test_what_a_disc_hides_is_farther_than_it():
    """A body as a point behind a disc, at its distance but for a kilometre, and before it."""
    face = Disc("Moon", AHEAD, 1000.0, 20.0, 20.0, np.array([0.0, 1.0, 0.0]), -AHEAD, "lambert")
    stars = with_bodies(stars_at(AHEAD[None], np.ones(1)), ("Moon", "Mars"), np.zeros(2))
    stars.vectors[1:] = AHEAD
    light = replace(sprites_at(np.full((3, 2), 40.0), np.ones(3), FOOTPRINT), star=np.arange(3))
    for far_km, shown in ((1001.0, []), (999.0, [2])):
        left = past_discs(light, stars, [face], np.array([1000.0, far_km]))
        assert left.star.tolist() == shown


def test_a_satellite_is_left_to_its_own_layer_which_knows_what_hides_it():
    """It has its place among the bodies' before theirs, and no distance there."""
    face = Disc("Moon", AHEAD, 1000.0, 20.0, 20.0, np.array([0.0, 1.0, 0.0]), -AHEAD, "lambert")
    stars = with_bodies(stars_at(AHEAD[None], np.ones(1)), ("SAT",), np.zeros(1), found=False)
    stars = with_bodies(stars, ("Moon",), np.zeros(1))
    stars.vectors[1:] = AHEAD
    light = replace(sprites_at(np.full((3, 2), 40.0), np.ones(3), FOOTPRINT), star=np.arange(3))
    left = past_discs(light, stars, [face], np.array([1000.0]))
    assert left.star.tolist() == [1]


def test_a_streak_is_listed_in_the_middle_of_its_light():
    """Three sprites of 1, 2 and 5 parts of the light, along a line that is not an axis."""
    stars = stars_at(np.eye(3), np.ones(3))
    places = np.array([[10.0, 4.0], [20.0, 6.0], [40.0, 9.0]])
    light = replace(sprites_at(places, np.array([1.0, 2.0, 5.0]), FOOTPRINT), star=np.full(3, 2))
    rows, star = sprite_truth(stars, replace(light, per_star=3), np.empty(0, dtype=np.intp))
    assert star.tolist() == [2]
    assert (rows["x_px"][0], rows["y_px"][0]) == pytest.approx((250 / 8, 61 / 8), rel=1e-6)


@pytest.mark.parametrize("clipping", [[], [2], [0, 1], [4]])
def test_a_star_of_several_sprites_is_one_row_that_clips_where_any_of_them_does(clipping):
    """Three of one star, one of each of two others; the place is the middle of the light."""
    stars = stars_at(np.eye(3), np.ones(3))
    places = np.array([[10.0, 5.0], [20.0, 5.0], [30.0, 9.0], [50.0, 6.0], [60.0, 7.0]])
    light = sprites_at(places, np.array([1.0, 2.0, 1.0, 5.0, 7.0]), FOOTPRINT)
    light = replace(light, star=np.array([1, 1, 1, 0, 2]), per_star=3)
    rows, star = sprite_truth(stars, light, np.array(clipping, dtype=np.intp))
    assert star.tolist() == [0, 1, 2]
    np.testing.assert_allclose(rows["x_px"], [50.0, 20.0, 60.0], rtol=1e-6)
    np.testing.assert_allclose(rows["y_px"], [6.0, 6.0, 7.0], rtol=1e-6)
    wanted = [star in {light.star[k] for k in clipping} for star in (0, 1, 2)]
    assert rows["clipped"].tolist() == wanted


def test_what_clips_is_named_by_its_name_or_else_its_number():
    rows = np.zeros(4, dtype=TRUTH_DTYPE)
    rows["hip"] = [7, 8, 0, 9]
    rows["name"] = ["", "Rigel", "Moon", "dim"]
    rows["clipped"] = [True, True, True, False]
    assert clipped_in(rows) == [7, "Rigel", "Moon"]


def test_each_channel_of_a_tracker_has_its_share_of_a_row_s_electrons():
    rows = np.zeros(2, dtype=TRUTH_DTYPE)
    rows["electrons_per_s"] = [100.0, 10.0]
    assert with_channels(rows, None) is rows
    table = with_channels(rows, np.array([[0.5, 0.3, 0.2], [0.1, 0.2, 0.7]]))
    for name, light in (("r", [50.0, 1.0]), ("g", [30.0, 2.0]), ("b", [20.0, 7.0])):
        assert table[f"electrons_{name}_per_s"] == pytest.approx(np.array(light))
    assert table["electrons_per_s"].tolist() == [100.0, 10.0]


def test_light_that_faults_add_has_rows_of_its_own_by_its_names():
    """A line of two sprites and a point, beside a star; what no catalogue knows is not known."""
    stars = stars_at(np.eye(3), np.ones(3))
    places = np.array([[10.0, 5.0], [20.0, 9.0], [30.0, 8.0], [50.0, 6.0]])
    light = sprites_at(places, np.array([1.0, 3.0, 5.0, 7.0]), FOOTPRINT)
    added = (AddedLight("line", 2.5, 0.25, 40.0), AddedLight("point", 6.0, 1.5, 50.0))
    light = replace(light, star=np.array([-1, -1, 2, -2]), added=added, per_star=2)
    rows, star = sprite_truth(stars, light, np.array([1]))
    assert star.tolist() == [2, -2, -1]
    named = {str(row["name"]): row for row in rows[1:]}
    for name, *figures in (
        ("line", 17.5, 8.0, 2.5, 0.25, 40.0, True),
        ("point", 50.0, 6.0, 6.0, 1.5, 50.0, False),
    ):
        columns = ("x_px", "y_px", "v_mag", "bv", "electrons_per_s", "clipped")
        assert [named[name][column] for column in columns] == pytest.approx(figures)
        assert named[name]["drawn"]
        assert np.isnan([named[name][c] for c in ("temperature_k", "ra_deg", "sigma_mag")]).all()


def test_what_is_seen_is_named_once_by_its_number_or_its_own_name():
    stars = stars_at(np.eye(3), np.ones(3))
    light = sprites_at(np.full((5, 2), 20.0), np.ones(5), FOOTPRINT)
    added = (AddedLight("line", 2.5, 0.25, 40.0), AddedLight("point", 6.0, 1.5, 50.0))
    light = replace(light, star=np.array([-1, -1, 2, -2, 2]), added=added, per_star=2)
    names = designations(stars, light, np.arange(5))
    number = int(stars.hip[2])
    assert (names[0], set(names[1:]), len(names)) == (number, {"line", "point"}, 3)
    assert sprite_names(stars, light) == ["line", "line", number, "point", number]
    assert designations(stars, light, np.array([0])) == ("line",)


def test_the_brightest_in_view_are_stars_and_discs_on_the_pixels_with_their_angles():
    """A disc has no sprite; a star whose footprint alone reaches the image is not on it."""
    rays = np.array([[0.03, -0.04, 1.0], [-0.06, 0.02, 1.0], [0.098, 0.0, 1.0], [0.0, 0.05, 1.0]])
    stars = with_bodies(stars_at(rays, np.ones(4)), ("Moon",), np.zeros(1))
    order = stars.row[:4]
    stars.vectors[4] = AHEAD
    stars.v_mag[:] = [*np.array([3.0, 1.0, 0.0, 2.0])[order], -12.0]
    rows = np.flatnonzero(order != 3)
    places = np.column_stack(CAMERA.project(stars.vectors[rows]))
    light = replace(sprites_at(places, np.ones(3), FOOTPRINT), star=rows, discs=("Moon",))
    views = brightest_in_view(light, stars, CAMERA, AT_START.q_icrs_to_cam, 5)
    named = [(view.name, view.hip, view.v_mag) for view in views]
    assert named == [("Moon", 0, -12.0), ("", 1, 1.0), ("HIP 1", 0, 3.0)]  # by its own number
    angles_deg = np.degrees(np.arctan([0.0, np.hypot(0.06, 0.02), 0.05]))
    assert [view.from_boresight_deg for view in views] == pytest.approx(angles_deg, abs=1e-9)
    assert (views[2].x_px, views[2].y_px) == pytest.approx((47.5 + 15.0, 39.5 - 20.0))
    sky_deg = np.degrees(np.arctan2(-0.04, 0.03)) % 360, np.degrees(np.arctan2(1.0, 0.05))
    assert (views[2].ra_deg, views[2].dec_deg) == pytest.approx(sky_deg)
    assert len(brightest_in_view(light, stars, CAMERA, AT_START.q_icrs_to_cam, 2)) == 2


def test_an_image_without_a_star_has_no_rows():
    stars = stars_at(np.eye(3), np.ones(3))
    rows, star = sprite_truth(stars, join_sprites([], FOOTPRINT), np.empty(0, dtype=np.intp))
    assert (len(rows), len(star)) == (0, 0)


@pytest.mark.parametrize(
    ("white_e_per_s", "hold_s", "largest_e_per_s"),
    [
        (np.inf, 0.01, 20_000.0),
        (np.inf, 0.1, 2000.0),
        (np.inf, 0.0, 200.0),  # a second, where light comes at once
        (1500.0, 0.1, 1500.0),
        (1500.0, 0.2, 1000.0),
        (1500.0, 0.0, 200.0),
        (150.0, 0.0, 150.0),
    ],
)
def test_a_pixel_shows_at_most_its_white_or_its_full_well_in_an_exposure(
    white_e_per_s, hold_s, largest_e_per_s
):
    """A full well of 200 electrons."""
    canvas = replace(CANVAS, white_e_per_s=white_e_per_s, full_e=200.0)
    view = replace(AT_START, scan=Scan(hold_s=hold_s))
    assert canvas.white_in(view) == pytest.approx(largest_e_per_s)


@pytest.mark.parametrize(
    ("view", "away_s"),
    [
        (AT_START, 0.0),
        (replace(AT_START, scan=Scan(hold_s=0.2)), 0.0),
        (View(AT_START.q_icrs_to_cam, TURN, scan=Scan((0, 1), 0.1, 0.04)), 0.09),
        (View(AT_START.q_icrs_to_cam, TURN, scan=Scan((0, 1), 0.1, 0.2), exposed=True), 0.15),
    ],
    ids=["at once", "still", "row by row", "rolling shutter"],
)
def test_bodies_are_looked_for_as_far_as_the_camera_turns_in_their_time(view, away_s):
    """A frame's light ends half of the scan and the hold after the attitude; an exposure's begins
    and ends half of its whole before and after.
    """
    drawing = DiscDrawing(Canvas(WIDE, GaussianPsf((0.8, 1.0))))
    more_rad = float(np.linalg.norm(TURN)) * away_s
    more = drawing.reach_rad(view) - drawing.reach_rad(AT_START)
    assert more == pytest.approx(more_rad, abs=1e-12)


@pytest.mark.parametrize("radius_px", [3.0, 15.0])
def test_no_diffuse_light_shines_through_a_dark_body(radius_px):
    """Small ones are maps, large ones drawn ray by ray; a new Moon has no light of its own."""
    disc = Disc(
        "Moon", AHEAD, 500 / radius_px, 1.0, 1.0, np.array([0.0, 1.0, 0.0]), AHEAD, "lambert"
    )
    even = LightMap(np.ones((80, 96), np.float32))
    before = replace(NO_LIGHT, extended=(even,))
    light = DiscDrawing(CANVAS).drawn(before, [disc], AT_START)
    image = extended_image(light.extended, CAMERA.resolution_px)
    assert image[39:41, 47:49].max() < 0.01
    # the disc's area, by a pixel's width of its limb
    assert (1 - image).sum() == pytest.approx(np.pi * radius_px**2, rel=0.02)
    assert image[:5].min() == 1


@pytest.mark.parametrize("sigma_px", [(0.4, 0.8), (1.0, 0.7), (2.5, 3.0)])
def test_a_disc_in_an_exposure_is_a_chain_of_edges_as_near_as_its_psf_is_narrow(sigma_px):
    """Poses at most 1.6 sigmas apart, and no more than one a sigma, to the next odd number."""
    disc = Disc("Moon", AHEAD, 12.0, 1.0, 1.0, np.array([0.0, 1.0, 0.0]), -AHEAD, "lambert")
    drawing = DiscDrawing(Canvas(CAMERA, GaussianPsf(sigma_px)))
    length_px = 20.0
    rate = np.array([0.0, length_px / CAMERA.focal_length_px, 0.0])
    view = View.exposure(AT_START.q_icrs_to_cam, rate, 1.0)
    lights = drawing.drawn(NO_LIGHT, [disc], view).extended
    ahead = np.array([light.icrs_to_image[:, 2] for light in lights])
    places_px = np.sort(ahead[:, 0] / ahead[:, 2]) * CAMERA.focal_length_px
    length_sigma = length_px / min(sigma_px)
    assert np.diff(places_px).max() < 1.6 * min(sigma_px)
    assert len(lights) % 2 == 1 and len(lights) < length_sigma + 2
    assert sum(light.times for light in lights) == pytest.approx(1.0)


def is_over(disc: Disc, white_e_per_s: float, canvas: Canvas, view: View = AT_START) -> bool:
    drawing = DiscDrawing(replace(canvas, white_e_per_s=white_e_per_s))
    return drawing.drawn(NO_LIGHT, [disc], view).over_white == ("Moon",)


def test_a_thin_crescent_is_over_white_by_its_lit_limb():
    """10 degrees from new it is half a pixel wide. A Lambert sphere's brightest is at the limb,
    which from 20 radii is seen 2.9 degrees short of a quarter turn: the Sun is 7.1 degrees high.
    """
    towards = np.array([np.sin(np.radians(10)), 0.0, np.cos(np.radians(10))])
    turned = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]) @ towards
    pole = np.array([0.0, 1.0, 0.0])
    crescent = Disc("Moon", AHEAD, 20.0, 1.0, 1.0, pole, turned, "lambert", 1e6)
    height_rad = np.radians(10) - np.arcsin(1 / 20)
    brightest = 1e6 * np.sin(height_rad) / CAMERA.focal_length_px**2
    assert is_over(crescent, 0.95 * brightest, CANVAS)
    assert not is_over(crescent, 1.01 * brightest, CANVAS)


def test_behind_a_lens_a_disc_is_over_white_by_the_largest_solid_angle_of_a_pixel():
    bowed = bounded(replace(CAMERA, lens=Lens((8.0, 0.0, 0.0))), 20.0)
    even = Disc("Moon", AHEAD, 20.0, 1.0, 1.0, AHEAD, -AHEAD, "uniform", 1e6)
    smallest, largest = bowed.scales_px_rad()
    canvas = replace(CANVAS, camera=bowed)
    assert largest > 1.1 * smallest
    assert is_over(even, 0.99e6 / smallest**2, canvas)
    assert not is_over(even, 1.01e6 / smallest**2, canvas)


def test_a_small_disc_that_an_exposure_moves_is_over_white_by_the_light_of_all_its_poses():
    """2 px wide, and moved by 2 sigmas: a chain of three."""
    small = Disc("Moon", AHEAD, 500.0, 1.0, 1.0, AHEAD, -AHEAD, "uniform", 1e6)
    rate = np.array([0.0, 1.6 / CAMERA.focal_length_px, 0.0])
    view = View.exposure(AT_START.q_icrs_to_cam, rate, 1.0)
    lights = DiscDrawing(CANVAS).drawn(NO_LIGHT, [small], view).extended
    peaks = [float(light.image.max()) for light in lights]
    assert len(peaks) == 3
    assert is_over(small, 1.2 * max(peaks), CANVAS, view)
    assert not is_over(small, 1.01 * sum(peaks), CANVAS, view)


def test_stars_without_paths_are_points_though_the_camera_turns():
    stars = stars_at(np.array([[0.01, 0.02, 1.0]]), np.ones(1))
    view = View(AT_START.q_icrs_to_cam, TURN, scan=Scan((0, 1), 0.1, 0.2))
    empty = join_sprites([], FOOTPRINT)
    point = StarLayer(CANVAS, paths=False).add(empty, stars, view)
    assert len(point) == 1
    assert (point.x_px[0], point.y_px[0]) == pytest.approx((52.5, 49.5))
    assert len(StarLayer(CANVAS).add(empty, stars, view)) > 1
