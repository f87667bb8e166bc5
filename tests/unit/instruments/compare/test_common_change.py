"""What all stars of two images differ by, of stars that are stated: no image is drawn or measured."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from hilstar.instruments.compare.sky_comparison import (
    Limits,
    SkyComparison,
    StarDifference,
    common_change,
    common_motion,
    fitted_motion,
    rank_for,
)

SIZE_PX = (200, 100)
MIDDLE = np.array([99.5, 49.5])
FINE = Limits(centroid_px=1e-4)  # far below what stars move by here
ROUNDING = 1e-9


def star(
    x_px: float, y_px: float, error_mag: float = 0.0, moved: tuple[float, float] = (0.0, 0.0)
) -> StarDifference:
    return StarDifference((), x_px, y_px, 1000.0, error_mag, *moved, FINE)


def moved_by(change: np.ndarray, shift: tuple[float, float]) -> list[StarDifference]:
    """A grid of stars that a matrix (2, 2) about the middle of the image and a shift move."""
    places = itertools.product(np.linspace(30.0, 170.0, 5), np.linspace(20.0, 80.0, 4))
    stars = []
    for x_px, y_px in places:
        dx_px, dy_px = change @ (np.array([x_px, y_px]) - MIDDLE) + shift
        stars.append(star(x_px, y_px, 0.0, (float(dx_px), float(dy_px))))
    return stars


@pytest.mark.parametrize(("turn_deg", "scale"), [(0.3, 1.01), (-0.3, 0.99)])
def test_what_turns_and_grows_about_the_middle_shifts_nothing_there(turn_deg, scale):
    turn = math.radians(turn_deg)
    cos, sin = scale * math.cos(turn), scale * math.sin(turn)
    common = common_change(
        moved_by(np.array([[cos, -sin], [sin, cos]]) - np.eye(2), (0.0, 0.0)), SIZE_PX
    )
    assert common is not None
    assert common.shift_px == (0.0, 0.0)
    assert common.rotation_deg == pytest.approx(turn_deg, abs=ROUNDING)
    assert common.scale_error == pytest.approx(scale - 1, abs=ROUNDING)
    assert common.differing == []


@pytest.mark.parametrize(("shift_px", "is_named"), [(0.0099, False), (0.0101, True)])
def test_a_shift_is_named_where_it_moves_half_of_the_stars_beyond_their_limit(shift_px, is_named):
    """Of 40 stars, 19 of which it moves further than the limit of 0.01 px, all by the same motion."""
    places = np.column_stack([np.linspace(-80, 80, 40), 30 * np.cos(np.arange(40.0))])
    moves = np.tile([shift_px, 0.0], (40, 1))
    moves[1::2, 0] += 0.001
    moves[1, 0] = shift_px
    motion = common_motion(places, moves, np.full(40, 0.01))
    assert (motion is not None) is is_named
    if motion is not None:
        assert motion(places)[0] == pytest.approx([shift_px, 0.0], abs=0.0011)


def test_a_motion_is_as_rich_as_its_stars_allow():
    ranks = [rank_for(stars) for stars in (1, 5, 6, 12, 15, 16, 17)]
    assert ranks == [1, 1, 2, 2, 2, 3, 3]


@pytest.mark.parametrize("stars", [4, 6, 16, 40])
def test_the_richest_motion_that_stars_determine_moves_them_as_they_moved(rng, stars):
    """A shift by 4 stars, turn and scale from 6 on, and from 16 on a camera's turn."""
    places = rng.uniform(-80, 80, (stars, 2))
    rank = rank_for(stars)
    assert rank == {4: 1, 6: 2, 16: 3, 40: 3}[stars]
    wide = 1.0
    matrix = np.eye(2)
    if rank == 2:
        matrix = 1.02 * np.array([[math.cos(0.1), -math.sin(0.1)], [math.sin(0.1), math.cos(0.1)]])
    if rank == 3:
        matrix = np.array([[1.01, 0.03], [-0.02, 0.98]])
        wide = 1 + places @ [4e-4, -3e-4]
    moved = (places @ matrix.T + [3.0, -2.0]) / np.reshape(wide, (-1, 1))
    moves = moved - places
    # one star that is another's
    moves[1] += [9.0, 5.0]
    motion = fitted_motion(places, moves, rank)
    kept = np.arange(stars) != 1
    np.testing.assert_allclose(motion(places)[kept], moves[kept], atol=1e-3)


@pytest.mark.parametrize(
    ("error_mag", "rest_mag", "common"),
    [
        (0.2, 0.05, 0.2),
        (-0.2, 0.05, -0.2),
        (0.2, 0.15, 0.0),  # what is left is more than half
        (0.0005, 0.0, 0.0),  # within the limit
    ],
)
def test_a_dimming_is_common_where_it_is_most_of_what_stars_are_off(error_mag, rest_mag, common):
    stars = [
        star(10.0 * k, 50.0, error_mag + off * rest_mag) for k, off in enumerate([1, -1, 0.9, -0.9])
    ]
    stars += [star(10.0 * k, 20.0, error_mag + off * rest_mag) for k, off in enumerate([1.2, -1.2])]
    found = common_change(stars, SIZE_PX)
    if not common:
        assert found is None
        return
    assert found.flux_mag == pytest.approx(common)
    rest = [star.flux_error_mag for star in found.beyond]
    np.testing.assert_allclose(rest, [each.flux_error_mag - common for each in stars])
    assert found.shift_px == (0.0, 0.0)


def test_stars_that_moved_far_are_paired_and_are_no_longer_missing_or_extra(rng):
    """All move by 25 px to the right and up, turn a little and get fainter; one is truly gone."""
    places = np.array(list(itertools.product(np.linspace(20, 150, 6), np.linspace(30, 90, 4))))
    places += rng.uniform(-2, 2, places.shape)
    turn = 0.01
    about = places - MIDDLE
    moved = places + np.array([25.0, -12.0])
    moved += np.column_stack([-turn * about[:, 1], turn * about[:, 0]])
    flux = rng.uniform(100, 1000, len(places))
    missing = [
        StarDifference((k,), x, y, f, math.inf, 0.0, 0.0, FINE)
        for k, ((x, y), f) in enumerate(zip(places.tolist(), flux.tolist(), strict=True))
    ]
    extra = [
        StarDifference((), x, y, 0.9 * f, -math.inf, 0.0, 0.0, FINE)
        for (x, y), f in zip(moved.tolist(), flux.tolist(), strict=True)
    ]
    gone = extra.pop(7)
    found = common_change([*extra, *missing], SIZE_PX)
    assert found.shift_px == pytest.approx((25.0, -12.0), abs=1e-2)
    assert found.rotation_deg == pytest.approx(math.degrees(turn), rel=1e-2)
    assert found.flux_mag == pytest.approx(-2.5 * math.log10(0.9))
    assert len(found.beyond) == len(places) - 1
    assert [each.hip for each in found.alone] == [(7,)]
    assert gone not in found.beyond
    # each star is paired with itself
    off = [math.hypot(each.dx_px, each.dy_px) for each in found.beyond]
    assert max(off) < 0.02


def test_a_turn_counts_by_what_it_moves_the_farthest_corner(rng):
    """111 px from the middle a turn of 1e-4 moves a star by 0.0111 px; all are near the corners."""
    places = rng.choice([-1, 1], (20, 2)) * (MIDDLE - rng.uniform(1, 3, (20, 2))) + MIDDLE
    turned = []
    for x_px, y_px in places.tolist():
        right, down = -1e-4 * (y_px - MIDDLE[1]), 1e-4 * (x_px - MIDDLE[0])
        turned.append(star(x_px, y_px, 0.0, (0.5 + right, down)))
    for limit_px, turn_rad in ((0.0105, 1e-4), (0.0115, 0.0)):
        limits = Limits(centroid_px=limit_px)
        common = common_change([replace(each, limits=limits) for each in turned], SIZE_PX)
        assert common.rotation_deg == pytest.approx(math.degrees(turn_rad), rel=1e-3)


def test_stars_that_a_shift_takes_out_of_view_or_brings_into_it_do_not_differ():
    """All move by 5 px to the right: out of view at the right edge, and in from the left one."""
    out = star(197.0, 50.0, math.inf)
    brought_in = star(2.0, 50.0, -math.inf)
    lost = star(100.0, 30.0, math.inf)
    from_nowhere = star(100.0, 70.0, -math.inf)
    # on the wrong sides: what is missing at the left edge should have moved inwards
    lost_left, new_right = star(2.0, 40.0, math.inf), star(197.0, 40.0, -math.inf)
    alone = [out, brought_in, lost, from_nowhere, lost_left, new_right]
    common = common_change([*moved_by(np.zeros((2, 2)), (5.0, 0.0)), *alone], SIZE_PX)
    assert common is not None
    assert common.shift_px == pytest.approx((5.0, 0.0), abs=ROUNDING)
    assert common.differing == [lost, lost_left, from_nowhere, new_right]


def test_skies_are_the_same_where_each_channel_is():
    same = SkyComparison([star(10.0, 10.0)], FINE, 0)
    differs = SkyComparison([star(10.0, 10.0, 0.5)], FINE, 0)
    assert same.same and not differs.same
    assert SkyComparison(same.stars, FINE, 0, channels={"r": same, "b": same})
    assert not SkyComparison(same.stars, FINE, 0, channels={"r": same, "b": differs})
