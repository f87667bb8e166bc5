"""Pointing error at the moment of light against latency and against the rate of packets, by
predictor, and their times.

The slew is a swing of degrees, shaken on each axis (`predictors.py`). A frame at time t has the
samples taken before t minus the latency, which covers link, drawing and scan-out.

Then the prediction of a vibration beside a steady turn, against its frequency: by the rate, with
`prediction = "auto"`, and for the newest attitude alone.
"""

import math
import time
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from hilstar.attitude.clock.timeline import Policy, Prediction, Timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, GREEN, MUTED, ORANGE
from hilstar.basics.rotation import (
    angle_between_rad,
    conjugate,
    multiply,
    propagate,
    to_rotation_vector,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_MS, NS_PER_S
from hilstar.instruments.study.engine import (
    HIDDEN,
    ChartSpec,
    LevelLine,
    LineSpec,
    PanelSpec,
    SeriesLook,
    draw_rows,
    looks_of,
    write_rows,
)
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
from hilstar.instruments.study.sweep import Judged, Load, OtherWork

RATES_HZ = (5, 10, 20, 50, 100, 200)
LATENCIES_MS = (2, 5, 10, 20, 50, 100)
USUAL_HZ, USUAL_MS = 100, 20
FRAME_HZ = 60
SPAN_S, QUICK_SPAN_S = 40.0, 4.0  # of the slew: two of its swings, or part of one
TIMED = 200  # attitudes, whose median time counts
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
    """One predictor at one packet rate and latency: errors over all frames, arcsec, and the time of
    one attitude, us.
    """

    method: str
    rate_hz: int
    latency_ms: int
    rms_arcsec: float
    worst_arcsec: float
    attitude_us: float


@dataclass(frozen=True, slots=True)
class Shaken:
    """A vibration with one way of prediction: the shown amplitude and the rms error, relative to
    the true ones.
    """

    way: str
    packets: str
    packet_hz: int
    age_ms: int
    jitter_hz: float
    gain: float
    residual: float


@dataclass(frozen=True, slots=True)
class PredictionMeasured:
    """The errors and times on the slew, the errors of vibrations, and the work of others while
    the slew was timed.
    """

    outcomes: Sequence[PredictionOutcome]
    shaken: Sequence[Shaken]
    load: Load


def run(directory: Path, quick: bool = False) -> Judged:
    """Measure, and write `prediction.csv` and its chart; a line for each method. Raises
    InputError.
    """
    return report(directory, measure(quick))


def measure(quick: bool) -> PredictionMeasured:
    """Every predictor on the slew, and every way of prediction on vibrations."""
    others = OtherWork()
    outcomes = slew_outcomes(QUICK_SPAN_S if quick else SPAN_S)
    load = others.load()
    return PredictionMeasured(outcomes, shaken_rows(quick), load)


def report(directory: Path, measured: PredictionMeasured) -> Judged:
    """Write what was measured; a line for each method. Raises InputError."""
    outcomes = measured.outcomes
    write_rows(directory / "prediction.csv", outcomes)
    usual = [row for row in outcomes if is_usual(row.rate_hz, row.latency_ms)]
    finding = slew_finding(usual)
    draw(directory / "prediction", finding, outcomes, measured.load)
    write_rows(directory / "prediction_jitter.csv", measured.shaken)
    note = shaken_finding(measured.shaken)
    draw_shaken(directory / "prediction_jitter", note, measured.shaken)
    lines = map(line_of, usual)
    return measured.load.judged([finding, *lines, note])


def is_usual(packet_hz: int, age_ms: int) -> bool:
    """Whether packet rate and age are those of most benches."""
    return (packet_hz, age_ms) == (USUAL_HZ, USUAL_MS)


def slew_outcomes(span_s: float) -> list[PredictionOutcome]:
    """Every predictor over latency at the usual rate, and over rate at the usual latency."""
    by_latency = {(USUAL_HZ, ms) for ms in LATENCIES_MS}
    by_rate = {(hz, USUAL_MS) for hz in RATES_HZ}
    outcomes = []
    for hz, ms in sorted(by_latency | by_rate):
        count = math.ceil(span_s * hz) + 1
        samples = []
        for number in range(count):
            t_ns = round(number * NS_PER_S / hz)
            samples.append(slew_sample(t_ns))
        for predictor in predictors():
            if not predictor.waits:
                outcome = _outcome(predictor, samples, hz, ms)
                outcomes.append(outcome)
    return outcomes


def slew_finding(usual: Sequence[PredictionOutcome]) -> str:
    """The error of the default predictor, beside that of none."""
    rms_arcsec = {row.method: row.rms_arcsec for row in usual}
    default = next(predictor.name for predictor in predictors() if predictor.is_default)
    held_arcsec = rms_arcsec["hold"]
    default_arcsec = rms_arcsec[default]
    return (
        f"At {USUAL_HZ} Hz and {USUAL_MS} ms of latency, prediction by the newest sample's rate is"
        f" off by {default_arcsec:.2g} arcsec rms, holding the sample by"
        f" {held_arcsec:.3g}"
    )


def line_of(row: PredictionOutcome) -> str:
    """A predictor in words."""
    errors = f"{row.rms_arcsec:.3g} arcsec rms, {row.worst_arcsec:.3g} maximum"
    return f"{row.method}: {errors}, {row.attitude_us:.0f} us per attitude"


class ShakenCase(NamedTuple):
    """A vibration with one way of prediction; see `Shaken`."""

    way: Way
    packets: str
    packet_hz: int
    age_ms: int
    jitter_hz: int


def shaken_rows(quick: bool) -> list[Shaken]:
    """A vibration by every way of prediction, with and without rates."""
    rows = []
    for case in shaken_cases(quick):
        way, packets, packet_hz, age_ms, jitter_hz = case
        has_rates = packets == SENDERS[0]
        residual, gain = shaken_error(way, jitter_hz, packet_hz, age_ms, has_rates)
        rows.append(Shaken(*case, gain, residual))
    return rows


def shaken_cases(quick: bool) -> Iterator[ShakenCase]:
    """Each vibration under half of the packets' rate, by every way of prediction, with and without
    rates.
    """
    cells: tuple[tuple[int, int], ...] = SHAKEN_CELLS
    frequencies: tuple[int, ...] = SHAKEN_HZ
    if quick:
        cells = QUICK_SHAKEN_CELLS
        frequencies = QUICK_SHAKEN_HZ
    for packets, cell, way, jitter_hz in product(SENDERS, cells, WAYS, frequencies):
        packet_hz, age_ms = cell
        if jitter_hz >= packet_hz / 2:
            continue  # it looks like a slow one
        yield ShakenCase(way, packets, packet_hz, age_ms, jitter_hz)


def shaken_finding(rows: Sequence[Shaken]) -> str:
    """The frequency above which no prediction is better, and the error of "auto"."""
    crossings_hz = []
    for packets in SENDERS:
        crossings_hz.append(crossing_hz(rows, packets, USUAL_HZ, USUAL_MS))
    given, derived = crossings_hz
    times = auto_times(rows)
    return (
        f"Of a vibration above {given:.0f} Hz ({derived:.0f} without rates) the newest attitude is"
        f' nearer than one predicted by {USUAL_MS} ms; "auto" is within {times:.1f}'
        " times the better of both"
    )


def shaken_error(
    way: Way, jitter_hz: float, packet_hz: int, age_ms: float, rates: bool
) -> tuple[float, float]:
    """The rms error and the shown amplitude of a vibration about z beside a steady turn, relative
    to the true ones.

    "newest" holds the attitude between packets; it knows the steady turn.
    """
    turn = SHAKEN_TURN_RAD_S
    ahead_ns = NS_PER_S
    if way == "newest":
        turn = 0.0
        ahead_ns = 0
    prediction: Prediction = "auto" if way == "auto" else "rate"
    policy = Policy(ahead_ns, NS_PER_S, prediction=prediction)
    timeline = Timeline(policy)
    middle_s = age_ms / 1e3 - 0.5 / packet_hz
    latency_s = max(middle_s, 0.0)
    amplitude = SHAKEN_ARCSEC / ARCSEC_PER_RAD
    turning = math.tau * jitter_hz

    def attitude(t_s: float) -> FloatArray:
        wave = amplitude * math.sin(turning * t_s + 0.3)
        angle = turn * t_s + wave
        return propagate(ORION, Z, angle)

    def sample(t_s: float) -> AttitudeSample:
        rate = None
        if rates:
            wave_rate = amplitude * turning * math.cos(turning * t_s + 0.3)
            rate = Z * (turn + wave_rate)
        t_ns = round(t_s * NS_PER_S)
        true_q = attitude(t_s)
        return AttitudeSample(t_ns, true_q, rate)

    received = 0
    errors = []
    frames_s = np.arange(0, SETTLED_S + SHAKEN_S, 1 / SHAKEN_FRAME_HZ)
    times_s = frames_s + latency_s
    for t_s in times_s:
        while received / packet_hz <= t_s - latency_s:
            timeline.add(sample(received / packet_hz))
            received += 1
        shown = attitude_at(timeline, round(t_s * NS_PER_S))
        off = multiply(shown.q_icrs_to_cam, conjugate(attitude(t_s)))
        off_rad = to_rotation_vector(off)
        errors.append(-off_rad[2])
    late = times_s >= SETTLED_S
    phase = turning * times_s[late] + 0.3
    error = np.array(errors)[late]
    columns = (np.sin(phase), np.cos(phase), np.ones(len(phase)))
    waves = np.column_stack(columns)
    shown_wave = error + amplitude * np.sin(phase)
    solution = np.linalg.lstsq(waves, shown_wave, rcond=None)[0]
    sine, cosine, _ = solution
    rms = np.sqrt(2 * np.mean(error**2))
    residual = float(rms / amplitude)
    gain = float(np.hypot(sine, cosine) / amplitude)
    return residual, gain


def auto_times(rows: Sequence[Shaken]) -> float:
    """The largest error of "auto" as a multiple of the better of the other two."""
    residuals: dict[tuple[str, float], dict[str, float]] = {}
    for row in rows:
        if is_usual(row.packet_hz, row.age_ms):
            by_way = residuals.setdefault((row.packets, row.jitter_hz), {})
            by_way[row.way] = row.residual
    times = []
    for by_way in residuals.values():
        better = min(by_way["rate"], by_way["newest"])
        times.append(by_way["auto"] / better)
    return max(times)


def crossing_hz(rows: Sequence[Shaken], packets: str, packet_hz: int, age_ms: int) -> float:
    """The frequency above which the newest attitude is nearer than one predicted by its rate;
    infinite where there is none.
    """
    residuals: dict[str, dict[float, float]] = {"rate": {}, "newest": {}, "auto": {}}
    for row in rows:
        if (row.packets, row.packet_hz, row.age_ms) == (packets, packet_hz, age_ms):
            residuals[row.way][row.jitter_hz] = row.residual
    by_rate = residuals["rate"]
    worse_by = {hz: by_rate[hz] - residuals["newest"][hz] for hz in by_rate}
    for (low, under), (high, over) in pairwise(worse_by.items()):
        if under <= 0 < over:
            crossing_share = under / (under - over)
            return float(low * (high / low) ** crossing_share)
    return math.inf


def _outcome(
    predictor: Predictor, samples: list[AttitudeSample], rate_hz: int, latency_ms: int
) -> PredictionOutcome:
    taken_ns = [sample.t_ns for sample in samples]
    latency_ns = latency_ms * NS_PER_MS
    first = (taken_ns[NEAR] + latency_ns) * FRAME_HZ / NS_PER_S
    last = taken_ns[-1] * FRAME_HZ / NS_PER_S
    errors = []
    for frame in range(math.ceil(first), math.floor(last)):
        t_ns = round(frame * NS_PER_S / FRAME_HZ)
        count = bisect_right(taken_ns, t_ns - latency_ns)
        ready = samples[count - NEAR : count]
        shown = predictor.load(ready)(t_ns)
        off_rad = angle_between_rad(slew_attitude(t_ns), shown)
        errors.append(off_rad * ARCSEC_PER_RAD)
    predict = predictor.load(samples[-NEAR:])
    times_us = []
    for _ in range(TIMED):
        begin_ns = time.perf_counter_ns()
        predict(taken_ns[-1] + latency_ns)
        spent_ns = time.perf_counter_ns() - begin_ns
        times_us.append(spent_ns / 1e3)
    mean_square = np.mean(np.square(errors))
    rms = float(np.sqrt(mean_square))
    median_us = float(np.median(times_us))
    return PredictionOutcome(predictor.name, rate_hz, latency_ms, rms, max(errors), median_us)


def draw(path: Path, finding: str, outcomes: Sequence[PredictionOutcome], load: Load) -> None:
    """The pointing error of each predictor, by latency and by the rate of packets."""
    shaken = ", ".join(f"{size:g} arcsec at {hz:g} Hz" for size, hz in JITTER)
    note = (
        f"A swing of {SLEW_DEG:g} degrees in {SLEW_S:g} s, shaken by {shaken}. In brackets: the"
        " time of one attitude."
    )
    times_us: dict[str, list[float]] = {}
    for row in outcomes:
        times_us.setdefault(row.method, []).append(row.attitude_us)

    def with_time(row: PredictionOutcome) -> str:
        time_us = np.median(times_us[row.method])
        return f"{row.method} ({time_us:.0f} us)"

    latency = LineSpec("latency_ms", "rms_arcsec", label=with_time, where=has_usual_rate)
    by_latency = PanelSpec(
        (latency,),
        "pointing error, rms [arcsec]",
        f"latency [ms], packets at {USUAL_HZ} Hz",
        scales=("log", "log"),
        xticks=LATENCIES_MS,
    )
    rate = LineSpec("rate_hz", "rms_arcsec", where=has_usual_latency)
    by_rate = PanelSpec(
        (rate,),
        "pointing error, rms [arcsec]",
        f"rate of packets [Hz], latency {USUAL_MS} ms",
        scales=("log", "log"),
        xticks=RATES_HZ,
    )
    methods = {method: method for method in times_us}
    looks = looks_of(methods, MARKERS)
    layout = {"share_x": False}
    panels = (by_latency, by_rate)
    spec = ChartSpec(panels, lambda row: row.method, looks, note, layout=layout)
    draw_rows(path, finding, spec, outcomes, load)


def has_usual_rate(row: PredictionOutcome) -> bool:
    """Whether a row varies latency only."""
    return row.rate_hz == USUAL_HZ


def has_usual_latency(row: PredictionOutcome) -> bool:
    """Whether a row varies the packet rate only."""
    return row.latency_ms == USUAL_MS


def draw_shaken(path: Path, finding: str, shaken: Sequence[Shaken]) -> None:
    """A vibration's error and amplitude as shown, by its frequency; with and without rates."""
    note = (
        f"Packets at {USUAL_HZ} Hz, the newest {USUAL_MS} ms old at light on the mean; a vibration"
        f" of {SHAKEN_ARCSEC:g} arcsec beside a turn of {math.degrees(SHAKEN_TURN_RAD_S):g} deg/s."
        " Error and amplitude as shares of the vibration's own."
    )
    usual = [row for row in shaken if is_usual(row.packet_hz, row.age_ms)]
    looks = {way: SeriesLook(way, colour, "o") for way, colour in WAYS.items()}
    panels = (*map(error_panel, SENDERS), *map(gain_panel, SENDERS))
    layout = {"share_y": "row"}
    spec = ChartSpec(panels, way_of, looks, note, 2, layout)
    draw_rows(path, finding, spec, usual)


def error_panel(packets: str) -> PanelSpec:
    """The error of a vibration, by its frequency, from one kind of sender."""
    line = shaken_line("residual", packets)
    return PanelSpec(
        (line,),
        ERROR_LABELS[packets],
        title=f"packets {packets}",
        scales=("log", "linear"),
        xticks=SHAKEN_TICKS_HZ,
        from_zero=True,
        names=packets != SENDERS[0],
    )


def gain_panel(packets: str) -> PanelSpec:
    """The amplitude of a vibration as shown, by its frequency, from one kind of sender."""
    line = shaken_line("gain", packets)
    whole = LevelLine(1.0, HIDDEN, MUTED, "-", 0.8)
    return PanelSpec(
        (line,),
        GAIN_LABELS[packets],
        "frequency of the vibration [Hz]",
        levels=(whole,),
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
