"""Pointing error at the moment of light against latency and against the rate of packets, by
predictor, and their times.

The slew is a swing of degrees, shaken on each axis (`predictors.py`). A frame at time t has the
samples taken before
t minus the latency, which covers link, drawing and scan-out.

Then the prediction of a vibration beside a steady turn, against its frequency: by the rate, with
`prediction = "auto"`, and for the newest attitude alone.
"""

import math
import time
from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Literal

import numpy as np

from hilstar.attitude.clock.timeline import Policy, Prediction, Timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.charts import BLUE, GREEN, MUTED, ORANGE, write_records
from hilstar.basics.rotation import (
    angle_between_rad,
    conjugate,
    multiply,
    propagate,
    to_rotation_vector,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_MS, NS_PER_S
from hilstar.instruments.study.predictors import (
    JITTER,
    NEAR,
    ORION,
    SLEW_DEG,
    SLEW_S,
    Predictor,
    attitude_at,
    predictors,
    slew_attitude,
    slew_sample,
)
from hilstar.instruments.study.row_charts import (
    HIDDEN,
    ChartSpec,
    LevelLine,
    LineSpec,
    PanelSpec,
    SeriesLook,
    draw_rows,
    looks_of,
)
from hilstar.instruments.study.sweep import Judged, Load, OtherWork

RATES_HZ = (5, 10, 20, 50, 100, 200)
LATENCIES_MS = (2, 5, 10, 20, 50, 100)
USUAL_HZ, USUAL_MS = 100, 20
FRAME_HZ = 60
SPAN_S, QUICK_SPAN_S = 40.0, 4.0
TIMED = 200
MARKERS = "osd^vx"

Way = Literal["rate", "auto", "newest"]
WAYS: dict[Way, str] = {"rate": ORANGE, "auto": BLUE, "newest": GREEN}
SHAKEN_HZ = (1, 2, 3, 5, 7, 10, 14, 20, 27, 35, 45)
QUICK_SHAKEN_HZ = (2, 5, 10, 14, 20, 45)
# Packet rate, Hz, and mean age of the newest packet at light, ms: at least half a packet period.
SHAKEN_CELLS = ((20, 40), (50, 20), (100, 5), (100, 10), (100, 20), (100, 40), (200, 10), (200, 20))
QUICK_SHAKEN_CELLS = ((100, 20),)
SHAKEN_ARCSEC, SHAKEN_TURN_RAD_S = 2.0, math.radians(0.5)
SETTLED_S, SHAKEN_S = 1.5, 3.0
SHAKEN_TICKS_HZ = (1, 2, 5, 10, 20, 45)
SHAKEN_LOOK = {"markersize": 3.5}
SENDERS = ("with rates", "without rates")
# The labels of their panels' y axes: one stands for both.
ERROR_LABELS = dict(zip(SENDERS, ("error, rms / vibration's rms", ""), strict=True))
GAIN_LABELS = dict(zip(SENDERS, ("amplitude shown / true", ""), strict=True))
SHAKEN_FRAME_HZ = 59.94  # no multiple of the packets' rate or of a vibration: every phase comes
Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class PredictionOutcome:
    """One predictor at one rate and latency: errors over all frames, arcsec, and the time of one
    attitude, us.
    """

    method: str
    rate_hz: int
    latency_ms: int
    rms_arcsec: float
    worst_arcsec: float
    attitude_us: float


def run(directory: Path, quick: bool = False) -> Judged:
    """Measure, and write `prediction.csv` and its chart; a line for each method. Raises
    InputError.
    """
    span_s = QUICK_SPAN_S if quick else SPAN_S
    outcomes = []
    others = OtherWork()
    # Over latency at the usual rate, and over rate at the usual latency.
    for hz, ms in sorted(
        {(USUAL_HZ, ms) for ms in LATENCIES_MS} | {(hz, USUAL_MS) for hz in RATES_HZ}
    ):
        samples = [slew_sample(round(k * NS_PER_S / hz)) for k in range(math.ceil(span_s * hz) + 1)]
        outcomes += [
            _outcome(predictor, samples, hz, ms)
            for predictor in predictors()
            if not predictor.waits
        ]
    load = others.load()
    write_records(directory / "prediction.csv", outcomes)
    usual = [o for o in outcomes if (o.rate_hz, o.latency_ms) == (USUAL_HZ, USUAL_MS)]
    default_name = next(predictor.name for predictor in predictors() if predictor.is_default)
    default = next(o for o in usual if o.method == default_name)
    hold = next(o for o in usual if o.method == "hold")
    finding = (
        f"At {USUAL_HZ} Hz and {USUAL_MS} ms of latency, prediction by the newest sample's rate is"
        f" off by {default.rms_arcsec:.2g} arcsec rms, holding the sample by {hold.rms_arcsec:.3g}"
    )
    draw(directory / "prediction", finding, outcomes, load)
    cells, frequencies = (
        (QUICK_SHAKEN_CELLS, QUICK_SHAKEN_HZ) if quick else (SHAKEN_CELLS, SHAKEN_HZ)
    )
    shaken_by = []
    for rates, (packet_hz, age_ms), way, jitter_hz in product(
        (True, False), cells, WAYS, frequencies
    ):
        if jitter_hz < packet_hz / 2:  # a faster one looks like a slow one
            residual, gain = shaken_error(way, jitter_hz, packet_hz, age_ms, rates)
            packets = "with rates" if rates else "without rates"
            shaken_by.append(Shaken(way, packets, packet_hz, age_ms, jitter_hz, gain, residual))
    write_records(directory / "prediction_jitter.csv", shaken_by)
    given, derived = (crossing_hz(shaken_by, packets, USUAL_HZ, USUAL_MS) for packets in SENDERS)
    note = (
        f"Of a vibration above {given:.0f} Hz ({derived:.0f} without rates) the newest attitude is"
        " nearer than one predicted by"
        f' {USUAL_MS} ms; "auto" is within {auto_times(shaken_by):.1f} times the better of both'
    )
    draw_shaken(directory / "prediction_jitter", note, shaken_by)
    lines = (
        f"{o.method}: {o.rms_arcsec:.3g} arcsec rms, {o.worst_arcsec:.3g} maximum,"
        f" {o.attitude_us:.0f} us per attitude"
        for o in usual
    )
    return load.judged([finding, *lines, note])


@dataclass(frozen=True, slots=True)
class Shaken:
    """A vibration by one way of prediction: the amplitude shown and the error (rms), as shares
    of the true ones.
    """

    way: str
    packets: str
    packet_hz: int
    age_ms: int
    jitter_hz: float
    gain: float
    residual: float


def shaken_error(
    way: Way, jitter_hz: float, packet_hz: int, age_ms: float, rates: bool
) -> tuple[float, float]:
    """Error (rms) and amplitude of a vibration about z, beside a steady turn, as shown: shares of
    the vibration's own.

    "newest" stands still between packets; the steady turn is known to it.
    """
    turn = 0.0 if way == "newest" else SHAKEN_TURN_RAD_S
    prediction: Prediction = "auto" if way == "auto" else "rate"
    timeline = Timeline(Policy(0 if way == "newest" else NS_PER_S, NS_PER_S, prediction=prediction))
    latency_s = max(age_ms / 1e3 - 0.5 / packet_hz, 0.0)
    amplitude = SHAKEN_ARCSEC / ARCSEC_PER_RAD
    turning = math.tau * jitter_hz

    def angle(t_s: float) -> float:
        return turn * t_s + amplitude * math.sin(turning * t_s + 0.3)

    taken = 0
    errors = []
    times_s = np.arange(0, SETTLED_S + SHAKEN_S, 1 / SHAKEN_FRAME_HZ) + latency_s
    for t_s in times_s:
        while taken / packet_hz <= t_s - latency_s:
            at_s = taken / packet_hz
            if rates:
                rate = Z * (turn + amplitude * turning * math.cos(turning * at_s + 0.3))
            else:
                rate = None
            timeline.add(
                AttitudeSample(round(at_s * NS_PER_S), propagate(ORION, Z, angle(at_s)), rate)
            )
            taken += 1
        shown = attitude_at(timeline, round(t_s * NS_PER_S))
        errors.append(
            -to_rotation_vector(
                multiply(shown.q_icrs_to_cam, conjugate(propagate(ORION, Z, angle(t_s))))
            )[2]
        )
    late = times_s >= SETTLED_S
    phase = turning * times_s[late] + 0.3
    error = np.array(errors)[late]
    waves = np.column_stack((np.sin(phase), np.cos(phase), np.ones(len(phase))))
    fitted = np.linalg.lstsq(waves, error + amplitude * np.sin(phase), rcond=None)[0]
    return float(np.sqrt(2 * np.mean(error**2)) / amplitude), float(
        np.hypot(fitted[0], fitted[1]) / amplitude
    )


def auto_times(found: list[Shaken]) -> float:
    """The largest error of "auto" as a multiple of the better of the other two."""
    residuals: dict[tuple[str, float], dict[str, float]] = {}
    for shaken in found:
        if (shaken.packet_hz, shaken.age_ms) == (USUAL_HZ, USUAL_MS):
            by_way = residuals.setdefault((shaken.packets, shaken.jitter_hz), {})
            by_way[shaken.way] = shaken.residual
    times = [way["auto"] / min(way["rate"], way["newest"]) for way in residuals.values()]
    return max(times)


def crossing_hz(found: list[Shaken], packets: str, packet_hz: int, age_ms: int) -> float:
    """The frequency above which the newest attitude is nearer than one predicted by its rate;
    infinite for none.
    """
    alike = [s for s in found if (s.packets, s.packet_hz, s.age_ms) == (packets, packet_hz, age_ms)]
    by_rate = [s for s in alike if s.way == "rate"]
    by_newest = [s for s in alike if s.way == "newest"]
    worse_by = np.array([s.residual for s in by_rate]) - np.array([s.residual for s in by_newest])
    hz = [s.jitter_hz for s in by_rate]
    for (low, under), (high, over) in pairwise(zip(hz, worse_by, strict=True)):
        if under <= 0 < over:
            return float(low * (high / low) ** (under / (under - over)))
    return math.inf


def _outcome(
    predictor: Predictor, samples: list[AttitudeSample], rate_hz: int, latency_ms: int
) -> PredictionOutcome:
    taken_ns = [sample.t_ns for sample in samples]
    latency_ns = latency_ms * NS_PER_MS
    errors = []
    first, last = (
        t_ns * FRAME_HZ / NS_PER_S for t_ns in (taken_ns[NEAR] + latency_ns, taken_ns[-1])
    )
    for frame in range(math.ceil(first), math.floor(last)):
        t_ns = round(frame * NS_PER_S / FRAME_HZ)
        count = bisect_right(taken_ns, t_ns - latency_ns)
        shown = predictor.load(samples[count - NEAR : count])(t_ns)
        errors.append(angle_between_rad(slew_attitude(t_ns), shown) * ARCSEC_PER_RAD)
    predict = predictor.load(samples[-NEAR:])
    times_us = []
    for _ in range(TIMED):
        begin_ns = time.perf_counter_ns()
        predict(taken_ns[-1] + latency_ns)
        times_us.append((time.perf_counter_ns() - begin_ns) / 1e3)
    rms = float(np.sqrt(np.mean(np.square(errors))))
    return PredictionOutcome(
        predictor.name, rate_hz, latency_ms, rms, max(errors), float(np.median(times_us))
    )


def draw(path: Path, finding: str, outcomes: list[PredictionOutcome], load: Load) -> None:
    """The pointing error of each predictor, by latency and by the rate of packets."""
    shaken = ", ".join(f"{size:g} arcsec at {hz:g} Hz" for size, hz in JITTER)
    note = (
        f"A swing of {SLEW_DEG:g} degrees in {SLEW_S:g} s, shaken by {shaken}. In brackets: the"
        " time of one attitude."
    )
    labels = {outcome.method: outcome.method for outcome in outcomes}
    with_times = {}
    for name in labels:
        took_us = [outcome.attitude_us for outcome in outcomes if outcome.method == name]
        with_times[name] = f"{name} ({np.median(took_us):.0f} us)"
    error = "pointing error, rms [arcsec]"
    by_latency = PanelSpec(
        (
            LineSpec(
                "latency_ms",
                "rms_arcsec",
                label=lambda outcome: with_times[outcome.method],
                where=lambda outcome: outcome.rate_hz == USUAL_HZ,
            ),
        ),
        error,
        f"latency [ms], packets at {USUAL_HZ} Hz",
        scales=("log", "log"),
        xticks=LATENCIES_MS,
    )
    by_rate = PanelSpec(
        (LineSpec("rate_hz", "rms_arcsec", where=lambda outcome: outcome.latency_ms == USUAL_MS),),
        error,
        f"rate of packets [Hz], latency {USUAL_MS} ms",
        scales=("log", "log"),
        xticks=RATES_HZ,
    )
    spec = ChartSpec(
        (by_latency, by_rate),
        lambda outcome: outcome.method,
        looks_of(labels, MARKERS),
        note,
        layout={"share_x": False},
    )
    draw_rows(path, finding, spec, outcomes, load)


def draw_shaken(path: Path, finding: str, shaken: list[Shaken]) -> None:
    """A vibration's error and amplitude as shown, by its frequency; with and without rates."""
    note = (
        f"Packets at {USUAL_HZ} Hz, the newest {USUAL_MS} ms old at light on the mean; a vibration"
        f" of {SHAKEN_ARCSEC:g} arcsec beside a turn of {math.degrees(SHAKEN_TURN_RAD_S):g} deg/s."
        " Error and amplitude as shares of the vibration's own."
    )
    usual = [row for row in shaken if (row.packet_hz, row.age_ms) == (USUAL_HZ, USUAL_MS)]
    looks = {way: SeriesLook(way, colour, "o") for way, colour in WAYS.items()}
    panels = (
        *(error_panel(packets) for packets in SENDERS),
        *(gain_panel(packets) for packets in SENDERS),
    )
    layout = {"share_y": "row"}
    draw_rows(path, finding, ChartSpec(panels, way_of, looks, note, 2, layout), usual)


def error_panel(packets: str) -> PanelSpec:
    """The error of a vibration, by its frequency, from one kind of sender."""
    return PanelSpec(
        (shaken_line("residual", packets),),
        ERROR_LABELS[packets],
        title=f"packets {packets}",
        scales=("log", "linear"),
        xticks=SHAKEN_TICKS_HZ,
        from_zero=True,
        names=packets != SENDERS[0],
    )


def gain_panel(packets: str) -> PanelSpec:
    """The amplitude of a vibration as shown, by its frequency, from one kind of sender."""
    return PanelSpec(
        (shaken_line("gain", packets),),
        GAIN_LABELS[packets],
        "frequency of the vibration [Hz]",
        levels=(LevelLine(1.0, HIDDEN, MUTED, "-", 0.8),),
        scales=("log", "linear"),
        xticks=SHAKEN_TICKS_HZ,
        from_zero=True,
        names=packets != SENDERS[0],
    )


def shaken_line(share: str, packets: str) -> LineSpec:
    """A share of a vibration's own against its frequency, of one kind of sender."""
    return LineSpec("jitter_hz", share, where=lambda row: row.packets == packets, look=SHAKEN_LOOK)


def way_of(row: Shaken) -> str:
    """The series of a row: its way of prediction."""
    return row.way
