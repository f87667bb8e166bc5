"""Prediction against latency and rate: figures that physics gives, and a chart."""

from __future__ import annotations

import csv
import math
from typing import get_type_hints

import pytest

from hilstar.instruments.study.prediction import (
    LATENCIES_MS,
    RATES_HZ,
    USUAL_HZ,
    USUAL_MS,
    PredictionOutcome,
    Shaken,
    crossing_hz,
    shaken_finding,
    shaken_rows,
    slew_outcomes,
)
from hilstar.instruments.study.predictors import SLEW_DEG, SLEW_S

SLEW_PART_S = 2.0  # a tenth of the swing, from its fastest on


@pytest.fixture(scope="module")
def whole_prediction(whole_study):
    found = whole_study("prediction", {"prediction", "prediction_jitter"})
    return found.folder, found.findings


def typed_rows(path, record):
    """A table as records of texts and numbers."""
    kinds = get_type_hints(record)
    with path.open(newline="") as file:
        return [
            record(**{name: kinds[name](text) for name, text in row.items()})
            for row in csv.DictReader(file)
        ]


def by_cell(outcomes):
    return {(o.method, o.rate_hz, o.latency_ms): o for o in outcomes}


@pytest.fixture(scope="module")
def outcomes():
    return by_cell(slew_outcomes(SLEW_PART_S))


def test_holding_costs_the_rate_times_the_age(outcomes):
    """Three axes swing at up to 2 pi 3 deg / 20 s each; the age is the latency and half a sample
    on the mean.
    """
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
        assert (
            outcomes[own, USUAL_HZ, ms].rms_arcsec < outcomes["hold", USUAL_HZ, ms].rms_arcsec / 3
        )


@pytest.fixture(scope="module")
def shaken():
    return {(s.way, s.packets, s.jitter_hz): s for s in shaken_rows(quick=True)}


def test_a_rate_amplifies_a_vibration_by_its_phase_over_the_age(shaken):
    """What is shown, 1 + i x of a wave, and what is true, exp(i x), for x = 2 pi f age; ages
    within 5 ms of their mean.
    """
    for hz in (2.0, 5.0, 10.0, 14.0):
        x = math.tau * hz * USUAL_MS / 1e3
        assert shaken["rate", "with rates", hz].gain == pytest.approx(math.hypot(1, x), rel=0.05)
        assert shaken["newest", "with rates", hz].residual == pytest.approx(
            2 * math.sin(x / 2), rel=0.1
        )


def test_auto_is_the_rate_where_vibrations_are_slow_and_damps_where_they_are_fast(shaken):
    for packets in ("with rates", "without rates"):
        for hz in (2.0, 5.0):
            assert shaken["auto", packets, hz].residual == pytest.approx(
                shaken["rate", packets, hz].residual, rel=0.05
            )
        for hz in (20.0, 45.0):
            assert shaken["auto", packets, hz].residual < 0.7 * shaken["rate", packets, hz].residual
            assert (
                shaken["auto", packets, hz].residual < 2.0 * shaken["newest", packets, hz].residual
            )
        # sin x = x / 2: 15 Hz with rates
        assert 8 < crossing_hz(list(shaken.values()), packets, USUAL_HZ, USUAL_MS) < 16
    assert shaken_finding(list(shaken.values())).startswith("Of a vibration above 1")


def test_the_study_writes_what_it_found(whole_prediction):
    folder, lines = whole_prediction
    outcomes = by_cell(typed_rows(folder / "prediction.csv", PredictionOutcome))
    assert len(typed_rows(folder / "prediction_jitter.csv", Shaken)) > 20
    assert len(lines) == 1 + 5 + 1
    assert len(outcomes) == 5 * (len(RATES_HZ) + len(LATENCIES_MS) - 1)
    assert {ms for _, hz, ms in outcomes if hz == USUAL_HZ} == set(LATENCIES_MS)
    assert {hz for _, hz, ms in outcomes if ms == USUAL_MS} == set(RATES_HZ)
    assert all(outcome.attitude_us > 0 for outcome in outcomes.values())
