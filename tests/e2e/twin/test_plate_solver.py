"""A plate solver that knows nothing of us finds the attitude that was commanded.

cedar-solve (a fork of ESA's tetra3) brings its own star data, epoch 2024.0. It wants an old NumPy, so it gets an environment
of its own. Near the poles its own proper motions are off by arcseconds, so the fields stay within 60 degrees of the equator.
"""

from __future__ import annotations

import json
import subprocess
import sys
import venv
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image
from scipy import ndimage

from hilstar.monitor.response import srgb_light
from tests.support.benches import bench_text
from tests.support.commands import run_hilstar_here

# The limits; measured here: 0.0003 to 0.024 arcsec and 0.03 to 0.7 arcsec.
LINEAR_LIMIT_ARCSEC = 0.1
CODES_LIMIT_ARCSEC = 2.0
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
BENCH = bench_text(
    {
        "tracker": {"focal_length_mm": 37.748569},
        "sky": {"epoch_jyear": 2024.0},
        "monitor": {"resolution_px": [1024, 1024], "pixel_pitch_um": 13},
        "collimator": {"focal_length_mm": 37.748569},
    }
)


@pytest.fixture(scope="session")
def solver_python(tmp_path_factory) -> Path:
    """An environment that this one's pip fills, without compiling ahead what is used once."""
    folder = tmp_path_factory.mktemp("cedar")
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-compile"]
    for arguments in (["numpy<2", "scipy", "pillow"], ["--no-deps", "cedar-solve==0.5.1"]):
        subprocess.run([*install, *arguments], check=True, timeout=600)
    return python


def centroids(image: np.ndarray, width_tolerance: float) -> np.ndarray:
    """Centres of gravity (y, x) of lone stars away from the edge, brightest first; NumPy and SciPy alone."""
    labels, _ = ndimage.label(image > 0, np.ones((3, 3)))
    found = []
    for number, window in enumerate(ndimage.find_objects(labels), start=1):
        if min(w.start for w in window) == 0 or max(w.stop for w in window) == 1024:
            continue
        light = np.where(labels[window] == number, image[window], 0.0).astype(np.float64)
        y, x = np.mgrid[window]
        total = light.sum()
        cy, cx = (light * y).sum() / total, (light * x).sum() / total
        found.append((total, cy, cx, (light * (y - cy) ** 2).sum() / total, (light * (x - cx) ** 2).sum() / total))
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
        result = run_hilstar_here("frame", "bench.toml", f"--radec={radec}", "-o", "f.fits", "--codes", "f.png", cwd=folder)
        assert result.returncode == 0, result.stderr
        images["linear"].append(fits.getdata(folder / "f.fits").astype(np.float64))
        images["codes"].append(srgb_light(np.array(Image.open(folder / "f.png")) / 255.0))
    return images


@pytest.mark.parametrize(("kind", "limit_arcsec"), [("linear", LINEAR_LIMIT_ARCSEC), ("codes", CODES_LIMIT_ARCSEC)])
def test_the_solved_attitude_is_the_commanded_one(solver_python, fields, kind, limit_arcsec):
    lines = []
    for image in fields[kind]:
        yx = centroids(image, WIDTH_TOLERANCE[kind])[: STARS[kind]]
        # The solver counts from the corner of the first pixel, hilstar from its centre.
        lines.append(json.dumps({"yx": (yx + 0.5).tolist(), "size": [1024, 1024], "fov_deg": 20.0}))
    script = Path(__file__).with_name("plate_solve.py")
    solved = subprocess.run(
        [solver_python, script], input="\n".join(lines), capture_output=True, text=True, timeout=120, check=True
    )
    for (ra, dec, roll), line in zip(ATTITUDES, solved.stdout.splitlines(), strict=True):
        solution = json.loads(line)
        assert solution["RA"] is not None, f"no solution at {ra}, {dec}"
        error_arcsec = np.degrees(np.linalg.norm(unit(solution["RA"], solution["Dec"]) - unit(ra, dec))) * 3600
        print(f"{kind} {ra} {dec} {roll}: {error_arcsec:.4f} arcsec", file=sys.stderr)
        assert error_arcsec < limit_arcsec
        # The roll is known less well by the ratio of the field's radius to a radian, about 6 to 10.
        assert abs((solution["Roll"] - roll + 180) % 360 - 180) * 3600 < 10 * limit_arcsec * 6
        assert solution["FOV"] == pytest.approx(20.0, abs=0.01)
