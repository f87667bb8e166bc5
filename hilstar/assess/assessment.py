"""What a run's ledger says of the commanded attitude, and of the bench that showed it.

Telemetry brought onto a run's clock, or refused with what is wrong with it.

A tracker's telemetry against the ledger of the run that it saw: the whole assessment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.assess.bench_effects import DisplayCost, Slice, display_cost, display_errors, field_magnitudes, slices_of
from hilstar.assess.budget import Axes, Decomposed, assess_run, axes_of_variance
from hilstar.assess.clock import CoarseClock, coarse_offset, speed_offsets
from hilstar.assess.components import MIN_ROWS
from hilstar.assess.lock import Lock, lock_of
from hilstar.assess.places import Scale
from hilstar.attitude.logs.telemetry import Telemetry, read_telemetry
from hilstar.bench.bench_file import BenchFile, bench_file_of
from hilstar.bench.config import BenchConfig
from hilstar.calibrate.alignment.conventions import refuse_conventions
from hilstar.calibrate.alignment.pairs import COMMANDED, Pairs
from hilstar.errors import HilstarError, InputError
from hilstar.rotation import to_matrix, to_rotation_vector
from hilstar.run.record.commanded import Commanded
from hilstar.run.record.ledger_reader import NO_FRAMES, config_of, frame_records, read_head
from hilstar.units import ARCSEC_PER_RAD, NS_PER_S

NOT_SHOWN = (np.nan,) * 4
AGREE_RAD = np.radians(1.0)  # half of the answers of one sky are this near to one rotation
MAX_TURN_RAD = np.radians(5.0)  # from commanded to reported: more is another frame
NEAR_AXES_RAD = np.radians(5.0)
MIN_PAIRS = 8
SEED = 0  # of the bootstrap: the same files give the same intervals
SMALL = 0.3  # of the noise: a larger error of the display is said
BENT_ARCSEC = 0.1
TOGETHER, SLOW_SHARE = 20, 0.1  # answers, and a share of the noise's variance that is said
Stamp = Literal["start", "middle", "end"]
MIDDLE = {"start": 0.5, "middle": 0.0, "end": -0.5}  # of an exposure, from the stamp on


@dataclass(frozen=True)
class RunLedger:
    """A run: the commanded attitudes, whose times are seconds after `zero_ns` of the sender's clock, and its bench."""

    path: Path
    head: dict[str, str]
    config: BenchConfig
    commanded: Commanded
    zero_ns: int
    frames: int
    not_plain: int

    @property
    def scale(self) -> Scale:
        """The tracker's sizes, by the bench file in the ledger."""
        tracker = self.config.tracker
        width, height = tracker.resolution_px
        return Scale(1e3 * tracker.focal_length_mm / tracker.pixel_pitch_um, (width, height))

    def bench_file(self) -> BenchFile:
        """The bench as it was, by the text in the ledger; what it names has to be where it was. Raises InputError."""
        return bench_file_of(Path(self.head.get("bench_file", "bench.toml")), self.head.get("bench_text", ""))


def read_ledger(path: Path) -> RunLedger:
    """Read a ledger. Raises InputError for a file that is none, for damage, and for a run without attitudes or bench file."""
    head = read_head(path)
    shown: dict[int, tuple[float, ...]] = {}
    not_plain = 0
    for record in frame_records(path):
        plain = record.q is not None and not record.operator and not record.hidden
        not_plain += record.q is not None and not plain
        shown[record.light_ns] = record.q if plain and record.q is not None else NOT_SHOWN
    if not shown:
        raise InputError(f"{path}: {NO_FRAMES}")
    light_ns = np.array(sorted(shown), dtype=np.int64)
    q = np.array([shown[int(t)] for t in light_ns])
    known = int(np.isfinite(q[:, 0]).sum())
    if known < 2:
        why = "operators' keys or a hidden window changed all of them" if not_plain else "none of them has an attitude"
        raise InputError(f"{path}: {len(light_ns)} frames, and {why}; give the ledger of a run that was sent attitudes")
    config = config_of(head)
    if config is None:
        raise InputError(f"{path}: its head holds no bench file that can be read; give the ledger of serve or replay --ledger")
    zero_ns = int(light_ns[0])
    return RunLedger(path, head, config, Commanded((light_ns - zero_ns) / NS_PER_S, q), zero_ns, len(light_ns), not_plain)


def tau_of(run: RunLedger, telemetry: Telemetry) -> tuple[FloatArray, float]:
    """The telemetry's times (n,), s, near the run's where the two overlap as they are, and what was subtracted from them, s."""
    end_ns = run.zero_ns + round(run.commanded.t_s[-1] * NS_PER_S)
    overlap = telemetry.t_ns[0] <= end_ns and telemetry.t_ns[-1] >= run.zero_ns
    base_ns = run.zero_ns if overlap else int(telemetry.t_ns[0])
    return (telemetry.t_ns - base_ns) / NS_PER_S, (base_ns - run.zero_ns) / NS_PER_S


def matched(run: RunLedger, telemetry: Telemetry, tau_s: FloatArray, q: FloatArray) -> CoarseClock:
    """Where valid answers (n, 4) at times (n,) lie on the run's clock.

    Raises InputError for other conventions than hilstar's, for another frame, and for answers of another run.
    """
    commanded = run.commanded
    coarse = coarse_offset(commanded, tau_s, q)
    if coarse is not None and coarse.spread_rad <= AGREE_RAD and coarse.turn_rad <= MAX_TURN_RAD:
        return coarse
    if coarse is not None and coarse.spread_rad <= AGREE_RAD:
        named = _other_axes(coarse.rotation)
        if named:
            raise InputError(f"{telemetry.path}: {_turned(coarse.rotation)}: {named}")
    offsets = [] if coarse is None else [coarse.offset_s]
    for offset in [*offsets, *speed_offsets(commanded, tau_s, q).tolist()]:
        _refuse(run, telemetry, tau_s + offset, q)
    if coarse is not None and coarse.spread_rad <= AGREE_RAD:
        w, x, y, z = (float(value) for value in coarse.rotation * [1, -1, -1, -1])
        cure = f"turn them back by the quaternion {w:.6f},{x:.6f},{y:.6f},{z:.6f} from the left"
        raise InputError(f"{telemetry.path}: {_turned(coarse.rotation)}: another frame or mounting; {cure}")
    raise InputError(
        f"{telemetry.path}: at no offset of its clock do the reported attitudes follow those of {run.path}, lit for"
        f" {commanded.t_s[-1]:.6g} s; give the telemetry of this run, of which no more than half may be wild"
    )


def _refuse(run: RunLedger, telemetry: Telemetry, t_s: FloatArray, q: FloatArray) -> None:
    """Refuse answers that agree with the run at these times by another convention; nothing where none fits."""
    moments = run.commanded.at(t_s)
    if moments.known.sum() < max(MIN_PAIRS, 0.1 * len(t_s)):
        return
    rows = np.flatnonzero(moments.known)
    pairs = Pairs(telemetry.path, telemetry.line[telemetry.valid][rows], moments.q[rows], q[rows], names=COMMANDED)
    try:
        refuse_conventions(pairs, float(np.arctan(0.5 * np.hypot(*run.scale.resolution_px) / run.scale.focal_px)))
    except InputError as refusal:
        if "wild" not in str(refusal) and "out of view" not in str(refusal):
            raise


def _turned(rotation: FloatArray) -> str:
    turn = to_rotation_vector(rotation)
    angle = float(np.linalg.norm(turn))
    axis = ",".join(f"{value:.3f}" for value in turn / max(angle, 1e-12))
    return f"the reported attitudes are turned by {np.degrees(angle):.4g} degrees about {axis} (cam) from the commanded ones"


def _other_axes(rotation: FloatArray) -> str:
    """Which axes a large constant rotation (4,) stands for, "" where it is none of the 24 ways to name right-handed axes."""
    matrix = to_matrix(rotation)
    nearest = np.zeros((3, 3))
    for row in range(3):
        column = int(np.argmax(np.abs(matrix[row])))
        nearest[row, column] = np.sign(matrix[row, column])
    off = np.arccos(np.clip((np.trace(matrix @ nearest.T) - 1) / 2, -1, 1))
    if abs(np.linalg.det(nearest) - 1) > 1e-9 or off > NEAR_AXES_RAD:
        return ""
    names = ["xyz"[int(np.argmax(np.abs(row)))] for row in nearest]
    signs = ["-" if row.sum() < 0 else "+" for row in nearest]
    axes = ", ".join(f"{own} = {sign}{name}" for own, sign, name in zip("xyz", signs, names, strict=True))
    return f"they fit axes with {axes} of hilstar's; write them for x right, y down in the image, z boresight"


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
