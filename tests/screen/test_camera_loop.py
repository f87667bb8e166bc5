"""A bench of software alone, end to end: first light on a real X server's screen, the virtual
tracker that watches it, its GigE Vision camera, and Aravis that takes the images.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import tomllib

import pytest

from hilstar.server.bench.config.hardware import DEFAULT_PSF_SIGMA_PX
from hilstar.server.genicam.camera import has_aravis
from tests.support.benches import TWIN, bench_text
from tests.support.commands import run_hilstar_here
from tests.support.forks import HILSTAR, Started
from tests.support.gige_client import own_address
from tests.support.senders import free_port
from tests.support.waiting import PATIENCE_S

# The truth's collimator; the bench file says 120 mm.
TRUE_FOCAL_MM = 121.0


MAX_NOISE_PX = 0.02  # of a dot's place in an image of the virtual tracker
SIGMAS = 4.0


def benches(folder):
    """The bench file, and the truth that the virtual tracker looks through."""
    bench, truth = folder / "bench.toml", folder / "truth.toml"
    bench.write_text(bench_text(TWIN, {"monitor": {"bits": 8}}))
    true = {"monitor": {"bits": 8}, "collimator": {"focal_length_mm": TRUE_FOCAL_MM}}
    truth.write_text(bench_text(TWIN, true))
    return bench, truth


@contextlib.contextmanager
def virtual_camera(truth, endpoint):
    """The virtual tracker's camera before what is shown at the endpoint: its address, and what it
    prints at the end.
    """
    address = own_address()
    command = [*HILSTAR, "tracker", truth, "--watch", endpoint, "--camera", address, "--json"]
    with Started(
        list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as tracker:

        def ended():
            tracker.terminate()
            return tracker.communicate(timeout=PATIENCE_S)

        yield address, ended


needs_aravis = pytest.mark.skipif(
    not has_aravis(), reason="Aravis is not installed (gir1.2-aravis-0.8, python3-gi)"
)


@needs_aravis
@pytest.mark.usefixtures("without_charts")
def test_first_light_calibrates_a_bench_through_the_virtual_trackers_camera(screen_here, tmp_path):
    bench, truth = benches(tmp_path)
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    with virtual_camera(truth, endpoint) as (address, ended):
        words = f"--grab genicam:{address} --feed {endpoint} --frames 2 --patches 0 --json"
        result = run_hilstar_here(f"first-light {words}", bench, "-o", tmp_path / "s")
        told, err = ended()
    assert result.returncode == 0, (result.stderr, err)
    camera = json.loads(told)["camera"]
    assert camera["images"] > 10 and camera["dropped"] == 0
    steps = {step["name"]: step for step in json.loads(result.stdout)["steps"]}
    assert steps["display"]["verdict"] == "done"
    focal_px = steps["geometry"]["figures"]["focal_length_px"]
    assert focal_px == pytest.approx(TRUE_FOCAL_MM * 1e3 / 57.65, rel=1e-3)
    assert steps["verify"]["figures"]["star_rms_px"] < 0.1
    measured = tomllib.loads((tmp_path / "s" / "geometry.toml").read_text())
    assert {"connector": "screen", "mode": "640x480@0.00", "bits": 8}.items() <= measured[
        "monitor_identity"
    ].items()
    # The twin agrees: of the true collimator the bench passes now.
    judged = tmp_path / "judged.toml"
    judged.write_text(f"{bench.read_text()}\n[verify]\ntrue_focal_length_mm = {TRUE_FOCAL_MM}\n")
    verified = run_hilstar_here("verify", judged, "--fields", "3", "--strict")
    assert verified.returncode == 0, (verified.stdout, verified.stderr)


@needs_aravis
@pytest.mark.usefixtures("without_charts")
def test_geometry_and_psf_are_calibrated_by_dots_that_a_camera_takes(screen_here, tmp_path):
    bench, truth = benches(tmp_path)
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    plan = tmp_path / "plan"
    planned = run_hilstar_here("calibrate dots --frames 10 --dots 25", bench, "-o", plan)
    assert planned.returncode == 0, planned.stderr
    with virtual_camera(truth, endpoint) as (address, ended):
        words = f"--grab genicam:{address} --feed {endpoint} --tracker-is-ideal --json"
        files = (bench, "-o", tmp_path / "geometry.toml", "--plan", plan)
        geometry = run_hilstar_here(f"calibrate geometric {words}", *files)
        told, err = ended()
    assert geometry.returncode == 0, (geometry.stderr, err)
    assert json.loads(told)["camera"]["dropped"] == 0
    found = json.loads(geometry.stdout)
    assert "its dots saturate the tracker" in geometry.stderr
    assert found["noise_px"] < MAX_NOISE_PX and found["centroids"]["false"] == 0
    fitted = found["parameters"]["focal_length_px"]
    off_px = abs(fitted["value"] - TRUE_FOCAL_MM * 1e3 / 57.65)
    assert off_px < SIGMAS * fitted["sigma"] < 0.5
    images = sorted((plan / "images").glob("frame_*.png"))
    files = (bench, *images, "--plan", plan, "-o", tmp_path / "psf.fits")
    psf = run_hilstar_here("calibrate psf --json", *files)
    assert psf.returncode == 0, psf.stderr
    assert json.loads(psf.stdout)["sigma_px"] == pytest.approx(DEFAULT_PSF_SIGMA_PX, rel=0.01)
