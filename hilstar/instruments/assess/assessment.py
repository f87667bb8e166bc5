"""A tracker's telemetry against the ledger of the run that it saw: matching, budget, lock, and the
bench's own errors.

Lock is availability, acquisition and loss: which of the answers that were due came.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hilstar.attitude.logs.telemetry import NO_RATE, Telemetry, read_telemetry
from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.errors import HilstarError, InputError
from hilstar.basics.rotation import (
    conjugate,
    from_rotation_vector,
    multiply,
    to_matrix,
    to_rotation_vector,
)
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
from hilstar.instruments.assess.further import (
    FurtherFigures,
    add_jitter,
    add_rates,
    add_stars,
)
from hilstar.instruments.assess.places import Scale, spread_rows
from hilstar.instruments.calibrate.attitude_pairs import COMMANDED, Pairs, refuse_conventions
from hilstar.server.answers.answer import JUMP_NS, ReportedStar
from hilstar.server.answers.formats import reported_stars
from hilstar.server.answers.judge import TO_MIDDLE, AnswerRules, Stamp
from hilstar.server.answers.stars import ShownStars
from hilstar.server.bench.alignment import Turned, cube_to_boresight
from hilstar.server.bench.bench_file import BenchFile, bench_file_of
from hilstar.server.bench.build import open_bench
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
HIDDEN = 1.5  # upper end of an interval over the figure, from which on a note says what hides it
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
        return len(self._waits_s) / len(self.acquisitions)

    @property
    def acquisition_s(self) -> float | None:
        """The median time until the first right answer."""
        if not self._waits_s:
            return None
        return float(np.median(self._waits_s))

    @property
    def _waits_s(self) -> list[float]:
        """The waits that ended in a right answer."""
        waits_s = []
        for acquisition in self.acquisitions:
            if acquisition.wait_s is not None:
                waits_s.append(acquisition.wait_s)
        return waits_s


def lock_of(commanded: Commanded, t_s: FloatArray, right: BoolArray, wrong: BoolArray) -> Lock:
    """The lock over rows at rising run times (n,): right answers, wrong ones, and rows without
    an answer.
    """
    cycle_s = max(float(np.median(np.diff(t_s))), 1e-6)
    span_s = float(t_s[-1] - t_s[0])
    cycle_s = max(cycle_s, span_s / MAX_CYCLES)
    due_s = np.arange(t_s[0], t_s[-1] + cycle_s / 2, cycle_s)
    due = int(commanded.at(due_s).known.sum())
    right_count = int(right.sum())
    outages = _outages(commanded, t_s, right, wrong, cycle_s)
    # After each appearance of the sky during the telemetry, and after each loss of the lock.
    acquisitions = _acquisitions(commanded, t_s, right)
    for outage in outages:
        if outage.lost:
            acquisitions.append(Acquisition(outage.start_s, outage.length_s))
    acquisitions.sort(key=lambda acquisition: acquisition.start_s)
    return Lock(
        cycle_s=cycle_s,
        due=due,
        right=right_count,
        availability=min(right_count / max(due, 1), 1.0),
        outages=tuple(outages),
        acquisitions=tuple(acquisitions),
    )


def _outages(
    commanded: Commanded, t_s: FloatArray, right: BoolArray, wrong: BoolArray, cycle_s: float
) -> list[Outage]:
    """The times without right answers while a sky was shown for more than half of them."""
    outages = []
    for before, after in pairwise(np.flatnonzero(right).tolist()):
        gap_s = float(t_s[after] - t_s[before])
        if gap_s <= MISSED_CYCLES * cycle_s:
            continue
        inner_s = np.arange(t_s[before] + cycle_s, t_s[after] - cycle_s / 2, cycle_s)
        if not len(inner_s) or commanded.at(inner_s).known.mean() <= 0.5:
            continue
        start_s = float(inner_s[0])
        length_s = gap_s - cycle_s
        is_lost = length_s > LOST_CYCLES * cycle_s
        rows = after - before - 1
        wrong_rows = int(wrong[before + 1 : after].sum())
        outages.append(Outage(start_s, length_s, is_lost, rows, wrong_rows))
    return outages


def _acquisitions(commanded: Commanded, t_s: FloatArray, right: BoolArray) -> list[Acquisition]:
    """The wait after each appearance of the sky during the telemetry."""
    appears = np.diff(np.r_[False, commanded.joined].astype(int)) == 1
    goes = np.diff(np.r_[commanded.joined, False].astype(int)) == -1
    starts_s = commanded.t_s[np.flatnonzero(appears)]
    ends_s = commanded.t_s[np.flatnonzero(goes) + 1]
    right_s = t_s[right]
    acquisitions = []
    for start_s, end_s in zip(starts_s, ends_s, strict=True):
        if end_s <= t_s[0] or start_s >= t_s[-1]:
            continue
        start_s = max(start_s, t_s[0])  # what the tracker did before its first row is unknown
        inside_s = right_s[(right_s >= start_s) & (right_s <= end_s)]
        wait_s = None
        if len(inside_s):
            wait_s = float(inside_s[0] - start_s)
        acquisitions.append(Acquisition(float(start_s), wait_s))
    return acquisitions


@dataclass(frozen=True, slots=True)
class AssessSettings:
    """Where in an exposure times are stamped, their latency, s, and at how many attitudes the
    display is tested.

    Without a `stamp` the run's own answers are stamped as the bench file says, and those of a file
    at the middle.
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
        focal_px = 1e3 * tracker.focal_length_mm / tracker.pixel_pitch_um
        return Scale(focal_px, (width, height))

    def bench_file(self) -> BenchFile:
        """The bench by its text in the ledger; the files that it names have to be where they
        were. Raises InputError.
        """
        path = Path(self.head.get("bench_file", "bench.toml"))
        return bench_file_of(path, self.head.get("bench_text", ""))


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
    exposed = run.commanded.over_exposures(reach_s)
    return RunLedger(path, head, config, replace(run, commanded=exposed))


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

    `offset_s` is the tracker's clock minus the run's at the run's start. `further` are the figures
    of what answers carry beside the attitude.
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
    further: FurtherFigures = field(default_factory=FurtherFigures)

    def __repr__(self) -> str:
        across = self.noise_arcsec.cross
        noise = "unknown" if across is None else f"{across:.2f} arcsec across"
        return f"<hilstar assessment: {len(self.t_s)} answers, noise {noise}>"

    @property
    def missed_line(self) -> str:
        """The run's missed frames and what they do to the budget, in words."""
        missed = self.run.run.missed
        if not missed:
            return "none"
        percent = 100 * self.run.run.missed_share
        share = f"{percent:.2g} % of refresh periods"
        hold_s = self.run.commanded.hold_s
        if len(hold_s):
            longest = int(np.argmax(hold_s))
            middle_s = self.run.commanded.held_s[longest].mean()
            share = f"{share}, up to {hold_s[longest]:.3f} s about {middle_s:.2f} s"
        touched = f"answers that looked while a frame was held for them: {len(self.found.held)}"
        return f"{missed} ({share}); {touched}, in no figure but the availability"


class LedgerAnswers(NamedTuple):
    """A ledger's own answers, where in an exposure they are stamped, and how far the tracker's
    clock is ahead of the run's, as it was known live.

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
    t_ns = on_run_ns
    overtaken = 0
    clock_set = False
    stamps_ns = [record.t_ns for record in records]
    if stamp == "arrival" or None in stamps_ns:
        stamp = "middle"
    else:
        t_ns = np.array(stamps_ns, dtype=np.int64)
        host_ns = np.array([record.host_ns for record in records], dtype=np.int64)
        clock_set = _clock_was_set(t_ns, host_ns)
        if clock_set:
            t_ns = on_run_ns
            stamp = "middle"
        else:
            latest_ns = np.maximum.accumulate(t_ns)[:-1]
            overtaken = int((t_ns[1:] < latest_ns).sum())
    # By their times, for a datagram may be overtaken; of one time the first that came.
    rising_ns, order = np.unique(t_ns, return_index=True)
    valid = []
    q = []
    rates_rad_s = []
    centroids = []
    for k in order.tolist():
        record = records[k]
        centroids.append([ReportedStar(*star) for star in record.centroids])
        rates_rad_s.append(record.rate or NO_RATE)
        if record.q is None:
            valid.append(False)
            q.append(NOT_SHOWN)
        else:
            valid.append(record.valid)
            q.append(record.q)
    telemetry = Telemetry(
        ledger,
        rising_ns,
        np.array(q, dtype=np.float64),
        np.array(valid, dtype=np.bool_),
        order + 1,
        of_lines=False,
        rate_cam_rad_s=np.array(rates_rad_s, dtype=np.float64),
    )
    ahead_ns = int(np.median(t_ns - on_run_ns))
    return LedgerAnswers(telemetry, stamp, ahead_ns, centroids, overtaken, clock_set)


def _on_run_ns(records: Sequence[AnswerRecord]) -> IntArray:
    """The time of each answer's exposure (n,) on the run's clock, ns, as it was known live; that of
    an answer that was not judged follows from the delay of the others.
    """
    late_ns = []
    to_light_ns = []
    for record in records:
        if record.verdict == "unjudged":
            continue
        late_ns.append(record.host_ns - record.middle_ns)
        if record.light_ns is not None:
            to_light_ns.append(record.light_ns - record.middle_ns)
    usual_late_ns = _median_ns(late_ns)
    middle_ns = []
    for record in records:
        if record.verdict == "unjudged":
            middle_ns.append(record.host_ns - usual_late_ns)
        else:
            middle_ns.append(record.middle_ns)
    return np.array(middle_ns, dtype=np.int64) + _median_ns(to_light_ns)


def _median_ns(times_ns: Sequence[int]) -> int:
    """The median, cut to a whole number; 0 of none."""
    if not times_ns:
        return 0
    return int(np.median(times_ns))


def _clock_was_set(t_ns: IntArray, host_ns: IntArray) -> bool:
    """Whether stamps (n,) step against arrivals (n,) for good; where an answer was overtaken the
    next one is as before.
    """
    blocks = len(t_ns) // SET_BLOCK
    if blocks < 2:
        return False
    rows = slice(0, blocks * SET_BLOCK)
    ahead_ns = (t_ns - host_ns)[rows].reshape(blocks, SET_BLOCK)
    arrived_ns = host_ns[rows].reshape(blocks, SET_BLOCK)
    step_ns = np.abs(np.diff(np.median(ahead_ns, axis=1)))
    passed_ns = np.abs(np.diff(np.median(arrived_ns, axis=1)))
    largest_ns = JUMP_NS + MAX_CLOCK_DRIFT * passed_ns
    return bool((step_ns > largest_ns).any())


@dataclass(frozen=True)
class TimedAnswers:
    """Answers of a file or of the ledger, with the middles of their exposures, `tau_s` (n,), on the
    tracker's clock.

    `tau_s` counts from a reading `base_s` above the run's zero. `overlap` is whether the answers'
    times meet the run's.
    """

    path: Path
    answers: Telemetry
    tau_s: FloatArray
    base_s: float
    overlap: bool = True
    centroids: Sequence[Centroids] = ()
    out_of_order: int = 0
    clock_set: bool = False


@dataclass
class BenchFigures:
    """What the bench tells beside the budget, with notes; None or empty where it could not be
    built.
    """

    by_magnitude: tuple[Slice, ...] = ()
    display: DisplayCost | None = None
    limit_arcsec: Axes | None = None
    glass: GlassCost | None = None
    certificate: Certificate | None = None
    cube: CubeToBoresight | None = None
    notes: list[str] = field(default_factory=list)


def assess_files(ledger: Path, telemetry: Path | None, settings: AssessSettings) -> Assessment:
    """Assess telemetry, or the ledger's own answers, against a ledger. Raises InputError for a
    fault of either.
    """
    run = read_ledger(ledger)
    if telemetry is None:
        timed = _answers_of_ledger(run, settings)
    else:
        timed = _answers_of_file(run, telemetry, settings)
    answers = timed.answers
    tau_s = timed.tau_s
    valid = np.flatnonzero(answers.valid)
    error_budget = _budget_of(run, timed, valid)
    clock = error_budget.clock
    t_s = clock.run_s(tau_s, float(run.commanded.t_s[0]))
    right_rows = valid[error_budget.row]
    right, wrong = _right_and_wrong(error_budget, valid, len(t_s))
    further = FurtherFigures()
    add_rates(further, answers, run.commanded, error_budget)
    add_jitter(further, error_budget)
    notes = _notes(run, error_budget, timed)
    rate_deg_s = np.degrees(np.linalg.norm(error_budget.rate_rad_s, axis=1))
    by_rate = _slices_by(rate_deg_s, error_budget)
    right_centroids = []
    if any(timed.centroids):
        right_centroids = [timed.centroids[row] for row in right_rows.tolist()]
    bench = BenchFigures()
    try:
        _look_at_bench(bench, run, error_budget, right_centroids, settings)
        if right_centroids:
            with open_bench(run.bench_file()) as opened:
                add_stars(further, ShownStars(opened), right_centroids, error_budget)
    except HilstarError as refusal:
        bench.notes.append(
            "neither the field's magnitude nor the display's own error, nor single stars' figures,"
            f" could be found from the ledger: {refusal}"
        )
    noise_arcsec, display_note = _without_display(error_budget, bench.display)
    return Assessment(
        run=run,
        telemetry=answers,
        found=error_budget,
        noise_arcsec=noise_arcsec,
        offset_s=clock.offset_s + timed.base_s,
        lock=lock_of(run.commanded, t_s, right, wrong),
        wrong=tuple(_wrong_answers(answers, error_budget, valid, t_s)),
        display=bench.display,
        limit_arcsec=bench.limit_arcsec,
        glass=bench.glass,
        by_rate=by_rate,
        by_magnitude=bench.by_magnitude,
        t_s=t_s,
        notes=(*notes, *further.notes, *bench.notes, *display_note),
        certificate=bench.certificate,
        out_of_order=timed.out_of_order,
        cube=bench.cube,
        further=further,
    )


def _right_and_wrong(
    found: DecomposedRun, valid: IntArray, count: int
) -> tuple[BoolArray, BoolArray]:
    """Which of so many rows (count,) are right answers and which wrong ones, of which `valid` (k,)
    were assessed. An answer that looked while a frame was held came, and was not wrong.
    """
    right = np.zeros(count, dtype=np.bool_)
    right[valid[found.row]] = True
    right[valid[found.held]] = True
    wrong = np.zeros(count, dtype=np.bool_)
    wrong[valid[found.wrong]] = True
    return right, wrong


def _answers_of_ledger(run: RunLedger, settings: AssessSettings) -> TimedAnswers:
    """The ledger's own answers, by their times as far as these are ahead of the run's."""
    stamp = settings.stamp or AnswerRules.of(run.config).stamp
    record = read_answers(run.path, stamp)
    zero_ns = run.run.zero_ns
    base_ns = zero_ns + record.ahead_ns
    return TimedAnswers(
        run.path,
        record.telemetry,
        _tau_s(run, record.telemetry, base_ns, record.stamp, settings),
        (base_ns - zero_ns) / NS_PER_S,
        centroids=record.centroids,
        out_of_order=record.out_of_order,
        clock_set=record.clock_set,
    )


def _answers_of_file(run: RunLedger, path: Path, settings: AssessSettings) -> TimedAnswers:
    """A file's answers: their times from the run's zero where the two overlap, else from their own
    first.
    """
    answers = read_telemetry(path)
    stamp = settings.stamp or "middle"
    zero_ns = run.run.zero_ns
    end_s = float(run.commanded.t_s[-1])
    end_ns = zero_ns + round(end_s * NS_PER_S)
    first_ns = int(answers.t_ns[0])
    last_ns = int(answers.t_ns[-1])
    overlap = first_ns <= end_ns and last_ns >= zero_ns
    base_ns = zero_ns
    if not overlap:
        base_ns = first_ns
    tau_s = _tau_s(run, answers, base_ns, stamp, settings)
    base_s = (base_ns - zero_ns) / NS_PER_S
    centroids = [reported_stars(rows) for rows in answers.star_rows]
    return TimedAnswers(path, answers, tau_s, base_s, overlap, centroids)


def _tau_s(
    run: RunLedger, answers: Telemetry, base_ns: int, stamp: Stamp, settings: AssessSettings
) -> FloatArray:
    """The middles of the answers' exposures (n,) after a time of the tracker's clock."""
    to_middle_s = TO_MIDDLE[stamp] * run.config.tracker.exposure_s
    stamped_s = (answers.t_ns - base_ns) / NS_PER_S
    return np.asarray(stamped_s + to_middle_s - settings.latency_s)


def _budget_of(run: RunLedger, timed: TimedAnswers, valid: IntArray) -> DecomposedRun:
    """The budget of the valid answers, rows (k,). Raises InputError."""
    if len(valid) < MIN_ROWS:
        raise InputError(
            f"{timed.path}: {len(valid)} valid answers, and {MIN_ROWS} are needed; give longer"
            " telemetry"
        )
    tau_s = timed.tau_s[valid]
    q = timed.answers.q[valid]
    coarse = matched(run, timed.answers, tau_s, q)
    rng = np.random.default_rng(SEED)
    try:
        return assess_run(run.commanded, tau_s, q, coarse, run.scale, rng)
    except InputError as refusal:
        raise InputError(f"{timed.path}: {refusal}") from refusal


def _slices_by(value: FloatArray, found: DecomposedRun) -> tuple[Slice, ...]:
    """Noise and error of the right answers by a value (k,) of each."""
    parts = found.components
    error = parts.fov.fitted + parts.pixel.fitted + parts.left
    freedom = parts.fov.freedom + parts.pixel.freedom + 1
    return slices_of(value, parts.left, error, freedom)


def _look_at_bench(
    bench: BenchFigures,
    run: RunLedger,
    found: DecomposedRun,
    centroids: Sequence[Centroids],
    settings: AssessSettings,
) -> None:
    """Fill in what the bench tells, as far as it can be built. Raises HilstarError."""
    file = run.bench_file()
    bench.certificate = bench_certificate(file)
    bench.cube = _cube_of(file, bench.certificate, found)
    field_mag = field_magnitudes(file, found.commanded_q)
    bench.by_magnitude = _slices_by(field_mag, found)
    bench.limit_arcsec = noise_limit(file, found.commanded_q)
    bench.glass, glass_notes = _glass_of(file, found, centroids)
    bench.notes += glass_notes
    if not settings.display_attitudes:
        return
    some = spread_rows(len(found.row), settings.display_attitudes)
    display_arcsec = display_errors(file, found.commanded_q[some])
    bench.display = display_cost(display_arcsec, found.components.left[some])
    if bench.display is None:
        bench.notes.append(
            "the display shows too few stars at once for an attitude: its own error was not found"
        )


def _wrong_answers(
    answers: Telemetry, found: DecomposedRun, valid: IntArray, t_s: FloatArray
) -> Iterator[WrongAnswer]:
    """The wrong ones of answers with run times (n,), of which `valid` (k,) were assessed."""
    off_rad = np.linalg.norm(found.clock.residual_arcsec, axis=1) / ARCSEC_PER_RAD
    off_deg = np.degrees(off_rad)
    for k in found.wrong.tolist():
        row = valid[k]
        line = int(answers.line[row])
        own_s = int(answers.t_ns[row]) / 1e9
        yield WrongAnswer(line, own_s, float(t_s[row]), float(off_deg[k]))


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
    bias = from_rotation_vector(found.bias_arcsec / ARCSEC_PER_RAD)
    turned = multiply(bias, found.commanded_q)
    cost = seen_cost(file, turned, centroids) or glass_cost(file, found.commanded_q)
    return cost, _glass_notes(cost, has_stars=bool(centroids))


def _glass_notes(cost: GlassCost | None, *, has_stars: bool) -> list[str]:
    """Why answers, with or without stars, do not tell a cost that the PSF file tells."""
    if cost is None or cost.source != FILE:
        return []
    if has_stars:
        has = "name too few stars"
    else:
        has = "hold only attitudes, which cannot tell colour from distortion"
    return [f"the answers {has}: what the glass costs is told by the PSF file"]


def matched(run: RunLedger, telemetry: Telemetry, tau_s: FloatArray, q: FloatArray) -> CoarseClock:
    """Where valid answers (n, 4) at times (n,) lie on the run's clock.

    Raises InputError for other conventions than hilstar's, for another frame, and for answers of
    another run.
    """
    commanded = run.commanded
    coarse = coarse_offset(commanded, tau_s, q)
    agreed = None
    if coarse is not None and coarse.spread_rad <= AGREE_RAD:
        agreed = coarse
    turned = ""
    if agreed is not None:
        if agreed.turn_rad <= MAX_TURN_RAD:
            return agreed
        turned = _turned(telemetry, agreed.rotation)
        axes = _axes_by_name(agreed.rotation)
        if axes:
            cure = "write them for x right, y down in the image, z boresight"
            raise InputError(f"{turned}: they fit axes with {axes} of hilstar's; {cure}")
    offsets_s = speed_offsets(commanded, tau_s, q).tolist()
    if coarse is not None:
        offsets_s.insert(0, coarse.offset_s)
    for offset_s in offsets_s:
        _refuse(run, telemetry, tau_s + offset_s, q)
    if agreed is not None:
        w, x, y, z = conjugate(agreed.rotation).tolist()
        cure = f"turn them back by the quaternion {w:.6f},{x:.6f},{y:.6f},{z:.6f} from the left"
        raise InputError(f"{turned}: another frame or mounting; {cure}")
    raise InputError(
        f"{telemetry.path}: at no offset of its clock do the reported attitudes follow those of"
        f" {run.path}, lit for {commanded.t_s[-1]:.6g} s; give the telemetry of this run, of which"
        " no more than half may be wild"
    )


def _turned(telemetry: Telemetry, rotation: FloatArray) -> str:
    """The rotation (4,) from commanded to reported attitudes, in words."""
    turn_rad = to_rotation_vector(rotation)
    angle_rad = float(np.linalg.norm(turn_rad))
    x, y, z = turn_rad / max(angle_rad, 1e-12)
    axis = f"{x:.3f},{y:.3f},{z:.3f}"
    angle = f"{np.degrees(angle_rad):.4g} degrees"
    turned = f"turned by {angle} about {axis} (cam) from the commanded ones"
    return f"{telemetry.path}: the reported attitudes are {turned}"


def _axes_by_name(rotation: FloatArray) -> str:
    """The nearest rotation that only names the axes otherwise, of which there are 24; "" where none
    is within NEAR_AXES_RAD.
    """
    matrix = to_matrix(rotation)
    nearest = np.zeros((3, 3))
    column = np.argmax(np.abs(matrix), axis=1)
    nearest[range(3), column] = np.sign(matrix[range(3), column])
    cosine = (np.trace(matrix @ nearest.T) - 1) / 2
    off_rad = np.arccos(np.clip(cosine, -1, 1))
    if off_rad > NEAR_AXES_RAD:
        return ""
    axes = []
    for letter, row, k in zip("xyz", nearest, column.tolist(), strict=True):
        sign = "+"
        if row.sum() < 0:
            sign = "-"
        axes.append(f"{letter} = {sign}{'xyz'[k]}")
    return ", ".join(axes)


def _refuse(run: RunLedger, telemetry: Telemetry, t_s: FloatArray, q: FloatArray) -> None:
    """Refuse (InputError) answers that agree with the run at these times by another convention."""
    moments = run.commanded.at(t_s)
    if moments.known.sum() < max(MIN_PAIRS, 0.1 * len(t_s)):
        return
    rows = np.flatnonzero(moments.known)
    lines = telemetry.line[telemetry.valid][rows]
    pairs = Pairs(telemetry.path, lines, moments.q[rows], q[rows], names=COMMANDED)
    half_diagonal_px = 0.5 * np.hypot(*run.scale.resolution_px)
    field_radius_rad = float(np.arctan(half_diagonal_px / run.scale.focal_px))
    try:
        refuse_conventions(pairs, field_radius_rad)
    except InputError as refusal:
        if "wild" not in str(refusal) and "out of view" not in str(refusal):
            raise


def _notes(run: RunLedger, found: DecomposedRun, timed: TimedAnswers) -> list[str]:
    """What a reader of the budget has to know beside its figures."""
    notes = [*found.notes]
    clock = found.clock
    parts = found.components
    if timed.base_s and not timed.overlap:
        notes.append(
            f"the telemetry's times, {abs(timed.base_s):.9g} s from the run's, do not overlap it:"
            " its clock is taken as one of its own"
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
    notes += _hidden_field(found)
    bent_arcsec = _bent_arcsec(found, run.config.tracker.exposure_s)
    if bent_arcsec >= BENT_ARCSEC:
        notes.append(
            "in an exposure the attitude's mean differs from that in its middle by up to"
            f" {bent_arcsec:.2g} arcsec"
        )
    # Noise that lasts: a slow drift, or an error that changes over the field more sharply than the
    # bumps do.
    rows = len(parts.left) // TOGETHER * TOGETHER
    if rows >= MIN_ROWS * TOGETHER:
        means = parts.left[:rows].reshape(-1, TOGETHER, 3).mean(axis=1)
        slow = (means**2).mean(axis=0) - parts.noise_variance / TOGETHER
        slow_share = slow / np.maximum(parts.noise_variance, 1e-12)
        if slow_share.max() >= SLOW_SHARE:
            size = axes_of_variance(slow)
            across = f"{size.cross:.2g} arcsec across the boresight"
            beside = parts.fov.detail or "the bias"
            notes.append(
                f"the noise is not white: {across} and {size.roll:.2g} about it last for"
                f" {TOGETHER} answers and more, besides {beside}: does the alignment drift with"
                " time, or does the field-of-view error jump somewhere?"
            )
    if timed.clock_set:
        notes.append(CLOCK_SET)
    return notes


def _hidden_field(found: DecomposedRun) -> Iterator[str]:
    """Where a clock or a slow change in time hides the size of a field-of-view error, a note."""
    size_arcsec = found.fov_arcsec.cross
    if size_arcsec is None:
        return
    low_arcsec, high_arcsec = found.intervals.fov[:, 0].tolist()
    if low_arcsec > 0 and high_arcsec < HIDDEN * size_arcsec:
        return
    shown = "is not shown"
    if low_arcsec > 0:
        shown = f"is at least {low_arcsec:.2g}"
    yield (
        f"the field-of-view error {shown} and at most {high_arcsec:.2g} arcsec across the"
        " boresight: the tracker's clock, or a slow change in time, may look like the rest; come"
        " back to the same places at other rates and times"
    )


def _bent_arcsec(found: DecomposedRun, exposure_s: float) -> float:
    """How far an exposure's mean attitude is off that in its middle, in 99 of 100 answers; 0 of
    too few answers.

    Under an acceleration alpha the mean over an exposure E is alpha E^2 / 24 off.
    """
    step_s = np.diff(found.clock.t_s[found.row])
    near = step_s < 1.0
    if len(found.row) < MIN_ROWS or not near.any():
        return 0.0
    change = np.diff(ARCSEC_PER_RAD * found.rate_rad_s, axis=0)[near]
    acceleration = np.linalg.norm(change, axis=1) / step_s[near]
    usual = float(np.percentile(acceleration, 99))
    return usual * exposure_s**2 / 24


def _without_display(found: Decomposed, display: DisplayCost | None) -> tuple[Axes, list[str]]:
    """The noise without the display's own error, and a note where that error is not small."""
    noise = found.noise_arcsec
    if display is None or noise.cross is None or noise.roll is None:
        return noise, []
    share = display.subtracted
    cross_arcsec = display.cross_arcsec
    roll_arcsec = display.roll_arcsec
    cost = np.array([cross_arcsec, cross_arcsec, roll_arcsec]) ** 2
    variance = found.components.noise_variance - share * cost
    without = axes_of_variance(variance)
    if cross_arcsec <= SMALL * noise.cross and roll_arcsec <= SMALL * noise.roll:
        return without, []
    size = f"{cross_arcsec:.2g} arcsec across the boresight and {roll_arcsec:.2g} about it"
    says = f"the answers show {display.seen:.2f} +- {display.sigma_seen:.2f} of it"
    if share:
        done = f"{100 * share:.0f} % of its variance are subtracted from the noise"
    else:
        done = "nothing is subtracted"
    return without, [
        f"the display's own error is not small beside the noise: {size}; {says}, and {done}"
    ]
