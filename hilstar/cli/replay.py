"""hilstar replay: an attitude log on the monitor."""

from pathlib import Path
from typing import Annotated

from msgspec.structs import replace as replaced
from typer import Argument, Option

from hilstar.basics.files import MCAP, check_directory, check_ending
from hilstar.basics.notices import Notices
from hilstar.cli import options, running
from hilstar.cli.completion import offered
from hilstar.server.console.run_status import RunSource, RunStatus, on_terminal
from hilstar.server.console.terminal import busy, say


@options.log_statements
def replay(
    bench_file: options.BenchFile,
    log: Annotated[Path, Argument(metavar="LOG", help=options.LOG_HELP)],
    speed: Annotated[
        str,
        Option(
            metavar="realtime|max|N",
            help="Real time, as fast as possible, or N times real time.",
            autocompletion=offered(("realtime", "max")),
        ),
    ] = "realtime",
    start: Annotated[
        float | None,
        Option(metavar="SECONDS", help="Start this many seconds after the first sample."),
    ] = None,
    stop: Annotated[
        float | None,
        Option(metavar="SECONDS", help="Stop this many seconds after the first sample."),
    ] = None,
    step: Annotated[
        float | None,
        Option(metavar="SECONDS", help="Time step of the log between frames, in seconds."),
    ] = None,
    statements: options.LogStatements = options.NOTHING_STATED,
    headless: options.Headless = False,
    output: Annotated[
        Path | None,
        Option(
            "-o",
            "--output",
            metavar="DIR",
            help="Directory for a PNG of each frame, and frames.csv.",
        ),
    ] = None,
    feed: running.Feed = None,
    ledger: running.LedgerFile = None,
    ledger_split: running.LedgerSplit = None,
    scenario: options.ScenarioFile = None,
    overwrite: options.Overwrite = False,
    windowed: running.Windowed = False,
    force: running.Force = False,
    console: running.Console = None,
    control: running.Control = False,
    token: running.Token = None,
    console_name: running.ConsoleName = None,
    strict: running.Strict = False,
    explain: options.Explain = False,
    as_json: options.Json = False,
) -> None:
    """Show an attitude log on the monitor."""
    from hilstar.server.bench.bench_file import dated, read_bench_file, with_codes_ms
    from hilstar.server.console.publisher import RunDescription
    from hilstar.server.replay import FrameImages, Wanted, plan_play
    from hilstar.server.replay import replay as replay_log
    from hilstar.server.serve import Outlet

    check_directory("-o", output)
    ledger = running.dated_ledger(ledger)
    check_ending("--ledger", ledger, MCAP)
    file = read_bench_file(bench_file)
    faults = running.optional_scenario(scenario)
    options.check_files(
        [log, scenario],
        [None if output is None else output / "frames.csv"],
        file,
        ledger,
        overwrite,
    )
    split = options.parse_split(ledger_split)
    notices = Notices()
    stated = statements.stated(file.config)
    wanted = Wanted(options.parse_speed(speed), start, stop, step)
    with busy("reading the log"):
        play = plan_play(log, wanted, file.config, stated)
    file = with_codes_ms(dated(file, play.conventions.scale, play.first_ns), play.codes_ms)
    with (
        running.page_listener(console, control, token, console_name) as listener,
        running.optional_pulse(file, notices) as pulse,
        # The frames of an earlier run have the codes that it had.
        running.shown_bench(
            file, headless, windowed, force, timed=play.paced and not play.moving
        ) as (bench, screen),
        FrameImages(output, bench) as record,
        running.optional_ledger(ledger, bench, notices, overwrite, split) as run_ledger,
        running.run_with_faults(bench, faults, notices, run_ledger, play.recording) as wrong,
        running.optional_answers(bench, notices, run_ledger, screen) as answers,
        running.optional_frames(feed, bench, screen) as watched,
    ):
        if play.span:
            say(play.span)
        running.say_units_of(file)
        running.say_of_light(bench)
        if explain:
            running.explain_bench(bench, of_source=play.conventions.lines(stated.mounting))
        # Before the run: what would do takes seconds, and a run that is stopped ends at once.
        effort = running.effort_of_run(bench, explain, as_json)
        renderer = bench.renderer.gl_renderer
        refresh_hz = bench.config.monitor.refresh_hz
        source = RunSource(
            f"replaying {log}", renderer, refresh_hz, play.frame_count, running.forced_on(screen)
        )
        status = RunStatus(source, run_ledger)
        page = RunDescription("replay", "log", str(log), "clock" if play.paced else "asked")
        parts = running.page_parts(bench, notices, run_ledger, screen, wrong, answers, split=split)
        with (
            on_terminal(status),
            running.followed(listener, control, page, parts, status, record, watched) as (
                sink,
                follower,
                requests,
            ),
        ):
            outlet = Outlet(
                screen, run_ledger, notices, None, follower, requests, wrong, pulse, answers
            )
            summary = replay_log(bench, play, sink, outlet)
        summary = replaced(summary, **effort)
    running.end_of_run(summary, screen, run_ledger, notices, as_json, strict)
