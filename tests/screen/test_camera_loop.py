"""A bench of software alone, end to end: first light on a real X server's screen, the virtual
tracker that watches it, its GigE Vision camera, and Aravis that takes the images.
"""

from __future__ import annotations

import json
import subprocess

import pytest

from hilstar.server.genicam.camera import has_aravis
from tests.support.benches import TWIN, bench_text
from tests.support.commands import run_hilstar
from tests.support.forks import HILSTAR, Started
from tests.support.gige_client import own_address
from tests.support.senders import free_port
from tests.support.waiting import PATIENCE_S

# The truth's collimator; the bench file says 120 mm.
TRUE_FOCAL_MM = 121.0


def test_first_light_calibrates_a_bench_through_the_virtual_trackers_camera(screen, tmp_path):
    if not has_aravis():
        pytest.skip("Aravis is not installed (gir1.2-aravis-0.8, python3-gi)")
    bench = tmp_path / "bench.toml"
    bench.write_text(bench_text(TWIN, {"monitor": {"bits": 8}}))
    truth = tmp_path / "truth.toml"
    truth.write_text(
        bench_text(TWIN, {"monitor": {"bits": 8}, "collimator": {"focal_length_mm": TRUE_FOCAL_MM}})
    )
    address, endpoint = own_address(), f"tcp://127.0.0.1:{free_port()}"
    watcher = [*HILSTAR, "tracker", truth, "--watch", endpoint, "--camera", address, "--json"]
    with Started(
        list(map(str, watcher)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as tracker:
        result = run_hilstar(
            "first-light",
            bench,
            "-o",
            tmp_path / "s",
            "--grab",
            f"genicam:{address}",
            "--frames",
            endpoint,
            "--frames",
            "2",
            "--patches",
            "0",
            "--json",
            env=screen.env,
            timeout=4 * PATIENCE_S,
        )
        tracker.terminate()
        told, err = tracker.communicate(timeout=PATIENCE_S)
    assert result.returncode == 0, (result.stderr, err)
    camera = json.loads(told)["camera"]
    assert camera["images"] > 10 and camera["dropped"] == 0
    steps = {step["name"]: step for step in json.loads(result.stdout)["steps"]}
    focal_px = steps["geometry"]["figures"]["focal_length_px"]
    assert focal_px == pytest.approx(TRUE_FOCAL_MM * 1e3 / 57.65, rel=1e-3)
    assert steps["verify"]["figures"]["star_rms_px"] < 0.1
