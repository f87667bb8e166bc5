"""hilstar assess over the ledger of a real run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.support.benches import LIVE_BENCH
from tests.support.commands import run_hilstar_here
from tests.support.planted_run import write_telemetry
from tests.support.planted_tracker import Sizes, plant, scan


@pytest.mark.e2e
@pytest.mark.usefixtures("without_charts")
def test_a_replayed_log_and_its_trackers_answers_give_the_budget(tmp_path: Path) -> None:
    planted = plant(scan, Sizes(fov=0.0, wild=3), np.random.default_rng(21), seconds=30.0)
    log, bench, ledger = tmp_path / "log.csv", tmp_path / "bench.toml", tmp_path / "run.mcap"
    write_telemetry(log, planted.frames_s, planted.frames_q, start_s=100.0)
    telemetry = write_telemetry(
        tmp_path / "telemetry.csv", planted.tau_s, planted.reported, start_s=100.0
    )
    bench.write_text(LIVE_BENCH)
    words = ("--headless", "--speed", "max", "--step", "0.1", "--ledger", ledger)
    replay = run_hilstar_here("replay", bench, log, *words)
    assert replay.returncode == 0, replay.stderr
    run = run_hilstar_here(
        "assess", ledger, telemetry, "-o", tmp_path / "out", "--json", "--display-attitudes", "2"
    )
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    assert found["noise_arcsec"]["cross"] == pytest.approx(1.0, rel=0.1)
    assert found["pixel_arcsec"]["cross"] == pytest.approx(0.6, rel=0.15)
    np.testing.assert_allclose(found["bias_arcsec"], planted.bias, atol=2.0)
    assert [each["row"] for each in found["wrong"]] == (planted.wild + 2).tolist()
    assert "field_v_mag" in (tmp_path / "out" / "slices.csv").read_text()
