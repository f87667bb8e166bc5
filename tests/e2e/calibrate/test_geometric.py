"""calibrate dots and geometric, from the plan to a frame that is drawn through the lens that was
found.
"""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from PIL import Image

import hilstar
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.calibrate.geometric.dots import read_plan
from hilstar.optics.camera import Camera
from tests.support.commands import assert_refused, run_hilstar_here, typed
from tests.support.traced_bench import TracedBench, observed_dots

BENCH = TracedBench()
TRACKER_PX = 2048
TRACKER = Camera(
    (TRACKER_PX, TRACKER_PX), ARCSEC_PER_RAD / 38, ((TRACKER_PX - 1) / 2,) * 2, np.eye(3)
)
FILE = f"""
[tracker]
aperture_mm = 30
focal_length_mm = {TRACKER.focal_length_px / 100!r}
pixel_pitch_um = 10
resolution_px = [{TRACKER_PX}, {TRACKER_PX}]
quantum_efficiency = 0.5

[monitor]
resolution_px = [1920, 1080]
pixel_pitch_um = 57.65

[collimator]
focal_length_mm = 350
"""
STARS_ARCSEC = (0.25, 1.0)  # rms and maximum over the screen


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("geometric")
    (folder / "bench.toml").write_text(FILE)
    made = run_hilstar_here(
        "calibrate", "dots", folder / "bench.toml", "-o", folder / "plan", "--json"
    )
    assert made.returncode == 0, made.stderr
    seen = observed_dots(
        BENCH, read_plan(folder / "plan" / "plan.csv"), TRACKER, np.random.default_rng(4)
    )
    with (folder / "observed.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "x_px", "y_px"])
        writer.writerows(
            zip(seen.frame.tolist(), seen.x_px.tolist(), seen.y_px.tolist(), strict=True)
        )
    return folder


@pytest.fixture(scope="module")
def fitted(session):
    wanted = typed(f"--plan {session}/plan -o {session}/geometry.toml --tracker-is-ideal --json")
    result = run_hilstar_here(
        f"calibrate geometric {session}/bench.toml {session}/observed.csv",
        *wanted,
        "--plot",
        session / "geometry.png",
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_every_frame_shows_the_dots_of_its_rows(session):
    plan = read_plan(session / "plan" / "plan.csv")
    for frame in (0, plan.frames - 1):
        image = np.asarray(Image.open(session / "plan" / f"frame_{frame:03}.png"))
        assert image.shape == (1080, 1920)
        assert (image == 255).sum() == 9 * plan.lit[:, frame].sum()
        lit = plan.lit[:, frame]
        assert (image[plan.y_px[lit].astype(int), plan.x_px[lit].astype(int)] == 255).all()


def test_the_summary_says_what_was_lost_and_what_is_known(fitted, session):
    assert (
        fitted["centroids"]["matched"] + fitted["centroids"]["false"]
        == fitted["centroids"]["given"]
    )
    assert 0.02 < fitted["centroids"]["lost"] / fitted["centroids"]["given"] < 0.1
    assert fitted["noise_px"] == pytest.approx(0.02, rel=0.15)
    assert fitted["held_out"]["rms_arcsec"] < 1.2 * fitted["held_out"]["noise_arcsec"]
    assert any("cannot be told apart" in note for note in fitted["notes"])
    assert (session / "geometry.png").stat().st_size > 10_000


def test_stars_are_drawn_through_the_lens_that_was_found(fitted, session):
    path = session / "real.toml"
    path.write_text(FILE + 'geometry = "geometry.toml"\n')
    with hilstar.load(path) as bench:
        q = from_radec_roll_deg(84.0, -1.0, 20.0)
        truth = bench.frame(q).truth
        place = {int(hip): k for k, hip in enumerate(bench.stars.hip)}
        vectors = bench.stars.vectors @ to_matrix(q).T
        x, y = BENCH.places_px(vectors[[place[int(hip)] for hip in truth["hip"]]])
        off = (
            np.hypot(x - truth["x_px"], y - truth["y_px"])
            * ARCSEC_PER_RAD
            / bench.camera.focal_length_px
        )
        front_x, front_y = BENCH.places_px(vectors[vectors[:, 2] > 0.9])
        on_screen = (np.abs(front_x - 959.5) < 960) & (np.abs(front_y - 539.5) < 540)
    assert np.sqrt((off**2).mean()) < STARS_ARCSEC[0]
    assert off.max() < STARS_ARCSEC[1]
    # no corner loses a star
    assert ((np.abs(x - 959.5) < 960) & (np.abs(y - 539.5) < 540)).sum() == on_screen.sum() > 100


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda text: text.replace("frame,x_px", "frame,col"),
            ("observed.csv:1", "x_px is missing"),
        ),
        (lambda text: text.replace("\n", "\n0,nan,3\n", 1), ("observed.csv:2", "finite")),
        (lambda text: text.splitlines()[0] + "\n", ("no centroid",)),
        (lambda text: "\n".join(text.splitlines()[:40]) + "\n", ("match no dots",)),
    ],
)
def test_a_table_that_is_none_gets_one_line(session, tmp_path, change, words):
    path = tmp_path / "observed.csv"
    path.write_text(change((session / "observed.csv").read_text().replace("\r\n", "\n")))
    wanted = ("--plan", session / "plan", "-o", tmp_path / "g.toml", "--tracker-is-ideal")
    assert_refused(
        run_hilstar_here("calibrate", "geometric", session / "bench.toml", path, *wanted), 2, *words
    )
    assert not (tmp_path / "g.toml").exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("kind = ", "sort = "), ("sort",)),
        (("[1920, 1080]", "[1280, 1024]"), ("1280 x 1024", "1920 x 1080")),
        (("k1 = ", "k1 = -2"), ("folds",)),
        (("q_cam_to_mon = [", "q_cam_to_mon = [7"), ("norm",)),
    ],
)
def test_a_geometry_file_that_is_none_gets_one_line(fitted, session, tmp_path, change, words):
    old, new = change
    text = (session / "geometry.toml").read_text()
    if new == "k1 = -2":
        text = "".join(
            "k1 = -200\n" if line.startswith(old) else line
            for line in text.splitlines(keepends=True)
        )
    else:
        text = text.replace(old, new)
    (tmp_path / "geometry.toml").write_text(text)
    (tmp_path / "bench.toml").write_text(FILE + 'geometry = "geometry.toml"\n')
    result = run_hilstar_here(
        "frame", tmp_path / "bench.toml", "--radec", "1,2,3", "--truth", tmp_path / "t.csv"
    )
    assert_refused(result, 2, "geometry.toml", *words)
