"""The turn of an attitude by places of stars that are old: that of the stars themselves."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.star_motion import BRIGHTEST, StarMotion, turn_of
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.acceptance import write_bench

SCALE = Scale(1538.0, (256, 256))
YEARS = 100.0


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
    new = (motion.vectors[rows] + YEARS * motion.yearly[rows]) @ to_matrix(q).T
    new /= np.linalg.norm(new, axis=1, keepdims=True)
    wanted, _ = Rotation.align_vectors(new, old)
    turn_arcsec = ARCSEC_PER_RAD * YEARS * motion.turn_rad(q, rows)
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
