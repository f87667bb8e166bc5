"""A tracker's telemetry against the ledger of the run that it saw: matching, budget, lock, and the
bench's own errors.

Lock is availability, acquisition and loss: which of the answers that were due came.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hilstar.attitude.logs.telemetry import Telemetry, read_telemetry
from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.errors import HilstarError, InputError
from hilstar.basics.rotation import from_rotation_vector, multiply, to_matrix, to_rotation_vector
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.instruments.assess.bench_effects import (
    FILE,
    Centroids,
    DisplayCost,
    GlassCost,
    Slice,
    display_cost,
    display_errors,
    field_magnitudes,
    glass_cost,
    noise_limit,
    seen_cost,
    slices_of,
)
from hilstar.instruments.assess.budget import (
    Axes,
    Decomposed,
    DecomposedRun,
    assess_run,
    axes_of_variance,
)
from hilstar.instruments.assess.clock import CoarseClock, coarse_offset, speed_offsets
from hilstar.instruments.assess.components import MIN_ROWS
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.calibrate.attitude_pairs import COMMANDED, Pairs, refuse_conventions
from hilstar.server.answers.answer import JUMP_NS
from hilstar.server.answers.judge import TO_MIDDLE, AnswerRules, Stamp
from hilstar.server.bench.alignment import Turned, cube_to_boresight
from hilstar.server.bench.bench_file import BenchFile, bench_file_of
from hilstar.server.bench.certificate_file import (
    Certificate,
    CubeToBoresight,
    bench_certificate,
)
from hilstar.server.bench.config import BenchConfig
from hilstar.server.record.commanded import Commanded
from hilstar.server.record.commanded_run import NOT_SHOWN, CommandedRun, read_commanded
from hilstar.server.record.ledger_records import AnswerRecord, answer_records, config_of, read_head

MISSED_CYCLES = 1.5  # a longer time between right answers is an outage
LOST_CYCLES = 3.0  # in a longer outage the lock is lost
MAX_CYCLES = 20_000_000
AGREE_RAD = np.radians(1.0)  # half of the answers of one sky lie this near to one rotation
MAX_TURN_RAD = np.radians(5.0)  # from commanded to reported; a larger rotation is another frame
NEAR_AXES_RAD = np.radians(5.0)
MIN_PAIRS = 8
SEED = 0  # the bootstrap's seed: the same files give the same intervals
SMALL = 0.3  # share of the noise above which the display's own error gets a note
BENT_ARCSEC = 0.1
# noise that lasts for so many answers gets a note from this share of the variance on
TOGETHER, SLOW_SHARE = 20, 0.1
CLOCK_SET = (
    "the tracker's clock was set during the run: its answers are placed by their arrivals, not by"
    " their stamps"
)
# answers whose median shift against their arrivals is compared with the next ones'
SET_BLOCK, MAX_CLOCK_DRIFT = 11, 2e-3


@dataclass(frozen=True, slots=True)
class Outage:
    """A time without right answers: its start in run time and its length, s; `lost` if longer
    than LOST_CYCLES.
    """

    start_s: float
    length_s: float
    lost: bool
    rows: int
    wrong: int


@dataclass(frozen=True, slots=True)
class Acquisition:
    """The run time, s, at which a sky appeared, and the wait for the first right answer; None if
    none came before it went.
    """

    start_s: float
    wait_s: float | None


@dataclass(frozen=True)
class Lock:
    """The answers that were due and the right ones among them; `availability` is right over due."""

    cycle_s: float
    due: int
    right: int
    availability: float
    outages: tuple[Outage, ...]
    acquisitions: tuple[Acquisition, ...]

    @property
    def lost(self) -> tuple[Outage, ...]:
        """The outages in which the lock was lost."""
        return tuple(outage for outage in self.outages if outage.lost)

    @property
    def acquisition_probability(self) -> float | None:
        """The share of appearances of a sky and losses of lock after which a right answer came."""
        if not self.acquisitions:
            return None
        return sum(acquisition.wait_s is not None for acquisition in self.acquisitions) / len(
            self.acquisitions
        )

    @property
    def acquisition_s(self) -> float | None:
        """The median time until the first right answer."""
        waits = [
            acquisition.wait_s
            for acquisition in self.acquisitions
            if acquisition.wait_s is not None
        ]
        return float(np.median(waits)) if waits else None


def lock_of(commanded: Commanded, t_s: FloatArray, right: BoolArray, wrong: BoolArray) -> Lock:
    """The lock over rows at rising run times (n,): right answers, wrong ones, and rows without
    an answer.
    """
    cycle_s = max(float(np.median(np.diff(t_s))), 1e-6)
    cycle_s = max(cycle_s, float(t_s[-1] - t_s[0]) / MAX_CYCLES)
    due = commanded.at(np.arange(t_s[0], t_s[-1] + cycle_s / 2, cycle_s)).known
    outages = []
    for before, after in pairwise(np.flatnonzero(right).tolist()):
        gap_s = float(t_s[after] - t_s[before])
        if gap_s <= MISSED_CYCLES * cycle_s:
            continue
        inner = np.arange(t_s[before] + cycle_s, t_s[after] - cycle_s / 2, cycle_s)
        if len(inner) and commanded.at(inner).known.mean() > 0.5:
            length_s = gap_s - cycle_s
            rows = after - before - 1
            lost = length_s > LOST_CYCLES * cycle_s
            outages.append(
                Outage(float(inner[0]), length_s, lost, rows, int(wrong[before + 1 : after].sum()))
            )
    # After each appearance of the sky during the telemetry, and after each loss of the lock.
    acquisitions = []
    shown = np.flatnonzero(np.diff(np.r_[False, commanded.joined].astype(int)) == 1)
    ends = np.flatnonzero(np.diff(np.r_[commanded.joined, False].astype(int)) == -1) + 1
    answers = t_s[right]
    for first, last in zip(commanded.t_s[shown], commanded.t_s[ends], strict=True):
        if last > t_s[0] and first < t_s[-1]:
            first = max(first, t_s[0])  # what the tracker did before its first row is unknown
            inside = answers[(answers >= first) & (answers <= last)]
            acquisitions.append(
                Acquisition(float(first), float(inside[0] - first) if len(inside) else None)
            )
    acquisitions += [
        Acquisition(outage.start_s, outage.length_s) for outage in outages if outage.lost
    ]
    return Lock(
        cycle_s=cycle_s,
        due=int(due.sum()),
        right=int(right.sum()),
        availability=min(int(right.sum()) / max(int(due.sum()), 1), 1.0),
        outages=tuple(outages),
        acquisitions=tuple(sorted(acquisitions, key=lambda outage: outage.start_s)),
    )


@dataclass(frozen=True, slots=True)
class AssessSettings:
    """Where in an exposure times are stamped, their latency, s, and at how many attitudes the
    display is tested.

    Without a `stamp` it is the bench file's for its own answers, and the middle for a file's.
    """

    stamp: Stamp | None = None
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
        """The bench by its text in the ledger; the files that it names have to be where they
        were. Raises InputError.
        """
        return bench_file_of(
            Path(self.head.get("bench_file", "bench.toml")), self.head.get("bench_text", "")
        )


def read_ledger(path: Path) -> RunLedger:
    """Read a ledger. Raises InputError for a file that is none, for damage, and for a run
    without attitudes or bench file.
    """
    head = read_head(path)
    run = read_commanded(path)
    shown = run.commanded.shown
    if shown.sum() < 2:
        if run.changed:
            why = "operators' keys or a hidden window changed all of them"
        else:
            why = "none of them has an attitude"
        raise InputError(
            f"{path}: {len(shown)} frames, and {why}; give the ledger of a run that was sent"
            " attitudes"
        )
    config = config_of(head)
    if config is None:
        raise InputError(
            f"{path}: its head holds no bench file that can be read; give the ledger of serve or"
            " replay --ledger"
        )
    # A moment stands for an exposure about it; a refresh period more, for it is known to some
    # milliseconds.
    reach_s = config.tracker.exposure_s / 2 + 1 / config.monitor.refresh_hz
    return RunLedger(
        path, head, config, replace(run, commanded=run.commanded.over_exposures(reach_s))
    )


@dataclass(frozen=True, slots=True)
class WrongAnswer:
    """An answer that is no attitude of this sky: its row, its own time and the run's, s, and its
    error.
    """

    row: int
    t_s: float
    run_s: float
    off_deg: float


@dataclass(frozen=True)
class Assessment:
    """The whole assessment. `noise_arcsec` excludes the display's own error where the answers show
    it.

    `limit_arcsec` is the smallest noise that the tracker's stars allow, None where the bench cannot
    be read.

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
    limit_arcsec: Axes | None
    glass: GlassCost | None
    by_rate: tuple[Slice, ...]
    by_magnitude: tuple[Slice, ...]
    t_s: FloatArray
    notes: tuple[str, ...]
    certificate: Certificate | None = None
    out_of_order: int = 0
    cube: CubeToBoresight | None = None

    def __repr__(self) -> str:
        across = self.noise_arcsec.cross
        noise = "unknown" if across is None else f"{across:.2f} arcsec across"
        return f"<hilstar assessment: {len(self.t_s)} answers, noise {noise}>"

    @property
    def missed_line(self) -> str:
        """The run's missed frames and what they do to the budget, in words."""
        missed = self.run.run.missed
        held_s = self.run.commanded.held_s
        hold_s = self.run.commanded.hold_s
        if not missed:
            return "none"
        share = 100 * self.run.run.missed_share
        longest = int(np.argmax(hold_s)) if len(hold_s) else -1
        if longest >= 0:
            where = f", up to {hold_s[longest]:.3f} s about {held_s[longest].mean():.2f} s"
        else:
            where = ""
        touched = f"{len(self.found.held)} answers looked while a frame was held for them"
        return (
            f"{missed} ({share:.2g} % of refresh periods{where}); {touched}, and are in no figure"
            " but the availability"
        )


class LedgerAnswers(NamedTuple):
    """A ledger's own answers: where in an exposure their times are, and how far these are ahead of
    the run's, as known live.

    `centroids` are the stars that each of them holds. They are sorted by their times;
    `out_of_order` counts those that came after a later one. `clock_set` says that the tracker's
    clock was set in the run, and that arrivals count instead.
    """

    telemetry: Telemetry
    stamp: Stamp
    ahead_ns: int
    centroids: Sequence[Centroids]
    out_of_order: int = 0
    clock_set: bool = False


def read_answers(ledger: Path, stamp: Stamp) -> LedgerAnswers:
    """The answers that a run recorded, by the tracker's own times where it sends any. Raises
    InputError where it has none.
    """
    records = list(answer_records(ledger))
    if not any(record.valid and record.q is not None for record in records):
        if records:
            has = f"{len(records)} answers, none of them with an attitude"
        else:
            has = "no answers of a tracker"
        raise InputError(
            f"{ledger}: has {has}; give its telemetry too, or the ledger of a bench file with"
            " [answers]"
        )
    on_run_ns = _on_run_ns(records)
    stamped = stamp != "arrival" and all(record.t_ns is not None for record in records)
    t_ns = np.array([record.t_ns for record in records] if stamped else on_run_ns, dtype=np.int64)
    clock_set = stamped and _clock_was_set(
        t_ns, np.array([record.host_ns for record in records], dtype=np.int64)
    )
    if clock_set or not stamped:
        t_ns = on_run_ns
        stamp = "middle"
    if stamped and not clock_set:
        overtaken = int((t_ns[1:] < np.maximum.accumulate(t_ns)[:-1]).sum())
    else:
        overtaken = 0
    # By their times, for a datagram may be overtaken; of one time the first that came.
    rising_ns, order = np.unique(t_ns, return_index=True)
    ordered = [records[k] for k in order.tolist()]
    valid = np.array([record.valid and record.q is not None for record in ordered], dtype=np.bool_)
    q = np.array(
        [NOT_SHOWN if record.q is None else record.q for record in ordered], dtype=np.float64
    )
    telemetry = Telemetry(ledger, rising_ns, q, valid, order + 1, of_lines=False)
    ahead_ns = int(np.median(t_ns - on_run_ns))
    centroids = [record.centroids for record in ordered]
    return LedgerAnswers(telemetry, stamp, ahead_ns, centroids, overtaken, clock_set)


def _on_run_ns(records: Sequence[AnswerRecord]) -> IntArray:
    """When each answer (n,) looked, on the run's clock, ns, as it was known live; of one not
    judged by the others' delay.
    """
    judged = [record for record in records if record.verdict != "unjudged"]
    late_ns = [record.host_ns - record.middle_ns for record in judged]
    usual_ns = int(np.median(late_ns)) if late_ns else 0
    to_light_ns = [
        record.light_ns - record.middle_ns for record in judged if record.light_ns is not None
    ]
    middle_ns = [
        record.host_ns - usual_ns if record.verdict == "unjudged" else record.middle_ns
        for record in records
    ]
    return np.array(middle_ns, dtype=np.int64) + (int(np.median(to_light_ns)) if to_light_ns else 0)


def _clock_was_set(t_ns: IntArray, host_ns: IntArray) -> bool:
    """Whether stamps (n,) step against arrivals (n,) for good; where an answer was overtaken the
    next one is as before.
    """
    blocks = len(t_ns) // SET_BLOCK
    if blocks < 2:
        return False
    rows = slice(0, blocks * SET_BLOCK)
    ahead_ns = np.median((t_ns - host_ns)[rows].reshape(blocks, SET_BLOCK), axis=1)
    passed_ns = np.diff(np.median(host_ns[rows].reshape(blocks, SET_BLOCK), axis=1))
    return bool((np.abs(np.diff(ahead_ns)) > JUMP_NS + MAX_CLOCK_DRIFT * np.abs(passed_ns)).any())


def assess_files(ledger: Path, telemetry: Path | None, settings: AssessSettings) -> Assessment:
    """Assess telemetry, or the ledger's own answers, against a ledger. Raises InputError for a
    fault of either.
    """
    run = read_ledger(ledger)
    zero_ns, start_s, end_s = (
        run.run.zero_ns,
        float(run.commanded.t_s[0]),
        float(run.commanded.t_s[-1]),
    )
    centroids: Sequence[Centroids] = ()
    overlap, out_of_order, clock_set = True, 0, False
    if telemetry is None:
        answer_record = read_answers(ledger, settings.stamp or AnswerRules.of(run.config).stamp)
        answers, stamp, ahead_ns, centroids, out_of_order, clock_set = answer_record
        base_ns, telemetry = zero_ns + ahead_ns, ledger
    else:
        answers, stamp = read_telemetry(telemetry), settings.stamp or "middle"
        # The telemetry's times from the run's zero where the two overlap, else from their own
        # first.
        overlap = (
            answers.t_ns[0] <= zero_ns + round(end_s * NS_PER_S) and answers.t_ns[-1] >= zero_ns
        )
        base_ns = zero_ns if overlap else int(answers.t_ns[0])
    base_s = (base_ns - zero_ns) / NS_PER_S
    tau_s = (
        (answers.t_ns - base_ns) / NS_PER_S
        + TO_MIDDLE[stamp] * run.config.tracker.exposure_s
        - settings.latency_s
    )
    valid = np.flatnonzero(answers.valid)
    if len(valid) < MIN_ROWS:
        raise InputError(
            f"{telemetry}: {len(valid)} valid answers, and {MIN_ROWS} are needed; give longer"
            " telemetry"
        )
    coarse = matched(run, answers, tau_s[valid], answers.q[valid])
    try:
        error_budget = assess_run(
            run.commanded,
            tau_s[valid],
            answers.q[valid],
            coarse,
            run.scale,
            np.random.default_rng(SEED),
        )
    except InputError as refusal:
        raise InputError(f"{telemetry}: {refusal}") from refusal
    t_s = start_s + (tau_s - error_budget.clock.offset_s - start_s) / (1 + error_budget.clock.drift)
    right, wrong = np.zeros(len(t_s), dtype=np.bool_), np.zeros(len(t_s), dtype=np.bool_)
    (
        right[valid[error_budget.row]],
        right[valid[error_budget.held]],
        wrong[valid[error_budget.wrong]],
    ) = True, True, True
    off_deg = np.degrees(
        np.linalg.norm(error_budget.clock.residual_arcsec, axis=1) / ARCSEC_PER_RAD
    )
    notes = [
        *_notes(run, error_budget, 0.0 if overlap else base_s),
        *([CLOCK_SET] if clock_set else []),
    ]
    # The error by rate and by magnitude, and the display's own.
    parts = error_budget.components
    error = parts.fov.fitted + parts.pixel.fitted + parts.left
    freedom = parts.fov.freedom + parts.pixel.freedom + 1
    by_rate = slices_of(
        np.degrees(np.linalg.norm(error_budget.rate_rad_s, axis=1)), parts.left, error, freedom
    )
    by_magnitude: tuple[Slice, ...] = ()
    display = limit = glass = certificate = cube = None
    try:
        file = run.bench_file()
        certificate = bench_certificate(file)
        cube = _cube_of(file, certificate, error_budget)
        by_magnitude = slices_of(
            field_magnitudes(file, error_budget.commanded_q), parts.left, error, freedom
        )
        limit = noise_limit(file, error_budget.commanded_q)
        glass, told_by = _glass_of(
            file,
            error_budget,
            [centroids[row] for row in valid[error_budget.row]] if any(centroids) else (),
        )
        notes += told_by
        if settings.display_attitudes:
            some = np.unique(
                np.linspace(0, len(error_budget.row) - 1, settings.display_attitudes).astype(int)
            )
            display = display_cost(
                display_errors(file, error_budget.commanded_q[some]), parts.left[some]
            )
            if display is None:
                notes.append(
                    "the display shows too few stars at once for an attitude: its own error was not"
                    " found"
                )
    except HilstarError as refusal:
        notes.append(
            "neither the field's magnitude nor the display's own error could be found from the"
            f" ledger: {refusal}"
        )
    noise_arcsec, display_note = _without_display(error_budget, display)
    return Assessment(
        run=run,
        telemetry=answers,
        found=error_budget,
        noise_arcsec=noise_arcsec,
        offset_s=error_budget.clock.offset_s + base_s,
        lock=lock_of(run.commanded, t_s, right, wrong),
        wrong=tuple(
            WrongAnswer(
                int(answers.line[at]),
                int(answers.t_ns[at]) / 1e9,
                float(t_s[at]),
                float(off_deg[k]),
            )
            for k, at in zip(error_budget.wrong, valid[error_budget.wrong], strict=True)
        ),
        display=display,
        limit_arcsec=limit,
        glass=glass,
        by_rate=by_rate,
        by_magnitude=by_magnitude,
        t_s=t_s,
        notes=(*notes, *display_note),
        certificate=certificate,
        out_of_order=out_of_order,
        cube=cube,
    )


def _cube_of(
    file: BenchFile, certificate: Certificate | None, found: DecomposedRun
) -> CubeToBoresight | None:
    """From the alignment reference to the boresight of a tracker with this bias."""
    low, high = found.intervals.bias
    turned = Turned(found.bias_arcsec, (high - low) / 2)
    return cube_to_boresight(file, certificate, turned)


def _glass_of(
    file: BenchFile, found: DecomposedRun, centroids: Sequence[Centroids]
) -> tuple[GlassCost | None, list[str]]:
    """What the glass costs, by the stars of the right answers where these have enough; a note
    where the PSF file tells it.
    """
    turned = multiply(from_rotation_vector(found.bias_arcsec / ARCSEC_PER_RAD), found.commanded_q)
    cost = seen_cost(file, turned, centroids) or glass_cost(file, found.commanded_q)
    if cost is None or cost.source != FILE:
        return cost, []
    if centroids:
        has = "name too few stars"
    else:
        has = "hold only attitudes, which cannot tell colour from distortion"
    return cost, [f"the answers {has}: what the glass costs is told by the PSF file"]


def matched(run: RunLedger, telemetry: Telemetry, tau_s: FloatArray, q: FloatArray) -> CoarseClock:
    """Where valid answers (n, 4) at times (n,) lie on the run's clock.

    Raises InputError for other conventions than hilstar's, for another frame, and for answers of
    another run.
    """
    commanded = run.commanded
    coarse = coarse_offset(commanded, tau_s, q)
    if coarse is not None and coarse.spread_rad <= AGREE_RAD:
        agreed = coarse
    else:
        agreed = None
    if agreed is not None and agreed.turn_rad <= MAX_TURN_RAD:
        return agreed
    turned = ""
    if agreed is not None:
        turn = to_rotation_vector(agreed.rotation)
        angle = float(np.linalg.norm(turn))
        axis = ",".join(f"{value:.3f}" for value in turn / max(angle, 1e-12))
        turned = (
            f"{telemetry.path}: the reported attitudes are turned by {np.degrees(angle):.4g}"
            f" degrees about {axis} (cam) from the commanded ones"
        )
        # The nearest rotation that only names the axes otherwise, of which there are 24.
        matrix = to_matrix(agreed.rotation)
        nearest = np.zeros((3, 3))
        column = np.argmax(np.abs(matrix), axis=1)
        nearest[range(3), column] = np.sign(matrix[range(3), column])
        off = np.arccos(np.clip((np.trace(matrix @ nearest.T) - 1) / 2, -1, 1))
        if abs(np.linalg.det(nearest) - 1) <= 1e-9 and off <= NEAR_AXES_RAD:
            signs = ["-" if row.sum() < 0 else "+" for row in nearest]
            axes = ", ".join(
                f"{letter} = {sign}{'xyz'[k]}"
                for letter, sign, k in zip("xyz", signs, column, strict=True)
            )
            cure = "write them for x right, y down in the image, z boresight"
            raise InputError(f"{turned}: they fit axes with {axes} of hilstar's; {cure}")
    offsets = [] if coarse is None else [coarse.offset_s]
    for offset in [*offsets, *speed_offsets(commanded, tau_s, q).tolist()]:
        _refuse(run, telemetry, tau_s + offset, q)
    if agreed is not None:
        w, x, y, z = (float(value) for value in agreed.rotation * [1, -1, -1, -1])
        cure = f"turn them back by the quaternion {w:.6f},{x:.6f},{y:.6f},{z:.6f} from the left"
        raise InputError(f"{turned}: another frame or mounting; {cure}")
    raise InputError(
        f"{telemetry.path}: at no offset of its clock do the reported attitudes follow those of"
        f" {run.path}, lit for {commanded.t_s[-1]:.6g} s; give the telemetry of this run, of which"
        " no more than half may be wild"
    )


def _refuse(run: RunLedger, telemetry: Telemetry, t_s: FloatArray, q: FloatArray) -> None:
    """Refuse (InputError) answers that agree with the run at these times by another convention."""
    moments = run.commanded.at(t_s)
    if moments.known.sum() < max(MIN_PAIRS, 0.1 * len(t_s)):
        return
    rows = np.flatnonzero(moments.known)
    pairs = Pairs(
        telemetry.path,
        telemetry.line[telemetry.valid][rows],
        moments.q[rows],
        q[rows],
        names=COMMANDED,
    )
    try:
        refuse_conventions(
            pairs, float(np.arctan(0.5 * np.hypot(*run.scale.resolution_px) / run.scale.focal_px))
        )
    except InputError as refusal:
        if "wild" not in str(refusal) and "out of view" not in str(refusal):
            raise


def _notes(run: RunLedger, found: DecomposedRun, base_s: float) -> list[str]:
    """What a reader of the budget has to know beside its figures."""
    notes = [*found.notes]
    clock = found.clock
    parts = found.components
    if base_s:
        notes.append(
            f"the telemetry's times, {abs(base_s):.9g} s from the run's, do not overlap it: its"
            " clock is taken as one of its own"
        )
    if not clock.drift_told:
        notes.append(
            "the run has no motion that tells the clock: offset and drift are not known, and times"
            " are taken as they are"
        )
    elif not clock.offset_told:
        notes.append(
            "the run turns at a constant rate: an offset of the clock cannot be told from a bias"
            f" along the motion, and is taken to be {1e3 * clock.offset_s:.3g} ms beside the"
            " rough one"
        )
    # A tracker averages over its exposure E: under an acceleration alpha that is alpha E^2 / 24 off
    # the middle's attitude.
    step_s = np.diff(clock.t_s[found.row])
    near = step_s < 1.0
    if len(found.row) >= MIN_ROWS and near.any():
        change = np.linalg.norm(np.diff(ARCSEC_PER_RAD * found.rate_rad_s, axis=0)[near], axis=1)
        bent = (
            float(np.percentile(change / step_s[near], 99)) * run.config.tracker.exposure_s**2 / 24
        )
        if bent >= BENT_ARCSEC:
            notes.append(
                "in an exposure the attitude's mean differs from that in its middle by up to"
                f" {bent:.2g} arcsec"
            )
    # Noise that lasts: a slow drift, or an error that changes over the field more sharply than the
    # bumps do.
    rows = len(parts.left) // TOGETHER * TOGETHER
    if rows >= MIN_ROWS * TOGETHER:
        means = parts.left[:rows].reshape(-1, TOGETHER, 3).mean(axis=1)
        slow = (means**2).mean(axis=0) - parts.noise_variance / TOGETHER
        if (slow / np.maximum(parts.noise_variance, 1e-12)).max() >= SLOW_SHARE:
            size = axes_of_variance(slow)
            notes.append(
                f"the noise is not white: {size.cross:.2g} arcsec across the boresight and"
                f" {size.roll:.2g} about it last for {TOGETHER} answers and more, besides"
                f" {parts.fov.detail or 'the bias'}: does the alignment drift with time, or does"
                " the field-of-view error jump somewhere?"
            )
    return notes


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
    size = (
        f"{display.cross_arcsec:.2g} arcsec across the boresight and {display.roll_arcsec:.2g}"
        " about it"
    )
    says = f"the answers show {display.seen:.2f} +- {display.sigma_seen:.2f} of it"
    if share:
        done = f"{100 * share:.0f} % of its variance are subtracted from the noise"
    else:
        done = "nothing is subtracted"
    return without, [
        f"the display's own error is not small beside the noise: {size}; {says}, and {done}"
    ]
