"""Solvers' answers for stars at a known attitude: the table of conventions in docs/answers.md."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.sky.catalog import load_catalog
from hilstar.tracker.identify import LostInSpace
from tests.support.beside import astrometry_side, lost_side

SIDE_PX, FIELD_DEG = 1024, 15.0
FOCAL_PX = SIDE_PX / 2 / np.tan(np.radians(FIELD_DEG / 2))
RADEC_ROLL_DEG = 283.021, 35.349, 30.0
FAINTEST_V_MAG = 7.0


@pytest.fixture(scope="module")
def bright_sky():
    stars = load_catalog().brighter_than(FAINTEST_V_MAG)
    ra_rad, dec_rad = np.radians(stars.ra_deg), np.radians(stars.dec_deg)
    xy = [np.cos(dec_rad) * np.cos(ra_rad), np.cos(dec_rad) * np.sin(ra_rad)]
    return np.stack([*xy, np.sin(dec_rad)], axis=1), np.asarray(stars.v_mag)


@pytest.fixture(scope="module")
def slopes_in_field(bright_sky):
    """Slopes of the stars in the field (n, 2), right and down in the image, brightest first, and
    magnitudes.
    """
    directions, v_mag = bright_sky
    cam = directions @ to_matrix(from_radec_roll_deg(*RADEC_ROLL_DEG)).T
    slopes = cam[:, :2] / cam[:, 2:]
    edge = SIDE_PX / 2 / FOCAL_PX
    seen = np.flatnonzero((cam[:, 2] > 0) & (np.abs(slopes) < edge).all(axis=1))
    order = seen[np.argsort(v_mag[seen])]
    return slopes[order], v_mag[order]


def is_same_attitude(q, other):
    return min(np.abs(q - other).max(), np.abs(q + other).max()) < 1e-5


def test_tetra3rs_answers_in_hilstars_convention(bright_sky, slopes_in_field):
    pytest.importorskip("tetra3rs")
    slopes, v_mag = slopes_in_field
    solver = LostInSpace(*bright_sky, FOCAL_PX, (SIDE_PX, SIDE_PX))
    q = solver.solve(slopes, 10 ** (-0.4 * v_mag))
    assert is_same_attitude(q, from_radec_roll_deg(*RADEC_ROLL_DEG))


def test_ruststartracker_has_the_scalar_last_and_the_conjugate(bright_sky, slopes_in_field):
    solver = pytest.importorskip("ruststartracker", reason="ruststartracker is not installed")
    middle_px = (SIDE_PX - 1) / 2
    matrix = np.array([[FOCAL_PX, 0, middle_px], [0, FOCAL_PX, middle_px], [0, 0, 1.0]])
    camera = solver.CameraParameters(
        camera_matrix=matrix, cam_resolution=(SIDE_PX, SIDE_PX), dist_coefs=None
    )
    tracker = solver.StarTracker(
        *(array.astype(np.float32) for array in bright_sky),
        camera,
        inter_star_angle_tolerance=float(np.radians(0.02)),
        n_minimum_matches=5,
    )
    rays = np.column_stack([slopes_in_field[0], np.ones(len(slopes_in_field[0]))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    x, y, z, w = tracker.process_observation_vectors(rays.astype(np.float32)).quat
    assert is_same_attitude(np.array([w, -x, -y, -z]), from_radec_roll_deg(*RADEC_ROLL_DEG))


def test_cedar_answers_hilstars_roll(slopes_in_field):
    solver = pytest.importorskip("tetra3", reason="tetra3 is not installed").Tetra3()
    rows = slopes_in_field[0][:30, ::-1] * FOCAL_PX + SIDE_PX / 2
    answer = solver.solve_from_centroids(rows, (SIDE_PX, SIDE_PX), fov_estimate=FIELD_DEG)
    found_deg = [answer["RA"], answer["Dec"], answer["Roll"]]
    assert found_deg == pytest.approx(RADEC_ROLL_DEG, abs=0.002)


def picture(slopes_in_field):
    """An image of 8 bits (rows from the top): a Gaussian of 1.2 px for each star of the field."""
    slopes, v_mag = slopes_in_field
    rows, columns = np.indices((SIDE_PX, SIDE_PX))
    image = np.zeros((SIDE_PX, SIDE_PX))
    for (right, down), v in zip(slopes, v_mag, strict=True):
        x_px, y_px = np.array([right, down]) * FOCAL_PX + (SIDE_PX - 1) / 2
        square_px = (columns - x_px) ** 2 + (rows - y_px) ** 2
        image += 2000 * 10 ** (-0.4 * (v - 3)) * np.exp(-square_px / (2 * 1.2**2))
    return np.clip(image, 0, 255).astype(np.uint8)


def turned_deg(angle_deg, other_deg):
    """How far two angles are apart."""
    return abs((angle_deg - other_deg + 180) % 360 - 180)


@pytest.mark.skipif("LOST" not in os.environ, reason="runs on demand: LOST=the folder of a build")
def test_lost_s_roll_is_minus_hilstar_s(slopes_in_field, tmp_path):
    from PIL import Image

    lost = lost_side.lost_folder()
    subprocess.run(["./lost", *lost_side.DATABASE], cwd=lost, capture_output=True, check=True)
    Image.fromarray(picture(slopes_in_field)).save(tmp_path / "sky.png", compress_level=1)
    words = ["./lost", "pipeline", "--png", str(tmp_path / "sky.png"), "--fov", f"{FIELD_DEG:g}"]
    words += ["--database", "stars.dat", "--centroid-algo", "cog", "--star-id-algo", "py"]
    words += ["--centroid-filter-brightest", "20", "--angular-tolerance", "0.05"]
    words += ["--false-stars", "1000", "--max-mismatch-prob", "0.0001"]
    words += ["--attitude-algo", "dqm", "--print-attitude", "-"]
    printed = subprocess.run(words, cwd=lost, capture_output=True, text=True, check=True).stdout
    answer = dict(re.findall(r"attitude_(\w+) (\S+)", printed))
    ra_deg, dec_deg, roll_deg = RADEC_ROLL_DEG
    assert float(answer["ra"]) == pytest.approx(ra_deg, abs=0.02)
    assert float(answer["de"]) == pytest.approx(dec_deg, abs=0.02)
    assert turned_deg(float(answer["roll"]), -roll_deg) < 0.1


def test_astrometry_net_s_up_is_180_deg_minus_hilstar_s_roll(slopes_in_field, tmp_path):
    """Of a list of places whose y is down, as hilstar's images have it."""
    if shutil.which(astrometry_side.SOLVER) is None:
        pytest.skip("astrometry.net is not installed (apt-get install astrometry.net)")
    config = astrometry_side.make_index(tmp_path)
    slopes, v_mag = slopes_in_field
    x_px, y_px = (slopes * FOCAL_PX + (SIDE_PX + 1) / 2).T
    columns = {"X": x_px, "Y": y_px, "FLUX": 10 ** (-0.4 * v_mag)}
    Table(columns).write(tmp_path / "places.fits")
    options = ["--no-plots", "--config", str(config), "--new-fits", "none", "--no-tweak"]
    options += ["--scale-units", "degwidth", "--scale-low", "14", "--scale-high", "16"]
    options += ["--width", str(SIDE_PX), "--height", str(SIDE_PX), "--sort-column", "FLUX"]
    command = [astrometry_side.SOLVER, *options, "--crpix-center", str(tmp_path / "places.fits")]
    printed = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout
    place = re.search(r"\(RA,Dec\) = \(([-\d.]+), ([-\d.]+)\) deg", printed)
    up = re.search(r"up is ([-\d.]+) degrees E of N", printed)
    assert place and up, printed
    ra_deg, dec_deg, roll_deg = RADEC_ROLL_DEG
    assert float(place[1]) == pytest.approx(ra_deg, abs=0.002)
    assert float(place[2]) == pytest.approx(dec_deg, abs=0.002)
    assert turned_deg(float(up[1]), 180 - roll_deg) < 0.01
    assert "Field parity: neg" in printed


ESA_SOLVER = """
import json, sys
import numpy as np
from PIL import Image
np.int = int  # a name that NumPy had when that version was written
import tetra3
solver = tetra3.Tetra3(load_database=None)
solver.generate_database(max_fov=16, star_min_magnitude=6.0)
answer = solver.solve_from_image(np.array(Image.open(sys.argv[1])), fov_estimate=15.0)
print(json.dumps({key: answer[key] for key in ("RA", "Dec", "Roll", "Matches")}, default=float))
"""


@pytest.mark.skipif("TETRA3" not in os.environ, reason="runs on demand: TETRA3=ESA's folder")
def test_esa_s_tetra3_answers_hilstar_s_roll(slopes_in_field, tmp_path):
    """Its catalogue is a file of the Bright Star Catalogue's form: here hilstar's own stars."""
    from PIL import Image

    shutil.copytree(Path(os.environ["TETRA3"]), tmp_path / "tetra3")
    stars = load_catalog().brighter_than(6.5)
    fields = [("id", "f4"), ("ra", "f8"), ("dec", "f8"), ("kind", "i2"), ("mag", "i2")]
    rows = np.zeros(9110, [*fields, ("ra_pm", "f4"), ("dec_pm", "f4")])[: len(stars.v_mag)]
    rows["ra"], rows["dec"] = np.radians(stars.ra_deg), np.radians(stars.dec_deg)
    rows["mag"] = np.round(stars.v_mag * 100)
    catalogue = bytes(28) + rows.tobytes() + bytes((9110 - len(rows)) * rows.itemsize)
    (tmp_path / "tetra3" / "BSC5").write_bytes(catalogue)
    Image.fromarray(picture(slopes_in_field)).save(tmp_path / "sky.png", compress_level=1)
    command = [sys.executable, "-c", ESA_SOLVER, str(tmp_path / "sky.png")]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout.splitlines()[-1])
    found_deg = [answer["RA"], answer["Dec"], answer["Roll"]]
    assert found_deg == pytest.approx(RADEC_ROLL_DEG, abs=0.05)
