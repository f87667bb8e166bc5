"""What all stars of two images differ by, of stars that are stated: no image is drawn or measured."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from hilstar.instruments.compare.sky_comparison import (
    Limits,
    SkyComparison,
    StarDifference,
    common_change,
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


def test_what_turns_and_grows_about_the_middle_shifts_nothing_there():
    turn = math.radians(0.3)
    cos, sin = 1.01 * math.cos(turn), 1.01 * math.sin(turn)
    common = common_change(
        moved_by(np.array([[cos, -sin], [sin, cos]]) - np.eye(2), (0.0, 0.0)), SIZE_PX
    )
    assert common is not None
    assert common.shift_px == (0.0, 0.0)
    assert common.rotation_deg == pytest.approx(0.3, abs=ROUNDING)
    assert common.scale_error == pytest.approx(0.01, abs=ROUNDING)
    assert common.differing == []


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
