"""hilstar replay: an attitude log on the monitor."""

from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace as replaced

from hilstar.basics.files import check_directory
from hilstar.basics.notices import Notices
from hilstar.cli import running
from hilstar.cli.completion import offered
from hilstar.cli.declare import argument, option, struct
from hilstar.cli.options import (
    LOG_HELP,
    LogStatements,
    bench_argument,
    output_option,
    parse_speed,
)
from hilstar.cli.running import ActingPageOptions, DisplayOptions, RunOptions
from hilstar.cli.shown_run import Followers, run_files, shown_run
from hilstar.server.console.terminal import busy, say

if TYPE_CHECKING:
    from hilstar.server.console.messages import Pace


@struct
class ReplayOptions:
    """The options of `hilstar replay`."""

    bench_file: Path = bench_argument()
    log: Path = argument("LOG", LOG_HELP)
    speed: str = option(
        "realtime|max|N",
        "Real time, as fast as possible, or N times real time.",
        default="realtime",
        autocompletion=offered(("realtime", "max")),
    )
    start: float | None = option("SECONDS", "Start this many seconds after the first sample.")
    stop: float | None = option("SECONDS", "Stop this many seconds after the first sample.")
    step: float | None = option("SECONDS", "Time step of the log between frames, in seconds.")
    output: Path | None = output_option("DIR", "Directory for a PNG of each frame, and frames.csv.")


def replay(
    options: ReplayOptions,
    statements: LogStatements,
    display: DisplayOptions,
    run: RunOptions,
    page: ActingPageOptions,
) -> None:
    """Show an attitude log on the monitor."""
    from hilstar.server.bench.bench_file import dated, read_bench_file, with_codes_ms
    from hilstar.server.console.publisher import RunDescription
    from hilstar.server.replay import FrameImages, Wanted, plan_play
    from hilstar.server.replay import replay as replay_log

    check_directory("-o", options.output)
    file = read_bench_file(options.bench_file)
    table = None
    if options.output is not None:
        table = options.output / "frames.csv"
    files = run_files(run, file, [options.log], [table])
    notices = Notices()
    stated = statements.stated(file.config)
    wanted = Wanted(parse_speed(options.speed), options.start, options.stop, options.step)
    with busy("reading the log"):
        play = plan_play(options.log, wanted, file.config, stated)
    file = with_codes_ms(dated(file, play.conventions.scale, play.first_ns), play.codes_ms)
    # The frames of an earlier run have the codes that it had.
    is_timed = play.paced and not play.moving
    with (
        running.page_listener(page) as listener,
        running.optional_pulse(file, notices) as pulse,
        running.shown_bench(file, display, timed=is_timed) as (bench, screen),
        FrameImages(options.output, bench) as record,
        shown_run(bench, screen, run, display, notices, files, pulse, play.recording) as shown,
    ):
        if play.span:
            say(play.span)
        running.say_units_of(file)
        running.say_of_light(bench)
        if run.explain:
            running.explain_bench(bench, of_source=play.conventions.lines(stated.mounting))
        effort = shown.effort()
        pace: Pace = "clock" if play.paced else "asked"
        description = RunDescription("replay", "log", str(options.log), pace)
        followers = Followers(record, listener, page.control)
        with shown.outlet(description, f"replaying {options.log}", play.frame_count, followers) as (
            sink,
            outlet,
        ):
            summary = replay_log(bench, play, sink, outlet)
    shown.end(replaced(summary, **effort))
