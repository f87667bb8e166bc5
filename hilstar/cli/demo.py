"""hilstar demo: the main job in one command."""

import json
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

from hilstar.basics.errors import InputError, MachineError
from hilstar.basics.files import check_directory, make_directory, temporary_folder
from hilstar.basics.notices import Notices
from hilstar.basics.process.interrupts import caught
from hilstar.cli import running
from hilstar.cli.declare import option, struct, switch
from hilstar.cli.options import json_option, output_option, seed_option
from hilstar.cli.running import ActingPageOptions
from hilstar.server.console.run_status import RunSource, RunStatus
from hilstar.server.console.terminal import progress, report, say

if TYPE_CHECKING:
    from hilstar.basics.arrays import FloatArray
    from hilstar.instruments.assess.budget import Axes
    from hilstar.server.bench.frame import Bench
    from hilstar.server.console.listener import PageListener
    from hilstar.server.frame_feed import FrameFeed
    from hilstar.server.pacer import FrameSink, Shown
    from hilstar.server.serve import Outlet
    from hilstar.server.summary import RunSummary

HZ = 60  # the demo bench's refresh
USUAL_S, LOOP_S = 10.0, 60.0  # of a run, and of one with a tracker, whose noise takes answers
MAX_MISSED = 0.01  # share of frames from which the budget is no longer the tracker's alone
FREE_PORT = "tcp://127.0.0.1:*"  # ZeroMQ chooses it
# the tracker of --loop
BIAS_ARCSEC, FOV_ARCSEC, PIXEL_ARCSEC, WRONG = (20.0, -10.0, 40.0), 2.0, 0.6, 0.01
PLANTED = [
    "--bias",
    ",".join(map(str, BIAS_ARCSEC)),
    "--fov-error",
    str(FOV_ARCSEC),
    "--pixel-error",
    str(PIXEL_ARCSEC),
]
PLANTED += ["--wrong", str(WRONG)]


@struct
class DemoOptions:
    """The options of `hilstar demo`."""

    output: Path = output_option("DIR", "Directory for the pictures.", default=Path("hilstar-demo"))
    duration: float | None = option(
        "SECONDS", "Seconds to run; by default 10, and 60 with --loop.", min=0.5, max=600
    )
    loop: bool = switch(
        "A slow scan with a virtual tracker before the display, and its error budget."
    )
    seed: int = seed_option("Seed of the jitter, and of the tracker's errors.", default=1)
    as_json: bool = json_option()


def demo(options: DemoOptions, page: ActingPageOptions) -> None:
    """The main job in one command: real stars, an attitude streamed over a real ZeroMQ socket,
    frames out.

    Where frames show an old sky, because attitudes came too late, the last line says so and the
    exit code is 1.
    """
    import numpy as np

    from hilstar.basics.resources import resource_path
    from hilstar.server.demo import Shows, run_demo, scan_samples, slew_samples, write_pictures

    check_directory("-o", options.output)
    seconds = options.duration or (LOOP_S if options.loop else USUAL_S)
    rng = np.random.default_rng(options.seed)
    motion = scan_samples if options.loop else slew_samples
    samples = motion(seconds + 1.0, rng)
    demo_file = resource_path("configs", "demo.toml")
    beside: AbstractContextManager[TrackerBeside | None] = nullcontext()
    if options.loop:
        beside = tracker_beside(options.output, demo_file, seconds, options.seed)
    with (
        running.page_listener(page) as listener,
        beside as tracker,
        progress("serving", seconds * HZ) as advance,
    ):

        def counted(shown: "Shown") -> None:
            advance(shown.number + 1)

        def watching(
            bench: "Bench", endpoint: str
        ) -> "AbstractContextManager[tuple[FrameSink, Outlet]]":
            return _watching(bench, endpoint, listener, page.control, counted, tracker)

        shows = Shows(demo_file, samples)
        if tracker is not None:
            shows = Shows(tracker.bench_file, samples, tracker.watches)
        result = run_demo(options.output, seconds, shows, watching)
    if result.kept and caught() is None:  # no pictures after Ctrl-C
        if not options.as_json:
            say(f"writing {len(result.kept)} pictures and their previews to {options.output}")
        with progress("writing pictures", 2 * len(result.kept)) as advance:
            write_pictures(options.output, result, advance)
    report(result.summary, options.as_json)
    if tracker is not None and caught() is None:
        tracker.report(result.summary.answers, options.as_json)
        say_missed(result.summary.missed_frames, result.summary.frames)
    if not options.as_json:
        typer.echo(
            f"{'pictures':20}{options.output}/frame_*_codes.png (what the monitor gets),"
            " _preview.png (stretched)"
        )
    if result.summary.stale_frames and caught() is None:
        _say_stale(result.summary, options.as_json)
        raise typer.Exit(1)


def say_missed(missed: int, frames: int) -> None:
    """Say where the display missed frames that the tracker's budget takes for its own errors."""
    if missed > MAX_MISSED * frames:
        say(
            f"hilstar: the display missed {missed} frames, and answers that looked while it held a"
            " frame are in no figure; the machine is busy: close other programs, and run it again"
        )


def _say_stale(summary: "RunSummary", as_json: bool) -> None:
    """Say that frames showed an old sky; on stderr where stdout is the JSON object's."""
    line = (
        f"{summary.stale_frames} of {summary.frames} frames show an old sky: no attitude came in"
        " time; the machine is busy, so close other programs and run it again"
    )
    if as_json:
        say(f"hilstar: {line}")
    else:
        typer.echo(f"{'stale sky':20}{line}")


@contextmanager
def _watching(
    bench: "Bench",
    endpoint: str,
    listener: "PageListener | None",
    control: bool,
    advance: "FrameSink",
    tracker: "TrackerBeside | None",
) -> "Iterator[tuple[FrameSink, Outlet]]":
    """The sink and the outlet of the demo's run, with its page and its tracker. Raises
    MachineError where the GPU was lost.
    """
    from hilstar.server.console.publisher import RunDescription
    from hilstar.server.record.ledger import NO_SPLIT
    from hilstar.server.serve import Outlet

    notices = Notices()
    refresh_hz = bench.config.monitor.refresh_hz
    source = RunSource(f"bound to {endpoint}", bench.renderer.gl_renderer, refresh_hz)
    status = RunStatus(source)
    ledger_path = None
    frames_endpoint = None
    if tracker is not None:
        ledger_path = tracker.ledger
        frames_endpoint = FREE_PORT
    with (
        running.optional_ledger(ledger_path, bench, notices, True, NO_SPLIT) as ledger,
        running.optional_answers(bench, notices, ledger, None) as answers,
        running.optional_frames(frames_endpoint, bench, None) as frames,
        nullcontext() if tracker is None or frames is None else tracker.before(frames),
    ):
        parts = running.page_parts(bench, notices, ledger, answers=answers)
        page = RunDescription("demo", bench.config.attitude.source, endpoint)
        with running.followed(listener, control, page, parts, status, advance, frames) as (
            sink,
            follower,
            requests,
        ):
            outlet = Outlet(
                None, ledger, notices, follower=follower, requests=requests, answers=answers
            )
            yield sink, outlet
    running.refuse_lost_gpu(notices)


@contextmanager
def tracker_beside(
    folder: Path, demo_file: Path, seconds: float, seed: int
) -> "Iterator[TrackerBeside]":
    """The demo's tracker, whose answers come by a socket of its own; the bench file that names
    it is in `folder`.
    """
    make_directory(folder)
    with temporary_folder("loop") as place:
        endpoint = f"ipc://{place.resolve()}/answers"
        bench_file = folder / "loop.toml"
        answers = (
            f'[answers]\nsource = "zmq"\nformat = "json"\nclock = "host"\nendpoint = "{endpoint}"\n'
        )
        bench_file.write_text(f"{demo_file.read_text()}\n{answers}")
        yield TrackerBeside(folder, bench_file, endpoint, seconds, seed)


class TrackerBeside:
    """The demo's tracker, a process of its own, with its planted errors, and the budget that is
    found of it.
    """

    def __init__(
        self, folder: Path, bench_file: Path, answers: str, seconds: float, seed: int
    ) -> None:
        self.ledger = folder / "loop.mcap"
        self.bench_file = bench_file
        self._page = folder / "budget.html"
        self._words = [
            "--answer",
            answers,
            "--format",
            "json",
            "--duration",
            f"{seconds:g}",
            "--seed",
            str(seed),
            *PLANTED,
        ]
        self._feed: FrameFeed | None = None
        self._process: subprocess.Popen[str] | None = None

    @contextmanager
    def before(self, frames: "FrameFeed") -> Iterator[None]:
        """Run it before the frames of a feed; it ends by itself, or with this."""
        self._feed = frames
        command = [
            sys.executable,
            "-m",
            "hilstar",
            "tracker",
            str(self.bench_file),
            "--watch",
            frames.endpoint,
        ]
        with subprocess.Popen(
            [*command, *self._words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        ) as self._process:
            try:
                yield
            finally:
                self._process.terminate()

    def watches(self) -> bool:
        """Whether it watches the frames. Raises MachineError where it has ended."""
        if self._process is None or self._feed is None:
            return False
        if self._process.poll() is not None:
            assert self._process.stderr is not None  # a pipe
            error_lines = self._process.stderr.read().strip().splitlines() or ["nothing"]
            raise MachineError(
                f"the demo's tracker ended before the run; it said: {error_lines[-1]}"
            )
        return self._feed.watched

    def report(self, live: object, as_json: bool) -> None:
        """Print the budget of the tracker's answers beside what was planted; `live` are the
        run's own figures.
        """
        from hilstar.instruments.assess.assessment import AssessSettings, assess_files
        from hilstar.instruments.assess.page import write_page
        from hilstar.instruments.assess.report import lines_of

        try:
            assessment = assess_files(self.ledger, None, AssessSettings(display_attitudes=0))
        except InputError as refusal:  # what is read here this machine has made
            raise MachineError(f"the demo's run gives no budget: {refusal}") from refusal
        write_page(self._page, assessment)
        parts = assessment.found
        rows = loop_figures(parts.bias_arcsec, parts.fov_arcsec, parts.pixel_arcsec, live)
        if as_json:
            say(json.dumps({"loop": [row._asdict() for row in rows]}))
            return
        print_loop([*lines_of(assessment), ("page", str(self._page))], rows)


class LoopFigure(NamedTuple):
    """A figure of the demo's tracker: as it was planted, and as its budget has it."""

    quantity: str
    planted: float
    found: float | None
    unit: str = "arcsec"

    def line(self) -> str:
        """The figure as a row of a table."""
        text = "unknown"
        if self.found is not None:
            text = f"{self.found:.2f}"
        return f"{self.quantity:28}{self.planted:10.2f}{text:>10} {self.unit}"


def print_loop(budget: Iterable[tuple[str, str]], rows: Iterable[LoopFigure]) -> None:
    """Print the lines of a budget, and what was planted beside what was found."""
    for what, text in budget:
        typer.echo(f"{what:24}{text}")
    typer.echo(f"{'':28}{'planted':>10}{'found':>10}")
    for row in rows:
        typer.echo(row.line())


def loop_figures(
    bias_arcsec: "FloatArray", fov_arcsec: "Axes", pixel_arcsec: "Axes", live: object
) -> list[LoopFigure]:
    """The parts of a budget beside those that were planted, and the share of wrong answers where
    `live` are the figures of a run with answers.
    """
    from hilstar.instruments.simulate.tracker_process import ROLL
    from hilstar.server.answers.judge import TrackerFigures

    rows = []
    for axis, planted_arcsec, axis_arcsec in zip("xyz", BIAS_ARCSEC, bias_arcsec, strict=True):
        rows.append(LoopFigure(f"bias {axis}", planted_arcsec, float(axis_arcsec)))
    for name, planted_arcsec, axes in (
        ("field-of-view error", FOV_ARCSEC, fov_arcsec),
        ("pixel error", PIXEL_ARCSEC, pixel_arcsec),
    ):
        rows.append(LoopFigure(f"{name} across", planted_arcsec, axes.cross))
        rows.append(LoopFigure(f"{name} about", ROLL * planted_arcsec, axes.roll))
    if isinstance(live, TrackerFigures) and live.answers:
        wrong_percent = 100 * live.wrong / live.answers
        rows.append(LoopFigure("wrong answers", 100 * WRONG, wrong_percent, "%"))
    return rows
