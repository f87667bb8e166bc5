"""Prediction against latency and rate: figures that physics gives, and a chart."""

from __future__ import annotations

import csv
import itertools
import math
from typing import get_type_hints

import numpy as np
import pytest

from hilstar.basics.rotation import angle_between_rad, propagate
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.instruments.study import prediction
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
)
from hilstar.instruments.study.predictors import (
    NEAR,
    predictors,
    rate_of,
    slew_attitude,
    slew_sample,
)


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
def shaken():
    return {(s.way, s.packets, s.jitter_hz): s for s in shaken_rows(quick=True)}


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


def test_the_study_writes_what_it_found(whole_study):
    measured = prediction.measure(quick=True)
    found = whole_study.reported("prediction", {"prediction", "prediction_jitter"}, measured)
    folder, lines = found.folder, found.findings
    outcomes = by_cell(typed_rows(folder / "prediction.csv", PredictionOutcome))
    assert len(typed_rows(folder / "prediction_jitter.csv", Shaken)) > 20
    assert len(lines) == 1 + 5 + 1
    assert len(outcomes) == 5 * (len(RATES_HZ) + len(LATENCIES_MS) - 1)
    assert {ms for _, hz, ms in outcomes if hz == USUAL_HZ} == set(LATENCIES_MS)
    assert {hz for _, hz, ms in outcomes if ms == USUAL_MS} == set(RATES_HZ)
    assert all(outcome.attitude_us > 0 for outcome in outcomes.values())


SPAN_S = 1.5
PATH = "linear, by the sample's rate"


def foretold_arcsec(packet_hz: int, latency_ms: int, by_rate: bool) -> list[float]:
    """The errors of the newest packet that has arrived, turned on by its rate or not, in frames at
    60 Hz from the first that NEAR packets and one more have reached.
    """
    step_ns = NS_PER_S / packet_hz
    last_ns = math.ceil(SPAN_S * packet_hz) * step_ns
    errors = []
    frame = 0
    while frame * NS_PER_S / 60 < last_ns:
        t_ns = round(frame * NS_PER_S / 60)
        frame += 1
        arrived_ns = t_ns - latency_ms * 1_000_000
        if arrived_ns < NEAR * step_ns:
            continue
        newest_ns = round(arrived_ns // step_ns * step_ns)
        q = slew_attitude(newest_ns)
        if by_rate:
            q = propagate(q, rate_of(slew_attitude, newest_ns), (t_ns - newest_ns) / NS_PER_S)
        errors.append(angle_between_rad(q, slew_attitude(t_ns)) * ARCSEC_PER_RAD)
    return errors


def test_a_small_study_is_off_by_what_its_packets_leave(small_run, monkeypatch):
    """Each packet as old as its latency and up to a period more; the last frame may be one."""
    monkeypatch.setattr(prediction, "QUICK_SPAN_S", SPAN_S)
    monkeypatch.setattr(prediction, "LATENCIES_MS", (5, 20, 100))
    monkeypatch.setattr(prediction, "RATES_HZ", (10, 100))
    monkeypatch.setattr(prediction, "QUICK_SHAKEN_HZ", (5, 10, 20))
    monkeypatch.setattr(prediction, "TIMED", 3)
    run = small_run(prediction.run, True)
    rows = {}
    for row in typed_rows(run.folder / "prediction.csv", PredictionOutcome):
        rows[row.method, row.rate_hz, row.latency_ms] = row
    cells = [(10, 20), (100, 5), (100, 20), (100, 100)]
    assert list(dict.fromkeys(key[1:] for key in rows)) == cells
    assert len(rows) == 5 * len(cells)
    for hz, ms in cells:
        for method, by_rate in (("hold", False), (PATH, True)):
            wanted = np.array(foretold_arcsec(hz, ms, by_rate))
            row = rows[method, hz, ms]
            # a frame more or less at the end
            rms_arcsec = math.sqrt(np.mean(wanted**2))
            assert row.rms_arcsec == pytest.approx(rms_arcsec, rel=0.03)
            assert row.worst_arcsec == pytest.approx(wanted.max(), rel=1e-3)
            assert row.attitude_us > 0
    # what is drawn, and what is told
    drawn = {label: (x, y) for label, x, y in run.lines("prediction", 0)}
    for method in ("hold", PATH):
        (label,) = (label for label in drawn if label.startswith(method))
        wanted = [rows[method, 100, ms].rms_arcsec for ms in (5, 20, 100)]
        assert drawn[label] == ([5, 20, 100], wanted)
    drawn = {label: (x, y) for label, x, y in run.lines("prediction", 1)}
    assert drawn[PATH] == ([10, 100], [rows[PATH, hz, 20].rms_arcsec for hz in (10, 100)])
    held_arcsec = rows["hold", 100, 20].rms_arcsec
    by_rate_arcsec = rows[PATH, 100, 20].rms_arcsec
    assert f"off by {by_rate_arcsec:.2g} arcsec rms, holding the sample by {held_arcsec:.3g}" in (
        run.title("prediction")
    )
    findings, _ = run.told
    assert findings[0] == run.title("prediction") and len(findings) == 1 + 5 + 1
    assert findings[1].startswith(f"hold: {held_arcsec:.3g} arcsec rms, ")
    shaken = "2 arcsec at 3.1 Hz, 1 arcsec at 11 Hz, 0.3 arcsec at 37 Hz"
    assert run.note("prediction").startswith(f"A swing of 3 degrees in 20 s, shaken by {shaken}.")
    assert run.note("prediction_jitter").startswith(
        "Packets at 100 Hz, the newest 20 ms old at light on the mean; a vibration of 2 arcsec"
        " beside a turn of 0.5 deg/s."
    )
    # a vibration that is shown as it is has a gain of 1
    for panel in (2, 3):
        assert list(run.levels("prediction_jitter", panel).values()) == [1.0]
    jitter = typed_rows(run.folder / "prediction_jitter.csv", Shaken)
    assert len(jitter) == 2 * 3 * 3
    for panel, (packets, share) in enumerate(
        [("with rates", "residual"), ("without rates", "residual"), ("with rates", "gain")]
    ):
        drawn = {label: (x, y) for label, x, y in run.lines("prediction_jitter", panel)}
        for way in ("rate", "auto", "newest"):
            own = [row for row in jitter if (row.way, row.packets) == (way, packets)]
            assert drawn[way] == ([5, 10, 20], [getattr(row, share) for row in own])
    above_hz = [
        crossing_hz(jitter, packets, 100, 20) for packets in ("with rates", "without rates")
    ]
    assert f"above {above_hz[0]:.0f} Hz ({above_hz[1]:.0f} without rates)" in findings[-1]


@pytest.mark.parametrize(("packet_hz", "age_ms"), [(100, 20), (50, 20), (200, 10)])
def test_a_vibration_is_shown_by_the_age_of_its_packets(packet_hz, age_ms):
    """As 1 + i x by a rate, and as it was by the newest, where it is exp(i x), for x = 2 pi f age."""
    hz = 7.0
    ages_s = np.linspace(-0.5, 0.5, 41) / packet_hz + age_ms / 1e3
    x = math.tau * hz * ages_s
    residual, gain = prediction.shaken_error("rate", hz, packet_hz, age_ms, True)
    assert gain == pytest.approx(abs(np.mean((1 + 1j * x) * np.exp(-1j * x))), rel=0.01)
    left = np.abs(1 + 1j * x - np.exp(1j * x))
    assert residual == pytest.approx(math.sqrt(np.mean(left**2)), rel=0.05)
    residual, gain = prediction.shaken_error("newest", hz, packet_hz, age_ms, False)
    assert residual == pytest.approx(math.sqrt(np.mean((2 * np.sin(x / 2)) ** 2)), rel=0.05)
    assert gain == pytest.approx(abs(np.mean(np.exp(-1j * x))), rel=0.01)


def test_a_crossing_is_where_the_logarithms_of_frequencies_are_parted_by_the_errors():
    rows = []
    for hz, by_rate, newest in ((2.0, 0.1, 0.4), (8.0, 0.5, 0.8), (32.0, 3.0, 1.2)):
        for way, residual in (("rate", by_rate), ("newest", newest), ("auto", 0.0)):
            rows.append(Shaken(way, "p", 100, 20, hz, 1.0, residual))
    # from 0.3 under to 1.8 over
    assert crossing_hz(rows, "p", 100, 20) == pytest.approx(8 * 4 ** (0.3 / 2.1))
    assert crossing_hz(rows[:6], "p", 100, 20) == math.inf


def test_every_vibration_is_under_half_of_the_packets_rate_and_comes_with_and_without_rates():
    wanted = set()
    for packet_hz, age_ms in prediction.SHAKEN_CELLS:
        for jitter_hz in (1, 2, 3, 5, 7, 10, 14, 20, 27, 35, 45):
            if 2 * jitter_hz < packet_hz:
                for way, packets in itertools.product(prediction.WAYS, prediction.SENDERS):
                    wanted.add((way, packets, packet_hz, age_ms, jitter_hz))
    cases = list(prediction.shaken_cases(quick=False))
    assert len(cases) == len(wanted) and set(cases) == wanted
    assert list(prediction.WAYS) == ["rate", "auto", "newest"]


def test_a_vibration_s_row_is_its_case_with_its_own_error(shaken):
    for (way, packets, hz), row in shaken.items():
        if hz != 5:
            continue
        has_rates = packets == "with rates"
        error = prediction.shaken_error(way, 5, row.packet_hz, row.age_ms, has_rates)
        assert (row.residual, row.gain) == error


def test_auto_is_told_by_the_vibration_at_which_it_is_worst():
    rows = []
    for packets, hz, residuals in (
        ("with rates", 2, {"rate": 2.0, "newest": 8.0, "auto": 2.2}),
        ("with rates", 20, {"rate": 9.0, "newest": 4.0, "auto": 6.0}),
        ("without rates", 20, {"rate": 1.0, "newest": 5.0, "auto": 1.0}),
    ):
        rows += [Shaken(way, packets, 100, 20, hz, 1.0, left) for way, left in residuals.items()]
    # another age is not most benches'
    rows += [
        Shaken(way, "with rates", 100, 5, 2, 1.0, left)
        for way, left in zip(("rate", "newest", "auto"), (1, 1, 9), strict=True)
    ]
    assert prediction.auto_times(rows) == pytest.approx(1.5)


def test_the_time_of_an_attitude_is_its_median_in_microseconds(monkeypatch):
    """Of clocks that read 3, 5 and 40 us, in turn."""
    now_ns = [0]
    steps_ns = itertools.cycle((3000, 0, 5000, 0, 40_000, 0))

    def clock():
        now_ns[0] += next(steps_ns)
        return now_ns[0]

    # each call's end follows its begin by one step
    next(steps_ns)
    monkeypatch.setattr(prediction.time, "perf_counter_ns", clock)
    samples = [slew_sample(k * 10_000_000) for k in range(30)]
    hold = next(predictor for predictor in predictors() if predictor.name == "hold")
    outcome = prediction._outcome(hold, samples, 100, 20)
    assert outcome.attitude_us == 5.0
    assert prediction.line_of(outcome).endswith("maximum, 5 us per attitude")
