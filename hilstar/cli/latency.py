"""hilstar latency: from swap to light, by a photodiode."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from hilstar.basics.errors import InputError
from hilstar.basics.files import CSV, check_directory, check_ending
from hilstar.cli.declare import option, struct
from hilstar.cli.options import (
    check_files,
    json_option,
    ledger_argument,
    output_option,
    overwrite_option,
    parse_diode,
)
from hilstar.server.console.terminal import busy, print_found, say

if TYPE_CHECKING:
    from hilstar.instruments.calibrate.latency import Edges

LEDGER_BEHIND_S = 0.5  # the newest part of a running ledger may not be on the disk yet


@struct
class LatencyOptions:
    """The options of `hilstar latency`."""

    ledger: Path = ledger_argument()
    edges: Path | None = option("EDGES.csv", "Edges from a file: host_ns,level.")
    diode: str | None = option(
        "serial:/dev/ttyX@BAUD", "Read edges from this device while serve runs."
    )
    grab: str | None = option(
        "genicam:NAME", "Film the square by this camera while serve runs, in place of a photodiode."
    )
    exposure: float | None = option(
        "S", "With --grab: the exposure; by default a fifth of a refresh.", min=1e-6, max=1
    )
    duration: float = option("SECONDS", "How long to read edges.", default=10.0, min=0.5, max=3600)
    save: Path | None = option("EDGES.csv", "Save the edges that were read.")
    write: Path | None = option("BENCH.toml", "Set panel_delay_ms in this bench file.")
    output: Path | None = output_option("DIR", "Directory for the chart.")
    overwrite: bool = overwrite_option()
    as_json: bool = json_option()


def latency(options: LatencyOptions) -> None:
    """Measure the latency from swap to light, by a photodiode over the screen's square, or a camera
    that sees it, and the run's ledger.
    """
    from hilstar.instruments.calibrate import latency as by_diode

    check_directory("-o", options.output)
    check_ending("--save", options.save, CSV)
    chart = None
    if options.output is not None:
        chart = options.output / "latency.png"
    inputs = [options.ledger, options.edges]
    check_files(inputs, [options.write, chart], None, options.save, options.overwrite)
    if [options.edges, options.diode, options.grab].count(None) != 2:
        raise InputError(
            "latency: give the edges with one of --edges EDGES.csv, --diode"
            " serial:/dev/ttyX@115200 and --grab genicam:NAME"
        )
    if options.exposure is not None and options.grab is None:
        raise InputError("--exposure: is for --grab; leave it out")
    edges_read = _edges(options)
    if options.save is not None:
        by_diode.save_edges(options.save, edges_read)
    summary = by_diode.measure_latency(options.ledger, edges_read, options.output)
    print_found(options.as_json, summary, by_diode.latency_lines(summary))
    if options.write is not None:
        delay_ms = summary["panel_delay_ms"]
        by_diode.write_panel_delay(options.write, delay_ms, summary["panel_delay_u_ms"])


def _edges(options: LatencyOptions) -> "Edges":
    """Edges of a file, by a photodiode or by a camera. Raises InputError, MachineError."""
    from hilstar.instruments.calibrate import latency as by_diode

    if options.edges is not None:
        return by_diode.read_edges(options.edges)
    if options.diode is not None:
        port, baud = parse_diode(options.diode)
        with busy(f"reading edges for {options.duration:g} s"):
            edges = by_diode.capture_edges(port, baud, options.duration)
    else:
        grab = options.grab or ""
        with busy(f"filming the square for {options.duration:g} s"):
            edges = _filmed(options.ledger, grab, options.duration, options.exposure)
    time.sleep(LEDGER_BEHIND_S)
    return edges


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
