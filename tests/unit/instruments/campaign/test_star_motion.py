"""The turn of an attitude by places of stars that are old: that of the stars themselves."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import get_body_barycentric_posvel
from astropy.time import Time
from scipy.spatial.transform import Rotation

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, KM_PER_AU
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.case_table import Columns
from hilstar.instruments.campaign.plan import Require
from hilstar.instruments.campaign.star_motion import (
    BRIGHTEST,
    OBSERVER_KM_S,
    PARALLAX_TURN,
    YEARLY_TURN,
    YEARS,
    StarMotion,
    _observers,
    turn_of,
    with_motion,
)
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.cameras import bench_camera
from hilstar.server.bench.star_light import bench_moving
from tests.support.acceptance import write_bench
from tests.support.claims import holds

OBSERVER = {
    "sky": {"epoch_utc": "2026-04-01T00:00:00Z"},
    "spacecraft": {"orbit": "geocentre"},
}
FIELDS = 300
NEAR_EDGE = 0.1  # share that uneven parallaxes lose to a turn about the boresight
SCALE = Scale(1538.0, (256, 256))
AGE_YR = 100.0


@pytest.fixture(scope="module")
def motion(tmp_path_factory: pytest.TempPathFactory) -> StarMotion:
    return StarMotion.of(read_bench_file(write_bench(tmp_path_factory.mktemp("motion"))))


@pytest.mark.parametrize("radec", [(84.0, 0.0), (200.0, 60.0), (300.0, -40.0)])
def test_the_turn_is_that_which_lays_old_places_onto_the_new(
    motion: StarMotion, radec: tuple[float, float]
) -> None:
    q = from_radec_roll_deg(*radec, 30.0)
    rows = motion.in_field(q, SCALE)[:BRIGHTEST]
    old = motion.vectors[rows] @ to_matrix(q).T
    new = (motion.vectors[rows] + AGE_YR * motion.yearly[rows]) @ to_matrix(q).T
    new /= np.linalg.norm(new, axis=1, keepdims=True)
    wanted, _ = Rotation.align_vectors(new, old)
    turn_arcsec = ARCSEC_PER_RAD * AGE_YR * motion.turn_rad(q, rows)
    assert np.linalg.norm(turn_arcsec) > 0.5
    # of the second order in the motion, which about the boresight counts more than across
    wanted_arcsec = wanted.as_rotvec() * ARCSEC_PER_RAD
    assert turn_arcsec == pytest.approx(wanted_arcsec, rel=2e-3, abs=0.02)


def test_stars_that_turn_as_a_whole_give_that_turn(rng: np.random.Generator) -> None:
    vectors = rng.normal(size=(8, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    turn = np.array([1e-6, -2e-6, 3e-6])
    assert turn_of(vectors, np.cross(turn, vectors)) == pytest.approx(turn, rel=1e-9)


def test_a_field_with_a_fast_star_has_no_likely_turn(motion: StarMotion) -> None:
    # 61 Cygni: 5.2 arcsec a year, V 5.2
    q = from_radec_roll_deg(316.7, 38.7, 0.0)
    assert np.isnan(motion.likely_turn_rad(q, SCALE)).all()
    assert np.isfinite(motion.whole_turn_rad(q, SCALE)).all()


@pytest.mark.parametrize(("through", "is_bounded"), [("tracker", False), ("bench", True)])
def test_before_a_display_the_stars_are_those_that_it_covers(
    through: str, is_bounded: bool, tmp_path: Path, rng: np.random.Generator
) -> None:
    """A display of 320 x 240 pixels of 57.65 um behind 150 mm covers half of a field of 9.5 deg."""
    file = read_bench_file(write_bench(tmp_path, collimator={"focal_length_mm": 150}))
    display = bench_camera(file.config, file.folder)
    bounded, whole = StarMotion.of(file, display), StarMotion.of(file)
    q = Rotation.random(20, random_state=rng).as_quat(scalar_first=True)
    half = 0.05765 / 150 * np.array([160.0, 120.0])
    turns = []
    for attitude in q:
        all_rows = whole.in_field(attitude, SCALE)
        seen = whole.vectors[all_rows] @ to_matrix(attitude).T
        covered = (np.abs(seen[:, :2]) < half * seen[:, 2:]).all(axis=1)
        assert bounded.in_field(attitude, SCALE).tolist() == all_rows[covered].tolist()
        expected = bounded if is_bounded else whole
        turns.append(ARCSEC_PER_RAD * expected.likely_turn_rad(attitude, SCALE)[:2])
    numbers = {name: q[:, k] for k, name in enumerate(("qw", "qx", "qy", "qz"))}
    cases = Columns(len(q), numbers | {"frames": np.ones(len(q))}, {})
    require = Require(quantity="catalogue-age", maximum=1.0)
    with_turns = with_motion(cases, [require], file, SCALE, through)
    np.testing.assert_allclose(with_turns.vectors(YEARLY_TURN, "xy"), np.array(turns), rtol=1e-9)


def test_a_field_turns_by_the_mean_parallax_of_its_stars(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """The stars of a field go together, against the observer's place: by their mean parallax times
    its part across the boresight, AU, by a formula of its own.
    """
    file = read_bench_file(write_bench(tmp_path, **OBSERVER))
    moving = bench_moving(file.config, file.folder)
    assert moving is not None
    motion = StarMotion.of(file).by_parallax(moving)
    place_au = moving.sight(0).view.place_km / KM_PER_AU
    turns_arcsec, means_arcsec = [], []
    for _ in range(FIELDS):
        q = Rotation.random(random_state=rng).as_quat(scalar_first=True)
        turn = ARCSEC_PER_RAD * motion.likely_turn_rad(q, SCALE)
        if not np.isfinite(turn).all():
            continue
        rows = motion.in_field(q, SCALE)[:BRIGHTEST]
        mean_arcsec = np.maximum(motion.parallax_mas[rows], 0.0).mean() / 1000
        across = (to_matrix(q) @ place_au)[:2]
        means_arcsec.append(mean_arcsec * np.array([across[1], -across[0]]))
        turns_arcsec.append(turn[:2])
    assert len(turns_arcsec) > 0.9 * FIELDS
    turns, means = np.array(turns_arcsec), np.array(means_arcsec)
    # one for one, but for near stars at an edge of the field, which the turn takes for a roll in part
    assert (turns * means).sum() / (means**2).sum() == pytest.approx(1.0, abs=NEAR_EDGE)
    assert np.corrcoef(turns.ravel(), means.ravel())[0, 1] > 1 - NEAR_EDGE
    holds("parallax-turn", math.sqrt((turns**2).sum(axis=1).mean()))


def test_a_field_s_stars_are_those_within_half_of_each_side_of_the_detector() -> None:
    """A detector of 800 x 500 px and 1000 px of focal length: tangents of 0.4 and 0.25."""
    tangents = np.array([[0.39, 0.24], [-0.39, -0.24], [0.41, 0.0], [0.0, 0.26], [-0.41, 0.1]])
    ahead = np.column_stack([tangents, np.ones(len(tangents))])
    vectors = np.concatenate([ahead, -ahead[:1]])
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    zeros = np.zeros(len(vectors))
    q = from_radec_roll_deg(40.0, 20.0, 70.0)
    stars = StarMotion(2026.0, vectors @ to_matrix(q), np.zeros_like(vectors), zeros)
    assert stars.in_field(q, Scale(1000.0, (800, 500))).tolist() == [0, 1]
    assert stars.in_field(q, Scale(1000.0, (500, 800))).tolist() == [3]


def test_sirius_moves_as_hipparcos_has_it(motion: StarMotion) -> None:
    """-546.01 mas a year along right ascension and -1223.08 along declination (HIP 32349)."""
    dec_rad = math.radians(-16.7161)
    ra_rad = math.radians(101.2872)
    east = np.array([-math.sin(ra_rad), math.cos(ra_rad), 0.0])
    north = np.array(
        [
            -math.sin(dec_rad) * math.cos(ra_rad),
            -math.sin(dec_rad) * math.sin(ra_rad),
            math.cos(dec_rad),
        ]
    )
    yearly_mas = 1000 * ARCSEC_PER_RAD * motion.yearly[0]  # the brightest star
    assert yearly_mas @ east == pytest.approx(-546.01, abs=0.5)
    assert yearly_mas @ north == pytest.approx(-1223.08, abs=0.5)
    assert np.linalg.norm(yearly_mas) == pytest.approx(math.hypot(546.01, 1223.08), abs=0.5)


def test_a_field_with_a_near_star_has_no_likely_parallax(tmp_path: Path) -> None:
    """Alpha Centauri: a parallax of 0.75 arcsec, of which 0.5 or more show at any time of the year.
    Its proper motion of 3.7 arcsec is no part of that.
    """
    file = read_bench_file(write_bench(tmp_path, **OBSERVER))
    moving = bench_moving(file.config, file.folder)
    assert moving is not None
    parallax = StarMotion.of(file).by_parallax(moving)
    near = from_radec_roll_deg(219.9, -60.8, 0.0)
    assert np.isnan(parallax.likely_turn_rad(near, SCALE)).all()
    # 61 Cygni's 0.29 arcsec are no such
    assert np.isfinite(parallax.likely_turn_rad(from_radec_roll_deg(316.7, 38.7, 0.0), SCALE)).all()


def test_what_places_the_observer_is_told_as_the_bench_file_writes_it(tmp_path: Path) -> None:
    """A table of cases has numbers for true and false, and texts as they are; a key of the tracker
    places nobody.
    """
    file = read_bench_file(write_bench(tmp_path, **OBSERVER))
    numbers = {
        "frames": np.ones(2),
        "vary.sky.bodies.sun": np.array([1.0, 0.0]),
        "vary.sky.epoch_jyear": np.array([2026.0, 2027.5]),
        "vary.tracker.exposure_s": np.array([0.1, 0.2]),
    }
    texts = {"vary.spacecraft.orbit": ["geocentre", "low.tle"]}
    told = _observers(Columns(2, numbers, texts), file)
    assert told == [
        {"sky.bodies.sun": True, "sky.epoch_jyear": 2026.0, "spacecraft.orbit": "geocentre"},
        {"sky.bodies.sun": False, "sky.epoch_jyear": 2027.5, "spacecraft.orbit": "low.tle"},
    ]
    assert [type(values["sky.bodies.sun"]) for values in told] == [bool, bool]


def test_each_case_has_its_own_date_and_the_observer_of_that_date(tmp_path: Path) -> None:
    """Dates half a year apart, beside the bench's, in no order: the Earth's velocity about the
    barycentre is astropy's, and turns by parallax are the other way round.
    """
    file = read_bench_file(write_bench(tmp_path, **OBSERVER))
    dates = ["2027-01-01T00:00:00Z", "2026-04-01T00:00:00", "2027-07-03T12:00:00Z"]
    q = np.tile(from_radec_roll_deg(84.0, 0.0, 30.0), (3, 1))
    numbers = {f"q{name}": q[:, k] for k, name in enumerate("wxyz")}
    cases = Columns(3, numbers | {"frames": np.ones(3)}, {"vary.sky.epoch_utc": dates})
    requires = [
        Require(quantity="catalogue-age", maximum=1.0),
        Require(quantity="parallax", maximum=1.0),
    ]
    told = with_motion(cases, requires, file, SCALE, "tracker")
    times = Time([date.removesuffix("Z") for date in dates])
    assert told.numbers[YEARS] == pytest.approx(times.jyear - times.jyear[1], abs=1e-4)
    _, velocity = get_body_barycentric_posvel("earth", times)
    wanted_km_s = velocity.xyz.to_value("km/s").T
    assert told.vectors(OBSERVER_KM_S, "xyz") == pytest.approx(wanted_km_s, abs=0.01)
    turns = told.vectors(PARALLAX_TURN, "xy")
    assert np.linalg.norm(turns[0]) > 1e-3
    # the Earth goes to within a fiftieth of the other side of its orbit
    assert turns[2] == pytest.approx(-turns[0], rel=0.1, abs=0.02 * np.abs(turns).max())


def test_dates_in_years_are_taken_as_they_are(tmp_path: Path) -> None:
    file = read_bench_file(write_bench(tmp_path, sky={"epoch_jyear": 2026.5}))
    q = np.tile(from_radec_roll_deg(84.0, 0.0, 30.0), (2, 1))
    numbers = {f"q{name}": q[:, k] for k, name in enumerate("wxyz")}
    numbers |= {"frames": np.ones(2), "vary.sky.epoch_jyear": np.array([2030.0, 2020.0])}
    require = Require(quantity="proper-motion", maximum=1.0)
    told = with_motion(Columns(2, numbers, {}), [require], file, SCALE, "tracker")
    assert told.numbers[YEARS].tolist() == [3.5, -6.5]


def test_two_stars_tell_no_turn_and_three_do(rng: np.random.Generator) -> None:
    vectors = rng.normal(size=(3, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    turn = np.array([1e-6, -2e-6, 3e-6])
    stars = StarMotion(2026.0, vectors, np.cross(turn, vectors), np.zeros(3))
    q = from_radec_roll_deg(10.0, 20.0, 30.0)
    assert stars.turn_rad(q, np.arange(2)).tolist() == [0.0, 0.0, 0.0]
    assert stars.turn_rad(q, np.arange(3)) == pytest.approx(to_matrix(q) @ turn, rel=1e-9)
