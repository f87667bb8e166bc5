"""hilstar simulate: the virtual tracker's image of the sky."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from hilstar.basics.errors import InputError
from hilstar.basics.files import FITS, PNG, PNG_OR_TIFF, check_directory, check_ending
from hilstar.cli.declare import option, struct
from hilstar.cli.options import (
    LogStatements,
    at_option,
    bench_argument,
    check_files,
    json_option,
    output_option,
    parse_at,
    parse_numbers,
    scenario_option,
    seed_option,
)
from hilstar.cli.pointing import PointingOptions, attitude_of
from hilstar.cli.running import optional_scenario, say_units_of
from hilstar.server.console.terminal import busy, print_found, progress, say

if TYPE_CHECKING:
    from hilstar.instruments.simulate.simulator import Exposure, FrameNoise


@struct
class SimulateOptions:
    """The options of `hilstar simulate`."""

    bench_file: Path = bench_argument()
    slew: str | None = option("X,Y,Z", "Angular rate of the camera about its own axes, deg/s.")
    at: float | None = at_option()
    scenario: Path | None = scenario_option()
    log: Path | None = option("LOG", "Simulate frames along a log, into the directory given by -o.")
    frames: int | None = option(
        "N", "With --log: this many, evenly spaced; by default one for each sample.", min=1
    )
    seed: int = seed_option("Seed of the frame's noise.")
    noise: Literal["full", "none"] = option(
        "", "The detector's full noise, or none.", default="full"
    )
    output: Path | None = output_option("OUT.fits", "The image in DN, uint16.")
    png: Path | None = option("OUT.png", "A picture stretched for the eye.")
    dn_png: Path | None = option("OUT.png|.tif", "The DN themselves, as 16-bit greyscale.")
    as_json: bool = json_option()


def simulate(
    pointing: PointingOptions, options: SimulateOptions, statements: LogStatements
) -> None:
    """Simulate the virtual tracker's image of the sky, with noise."""
    import numpy as np

    from hilstar.instruments.simulate import pictures as files
    from hilstar.instruments.simulate.exposures import faulty_exposure
    from hilstar.instruments.simulate.simulator import FrameNoise, Simulator
    from hilstar.server.bench.bench_file import at_moment, read_bench_file

    noise = FrameNoise(options.noise, options.seed)
    if options.log is not None:
        of_frame = (options.slew, options.at, options.png, options.dn_png, *pointing.given)
        if options.output is None or any(value is not None for value in of_frame):
            raise InputError(
                "simulate --log LOG: give -o DIR, and no --radec, --star, --quaternion, --slew,"
                " --at, --png or --dn-png"
            )
        check_directory("-o", options.output)
        simulate_log(options.log, options.output, noise, options, statements)
        return
    statements.refuse("it is for --log LOG, and there is none; leave it out")
    file = read_bench_file(options.bench_file)
    paths = (options.output, options.png, options.dn_png)
    targets = [path for path in paths if path is not None]
    if not targets:
        raise InputError(
            "simulate: no output was asked for; add -o OUT.fits, --png OUT.png or --dn-png OUT.png"
        )
    check_ending("-o", options.output, FITS)
    check_ending("--png", options.png, PNG)
    check_ending("--dn-png", options.dn_png, PNG_OR_TIFF)
    wrong = optional_scenario(options.scenario)
    check_files([options.scenario], targets, file)
    q = attitude_of("simulate", pointing, file.config.sky.epoch_jyear)
    t_ns = parse_at("simulate", options.at, file.config, wrong is not None)
    file = at_moment(file, t_ns)
    rate_deg_s = [0.0, 0.0, 0.0]
    if options.slew:
        rate_deg_s = parse_numbers(options.slew, 3, "--slew", "X,Y,Z in deg/s")
    with busy("exposing"), Simulator(file) as simulator:
        view = simulator.view(q, np.radians(rate_deg_s), t_ns)
        faults = None
        if wrong is not None:
            faults = faulty_exposure(simulator, [view], wrong, t_ns or 0)
        exposure = simulator.expose(view, noise.rng(), faults=faults)
        if options.output is not None:
            files.write_exposure_fits(options.output, simulator, exposure, noise)
        if options.png is not None:
            files.write_exposure_png(options.png, exposure.dn, file.config.tracker.detector)
        if options.dn_png is not None:
            files.write_dn_picture(options.dn_png, exposure.dn)
        summary = _summary(exposure, targets, simulator.renderer.gl_renderer)
    print_found(options.as_json, summary, [_exposure_line(summary)])
    say_units_of(file)  # after the refusals: a failing command prints one line


def _summary(exposure: "Exposure", targets: list[Path], renderer: str) -> dict[str, Any]:
    """An exposure and its files by the keys of --json."""
    from hilstar.optics.layers.truth import clipped_in

    dn = {
        "min": int(exposure.dn.min()),
        "mean": float(exposure.dn.mean()),
        "max": int(exposure.dn.max()),
    }
    return {
        "stars": len(exposure.truth),
        "clipped": clipped_in(exposure.truth),
        "capped": exposure.capped,
        "dn": dn,
        "faults": list(exposure.faults),
        "written": [str(path) for path in targets],
        "gl_renderer": renderer,
    }


def _exposure_line(summary: dict[str, Any]) -> str:
    """The same as a line of text."""
    line = f"{summary['stars']} stars"
    if summary["faults"]:
        line += f", faults: {', '.join(summary['faults'])}"
    dn = summary["dn"]
    return f"{line}, DN {dn['min']} to {dn['max']}; wrote {', '.join(summary['written'])}"


def simulate_log(
    log: Path,
    output: Path,
    noise: "FrameNoise",
    options: SimulateOptions,
    statements: LogStatements,
) -> None:
    """The virtual tracker along a log."""
    from hilstar.attitude.logs.log_file import open_log
    from hilstar.instruments.simulate.batch import simulate_views
    from hilstar.instruments.simulate.exposures import LogFaults, log_views
    from hilstar.server.bench.bench_file import dated, read_bench_file

    wrong = optional_scenario(options.scenario)
    file = read_bench_file(options.bench_file)
    config = file.config
    read = open_log(log, statements.stated(config))
    samples = read.samples
    file = dated(file, read.conventions.scale, samples[0].t_ns)
    for _, line in [*read.told, *read.joins().told]:
        say(line)
    max_rate_rad_s = math.radians(config.attitude.max_rate_deg_s)
    views = log_views(samples, options.frames, config.tracker.exposure_s, max_rate_rad_s)
    faults = None
    if wrong is not None:
        faults = LogFaults(wrong, samples, max_rate_rad_s)
    with progress("exposing", len(views)) as advance:
        simulate_views(file, views, noise, output, advance, faults)
    typer.echo(f"{len(views)} exposures in {output}")
    say_units_of(file)
