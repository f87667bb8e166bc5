"""hilstar serve: the live attitude stream on the monitor."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from msgspec import UNSET
from msgspec.structs import replace as replaced

from hilstar.cli.options import BenchFile, Explain, Headless, Json, Overwrite, ScenarioFile, check_files
from hilstar.cli.parsers import parse_split
from hilstar.cli.show.heads import HeadsAsked, fed_link, serve_heads
from hilstar.cli.show.paging import Console, ConsoleName, Control, Token, fault_desk, followed, page_listener
from hilstar.cli.show.running import (
    Force,
    LedgerFile,
    LedgerSplit,
    Windowed,
    dated_ledger,
    end_of_run,
    explain_bench,
    explain_source,
    optional_ledger,
    optional_pulse,
    optional_scenario,
    run_with_faults,
    say_beat,
    say_of_light,
    say_units,
    shown_bench,
)
from hilstar.console.run_status import RunSource, RunStatus, on_terminal
from hilstar.console.terminal import say, without_attitude
from hilstar.files import MCAP, check_ending
from hilstar.notices import Notices

if TYPE_CHECKING:
    from hilstar.attitude.wire.links import Pictures
    from hilstar.bench.bench_file import BenchFile as ReadFile
    from hilstar.bench.frame import Bench
    from hilstar.run.open_link import AnyLink

HeadOf = Annotated[Path | None, typer.Option("--head-of", hidden=True)]  # of a head's process: the file with `heads`,
FedBy = Annotated[str | None, typer.Option("--fed-by", hidden=True)]  # and where the source's attitudes come from
NO_ATTITUDE = 4  # the exit code of a run that never had one


def serve(
    bench_file: BenchFile,
    headless: Headless = False,
    duration: Annotated[float | None, typer.Option(help="Seconds to run; by default until Ctrl-C.", min=0, max=1e8)] = None,
    frames: Annotated[int | None, typer.Option(help="Number of frames to draw.", min=1)] = None,
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
    head_of: HeadOf = None,
    fed_by: FedBy = None,
) -> None:
    """Show the live attitude stream on the monitor; of a file with `heads`, on the monitor of each."""
    from hilstar.bench.bench_file import HeadsFile, as_head, read_bench_or_heads

    file = read_bench_or_heads(bench_file) if head_of is None else as_head(bench_file, head_of)
    if isinstance(file, HeadsFile):
        switches = {"--headless": headless, "--windowed": windowed, "--force": force, "--control": control}
        switches |= {"--overwrite": overwrite, "--explain": explain}
        asked = HeadsAsked(duration, frames, dated_ledger(ledger), ledger_split, scenario, switches, console, token)
        serve_heads(file, asked, as_json)
        return
    from hilstar.attitude.wire.source import Mounting
    from hilstar.bench.cameras import fields_of_view
    from hilstar.console.publisher import PageParts, RunDescription
    from hilstar.run.loop import Limit
    from hilstar.run.record.ledger import Ledger
    from hilstar.run.serve import Outlet
    from hilstar.run.serve import serve as serve_stream

    ledger = dated_ledger(ledger)
    check_ending("--ledger", ledger, MCAP)
    faults = optional_scenario(scenario)
    fields = fields_of_view(file.config, file.folder)
    check_files([scenario], [], file, ledger, overwrite)
    split = parse_split(ledger_split)
    notices = Notices()
    with (
        page_listener(console, control, token, console_name) as listener,
        _source(file, fed_by, notices) as link,
        optional_pulse(file, notices) as pulse,
        shown_bench(file, headless, windowed, force) as (bench, screen),
        optional_ledger(ledger, bench, notices, overwrite, split) as kept,
        run_with_faults(bench, faults, notices, kept) as wrong,
    ):
        if explain:
            explain_source(link.conventions, Mounting(file.config.tracker.q_body_to_cam))
            explain_bench(bench)
        refresh_hz = bench.config.monitor.refresh_hz
        slots = math.inf if duration is None else round(duration * refresh_hz)
        limit = Limit(slots, math.inf if frames is None else frames)
        link.await_ready()
        say(f"{link.verb} {link.endpoint}, {refresh_hz:g} Hz, {bench.renderer.gl_renderer}")
        say(fields.line())
        say_units(fields)
        say_of_light(bench)
        beat = UNSET if file.config.attitude.lockstep else say_beat(bench, screen)
        told = RunSource(link.endpoint, bench.renderer.gl_renderer, refresh_hz, min(limit.slots, limit.frames))
        status = RunStatus(told, kept)
        page = RunDescription(
            "serve", file.config.attitude.source, link.endpoint, "asked" if file.config.attitude.lockstep else "clock"
        )
        parts = PageParts(
            bench, notices, kept, lambda path: Ledger(path, bench, notices, split=split), screen, fault_desk(wrong)
        )
        with on_terminal(status), followed(listener, control, page, parts, status) as (sink, follower, requests):
            outlet = Outlet(screen, kept, notices, tracker_pictures(link, bench, wrong), follower, requests, wrong, pulse)
            summary = serve_stream(bench, link, limit, sink, outlet)
    end_of_run(replaced(summary, beat=beat, fields_of_view=fields.keys()), screen, kept, notices, as_json)
    if not summary.packets.accepted:
        say(without_attitude(link.endpoint, summary.packets))
        raise typer.Exit(NO_ATTITUDE)


def _source(file: ReadFile, fed_by: str | None, notices: Notices) -> AnyLink:
    """Where the attitudes come from: the bench's own source, or of a head the process that has it."""
    from hilstar.run.open_link import open_link

    if fed_by is not None:
        return fed_link(file, fed_by, notices)
    return open_link(file.config, file.folder, notices, apart=True)


def tracker_pictures(link: AnyLink, bench: Bench, faults: Any = None) -> Pictures | None:
    """The virtual tracker's pictures for a link whose other side asks for them."""
    from hilstar.twin.pictures import TrackerPictures

    if not link.asks_for_pictures:
        return None
    if faults is None:
        return TrackerPictures(bench)
    return TrackerPictures(bench, faults.desk.scenario, lambda: faults.frames.now)
