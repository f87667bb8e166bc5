"""calibrate geometric from the tracker's images: dots as blurred squares of light, with noise,
hot pixels and a dark frame.
"""

from __future__ import annotations

import json
import shlex
import shutil
import sys

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
    wanted = ("-o", folder / "plan", "--frames", "10", "--dots", "24")
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


def words_for(session, plan):
    """The command with its session, but for the images."""
    words = ["calibrate", "geometric", session / "bench.toml", "--plan", plan, "--json"]
    return [*words, "--tracker-is-ideal", "--dark", session / "dark.fits"]


@pytest.fixture(scope="module")
def given(session):
    """What the command says of the images' files, in the order of their frames."""
    # which rounding follows
    files = [*session.glob("frame_*.fits"), *session.glob("frame_*.png")]
    files.sort(key=lambda path: path.stem)
    words = words_for(session, session / "plan")
    result = run_hilstar_here(*words, "-o", session / "geometry.toml", *files)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_images_give_what_centroids_give(given):
    assert given["noise_px"] < 0.02
    assert given["centroids"]["false"] < 0.02 * given["centroids"]["given"]
    assert given["held_out"]["rms_arcsec"] < IMAGES_ARCSEC[0] * 2
    assert given["error"]["max_arcsec"] < IMAGES_ARCSEC[1]


def grabbing(session, folder):
    """A command that takes the session's images, as a camera before the patterns would."""
    script = folder / "grab.py"
    script.write_text(
        "import pathlib, shutil, sys\n"
        "output, pattern = map(pathlib.Path, sys.argv[1:])\n"
        "assert pattern.stat().st_size\n"
        f"taken, = pathlib.Path({str(session)!r}).glob(output.stem + '.*')\n"
        "shutil.copy(taken, output)\n"
    )
    return f"{shlex.quote(sys.executable)} {script} {{output}} {{pattern}}"


def test_images_that_are_taken_here_give_what_their_files_give(session, given, tmp_path):
    plan = tmp_path / "plan"
    shutil.copytree(session / "plan", plan)
    words = words_for(session, plan)
    grab = ("--grab", grabbing(session, tmp_path))
    run = run_hilstar_here(*words, "-o", tmp_path / "taken.toml", *grab)
    assert run.returncode == 0, run.stderr
    assert "frame_009: image 10 of 10" in run.stderr
    taken = json.loads(run.stdout)
    assert taken == given | {"written": taken["written"]}
    again = run_hilstar_here(*words, "-o", tmp_path / "again.toml", *grab)
    assert_refused(again, 2, "has images", "--overwrite")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "no image of the dots: give their files, or --grab"),
        (("frame_001.png", "--grab", "genicam:"), "--grab takes the images"),
        (("frame_001.png", "--exposure", "1"), "--exposure: is for --grab"),
        (("--grab", "cp {pattern} {output}", "--exposure", "1"), "--grab has no {exposure_s}"),
        (("--grab", "cp {pattern} {output}", "--feed", "3"), "not an endpoint"),
        (("--grab", "false {pattern} {output}"), "ended with code 1"),
    ],
)
def test_a_grab_that_does_not_fit_is_refused(session, tmp_path, words, says):
    plan = tmp_path / "plan"
    shutil.copytree(session / "plan", plan)
    words = [str(session / word) if word.startswith("frame_") else word for word in words]
    wanted = ("--plan", plan, "-o", tmp_path / "g.toml", "--tracker-is-ideal")
    refused = run_hilstar_here("calibrate", "geometric", session / "bench.toml", *words, *wanted)
    assert_refused(refused, 2, says)


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
