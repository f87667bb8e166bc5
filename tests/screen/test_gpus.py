"""The GPU of the window and the one that draws headless."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hilstar.display.render.context import gpus
from tests.support.benches import SCREEN_BENCH, still_log
from tests.support.commands import run_hilstar, run_hilstar_here
from tests.support.ledgers import read_run
from tests.support.x11.screens import xvfb


@pytest.fixture(scope="module")
def softpipe_screen(tmp_path_factory):
    """A screen whose windows softpipe draws: GLX asks another driver than EGL's list begins with
    elsewhere.
    """
    with xvfb(tmp_path_factory.mktemp("softpipe")) as running:
        yield running


@pytest.mark.usefixtures("screen_here")
def test_doctor_names_the_gpu_of_a_window_and_the_headless_one():
    ran = run_hilstar_here("doctor", "--json")
    checks = {check["name"]: check["detail"] for check in json.loads(ran.stdout)["checks"]}
    name = gpus()[0].renderer
    assert checks["gpu"] == f"headless 0: {name}; window {name}"


def test_the_summary_and_the_ledger_have_the_gpu_that_drew_the_window(
    softpipe_screen, screen_file: Path, tmp_path: Path
):
    screen_file.write_text(
        SCREEN_BENCH.replace("[640, 480]", "[160, 120]").replace(
            '"exact"', '"round"\ngpu = "llvmpipe"'
        )
    )
    ledger = tmp_path / "run.mcap"
    log = still_log(tmp_path / "second.csv", seconds=1)
    environment = softpipe_screen.env | {"GALLIUM_DRIVER": "softpipe"}
    ran = run_hilstar(
        "replay", screen_file, log, "--json", "--windowed", "--ledger", ledger, env=environment
    )
    assert ran.returncode == 0, ran.stderr
    assert "softpipe draws this window" in ran.stderr
    assert json.loads(ran.stdout)["gl_renderer"] == "softpipe"
    assert read_run(ledger).head["gl_renderer"] == "softpipe"
