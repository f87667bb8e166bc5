"""Pointing error at the moment of light against latency and against the rate of packets, by predictor, and their times.

The slew is a swing of degrees, shaken on each axis (see `shared.predictors`). A frame at time t has the samples that were taken
before t minus the latency, which covers link, drawing and scan-out.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.charts import SERIES, chart, label_ends, plain_ticks, write_records
from hilstar.rotation import angle_between_rad
from hilstar.study.shared.predictors import JITTER, NEAR, SLEW_DEG, SLEW_S, Predictor, predictors, slew_attitude, slew_sample
from hilstar.units import ARCSEC_PER_RAD, NS_PER_MS, NS_PER_S

RATES_HZ = (5, 10, 20, 50, 100, 200)
LATENCIES_MS = (2, 5, 10, 20, 50, 100)
USUAL_HZ, USUAL_MS = 100, 20
FRAME_HZ = 60
SPAN_S, QUICK_SPAN_S = 40.0, 4.0
TIMED = 200
MARKERS = "osd^vx"


@dataclass(frozen=True, slots=True)
class Outcome:
    """One predictor at one rate and latency: errors over all frames, arcsec, and the time of one attitude, us."""

    method: str
    rate_hz: int
    latency_ms: int
    rms_arcsec: float
    worst_arcsec: float
    attitude_us: float


def run(directory: Path, quick: bool = False) -> list[str]:
    """Measure, and write `prediction.csv` and its chart; a line for each method. Raises InputError."""
    outcomes = measure(QUICK_SPAN_S if quick else SPAN_S)
    write_records(directory / "prediction.csv", outcomes)
    usual = [o for o in outcomes if (o.rate_hz, o.latency_ms) == (USUAL_HZ, USUAL_MS)]
    default = next(o for o in usual if o.method == next(g.name for g in predictors() if g.is_default))
    hold = next(o for o in usual if o.method == "hold")
    finding = (
        f"At {USUAL_HZ} Hz and {USUAL_MS} ms of latency, prediction by the newest sample's rate is off by "
        f"{default.rms_arcsec:.2g} arcsec rms, holding the sample by {hold.rms_arcsec:.3g}"
    )
    _draw(directory / "prediction", finding, outcomes)
    return [finding, *(_line(outcome) for outcome in usual)]


def measure(span_s: float) -> list[Outcome]:
    """Every predictor over latency at the usual rate, and over rate at the usual latency."""
    cells = {(USUAL_HZ, ms) for ms in LATENCIES_MS} | {(hz, USUAL_MS) for hz in RATES_HZ}
    outcomes = []
    for hz, ms in sorted(cells):
        samples = [slew_sample(round(k * NS_PER_S / hz)) for k in range(math.ceil(span_s * hz) + 1)]
        outcomes += [_outcome(predictor, samples, hz, ms) for predictor in predictors() if not predictor.waits]
    return outcomes


def _outcome(predictor: Predictor, samples: list[AttitudeSample], rate_hz: int, latency_ms: int) -> Outcome:
    taken_ns = [sample.t_ns for sample in samples]
    errors = []
    first_ns = taken_ns[NEAR] + latency_ms * NS_PER_MS
    for frame in range(math.ceil(first_ns * FRAME_HZ / NS_PER_S), math.floor(taken_ns[-1] * FRAME_HZ / NS_PER_S)):
        t_ns = round(frame * NS_PER_S / FRAME_HZ)
        count = bisect_right(taken_ns, t_ns - latency_ms * NS_PER_MS)
        shown = predictor.load(samples[count - NEAR : count])(t_ns)
        errors.append(angle_between_rad(slew_attitude(t_ns), shown) * ARCSEC_PER_RAD)
    rms = float(np.sqrt(np.mean(np.square(errors))))
    return Outcome(predictor.name, rate_hz, latency_ms, rms, max(errors), _attitude_us(predictor, samples, latency_ms))


def _attitude_us(predictor: Predictor, samples: list[AttitudeSample], latency_ms: int) -> float:
    """The median time of one attitude after the last sample, us."""
    attitude_at = predictor.load(samples[-NEAR:])
    t_ns = samples[-1].t_ns + latency_ms * NS_PER_MS
    times = []
    for _ in range(TIMED):
        begin_ns = time.perf_counter_ns()
        attitude_at(t_ns)
        times.append((time.perf_counter_ns() - begin_ns) / 1e3)
    return float(np.median(times))


def _line(outcome: Outcome) -> str:
    errors = f"{outcome.rms_arcsec:.3g} arcsec rms, {outcome.worst_arcsec:.3g} maximum"
    return f"{outcome.method}: {errors}, {outcome.attitude_us:.0f} us per attitude"


def _draw(path: Path, finding: str, outcomes: list[Outcome]) -> None:
    shaken = ", ".join(f"{size:g} arcsec at {hz:g} Hz" for size, hz in JITTER)
    note = f"A swing of {SLEW_DEG:g} degrees in {SLEW_S:g} s, shaken by {shaken}. In brackets: the time of one attitude."
    with chart(path, finding, panels=2, share_x=False, note=note) as (latency, rate):
        for name, marker, colour in zip(dict.fromkeys(o.method for o in outcomes), MARKERS, SERIES, strict=False):
            mine = [o for o in outcomes if o.method == name]
            took_us = np.median([o.attitude_us for o in mine])
            by_latency = sorted((o.latency_ms, o.rms_arcsec) for o in mine if o.rate_hz == USUAL_HZ)
            by_rate = sorted((o.rate_hz, o.rms_arcsec) for o in mine if o.latency_ms == USUAL_MS)
            latency.loglog(*zip(*by_latency, strict=True), marker=marker, color=colour, label=f"{name} ({took_us:.0f} us)")
            rate.loglog(*zip(*by_rate, strict=True), marker=marker, color=colour, label=name)
        latency.set_xlabel(f"latency [ms], packets at {USUAL_HZ} Hz")
        rate.set_xlabel(f"rate of packets [Hz], latency {USUAL_MS} ms")
        plain_ticks(latency.xaxis, LATENCIES_MS)
        plain_ticks(rate.xaxis, RATES_HZ)
        for axes in (latency, rate):
            axes.set_ylabel("pointing error, rms [arcsec]")
            label_ends(axes)
