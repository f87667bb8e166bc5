"""Attitudes, angles, rates and times as callers have them, in numbers of one unit."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import with_columns
from hilstar.basics.attitudes import (
    angle_deg_of,
    numbers_of,
    quaternion_of,
    quaternions_of,
    rate_of,
    seconds_of,
    share_of,
    t_ns_of,
    whole_of,
)
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg
from tests.support.refusals import refusal

Q = np.array([0.1, 0.5, -0.7, 0.5])  # of norm 1


def test_a_rotation_s_scalar_comes_first():
    rotation = Rotation.from_quat(Q, scalar_first=True)
    assert quaternion_of(rotation) == pytest.approx(Q)
    several = Rotation.from_quat([Q, -Q[[1, 0, 2, 3]]], scalar_first=True)
    assert quaternions_of(several, "q") == pytest.approx(several.as_quat(scalar_first=True))


def test_a_place_has_its_roll_and_0_without_one():
    icrs = SkyCoord(40.0, -20.0, unit="deg")
    assert quaternion_of(icrs) == pytest.approx(from_radec_roll_deg(40.0, -20.0, 0.0))
    turned = from_radec_roll_deg(40.0, -20.0, 30.0)
    assert quaternion_of(icrs.galactic, 30.0) == pytest.approx(turned)
    assert quaternion_of(icrs, 2 * u.hourangle) == pytest.approx(turned)
    for roll_deg in (30.0, 0.0):
        assert "roll_deg" in refusal(quaternion_of, Q, roll_deg)


def test_a_quantity_is_turned_into_the_unit_that_is_wanted():
    assert angle_deg_of(30 * u.arcmin, "roll") == 0.5
    assert seconds_of(20 * u.ms, "exposure") == pytest.approx(0.02)
    assert share_of(50 * u.percent, "share") == 0.5
    assert rate_of([0, 0, 180] * u.deg / u.s) == pytest.approx([0, 0, np.pi])
    assert t_ns_of(2.5 * u.us) == 2500
    assert [t_ns_of(ns * u.ns) for ns in (2.4, 2.6, -2.6)] == [2, 3, -3]
    assert t_ns_of(np.int64(-3)) == -3
    assert numbers_of([1, 2] * u.deg, "places", ("n",), "arcsec", "of places").tolist() == [
        3600.0,
        7200.0,
    ]


@pytest.mark.parametrize(
    ("values", "axes", "form"),
    [
        (np.zeros((2, 3)), (..., 4), "write an array (..., 4) of x"),
        (np.zeros(3), ("n", 3), "write an array (n, 3) of x"),
        (np.zeros((5, 2, 3)), ("n", 3), "write an array (n, 3) of x"),
        (0.0, ("n",), "write an array (n) of x"),
    ],
)
def test_an_array_of_another_shape_is_told_the_one_that_is_wanted(values, axes, form):
    line = refusal(numbers_of, values, "given", axes, "1", "of x")
    assert line.startswith(f"given of shape {np.shape(values)}: ") and line.endswith(form)


def test_an_array_of_any_axes_before_is_taken():
    for shape in ((4,), (2, 4), (5, 2, 4)):
        assert quaternions_of(np.zeros(shape), "q").shape == shape


@pytest.mark.parametrize(
    ("number", "minimum", "maximum", "is_taken"),
    [
        (0, 0, None, True),
        (-1, 0, None, False),
        (5, 1, 5, True),
        (6, 1, 5, False),
        (True, 0, 5, False),
        (1.0, 0, 5, False),
        (np.int32(3), 0, 5, True),
    ],
)
def test_a_whole_number_lies_within_its_limits(number, minimum, maximum, is_taken):
    if is_taken:
        assert whole_of(number, "count", minimum, maximum) == number
        return
    with pytest.raises(InputError, match=f"write a whole number from {minimum} "):
        whole_of(number, "count", minimum, maximum)


def test_columns_more_are_of_the_rows_that_have_them():
    table = np.array([(1,), (2,), (3,)], dtype=[("star", np.int64)])
    added = {"dn": np.array([5.0, 7.0]), "lit": np.array([True, True])}
    wider = with_columns(table, added, np.array([2, 0]))
    assert wider["star"].tolist() == [1, 2, 3]
    np.testing.assert_array_equal(wider["dn"], [7.0, np.nan, 5.0])
    assert wider["lit"].tolist() == [True, False, True]


@pytest.mark.parametrize("rate", [(0.0, np.inf, 0.0), (np.nan, 0.0, 0.0)])
def test_a_rate_that_is_not_finite_is_refused(rate):
    line = refusal(rate_of, rate)
    assert line.startswith("rate_cam_rad_s [") and "]: is not finite; write three numbers" in line


@pytest.mark.parametrize("number", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("scalar_of", [angle_deg_of, seconds_of, share_of])
def test_a_number_that_is_not_finite_is_refused(scalar_of, number):
    line = refusal(scalar_of, number, "roll")
    assert line.startswith(f"roll {number!r}") and "write a number" in line
