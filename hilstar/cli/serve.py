"""hilstar serve: the live attitude stream on the monitor; of a file with `heads`, one process
per head beside one source.
"""

import math
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from msgspec import UNSET
from msgspec.structs import replace as replaced
from typer import Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import MCAP, check_ending
from hilstar.basics.notices import Notices
from hilstar.basics.process.interrupts import end_with_parent
from hilstar.cli import running
from hilstar.cli.options import (
    BenchFile,
    Explain,
    Headless,
    Json,
    Overwrite,
    ScenarioFile,
    check_files,
    parse_split,
)
from hilstar.server.console.run_status import RunSource, RunStatus, on_terminal
from hilstar.server.console.terminal import print_found, say, without_attitude

if TYPE_CHECKING:
    from hilstar.attitude.wire.links import Pictures
    from hilstar.attitude.wire.zmq_links import ZmqReceiver
    from hilstar.server.bench.bench_file import BenchFile as ReadFile
    from hilstar.server.bench.frame import Bench
    from hilstar.server.console.publisher import RunDescription
    from hilstar.server.heads import HeadsRun
    from hilstar.server.open_link import AnyLink

NO_ATTITUDE = 4
# Options of a head's process: the file with `heads`, and the endpoint of the source's attitudes.
HeadOf = Annotated[Path | None, Option("--head-of", hidden=True)]
FedBy = Annotated[str | None, Option("--fed-by", hidden=True)]


def serve_heads(asked: "HeadsRun", console: str | None, overwrite: bool, as_json: bool) -> None:
    """Serve every head until its end, and print what each reported; exit code 4 if none ever had an
    attitude.

    The page of head k is at the port of `console` plus k.
    """
    from hilstar.server.heads import head_ledger, run_heads, source_config
    from hilstar.server.open_link import open_link

    heads = asked.heads
    if asked.ledger is not None and not overwrite:
        taken = [file for name in heads.names if (file := head_ledger(asked.ledger, name)).exists()]
        if taken:
            raise InputError(
                f"--ledger {asked.ledger}: {taken[0]} exists; give another name, or --overwrite"
            )
    notices = Notices()
    asked = replace(asked, consoles=_consoles(console, asked.token, len(heads.names)))
    with open_link(source_config(heads), heads.folder, notices, apart=True) as link:
        link.await_ready()
        say(f"{link.verb} {link.endpoint}, {len(heads.names)} heads: {', '.join(heads.names)}")
        assert not link.steps  # read_heads refuses lockstep
        head_summaries = run_heads(asked, link, say)
    lines = []
    verdicts = []
    for name, head in head_summaries.items():
        summary = head["summary"]
        if isinstance(summary, dict):
            frames = summary.get("frames")
        else:
            frames = None
        if frames is None:
            counted = "no summary"
        else:
            counted = f"{frames} frames"
        if head["restarts"]:
            again = f", started again {head['restarts']} times"
        else:
            again = ""
        lines.append(f"{name:20s}{counted}, exit code {head['exit_code']}{again}")
        if isinstance(summary, dict) and "verdict" in summary:
            verdicts.append(f"{'verdict':20s}{name}: {summary['verdict']['line']}")
    print_found(as_json, {"heads": head_summaries}, [*lines, *verdicts])
    codes = [head["exit_code"] for head in head_summaries.values()]
    if all(code == NO_ATTITUDE for code in codes):
        raise typer.Exit(NO_ATTITUDE)
    failed = [code for code in codes if code not in {0, NO_ATTITUDE}]
    if failed:
        raise typer.Exit(failed[0] if 0 < failed[0] <= NO_ATTITUDE else 1)


def _consoles(console: str | None, token: str | None, count: int) -> tuple[str, ...]:
    from hilstar.server.console.listener import MAX_PORT, ListenAddress, PageListener, parse_address

    if console is None:
        return ()
    first = parse_address(console)
    if first.port and first.port + count - 1 > MAX_PORT:
        raise InputError(
            f"--console {console}: {count} pages need as many ports from there; choose a lower one"
        )
    addresses = []
    for k in range(count):
        addresses.append(ListenAddress(first.host, first.port + k if first.port else 0))
    with ExitStack() as doors:
        for address in addresses:
            doors.enter_context(PageListener(address, token))
    if ":" in first.host:
        host = f"[{first.host}]"
    else:
        host = first.host
    return tuple(f"{host}:{address.port}" for address in addresses)


def fed_link(file: "ReadFile", fed_by: str, notices: Notices) -> "ZmqReceiver":
    """A head's link to the process that has the source, with which it ends; `fed_by` is that
    one's endpoint and process id.
    """
    from hilstar.attitude.wire.source import Mounting, SentAttitudes
    from hilstar.attitude.wire.zmq_links import FedDecoder, ZmqReceiver
    from hilstar.server.bench.config.attitude import PACKET_SOURCES

    endpoint, _, parent = fed_by.rpartition(",")
    end_with_parent(int(parent))
    sent = SentAttitudes(
        file.config.attitude.convention, Mounting(file.config.tracker.q_body_to_cam)
    )
    decoder = FedDecoder(sent)
    # Only packets have the key of a convention; the other sources have one of their own, and refuse
    # it.
    of_packets = file.config.attitude.source in PACKET_SOURCES
    decoder.conventions = replace(
        decoder.conventions, source="the source of several heads", of_packets=of_packets
    )
    return ZmqReceiver(endpoint, notices=notices, decoder=decoder)


def serve(
    bench_file: BenchFile,
    headless: Headless = False,
    duration: Annotated[
        float | None,
        Option(metavar="SECONDS", help="Seconds to run; by default until Ctrl-C.", min=0, max=1e8),
    ] = None,
    frames: Annotated[
        int | None, Option(metavar="N", help="Number of frames to draw.", min=1)
    ] = None,
    feed: running.Feed = None,
    ledger: running.LedgerFile = None,
    ledger_split: running.LedgerSplit = None,
    scenario: ScenarioFile = None,
    overwrite: Overwrite = False,
    windowed: running.Windowed = False,
    force: running.Force = False,
    console: running.Console = None,
    control: running.Control = False,
    token: running.Token = None,
    console_name: running.ConsoleName = None,
    scpi: running.Scpi = None,
    strict: running.Strict = False,
    explain: Explain = False,
    as_json: Json = False,
    head_of: HeadOf = None,
    fed_by: FedBy = None,
) -> None:
    """Show the live attitude stream on the monitor; of a file with `heads`, on the monitor of
    each.
    """
    from hilstar.server.bench.bench_file import HeadsFile, as_head, read_bench_or_heads

    file = read_bench_or_heads(bench_file) if head_of is None else as_head(bench_file, head_of)
    if isinstance(file, HeadsFile):
        from hilstar.server.heads import HeadsRun

        if feed is not None:
            raise InputError(
                f"--feed {feed}: one endpoint for several heads; serve one head's file, or leave it"
                " out"
            )
        if scpi is not None:
            raise InputError(
                f"--scpi: {bench_file} has several heads, and SCPI is one bench's; give the bench"
                " file of a head"
            )
        valued = {"--frames": frames, "--ledger-split": ledger_split, "--scenario": scenario}
        switches = {
            "--headless": headless,
            "--windowed": windowed,
            "--force": force,
            "--control": control,
        }
        switches |= {"--overwrite": overwrite, "--explain": explain, "--strict": strict}
        head_options = [
            word
            for name, value in valued.items()
            if value is not None
            for word in (name, str(value))
        ]
        head_options += [name for name, on in switches.items() if on]
        asked = HeadsRun(
            file, tuple(head_options), duration, running.dated_ledger(ledger), token=token
        )
        serve_heads(asked, console, overwrite, as_json)
        return
    from hilstar.attitude.wire.source import Mounting
    from hilstar.server.loop import Limit
    from hilstar.server.serve import Outlet
    from hilstar.server.serve import serve as serve_stream

    ledger = running.dated_ledger(ledger)
    check_ending("--ledger", ledger, MCAP)
    faults = running.optional_scenario(scenario)
    check_files([scenario], [], file, ledger, overwrite)
    split = parse_split(ledger_split)
    notices = Notices()
    with (
        running.page_listener(console, control, token, console_name) as listener,
        running.scpi_listener(file, scpi, listener, token) as instrument,
        _source(file, fed_by, notices) as link,
        running.optional_pulse(file, notices) as pulse,
        # In lockstep the simulation waits for each frame: no frame is late, and a run's codes are
        # those of any other machine.
        running.shown_bench(
            file, headless, windowed, force, timed=not file.config.attitude.lockstep
        ) as (bench, screen),
        running.optional_ledger(ledger, bench, notices, overwrite, split) as run_ledger,
        running.run_with_faults(bench, faults, notices, run_ledger) as wrong,
        running.optional_answers(bench, notices, run_ledger, screen) as answers,
        running.optional_frames(feed, bench, screen) as watched,
    ):
        if explain:
            running.explain_bench(
                bench, of_source=link.conventions.lines(Mounting(file.config.tracker.q_body_to_cam))
            )
        refresh_hz = bench.config.monitor.refresh_hz
        limit = Limit(
            math.inf if duration is None else round(duration * refresh_hz),
            math.inf if frames is None else frames,
        )
        link.await_ready()
        say(f"{link.verb} {link.endpoint}, {refresh_hz:g} Hz, {bench.renderer.gl_renderer}")
        # Before the run: what would do takes seconds, and a run that is stopped ends at once.
        effort = running.effort_of_run(bench, explain, as_json)
        optics = running.say_seen(bench) | effort
        running.say_of_light(bench)
        beat = UNSET if file.config.attitude.lockstep else running.say_beat(bench, screen)
        source = RunSource(
            link.endpoint,
            bench.renderer.gl_renderer,
            refresh_hz,
            limit.shortest,
            running.forced_on(screen),
        )
        status = RunStatus(source, run_ledger)
        parts = running.page_parts(bench, notices, run_ledger, screen, wrong, answers, split=split)
        with (
            on_terminal(status),
            running.followed(
                listener,
                control,
                _described(file, link),
                parts,
                status,
                frames=watched,
                scpi=instrument,
            ) as fed,
        ):
            outlet = Outlet(
                screen,
                run_ledger,
                notices,
                tracker_pictures(link, bench, wrong),
                *fed[1:],
                wrong,
                pulse,
                answers,
            )
            summary = serve_stream(bench, link, limit, fed[0], outlet)
    whole_summary = replaced(summary, beat=beat, **optics)
    running.end_of_run(whole_summary, screen, run_ledger, notices, as_json, strict)
    if not summary.packets.accepted:
        say(without_attitude(link.endpoint, summary.packets, link.trouble))
        raise typer.Exit(NO_ATTITUDE)


def _described(file: "ReadFile", link: "AnyLink") -> "RunDescription":
    """The run as its page says it; where SCPI steers, with the port of the link to which it
    sends.
    """
    from hilstar.server.console.publisher import RunDescription

    source = file.config.attitude
    if source.source == "scpi":
        steer_port = int(link.endpoint.rpartition(":")[2])
    else:
        steer_port = 0
    return RunDescription(
        "serve", source.source, link.endpoint, "asked" if source.lockstep else "clock", steer_port
    )


def _source(file: "ReadFile", fed_by: str | None, notices: Notices) -> "AnyLink":
    """The link to the bench's own source or, for a head, to the process that has it."""
    from hilstar.server.open_link import open_link

    if fed_by is not None:
        return fed_link(file, fed_by, notices)
    return open_link(file.config, file.folder, notices, apart=True)


def tracker_pictures(link: "AnyLink", bench: "Bench", faults: Any = None) -> "Pictures | None":
    """The virtual tracker's pictures for a link whose other side asks for them."""
    if not link.asks_for_pictures:
        return None
    from hilstar.instruments.simulate.pictures import TrackerPictures  # 15 ms

    if faults is None:
        return TrackerPictures(bench)
    return TrackerPictures(bench, faults.schedule.scenario, lambda: faults.frames.now)
