"""A tracker's telemetry against the ledger of the run that it saw: matching, budget, lock, and what the bench adds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.assess.bench_effects import DisplayCost, Slice, display_cost, display_errors, field_magnitudes, slices_of
from hilstar.assess.budget import Axes, Decomposed, DecomposedRun, assess_run, axes_of_variance
from hilstar.assess.clock import CoarseClock, coarse_offset, speed_offsets
from hilstar.assess.components import MIN_ROWS
from hilstar.assess.lock import Lock, lock_of
from hilstar.assess.places import Scale
from hilstar.attitude.logs.telemetry import Telemetry, read_telemetry
from hilstar.bench.bench_file import BenchFile, bench_file_of
from hilstar.bench.config import BenchConfig
from hilstar.calibrate.attitude_pairs import COMMANDED, Pairs, refuse_conventions
from hilstar.errors import HilstarError, InputError
from hilstar.rotation import to_matrix, to_rotation_vector
from hilstar.run.record.commanded import Commanded, CommandedRun, read_commanded
from hilstar.run.record.ledger_records import config_of, read_head
from hilstar.units import ARCSEC_PER_RAD, NS_PER_S

AGREE_RAD = np.radians(1.0)  # half of the answers of one sky lie this near to one rotation
MAX_TURN_RAD = np.radians(5.0)  # from commanded to reported; a larger rotation is another frame
NEAR_AXES_RAD = np.radians(5.0)
MIN_PAIRS = 8
SEED = 0  # the bootstrap's seed: the same files give the same intervals
SMALL = 0.3  # share of the noise above which the display's own error gets a note
BENT_ARCSEC = 0.1
TOGETHER, SLOW_SHARE = 20, 0.1  # noise that lasts for so many answers gets a note from this share of the variance on
Stamp = Literal["start", "middle", "end"]
TO_MIDDLE = {"start": 0.5, "middle": 0.0, "end": -0.5}  # from the stamp to the middle, in exposures


@dataclass(frozen=True, slots=True)
class AssessSettings:
    """Where in an exposure times are stamped, how much later than that they are, s, and how many attitudes test the display."""

    stamp: Stamp = "middle"
    latency_s: float = 0.0
    display_attitudes: int = 12


@dataclass(frozen=True)
class RunLedger:
    """A run's commanded attitudes, and the bench that showed them."""

    path: Path
    head: dict[str, str]
    config: BenchConfig
    run: CommandedRun

    @property
    def commanded(self) -> Commanded:
        """The commanded attitudes, by seconds after the first frame."""
        return self.run.commanded

    @property
    def scale(self) -> Scale:
        """The tracker's sizes, by the bench file in the ledger."""
        tracker = self.config.tracker
        width, height = tracker.resolution_px
        return Scale(1e3 * tracker.focal_length_mm / tracker.pixel_pitch_um, (width, height))

    def bench_file(self) -> BenchFile:
        """The bench by its text in the ledger; the files that it names have to be where they were. Raises InputError."""
        return bench_file_of(Path(self.head.get("bench_file", "bench.toml")), self.head.get("bench_text", ""))


def read_ledger(path: Path) -> RunLedger:
    """Read a ledger. Raises InputError for a file that is none, for damage, and for a run without attitudes or bench file."""
    head, run = read_head(path), read_commanded(path)
    shown = run.commanded.shown
    if shown.sum() < 2:
        why = "operators' keys or a hidden window changed all of them" if run.changed else "none of them has an attitude"
        raise InputError(f"{path}: {len(shown)} frames, and {why}; give the ledger of a run that was sent attitudes")
    config = config_of(head)
    if config is None:
        raise InputError(f"{path}: its head holds no bench file that can be read; give the ledger of serve or replay --ledger")
    return RunLedger(path, head, config, run)


@dataclass(frozen=True, slots=True)
class WrongAnswer:
    """An answer that is no attitude of this sky: its row, its own time and the run's, s, and its error."""

    row: int
    t_s: float
    run_s: float
    off_deg: float


@dataclass(frozen=True)
class Assessment:
    """The whole assessment. `noise_arcsec` excludes the display's own error where the answers show it.

    `offset_s` is the tracker's clock minus the run's at the run's start.
    """

    run: RunLedger
    telemetry: Telemetry
    found: DecomposedRun
    noise_arcsec: Axes
    offset_s: float
    lock: Lock
    wrong: tuple[WrongAnswer, ...]
    display: DisplayCost | None
    by_rate: tuple[Slice, ...]
    by_magnitude: tuple[Slice, ...]
    t_s: FloatArray
    notes: tuple[str, ...]


def assess_files(
    ledger: Path, telemetry: Path, settings: AssessSettings, say: Callable[[str], None] = lambda _: None
) -> Assessment:
    """Assess telemetry against a ledger. Raises InputError with what is wrong with either."""
    answers, run = read_telemetry(telemetry), read_ledger(ledger)
    tau_s, base_s = tau_of(run, answers)
    tau_s = tau_s + TO_MIDDLE[settings.stamp] * run.config.tracker.exposure_s - settings.latency_s
    valid = np.flatnonzero(answers.valid)
    if len(valid) < MIN_ROWS:
        raise InputError(f"{telemetry}: {len(valid)} valid answers, and {MIN_ROWS} are needed; give longer telemetry")
    say("clock and parts of the error")
    coarse = matched(run, answers, tau_s[valid], answers.q[valid])
    try:
        found = assess_run(run.commanded, tau_s[valid], answers.q[valid], coarse, run.scale, np.random.default_rng(SEED))
    except InputError as refusal:
        raise InputError(f"{telemetry}: {refusal}") from refusal
    start_s = float(run.commanded.t_s[0])
    t_s = start_s + (tau_s - found.clock.offset_s - start_s) / (1 + found.clock.drift)
    right, wrong = np.zeros(len(t_s), dtype=np.bool_), np.zeros(len(t_s), dtype=np.bool_)
    right[valid[found.row]], wrong[valid[found.wrong]] = True, True
    effects = _bench_effects(run, found, settings, say)
    noise_arcsec, said = _without_display(found, effects.display)
    notes = [*found.notes, *_said_of_base(base_s), *_said_of_clock(found), *_said_of_bend(run, found), *_said_of_slow(found)]
    return Assessment(
        run=run,
        telemetry=answers,
        found=found,
        noise_arcsec=noise_arcsec,
        offset_s=found.clock.offset_s + base_s,
        lock=lock_of(run.commanded, t_s, right, wrong),
        wrong=_wrong(answers, found, t_s),
        display=effects.display,
        by_rate=effects.by_rate,
        by_magnitude=effects.by_magnitude,
        t_s=t_s,
        notes=(*notes, *effects.notes, *said),
    )


def tau_of(run: RunLedger, telemetry: Telemetry) -> tuple[FloatArray, float]:
    """The telemetry's times (n,), s, from the run's zero where the two overlap, else from their own first; and that base, s."""
    zero_ns = run.run.zero_ns
    end_ns = zero_ns + round(run.commanded.t_s[-1] * NS_PER_S)
    overlap = telemetry.t_ns[0] <= end_ns and telemetry.t_ns[-1] >= zero_ns
    base_ns = zero_ns if overlap else int(telemetry.t_ns[0])
    return (telemetry.t_ns - base_ns) / NS_PER_S, (base_ns - zero_ns) / NS_PER_S


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
    """Refuse (InputError) answers that agree with the run at these times by another convention."""
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
    """The axes that a large constant rotation (4,) stands for; "" where it is none of the 24 right-handed ways to name them."""
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


class _BenchEffects(NamedTuple):
    by_rate: tuple[Slice, ...]
    by_magnitude: tuple[Slice, ...] = ()
    display: DisplayCost | None = None
    notes: tuple[str, ...] = ()


def _bench_effects(run: RunLedger, found: Decomposed, settings: AssessSettings, say: Callable[[str], None]) -> _BenchEffects:
    """The error by rate and by magnitude, the display's own error, and notes on what could not be found."""
    parts = found.components
    error = parts.fov.fitted + parts.pixel.fitted + parts.left
    freedom = parts.fov.freedom + parts.pixel.freedom + 1
    rate_deg_s = np.degrees(np.linalg.norm(found.rate_rad_s, axis=1))
    effects = _BenchEffects(slices_of(rate_deg_s, parts.left, error, freedom))
    try:
        file = run.bench_file()
        say("the field's stars")
        by_magnitude = slices_of(field_magnitudes(file, found.commanded_q), parts.left, error, freedom)
        effects = effects._replace(by_magnitude=by_magnitude)
        if not settings.display_attitudes:
            return effects
        say("the display's own error")
        some = np.unique(np.linspace(0, len(found.row) - 1, settings.display_attitudes).astype(int))
        display = display_cost(display_errors(file, found.commanded_q[some]), parts.left[some])
        if display is None:
            note = "the display shows too few stars at once for an attitude: its own error was not found"
            return effects._replace(notes=(note,))
        return effects._replace(display=display)
    except HilstarError as refusal:
        note = f"neither the field's magnitude nor the display's own error could be found from the ledger: {refusal}"
        return effects._replace(notes=(note,))


def _wrong(answers: Telemetry, found: DecomposedRun, t_s: FloatArray) -> tuple[WrongAnswer, ...]:
    valid = np.flatnonzero(answers.valid)
    off = np.degrees(np.linalg.norm(found.clock.residual_arcsec, axis=1) / ARCSEC_PER_RAD)
    return tuple(
        WrongAnswer(int(answers.line[valid[k]]), int(answers.t_ns[valid[k]]) / 1e9, float(t_s[valid[k]]), float(off[k]))
        for k in found.wrong
    )


def _said_of_base(base_s: float) -> list[str]:
    if base_s == 0:
        return []
    return [
        f"the telemetry's times, {abs(base_s):.9g} s from the run's, do not overlap it: its clock is taken as one of its own"
    ]


def _said_of_clock(found: DecomposedRun) -> list[str]:
    clock = found.clock
    if clock.offset_told and clock.drift_told:
        return []
    if not clock.drift_told:
        return ["the run has no motion that tells the clock: offset and drift are not known, and times are taken as they are"]
    return [
        "the run turns at a constant rate: an offset of the clock cannot be told from a bias along the motion, and is taken to"
        f" be {1e3 * clock.offset_s:.3g} ms beside the rough one"
    ]


def _said_of_bend(run: RunLedger, found: DecomposedRun) -> list[str]:
    """A tracker averages over its exposure E: under an acceleration alpha that is alpha E^2 / 24 off the middle's attitude."""
    rate = ARCSEC_PER_RAD * found.rate_rad_s
    if len(rate) < MIN_ROWS:
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
    """Noise that lasts: a slow drift, or an error that changes over the field more sharply than the bumps do."""
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
    """The noise without the display's own error, and a note where that error is not small."""
    noise = found.noise_arcsec
    if display is None or noise.cross is None or noise.roll is None:
        return noise, []
    share = display.subtracted
    cost = np.array([display.cross_arcsec, display.cross_arcsec, display.roll_arcsec]) ** 2
    without = axes_of_variance(found.components.noise_variance - share * cost)
    if display.cross_arcsec <= SMALL * noise.cross and display.roll_arcsec <= SMALL * noise.roll:
        return without, []
    size = f"{display.cross_arcsec:.2g} arcsec across the boresight and {display.roll_arcsec:.2g} about it"
    says = f"the answers show {display.seen:.2f} +- {display.sigma_seen:.2f} of it"
    done = f"{100 * share:.0f} % of its variance are subtracted from the noise" if share else "nothing is subtracted"
    return without, [f"the display's own error is not small beside the noise: {size}; {says}, and {done}"]
