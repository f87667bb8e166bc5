"""Parts of the commands that run a bench: its screen, its ledger, its page, what is said of it,
and the end of a run.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hilstar.basics.errors import InputError, MachineError, without_display
from hilstar.basics.notices import Notice, Notices
from hilstar.basics.process.programs import Service
from hilstar.cli.declare import option, struct, switch
from hilstar.cli.options import (
    explain_option,
    feed_option,
    force_option,
    json_option,
    overwrite_option,
    scenario_option,
    windowed_option,
)
from hilstar.server.console.run_status import RunStatus
from hilstar.server.console.terminal import busy, report, say

if TYPE_CHECKING:
    from hilstar.server.bench.bench_file import BenchFile
    from hilstar.server.bench.cameras import FieldsOfView
    from hilstar.server.bench.config import BenchConfig
    from hilstar.server.bench.scenario import Scenario
    from hilstar.server.bench.star_size import StarSize
    from hilstar.server.console.listener import PageListener
    from hilstar.server.console.publisher import PageParts, RunDescription
    from hilstar.server.faults import AnyFaults, Recording
    from hilstar.server.frame_feed import FrameFeed
    from hilstar.server.frame_pulse import FramePulse
    from hilstar.server.live_answers import LiveAnswers
    from hilstar.server.operator import SwitchRequests
    from hilstar.server.pacer import FrameSink, Shown
    from hilstar.server.record.ledger import LedgerSwitch
    from hilstar.server.run_progress import Follower, Running
    from hilstar.server.screen.screen import Screen
    from hilstar.server.summary import RunSummary
    from hilstar.server.sync import BeatSummary

POINTED = ("serve", "replay")  # commands whose attitudes come from elsewhere
UTC_MARK = "{utc}"  # stands for the time in a ledger's name


@struct
class DisplayOptions:
    """Where a run's frames are shown, and who else gets them."""

    headless: bool = switch("Draw without a window.")
    windowed: bool = windowed_option()
    force: bool = force_option()
    feed: str | None = feed_option()

    def given(self) -> dict[str, bool]:
        """Each flag, and whether the command line gives it."""
        return {
            "--headless": self.headless,
            "--windowed": self.windowed,
            "--force": self.force,
            "--feed": self.feed is not None,
        }


@struct
class RunOptions:
    """What a run records, which faults it has, and what it prints."""

    ledger: Path | None = option(
        "RUN.mcap",
        "Record every packet and every frame in this file; {utc} in it is the start's time.",
    )
    ledger_split: str | None = option(
        "1GB|1h", "Continue in RUN.0001.mcap and so on after this size or time."
    )
    scenario: Path | None = scenario_option()
    overwrite: bool = overwrite_option()
    strict: bool = switch(
        "Exit with 1 where over 1 % of the frames were missed or stale, or a wrong sky was shown"
        " for any time."
    )
    explain: bool = explain_option()
    as_json: bool = json_option()


@struct
class PageOptions:
    """Where the operator's page of a run is, and who may see it."""

    console: str | None = option(
        "[HOST:PORT]",
        "Serve the operator's page there, by default on 127.0.0.1:8765; port 0 is any free one.",
        show_default=False,
    )
    token: str | None = option(
        "TEXT",
        "What a browser must give to see the page; beyond 127.0.0.1 one is made where none is"
        " given.",
        envvar="HILSTAR_TOKEN",
    )
    console_name: list[str] | None = option(
        "NAME", "A further name of the page, as a proxy shows it; may be given often."
    )


@struct
class ActingPageOptions(PageOptions):
    """The same of a page that may act."""

    control: bool = switch("Let the page act: without it, it only shows.")


def explain_bench(bench: Any, t_ns: int | None = None, of_source: Sequence[str] = ()) -> None:
    """Say what was chosen for this scene and why: the sources of attitudes and stars, the choices
    within the tolerance, and the bodies that are discs at `t_ns`.
    """
    from hilstar.optics.layers.diffuse_layer import DiffuseLayer
    from hilstar.server.bench.effort_report import effort_lines
    from hilstar.server.bench.moving_sky import observer_lines, satellite_lines, wide_bodies

    moving = bench.moving
    for line in [
        *of_source,
        *bench.stars.catalog.notes,
        *effort_lines(bench),
        *observer_lines(bench.config),
        *wide_bodies(moving, bench.camera, t_ns),
        *satellite_lines(moving, t_ns),
        *(layer.line() for layer in bench.layers if isinstance(layer, DiffuseLayer)),
    ]:
        say(line)


def effort_of_run(bench: Any, explain: bool, as_json: bool) -> dict[str, dict[str, Any]]:
    """The key "effort" of a run's JSON, where the bench leaves something to its tolerance or it
    is to be explained; else {}.
    """
    with busy("finding what else would do"):
        return explained_effort(bench, as_json and (explain or bench.effort.is_chosen))


def explained_effort(bench: Any, wanted: bool) -> dict[str, dict[str, Any]]:
    """The key "effort" of a JSON object, if it is wanted; else {}."""
    from hilstar.server.bench.effort_report import effort_keys

    return {"effort": effort_keys(bench)} if wanted else {}


@contextmanager
def shown_bench(
    file: "BenchFile", display: DisplayOptions, *, timed: bool
) -> Iterator[tuple[Any, Any]]:
    """The bench and its screen; None when headless. `timed` as in `open_bench`."""
    if display.headless:
        from hilstar.display.render.context import create_context
        from hilstar.server.bench.build import open_bench

        # NumPy is too slow for a stream
        with open_bench(file, create_context(file.config.render.gpu), timed=timed) as bench:
            yield bench, None
        return
    from hilstar.server.screen.gate import open_screen

    with ExitStack() as stack:
        opened = open_screen(
            file,
            datetime.now(UTC).date(),
            windowed=display.windowed,
            force=display.force,
            timed=timed,
        )
        with without_display("run with --headless"):
            screen = stack.enter_context(opened)
        yield screen.bench, screen


def forced_on(screen: Any) -> str:
    """The faults of a screen that --force ignores; "" for none, and headless."""
    return "" if screen is None else "; ".join(screen.forced)


def say_of_light(bench: Any) -> None:
    """Name the stars that this bench shows too faint, and the assumption about its primaries."""
    from hilstar.server.bench.frame import clipping_line, colour_line, drawn_line, shares_line

    for line in (clipping_line(bench), drawn_line(bench), shares_line(bench), colour_line(bench)):
        if line is not None:
            say(line)


def say_optics(fields: "FieldsOfView", star: "StarSize") -> None:
    """Warn where a length of the bench file is probably in another unit than its key, else where a
    star is too wide.
    """
    fault = star.fault()
    if fields.warning is not None:
        say_units(fields)
    elif fault is not None:
        say(f"{fault}; hilstar doctor BENCH lists panels")


def say_seen(bench: Any) -> dict[str, Any]:
    """Say the fields of view of screen and tracker and the width of a star, with a warning where
    one is implausible. Returns both for the run's summary.
    """
    from hilstar.server.bench.cameras import fields_of_view
    from hilstar.server.bench.star_size import star_size

    fields = fields_of_view(bench.config, bench.file.folder)
    star = star_size(bench.config, bench.file.folder, bench.camera)
    say(fields.line())
    say(star.line())
    say_optics(fields, star)
    return {"fields_of_view": fields.keys(), "star": star.keys()}


def say_units_of(file: "BenchFile") -> None:
    """Warn where a length of a bench file is probably another quantity, or in another unit than its
    key.
    """
    from hilstar.server.bench.cameras import fields_of_view

    say_units(fields_of_view(file.config, file.folder))


def say_units(fields: "FieldsOfView") -> None:
    """The same warning, from fields of view that were found already."""
    if fields.warning is not None:
        say(f"check the units: {fields.warning}")


def say_beat(config: "BenchConfig", screen: "Screen | None") -> "BeatSummary":
    """The beat between the tracker's exposures and the screen's refresh, with a line where it
    matters.
    """
    from hilstar.server.sync import beat_line, beat_of

    if screen is None:
        frame_beat = beat_of(config)
    else:
        frame_beat = beat_of(config, screen.clock.measured_hz, screen.window.modes_hz)
    line = beat_line(frame_beat)
    if line is not None:
        say(line)
    return frame_beat


@contextmanager
def optional_pulse(file: "BenchFile", notices: Notices) -> "Iterator[FramePulse | None]":
    """The bench file's pulse at each frame; None without one. Raises InputError where its port
    cannot be opened.
    """
    from hilstar.server.frame_pulse import FramePulse

    settings = file.config.sync
    if settings.port is None:
        yield None
        return
    with FramePulse.of(settings, notices) as pulse:
        yield pulse


@contextmanager
def optional_answers(
    bench: Any, notices: Notices, ledger: "LedgerSwitch", screen: Any
) -> "Iterator[LiveAnswers | None]":
    """The tracker's answers while this is open; None where the bench file names none. Raises
    InputError.
    """
    if bench.config.answers is None:
        yield None
        return
    from hilstar.server.answers.judge import AnswerRules
    from hilstar.server.answers.reader import open_answers
    from hilstar.server.live_answers import LiveAnswers

    with open_answers(bench.config, bench.file.folder, notices) as source:
        answers = LiveAnswers(
            bench.config.monitor,
            AnswerRules.of(bench.config),
            source,
            notices,
            ledger,
            swap_to_light_ns=None if screen is None else screen.swap_to_light_ns,
        )
        with answers.running():
            say(f"answers: {source.endpoint}")
            yield answers


@contextmanager
def optional_frames(endpoint: str | None, bench: Any, screen: Any) -> "Iterator[FrameFeed | None]":
    """The feed of the run's frames to watchers; None without an endpoint. Raises InputError
    where it cannot be bound.
    """
    if endpoint is None:
        yield None
        return
    from hilstar.attitude.wire.shown_frames import FrameSender
    from hilstar.server.frame_feed import FrameFeed

    with FrameFeed(
        FrameSender(endpoint), bench, lambda: 0 if screen is None else screen.swap_to_light_ns
    ) as feed:
        say(f"frames: {feed.endpoint}")
        yield feed


def dated_ledger(path: Path | None) -> Path | None:
    """A ledger's path, with the present time in place of UTC_MARK."""
    if path is None or UTC_MARK not in path.name:
        return path
    return path.with_name(path.name.replace(UTC_MARK, f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}"))


@contextmanager
def optional_ledger(
    path: Path | None, bench: Any, notices: Notices, overwrite: bool, split: Any
) -> "Iterator[LedgerSwitch]":
    """The run's ledger, which also keeps its events; without a path it starts switched off."""
    from hilstar.server.bench.measured_on import SHOWN_ANYWAY
    from hilstar.server.record.ledger import Ledger, LedgerSwitch

    ledger = LedgerSwitch(None if path is None else Ledger(path, bench, notices, overwrite, split))
    notices.listen(ledger.notice)
    for line in bench.output.get("forced", ()):
        ledger.notice(Notice.now("forced", f"{line}: {SHOWN_ANYWAY}"))
    with ledger:
        yield ledger


def optional_scenario(path: Path | None) -> "Scenario | None":
    """The scenario of `--scenario`, None without one. Raises InputError."""
    if path is None:
        return None
    from hilstar.server.bench.scenario import read_scenario

    return read_scenario(path)


@contextmanager
def run_with_faults(
    bench: Any,
    scenario: "Scenario | None",
    notices: Notices,
    ledger: "LedgerSwitch",
    recording: "Recording | None" = None,
) -> "Iterator[AnyFaults | None]":
    """The faults of a run, from its scenario and stream or from the run that is replayed; None
    for none.
    """
    from hilstar.server.bench.scenario import NO_SCENARIO
    from hilstar.server.faults import ReplayedFaults, RunFaults

    if recording is not None and recording.faults:
        if scenario is not None:
            raise InputError(
                f"--scenario {scenario.path}: the run that is replayed has faults of its own; leave"
                " it out"
            )
        yield ReplayedFaults(bench, recording, ledger)
        return
    if scenario is None and bench.config.faults.endpoint is None:
        yield None
        return
    faults = RunFaults(bench, scenario or NO_SCENARIO, notices, ledger)
    with faults.listening(bench.config.faults, bench.file.folder) as endpoint:
        if scenario is not None:
            timed = sum(fault.at_s is not None for fault in scenario.faults)
            say(f"{scenario.path}: {len(scenario.faults)} faults, {timed} of them at their time")
        if endpoint:
            say(f"faults: {endpoint}")
        yield faults


def end_of_run(
    summary: "RunSummary",
    gone: str | None,
    failure: str | None,
    notices: Notices,
    as_json: bool,
    strict: bool = False,
) -> None:
    """Print the summary of a run whose ledger is closed; exit code 1 where the ledger failed, or
    the run is not `strict`. `gone` says why the window went away, `failure` why the ledger failed.

    Raises MachineError where the window went away or the GPU was lost. A run without an attitude is
    the caller's.
    """
    report(summary, as_json)
    if gone is not None:
        raise MachineError(f"the run ended early: {gone}")
    refuse_lost_gpu(notices)
    had_attitude = summary.frames > summary.blank_frames or summary.packets.accepted > 0
    passed = not strict or not had_attitude or not summary.verdict or summary.verdict.strict
    if failure is not None or not passed:
        raise typer.Exit(1)


def refuse_lost_gpu(notices: Notices) -> None:
    """Raise MachineError where the GPU was lost in a run."""
    from hilstar.server.watchdog import GPU_LOST

    if lost := notices.lasting.get(GPU_LOST):
        raise MachineError(f"{lost}; begin it again, and see dmesg where that happens again")


@contextmanager
def page_listener(page: PageOptions) -> "Iterator[PageListener | None]":
    """The page's listening socket; None without --console. Raises InputError."""
    from hilstar.server.console.listener import PageListener, parse_address

    names = tuple(page.console_name or ())
    if page.console is None:
        may_act = isinstance(page, ActingPageOptions) and page.control
        for flag, given in (("--control", may_act), ("--console-name", bool(names))):
            if given:
                raise InputError(f"{flag}: is the page's; add --console, or leave it out")
        yield None
        return
    with PageListener(parse_address(page.console), page.token, names) as listener:
        say(f"the operator's page is at {listener.url}")
        yield listener


@contextmanager
def scpi_listener(
    file: "BenchFile", scpi: str | None, page: "PageListener | None", token: str | None
) -> "Iterator[PageListener | None]":
    """SCPI's listening socket, with the page's token if that has one; None without --scpi.
    Raises InputError.
    """
    from hilstar.server.console.listener import PageListener, parse_address

    if scpi is None:
        if file.config.attitude.source == "scpi":
            raise InputError(
                f'{file.path}: [attitude] source = "scpi" needs SCPI; add --scpi, or name another'
                " source"
            )
        yield None
        return
    token = token if page is None else page.token or None
    with PageListener(parse_address(scpi, "--scpi"), token, option="--scpi") as listener:
        if listener.made:
            secret = f', SYST:AUTH "{listener.token}" first'
        elif listener.token:
            secret = ", SYST:AUTH first"
        else:
            secret = ""
        say(f"SCPI is at {listener.host}:{listener.port}{secret}")
        yield listener


def page_parts(
    bench: Any,
    notices: Notices,
    ledger: "LedgerSwitch",
    screen: Any = None,
    faults: Any = None,
    answers: Any = None,
    **split: Any,
) -> "PageParts":
    """The parts of a run for its page; a ledger that is begun there is split as `split` says."""
    from hilstar.server.console.publisher import PageParts
    from hilstar.server.record.ledger import Ledger

    schedule = getattr(faults, "schedule", None)  # nobody starts a fault in a run that is replayed
    return PageParts(
        bench,
        notices,
        ledger,
        lambda path: Ledger(path, bench, notices, **split),
        screen,
        schedule,
        answers,
    )


@contextmanager
def optional_pointing(
    description: "RunDescription", parts: "PageParts", sinks: "list[FrameSink]"
) -> Iterator[None]:
    """Say where the first attitude points, while this is open; the demo knows where it does."""
    if description.command not in POINTED:
        yield
        return
    from hilstar.server.pointing import Pointing

    with Pointing(parts.bench, parts.notices) as pointing:
        sinks.append(pointing.see)
        yield


@contextmanager
def followed(
    listener: "PageListener | None",
    control: bool,
    description: "RunDescription",
    parts: "PageParts",
    status: RunStatus,
    record: "FrameSink | None" = None,
    frames: "FrameFeed | None" = None,
    scpi: "PageListener | None" = None,
) -> "Iterator[tuple[FrameSink, Follower, SwitchRequests | None]]":
    """Connect a run to all that follows it: terminal, `record`, systemd, `frames`, page and SCPI.

    Yields the sink of its frames, its follower, and the requests of page and SCPI.
    """
    sinks: list[FrameSink] = [status.see]
    if record is not None:
        sinks.insert(0, record)
    if frames is not None:
        sinks.append(frames.see)
    with (
        Service(status.begun, status.alive, status.line),
        optional_pointing(description, parts, sinks),
    ):
        if listener is None and scpi is None:
            yield _all_of(sinks), status.follow, None
            return
        from hilstar.server.console.page_process import Listeners
        from hilstar.server.console.publisher import opened_page

        with opened_page(Listeners(listener, scpi), control, description, parts) as (
            feed,
            requests,
        ):

            def follow(running: "Running") -> None:
                status.follow(running)
                feed.follow(running)

            yield _all_of([*sinks, feed.see]), follow, requests


def _all_of(sinks: "list[FrameSink]") -> "FrameSink":
    """A sink that hands each frame to all of `sinks`, in their order."""
    if len(sinks) == 1:
        return sinks[0]

    def sink(shown: "Shown") -> None:
        for next_sink in sinks:
            next_sink(shown)

    return sink
