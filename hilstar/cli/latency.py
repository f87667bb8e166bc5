"""hilstar latency: from swap to light, by a photodiode."""

import time
from pathlib import Path
from typing import Annotated

from typer import Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import CSV, check_directory, check_ending
from hilstar.cli.options import Json, Overwrite, RunFile, check_files, parse_diode
from hilstar.server.console.terminal import busy, print_found

LEDGER_BEHIND_S = 0.5  # the newest part of a running ledger may not be on the disk yet


def latency(
    ledger: RunFile,
    edges: Annotated[
        Path | None, Option(metavar="EDGES.csv", help="Edges from a file: host_ns,level.")
    ] = None,
    diode: Annotated[
        str | None,
        Option(
            metavar="serial:/dev/ttyX@BAUD", help="Read edges from this device while serve runs."
        ),
    ] = None,
    duration: Annotated[
        float, Option(metavar="SECONDS", help="How long to read edges.", min=0.5, max=3600)
    ] = 10.0,
    save: Annotated[
        Path | None, Option(metavar="EDGES.csv", help="Save the edges that were read.")
    ] = None,
    write: Annotated[
        Path | None, Option(metavar="BENCH.toml", help="Set panel_delay_ms in this bench file.")
    ] = None,
    output: Annotated[
        Path | None, Option("-o", "--output", metavar="DIR", help="Directory for the chart.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Measure the latency from swap to light, by a photodiode over the screen's square and the
    run's ledger.
    """
    from hilstar.instruments.calibrate import latency as by_diode

    check_directory("-o", output)
    check_ending("--save", save, CSV)
    check_files(
        [ledger, edges],
        [write, None if output is None else output / "latency.png"],
        None,
        save,
        overwrite,
    )
    if (edges is None) == (diode is None):
        raise InputError(
            "latency: give the edges with either --edges EDGES.csv or --diode"
            " serial:/dev/ttyX@115200"
        )
    if diode is None:
        edges_read = by_diode.read_edges(edges or Path())
    else:
        with busy(f"reading edges for {duration:g} s"):
            edges_read = by_diode.capture_edges(*parse_diode(diode), duration)
        time.sleep(LEDGER_BEHIND_S)
    if save is not None:
        by_diode.save_edges(save, edges_read)
    summary = by_diode.measure_latency(ledger, edges_read, output)
    print_found(as_json, summary, by_diode.latency_lines(summary))
    if write is not None:
        by_diode.write_panel_delay(write, summary["panel_delay_ms"], summary["panel_delay_u_ms"])
