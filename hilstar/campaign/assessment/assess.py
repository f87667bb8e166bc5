"""A tracker's telemetry against the ledger of the run that it saw: the whole assessment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.campaign.assessment.display_cost import DisplayCost, display_cost, display_errors
from hilstar.campaign.assessment.lock import Lock, lock_of
from hilstar.campaign.assessment.matching import matched, tau_of
from hilstar.campaign.assessment.run_ledger import RunLedger, read_ledger
from hilstar.campaign.assessment.slices import Slice, field_magnitudes, slices_of
from hilstar.campaign.assessment.telemetry import Telemetry, read_telemetry
from hilstar.campaign.budget.budget import Axes, Decomposed, assess_run, axes_of_variance
from hilstar.campaign.budget.components import MIN_ROWS
from hilstar.errors import HilstarError, InputError
from hilstar.units import ARCSEC_PER_RAD

SEED = 0  # of the bootstrap: the same files give the same intervals
SMALL = 0.3  # of the noise: a larger error of the display is said
BENT_ARCSEC = 0.1
TOGETHER, SLOW_SHARE = 20, 0.1  # answers, and a share of the noise's variance that is said
Stamp = Literal["start", "middle", "end"]
MIDDLE = {"start": 0.5, "middle": 0.0, "end": -0.5}  # of an exposure, from the stamp on


@dataclass(frozen=True, slots=True)
class Wanted:
    """How times are stamped, how much later than that, s, and at how many attitudes the display's error is looked at."""

    stamp: Stamp = "middle"
    latency_s: float = 0.0
    display_attitudes: int = 12


@dataclass(frozen=True, slots=True)
class Wrong:
    """An answer that is no attitude of this sky: its line, its own time and the run's, s, and how far off it is."""

    row: int
    t_s: float
    run_s: float
    off_deg: float


@dataclass(frozen=True)
class Assessment:
    """All that was found; `noise_arcsec` is without what the display itself cost, where the answers show it."""

    run: RunLedger
    telemetry: Telemetry
    found: Decomposed
    noise_arcsec: Axes
    offset_s: float
    lock: Lock
    wrong: tuple[Wrong, ...]
    display: DisplayCost | None
    by_rate: tuple[Slice, ...]
    by_magnitude: tuple[Slice, ...]
    t_s: FloatArray
    notes: tuple[str, ...]


def assess_files(ledger: Path, telemetry: Path, wanted: Wanted, say: Callable[[str], None] = lambda _: None) -> Assessment:
    """Assess telemetry against a ledger. Raises InputError with what is wrong with either."""
    answers, run = read_telemetry(telemetry), read_ledger(ledger)
    exposure_s = run.config.tracker.exposure_s
    tau_s, base_s = tau_of(run, answers)
    tau_s = tau_s + MIDDLE[wanted.stamp] * exposure_s - wanted.latency_s
    valid = np.flatnonzero(answers.valid)
    if len(valid) < MIN_ROWS:
        raise InputError(f"{telemetry}: {len(valid)} valid answers, and {MIN_ROWS} are needed; give longer telemetry")
    say("clock and parts of the error")
    coarse = matched(run, answers, tau_s[valid], answers.q[valid])
    try:
        found = assess_run(run.commanded, tau_s[valid], answers.q[valid], coarse, run.scale, np.random.default_rng(SEED))
    except InputError as refusal:
        raise InputError(f"{telemetry}: {refusal}") from refusal
    return _completed(run, answers, found, (tau_s, base_s, wanted), say)


def _completed(
    run: RunLedger,
    answers: Telemetry,
    found: Decomposed,
    timing: tuple[FloatArray, float, Wanted],
    say: Callable[[str], None],
) -> Assessment:
    tau_s, base_s, wanted = timing
    clock = found.clock
    if clock is None:
        raise AssertionError("a run has a clock")
    start_s = float(run.commanded.t_s[0])
    t_s = start_s + (tau_s - clock.offset_s - start_s) / (1 + clock.drift)
    valid = np.flatnonzero(answers.valid)
    right, wrong = np.zeros(len(t_s), dtype=np.bool_), np.zeros(len(t_s), dtype=np.bool_)
    right[valid[found.row]], wrong[valid[found.wrong]] = True, True
    notes = [*found.notes, *_said_of_base(base_s), *_said_of_clock(found), *_said_of_bend(run, found), *_said_of_slow(found)]
    by_rate, by_magnitude, display, missing = _of_the_bench(run, found, wanted, say)
    noise, said = _without_display(found, display)
    return Assessment(
        run=run,
        telemetry=answers,
        found=found,
        noise_arcsec=noise,
        offset_s=clock.offset_s + base_s,
        lock=lock_of(run.commanded, t_s, right, wrong),
        wrong=_wrong(answers, found, t_s),
        display=display,
        by_rate=by_rate,
        by_magnitude=by_magnitude,
        t_s=t_s,
        notes=(*notes, *missing, *said),
    )


def _of_the_bench(
    run: RunLedger, found: Decomposed, wanted: Wanted, say: Callable[[str], None]
) -> tuple[tuple[Slice, ...], tuple[Slice, ...], DisplayCost | None, list[str]]:
    """The error by rate and by magnitude, the display's own, and what of it could not be found."""
    parts = found.components
    error = parts.fov.fitted + parts.pixel.fitted + parts.left
    freedom = parts.fov.freedom + parts.pixel.freedom + 1
    rate_deg_s = np.degrees(np.linalg.norm(found.rate_rad_s, axis=1))
    by_rate = slices_of(rate_deg_s, parts.left, error, freedom)
    by_magnitude: tuple[Slice, ...] = ()
    display: DisplayCost | None = None
    notes: list[str] = []
    try:
        file = run.bench_file()
        say("the field's stars")
        by_magnitude = slices_of(field_magnitudes(file, found.commanded_q), parts.left, error, freedom)
        if wanted.display_attitudes:
            say("the display's own error")
            some = np.unique(np.linspace(0, len(found.row) - 1, wanted.display_attitudes).astype(int))
            display = display_cost(display_errors(file, found.commanded_q[some]), parts.left[some])
            if display is None:
                notes.append("the display shows too few stars at once for an attitude: its own error was not found")
    except HilstarError as refusal:
        notes.append(f"neither the field's magnitude nor the display's own error could be found from the ledger: {refusal}")
    return by_rate, by_magnitude, display, notes


def _wrong(answers: Telemetry, found: Decomposed, t_s: FloatArray) -> tuple[Wrong, ...]:
    valid = np.flatnonzero(answers.valid)
    if found.clock is None:
        return ()
    off = np.degrees(np.linalg.norm(found.clock.residual_arcsec, axis=1) / ARCSEC_PER_RAD)
    return tuple(
        Wrong(int(answers.line[valid[k]]), int(answers.t_ns[valid[k]]) / 1e9, float(t_s[valid[k]]), float(off[k]))
        for k in found.wrong
    )


def _said_of_base(base_s: float) -> list[str]:
    """Times that do not overlap the run's as they are."""
    if base_s == 0:
        return []
    return [
        f"the telemetry's times, {abs(base_s):.9g} s from the run's, do not overlap it: its clock is taken as one of its own"
    ]


def _said_of_clock(found: Decomposed) -> list[str]:
    clock = found.clock
    if clock is None or (clock.offset_told and clock.drift_told):
        return []
    if not clock.drift_told:
        return ["the run has no motion that tells the clock: offset and drift are not known, and times are taken as they are"]
    return [
        "the run turns at a constant rate: an offset of the clock cannot be told from a bias along the motion, and is taken to"
        f" be {1e3 * clock.offset_s:.3g} ms beside the rough one"
    ]


def _said_of_bend(run: RunLedger, found: Decomposed) -> list[str]:
    """A tracker averages over its exposure: by alpha E^2 / 24 that differs from the attitude in its middle."""
    rate = ARCSEC_PER_RAD * found.rate_rad_s
    if found.clock is None or len(rate) < MIN_ROWS:
        return []
    step_s = np.diff(found.clock.t_s[found.row])
    near = step_s < 1.0
    if not near.any():
        return []
    acceleration = np.linalg.norm(np.diff(rate, axis=0)[near], axis=1) / step_s[near]
    bent = float(np.percentile(acceleration, 99)) * run.config.tracker.exposure_s**2 / 24
    if bent < BENT_ARCSEC:
        return []
    return [f"in an exposure the attitude's mean differs from that in its middle by up to {bent:.2g} arcsec"]


def _said_of_slow(found: Decomposed) -> list[str]:
    """Noise that goes on from answer to answer: what changes slowly with time, or with the place more sharply than bumps do."""
    left = found.components.left
    rows = len(left) // TOGETHER * TOGETHER
    if rows < MIN_ROWS * TOGETHER:
        return []
    means = left[:rows].reshape(-1, TOGETHER, 3).mean(axis=1)
    slow = (means**2).mean(axis=0) - found.components.noise_variance / TOGETHER
    share = slow / np.maximum(found.components.noise_variance, 1e-12)
    if share.max() < SLOW_SHARE:
        return []
    size = axes_of_variance(slow)
    return [
        f"the noise is not white: {size.cross:.2g} arcsec across the boresight and {size.roll:.2g} about it last for {TOGETHER}"
        f" answers and more, besides {found.components.fov.detail or 'the bias'}: does the alignment drift with time, or"
        " does the field-of-view error jump somewhere?"
    ]


def _without_display(found: Decomposed, display: DisplayCost | None) -> tuple[Axes, list[str]]:
    """The noise without the display's own error, and what is to be said of that."""
    noise = found.noise_arcsec
    if display is None or noise.cross is None or noise.roll is None:
        return noise, []
    share = display.subtracted
    cost = np.array([display.cross_arcsec, display.cross_arcsec, display.roll_arcsec]) ** 2
    without = axes_of_variance(found.components.noise_variance - share * cost)
    small = display.cross_arcsec <= SMALL * noise.cross and display.roll_arcsec <= SMALL * noise.roll
    if small:
        return without, []
    size = f"{display.cross_arcsec:.2g} arcsec across the boresight and {display.roll_arcsec:.2g} about it"
    says = f"the answers show {display.seen:.2f} +- {display.sigma_seen:.2f} of it"
    done = f"{100 * share:.0f} % of its variance are subtracted from the noise" if share else "nothing is subtracted"
    return without, [f"the display's own error is not small beside the noise: {size}; {says}, and {done}"]
