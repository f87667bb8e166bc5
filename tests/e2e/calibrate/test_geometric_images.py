"""calibrate geometric from the tracker's images: dots as blurred squares of light, with noise,
hot pixels and a dark frame.
"""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image
from scipy.special import ndtr

from hilstar.instruments.calibrate.geometric.dots import read_plan
from tests.e2e.calibrate.test_geometric import BENCH, FILE, STARS_ARCSEC, TRACKER, TRACKER_PX
from tests.support.commands import assert_refused, run_hilstar_here

SIGMA_PX, PEAK_DN, FLOOR_DN, NOISE_DN = 1.1, 9000.0, 400.0, 12.0
HOT = 150  # pixels
# An image's centroids are better than 0.02 px here, but for the S-curve of the centroider: twice
# the aim for a table.
IMAGES_ARCSEC = tuple(2 * aim for aim in STARS_ARCSEC)


def image_of(x, y, rng, hot):
    """Gaussians integrated over pixels: nothing of hilstar's own."""
    image = np.full((TRACKER_PX, TRACKER_PX), FLOOR_DN)
    for cx, cy in zip(x, y, strict=True):
        left, top = int(cx) - 8, int(cy) - 8
        if min(left, top) < 0 or max(left, top) + 17 > TRACKER_PX:
            continue
        columns, rows = (np.arange(17) + corner for corner in (left, top))
        across, down = (
            ndtr((places + 0.5 - c) / SIGMA_PX) - ndtr((places - 0.5 - c) / SIGMA_PX)
            for places, c in ((columns, cx), (rows, cy))
        )
        image[top : top + 17, left : left + 17] += (
            PEAK_DN * 2 * np.pi * SIGMA_PX**2 * np.outer(down, across) / 2.2
        )
    image += rng.normal(0, NOISE_DN, image.shape)
    image[hot] += 6000
    return np.clip(np.rint(image), 0, 65535).astype(np.uint16)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    (folder / "bench.toml").write_text(FILE)
    wanted = ("-o", folder / "plan", "--frames", "12", "--dots", "40")
    assert run_hilstar_here("calibrate", "dots", folder / "bench.toml", *wanted).returncode == 0
    plan = read_plan(folder / "plan" / "plan.csv")
    x, y = TRACKER.project(BENCH.directions(plan.x_px, plan.y_px))
    rng = np.random.default_rng(8)
    hot = (rng.integers(0, TRACKER_PX, HOT), rng.integers(0, TRACKER_PX, HOT))
    for frame in range(plan.frames):
        lit = plan.lit[:, frame]
        data = image_of(x[lit], y[lit], rng, hot)
        if frame % 2:
            Image.fromarray(data).save(folder / f"frame_{frame:03}.png", compress_level=1)
        else:
            fits.PrimaryHDU(data).writeto(folder / f"frame_{frame:03}.fits")
    fits.PrimaryHDU(image_of([], [], rng, hot)).writeto(folder / "dark.fits")
    return folder


def images_in(folder):
    return sorted(folder.glob("frame_*.fits")) + sorted(folder.glob("frame_*.png"))


def test_images_give_what_centroids_give(session):
    wanted = (
        "--plan",
        session / "plan",
        "-o",
        session / "geometry.toml",
        "--tracker-is-ideal",
        "--json",
    )
    result = run_hilstar_here(
        "calibrate",
        "geometric",
        session / "bench.toml",
        *images_in(session),
        *wanted,
        "--dark",
        session / "dark.fits",
    )
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["noise_px"] < 0.02
    assert found["centroids"]["false"] < 0.02 * found["centroids"]["given"]
    assert found["held_out"]["rms_arcsec"] < IMAGES_ARCSEC[0] * 2
    assert found["error"]["max_arcsec"] < IMAGES_ARCSEC[1]


@pytest.mark.parametrize("kind", ["saturated", "no number", "small", "text", "twice"])
def test_images_that_cannot_be_measured_get_one_line(session, tmp_path, kind):
    good = np.asarray(Image.open(session / "frame_001.png"))
    image = tmp_path / "frame_001.png"
    words = {
        "saturated": ("saturated", "expose shorter"),
        "no number": ("no frame number",),
        "small": ("resolution_px",),
        "text": ("frame_001.png",),
        "twice": ("frame 1 of pose 0",),
    }[kind]
    images = [image]
    match kind:
        case "saturated":
            Image.fromarray(np.where(good > 2000, 65535, good).astype(np.uint16)).save(
                image, compress_level=1
            )
        case "no number":
            images = [tmp_path / "dots.png"]
            shutil.copy(session / "frame_001.png", images[0])
        case "small":
            Image.fromarray(good[:100]).save(image)
        case "text":
            image.write_text("no image")
        case "twice":
            images = [session / "frame_001.png", image]
            shutil.copy(images[0], image)
    wanted = ("--plan", session / "plan", "-o", tmp_path / "g.toml", "--tracker-is-ideal")
    assert_refused(
        run_hilstar_here("calibrate", "geometric", session / "bench.toml", *images, *wanted),
        2,
        *words,
    )
