"""hilstar replay: an attitude log on the monitor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import (
    LOG_HELP,
    BenchFile,
    BodyName,
    EpochUtc,
    Explain,
    Headless,
    Json,
    KernelFiles,
    Overwrite,
    PlaceText,
    ReferenceName,
    ScenarioFile,
    TopicName,
    check_files,
    parse_place,
    parse_speed,
    parse_split,
)
from hilstar.cli.running import (
    Console,
    ConsoleName,
    Control,
    Force,
    LedgerFile,
    LedgerSplit,
    Token,
    Windowed,
    dated_ledger,
    end_of_run,
    explain_bench,
    explain_source,
    fault_schedule,
    followed,
    optional_ledger,
    optional_pulse,
    optional_scenario,
    page_listener,
    run_with_faults,
    say_of_light,
    shown_bench,
)
from hilstar.console.run_status import RunSource, RunStatus, on_terminal
from hilstar.files import MCAP, check_directory, check_ending
from hilstar.notices import Notices


def replay(
    bench_file: BenchFile,
    log: Annotated[Path, typer.Argument(metavar="LOG", help=LOG_HELP)],
    speed: Annotated[
        str, typer.Option(metavar="realtime|max|N", help="Real time, as fast as possible, or N times real time.")
    ] = "realtime",
    start: Annotated[float | None, typer.Option(metavar="S", help="Start this many seconds after the first sample.")] = None,
    stop: Annotated[float | None, typer.Option(metavar="S", help="Stop this many seconds after the first sample.")] = None,
    step: Annotated[float | None, typer.Option(metavar="S", help="Time step of the log between frames, in seconds.")] = None,
    kernel: KernelFiles = None,
    topic: TopicName = None,
    body: BodyName = None,
    reference: ReferenceName = None,
    epoch_utc: EpochUtc = None,
    place: PlaceText = None,
    headless: Headless = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Directory for a PNG of each frame, and frames.csv.")
    ] = None,
    ledger: LedgerFile = None,
    ledger_split: LedgerSplit = None,
    scenario: ScenarioFile = None,
    overwrite: Overwrite = False,
    windowed: Windowed = False,
    force: Force = False,
    console: Console = None,
    control: Control = False,
    token: Token = None,
    console_name: ConsoleName = None,
    explain: Explain = False,
    as_json: Json = False,
) -> None:
    """Show an attitude log on the monitor."""
    from hilstar.attitude.logs.entries import Stated
    from hilstar.attitude.wire.source import Mounting
    from hilstar.bench.bench_file import dated, read_bench_file
    from hilstar.console.publisher import PageParts, RunDescription
    from hilstar.run.record.frame_images import FrameImages
    from hilstar.run.record.ledger import Ledger
    from hilstar.run.replay import Wanted, plan_play
    from hilstar.run.replay import replay as replay_log
    from hilstar.run.serve import Outlet

    check_directory("-o", output)
    ledger = dated_ledger(ledger)
    check_ending("--ledger", ledger, MCAP)
    file = read_bench_file(bench_file)
    faults = optional_scenario(scenario)
    check_files([log, scenario], [None if output is None else output / "frames.csv"], file, ledger, overwrite)
    split = parse_split(ledger_split)
    notices = Notices()
    mounting = Mounting(file.config.tracker.q_body_to_cam)
    stated = Stated(mounting, tuple(kernel or ()), topic, body, reference, epoch_utc, parse_place(place))
    play = plan_play(log, Wanted(parse_speed(speed), start, stop, step), file.config, stated)
    file = dated(file, play.conventions.scale, play.first_ns)
    with (
        page_listener(console, control, token, console_name) as listener,
        optional_pulse(file, notices) as pulse,
        shown_bench(file, headless, windowed, force) as (bench, screen),
        FrameImages(output, bench) as record,
        optional_ledger(ledger, bench, notices, overwrite, split) as kept,
        run_with_faults(bench, faults, notices, kept, play.recording) as wrong,
    ):
        say_of_light(bench)
        if explain:
            explain_source(play.conventions, mounting)
            explain_bench(bench)

        renderer, refresh_hz = bench.renderer.gl_renderer, bench.config.monitor.refresh_hz
        status = RunStatus(RunSource(f"replaying {log}", renderer, refresh_hz, play.frame_count), kept)

        page = RunDescription("replay", "log", str(log), "clock" if play.paced else "asked")
        parts = PageParts(
            bench, notices, kept, lambda path: Ledger(path, bench, notices, split=split), screen, fault_schedule(wrong)
        )
        with on_terminal(status), followed(listener, control, page, parts, status, record) as (sink, follower, requests):
            outlet = Outlet(screen, kept, notices, follower=follower, requests=requests, faults=wrong, pulse=pulse)
            summary = replay_log(bench, play, sink, outlet)
    end_of_run(summary, screen, kept, notices, as_json)
