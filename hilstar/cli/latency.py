"""hilstar latency: from swap to light, by a photodiode."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import CSV, check_directory, check_ending
from hilstar.cli.options import Json, Overwrite, RunFile, check_files, parse_diode
from hilstar.server.console.terminal import busy, print_found, say

if TYPE_CHECKING:
    from hilstar.instruments.calibrate.latency import Edges

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
    grab: Annotated[
        str | None,
        Option(
            metavar="genicam:NAME",
            help="Film the square by this camera while serve runs, in place of a photodiode.",
        ),
    ] = None,
    exposure: Annotated[
        float | None,
        Option(
            metavar="S",
            help="With --grab: the exposure; by default a fifth of a refresh.",
            min=1e-6,
            max=1,
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
    """Measure the latency from swap to light, by a photodiode over the screen's square, or a camera
    that sees it, and the run's ledger.
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
    if [edges, diode, grab].count(None) != 2:
        raise InputError(
            "latency: give the edges with one of --edges EDGES.csv, --diode"
            " serial:/dev/ttyX@115200 and --grab genicam:NAME"
        )
    if exposure is not None and grab is None:
        raise InputError("--exposure: is for --grab; leave it out")
    if edges is not None:
        edges_read = by_diode.read_edges(edges)
    elif diode is not None:
        with busy(f"reading edges for {duration:g} s"):
            edges_read = by_diode.capture_edges(*parse_diode(diode), duration)
        time.sleep(LEDGER_BEHIND_S)
    else:
        with busy(f"filming the square for {duration:g} s"):
            edges_read = _filmed(ledger, grab or "", duration, exposure)
        time.sleep(LEDGER_BEHIND_S)
    if save is not None:
        by_diode.save_edges(save, edges_read)
    summary = by_diode.measure_latency(ledger, edges_read, output)
    print_found(as_json, summary, by_diode.latency_lines(summary))
    if write is not None:
        by_diode.write_panel_delay(write, summary["panel_delay_ms"], summary["panel_delay_u_ms"])


def _filmed(ledger: Path, grab: str, seconds: float, exposure_s: float | None) -> "Edges":
    """Edges by a camera, set as the run's bench file says. Raises InputError, MachineError."""
    from hilstar.instruments.calibrate.camera_edges import film_edges
    from hilstar.server.genicam.camera import PREFIX, GenicamCamera
    from hilstar.server.record.ledger_records import config_of, read_head

    if not grab.startswith(PREFIX):
        raise InputError(
            f"--grab {grab}: a command takes one image at a time; write {PREFIX}NAME, or --diode"
        )
    config = config_of(read_head(ledger))
    if config is None:
        raise InputError(
            f"{ledger}: its header has no bench file that can be read; record the run again"
        )
    with GenicamCamera(grab.removeprefix(PREFIX)) as camera:
        camera.set(config.tracker.camera.settings())
        edges = film_edges(camera, seconds, exposure_s, config.monitor.refresh_hz)
    say("the camera's own delay, from the end of an exposure to its first byte, is in the latency")
    return edges
