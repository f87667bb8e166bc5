"""Count how often the intervals of calibrations and assessments hold a planted truth.

`python tools/interval_coverage.py [TRIALS] [KIND] [-o FILE.csv] [--seed S]`: the estimators alone,
no image is drawn. What they get is drawn here, with NumPy and SciPy. A kind's rows in FILE.csv are
replaced, and those of others stay. An interval is made of an error and its degrees of freedom as
`certify` makes it of a calibration's file; those of `assess` are its own.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit
from scipy.stats import binomtest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hilstar.instruments.assess.budget import Decomposed, assess_cases, assess_run
from hilstar.instruments.assess.clock import coarse_offset
from hilstar.instruments.calibrate.alignment import groups_of
from hilstar.instruments.calibrate.attitude_pairs import fit_rotation
from hilstar.instruments.calibrate.latency import Paired, summarise
from hilstar.instruments.calibrate.measurements import Measurements
from hilstar.instruments.calibrate.photometric import errors_of, fit_channel
from hilstar.instruments.calibrate.scale import scale_of
from hilstar.instruments.campaign.case_table import Columns
from hilstar.instruments.campaign.plan import Require
from hilstar.instruments.campaign.requirements import verdicts_of
from hilstar.server.bench.config import BenchConfig, read_config
from hilstar.server.record.commanded import Commanded
from tests.support.planted_answers import SCALE as PLANTED_SCALE
from tests.support.planted_answers import answers, old_places, reported_stars
from tests.support.planted_tracker import (
    ARCSEC_PER_RAD,
    ROLL,
    SCALE,
    Motion,
    Sizes,
    plant,
    scan,
)
from tests.support.planted_tracker import scalar_first as quaternions

COVERAGE = 0.95
THREE_SIGMAS = 0.9973
COLUMNS = ("kind", "figure", "trials", "held_percent", "low_percent", "high_percent", "seed")
ROOT = Path(__file__).resolve().parents[1]

# by figure, whether each interval held the truth
Held = Iterator[tuple[str, bool]]


def holds(value: float, truth: float, error: float, dof: float = math.inf) -> bool:
    """Whether a value within its error's 95 % interval is the truth."""
    k = 1.959964 if math.isinf(dof) else float(stdtrit(dof, (1 + COVERAGE) / 2))
    return abs(value - truth) <= k * error


ATTITUDES, REPEATS = 12, 3
CROSS_ARCSEC, OF_ATTITUDE = 5.0, 0.5


def alignment(rng: np.random.Generator) -> Held:
    """`calibrate alignment`: twelve attitudes read three times, each with an error that repeats."""
    commanded = Rotation.random(ATTITUDES, random_state=rng)
    turn = Rotation.from_rotvec(rng.normal(0, 200.0, 3) / ARCSEC_PER_RAD)
    shape = np.array([1.0, 1.0, ROLL]) * CROSS_ARCSEC / ARCSEC_PER_RAD
    of_attitude = OF_ATTITUDE * shape * rng.standard_normal((ATTITUDES, 3))
    number = np.repeat(np.arange(ATTITUDES), REPEATS)
    error = of_attitude[number] + shape * rng.standard_normal((len(number), 3))
    fit = fit_rotation(quaternions(Rotation.from_rotvec(error) * turn))
    covariance, dof = fit.covariance_rad2(groups_of(quaternions(commanded[number])))
    off = (Rotation.from_quat(np.roll(fit.q, -1)) * turn.inv()).as_rotvec()
    for axis, name in enumerate(("x", "y", "about the boresight")):
        yield f"rotation {name}", holds(off[axis], 0.0, math.sqrt(covariance[axis, axis]), dof)


STARS = 15


def scale(rng: np.random.Generator) -> Held:
    """`calibrate scale` by 15 stars, with the noise of each stated and not."""
    true = 1 + rng.normal(0, 0.1)
    for name, is_stated in (("noise stated", True), ("noise not stated", False)):
        noise_mag = rng.uniform(0.002, 0.02, STARS)
        off_mag = np.hypot(noise_mag, 0.004) * rng.standard_normal(STARS)
        ratios = true * 10 ** (-0.4 * off_mag)
        found = scale_of(1.0, ratios, noise_mag if is_stated else np.zeros(STARS))
        error = found.relative_error
        assert error is not None
        yield name, holds(found.flux_at_white_e_per_s / true, 1.0, error, STARS - 1.0)


EDGES = 60
CONFIG: list[BenchConfig] = []


def latency(rng: np.random.Generator) -> Held:
    """`latency`: the median of 60 edges with jitter of 0.3 ms."""
    if not CONFIG:
        CONFIG.append(read_config(ROOT / "configs" / "demo.toml"))
    true_ms = rng.uniform(5, 30)
    edges_ms = true_ms + 0.3 * rng.standard_normal(EDGES)
    found = summarise(Paired(1e6 * edges_ms, np.arange(EDGES) % 2, 0, False), CONFIG[0])
    shown_ms = found["panel_delay_ms"] + found["swap_to_square_ms"]
    yield "panel's delay", holds(shown_ms, true_ms, found["panel_delay_u_ms"])


LEVELS, READINGS = 24, 3


def response(rng: np.random.Generator) -> Held:
    """`calibrate photometric`: codes read three times, with noise relative to light, and a floor."""
    code = np.arange(256) / 255
    wave = rng.normal(0, 0.03)
    light = code ** rng.uniform(1.9, 2.5) * (1 + wave * np.sin(4 * code)) / (1 + wave * np.sin(4.0))
    black = rng.uniform(0.0005, 0.002)
    codes = np.unique(np.rint(np.geomspace(4, 255, LEVELS)).astype(np.intp))
    read = rng.permutation(np.repeat(np.append(0, codes), READINGS))
    value = light[read] + black
    value = value * (1 + 0.003 * rng.standard_normal(len(read)))
    value += 2e-5 * rng.standard_normal(len(read))
    none = np.zeros(len(read))
    channel = np.full(len(read), "w")
    time_s = np.arange(len(read), dtype=np.float64)
    shared = np.zeros((len(read), 0))
    data = Measurements("planted", 8, read, channel, value, time_s, {}, "", none, shared)
    fit = fit_channel(data, "w")
    errors = errors_of({"w": fit})
    assert errors is not None
    for name, at in (("half of white", 186), ("1 % of white", 32)):
        near = codes[np.argmin(np.abs(codes - at))]
        error = fit.error[near] * light[near]
        yield f"curve at {name}", holds(fit.light[near], light[near], error, errors.dof)
    middle = len(codes) // 2
    level = errors.light[middle] * (1 + errors.off[middle])
    own = math.hypot(errors.relative[middle], errors.relative[-1])
    off = level / (errors.light[-1] * (1 + errors.off[-1])) / light[codes[middle]]
    yield "level against white", holds(off, 1.0, own, errors.dof)
    yield "black", holds(fit.black / fit.white, black, errors.black, errors.dof)


CASES = 300


def assessed(found: Decomposed, bias: np.ndarray, noise: float) -> Held:
    """Bias and noise of a budget."""
    low, high = found.intervals.bias
    for axis, name in enumerate(("x", "y", "about the boresight")):
        yield f"bias {name}", bool(low[axis] <= bias[axis] <= high[axis])
    low, high = found.intervals.noise
    yield "noise across", bool(low[0] <= noise <= high[0])
    yield "noise about the boresight", bool(low[1] <= ROLL * noise <= high[1])


def cases(rng: np.random.Generator) -> Held:
    """`assess` of 300 cases all over the sky."""
    commanded = Rotation.random(CASES, random_state=rng)
    bias = rng.normal(0, 20.0, 3)
    noise = 2.0
    error = bias + noise * np.array([1.0, 1.0, ROLL]) * rng.standard_normal((CASES, 3))
    reported = Rotation.from_rotvec(error / ARCSEC_PER_RAD) * commanded
    found = assess_cases(quaternions(commanded), quaternions(reported), SCALE, rng)
    yield from assessed(found, bias, noise)


RUN_S, ANSWER_HZ = 300.0, 10.0


def run(rng: np.random.Generator) -> Held:
    """`assess` of a run of 3000 answers on a clock of their own; what repeats is counted too."""
    yield from of_run(scan, Sizes(wild=5, offset_s=0.02), RUN_S, ANSWER_HZ, rng)


def of_run(
    motion: Motion, sizes: Sizes, seconds: float, answer_hz: float, rng: np.random.Generator
) -> Held:
    """A run's figures: clock, bias, noise, and what repeats in the field and within a pixel."""
    field = drawn_field(rng)
    planted = plant(motion, sizes, rng, seconds=seconds, rate_hz=answer_hz, fov=field)
    commanded = Commanded(planted.frames_s, planted.frames_q)
    coarse = coarse_offset(commanded, planted.tau_s, planted.reported)
    assert coarse is not None
    found = assess_run(commanded, planted.tau_s, planted.reported, coarse, SCALE, rng)
    clock = found.clock
    if clock.offset_told:
        yield "clock's offset", holds(clock.offset_s, sizes.offset_s, clock.sigma_offset_s)
    if clock.drift_told:
        yield "clock's drift", holds(1e6 * clock.drift, sizes.drift_ppm, 1e6 * clock.sigma_drift)
    low, high = found.intervals.noise
    # what repeats with neither place is noise: a slow change too
    across = math.hypot(sizes.noise, float(np.sqrt((planted.slow[:2] ** 2).mean())))
    about = math.hypot(ROLL * sizes.noise, float(planted.slow[2]))
    yield "noise across", bool(low[0] <= across <= high[0])
    yield "noise about the boresight", bool(low[1] <= about <= high[1])
    of_pixel = found.intervals.pixel
    if sizes.pixel and found.pixel_arcsec.cross is not None:
        yield "pixel error across", bool(of_pixel[0, 0] <= sizes.pixel <= of_pixel[1, 0])
    if found.fov_arcsec.cross is None:
        return
    of_field = found.intervals.fov
    true = float(np.sqrt((planted.fov[:2] ** 2).mean()))
    yield "field error across", bool(of_field[0, 0] <= true <= of_field[1, 0])
    yield (
        "field error about the boresight",
        bool(of_field[0, 1] <= planted.fov[2] <= of_field[1, 1]),
    )


def drawn_field(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """A field-of-view error (n, 3) of rms 1 over the sky, of 250 to 900 px a period."""
    period_px = rng.uniform(250, 900)
    phase = rng.uniform(0, 2 * np.pi, 3)

    def field(place_px: np.ndarray) -> np.ndarray:
        x, y = 2 * np.pi * place_px.T / period_px
        angles = np.stack([x, y, (x + y) / 1.7], axis=1) + phase
        return np.asarray(np.sqrt(2) * np.sin(angles))

    return field


def drawn_scan(rng: np.random.Generator) -> Motion:
    """To and fro by 1 to 4 degrees in two axes of 150 to 600 s, with a slow roll."""
    size_deg = rng.uniform(1, 4, 2)
    period_s = rng.uniform(150, 600, 2)
    phase = rng.uniform(0, 2 * np.pi, 3)

    def motion(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        across = 2 * np.pi * t_s[:, None] / period_s + phase[:2]
        ra_deg, dec_deg = (size_deg * np.sin(across)).T
        roll_deg = 10 * np.sin(2 * np.pi * t_s / 603 + phase[2])
        return 84 + ra_deg, dec_deg - 1.2, roll_deg

    return motion


def drawn_slews(rng: np.random.Generator) -> Motion:
    """Slews of both signs over the same places, of 60 to 150 s there and back."""
    size_deg = rng.uniform(1, 4, 2)
    period_s = rng.uniform(60, 150)

    def motion(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        ra_deg, dec_deg = size_deg[:, None] * np.sin(2 * np.pi * t_s / period_s)
        return 84 + ra_deg, dec_deg - 1.2, np.zeros_like(t_s)

    return motion


def drawn_slew(rng: np.random.Generator) -> Motion:
    """One slew of 0.01 to 0.1 deg/s, which comes back to no place."""
    rate_deg_s = rng.uniform(0.01, 0.1) * rng.choice([-1.0, 1.0])
    dec_deg = rng.uniform(-30, 30)

    def motion(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return 84 + rate_deg_s * t_s, np.full_like(t_s, dec_deg), np.zeros_like(t_s)

    return motion


def of_minutes(
    draw: Callable[[np.random.Generator], Motion],
    minutes: float,
    answer_hz: float,
    slow: float = 0.0,
) -> Callable[[np.random.Generator], Held]:
    """Runs of a motion that is drawn, with a field-of-view error of 0.3 to 5 arcsec, and a slow
    change in time, arcsec rms.
    """

    def kind(rng: np.random.Generator) -> Held:
        motion = draw(rng)
        fov = float(rng.choice([0.3, 2.0, 5.0]))
        sizes = Sizes(wild=5, offset_s=0.02, fov=fov, pixel=0.0, slow=slow)
        yield from of_run(motion, sizes, 60 * minutes, answer_hz, rng)

    return kind


ONE_SIDE = (1 + COVERAGE) / 2  # of a clause's limits, which are one-sided


@dataclass(frozen=True, slots=True)
class PlantedClause:
    """What makes the cases of a clause, the planted key, its size, and the clause's axis."""

    make: Callable[..., Columns]
    key: str
    size: float
    axis: str | None = None


CLAUSES = {
    "rate-noise": PlantedClause(answers, "rate_noise", 0.05, "x"),
    "rate-scale": PlantedClause(answers, "rate_scale", 0.05, "x"),
    "rate-lag": PlantedClause(answers, "rate_lag", 0.3, "x"),
    "time-bias": PlantedClause(answers, "stamp_bias", 0.02),
    "time-jitter": PlantedClause(answers, "stamp_jitter", 0.02),
    "aberration": PlantedClause(answers, "aberration", 1.0),
    "proper-motion": PlantedClause(old_places, "proper_motion", 1.0),
    "catalogue-age": PlantedClause(old_places, "age", 5.0),
    "parallax": PlantedClause(old_places, "parallax", 1.0),
    "star-noise": PlantedClause(reported_stars, "noise", 0.3),
    "star-fov-error": PlantedClause(reported_stars, "fov", 0.3),
    "star-colour": PlantedClause(reported_stars, "colour", 0.1),
    "star-limit": PlantedClause(reported_stars, "limit", 5.0),
    "false-stars": PlantedClause(reported_stars, "false", 2.0),
}


def of_clauses(cases: int, **hard: float) -> Callable[[np.random.Generator], Held]:
    """A clause's limits, each at 97.5 %, for so many cases and with what makes them hard."""

    def kind(rng: np.random.Generator) -> Held:
        for quantity, clause in CLAUSES.items():
            size = clause.size
            planted = clause.make(rng, cases, **{clause.key: size}, **hard)
            side = "minimum" if quantity == "star-limit" else "maximum"
            keys: dict[str, Any] = {side: size, "quantity": quantity, "axis": clause.axis}
            require = Require(confidence=ONE_SIDE, **keys)
            verdict = verdicts_of([require], planted, PLANTED_SCALE, 1)[0]
            # a figure that is not told claims nothing
            if verdict.value is None:
                continue
            low = -math.inf if verdict.low is None else verdict.low
            high = math.inf if verdict.high is None else verdict.high
            yield quantity, low <= size <= high

    return kind


KINDS: dict[str, Callable[[np.random.Generator], Held]] = {
    "calibrate alignment": alignment,
    "calibrate scale": scale,
    "latency": latency,
    "calibrate photometric": response,
    "assess of cases": cases,
    "assess of a run": run,
    "assess, scan of 5 min": of_minutes(drawn_scan, 5, ANSWER_HZ / 2),
    "assess, scan of 15 min": of_minutes(drawn_scan, 15, ANSWER_HZ / 5),
    "assess, scan of 60 min": of_minutes(drawn_scan, 60, ANSWER_HZ / 10),
    "assess, slews of both signs, 5 min": of_minutes(drawn_slews, 5, ANSWER_HZ / 2),
    "assess, one slew of 5 min": of_minutes(drawn_slew, 5, ANSWER_HZ / 2),
    "assess, a slow change of half the noise": of_minutes(drawn_slews, 5, ANSWER_HZ / 2, slow=0.5),
    "clauses, 60 cases": of_clauses(60),
    "clauses, 10 cases": of_clauses(10),
    "clauses, frames of a case go together": of_clauses(30, together=0.5),
    "clauses, 1 % far off": of_clauses(30, wild=0.01),
}


def rows_of(kind: str, trials: int, seed: int) -> list[list[str]]:
    """The rows of a kind: its figures, and how many of their intervals held."""
    held: dict[str, list[bool]] = defaultdict(list)
    for number in range(trials):
        for figure, is_held in KINDS[kind](np.random.default_rng((seed, number))):
            held[figure].append(is_held)
    rows = []
    for figure, each in held.items():
        share = sum(each) / len(each)
        about = binomtest(sum(each), len(each)).proportion_ci(THREE_SIGMAS, "wilson")
        percents = [f"{100 * percent:.1f}" for percent in (share, about.low, about.high)]
        rows.append([kind, figure, str(len(each)), *percents, str(seed)])
    return rows


def write(path: Path | None, kind: str, rows: list[list[str]]) -> None:
    """Put the rows of a kind into a file, in the place of those that it has; None: no file."""
    if path is None:
        return
    others: list[list[str]] = []
    if path.exists():
        with path.open(newline="") as file:
            others = [row for row in list(csv.reader(file))[1:] if row[0] != kind]
    names = list(KINDS)
    every = sorted(rows + others, key=lambda row: names.index(row[0]))
    with path.open("w", newline="") as out:
        csv.writer(out, lineterminator="\n").writerows([COLUMNS, *every])


def main() -> None:
    """Print the counts, and write them as CSV."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("trials", type=int, nargs="?", default=1000)
    parser.add_argument("kind", nargs="?", choices=list(KINDS))
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    for kind in [asked.kind] if asked.kind else list(KINDS):
        started = time.process_time()
        rows = rows_of(kind, asked.trials, asked.seed)
        seconds = (time.process_time() - started) / asked.trials
        print(f"{kind}: {1000 * seconds:.1f} ms of CPU a trial", flush=True)
        for row in rows:
            print(f"  {row[1]:32}{row[3]:>6} % ({row[4]} to {row[5]})", flush=True)
        write(asked.output, kind, rows)


if __name__ == "__main__":
    main()
