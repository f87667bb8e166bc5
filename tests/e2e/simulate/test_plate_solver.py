"""A plate solver that knows nothing of us finds the attitude that was commanded.

cedar-solve (a fork of ESA's tetra3) brings its own star data, epoch 2024.0. It wants an old NumPy
for one name, which plate_solve.py gives it. Near the poles its own proper motions are off by
arcseconds, so the fields stay within 60 degrees of the equator.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image
from scipy import ndimage

from hilstar.display.response import srgb_light
from tests.support.benches import bench_text
from tests.support.claims import holds
from tests.support.commands import run_hilstar_here
from tests.support.senders import free_port
from tests.support.servers import interrupted, listening
from tests.support.sources.basilisk import Truth, basilisk, rotation
from tests.support.waiting import INSTALLED_WITHIN_S, PATIENCE_S

# The roll, and the scale, are known less well; the attitude's own limits are claims.
LIMITS_ARCSEC = {"linear": 0.1, "codes": 2.0}
# for the virtual tracker's pictures, with its noise; measured 0.2 and 0.4
PICTURE_LIMIT_ARCSEC = 1.0
STARS = {"linear": 30, "codes": 20}
# Blobs whose second moments differ by more than this from the typical star's are two stars in one.
WIDTH_TOLERANCE = {"linear": 0.01, "codes": 0.10}
ATTITUDES = [
    (84.057, -1.2, 0),
    (283.021, 35.349, 30),
    (180, -60, 77),
    (200, 10, 300),
    (10, 45, 200),
    (130, -20, 45),
    (330, 60, 5),
]

# 20 degrees on 1024 px: 512 px / tan(10 deg) x 13 um; the monitor is the tracker's twin.
FIELD = {
    "tracker": {"focal_length_mm": 37.748569},
    "sky": {"epoch_jyear": 2024.0},
    "monitor": {"resolution_px": [1024, 1024], "pixel_pitch_um": 13},
    "collimator": {"focal_length_mm": 37.748569},
}
BENCH = bench_text(FIELD)


@pytest.fixture(scope="session")
def solver_folder(tmp_path_factory) -> Path:
    """A folder that has the solver alone, not compiled ahead: it is used once."""
    folder = tmp_path_factory.mktemp("cedar")
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-compile", "--no-deps"]
    package = ["--target", folder, "cedar-solve==0.5.1"]
    subprocess.run([*install, *package], check=True, timeout=INSTALLED_WITHIN_S)
    return folder


def lone_centroids(image: np.ndarray, width_tolerance: float) -> np.ndarray:
    """Centres of gravity (y, x) of lone stars away from the edge, brightest first; NumPy and
    SciPy alone.
    """
    labels, _ = ndimage.label(image > 0, np.ones((3, 3)))
    found = []
    for number, window in enumerate(ndimage.find_objects(labels), start=1):
        if min(w.start for w in window) == 0 or max(w.stop for w in window) == 1024:
            continue
        light = np.where(labels[window] == number, image[window], 0.0).astype(np.float64)
        y, x = np.mgrid[window]
        total = light.sum()
        cy, cx = (light * y).sum() / total, (light * x).sum() / total
        found.append(
            (
                total,
                cy,
                cx,
                (light * (y - cy) ** 2).sum() / total,
                (light * (x - cx) ** 2).sum() / total,
            )
        )
    table = np.array(sorted(found, reverse=True))
    typical = np.median(table[:30, 3:], axis=0)
    lone = (np.abs(table[:, 3:] / typical - 1) < width_tolerance).all(axis=1)
    return table[lone, 1:3]


def unit(ra_deg: float, dec_deg: float) -> np.ndarray:
    ra, dec = np.radians([ra_deg, dec_deg])
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


@pytest.fixture(scope="module")
def fields(tmp_path_factory) -> dict[str, list[np.ndarray]]:
    """The frames of every attitude, by the command: linear images, and the light of their codes."""
    folder = tmp_path_factory.mktemp("fields")
    (folder / "bench.toml").write_text(BENCH)
    images: dict[str, list[np.ndarray]] = {"linear": [], "codes": []}
    for attitude in ATTITUDES:
        radec = ",".join(map(str, attitude))
        result = run_hilstar_here(
            f"frame bench.toml --radec={radec} -o f.fits --codes f.png", cwd=folder
        )
        assert result.returncode == 0, result.stderr
        images["linear"].append(fits.getdata(folder / "f.fits").astype(np.float64))
        images["codes"].append(srgb_light(np.array(Image.open(folder / "f.png")) / 255.0))
    return images


def solved_fields(solver_folder: Path, fields: list[np.ndarray]) -> list[dict[str, float]]:
    """What the solver makes of centroids (y, x) on 1024 x 1024 px."""
    # The solver counts from the corner of the first pixel, hilstar from its centre.
    lines = [
        json.dumps({"yx": (yx + 0.5).tolist(), "size": [1024, 1024], "fov_deg": 20.0})
        for yx in fields
    ]
    script = Path(__file__).with_name("plate_solve.py")
    solved = subprocess.run(
        [sys.executable, script],
        env=os.environ | {"PYTHONPATH": str(solver_folder)},
        input="\n".join(lines),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    return [json.loads(line) for line in solved.stdout.splitlines()]


@pytest.mark.parametrize("kind", ["linear", "codes"])
def test_the_solved_attitude_is_the_commanded_one(solver_folder, fields, kind):
    limit_arcsec = LIMITS_ARCSEC[kind]
    found = [lone_centroids(image, WIDTH_TOLERANCE[kind])[: STARS[kind]] for image in fields[kind]]
    for (ra, dec, roll), solution in zip(
        ATTITUDES, solved_fields(solver_folder, found), strict=True
    ):
        assert solution["RA"] is not None, f"no solution at {ra}, {dec}"
        error_arcsec = (
            np.degrees(np.linalg.norm(unit(solution["RA"], solution["Dec"]) - unit(ra, dec))) * 3600
        )
        print(f"{kind} {ra} {dec} {roll}: {error_arcsec:.4f} arcsec", file=sys.stderr)
        holds(f"solved-{kind}", error_arcsec)
        # The roll is known less well by the ratio of the field's radius to a radian, about 6 to 10.
        assert abs((solution["Roll"] - roll + 180) % 360 - 180) * 3600 < 10 * limit_arcsec * 6
        assert solution["FOV"] == pytest.approx(20.0, abs=0.01)


# How the tracker sits in Basilisk's body, and the field of 20 degrees that its camera is told to
# have.
MOUNTING = [0.6, 0.48, 0.64, 0.0]
STAR_SIGMA = 8.0  # a pixel this far above the background is a star's


def test_pictures_for_basilisk_s_camera_solve_to_basilisk_s_attitude(solver_folder, tmp_path):
    """The bytes that Basilisk's own image message points to, against the attitude that Basilisk
    recorded.
    """
    port, pose = free_port(), rotation(MOUNTING)
    attitude = {"source": "vizard", "lockstep": True, "endpoint": f"tcp://127.0.0.1:{port}"}
    (tmp_path / "bench.toml").write_text(
        bench_text(FIELD, {"tracker": {"q_body_to_cam": MOUNTING}, "attitude": attitude})
    )
    camera = {
        "cameraID": 3,
        "fieldOfView": np.radians(20.0),
        "resolution": [1024, 1024],
        "renderRate": 500_000_000,
    }
    camera["sigma_CB"] = pose.inv().as_mrp().tolist()
    crafts = {"chaser": [[0.3, -0.2, 0.5], [1e-4, 2e-4, -1e-4]]}
    scenario = {
        "mode": "noDisplay",
        "port": port,
        "shown_s": 0.1,
        "stops_s": [0.5, 1.0],
        "camera": camera,
    }
    with (
        basilisk(tmp_path, **scenario, spacecraft=crafts) as simulation,
        listening(tmp_path / "bench.toml", "bound") as served,
    ):
        simulation.run()
        summary = interrupted(served)
    assert "other-camera" not in summary["events"]
    times_ns = [500_000_000, 1_000_000_000]
    pictures = [np.array(Image.open(tmp_path / f"picture-{t_ns}.png")) for t_ns in times_ns]
    # 12 bits, the leading ones
    assert all(picture.dtype == np.uint16 and not (picture & 15).any() for picture in pictures)
    truth = Truth(tmp_path)
    found = [lone_centroids(lit_pixels(picture >> 4), 0.3)[:40] for picture in pictures]
    for t_ns, solution in zip(times_ns, solved_fields(solver_folder, found), strict=True):
        row = truth.row(t_ns)
        boresight = (pose * truth.body_from_n[row]).inv().apply([0, 0, 1])
        # Stars stand nearer to where Basilisk's spacecraft flies, which the solver knows nothing
        # of: v / c, to first order.
        beta = truth.v_bn_n[row] / 299_792_458.0
        aberration = beta - beta @ boresight * boresight
        assert np.degrees(np.linalg.norm(aberration)) * 3600 > 2 * PICTURE_LIMIT_ARCSEC
        error_arcsec = (
            np.degrees(
                np.linalg.norm(unit(solution["RA"], solution["Dec"]) - (boresight - aberration))
            )
            * 3600
        )
        print(f"picture {t_ns}: {error_arcsec:.4f} arcsec", file=sys.stderr)
        assert error_arcsec < PICTURE_LIMIT_ARCSEC


def lit_pixels(dn: np.ndarray) -> np.ndarray:
    """What stands out of a tracker's background, DN above it."""
    light = dn - np.median(dn)
    noise = max(float(np.percentile(light, 84)), 1.0)
    return np.where(light > STAR_SIGMA * noise, light, 0.0)
