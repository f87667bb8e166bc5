"""Dots on a screen and their codes: where they stand, how they are drawn, and how they are told
again from centroids, each by closed forms and planted errors.
"""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from PIL import Image

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import to_matrix
from hilstar.display.geometry import monitor_camera
from hilstar.instruments.calibrate.geometric.dots import (
    DOT_PX,
    EDGE_PX,
    DotPlan,
    SeenScreen,
    _codes,
    _distances,
    _seen_places,
    dot_image,
    dots_of_frames,
    joined,
    lit_for,
    plan_dots,
    plan_seen_dots,
    read_plan,
)
from hilstar.instruments.calibrate.geometric.fit import MatchedDots, Nominal
from hilstar.instruments.calibrate.geometric.geometry_fit import calibrate_files
from hilstar.instruments.calibrate.geometric.match import (
    _middle_places,
    _nearest,
    _refuse_orientation,
    decode,
    first_look,
    frame_shifts,
    homography,
    mapped,
    refuse_motion,
)
from hilstar.instruments.calibrate.geometric.observed import (
    Observed,
    dot_centroids,
    numbered,
    read_image,
    read_observed,
)
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile
from tests.support.bench_files import filed_bench
from tests.support.closed_camera import CLOSED, ClosedCamera
from tests.support.refusals import assert_file_refused, refusal

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
ROUNDING = 1e-9


def observed(frame, x_px, y_px, pose=None) -> Observed:
    frame = np.asarray(frame)
    pose = np.zeros_like(frame) if pose is None else np.asarray(pose)
    x_px, y_px = np.asarray(x_px, dtype=float), np.asarray(y_px, dtype=float)
    return Observed(frame, pose, x_px, y_px, np.ones(len(frame)))


def test_a_dot_is_drawn_about_its_place_in_its_frames():
    plan = DotPlan(
        np.array([10.0, 30.0, 20.0]),
        np.array([6.0, 12.0, 9.0]),
        np.array([[True, False], [True, True], [False, True]]),
    )
    half = DOT_PX // 2
    for frame, places in ((0, [(10, 6), (30, 12)]), (1, [(30, 12), (20, 9)])):
        codes = dot_image(plan, frame, (40, 20), 200)
        assert codes.shape == (20, 40)
        lit = np.zeros((20, 40), dtype=bool)
        for x, y in places:
            lit[y - half : y + half + 1, x - half : x + half + 1] = True
        np.testing.assert_array_equal(codes, 200 * lit)
    assert (plan.frames, len(plan), plan.extent_px) == (2, 3, 20.0)


def test_two_plans_are_one_after_the_other():
    first = DotPlan(np.array([5.0]), np.array([2.0]), np.array([[True, False]]))
    second = DotPlan(np.array([3.0, 5.0]), np.array([4.0, 2.0]), np.array([[False], [True]]))
    both = joined(first, second)
    assert both.x_px.tolist() == [5.0, 3.0, 5.0]
    assert both.y_px.tolist() == [2.0, 4.0, 2.0]
    assert both.lit.tolist() == [[True, False, False], [False, False, False], [False, False, True]]
    # the third stands where the first does
    assert both.sites.tolist() == [0, 1, 0]


def test_a_whole_screen_has_dots_in_its_corners_and_evenly_between(rng):
    plan = plan_dots((300, 200), 12, 20, rng)
    # each lit in five of twelve frames
    assert (plan.lit.sum(axis=1) == 5).all()
    assert len(plan) == round(20 * 12 / 5)
    assert plan.lit.sum(axis=0).mean() == pytest.approx(20, abs=0.5)
    corners = set(itertools.product((EDGE_PX, 299 - EDGE_PX), (EDGE_PX, 199 - EDGE_PX)))
    assert corners <= set(zip(plan.x_px.tolist(), plan.y_px.tolist(), strict=True))
    for places, size in ((plan.x_px, 300), (plan.y_px, 200)):
        assert places.min() == EDGE_PX and places.max() == size - 1 - EDGE_PX
        thirds = np.histogram(places, bins=3, range=(EDGE_PX, size - 1 - EDGE_PX))[0]
        assert thirds.min() > 0.6 * len(plan) / 3
    assert "too small for dots" in refusal(plan_dots, (12, 200), 12, 20, rng)
    assert "8 frames or more" in refusal(plan_dots, (300, 200), 7, 20, rng)


@pytest.mark.parametrize(("count", "frames"), [(12, 8), (40, 16)])
def test_codes_are_of_one_weight_and_two_frames_or_more_apart(rng, count, frames):
    codes = _codes(count, frames, rng)
    assert len(set(codes.sum(axis=1).tolist())) == 1
    apart = [(a != b).sum() for a, b in itertools.combinations(codes, 2)]
    assert min(apart) >= 2
    # of three frames in eight there are 56 codes
    assert "more than the codes of 8 frames" in refusal(_codes, 57, 8, rng)


def screen(ratio: float = 1.5, psf_px: float = 0.8, *, is_sure: bool = True) -> SeenScreen:
    """A screen of 640 x 480 px, turned by 20 degrees before a tracker of 400 x 300 px that sees its
    middle.
    """
    half = math.radians(10)
    turned = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
    return SeenScreen(
        monitor_camera((640, 480), 50.0, 100.0, turned),
        monitor_camera((400, 300), 50.0 / ratio, 100.0, UPRIGHT),
        is_sure=is_sure,
        psf_sigma_px=psf_px,
    )


def seen_at(seen: SeenScreen, x_px, y_px):
    """Where the tracker sees pixels of the screen, by a pinhole and a turn alone."""
    ratio = seen.tracker_px_a_monitor_px
    right, down = np.asarray(x_px) - 319.5, np.asarray(y_px) - 239.5
    turn = math.radians(-20)
    x = ratio * (math.cos(turn) * right - math.sin(turn) * down)
    y = ratio * (math.sin(turn) * right + math.cos(turn) * down)
    return 199.5 + x, 149.5 + y


def test_what_a_tracker_sees_of_a_turned_screen_is_a_pinhole_s():
    seen = screen()
    assert seen.tracker_px_a_monitor_px == pytest.approx(1.5)
    assert seen.turn_deg == pytest.approx(-20.0)
    assert seen.dot_sigma_px == pytest.approx(math.hypot(0.8, 4.5 / math.sqrt(12)))
    assert (seen.dot_shape.side_px, seen.dot_shape.turn_deg) == pytest.approx((4.5, -20.0))
    x, y = np.array([319.5, 400.0, 200.0, 260.0]), np.array([239.5, 200.0, 300.0, 100.0])
    u, v = seen_at(seen, x, y)
    inside = (u > 20) & (u < 379) & (v > 20) & (v < 279)
    assert seen.shows(x, y).tolist() == inside.tolist()
    low, high = seen.box()
    corners = np.array(list(itertools.product((low[0], high[0]), (low[1], high[1]))))
    # the box of a turned field reaches beyond it in its corners
    assert not seen.shows(*corners.T).any()
    assert seen.shows(*((low + high) / 2)[:, None]).all()
    unsure = screen(is_sure=False)
    wide_low, wide_high = unsure.box()
    assert (wide_low < low).all() and (wide_high > high).all()


def test_dots_over_what_is_seen_are_apart_and_reach_its_edges(rng):
    seen = screen()
    plan = plan_seen_dots(seen, 16, 12, rng)
    assert seen.shows(plan.x_px, plan.y_px).all()
    assert (plan.x_px == np.rint(plan.x_px)).all()
    places = np.stack([plan.x_px, plan.y_px], axis=1)
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    np.fill_diagonal(apart, np.inf)
    area = 400 * 300 / 1.5**2
    nearest = apart.min(axis=1)
    # two that are outermost in neighbouring directions may stand closer, the others not
    assert np.median(nearest) > 0.5 * math.sqrt(area / len(plan))
    assert (nearest < 0.4 * math.sqrt(area / len(plan))).sum() <= 8
    assert nearest.min() > 3 * DOT_PX - 1
    u, v = seen_at(seen, plan.x_px, plan.y_px)
    assert u.min() < 30 and u.max() > 369 and v.min() < 30 and v.max() > 269
    beside = plan_seen_dots(seen, 16, 12, rng, beside=plan)
    others = np.stack([beside.x_px, beside.y_px], axis=1)
    # as many as were asked for, no nearer to those of another plan than 0.3 of their own distance
    assert len(plan) == len(beside) == dots_of_frames(16, 12)
    assert _distances(others, places).min() > 0.28 * math.sqrt(359 * 259 / 1.5**2 / len(plan))
    x, _ = _seen_places(seen, 12, np.empty((0, 2)))
    assert len(x) == 12
    # 40 px and more from dot to dot, of 2.5 sides and 20 px of wings
    wanted = 400 * 300 / max(40.0, 2.5 * 4.5 + 20) ** 2
    assert lit_for(seen) == pytest.approx(wanted, rel=0.35)


def test_distances_are_to_the_nearest_other():
    places = np.array([[0.0, 0.0], [10.0, 0.0]])
    others = np.array([[3.0, 4.0], [10.0, 1.0]])
    assert _distances(places, others).tolist() == [5.0, 1.0]
    assert np.isinf(_distances(places, np.empty((0, 2)))).all()


def test_a_projective_map_of_four_points_and_more_is_found_exactly(rng):
    true = np.array([[1.2, 0.1, 30.0], [-0.2, 0.9, -12.0], [2e-4, -3e-4, 1.0]])
    u, v = rng.uniform(-300, 300, (2, 40))
    x, y = mapped(true, u, v)
    np.testing.assert_allclose(homography(u, v, x, y), true, rtol=1e-7, atol=1e-9)
    four = homography(u[:4], v[:4], x[:4], y[:4])
    np.testing.assert_allclose(four, true, rtol=1e-6, atol=1e-8)
    # many at once, as RANSAC's samples are
    stacked = homography(*(part.reshape(10, 4) for part in (u, v, x, y)))
    np.testing.assert_allclose(stacked, np.broadcast_to(true, (10, 3, 3)), rtol=1e-4, atol=1e-6)


def codes_seen(plan: DotPlan, rng, noise_px=0.1) -> Observed:
    """Every lit dot of every frame at 2 x + 30, 2 y - 10, with noise."""
    dot, frame = np.nonzero(plan.lit)
    x = 2 * plan.x_px[dot] + 30 + rng.normal(0, noise_px, len(dot))
    y = 2 * plan.y_px[dot] - 10 + rng.normal(0, noise_px, len(dot))
    return observed(frame, x, y)


def test_dots_are_known_by_their_codes_through_lost_and_false_centroids(rng):
    plan = plan_dots((300, 200), 16, 20, rng)
    seen = codes_seen(plan, rng)
    lost = rng.uniform(size=len(seen)) < 0.05
    kept = seen.at(np.flatnonzero(~lost))
    false = observed(rng.integers(0, 16, 12), rng.uniform(0, 600, 12), rng.uniform(0, 380, 12))
    found = decode(plan, kept.joined(false))
    assert len(found.dot) > 0.85 * len(plan)
    assert len(set(found.dot.tolist())) == len(found.dot)
    np.testing.assert_allclose(found.x_px, 2 * plan.x_px[found.dot] + 30, atol=0.3)
    np.testing.assert_allclose(found.y_px, 2 * plan.y_px[found.dot] - 10, atol=0.3)
    # what blinks in frames that the plan does not have is none of its dots
    late = replace(kept, frame=kept.frame + 16)
    assert len(decode(plan, late).dot) == 0


def test_centroids_are_matched_with_the_nearest_lit_dot_where_both_agree():
    plan = DotPlan(
        np.array([0.0, 10.0, 20.0]),
        np.array([0.0, 0.0, 5.0]),
        np.array([[True, False], [True, True], [False, True]]),
    )
    # frame 0 has dots 0 and 1, frame 1 dots 1 and 2
    seen = observed([0, 0, 0, 1, 1], [0.4, 9.0, 11.5, 20.5, 13.5], [0.1, 0.2, 0.0, 5.0, 0.0])
    found = _nearest(plan, seen, seen.x_px, seen.y_px, 3.0)
    # dot 1 of frame 0 takes the nearer of two, and 3.5 px are too far
    assert found.dot.tolist() == [0, 1, 2]
    assert found.centroids.x_px.tolist() == [0.4, 9.0, 20.5]
    wider = _nearest(plan, seen, seen.x_px, seen.y_px, 4.0)
    assert wider.dot.tolist() == [0, 1, 2, 1]
    away = seen.x_px.copy()
    away[0] = np.nan
    assert 0 not in _nearest(plan, seen, away, seen.y_px, 4.0).dot


def moving_dots(rng, shifts, noise_px=0.01) -> MatchedDots:
    """Twenty dots in each of some frames, whose images stand off by these shifts along y."""
    x, y = rng.uniform(0, 400, (2, 20))
    frame = np.repeat(np.arange(len(shifts)), 20)
    dot = np.tile(np.arange(20), len(shifts))
    noise = rng.normal(0, noise_px, (2, len(frame)))
    seen = observed(frame, x[dot] + noise[0], y[dot] + noise[1] + np.asarray(shifts)[frame])
    return MatchedDots(seen, dot)


def test_a_frame_that_moved_is_told_with_its_axis_and_by_how_much(rng):
    still = moving_dots(rng, [0.0] * 6)
    refuse_motion(still)
    shifts = [0.0, 0.0, 0.02, -0.3, 0.0, 0.0]
    moved = moving_dots(rng, shifts)
    found = frame_shifts(moved, moved.centroids.y_px)
    np.testing.assert_allclose(found.shift, shifts, atol=0.02)
    assert found.frames.tolist() == [0, 1, 2, 3, 4, 5]
    # of six frames' medians, which are two of them
    assert found.noise == pytest.approx(0.008, rel=0.3)
    words = refusal(refuse_motion, moved)
    assert re.search(r"moved by 0\.3\d px in y between frames 2 and 3", words)


def test_frames_are_named_in_their_own_numbers(rng):
    moved = moving_dots(rng, [0.0, 0.2, 0.0])
    late = MatchedDots(replace(moved.centroids, frame=moved.centroids.frame + 5), moved.dot)
    assert "between frames 5 and 6" in refusal(refuse_motion, late) or "7" in refusal(
        refuse_motion, late
    )


WAYS = [(turns, is_mirrored) for turns in range(4) for is_mirrored in (False, True)]


def cured(file: BenchFile, words: str) -> BenchFile:
    """The bench file after what a refusal says is done to it."""
    monitor = file.config.monitor
    keys: dict[str, object] = {}
    turn = re.search(r"add (\d+) to \[monitor\] rotate_deg", words)
    if turn:
        keys["rotate_deg"] = (monitor.rotate_deg + int(turn[1])) % 360
    for key in ("flip_x", "flip_y"):
        if f"{key} the other way" in words:
            keys[key] = not getattr(monitor, key)
    assert keys, words
    config = msgspec.structs.replace(file.config, monitor=msgspec.structs.replace(monitor, **keys))
    return replace(file, config=config)


@pytest.mark.parametrize(("turns", "is_mirrored"), WAYS[1:])
def test_the_cure_of_an_orientation_makes_the_image_upright(tmp_path, turns, is_mirrored):
    """Of a square screen, by where the camera sees three of its pixels."""

    def mounted(shown: np.ndarray) -> np.ndarray:
        turned = np.rot90(shown, turns)
        return turned[:, ::-1] if is_mirrored else turned

    file = filed_bench(tmp_path, CLOSED, {"monitor": {"resolution_px": [96, 96]}})
    camera = ClosedCamera(mounted=mounted)
    codes = np.zeros((96, 96), dtype=np.uint16)
    x, y = np.array([30, 60, 30, 70]), np.array([20, 20, 75, 65])
    codes[y, x] = [1, 2, 3, 4]
    seen = camera.seen(file, codes)
    rows, columns = (
        np.array(part)
        for part in zip(*[np.argwhere(seen == k)[0] for k in (1, 2, 3, 4)], strict=True)
    )
    focal_px = 500.0
    u, v = (columns - 47.5) / focal_px, (rows - 47.5) / focal_px
    matrix = homography(u, v, x.astype(float), y.astype(float))
    lens = Camera((96, 96), focal_px, (47.5, 47.5), np.eye(3))
    nominal = Nominal(lens, UPRIGHT, lens)
    words = refusal(_refuse_orientation, nominal, matrix)
    assert words.startswith("the tracker sees the monitor ")
    better = camera.seen(cured(file, words), codes)
    np.testing.assert_array_equal(better, codes)
    _refuse_orientation(nominal, homography(u, v, 500 * u + 47.5, 500 * v + 47.5))


def test_dots_closer_than_a_link_are_not_taken_for_one(rng):
    """Two pixels and a half apart, at less than a tenth of that of noise."""
    x, y = (part.ravel() for part in np.meshgrid(np.arange(6) * 1.25, np.arange(5) * 1.25))
    plan = DotPlan(x, y, plan_dots((300, 200), 16, 14, rng).lit[:30])
    assert len(plan.lit) == 30
    found = decode(plan, codes_seen(plan, rng))
    assert found.dot.tolist() == list(range(30))
    np.testing.assert_allclose(found.x_px, 2 * x + 30, atol=0.2)
    np.testing.assert_allclose(found.y_px, 2 * y - 10, atol=0.2)


def test_of_two_places_that_blink_one_dot_s_code_the_one_with_fewer_errors_is_it(rng):
    """The first of them misses a frame, or the second does."""
    plan = plan_dots((300, 200), 16, 14, rng)
    seen = codes_seen(plan, rng)
    frames = np.flatnonzero(plan.lit[3])
    for missed, places in (((frames[1:], frames), 1), ((frames, frames[1:]), 0)):
        x_px = 1000.0 + 100.0 * np.repeat([0, 1], [len(frame) for frame in missed])
        false = observed(np.concatenate(missed), x_px, np.full(len(x_px), 900.0))
        others = seen.at(np.flatnonzero(np.abs(seen.x_px - (2 * plan.x_px[3] + 30)) > 1))
        found = decode(plan, others.joined(false))
        assert found.x_px[found.dot == 3] == pytest.approx([1000.0 + 100.0 * places])


PLANS = [
    ("0,0,1,2\n-1,0,1,2\n", ":3: '-1,0,1,2'; whole numbers frame and dot"),
    ("0,-1,1,2\n", ":2: '0,-1,1,2'; whole numbers"),
    ("1000001,0,1,2\n", ":2: '1000001,0,1,2'; whole numbers"),
    ("0.5,0,1,2\n", "whole numbers"),
    ("0,0,inf,2\n", "a dot's place is no number"),
    ("0,0,1,nan\n", "a dot's place is no number"),
    ("", "has no dot"),
]


@pytest.mark.parametrize(("rows", "words"), PLANS, ids=range(len(PLANS)))
def test_what_is_no_plan_of_dots_is_refused(tmp_path, rows, words):
    (tmp_path / "plan.csv").write_text(f"frame,dot,x_px,y_px\n{rows}")
    assert_file_refused(read_plan, tmp_path / "plan.csv", f"...{words}")


def test_images_are_known_by_the_last_number_of_their_names_and_their_folder_s_pose():
    paths = [Path(name) for name in ("a/x2_003.png", "pose_2/7.png", "POSE1/f12b.png", "f0.png")]
    found = numbered(paths)
    assert found == dict(zip(((3, 0), (7, 2), (12, 1), (0, 0)), paths, strict=True))
    assert numbered([Path("1000000.png")]) == {(10**6, 0): Path("1000000.png")}
    for names, why in (
        (["dark.png"], "dark.png: its name has no frame number"),
        (["1000001.png"], "no frame number"),
        (["a/3.png", "b/03.png"], "b/03.png: is frame 3 of pose 0, and so is a/3.png"),
    ):
        with pytest.raises(InputError, match=re.escape(why)):
            numbered([Path(name) for name in names])


@pytest.mark.parametrize("disordered", [0, 1])
def test_frames_in_disorder_are_named_with_their_pose_but_the_first(disordered, rng):
    plan = plan_dots((300, 200), 16, 20, rng)
    poses = []
    for pose in range(2):
        seen = codes_seen(plan, rng)
        if pose == disordered:
            seen = replace(seen, frame=15 - seen.frame)
        poses.append(replace(seen, pose=np.full(len(seen), pose)))
    lens = Camera((640, 480), 2000.0, (319.5, 239.5), np.eye(3))
    words = refusal(first_look, plan, Nominal(lens, UPRIGHT, lens), poses[0].joined(poses[1]), rng)
    beginning = "pose 1: " if disordered else ""
    assert words.startswith(f"{beginning}the frames are in reverse order")


def test_a_pose_is_turned_as_its_image_is(rng):
    """By a quarter turn what was at the right is below, about the middle of the tracker's image."""
    plan = plan_dots((300, 200), 16, 20, rng)
    first = codes_seen(plan, rng)
    right, down = first.x_px - 319.5, first.y_px - 239.5
    second = replace(first, x_px=319.5 - down, y_px=239.5 + right, pose=first.pose + 1)
    lens = Camera((640, 480), 2000.0, (319.5, 239.5), np.eye(3))
    look = first_look(plan, Nominal(lens, UPRIGHT, lens), first.joined(second), rng)
    turns = to_matrix(look.q_poses)
    np.testing.assert_allclose(turns[0], np.eye(3), atol=1e-9)
    np.testing.assert_allclose(turns[1], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-3)


def test_an_image_of_another_size_is_refused_by_both_sizes(tmp_path):
    path = tmp_path / "frame_0.png"
    codes = np.arange(24, dtype=np.uint8).reshape(4, 6)
    Image.fromarray(codes).save(path)
    np.testing.assert_array_equal(read_image(path, (6, 4)), codes)
    wanted = "is 6 x 4 px, and [tracker] resolution_px is 8 x 5"
    assert wanted in refusal(read_image, path, (8, 5))
    assert "is 6 x 4 px" in refusal(read_image, path, (4, 6))


HEAD = "frame,x_px,y_px,sigma_px,pose\n"


def test_centroids_of_a_table_are_those_of_its_rows(tmp_path):
    path = tmp_path / "dots.csv"
    path.write_text(HEAD + "3,1.5,-2.5,0.25,1\n0,7,8,,\n")
    seen = read_observed(path)
    assert (seen.frame.tolist(), seen.pose.tolist()) == ([3, 0], [1, 0])
    assert (seen.x_px.tolist(), seen.y_px.tolist()) == ([1.5, 7.0], [-2.5, 8.0])
    assert (seen.sigma_px.tolist(), seen.edge_px) == ([0.25, 1.0], 0.0)


@pytest.mark.parametrize(
    "row",
    [
        *("-1,1,2,1,0", "1000000,1,2,1,0", "0.5,1,2,1,0", "0,nan,2,1,0", "0,1,inf,1,0"),
        *("0,1,2,0,0", "0,1,2,-1,0", "0,1,2,inf,0", "0,1,2,1,-1", "0,1,2,1,1000"),
    ],
)
def test_a_row_that_is_no_centroid_is_refused_with_its_line(tmp_path, row):
    path = tmp_path / "dots.csv"
    path.write_text(HEAD + "0,1,2,1,0\n" + row + "\n")
    words = refusal(read_observed, path)
    assert words.startswith(f"{path}:3: {row!r}; a frame from 0, finite x_px and y_px, sigma_px")


@pytest.mark.parametrize(
    ("x_px", "y_px", "is_beyond"),
    [(95, 119, False), (96, 119, True), (95, 120, True), (40, 30, False)],
)
def test_a_plan_of_a_larger_screen_is_refused_before_its_images(tmp_path, x_px, y_px, is_beyond):
    """Of a screen that is higher than it is wide."""
    plan = tmp_path / "plan.csv"
    plan.write_text(f"frame,dot,x_px,y_px\n0,0,10,10\n1,1,{x_px},{y_px}\n")
    missing = [tmp_path / "none.csv"]
    file = filed_bench(tmp_path, CLOSED, {"monitor": {"resolution_px": [96, 120]}})
    words = refusal(calibrate_files, file, missing, plan, None, tracker_is_ideal=True)
    off = f"{plan}: has dots off this monitor of 96 x 120 px"
    assert words.startswith(off if is_beyond else f"{missing[0]}: ")


@pytest.mark.parametrize("place", ["12,20", "10,25"])
def test_a_dot_at_two_places_is_refused_whichever_axis_it_moves_along(tmp_path, place):
    plan = tmp_path / "plan.csv"
    plan.write_text(f"frame,dot,x_px,y_px\n0,3,10,20\n1,3,10,20\n2,3,{place}\n")
    assert refusal(read_plan, plan).startswith(f"{plan}: dot 3 is at two places")


def test_poses_are_told_by_places_over_the_middle_of_the_dots():
    """Dots over 100 to 600 px and 40 to 90 px: four columns and rows over the middle 60 %."""
    x_px, y_px = np.array([600.0, 100, 300]), np.array([40.0, 80, 90])
    plan = DotPlan(x_px, y_px, np.ones((3, 1), dtype=bool))
    x_px, y_px = _middle_places(plan)
    assert sorted({round(x, 6) for x in x_px.tolist()}) == [200, 300, 400, 500]
    assert sorted({round(y, 6) for y in y_px.tolist()}) == [50, 60, 70, 80]
    assert len(x_px) == 16


@pytest.mark.parametrize(
    ("frames", "dots"), [(8, 120 / 3), (16, 240 / 6), (20, 300 / 8), (24, 360 / 10), (60, 900 / 10)]
)
def test_a_dot_is_lit_in_two_frames_of_five_and_in_three_to_ten(frames, dots):
    """15 dots in each frame, of which every one is lit in so many."""
    assert dots_of_frames(frames, 15) == round(dots)
    with pytest.raises(InputError, match="--frames 7: the dots' codes need 8 frames or more"):
        dots_of_frames(7, 15)


def test_dots_of_a_wide_psf_stand_farther_apart():
    """18 sigmas of 4 px, and 2.5 sides of 4.5 px: 83 px from dot to dot in place of 40."""
    seen = replace(screen(), psf_sigma_px=4.0)
    # in the field in which a dot's window is whole
    margin_px = dot_centroids(seen.dot_sigma_px).radius_px + 1
    area_px2 = (399 - 2 * margin_px) * (299 - 2 * margin_px)
    assert abs(lit_for(seen) - area_px2 / 83.25**2) < 1.0


def test_dots_are_measured_in_a_window_as_wide_as_they_are_and_of_1_5_px_at_least():
    widths_px = [dot_centroids(sigma_px).window_sigma_px for sigma_px in (0.4, 1.5, 6.0)]
    assert widths_px == [1.5, 1.5, 6.0]


def test_a_dot_is_on_the_screen_to_6_px_from_the_middles_of_its_outermost_pixels():
    """Of 640 x 480 px, before a tracker that sees beyond all its edges."""
    tracker = Camera((2000, 1500), 1000.0, (999.5, 749.5), np.eye(3))
    monitor = Camera((640, 480), 1000.0, (319.5, 239.5), np.eye(3))
    seen = SeenScreen(monitor, tracker, is_sure=True, psf_sigma_px=0.8)
    x_px = np.array([6.0, 5.9, 633.0, 633.1, 300.0, 300.0, 300.0, 300.0])
    y_px = np.array([200.0, 200.0, 200.0, 200.0, 6.0, 5.9, 473.0, 473.1])
    assert seen.shows(x_px, y_px).tolist() == [True, False] * 4
    lower, upper = seen.box()
    assert (lower.tolist(), upper.tolist()) == ([EDGE_PX, EDGE_PX], [639 - EDGE_PX, 479 - EDGE_PX])
