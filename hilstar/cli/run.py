"""Commands about a run that was kept in a ledger: report, latency."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.common import Json, Overwrite, app, check_files
from hilstar.console.terminal import print_json
from hilstar.errors import InputError
from hilstar.files import CSV, check_directory, check_ending, make_directory

LEDGER_BEHIND_S = 0.5  # so much of a run that goes on may not be on the disk yet
RunFile = Annotated[Path, typer.Argument(metavar="RUN.mcap", help="The ledger of serve or replay.")]


@app.command()
def report(
    ledger: RunFile,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where report.html and its charts go.")],
    as_json: Json = False,
) -> None:
    """Timing, age of the attitude, missed frames and memory of a run, on one page with charts."""
    from hilstar.run.record.report import report as write_report
    from hilstar.run.record.report import table_rows

    check_directory("-o", output)
    make_directory(output)
    summary = write_report(ledger, output)
    if as_json:
        print_json(summary)
        return
    for what, how_much in table_rows(summary):
        typer.echo(f"{what:32}{how_much}")
    typer.echo(f"{'page':32}{output / 'report.html'}")


@app.command()
def latency(
    ledger: RunFile,
    edges: Annotated[Path | None, typer.Option(metavar="EDGES.csv", help="Edges that were kept: host_ns,level.")] = None,
    diode: Annotated[
        str | None, typer.Option(metavar="serial:/dev/ttyX@BAUD", help="Read edges there while serve runs.")
    ] = None,
    duration: Annotated[float, typer.Option(help="Seconds to read edges for.", min=0.5, max=3600)] = 10.0,
    save: Annotated[Path | None, typer.Option(metavar="EDGES.csv", help="Keep the edges that were read.")] = None,
    write: Annotated[Path | None, typer.Option(metavar="BENCH.toml", help="Set panel_delay_ms in it.")] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="DIR", help="Where the chart goes.")] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """From swap to light, by a photodiode before the screen's square and the ledger of the run."""
    from hilstar.calibrate.latency import capture_edges, read_edges, save_edges, write_panel_delay
    from hilstar.calibrate.latency_chart import measure, told
    from hilstar.run.send.sender import parse_serial

    check_directory("-o", output)
    check_ending("--save", save, CSV)
    check_files([ledger, edges], [write, None if output is None else output / "latency.png"], None, save, overwrite)
    if (edges is None) == (diode is None):
        raise InputError("latency: give the edges with --edges EDGES.csv or --diode serial:/dev/ttyX@115200, one of them")
    if diode is None:
        found = read_edges(edges or Path())
    else:
        port = parse_serial(diode)
        if port is None:
            raise InputError(f"--diode {diode}: write serial:/dev/ttyX@BAUD, such as serial:/dev/ttyACM0@115200")
        found = capture_edges(*port, duration)
        time.sleep(LEDGER_BEHIND_S)
    if save is not None:
        save_edges(save, found)
    summary = measure(ledger, found, None if output is None else make_directory(output))
    if as_json:
        print_json(summary)
    else:
        for what, how_much in told(summary):
            typer.echo(f"{what:24}{how_much}")
    if write is not None:
        write_panel_delay(write, summary["panel_delay_ms"])
