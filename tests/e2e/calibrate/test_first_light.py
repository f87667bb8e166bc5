"""hilstar first-light: whole sessions on a planted bench, killed and resumed, and by a command
that takes the images.
"""

from __future__ import annotations

import json
import math
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import from_rotation_vector, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.display.calibration import (
    CalibrationHead,
    NotesTable,
    load_calibration,
    read_toml,
    write_calibration,
)
from hilstar.display.geometry import ErrorTable, MadeTable, Notes, write_geometry
from hilstar.display.response import gamma_response, srgb_response
from hilstar.instruments.calibrate.first_light.photometry import response_error_mag
from hilstar.optics.camera import Camera, Lens
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.cameras import bench_camera
from tests.support import plain_camera
from tests.support.benches import TWIN, bench_text
from tests.support.claims import holds
from tests.support.commands import assert_refused, run_hilstar_here, typed
from tests.support.forks import HILSTAR, Started
from tests.support.undrawn import charts_left_out
from tests.support.waiting import PATIENCE_S

GAMMA_22 = {"monitor": {"calibration": "gamma2.2", "photodiode_px": 40}}
NOTES = Notes({}, ErrorTable(), MadeTable(by="planted", when="2026-11-21", poses=1))
STEPS = [
    "machine",
    "display",
    "orientation",
    "focus",
    "warm-up",
    "geometry",
    "uniformity",
    "photometry",
    "scale",
    "latency",
    "verify",
]
FEW = ["--patches", 30]  # 12 levels
NONE = ["--patches", 0]
GAMMA, BLACK, WHITE_E_PER_S = 2.35, 1 / 800, 2.5e6
# `calibrate photometric` states the error of 12 levels at 3 decades below white as 0.4 %; the
# tracker's whole DN add as much.
RESPONSE_MAG = 0.01
DELAY_MS, EDGE_MS = 12.5, 0.05  # an edge's jitter of 0.1 ms leaves 0.01 in the median of 150
SCALE_MAG = 0.005  # 20 stars or more, each within 0.01 mag
# The tracker's pixel is 107 arcsec. Held-out dots of this bench are 0.2 arcsec rms off; outside the
# tracker's field, which is a third of the screen, nothing is measured and the lens is extrapolated.
PLACES_ARCSEC = 3.0
SAME = 1e-6  # figures are written with six digits
SEEN_SHARE = 0.6  # of the screen's width and height, about its middle: what the tracker surely sees


def plant(folder, **monitor):
    """A bench file, and a truth of which it knows nothing: mirror, lens, tilt, centre, focal
    length, light, and delay.
    """
    (folder / "bench.toml").write_text(bench_text(TWIN, GAMMA_22))
    head = CalibrationHead(
        "photometric", "planted", "2026-11-22", "none", "relative", 10, "true-response.csv"
    )
    light = {"w": BLACK + gamma_response(10, GAMMA).light}
    write_calibration(folder / "true-response.toml", head, light, 0.0, NotesTable())
    changed = {
        "monitor": {"calibration": "true-response.toml", "panel_delay_ms": DELAY_MS} | monitor,
        "collimator": {"geometry": "true.toml"},
        "render": {"flux_at_white_e_per_s": WHITE_E_PER_S},
    }
    q = from_rotation_vector(np.radians([0.2, -0.15, 0.5]))
    size = (480, 640) if monitor.get("rotate_deg", 0) % 180 else (640, 480)
    upright = {"monitor": {"resolution_px": list(size)}}
    (folder / "truth.toml").write_text(bench_text(TWIN, changed, upright))
    centre = ((size[0] - 1) / 2 + 15, (size[1] - 1) / 2 - 8)
    lens = Lens((0.6, 0.0, 0.0), (0.0, 0.0), (math.radians(1.0), math.radians(-0.4)))
    camera = Camera(size, 120e3 / 57.65 * 1.01, centre, to_matrix(q), lens)
    write_geometry(folder / "true.toml", camera, q, NOTES)
    return folder


def places_off_arcsec(folder):
    """How far the places that the tracker sees are from where the truth has them, rms over the
    directions of its field.
    """
    files = [read_bench_file(folder / name) for name in ("bench.toml", "truth.toml")]
    cameras = [bench_camera(file.config, folder) for file in files]
    sides = [
        np.linspace((1 - SEEN_SHARE) / 2, (1 + SEEN_SHARE) / 2, 15) * (size - 1)
        for size in cameras[0].resolution_px
    ]
    x, y = (part.ravel() for part in np.meshgrid(*sides))
    mine, its = (
        rays / np.linalg.norm(rays, axis=1)[:, None]
        for rays in (camera.rays(x, y) for camera in cameras)
    )
    return float(
        np.sqrt((np.linalg.norm(np.cross(mine, its), axis=1) ** 2).mean()) * ARCSEC_PER_RAD
    )


def go(folder, *more):
    return run_hilstar_here("first-light", folder / "bench.toml", "-o", folder / "s", *more)


def virtually(folder, *more):
    return go(folder, "--virtual", folder / "truth.toml", "--json", *more)


def steps_by_name(result):
    return {step["name"]: step for step in json.loads(result.stdout)["steps"]}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A session before and after its response was measured; tests/e2e/browser looks at a page with
    its charts.
    """
    folder = plant(tmp_path_factory.mktemp("light"), flip_x=True)
    with charts_left_out():
        before = virtually(folder, *NONE)
        result = virtually(folder, *FEW)
    assert before.returncode == 1, before.stderr
    assert result.returncode == 0, result.stderr
    return folder, json.loads(result.stdout), steps_by_name(before)


def test_a_wrong_response_fails_the_light_and_not_the_places(whole):
    _, _, before = whole
    verdicts = [before[name]["verdict"] for name in ("geometry", "photometry", "scale", "verify")]
    assert verdicts == ["done", "skipped", "failed", "failed"]
    assert "photometry" in before["scale"]["line"]
    figures = before["verify"]["figures"]
    assert figures["star_p95_px"] < 0.1  # [verify] centroid_px
    assert figures["flux_p95_mag"] > 0.05  # [verify] flux_mag
    assert figures["twin_flux_p95_mag"] > 0.05
    assert figures["twin_centroid_p95_px"] < 0.1


def test_the_response_and_the_full_scale_are_found_and_mended(whole):
    folder, found, _ = whole
    steps = {step["name"]: step for step in found["steps"]}
    light = steps["photometry"]["figures"]
    assert light["gamma"] == pytest.approx(GAMMA, abs=0.005)
    assert light["black_level"] == pytest.approx(BLACK, rel=0.02)
    assert light["bench_file_off_max_mag"] > 0.3
    holds("first-light-response", light["truth_max_mag"])
    scale = steps["scale"]["figures"]["flux_at_white_e_per_s"]
    holds("first-light-scale", 100 * abs(scale / WHITE_E_PER_S - 1))
    assert steps["latency"]["figures"]["panel_delay_ms"] == pytest.approx(DELAY_MS, abs=EDGE_MS)
    figures = steps["verify"]["figures"]
    assert max(figures["flux_p95_mag"], figures["twin_flux_p95_mag"]) < 0.05
    config = read_bench_file(folder / "bench.toml").config
    assert config.monitor.calibration == "s/response.toml"
    assert config.monitor.panel_delay_ms == pytest.approx(DELAY_MS, abs=EDGE_MS)
    # a key has six digits
    assert config.render.flux_at_white_e_per_s == float(f"{scale:.6g}")


def test_a_whole_virtual_session_finds_mirror_and_lens(whole):
    folder, found, _ = whole
    steps = {step["name"]: step for step in found["steps"]}
    assert list(steps) == STEPS
    undone = {name for name, step in steps.items() if step["verdict"] != "done"}
    # which a virtual bench has none of
    assert undone == {"display"}
    assert steps["orientation"]["figures"]["seen"] == "mirrored left to right"
    config = read_bench_file(folder / "bench.toml").config
    assert (config.monitor.flip_x, config.collimator.geometry) == (True, "s/geometry.toml")
    assert places_off_arcsec(folder) < PLACES_ARCSEC
    assert steps["verify"]["figures"]["truth_rms_arcsec"] < 2 * PLACES_ARCSEC
    assert (folder / "s" / "bench-before.toml").read_text() == bench_text(TWIN, GAMMA_22)


def again_by_hand(line, *words):
    result = run_hilstar_here("calibrate", *typed(line, *words), "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_the_commands_of_calibrate_give_the_figures_of_the_steps(whole, tmp_path):
    """One code, two entrances: the step's own files through `calibrate geometric`, `photometric`
    and `scale`.
    """
    folder, found, _ = whole
    steps = {step["name"]: step["figures"] for step in found["steps"]}
    images = folder / "s" / "images" / "geometry-1"
    words = f"--plan {images} --dark {images}/dark_000.png -o {tmp_path}/geometry.toml"
    geometry = again_by_hand(
        f"geometric {folder}/bench.toml --tracker-is-ideal {words}",
        *sorted(images.glob("frame_*.png")),
    )
    light = again_by_hand(
        f"photometric {folder}/s/measured.csv --bits 10 -o {tmp_path}/response.toml"
    )
    # as the bench file was before the step: white as it had it
    white = steps["scale"]["in_bench_file_e_per_s"]
    text = re.sub(
        r"flux_at_white_e_per_s = .*",
        f"flux_at_white_e_per_s = {white!r}",
        (folder / "bench.toml").read_text(),
    )
    (folder / "before-scale.toml").write_text(text)
    readings = (folder / "s" / "readings.csv").read_text().splitlines()[1:]
    told = " ".join(f"--reading {line}" for line in readings)
    scale = again_by_hand(f"scale {folder}/before-scale.toml {told}")
    assert geometry["model"] == steps["geometry"]["model"]
    for figure, name, key in (
        (geometry["held_out"]["rms_arcsec"], "geometry", "held_out_rms_arcsec"),
        (geometry["error"]["rms_arcsec"], "geometry", "error_rms_arcsec"),
        (geometry["parameters"]["focal_length_px"]["value"], "geometry", "focal_length_px"),
        (light["holdout"]["rms_mag"], "photometry", "held_out_rms_mag"),
        (light["black_level"]["relative"], "photometry", "black_level"),
        (scale["flux_at_white_e_per_s"], "scale", "flux_at_white_e_per_s"),
    ):
        assert figure == pytest.approx(steps[name][key], rel=SAME), key
    own, again = (folder / "s" / "response.toml", tmp_path / "response.toml")
    assert read_toml(own).errors == read_toml(again).errors
    responses = [load_calibration(path, 10).response.light for path in (own, again)]
    assert np.array_equal(*responses)


def test_the_page_needs_nothing_beside_it(whole):
    folder, found, _ = whole
    page = (folder / "s" / "first-light.html").read_text()
    assert not re.search(r"(src|href)=['\"](?!data:|#)", page)
    assert page.count("data:image/svg+xml;base64,") == 12
    for step in found["steps"]:
        assert f'id="{step["name"]}"' in page
        assert (step["number"] is not None) == (step["verdict"] == "done")
    assert found["bench_sha256"] in page
    assert "+flip_x = true" in page


def started(folder, *more):
    line = f"first-light {folder}/bench.toml -o {folder}/s --virtual {folder}/truth.toml"
    words = [*HILSTAR, *typed(line, *map(str, more))]
    return Started(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ended_at(process, folder, image, ending):
    """Let a session run until an image is there, end it so, and give back the images of that
    step and when they were taken.
    """
    end_s = time.monotonic() + PATIENCE_S
    while not list((folder / "s").glob(f"images/{image}*")):
        assert time.monotonic() < end_s
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(ending)
    process.wait(PATIENCE_S)
    return {
        path: path.stat().st_mtime_ns
        for path in sorted((folder / "s").glob(f"images/{image.split('/')[0]}/[!.]*.png"))
    }


def untouched(taken):
    """How many of the images are as they were; the last one may have been cut short, and is
    taken again.
    """
    return sum(path.exists() and path.stat().st_mtime_ns == when for path, when in taken.items())


@pytest.mark.usefixtures("without_charts")
def test_a_session_that_is_stopped_or_killed_half_way_says_so_and_goes_on_where_it_was(tmp_path):
    folder = plant(tmp_path, rotate_deg=90)
    with started(folder, *FEW) as process:
        taken = ended_at(process, folder, "geometry-1/frame_007", signal.SIGKILL)
        assert process.returncode == -signal.SIGKILL
        assert "Traceback" not in process.stderr.read()
    session = json.loads((folder / "s" / "session.json").read_text())
    assert session["running"] == "geometry"
    assert [step["name"] for step in session["steps"]] == STEPS[:5]
    with started(folder, *FEW) as process:
        readings = ended_at(process, folder, "photometry-1/patch_010", signal.SIGTERM)
        assert process.returncode == 128 + signal.SIGTERM
        assert "Traceback" not in process.stderr.read()
    assert untouched(taken) == len(taken) - 1 > 6
    resumed = virtually(folder, *FEW)
    assert resumed.returncode == 0, resumed.stderr
    assert untouched(readings) == len(readings) - 1 > 10
    seen = set(STEPS) - {"machine", "display", "latency"}
    assert {path.name for path in (folder / "s" / "images").iterdir()} == {f"{n}-1" for n in seen}
    assert not list((folder / "s").rglob("*.part*"))
    light = steps_by_name(resumed)["photometry"]["figures"]
    assert light["truth_max_mag"] < RESPONSE_MAG
    assert read_bench_file(folder / "bench.toml").config.monitor.rotate_deg == 90
    assert places_off_arcsec(folder) < PLACES_ARCSEC


@pytest.mark.usefixtures("without_charts")
def test_the_truth_that_comes_with_hilstar_is_found(tmp_path):
    """By its name alone, in a folder that has no such file: mirror, focal length, light, its
    fall to the edges, full scale.
    """
    shutil.copy(resource_path("configs", "demo.toml"), tmp_path / "bench.toml")
    result = run_hilstar_here(
        "first-light bench.toml -o s --virtual truth-example.toml --patches 60 --json", cwd=tmp_path
    )
    assert result.returncode == 0, result.stderr
    steps = steps_by_name(result)
    assert steps["orientation"]["figures"]["seen"] == "mirrored left to right"
    assert steps["uniformity"]["figures"]["darkest_of_brightest"] < 0.95
    assert steps["uniformity"]["figures"]["truth_rms_mag"] < 0.005
    assert steps["photometry"]["figures"]["truth_max_mag"] < RESPONSE_MAG
    assert steps["scale"]["figures"]["flux_at_white_e_per_s"] == pytest.approx(2.4e6, rel=SCALE_MAG)
    light = steps["verify"]["figures"]
    assert light["flux_scatter_mag"] < 1.5 * light["flux_error_mag"]


@pytest.mark.usefixtures("without_charts")
def test_images_come_from_a_command(tmp_path):
    (tmp_path / "bench.toml").write_text(bench_text(TWIN, GAMMA_22))
    with plain_camera.on_duty() as camera:
        grab = f"{camera} {{pattern}} {{output}} --reversed --exposure {{exposure_s}}"
        result = go(tmp_path, "--grab", grab, *FEW, "--json")
    assert result.returncode == 0, result.stderr
    steps = steps_by_name(result)
    assert steps["orientation"]["figures"]["seen"] == "mirrored top to bottom"
    # The camera's pixels are points; a screen's are squares of 0.924 px, which the figure takes out
    # of the dots' width.
    assert steps["focus"]["figures"]["psf_sigma_px"] == pytest.approx(
        math.sqrt(plain_camera.SIGMA_PX**2 - 0.924**2 / 12), abs=0.02
    )
    assert steps["geometry"]["figures"]["focal_length_px"] == pytest.approx(120e3 / 57.65, rel=1e-4)
    light, srgb = steps["photometry"]["figures"], srgb_response(10)
    assert light["exposure_s"] < 0.1  # in which white saturates
    assert light["black_level_measured"].startswith("no")
    measured = load_calibration(tmp_path / "s" / "response.toml", 10).response
    assert np.abs(response_error_mag(measured, srgb)).max() < RESPONSE_MAG
    white_e_per_s = (
        plain_camera.WHITE_DN_PER_S
        * read_bench_file(tmp_path / "bench.toml").config.tracker.detector.gain_e_per_dn
    )
    assert steps["scale"]["figures"]["flux_at_white_e_per_s"] == pytest.approx(
        white_e_per_s, rel=SCALE_MAG
    )
    assert steps["verify"]["figures"]["star_rms_px"] < 0.05
    assert steps["verify"]["figures"]["flux_p95_mag"] < 0.05


def test_a_command_that_fails_is_a_failed_step_and_what_needs_it_is_not_done(tmp_path):
    (tmp_path / "bench.toml").write_text(
        bench_text(TWIN, {"tracker": {"exposure_s": 0.045}, "render": {"tolerance_px": 0.02}})
    )
    fails = (
        f"{shlex.quote(sys.executable)} -c \"import sys; sys.exit('camera 3 is not there')\""
        " {pattern} {output}"
    )
    result = go(tmp_path, "--grab", fails, "--json")
    assert result.returncode == 1
    steps = steps_by_name(result)
    assert steps["orientation"]["verdict"] == "failed"
    assert "camera 3 is not there" in steps["orientation"]["line"]
    assert {steps[name]["verdict"] for name in ("focus", "geometry", "verify")} == {"skipped"}
    page = (tmp_path / "s" / "first-light.html").read_text()
    assert (
        "Not ready: orientation failed" in page
        and "What to do:" in page
        and "--again orientation" in page
    )
    # Whatever fails: 2.7 refreshes beat with the screen.
    (beats,) = (line for line in result.stderr.splitlines() if "refreshes" in line)
    assert (
        beats.startswith("exposures of 0.045 s are 2.7 refreshes of 60 Hz")
        and "[tracker] exposure_s = 0.05" in beats
    )
    assert beats in page
    assert json.loads(result.stdout)["beat"]["proposal"]["exposure_s"] == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--again", "focsu"], ["--again focsu", "focus"]),
        (["--grab", "snapshot"], ["{output}"]),
        (["--grab", "cp {output}", "--virtual", "truth.toml"], ["--grab and --virtual"]),
        (["--virtual", "none.toml"], ["none.toml"]),
        (["--grab", "cp {output}", "--dark", "none.fits"], ["none.fits"]),
        (["--patches", "-1"], ["--patches"]),
        (["--grab", "cp {output}", "--diode", "tcp://x"], ["--diode", "serial:"]),
        (["--virtual", "truth.toml", "--dark", "truth.toml"], ["--dark and --virtual"]),
        (["--virtual", "small.toml"], ["small.toml", "screen"]),
    ],
)
def test_wrong_words_get_one_line(tmp_path, words, said):
    plant(tmp_path)
    (tmp_path / "small.toml").write_text(
        bench_text(TWIN, {"monitor": {"resolution_px": [320, 240]}})
    )
    result = run_hilstar_here("first-light", "bench.toml", "-o", "s", *words, cwd=tmp_path)
    assert_refused(result, 2, *said)
    assert not (tmp_path / "s" / "session.json").exists()


def test_a_wrong_bench_file_gets_one_line(tmp_path):
    plant(tmp_path)
    (tmp_path / "bench.toml").write_text(bench_text(TWIN, {"monitor": {"flip_x": "yes"}}))
    assert_refused(virtually(tmp_path), 2, "flip_x", "true or false")


@pytest.mark.skipif(shutil.which("true") is None, reason="the system has no true")
def test_without_a_display_the_machine_lacks_something(tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    plant(tmp_path)
    result = go(tmp_path, "--grab", "true {output}")
    assert result.returncode == 3
    assert "{pattern}" in result.stderr
