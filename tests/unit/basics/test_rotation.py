"""The conventions of the design's section 2, and the laws of rotation."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.rotation import (
    angle_between_rad,
    conjugate,
    direction_of,
    frame_turns,
    from_matrix,
    from_radec_roll_deg,
    from_rotation_vectors,
    multiply,
    normalise,
    propagate,
    random_attitude,
    random_attitudes,
    rate_between_rad_s,
    rotate,
    slerp,
    to_matrix,
    to_radec_roll_deg,
    to_rotation_vector,
    turn_text,
)

# The check values are printed with seven decimals.
PRINTED = 6e-8
# A few dozen float64 operations on numbers of size 1.
ROUNDING = 1e-14
# Angles in degrees, up to 360: the same operations, in a larger unit.
ROUNDING_DEG = 1e-11
# Kolmogorov's bound on the largest distance of a share from its law, times the root of the count:
# it is passed by chance once in 10 000.
KOLMOGOROV = 2.23
ATTITUDES = 4000


@pytest.mark.parametrize(
    ("radec_roll", "expected"),
    [
        ((0, 0, 0), (0.5, 0.5, -0.5, 0.5)),
        ((84.057, -1.200, 0), (0.6987226, 0.7135120, -0.0370377, 0.0362700)),
        ((283.021, 35.349, 30), (0.3257559, -0.0677680, -0.4540152, 0.8265354)),
    ],
)
def test_the_design_s_check_values_come_out(radec_roll, expected):
    q = from_radec_roll_deg(*radec_roll)
    assert np.abs(q - expected).max() < PRINTED


def test_a_direction_is_where_the_boresight_points():
    ra_deg, dec_deg = np.array([0.0, 40.0, 283.0, 10.0]), np.array([0.0, 20.0, -89.0, 90.0])
    found = direction_of(ra_deg, dec_deg)
    for ra, dec, vector in zip(ra_deg, dec_deg, found, strict=True):
        assert np.allclose(
            to_matrix(from_radec_roll_deg(ra, dec, 7.0)) @ vector, [0, 0, 1], rtol=0, atol=ROUNDING
        )
        assert direction_of(ra, dec) == pytest.approx(vector, abs=ROUNDING)


def test_at_roll_zero_north_is_up_and_east_is_left():
    r = to_matrix(from_radec_roll_deg(40.0, 20.0, 0.0))
    ra, dec = np.radians([40.0, 20.0])
    boresight = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    east = [-np.sin(ra), np.cos(ra), 0]
    north = [-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)]
    assert np.allclose(r @ boresight, [0, 0, 1], atol=ROUNDING)
    assert np.allclose(r @ east, [-1, 0, 0], atol=ROUNDING)
    assert np.allclose(r @ north, [0, -1, 0], atol=ROUNDING)


def test_radec_roll_comes_back(rng):
    for ra, dec, roll in zip(
        rng.uniform(0, 360, 200),
        rng.uniform(-89.9, 89.9, 200),
        rng.uniform(0, 360, 200),
        strict=True,
    ):
        back = np.array(to_radec_roll_deg(from_radec_roll_deg(ra, dec, roll)))
        assert np.abs(back - [ra, dec, roll]).max() < ROUNDING_DEG / np.cos(np.radians(dec))


def test_right_ascension_and_roll_never_reach_360():
    for angle in (-1e-15, 360.0, 720.0):
        ra, _, roll = to_radec_roll_deg(from_radec_roll_deg(angle, 10.0, angle))
        assert 0 <= ra < 360
        assert 0 <= roll < 360


@pytest.mark.parametrize(
    ("turn_deg", "decimals", "text"),
    [
        (359.99996, 4, "0.0000"),
        (359.9996, 3, "0.000"),
        (359.9994, 3, "359.999"),
        (0.0, 4, "0.0000"),
        (84.057, 3, "84.057"),
    ],
)
def test_no_turn_is_written_as_360(turn_deg, decimals, text):
    assert turn_text(turn_deg, decimals) == text


def test_the_product_turns_vectors_one_after_the_other(rng):
    a, b = normalise(rng.normal(size=4)), normalise(rng.normal(size=4))
    assert np.allclose(to_matrix(multiply(a, b)), to_matrix(a) @ to_matrix(b), atol=ROUNDING)
    assert np.allclose(to_matrix(multiply(a, conjugate(a))), np.eye(3), atol=ROUNDING)


def test_a_turning_camera_sees_vectors_turn_the_other_way(rng):
    """v_cam' = -omega x v_cam, by central differences."""
    q, rate, v = normalise(rng.normal(size=4)), rng.normal(size=3), rng.normal(size=3)
    h = 1e-4
    slope = (to_matrix(propagate(q, rate, h)) @ v - to_matrix(propagate(q, rate, -h)) @ v) / (2 * h)
    # The error of a central difference: h^2/6 of the third derivative, here |omega|^3 |v| < 100.
    assert np.abs(slope + np.cross(rate, to_matrix(q) @ v)).max() < 100 * h * h / 6 + 1e-10


def test_slerp_meets_its_ends_and_keeps_its_pace(rng):
    for scale in (1e-9, 1e-5, 1e-4, 1e-2, 1.0, 3.0):
        a = normalise(rng.normal(size=4))
        rate = normalise(rng.normal(size=3)) * scale
        b = propagate(a, rate, 1.0)
        for f in (0.0, 0.3, 0.5, 1.0):
            q = slerp(a, b, f)
            assert abs(np.linalg.norm(q) - 1) < ROUNDING
            assert angle_between_rad(q, propagate(a, rate, f)) < 1e-12


def test_slerp_takes_the_shorter_way_whatever_the_sign(rng):
    a = normalise(rng.normal(size=4))
    b = propagate(a, np.array([0.1, 0.2, -0.1]), 1.0)
    assert angle_between_rad(slerp(a, b, 0.4), slerp(a, -b, 0.4)) < ROUNDING


def test_slerp_between_opposite_attitudes_stays_unit():
    a = np.array([1.0, 0, 0, 0])
    half_turn = np.array([0.0, 1, 0, 0])
    assert np.linalg.norm(slerp(a, half_turn, 0.5)) == pytest.approx(1, abs=ROUNDING)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1e-4, 0.1, 3.1])
def test_the_rate_between_two_attitudes_is_the_one_that_turned_them(rng, angle):
    a = normalise(rng.normal(size=4))
    rate = normalise(rng.normal(size=3)) * angle / 0.25
    found = rate_between_rad_s(a, propagate(a, rate, 0.25), 0.25)
    assert np.abs(found - rate).max() < 1e-13 / 0.25 + 1e-14


def test_the_rate_between_two_attitudes_is_that_of_the_shorter_way(rng):
    """-q is the attitude of q."""
    q = normalise(rng.normal(size=4))
    rate = np.array([0.01, -0.02, 0.03])
    later = propagate(q, rate, 2.0)
    for sign in (1, -1):
        np.testing.assert_allclose(rate_between_rad_s(q, sign * later, 2.0), rate, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("turn_deg", [120.0, 179.0, 180.0])
def test_a_matrix_of_a_large_turn_about_any_axis_gives_its_quaternion(axis, turn_deg):
    half = np.radians(turn_deg / 2)
    q = np.zeros(4)
    q[0], q[1 + axis] = np.cos(half), np.sin(half)
    assert from_matrix(to_matrix(q)) == pytest.approx(q, abs=1e-15)


@pytest.mark.parametrize("angle_rad", [1e-9, 5e-5, 1.9e-4, 0.3, 3.0])
def test_rotation_vectors_come_back_of_either_sign_of_their_quaternions(angle_rad):
    vectors = angle_rad * np.array([[0.6, -0.48, 0.64], [0.0, 1.0, 0.0]])
    q = from_rotation_vectors(vectors)
    for same in (q, -q, np.array([1, -1])[:, None] * q):
        # a float64's sine and norm: 1e-15 each
        assert to_rotation_vector(same) == pytest.approx(vectors, rel=1e-14, abs=1e-15 * angle_rad)


@pytest.mark.parametrize(
    ("axis", "seen"),
    [(0, [[1, 3, -2], [1, -3, 2]]), (1, [[-3, 2, 1], [3, 2, -1]]), (2, [[2, -1, 3], [-2, 1, 3]])],
)
def test_a_frame_turned_about_an_axis_has_a_vector_turned_the_other_way(axis, seen):
    """By a quarter turn and back: y is x of a frame that is turned from x to y about z."""
    turns = frame_turns(axis, np.array([np.pi / 2, -np.pi / 2]))
    vectors = np.array([[1.0, 2.0, 3.0]] * 2)
    assert rotate(turns, vectors) == pytest.approx(np.array(seen, dtype=float), abs=1e-14)


def test_random_attitudes_are_uniform_over_all_rotations(rng):
    """(t - sin t) / pi of them turn by less than t; a boresight is as often at each right ascension
    and at each sine of its declination.
    """
    q = random_attitudes(ATTITUDES, rng)
    assert q.shape == (ATTITUDES, 4)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=ROUNDING)
    turn_rad = 2 * np.arccos(np.abs(q[:, 0]))
    x, y, z = to_matrix(q)[:, 2].T
    ra_turns = np.arctan2(y, x) / (2 * np.pi) + 0.5
    for shares in ((turn_rad - np.sin(turn_rad)) / np.pi, ra_turns, (z + 1) / 2):
        steps = np.arange(1, ATTITUDES + 1) / ATTITUDES
        assert np.abs(np.sort(shares) - steps).max() < KOLMOGOROV / np.sqrt(ATTITUDES)


def test_one_random_attitude_is_the_next_of_many():
    q = random_attitudes(2, np.random.default_rng(7))
    rng = np.random.default_rng(7)
    np.testing.assert_array_equal([random_attitude(rng), random_attitude(rng)], q)
