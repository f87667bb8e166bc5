"""A slew on a simulated panel that scans: what compensation is worth, and that the measure would see it missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from hilstar.scene.frame_motion import Scan
from hilstar.study.timing import run as timing
from hilstar.study.timing.panel import WAYS, ScanningPanel, Sky, frame_weights
from hilstar.study.timing.run import QUICK_RATES_DEG_S, compare, measure
from hilstar.study.timing.slew import Slew

GAIN = 20  # compensated against not: the issue's own figure
RATE_DEG_S = QUICK_RATES_DEG_S[0]
PERIOD_S = 1 / 60
# A frame's motion at this rate: 2 deg/s over 1/60 s.
FRAME_ARCSEC = RATE_DEG_S * PERIOD_S * 3600


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The study's folder and findings, and what it measured."""
    folder, measured = tmp_path_factory.mktemp("timing"), []

    def keep(quick):
        measured.extend(measure(quick))
        return measured

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(timing, "measure", keep)
        findings = timing.run(folder, quick=True)
    return folder, findings, measured


@pytest.fixture(scope="module")
def outcomes(study):
    return {outcome.way: outcome for outcome in study[2]}


def test_compensation_leaves_a_twentieth_of_the_error_at_most(outcomes):
    assert outcomes["+ smear"].stars > 10
    assert outcomes["+ smear"].rms_arcsec < outcomes["prediction"].rms_arcsec / GAIN
    assert outcomes["+ smear"].worst_arcsec < outcomes["prediction"].worst_arcsec / GAIN


def test_each_step_takes_away_what_physics_says_it_should(outcomes):
    """A row's light is half a frame old on the mean; rows at top and bottom are half a scan-out early and late."""
    assert outcomes["+ scan-out"].rms_arcsec == pytest.approx(FRAME_ARCSEC / 2, rel=0.02)
    assert outcomes["+ scan-out"].worst_arcsec == pytest.approx(FRAME_ARCSEC / 2, rel=0.02)
    assert FRAME_ARCSEC / 2 < outcomes["prediction"].rms_arcsec < FRAME_ARCSEC
    assert outcomes["no prediction"].rms_arcsec > outcomes["prediction"].rms_arcsec


@pytest.mark.parametrize(
    "wrong", [{"down": (0, -1)}, {"scanout_s": 0.0}, {"hold_s": 0.0}], ids=["rows upwards", "no scan-out", "no hold"]
)
def test_a_scan_that_is_assumed_wrong_is_seen(tmp_path, outcomes, wrong):
    panel = ScanningPanel("+ smear", tmp_path / "bench.toml")
    panel.bench = replace(panel.bench, scan=replace(panel.bench.scan, **wrong))
    sky = Sky(panel)
    try:
        outcome = compare(panel, sky, Slew(RATE_DEG_S))
    finally:
        panel.close()
        sky.close()
    assert outcome.rms_arcsec > outcomes["prediction"].rms_arcsec / GAIN


def test_rows_share_an_exposure_among_the_frames_that_they_show():
    rows = (np.arange(100) + 0.5) / 100
    swaps_s = [k * PERIOD_S for k in range(-3, 9)]
    weights = frame_weights(rows, swaps_s, Scan((0, 1), PERIOD_S, PERIOD_S), (0.004, 0.104))
    assert weights.sum(axis=0) == pytest.approx(np.ones(100))
    # The first row shows frame 0 at 4 ms, the last one still the frame before.
    assert weights[2, 0] == 0 and weights[3, 0] > 0
    assert weights[2, -1] > 0


def test_the_study_writes_a_chart_and_a_table(study):
    folder, findings, _ = study
    assert len(findings) == 1 + len(WAYS)
    pixels = np.array(Image.open(folder / "timing.png").convert("L"))
    assert pixels.shape[0] > 500 and (pixels < 200).mean() > 0.005
    assert len((folder / "timing.csv").read_text().splitlines()) == 1 + len(WAYS)
