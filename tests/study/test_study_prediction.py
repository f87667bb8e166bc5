"""Prediction against latency and rate: figures that physics gives, and a chart."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest
from PIL import Image

from hilstar.study.prediction import LATENCIES_MS, RATES_HZ, USUAL_HZ, USUAL_MS, measure, run
from hilstar.study.shared.predictors import SLEW_DEG, SLEW_S

SPAN_S = 4.0


@pytest.fixture(scope="module")
def outcomes():
    return {(o.method, o.rate_hz, o.latency_ms): o for o in measure(SPAN_S)}


def test_holding_costs_the_rate_times_the_age(outcomes):
    """Three axes swing at up to 2 pi 3 deg / 20 s each; the age is the latency and half a sample on the mean."""
    fastest_arcsec_s = math.sqrt(3) * 2 * math.pi * SLEW_DEG / SLEW_S * 3600
    for ms in LATENCIES_MS:
        found = outcomes["hold", USUAL_HZ, ms]
        assert found.worst_arcsec < fastest_arcsec_s * (ms + 1000 / USUAL_HZ) / 1e3 * 1.1
        assert found.rms_arcsec > 0.3 * fastest_arcsec_s * ms / 1e3


def test_a_rate_predicts_better_than_holding_and_worse_the_longer_it_has_to(outcomes):
    own = "linear, by the sample's rate"
    errors = [outcomes[own, USUAL_HZ, ms].rms_arcsec for ms in LATENCIES_MS]
    assert errors == sorted(errors)
    for ms in LATENCIES_MS:
        assert outcomes[own, USUAL_HZ, ms].rms_arcsec < outcomes["hold", USUAL_HZ, ms].rms_arcsec / 3


def test_the_study_writes_what_it_found(tmp_path):
    lines = run(tmp_path, quick=True)
    assert len(lines) == 1 + 5
    with (tmp_path / "prediction.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5 * (len(RATES_HZ) + len(LATENCIES_MS) - 1)
    assert {int(row["latency_ms"]) for row in rows if int(row["rate_hz"]) == USUAL_HZ} == set(LATENCIES_MS)
    assert {int(row["rate_hz"]) for row in rows if int(row["latency_ms"]) == USUAL_MS} == set(RATES_HZ)
    assert all(float(row["attitude_us"]) > 0 for row in rows)
    pixels = np.array(Image.open(tmp_path / "prediction.png").convert("L"))
    assert pixels.shape[0] > 500 and (pixels < 200).mean() > 0.005
