"""Short paths against exact ones: through a pinhole and a strong lens with a field of degree 6,
over the whole screen.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.display.geometry import monitor_camera
from hilstar.optics import frame_motion
from hilstar.optics.camera import Lens, ResidualField, bounded
from hilstar.optics.frame_motion import CameraTurn, swept_sprites
from hilstar.optics.paths import (
    LIMIT_PX,
    LIMIT_SHARE,
    MAX_NODES,
    TABLE_PX,
    TRIED_AXES,
    Chords,
    LensTable,
    Paths,
    ShortPaths,
    _excess,
    _lens_table,
    _mapping,
    bend_px,
    node_counts,
    points_within,
)
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.scan import Scan
from tests.support.stars import stars_at

SIZE = (1920, 1080)
FRAME_S = 1 / 60
# of a frame, to both sides: a row holds its light for one, and the row is known to a tenth
HALF = 0.6
FOOTPRINT, SIGMA = 10, (0.85, 0.85)
MARGIN_PX = FOOTPRINT / 2 + 1
AXES = ((0.3, 0.9, 0.2), (-0.8, 0.4, 0.1), (0.9, -0.3, 0.4), (0.1, -0.1, 1.0))
SCREEN = (0.5 * (np.array(SIZE) - 1))[:, None]
# The grid on which a camera is tried is coarser than this screen's.
BETWEEN_THE_TRIED = 1.2


def lens_camera(focal_mm: float, degree: int = 6):
    """The lens of tests/benchmarks/bench_lens.py."""
    camera = monitor_camera(SIZE, 57.65, focal_mm, np.array([1.0, 0.0, 0.0, 0.0]))
    x, y = np.random.default_rng(2).normal(0, 0.3, (2, (degree + 1) * (degree + 2) // 2))
    field = ResidualField.of_terms(x, y, degree, SIZE)
    lens = Lens((0.6, -1.0, 2.0), (1e-3, -1e-3), (0.017, -0.01), field)
    return bounded(replace(camera, lens=lens), MARGIN_PX)


def pinhole(focal_mm: float):
    return replace(lens_camera(focal_mm), lens=None)


CAMERAS = {"pinhole": pinhole(200.0), "wide": lens_camera(200.0), "narrow": lens_camera(350.0)}


def off_px(camera, axis, half_turn_rad, points):
    """Paths that begin all over the screen: their error (moments, stars), exact x and y (2,
    moments, stars), and lengths.
    """
    x, y = np.meshgrid(np.linspace(-0.5, SIZE[0] - 0.5, 49), np.linspace(-0.5, SIZE[1] - 0.5, 33))
    seen = camera.rays(x.ravel(), y.ravel()) @ camera.cam_to_image.T
    exact = Paths(seen / np.linalg.norm(seen, axis=1, keepdims=True), np.array(axis), camera)
    half_s = half_turn_rad / exact.speed_rad_s
    short = ShortPaths(exact, np.full(len(seen), half_s), half_s, points)
    moments = np.linspace(0.0, 2 * half_s, 15)
    places = np.stack(exact.all_places_px(moments[:, None]))
    found = np.stack(
        [short.places_px(slice(None), np.full(len(seen), moment)) for moment in moments], axis=1
    )
    return np.hypot(*(found - places)), places, np.hypot(*(places[:, -1] - places[:, 0]))


def on_screen(places):
    return (np.abs(places - SCREEN[:, None]) <= SCREEN[:, None] + 0.5).all(axis=0)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("rate_deg_s", [1.0, 3.0, 10.0, 20.0, 30.0])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_a_place_is_off_by_no_more_than_the_limit_over_the_whole_screen(camera, rate_deg_s, axis):
    half_turn_rad = np.radians(rate_deg_s) * FRAME_S * HALF
    points = points_within(camera, half_turn_rad)
    if points is None:
        # its stars come from beyond the field's end: see below
        assert (camera, rate_deg_s) == (CAMERAS["narrow"], 30.0)
        return
    off, places, length = off_px(camera, axis, half_turn_rad, points)
    seen = on_screen(places)
    assert seen.any(axis=0).mean() > 0.95
    assert (
        off[seen]
        <= BETWEEN_THE_TRIED * np.maximum(LIMIT_PX, LIMIT_SHARE * length[np.nonzero(seen)[1]])
    ).all()


@pytest.mark.parametrize(
    "camera",
    [CAMERAS["wide"], CAMERAS["narrow"], lens_camera(200.0, degree=10)],
    ids=["wide", "narrow", "wild"],
)
def test_a_table_of_a_lens_is_right_or_not_used(camera, rng):
    """At 40 000 places, a half of them within 8 px of the image's border, where the field is
    steepest.
    """
    size = np.array(SIZE)[:, None]
    px = rng.uniform(-0.5, size - 0.5, (2, 40_000))
    px[:, ::4] = np.where(
        px[:, ::4] < size / 2, rng.uniform(-0.5, 7.5), size - 0.5 - rng.uniform(0, 8)
    )
    px[0, 1::4] = rng.choice([-0.5, SIZE[0] - 0.5], 10_000)
    table = _lens_table(*_mapping(camera))
    found = table.along(np.stack(camera.tangents(*px)), *np.zeros((2, 2, 1)))[0]
    off_px = np.hypot(*(found - px)).max()
    assert 0.8 * table.off_px < off_px < 1.2 * table.off_px
    assert (off_px < TABLE_PX) == (points_within(camera, 1e-6) == 1)


@pytest.mark.parametrize(
    ("points", "camera"), [(1, CAMERAS["narrow"]), (2, CAMERAS["pinhole"]), (3, CAMERAS["narrow"])]
)
def test_the_limit_is_where_it_fails(points, camera):
    """A turn that is twice the longest for its points is off by more than it may be: the limit
    is no mere caution.
    """
    turns = np.geomspace(1e-5, 0.1, 400)
    longest = max(turn for turn in turns if (points_within(camera, turn) or 9) <= points)
    for times, is_too_far, axes in ((2, True, AXES), (1, False, AXES[1:2])):
        worst = 0.0
        for axis in axes:
            off, places, length = off_px(camera, axis, times * longest, points)
            allowed = BETWEEN_THE_TRIED * np.maximum(LIMIT_PX, LIMIT_SHARE * length)
            worst = max(worst, float((off / allowed)[on_screen(places)].max()))
        assert (worst > 1) == is_too_far


def test_a_turn_too_long_for_a_few_points_has_exact_paths():
    """Of 350 mm at 30 deg/s a star of the border comes from 60 px outside: past FIELD_EDGE,
    where the field stands still.
    """
    camera = CAMERAS["narrow"]
    half_turn_rad = np.radians(30.0) * FRAME_S
    assert points_within(camera, half_turn_rad) is None
    worst = []
    for axis in AXES:
        off, places, length = off_px(camera, axis, half_turn_rad, 3)
        worst.append((off / np.maximum(LIMIT_PX, LIMIT_SHARE * length))[on_screen(places)].max())
    assert max(worst) > 1
    assert points_within(camera, 0.0) is None


@pytest.mark.parametrize("rate_deg_s", [0.5, 5.0, 25.0])
@pytest.mark.parametrize("camera", [pinhole(350.0), lens_camera(350.0)], ids=["pinhole", "lens"])
def test_a_frame_of_short_paths_is_a_frame_of_exact_ones(camera, rate_deg_s, rng, monkeypatch):
    """The same stars and light: also of those that cross the border, or the end of the lens
    beyond its corner.
    """
    q, axis = from_radec_roll_deg(84.0, -1.0, 20.0), np.array([0.4, -0.7, 0.3])
    turn = CameraTurn(q, np.radians(rate_deg_s) * axis / np.linalg.norm(axis))
    reach = camera.field_radius_rad(MARGIN_PX) * 1.3
    u, v = rng.uniform(-np.tan(reach), np.tan(reach), (2, 3000))
    image = np.column_stack([u, v, np.ones(3000)])
    stars = stars_at(image @ (camera.cam_to_image @ to_matrix(q)), np.ones(3000))
    scan = Scan((0, 1), FRAME_S, FRAME_S)
    short = swept_sprites(stars, turn, scan, camera, GaussianPsf(SIGMA))
    monkeypatch.setattr(frame_motion, "points_within", lambda camera, half_turn_rad: None)
    monkeypatch.setattr(
        type(camera), "in_view", lambda self, seen, margin_px, reach_rad: np.arange(len(seen))
    )
    exact = swept_sprites(stars, turn, scan, camera, GaussianPsf(SIGMA))
    places = [_means(sprites) for sprites in (short, exact)]
    (light, *of_short), (true, *of_exact) = places
    # a path that ends at the border may have a node more or less there
    assert np.abs(light - true).max() < 0.02
    whole = (light > 0.999) & (true > 0.999)
    assert whole.sum() > 500
    path_px = np.radians(rate_deg_s) * FRAME_S * camera.scales_px_rad()[1]
    # The row's moment is found from short places too: twice their error.
    limit_px = 2 * max(LIMIT_PX, 2 * LIMIT_SHARE * path_px)
    assert (
        np.hypot(*(a[whole] - b[whole] for a, b in zip(of_short, of_exact, strict=True))).max()
        < limit_px
    )


def _means(sprites):
    """The light of each of 3000 stars, and its mean x and y."""
    light = np.bincount(sprites.star, sprites.data["electrons_per_s"], 3000)
    sums = (
        np.bincount(sprites.star, sprites.data["electrons_per_s"] * at, 3000)
        for at in (sprites.x_px, sprites.y_px)
    )
    return light, *(total / np.maximum(light, 1e-9) for total in sums)


@pytest.mark.parametrize("reach_deg", [0.0, 0.3, 20.0])
@pytest.mark.parametrize("camera", [pinhole(200.0), lens_camera(200.0)], ids=["pinhole", "lens"])
def test_no_direction_in_view_is_culled(camera, reach_deg, rng):
    """Random places on the image and its margin, turned away by up to the reach."""
    x, y = (rng.uniform(-0.5 - MARGIN_PX, size - 0.5 + MARGIN_PX, 4000) for size in SIZE)
    seen = camera.rays(x, y) @ camera.cam_to_image.T
    seen = seen[np.isfinite(seen[:, 0])]
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    aside = np.cross(seen, rng.normal(size=seen.shape))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    angle = np.radians(reach_deg) * rng.uniform(0.9, 1.0, (len(seen), 1))
    away = seen * np.cos(angle) + aside * np.sin(angle)
    assert len(camera.in_view(away, MARGIN_PX, np.radians(reach_deg))) == len(away)


def test_directions_beside_the_image_are_culled(rng):
    camera = lens_camera(200.0)
    around = rng.normal(size=(20_000, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    kept = camera.in_view(around, MARGIN_PX, 0.0)
    x, y = camera.project(around)
    seen = (np.abs(x - SCREEN[0]) < 960) & (np.abs(y - SCREEN[1]) < 540)
    assert 0 < seen.sum() <= len(kept) < 1.3 * seen.sum()


def test_turns_about_every_axis_of_a_cube_are_tried():
    """Through its 6 faces, 12 edges and 8 corners, of which opposite ones are one axis."""
    ways = [way for way in itertools.product((-1, 0, 1), repeat=3) if any(way)]
    tried = {way for axis in TRIED_AXES for way in (axis, tuple(-each for each in axis))}
    assert tried == set(ways)


def test_the_error_that_is_tried_is_that_of_all_places_on_the_image():
    """A parabola through the ends and the middle of an arc of 1.2 rad is far off; a straight way
    of the smallest turn is not.
    """
    assert _excess(pinhole(200.0), 0.6, 3) > 10
    assert _excess(pinhole(200.0), 1e-5, 3) < 1


NOWHERE = np.nan
CHORDS_ON_IMAGE = {
    "across": ([-60.0, 140.0], [20.0, 20.0], (0.25, 0.745)),
    "down": ([30.0, 30.0], [-40.0, 160.0], (0.15, 0.545)),
    "within": ([30.0, 40.0], [20.0, 25.0], (0.0, 1.0)),
    "backwards": ([140.0, -60.0], [20.0, 20.0], (0.255, 0.75)),
    "beside": ([-60.0, 140.0], [200.0, 200.0], None),
    "at rest on it": ([30.0, 30.0], [20.0, 20.0], (0.0, 1.0)),
    "at rest beside it": ([130.0, 130.0], [20.0, 20.0], None),
    "at rest left of it": ([-11.0, -11.0], [20.0, 20.0], None),
    "along its upper side": ([-60.0, 140.0], [-11.0, -11.0], None),
    # which way it comes from behind is not known: it counts whole
    "from behind the camera": ([NOWHERE, 40.0], [NOWHERE, 30.0], (0.0, 1.0)),
    "to behind the camera": ([40.0, NOWHERE], [30.0, NOWHERE], (0.0, 1.0)),
    "from behind to far beside": ([NOWHERE, 900.0], [NOWHERE, 30.0], None),
    "behind the camera": ([NOWHERE, NOWHERE], [NOWHERE, NOWHERE], None),
}


@pytest.mark.parametrize("name", CHORDS_ON_IMAGE)
def test_a_chord_is_drawn_where_it_is_on_the_image_or_beside_it_by_a_margin(name):
    """Of an image of 80 x 60 px, whose edges lie half a pixel outside its outer pixels' middles,
    and 9.5 px beside it: from -10 to 89 and to 69 px.
    """
    x_px, y_px, part = CHORDS_ON_IMAGE[name]
    chords = Chords(np.array(x_px)[:, None], np.array(y_px)[:, None])
    (begin,), (end,) = chords.on_image((80, 60), 9.5)
    if part is None:
        assert end <= begin
    else:
        assert (begin, end) == pytest.approx(part)


def test_a_direction_s_tangents_turn_by_their_first_and_second_difference(rng):
    """Of exact places by a pinhole of focal length 1, 0.1 s to either side; the next terms of the
    differences are 1e-4 of these.
    """
    camera = replace(pinhole(200.0), focal_length_px=1.0, principal_point_px=(0.0, 0.0))
    seen = np.column_stack([rng.uniform(-0.5, 0.5, (20, 2)), np.ones(20)])
    paths = Paths(seen, np.array([0.03, -0.05, 0.08]), camera)
    seconds, unit_s = rng.uniform(-1.0, 1.0, 20), 0.1
    before, now, after = (
        np.stack(paths.places_px(slice(None), seconds + step)) for step in (-unit_s, 0.0, unit_s)
    )
    at, first, second = paths.tangents_at(seconds, unit_s)
    assert at == pytest.approx(now, abs=1e-14)
    assert first == pytest.approx((after - before) / 2, rel=1e-3, abs=1e-6)
    assert second == pytest.approx((after + before) / 2 - now, rel=1e-3, abs=1e-8)


def test_a_lens_s_table_turns_a_path_of_tangents_into_one_of_pixels(rng):
    """The polynomial about the nearest node, of 5 x 4 of them 0.1 apart, by tangents that are
    polynomials of time; beyond the table that of its edge.
    """
    terms = rng.normal(size=(6, 2, 20))
    table = LensTable(np.array([[-0.2], [-0.15]]), 10.0, (5, 4), terms)
    at = np.stack([rng.uniform(-0.3, 0.3, 30), rng.uniform(-0.25, 0.25, 30)])
    by = rng.normal(0, 0.1, (2, 30))
    bend = rng.normal(0, 0.1, (2, 30))
    by_time = table.along(at, by, bend)
    for k in range(30):
        column = int(np.clip(np.rint((at[0, k] + 0.2) * 10), 0, 4))
        row = int(np.clip(np.rint((at[1, k] + 0.15) * 10), 0, 3))
        u = Polynomial([(at[0, k] + 0.2) * 10 - column, by[0, k] * 10, bend[0, k] * 10])
        v = Polynomial([(at[1, k] + 0.15) * 10 - row, by[1, k] * 10, bend[1, k] * 10])
        for axis in (0, 1):
            place, by_u, by_v, uu, uv, vv = terms[:, axis, 5 * row + column]
            whole = place + by_u * u + by_v * v + uu * u * u + uv * u * v + vv * v * v
            assert by_time[:, axis, k] == pytest.approx(whole.coef[:3])


def test_a_path_has_nodes_by_its_length_and_all_where_that_is_not_known():
    lengths = np.array([0.0, 0.29, 0.31, 1.0, 10.1, np.nan, np.inf])
    counts = node_counts(lengths, 0.6, 1, 0.3)
    assert counts[:5].tolist() == [1, 1, 2, 2, 8]
    assert (counts[5:] >= MAX_NODES).all()


def test_a_lens_bends_the_most_where_its_distortion_is_largest():
    """k1 r^2 of the direction's own place, farthest out on the image; the principal point is not
    in its middle. A pinhole bends nothing.
    """
    camera = replace(pinhole(350.0), principal_point_px=(700.0, 600.0))
    lens = bounded(replace(camera, lens=Lens((0.5, 0.0, 0.0))), MARGIN_PX)
    u, v = lens.tangents(np.array([SIZE[0] - 0.5]), np.array([-0.5]))
    corner_px = camera.focal_length_px * 0.5 * np.hypot(u, v) ** 3
    assert bend_px(lens) == pytest.approx(float(corner_px[0]))
    assert bend_px(camera) == 0
