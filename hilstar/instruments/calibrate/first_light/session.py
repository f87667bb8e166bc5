"""The session: its steps in order, each done once, and again when what it depends on has
changed.
"""

import datetime
import hashlib
import math
import os
import platform
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Set
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from hilstar.basics.errors import HilstarError, InputError, MachineError, one_line
from hilstar.basics.files import clear_parts, lock_alone, write_whole
from hilstar.basics.units import NS_PER_S
from hilstar.basics.version import __version__
from hilstar.instruments.calibrate.first_light.context import (
    KIND,
    Figure,
    KeyChange,
    SessionFile,
    StepContext,
    StepNumber,
    StepOutcome,
    StepRecord,
    read_session,
    rewrite,
    sha256_of,
    write_session,
)
from hilstar.instruments.calibrate.first_light.focus import focus
from hilstar.instruments.calibrate.first_light.geometry import geometry, orientation
from hilstar.instruments.calibrate.first_light.image_sources import (
    ImageSource,
    NoImage,
    Pattern,
    Stopped,
    complete_images,
)
from hilstar.instruments.calibrate.first_light.photometry import photometry
from hilstar.instruments.calibrate.first_light.stars import scale, verify
from hilstar.instruments.calibrate.first_light.steps import STEPS, SessionStep
from hilstar.instruments.calibrate.first_light.uniformity import uniformity, warm_up
from hilstar.instruments.calibrate.latency import checked_delay_ms, draw_latency, pair, summarise
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.doctor import examine
from hilstar.server.sync import BeatSummary, beat_of

WATCHED_S = 5.0  # about 150 edges at 60 Hz
AGREE_MS = 0.05  # a smaller difference neither changes the bench file nor casts doubt on a scan-out
MS_PER_S = 1000.0
PROGRESS_S = 3.0
BEFORE_FILE = "bench-before.toml"
LOCK_FILE = ".lock"


def latency(context: StepContext) -> StepOutcome:
    """Measure the panel's delay and set it in the bench file. Raises InputError, MachineError."""
    monitor = context.monitor
    if not monitor.photodiode_px:
        return StepOutcome(
            "skipped",
            "not measured: [monitor] photodiode_px is 0, so no square is shown for a photodiode",
        )
    watched = context.source.diode(context.file, WATCHED_S)
    if watched is None:
        how = (
            "--diode serial:/dev/ttyX@BAUD, with the display on this machine; or `hilstar latency`"
            " with the ledger of a run"
        )
        return StepOutcome(
            "skipped",
            f"not measured, the bench file's {monitor.panel_delay_ms:g} ms stays: give {how}",
        )
    paired = pair(watched.seen, watched.shown, NS_PER_S / monitor.refresh_hz)
    summary = summarise(paired, context.file.config)
    picture = context.session / "latency.svg"
    draw_latency(picture, paired, summary)
    panel_ms = summary["panel_delay_ms"]
    # light of a panel without delay may come this much early, by noise
    if -AGREE_MS < panel_ms < 0:
        panel_ms = 0.0
    delay_ms = checked_delay_ms(panel_ms)
    error_ms = summary["panel_delay_u_ms"]
    latency_ms = summary["latency_ms"]
    figures: dict[str, Figure] = {
        "panel_delay_ms": delay_ms,
        "error_ms": error_ms,
        "in_bench_file_ms": monitor.panel_delay_ms,
        "swap_to_light_p50_ms": latency_ms["p50"],
        "swap_to_light_p99_ms": latency_ms["p99"],
        "swap_to_square_ms": summary["swap_to_square_ms"],
        "jitter_ms": summary["jitter_ms"],
        "edges": summary["edges"],
        "edges_without_a_frame": summary["unmatched"],
    }
    for name in ("rise_ms", "fall_ms"):
        if summary[name] is not None:
            figures[name] = summary[name]
    if context.truth is not None:
        figures["truth_panel_delay_ms"] = context.truth.config.monitor.panel_delay_ms
    line = (
        f"the panel's delay is {delay_ms:g} +- {error_ms:.3f} ms, the bench file has"
        f" {monitor.panel_delay_ms:g}; a swap is light at the square after"
        f" {latency_ms['p50']:.2f} ms, jitter {summary['jitter_ms']:.3f}, {summary['edges']} edges"
    )
    changes: tuple[KeyChange, ...] = ()
    if abs(delay_ms - monitor.panel_delay_ms) >= max(AGREE_MS, 3 * error_ms):
        changes = (
            *context.change("monitor", "panel_delay_ms", delay_ms),
            *context.change("certify", "panel_delay_u_ms", float(f"{error_ms:.3g}")),
        )
    number = StepNumber(
        delay_ms, error_ms, "ms", "from the buffer swap to the light of the first row"
    )
    return StepOutcome("done", line, figures, (picture,), (picture,), changes, number)


def machine(context: StepContext) -> StepOutcome:
    """Check the machine. Raises MachineError for what it lacks."""
    examined = examine()
    missing = []
    for check in examined.checks:
        if check.required and not check.ok:
            missing.append(f"{check.name}: {check.detail}")
    if missing:
        raise MachineError("; ".join(missing))
    figures = {check.name: check.detail for check in examined.checks}
    passed = sum(check.required for check in examined.checks)  # all of them
    number = StepNumber(passed, None, f"of {passed}", "checks passed of what hilstar needs")
    return StepOutcome("done", f"OpenGL by {figures['opengl']}", figures, number=number)


def display(context: StepContext) -> StepOutcome:
    """Measure the display. Raises MachineError for one that is not as the bench file has it."""
    timing = context.source.gate(context.file)
    if timing is None:
        source, _, _ = context.source.identity.partition(":")
        return StepOutcome("skipped", f"no display of this program's own ({source})")
    figures: dict[str, Figure] = {"period_ms": timing.period_ms, "dropped": timing.dropped}
    line = f"a frame every {timing.period_ms:.3f} ms, {timing.dropped} dropped"
    if timing.paced_by_screen:
        figures["refresh_hz"] = MS_PER_S / timing.period_ms
    else:
        line += "; the display has no refresh of its own, frames are paced by software"
    if timing.modes_hz:
        figures["modes_hz"] = " ".join(map(str, timing.modes_hz))
    for forced_check in context.source.forced:
        line += f"; forced: {forced_check}"
    number = StepNumber(
        timing.period_ms, timing.period_error_ms, "ms", "from one frame to the next"
    )
    return StepOutcome("done", line, figures, number=number)


RUNS: dict[str, Callable[[StepContext], StepOutcome]] = {
    run.__name__.replace("_", "-"): run
    for run in (
        machine,
        display,
        orientation,
        focus,
        warm_up,
        geometry,
        uniformity,
        photometry,
        scale,
        latency,
        verify,
    )
}


class SessionPlan(NamedTuple):
    """The steps of a session in their order, and what runs each."""

    steps: tuple[SessionStep, ...] = STEPS
    runs: Mapping[str, Callable[[StepContext], StepOutcome]] = RUNS

    @property
    def names(self) -> tuple[str, ...]:
        """The steps' names, in their order."""
        return tuple(step.name for step in self.steps)

    def later_keys(self, number: int) -> frozenset[str]:
        """The keys of the bench file, as table.key, that the steps after one may set."""
        return frozenset(key for other in self.steps[number + 1 :] for key in other.writes)


FIRST_LIGHT = SessionPlan()


class Progress:
    """Tells every PROGRESS_S what a step is at, from a thread of its own: a fit takes as long as
    an image.
    """

    def __init__(self, tell: Callable[[str], object]) -> None:
        self._tell = tell
        self._stage = ""
        self._images = 0

    def shows(self, pattern: Pattern) -> None:
        """A pattern is shown, and its image taken."""
        self._images += 1
        self._stage = f"image {self._images}, {pattern.name}"

    def stage(self, words: str) -> None:
        """Something begins that may take long."""
        self._stage = words

    @contextmanager
    def of(self, step: str) -> Iterator[None]:
        """Tell of a step while this is open."""
        self._stage = "begins"
        self._images = 0
        begun_s = time.monotonic()
        ended = threading.Event()

        def tell() -> None:
            while not ended.wait(PROGRESS_S):
                self._tell(f"{step:12} {time.monotonic() - begun_s:.0f} s: {self._stage}")

        thread = threading.Thread(target=tell, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


def origin_of(source: ImageSource) -> str:
    """What takes the images, and the monitor that shows the patterns where its EDID tells it."""
    monitor = source.monitor
    if monitor is None or not monitor.edid_sha256:
        return source.identity
    return f"{source.identity} on {monitor.name()}"


def state_sha256(
    step: SessionStep,
    later: Set[str],
    config: Mapping[str, Mapping[str, Any]],
    folder: Path,
    source: str,
    tables: tuple[str, ...] = (),
) -> str:
    """The SHA-256 of what a step depends on: its tables (or these) of a bench file in `folder`,
    without later steps' keys, the files that they name, and the source of its images.
    """
    keys_by_table = {}
    for table in tables or step.tables:
        keys_by_table[table] = {
            key: value for key, value in config[table].items() if f"{table}.{key}" not in later
        }
    named = {}
    for text in _texts(keys_by_table):
        if _is_file(folder / text):
            named[text] = sha256_of(folder / text)
    # a step without tables shows nothing
    origin = source if step.tables else platform.python_version()
    return hashlib.sha256(
        msgspec.json.encode([__version__, origin, keys_by_table, named], order="sorted")
    ).hexdigest()


class FirstLightSession:
    """A session in a directory, with at most `patches` readings of the response; `watch` is called
    with each pattern.

    White is watched for `watched_s` at most, 0 for not at all; `frames` images of each field of
    stars are averaged, 0: as many as it takes. `progress` is called with a line every few seconds
    while a step runs, from a thread of its own.
    Raises InputError for a directory with another bench's session.
    """

    def __init__(
        self,
        folder: Path,
        file: BenchFile,
        source: ImageSource,
        patches: int,
        watch: Callable[[Pattern], object] = lambda pattern: None,
        *,
        watched_s: float = 0.0,
        frames: int = 0,
        progress: Callable[[str], object] = lambda line: None,
        plan: SessionPlan = FIRST_LIGHT,
    ) -> None:
        self._plan = plan
        self._watch = watch
        self._watched_s = watched_s
        self._frames = frames
        self._progress = Progress(progress)
        self.folder = folder
        self.file = file
        self.source = source
        self.patches = patches
        bench = str(file.path.resolve())
        earlier = read_session(folder)
        if earlier is not None and earlier.bench != bench:
            raise InputError(
                f"{folder}: is the session of {earlier.bench}; write another directory for"
                f" {file.path}"
            )
        self.records: dict[str, StepRecord] = {}
        self.unfinished: dict[str, str] = {}
        if earlier is not None:
            self.unfinished |= earlier.unfinished
            for record in earlier.steps:
                # a step of another version of hilstar is none of this session's
                if record.name in plan.names:
                    self.records[record.name] = record

    def run(self, again: frozenset[str], say: Callable[[str], None]) -> int:
        """Run what is not done; exit code 0, 1 where a step failed, or a MachineError's. Raises
        Stopped at a closed display.
        """
        clear_parts(self.folder)
        before = self.folder / BEFORE_FILE
        if not before.exists():
            write_whole(before, self.file.path.read_bytes())
        for number, step in enumerate(self._plan.steps):
            if step.name not in again and self._is_done(number):
                record = self.records[step.name]
                say(f"{step.name:12} {record.verdict} before: {record.line}")
                continue
            record = self._run(number, step.name in again, say)
            self.records[step.name] = record
            write_session(self.folder, self.as_file())
            say(f"{step.name:12} {record.verdict}: {record.line}")
        return max(record.exit_code for record in self.records.values())

    def _is_done(self, number: int) -> bool:
        """Whether a step need not run: it is done, or skipped for good, and nothing it depends
        on has changed.
        """
        step = self._plan.steps[number]
        record = self.records.get(step.name)
        if record is None or record.verdict == "failed" or step.name in self.unfinished:
            return False
        if self._unmet(step) is not None:
            return False
        if record.verdict == "skipped" and step.needs:
            return False  # it lacked a step that has been done by now
        if record.state_sha256 != self._state(number):
            return False
        for name, digest in record.files.items():
            path = self.folder / name
            if not _is_file(path) or sha256_of(path) != digest:
                return False
        return True

    def _unmet(self, step: SessionStep) -> str | None:
        """The step that has to be done before this one can run; None where it can."""
        for name in step.unless_failed:
            record = self.records.get(name)
            if record is not None and record.verdict == "failed":
                return name
        for name in step.needs:
            record = self.records.get(name)
            if record is None or record.verdict == "failed":
                return name
            # without a display of this program's own there is nothing to measure of it
            if record.verdict == "skipped" and name != "display":
                return name
        return None

    def _run(self, number: int, afresh: bool, say: Callable[[str], None]) -> StepRecord:
        """Run a step, or skip it for want of another; its record."""
        step = self._plan.steps[number]
        start_s = time.monotonic()
        exit_code = 0
        unmet = self._unmet(step)
        if unmet is not None:
            outcome = StepOutcome("skipped", f"needs {unmet}, which is not done")
        else:
            say(f"{step.name:12} shows {step.shows or 'nothing'}; wants {step.wants}")
            # An interrupted attempt's images can be used where nothing they depend on has changed.
            goes_on = not afresh and self.unfinished.get(step.name) == self._attempt(number)
            context = self._context(step, goes_on)
            self.unfinished[step.name] = self._attempt(number)
            write_session(self.folder, self.as_file(step.name))
            outcome, exit_code = self._tried(step, context)
        figures = {name: _finite(value) for name, value in outcome.figures.items()}
        files = {}
        for path in outcome.files:
            files[os.path.relpath(path, self.folder)] = sha256_of(path)
        pictures = [os.path.relpath(path, self.folder) for path in outcome.pictures]
        ended = datetime.datetime.now(datetime.UTC)
        return StepRecord(
            name=step.name,
            verdict=outcome.verdict,
            line=outcome.line,
            exit_code=exit_code,
            state_sha256=self._state(number),
            figures=figures,
            files=files,
            pictures=pictures,
            changes=list(outcome.changes),
            ended=ended.isoformat(timespec="seconds"),
            seconds=round(time.monotonic() - start_s, 3),
            number=outcome.number,
        )

    def _tried(self, step: SessionStep, context: StepContext) -> tuple[StepOutcome, int]:
        """A step's outcome, and its exit code; a failure where it raises. Raises Stopped."""
        try:
            with self._progress.of(step.name):
                outcome = self._plan.runs[step.name](context).checked()
            self.file = rewrite(self.file, outcome.changes)
        except Stopped:
            raise
        except HilstarError as error:
            # Bad data for one step is not a wrong command: the session continues and ends with exit
            # code 1.
            code = error.exit_code
            if isinstance(error, InputError):
                code = 1
            if not isinstance(error, NoImage | MachineError):
                del self.unfinished[step.name]
            return StepOutcome("failed", one_line(str(error))), code
        del self.unfinished[step.name]
        return outcome, int(outcome.verdict == "failed")

    def _attempt(self, number: int) -> str:
        """What an attempt's images depend on."""
        # Every pattern depends on the collimator, even where the step's result does not.
        tables = (*self._plan.steps[number].tables, "collimator")
        return f"{self._state(number, tables)} {self.patches}"

    def _context(self, step: SessionStep, goes_on: bool) -> StepContext:
        """What a step is given; its images go into the last attempt's folder, or into a new one."""
        attempts = self.folder / "images"
        number = sum(1 for path in attempts.glob(f"{step.name}-*") if path.is_dir())
        if not goes_on or not number:
            number += 1
        folder = attempts / f"{step.name}-{number}"
        known: dict[str, Figure] = {}
        for name, record in self.records.items():
            if record.verdict == "done":
                for key, value in record.figures.items():
                    known[f"{name}.{key}"] = value
        return StepContext(
            self.file,
            self.folder,
            folder,
            self.source,
            known,
            complete_images(folder),
            self.patches,
            watch=self._shows,
            stage=self._progress.stage,
            watched_s=self._watched_s,
            frames=self._frames,
        )

    def _shows(self, pattern: Pattern) -> None:
        self._progress.shows(pattern)
        self._watch(pattern)

    def _state(self, number: int, tables: tuple[str, ...] = ()) -> str:
        """The state of a step of this session."""
        step = self._plan.steps[number]
        later = self._plan.later_keys(number)
        config = msgspec.to_builtins(self.file.config)
        source = origin_of(self.source)
        return state_sha256(step, later, config, self.file.folder, source, tables)

    def as_file(self, running: str | None = None) -> SessionFile:
        """The contents of session.json."""
        return SessionFile(
            kind=KIND,
            hilstar=__version__,
            bench=str(self.file.path.resolve()),
            bench_sha256=self.file.sha256,
            seen_by=self.source.identity,
            running=running,
            steps=[self.records[name] for name in self._plan.names if name in self.records],
            unfinished=self.unfinished,
            beat=self.beat(),
            forced=list(self.source.forced),
        )

    def beat(self) -> BeatSummary:
        """The beat of the tracker's exposures with the display, at its measured rate and modes
        where they are known.
        """
        record = self.records.get("display")
        figures = {} if record is None else record.figures
        refresh_hz = figures.get("refresh_hz")
        modes = str(figures.get("modes_hz", "")).split()
        if refresh_hz is not None:
            refresh_hz = float(refresh_hz)
        return beat_of(self.file.config, refresh_hz, [float(hz) for hz in modes])


def _finite(value: Figure) -> Figure:
    """The figure, or "not known" where JSON has no such number."""
    if not isinstance(value, float):
        return value
    # msgspec does not encode NumPy's floats
    if math.isfinite(value):
        return float(value)
    return "not known"


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _texts(inner)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Lock a directory against a second session (InputError); a kill releases the lock."""
    lock = lock_alone(
        folder / LOCK_FILE, "another first-light session works there; wait for its end"
    )
    try:
        yield
    finally:
        os.close(lock)
