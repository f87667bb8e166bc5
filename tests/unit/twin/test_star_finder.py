"""Which stars the twin compares."""

from __future__ import annotations

import math

import numpy as np

from hilstar.tracker.centroids import Centroids
from hilstar.twin.verify.display_errors import median
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


def test_nothing_measured_has_no_zero_point():
    assert median([math.nan, 2.0, math.inf, 4.0]) == 3.0
    assert median([]) == 0.0
