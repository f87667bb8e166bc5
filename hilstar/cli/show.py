"""Commands that show stars: demo, frame, serve, replay."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from hilstar.cli.common import (
    LOG_HELP,
    MAX_SEED,
    BenchFile,
    Headless,
    Json,
    Overwrite,
    QuaternionText,
    RadecText,
    app,
    attitude_of,
    check_files,
)
from hilstar.console.terminal import print_json, progress, report, say
from hilstar.errors import InputError, MachineError
from hilstar.files import CSV, FITS, MCAP, PNG, check_directory, check_ending
from hilstar.notices import Notices
from hilstar.process.interrupts import stop_on_signal

Windowed = Annotated[bool, typer.Option("--windowed", help="A window on the desk instead of the whole display.")]
Force = Annotated[bool, typer.Option("--force", help="Show on a display that the start-up gate refuses; logged.")]
Explain = Annotated[bool, typer.Option("--explain", help="What was chosen for the scene, its error and saving, on stderr.")]
LedgerFile = Annotated[Path | None, typer.Option("--ledger", metavar="RUN.mcap", help="Keep every packet and frame there.")]

LedgerSplit = Annotated[
    str | None,
    typer.Option("--ledger-split", metavar="1GB|1h", help="Go on in RUN.0001.mcap and so on after so much, or so long."),
]
NO_ATTITUDE = 4  # the exit code of a run that never had one


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Where the pictures go.")] = Path("hilstar-demo"),
    duration: Annotated[float, typer.Option(help="Seconds to serve.", min=0.5, max=600)] = 10.0,
    seed: Annotated[int, typer.Option(help="Seed of the slew's jitter.", min=0, max=MAX_SEED)] = 1,
    as_json: Json = False,
) -> None:
    """The main job in one command: real stars, an attitude streamed over a real ZeroMQ socket, frames out."""
    from hilstar.run.demo import run_demo

    check_directory("-o", output)
    with progress("serving", duration * 60) as advance:
        result = run_demo(output, duration, np.random.default_rng(seed), lambda shown: advance(shown.number + 1))
    report(result.summary, as_json)
    if not as_json:
        typer.echo(f"{'pictures':20}{output}/frame_*_codes.png (what the monitor gets), _preview.png (stretched)")


@app.command()
def frame(
    bench_file: BenchFile,
    radec: RadecText = None,
    quaternion: QuaternionText = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="OUT.fits", help="Linear image.")] = None,
    truth: Annotated[Path | None, typer.Option(metavar="OUT.csv", help="A row for each star in view.")] = None,
    codes: Annotated[Path | None, typer.Option(metavar="OUT.png", help="The code values.")] = None,
    preview: Annotated[Path | None, typer.Option(metavar="OUT.png", help="A stretched picture for a person.")] = None,
    explain: Explain = False,
    as_json: Json = False,
) -> None:
    """Draw one frame into files."""
    from hilstar.bench import frame_files as files
    from hilstar.bench.build import load

    q = attitude_of("frame", radec, quaternion)
    targets = [path for path in (output, truth, codes, preview) if path is not None]
    if not targets:
        raise InputError("frame: nothing to write; add -o OUT.fits, --truth OUT.csv or --codes OUT.png")
    check_ending("-o", output, FITS)
    check_ending("--truth", truth, CSV)
    check_ending("--codes", codes, PNG)
    check_ending("--preview", preview, PNG)
    check_files([], targets, bench_file)
    with load(bench_file) as bench:
        if explain:
            explain_effort(bench)
        shot = bench.frame(q)
        if output is not None:
            files.write_frame_fits(output, bench, shot)
        if truth is not None:
            files.write_truth_csv(truth, shot)
        if codes is not None:
            files.write_codes_png(codes, shot.codes, bench.config.monitor.bits)
        if preview is not None:
            files.write_preview_png(preview, shot.levels)
        clipped = shot.truth["hip"][shot.truth["clipped"]].tolist()
        summary = {
            "stars": len(shot.truth),
            "electrons_per_s": float(shot.linear.sum(dtype=np.float64)),
            "flux_at_white_e_per_s": bench.flux_at_white_e_per_s,
            "clipped": clipped,
            "clipped_mag": bench.losses_mag(shot),
            "left_out": left_out(shot.truth),
            "calibration": {"name": bench.calibration.name, "sha256": bench.calibration.sha256},
            "written": [str(path) for path in targets],
            "gl_renderer": bench.renderer.gl_renderer,
        }
    if as_json:
        print_json(summary)
    else:
        losses = ", ".join(f"{hip} by {mag:.2f} mag" for hip, mag in summary["clipped_mag"].items())
        names = f", clipped: HIP {losses}" if clipped else ""
        missing = summary["left_out"]
        if missing["stars"]:
            names += f", {missing['stars']} too faint to show ({missing['flux_share']:.2%} of all light)"
        typer.echo(f"{len(shot.truth)} stars{names}; wrote {', '.join(summary['written'])}")


def explain_effort(bench: Any) -> None:
    """Say what was chosen within the bench file's tolerance."""
    from hilstar.bench.effort import explain

    for line in explain(bench.effort, bench.config.render):
        say(line)


@contextmanager
def shown_bench(bench_file: Path, headless: bool, windowed: bool, force: bool) -> Iterator[tuple[Any, Any]]:
    """The bench, and the screen that it is on; None when headless."""
    if headless:
        from hilstar.bench.build import load

        with load(bench_file) as bench:
            yield bench, None
        return
    from hilstar.run.screen.screen import open_screen

    with open_screen(bench_file, windowed=windowed, force=force) as screen:
        yield screen.bench, screen


def say_what_clips(bench: Any) -> None:
    """Name the stars that this bench cannot show as bright as they are."""
    from hilstar.bench.white import clipping_line

    line = clipping_line(bench)
    if line is not None:
        say(line)


@contextmanager
def optional_ledger(path: Path | None, bench: Any, notices: Notices, overwrite: bool, split: Any) -> Iterator[Any]:
    """The run's ledger, which keeps the run's events too, or nothing where none was asked for."""
    from hilstar.run.record.ledger import Ledger

    if path is None:
        yield None
        return
    ledger = Ledger(path, bench, notices, overwrite, split)
    notices.listen(ledger.notice)
    try:
        yield ledger
    finally:
        with stop_on_signal(threading.Event()):  # a signal that comes now does not interrupt this
            ledger.close()


def end_of_run(summary: dict[str, Any], screen: Any, ledger: Any, as_json: bool) -> None:
    """The summary of a run whose ledger is closed; exit code 1 where that has failed.

    Raises MachineError where its window went away.
    """
    if ledger is not None:
        summary |= {"ledger": ledger.summary()}
    report(summary, as_json)
    if screen is not None and screen.window.gone is not None:
        raise MachineError(f"the run ended early: {screen.window.gone}")
    if ledger is not None and ledger.failure is not None:
        raise typer.Exit(1)


def left_out(truth: Any) -> dict[str, float | int]:
    """The stars in view that the monitor cannot show: how many, and their part of all light."""
    missing = truth["electrons_per_s"][~truth["drawn"]]
    total = float(truth["electrons_per_s"].sum())
    return {"stars": len(missing), "flux_share": float(missing.sum()) / total if total else 0.0}


@app.command()
def serve(
    bench_file: BenchFile,
    headless: Headless = False,
    duration: Annotated[float | None, typer.Option(help="Seconds to run; until Ctrl-C by default.", min=0, max=1e8)] = None,
    frames: Annotated[int | None, typer.Option(help="Frames to draw.", min=1)] = None,
    ledger: LedgerFile = None,
    ledger_split: LedgerSplit = None,
    overwrite: Overwrite = False,
    windowed: Windowed = False,
    force: Force = False,
    explain: Explain = False,
    as_json: Json = False,
) -> None:
    """Show the live attitude stream."""
    from hilstar.bench.config import read_config
    from hilstar.run.loop import Limit
    from hilstar.run.record.ledger import parse_split
    from hilstar.run.serve import Outlet, open_link
    from hilstar.run.serve import serve as serve_stream

    check_ending("--ledger", ledger, MCAP)
    check_files([], [], bench_file, ledger, overwrite)
    split = parse_split(ledger_split)
    notices = Notices()
    with (
        open_link(read_config(bench_file).attitude, bench_file.parent, notices) as link,
        shown_bench(bench_file, headless, windowed, force) as (bench, screen),
        optional_ledger(ledger, bench, notices, overwrite, split) as kept,
    ):
        if explain:
            explain_effort(bench)
        refresh_hz = bench.config.monitor.refresh_hz
        slots = math.inf if duration is None else round(duration * refresh_hz)
        limit = Limit(slots, math.inf if frames is None else frames)
        say(f"{link.verb} {link.endpoint}, {refresh_hz:g} Hz, {bench.renderer.gl_renderer}")
        say_what_clips(bench)
        with progress("serving", min(limit.slots, limit.frames)) as advance:
            summary = serve_stream(bench, link, limit, lambda shown: advance(shown.number + 1), Outlet(screen, kept, notices))
    end_of_run(summary, screen, kept, as_json)
    if not summary["packets"]["accepted"]:
        raise typer.Exit(NO_ATTITUDE)


@app.command()
def replay(
    bench_file: BenchFile,
    log: Annotated[Path, typer.Argument(metavar="LOG", help=LOG_HELP)],
    speed: Annotated[str, typer.Option(metavar="realtime|max|N", help="1, at once, or N times real time.")] = "realtime",
    start: Annotated[float | None, typer.Option(metavar="S", help="Seconds after the log's first sample.")] = None,
    stop: Annotated[float | None, typer.Option(metavar="S", help="Seconds after the log's first sample.")] = None,
    step: Annotated[float | None, typer.Option(metavar="S", help="Seconds of the log from frame to frame.")] = None,
    headless: Headless = False,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="DIR", help="Write each frame there.")] = None,
    ledger: LedgerFile = None,
    ledger_split: LedgerSplit = None,
    overwrite: Overwrite = False,
    windowed: Windowed = False,
    force: Force = False,
    explain: Explain = False,
    as_json: Json = False,
) -> None:
    """Show an attitude log."""
    from hilstar.bench.config import read_config
    from hilstar.run.record.frame_sequence import FrameRecorder
    from hilstar.run.record.ledger import parse_split
    from hilstar.run.replay import Wanted, plan_play
    from hilstar.run.serve import Outlet
    from hilstar.run.serve import replay as replay_log

    check_directory("-o", output)
    check_ending("--ledger", ledger, MCAP)
    check_files([log], [None if output is None else output / "frames.csv"], bench_file, ledger, overwrite)
    split = parse_split(ledger_split)
    notices = Notices()
    play = plan_play(log, Wanted(speed, start, stop, step), read_config(bench_file))
    with (
        shown_bench(bench_file, headless, windowed, force) as (bench, screen),
        FrameRecorder(output, bench) as record,
        optional_ledger(ledger, bench, notices, overwrite, split) as kept,
        progress("replaying", play.frame_count) as advance,
    ):
        say_what_clips(bench)
        if explain:
            explain_effort(bench)

        def sink(shown: Any) -> None:
            record(shown)
            advance(shown.number + 1)

        summary = replay_log(bench, play, sink, Outlet(screen, kept, notices))
    end_of_run(summary, screen, kept, as_json)
