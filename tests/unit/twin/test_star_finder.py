"""Which stars the twin compares, and what a wrong geometry explains of their errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.tracker.centroids import Centroids
from hilstar.twin.verify.display_errors import fit_geometry, median
from hilstar.twin.verify.measured import Star
from hilstar.twin.verify.star_finder import crowded, nearest, shared


def test_a_star_is_crowded_by_the_light_that_others_bring_into_its_window():
    """Window of 9 px, sigma 1: a neighbour at the window's edge brings half of its light, one 3 px past it a thousandth."""
    place = [100.0, 104.5, 200.0, 207.5, 300.0, 307.5, np.nan]
    flux = [1.0, 1.0, 1.0, 1.0, 1.0, 1000.0, 1.0]
    assert crowded(np.array(place), np.full(7, 50.0), np.array(flux), 4, (1.0, 1.0)).tolist() == [
        True,
        True,
        False,
        False,
        True,
        False,
        False,
    ]


def test_two_stars_that_are_found_as_one_are_no_two():
    assert shared(np.array([-1, 0, 1, 1, -1])).tolist() == [False, False, True, True, False]
    nothing = np.empty(0)
    found = Centroids(nothing, nothing, nothing, nothing, np.empty(0, dtype=np.intp), np.empty(0, dtype=np.bool_))
    assert nearest(found, np.array([1.0, np.nan]), np.array([2.0, 2.0])).tolist() == [-1, -1]


def star(x_px: float, y_px: float, dx_px: float, dy_px: float) -> Star:
    return Star(1, 5.0, x_px, y_px, 0.0, dx_px, dy_px, 0.0, 0.0, 0.0, 0.0)


def test_scale_rotation_and_shift_are_told_apart(rng):
    x, y = rng.uniform(0, 100, (2, 30))
    dx, dy = 0.01 * (x - 50) - 0.002 * (y - 50) + 0.3, 0.01 * (y - 50) + 0.002 * (x - 50) - 0.1
    fit = fit_geometry([star(*row) for row in zip(x, y, dx, dy, strict=True)], (50.0, 50.0))
    assert (fit.scale_error, fit.rotation_rad, *fit.offset_px) == pytest.approx((0.01, 0.002, 0.3, -0.1))
    assert fit.left < 1e-20
    chance = fit_geometry([star(*row) for row in zip(x, y, *rng.normal(size=(2, 30)), strict=True)], (50.0, 50.0))
    assert 0.7 < chance.left < 1.3  # 60 residuals, 4 unknowns: chi^2 of 56 over 56, sigma 0.19
    assert fit_geometry([star(1, 2, 0, 0)] * 5, (0.0, 0.0)) is None


def test_nothing_measured_has_no_zero_point():
    assert median([math.nan, 2.0, math.inf, 4.0]) == 3.0
    assert median([]) == 0.0
