"""Found stars become an attitude: near an expected one, and lost in space by tetra3rs, against
the truth.
"""

from __future__ import annotations

import builtins
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import (
    angle_between_rad,
    from_rotation_vector,
    multiply,
    normalise,
    to_matrix,
)
from hilstar.sky.catalog import load_catalog
from hilstar.sky.stars import unit_vectors_icrs
from hilstar.tracker.identify import GAIA_RECORD, FoundStars, LostInSpace, identify, wahba

FOCAL_PX, SIDE_PX = 5384.6, 1024
ARCSEC = np.pi / 180 / 3600
NOISE_PX = 0.05
# About the boresight n stars r px from it say s / (r sqrt(n)); five sigma of 20 stars at 300 px.
LIMIT_RAD = 5 * NOISE_PX / 300 / np.sqrt(20)


@pytest.fixture(scope="module")
def sky():
    catalog = load_catalog().brighter_than(6.5)
    order = np.argsort(catalog.v_mag, kind="stable")
    return unit_vectors_icrs(catalog, 2026.0)[order], catalog.v_mag[order]


@pytest.fixture(scope="module")
def lost_in_space(sky):
    return LostInSpace(*sky, FOCAL_PX, (SIDE_PX, SIDE_PX))


class SeenSky:
    """Stars that a camera of 10.9 degrees sees at an attitude, with noise, false ones and one
    that a neighbour pulled away.
    """

    def __init__(self, sky, q, rng, false=5):
        self.vectors, v_mag = sky
        x, y = self.place(self.vectors @ to_matrix(q).T)
        seen = np.flatnonzero((np.abs(x - 511.5) < 512) & (np.abs(y - 511.5) < 512))
        x, y = (each[seen] + rng.normal(0, NOISE_PX, len(seen)) for each in (x, y))
        x[3] += 1.0
        x, y = (np.append(each, rng.uniform(0, SIDE_PX, false)) for each in (x, y))
        flux = np.append(3e6 * 10 ** (-0.4 * v_mag[seen]), np.full(false, 2e4))
        order = np.argsort(-flux)
        rays = np.stack([x - 511.5, y - 511.5, np.full(len(x), FOCAL_PX)], axis=1)
        self.found = FoundStars(x[order], y[order], flux[order], normalise(rays[order]))

    def place(self, rays):
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(rays[:, 2] > 0.5, FOCAL_PX / rays[:, 2], np.nan)
        return rays[:, 0] * scale + 511.5, rays[:, 1] * scale + 511.5

    def near(self, q):
        near = np.flatnonzero(self.vectors @ to_matrix(q)[2] > np.cos(np.radians(7.7)))
        return near, self.vectors[near]


def test_lost_in_space_and_then_by_all_stars_is_the_true_attitude_wherever_the_camera_looks(
    sky, lost_in_space, rng
):
    for q in normalise(rng.normal(size=(25, 4))):
        seen = SeenSky(sky, q, rng)
        rays = seen.found.rays
        guess = lost_in_space.solve(rays[:, :2] / rays[:, 2:], seen.found.flux_e)
        assert guess is not None
        known = identify(seen.found, guess, seen.near, seen.place)
        assert known is not None
        assert angle_between_rad(known.q_icrs_to_cam, q) < LIMIT_RAD


def test_noise_alone_is_no_attitude(sky, lost_in_space, rng):
    x, y = rng.uniform(0, SIDE_PX, (2, 30))
    rays = normalise(np.stack([x - 511.5, y - 511.5, np.full(30, FOCAL_PX)], axis=1))
    assert lost_in_space.solve(rays[:, :2] / rays[:, 2:], np.ones(30)) is None
    seen = SeenSky(sky, normalise(rng.normal(size=4)), rng)
    assert (
        identify(
            FoundStars(x, y, np.ones(30), rays),
            normalise(rng.normal(size=4)),
            seen.near,
            seen.place,
        )
        is None
    )


@pytest.mark.parametrize(("right", "is_known"), [(5, False), (8, False), (15, True)])
def test_half_of_what_is_found_has_to_be_the_catalogue_s(sky, rng, right, is_known):
    """Of 20 spots in Orion: where fewer lie on stars, the others say that this is another field."""
    q = np.array([0.6987226, 0.7135120, -0.0370377, 0.0362700])
    seen = SeenSky(sky, q, rng, false=0)
    wrong = 20 - right
    x_px = np.append(seen.found.x_px[5 : 5 + right], rng.uniform(0, SIDE_PX, wrong))
    y_px = np.append(seen.found.y_px[5 : 5 + right], rng.uniform(0, SIDE_PX, wrong))
    rays = normalise(np.stack([x_px - 511.5, y_px - 511.5, np.full(20, FOCAL_PX)], axis=1))
    known = identify(FoundStars(x_px, y_px, np.full(20, 1e5), rays), q, seen.near, seen.place)
    assert (known is not None) is is_known


@pytest.mark.parametrize("off_px", [0.5, 9.0])
def test_an_expected_attitude_may_be_off_by_the_first_radius(sky, rng, off_px):
    q = normalise(rng.normal(size=4))
    expected = multiply(from_rotation_vector(np.array([0.6, 0.8, 0.0]) * off_px / FOCAL_PX), q)
    seen = SeenSky(sky, q, rng)
    known = identify(seen.found, expected, seen.near, seen.place)
    assert known is not None
    assert angle_between_rad(known.q_icrs_to_cam, q) < LIMIT_RAD
    assert known.rms_rad < 2 * NOISE_PX / FOCAL_PX  # the star that was pulled away is none of them


def test_the_residual_s_rms_is_that_of_one_axis(sky, rng):
    """Of 12 fields of some 20 stars: known to a twentieth; three of their numbers go to the fit."""
    rms_px = []
    for q in normalise(rng.normal(size=(12, 4))):
        seen = SeenSky(sky, q, rng)
        known = identify(seen.found, q, seen.near, seen.place)
        freedom = 1 - 3 / (2 * len(known.star))
        rms_px.append(known.rms_rad * FOCAL_PX / np.sqrt(freedom))
    assert np.mean(rms_px) == pytest.approx(NOISE_PX, rel=0.15)


def test_wahba_finds_the_rotation_of_weighted_directions(rng):
    q = normalise(rng.normal(size=4))
    known = normalise(rng.normal(size=(6, 3)))
    seen = known @ to_matrix(q).T
    seen[0] = [1.0, 0.0, 0.0]
    weight = np.array([0.0, 1.0, 2.0, 1.0, 1.0, 3.0])
    assert angle_between_rad(wahba(seen, known, weight), q) < 1e-12


def test_without_the_extra_it_says_how_to_get_it(sky, monkeypatch):
    real = builtins.__import__

    def without(name, *arguments):
        if name == "tetra3rs":
            raise ImportError(name)
        return real(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(
        InputError, match=r"pip install \"hilstar\[solve\]\", or write --solver truth"
    ):
        LostInSpace(*sky, FOCAL_PX, (SIDE_PX, SIDE_PX))


def test_two_stars_tell_a_rotation_and_never_its_mirror(rng):
    """Of two directions the third singular value is 0, and its sign is anyone's guess."""
    for _ in range(40):
        q = normalise(rng.normal(size=4))
        known = normalise(rng.normal(size=(2, 3)))
        found = wahba(known @ to_matrix(q).T, known, np.array([1.0, 2.0]))
        assert angle_between_rad(found, q) < 1e-7


def place_px(rays):
    return rays[:, 0] / rays[:, 2] * FOCAL_PX + 511.5, rays[:, 1] / rays[:, 2] * FOCAL_PX + 511.5


# The median star is 0.2 px off; the one star that is more so turns the solution by under 0.02 px.
@pytest.mark.parametrize(("off_px", "is_left_out"), [(0.76, False), (0.84, True)])
def test_a_star_over_four_times_the_median_off_is_left_out(off_px, is_left_out):
    x, y = np.meshgrid(np.linspace(60.0, 960.0, 8), np.linspace(60.0, 960.0, 8))
    x, y = x.ravel(), y.ravel()
    known = normalise(np.stack([x - 511.5, y - 511.5, np.full(64, FOCAL_PX)], axis=1))
    way = np.arange(64) + np.arange(64) // 8  # of neighbours in four directions
    step = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[way % 4] * 0.2
    step[27] *= off_px / 0.2
    x, y = x + step[:, 0], y + step[:, 1]
    rays = normalise(np.stack([x - 511.5, y - 511.5, np.full(64, FOCAL_PX)], axis=1))
    found = FoundStars(x, y, np.full(64, 1e4), rays)
    identified = identify(
        found, np.array([1.0, 0.0, 0.0, 0.0]), lambda q: (np.arange(64), known), place_px
    )
    assert (27 not in identified.star) == is_left_out
    assert len(identified.star) == 64 - is_left_out


def grid():
    """Places of 64 stars, 130 px apart, and their directions as seen by a camera that is level."""
    x, y = np.meshgrid(np.linspace(60.0, 960.0, 8), np.linspace(60.0, 960.0, 8))
    x, y = x.ravel(), y.ravel()
    return x, y, rays_of(x, y)


def rays_of(x, y):
    return normalise(np.stack([x - 511.5, y - 511.5, np.full(len(x), FOCAL_PX)], axis=1))


LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def test_of_two_stars_near_one_find_the_brightest_has_it():
    x, y, known = grid()
    known = np.concatenate([known, rays_of(x[27:30] + 0.2, y[27:30])])
    found = FoundStars(x, y, np.full(64, 1e4), known[:64])
    identified = identify(found, LEVEL, lambda q: (np.arange(67), known), place_px)
    assert (identified.found == identified.star).all() and len(identified.star) == 64


def test_a_false_star_before_the_others_does_not_tell_how_they_all_moved():
    """The brightest find is 6 px off its star, and all others are 5 px off where it is expected."""
    x, y, known = grid()
    x = x + np.where(np.arange(64) == 0, 1.0, -5.0)
    found = FoundStars(x, y, np.full(64, 1e4), rays_of(x, y))
    identified = identify(found, LEVEL, lambda q: (np.arange(64), known), place_px)
    assert identified is not None and list(identified.star) == list(range(1, 64))


def test_bright_stars_count_as_their_floor_and_faint_ones_by_their_light():
    """Half are without shot noise, half have three times the floor's variance by theirs: these
    count a quarter, and their 0.05 px turn all by a fifth of that.
    """
    x, y, known = grid()
    faint = np.arange(64) % 2 == 1
    x = x + np.where(faint, 0.05, 0.0)
    flux_e = np.where(faint, 0.4 / (3 * 0.02**2), 1e15)
    found = FoundStars(x, y, flux_e, rays_of(x, y))
    identified = identify(found, LEVEL, lambda q: (np.arange(64), known), place_px)
    assert len(identified.star) == 64
    moved_px, _ = place_px(known @ to_matrix(identified.q_icrs_to_cam).T)
    assert np.mean(moved_px - grid()[0]) == pytest.approx(0.01, rel=0.02)


def test_the_database_is_of_the_field_s_width_and_of_all_stars(monkeypatch):
    made = {}

    def generate(path, **options):
        made.update(options, rows=(Path(path).stat().st_size - 16) // GAIA_RECORD.itemsize)

    fake = SimpleNamespace(
        SolveResult=tuple,
        CameraModel=SimpleNamespace,
        SolverDatabase=SimpleNamespace(generate_from_gaia=generate),
    )
    monkeypatch.setitem(sys.modules, "tetra3rs", fake)
    LostInSpace(np.eye(3), np.array([5.0, 2.0, 6.5]), 1000.0, (2000, 1000))
    assert made["min_fov_deg"] < 90.0 < made["max_fov_deg"] < 95.0
    assert (made["star_max_magnitude"], made["rows"]) == (6.5, 3)


def test_where_the_catalogue_has_few_stars_more_spots_do_not_count_against_it(sky, rng):
    """Twelve stars of it among some hundred spots: all twelve are there."""
    q = np.array([0.6987226, 0.7135120, -0.0370377, 0.0362700])
    seen = SeenSky(sky, q, rng, false=60)
    place_px = seen.place(seen.vectors @ to_matrix(q).T)
    with np.errstate(invalid="ignore"):
        on_image = (np.abs(place_px[0] - 511.5) < 450) & (np.abs(place_px[1] - 511.5) < 450)
    few = seen.vectors[np.flatnonzero(on_image)[5:17]]
    assert len(few) == 12 and len(seen.found) > 60
    known = identify(seen.found, q, lambda q: (np.arange(12), few), seen.place)
    assert known is not None
    assert angle_between_rad(known.q_icrs_to_cam, q) < LIMIT_RAD * np.sqrt(2)


@pytest.mark.parametrize("flux_e", [0.0, -40.0])
def test_a_spot_without_light_counts_for_nothing_and_turns_nothing(sky, rng, flux_e):
    """A level that is a little too high leaves the faintest spots none."""
    q = normalise(rng.normal(size=4))
    seen = SeenSky(sky, q, rng, false=0)
    flux = seen.found.flux_e.copy()
    flux[-2:] = flux_e
    found = replace(seen.found, flux_e=flux)
    known = identify(found, q, seen.near, seen.place)
    assert known is not None
    assert angle_between_rad(known.q_icrs_to_cam, q) < LIMIT_RAD


def test_a_third_that_is_false_does_not_tell_how_they_all_moved():
    """44 of 64 are 5 px off where they are expected; 20 are other stars, 6 px off the other way.
    Their mean, of -1.6 px, is over the second radius from both.
    """
    x, y, known = grid()
    is_other = np.arange(64) % 3 == 1
    is_other[61] = False
    assert is_other.sum() == 20
    x = x + np.where(is_other, 6.0, -5.0)
    found = FoundStars(x, y, np.full(64, 1e4), rays_of(x, y))
    identified = identify(found, LEVEL, lambda q: (np.arange(64), known), place_px)
    assert identified is not None
    assert list(identified.star) == np.flatnonzero(~is_other).tolist()


@pytest.mark.parametrize(("number", "off_px", "is_left_out"), [(28, 0.75, False), (27, 0.45, True)])
def test_a_star_is_left_out_by_what_its_own_noise_allows(number, off_px, is_left_out):
    """Half are bright and 0.1 px off; half are faint, with twice that noise, and 0.2 px off. A
    faint one may be 0.8 px off, four times that, and a bright one 0.4 px.
    """
    x, y, known = grid()
    way = np.arange(64) // 2 + np.arange(64) // 8  # of both kinds in four directions
    is_faint = np.arange(64) % 2 == 0
    step_px = np.where(is_faint, 0.2, 0.1)
    step_px[number] = off_px
    step = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[way % 4] * step_px[:, None]
    x, y = x + step[:, 0], y + step[:, 1]
    flux_e = np.where(is_faint, 0.4 / (3 * 0.02**2), 1e15)
    found = FoundStars(x, y, flux_e, rays_of(x, y))
    identified = identify(found, LEVEL, lambda q: (np.arange(64), known), place_px)
    assert (number not in identified.star) == is_left_out
    assert len(identified.star) == 64 - is_left_out
