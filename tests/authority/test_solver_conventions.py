"""Solvers' answers for stars at a known attitude: the table of conventions in docs/answers.md."""

import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.sky.catalog import load_catalog
from hilstar.tracker.identify import LostInSpace

SIDE_PX, FIELD_DEG = 1024, 15.0
FOCAL_PX = SIDE_PX / 2 / np.tan(np.radians(FIELD_DEG / 2))
RADEC_ROLL_DEG = 283.021, 35.349, 30.0
FAINTEST_V_MAG = 7.0


@pytest.fixture(scope="module")
def sky():
    stars = load_catalog().brighter_than(FAINTEST_V_MAG)
    ra_rad, dec_rad = np.radians(stars.ra_deg), np.radians(stars.dec_deg)
    xy = [np.cos(dec_rad) * np.cos(ra_rad), np.cos(dec_rad) * np.sin(ra_rad)]
    return np.stack([*xy, np.sin(dec_rad)], axis=1), np.asarray(stars.v_mag)


@pytest.fixture(scope="module")
def field(sky):
    """Slopes of the stars in the field (n, 2), right and down in the image, brightest first, and
    magnitudes.
    """
    directions, v_mag = sky
    cam = directions @ to_matrix(from_radec_roll_deg(*RADEC_ROLL_DEG)).T
    slopes = cam[:, :2] / cam[:, 2:]
    edge = SIDE_PX / 2 / FOCAL_PX
    seen = np.flatnonzero((cam[:, 2] > 0) & (np.abs(slopes) < edge).all(axis=1))
    order = seen[np.argsort(v_mag[seen])]
    return slopes[order], v_mag[order]


def is_same_attitude(q, other):
    return min(np.abs(q - other).max(), np.abs(q + other).max()) < 1e-5


def test_tetra3rs_answers_in_hilstars_convention(sky, field):
    pytest.importorskip("tetra3rs")
    slopes, v_mag = field
    solver = LostInSpace(*sky, FOCAL_PX, (SIDE_PX, SIDE_PX))
    q = solver.solve(slopes, 10 ** (-0.4 * v_mag))
    assert is_same_attitude(q, from_radec_roll_deg(*RADEC_ROLL_DEG))


def test_ruststartracker_has_the_scalar_last_and_the_conjugate(sky, field):
    solver = pytest.importorskip("ruststartracker")
    middle_px = (SIDE_PX - 1) / 2
    matrix = np.array([[FOCAL_PX, 0, middle_px], [0, FOCAL_PX, middle_px], [0, 0, 1.0]])
    camera = solver.CameraParameters(
        camera_matrix=matrix, cam_resolution=(SIDE_PX, SIDE_PX), dist_coefs=None
    )
    tracker = solver.StarTracker(
        *(array.astype(np.float32) for array in sky),
        camera,
        inter_star_angle_tolerance=float(np.radians(0.02)),
        n_minimum_matches=5,
    )
    rays = np.column_stack([field[0], np.ones(len(field[0]))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    x, y, z, w = tracker.process_observation_vectors(rays.astype(np.float32)).quat
    assert is_same_attitude(np.array([w, -x, -y, -z]), from_radec_roll_deg(*RADEC_ROLL_DEG))


def test_cedar_answers_hilstars_roll(field):
    solver = pytest.importorskip("tetra3").Tetra3()
    rows = field[0][:30, ::-1] * FOCAL_PX + SIDE_PX / 2
    answer = solver.solve_from_centroids(rows, (SIDE_PX, SIDE_PX), fov_estimate=FIELD_DEG)
    found_deg = [answer["RA"], answer["Dec"], answer["Roll"]]
    assert found_deg == pytest.approx(RADEC_ROLL_DEG, abs=0.002)
