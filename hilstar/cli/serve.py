"""hilstar serve: the live attitude stream on the monitor; of a file with `heads`, one process
per head beside one source.
"""

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from msgspec import UNSET, UnsetType
from msgspec.structs import replace as replaced

from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.process.interrupts import end_with_parent
from hilstar.cli import running
from hilstar.cli.declare import option, struct
from hilstar.cli.options import bench_argument
from hilstar.cli.running import ActingPageOptions, DisplayOptions, RunOptions
from hilstar.cli.shown_run import Followers, run_files, shown_run
from hilstar.server.console.terminal import print_found, say, without_attitude

if TYPE_CHECKING:
    from hilstar.attitude.wire.links import Pictures
    from hilstar.attitude.wire.zmq_links import ZmqReceiver
    from hilstar.server.bench.bench_file import BenchFile as ReadFile
    from hilstar.server.bench.bench_file import HeadsFile
    from hilstar.server.bench.frame import Bench
    from hilstar.server.console.publisher import RunDescription
    from hilstar.server.heads import HeadsRun
    from hilstar.server.loop import Limit
    from hilstar.server.open_link import AnyLink
    from hilstar.server.sync import BeatSummary

NO_ATTITUDE = 4


def serve_heads(asked: "HeadsRun", console: str | None, overwrite: bool, as_json: bool) -> None:
    """Serve every head until its end, and print what each reported; exit code 4 if none ever had an
    attitude.

    The page of head k is at the port of `console` plus k.
    """
    from hilstar.server.heads import head_ledger, run_heads, source_config
    from hilstar.server.open_link import open_link

    heads = asked.heads
    if asked.ledger is not None and not overwrite:
        for name in heads.names:
            file = head_ledger(asked.ledger, name)
            if file.exists():
                raise InputError(
                    f"--ledger {asked.ledger}: {file} exists; give another name, or --overwrite"
                )
    notices = Notices()
    asked = replace(asked, consoles=_consoles(console, asked.token, len(heads.names)))
    with open_link(source_config(heads), heads.folder, notices, apart=True) as link:
        link.await_ready()
        say(f"{link.verb} {link.endpoint}, {len(heads.names)} heads: {', '.join(heads.names)}")
        assert not link.steps  # read_heads refuses lockstep
        head_summaries = run_heads(asked, link, say)
    lines = [_head_line(name, head) for name, head in head_summaries.items()]
    for name, head in head_summaries.items():
        summary = head["summary"]
        if isinstance(summary, dict) and "verdict" in summary:
            lines.append(f"{'verdict':20s}{name}: {summary['verdict']['line']}")
    print_found(as_json, {"heads": head_summaries}, lines)
    exit_code = _exit_code([head["exit_code"] for head in head_summaries.values()])
    if exit_code:
        raise typer.Exit(exit_code)


def _exit_code(codes: Sequence[int]) -> int:
    """The exit code of a run by those of its heads: that of the first that failed, else 4 where
    none ever had an attitude.
    """
    failures = [code for code in codes if code not in {0, NO_ATTITUDE}]
    if not failures:
        return min(codes)
    # a head that a signal ended has a negative code, which is none of a command's
    return failures[0] if 0 < failures[0] < NO_ATTITUDE else 1


def _head_line(name: str, head: dict[str, Any]) -> str:
    """How a head's process ended; its summary is a text where it printed no JSON object."""
    frames = None
    if isinstance(head["summary"], dict):
        frames = head["summary"].get("frames")
    count = "no summary"
    if frames is not None:
        count = f"{frames} frames"
    restarts = ""
    if head["restarts"]:
        restarts = f", started again {head['restarts']} times"
    return f"{name:20s}{count}, exit code {head['exit_code']}{restarts}"


def _consoles(console: str | None, token: str | None, count: int) -> tuple[str, ...]:
    """The addresses of the heads' pages, one port after another; none without --console. Raises
    InputError where one of them cannot be had.
    """
    from hilstar.server.console.listener import MAX_PORT, ListenAddress, PageListener, parse_address

    if console is None:
        return ()
    first = parse_address(console)
    if first.port and first.port + count - 1 > MAX_PORT:
        raise InputError(
            f"--console {console}: {count} pages need as many ports from there; choose a lower one"
        )
    ports = [0] * count  # of the system's choice
    if first.port:
        ports = [first.port + k for k in range(count)]
    addresses = [ListenAddress(first.host, port) for port in ports]
    with ExitStack() as stack:
        for address in addresses:
            stack.enter_context(PageListener(address, token))
    host = first.host
    if ":" in host:
        host = f"[{host}]"
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


@struct
class ServeOptions:
    """The options of `hilstar serve`."""

    bench_file: Path = bench_argument()
    duration: float | None = option(
        "SECONDS", "Seconds to run; by default until Ctrl-C.", min=0, max=1e8
    )
    frames: int | None = option("N", "Number of frames to draw.", min=1)
    scpi: str | None = option(
        "[HOST:PORT]",
        "Answer a test stand's SCPI there, by default on 127.0.0.1:5025; port 0 is any free one.",
        show_default=False,
    )


@struct
class HeadOptions:
    """What `serve` of several heads gives the process of one head."""

    head_of: Path | None = option("", "The file with `heads`.", hidden=True)
    fed_by: str | None = option("", "The endpoint of the source's attitudes.", hidden=True)


def serve(
    options: ServeOptions,
    display: DisplayOptions,
    run: RunOptions,
    page: ActingPageOptions,
    head: HeadOptions,
) -> None:
    """Show the live attitude stream on the monitor; of a file with `heads`, on the monitor of
    each.
    """
    from hilstar.server.bench.bench_file import HeadsFile, as_head, read_bench_or_heads

    file: ReadFile | HeadsFile
    if head.head_of is None:
        file = read_bench_or_heads(options.bench_file)
    else:
        file = as_head(options.bench_file, head.head_of)
    if isinstance(file, HeadsFile):
        asked = heads_run(file, options, display, run, page)
        serve_heads(asked, page.console, run.overwrite, run.as_json)
        return
    serve_bench(file, options, display, run, page, head.fed_by)


def serve_bench(
    file: "ReadFile",
    options: ServeOptions,
    display: DisplayOptions,
    run: RunOptions,
    page: ActingPageOptions,
    fed_by: str | None,
) -> None:
    """Show the live attitude stream on the monitor of one bench; exit code 4 where no attitude
    came.

    `fed_by` as in `fed_link`; None for a bench with a source of its own.
    """
    from hilstar.attitude.wire.source import Mounting
    from hilstar.server.serve import serve as serve_stream

    files = run_files(run, file)
    notices = Notices()
    # In lockstep the simulation waits for each frame: no frame is late, and a run's codes are those
    # of any other machine.
    is_timed = not file.config.attitude.lockstep
    with (
        running.page_listener(page) as listener,
        running.scpi_listener(file, options.scpi, listener, page.token) as instrument,
        _source(file, fed_by, notices) as link,
        running.optional_pulse(file, notices) as pulse,
        running.shown_bench(file, display, timed=is_timed) as (bench, screen),
        shown_run(bench, screen, run, display, notices, files, pulse) as shown,
    ):
        if run.explain:
            mounting = Mounting(file.config.tracker.q_body_to_cam)
            running.explain_bench(bench, of_source=link.conventions.lines(mounting))
        refresh_hz = bench.config.monitor.refresh_hz
        limit = _limit(options, refresh_hz)
        link.await_ready()
        say(f"{link.verb} {link.endpoint}, {refresh_hz:g} Hz, {bench.renderer.gl_renderer}")
        effort = shown.effort()
        optics = running.say_seen(bench) | effort
        running.say_of_light(bench)
        beat: BeatSummary | UnsetType = UNSET
        if is_timed:
            beat = running.say_beat(bench.config, screen)
        followers = Followers(None, listener, page.control, instrument)
        with shown.outlet(
            _described(file, link),
            link.endpoint,
            limit.shortest,
            followers,
            tracker_pictures(link, bench, shown.faults),
        ) as (sink, outlet):
            summary = serve_stream(bench, link, limit, sink, outlet)
    shown.end(replaced(summary, beat=beat, **optics))
    if not summary.packets.accepted:
        say(without_attitude(link.endpoint, summary.packets, link.trouble))
        raise typer.Exit(NO_ATTITUDE)


def _limit(options: ServeOptions, refresh_hz: float) -> "Limit":
    """How long a run lasts by its options; without end where they do not say."""
    from hilstar.server.loop import Limit

    slots: float = math.inf
    if options.duration is not None:
        slots = round(options.duration * refresh_hz)
    return Limit(slots, options.frames or math.inf)


def heads_run(
    file: "HeadsFile",
    options: ServeOptions,
    display: DisplayOptions,
    run: RunOptions,
    page: ActingPageOptions,
) -> "HeadsRun":
    """The run of several heads, with the options that go to each head's process. Raises InputError
    for options of one bench.
    """
    from hilstar.server.heads import HeadsRun

    if display.feed is not None:
        raise InputError(
            f"--feed {display.feed}: one endpoint for several heads; serve one head's file, or"
            " leave it out"
        )
    if options.scpi is not None:
        raise InputError(
            f"--scpi: {options.bench_file} has several heads, and SCPI is one bench's; give the"
            " bench file of a head"
        )
    values = {
        "--frames": options.frames,
        "--ledger-split": run.ledger_split,
        "--scenario": run.scenario,
    }
    switches = {
        "--headless": display.headless,
        "--windowed": display.windowed,
        "--force": display.force,
        "--control": page.control,
        "--overwrite": run.overwrite,
        "--explain": run.explain,
        "--strict": run.strict,
    }
    words = []
    for name, value in values.items():
        if value is not None:
            words += [name, str(value)]
    words += [name for name, is_on in switches.items() if is_on]
    ledger = running.dated_ledger(run.ledger)
    return HeadsRun(file, tuple(words), options.duration, ledger, token=page.token)


def _described(file: "ReadFile", link: "AnyLink") -> "RunDescription":
    """What the page says of the run; where SCPI steers, also the port to which SCPI sends."""
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
