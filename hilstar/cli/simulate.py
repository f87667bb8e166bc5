"""hilstar simulate: the virtual tracker's image of the sky."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import FITS, PNG, PNG_OR_TIFF, check_directory, check_ending
from hilstar.cli import options
from hilstar.cli.pointing import QuaternionText, RadecText, StarText, attitude_of
from hilstar.cli.running import optional_scenario, say_units_of
from hilstar.server.console.terminal import busy, print_found, progress, say

if TYPE_CHECKING:
    from hilstar.instruments.simulate.simulator import FrameNoise


@options.log_statements
def simulate(
    bench_file: options.BenchFile,
    radec: RadecText = None,
    star: StarText = None,
    quaternion: QuaternionText = None,
    slew: Annotated[
        str | None,
        Option(metavar="X,Y,Z", help="Angular rate of the camera about its own axes, deg/s."),
    ] = None,
    at: options.AtSeconds = None,
    scenario: options.ScenarioFile = None,
    log: Annotated[
        Path | None,
        Option(metavar="LOG", help="Simulate frames along a log, into the directory given by -o."),
    ] = None,
    frames: Annotated[
        int | None,
        Option(
            metavar="N",
            help="With --log: this many, evenly spaced; by default one for each sample.",
            min=1,
        ),
    ] = None,
    statements: options.LogStatements = options.NOTHING_STATED,
    seed: Annotated[int, options.seed_option("Seed of the frame's noise.")] = 0,
    noise: Annotated[
        Literal["full", "none"], Option(help="The detector's full noise, or none.")
    ] = "full",
    output: Annotated[
        Path | None, Option("-o", "--output", metavar="OUT.fits", help="The image in DN, uint16.")
    ] = None,
    png: Annotated[
        Path | None, Option(metavar="OUT.png", help="A picture stretched for the eye.")
    ] = None,
    dn_png: Annotated[
        Path | None, Option(metavar="OUT.png|.tif", help="The DN themselves, as 16-bit greyscale.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Simulate the virtual tracker's image of the sky, with noise."""
    import numpy as np

    from hilstar.instruments.simulate import pictures as files
    from hilstar.instruments.simulate.exposures import faulty_exposure
    from hilstar.instruments.simulate.simulator import FrameNoise, Simulator
    from hilstar.optics.layers.truth import clipped_in
    from hilstar.server.bench.bench_file import at_moment, read_bench_file

    if log is not None:
        if output is None or radec or star or quaternion or slew or png or dn_png or at is not None:
            raise InputError(
                "simulate --log LOG: give -o DIR, and no --radec, --star, --quaternion, --slew,"
                " --at, --png or --dn-png"
            )
        check_directory("-o", output)
        simulate_log(bench_file, log, frames, FrameNoise(noise, seed), output, scenario, statements)
        return
    statements.refuse("it is for --log LOG, and there is none; leave it out")
    file = read_bench_file(bench_file)
    targets = [path for path in (output, png, dn_png) if path is not None]
    if not targets:
        raise InputError(
            "simulate: no output was asked for; add -o OUT.fits, --png OUT.png or --dn-png OUT.png"
        )
    check_ending("-o", output, FITS)
    check_ending("--png", png, PNG)
    check_ending("--dn-png", dn_png, PNG_OR_TIFF)
    wrong = optional_scenario(scenario)
    options.check_files([scenario], targets, file)
    q = attitude_of("simulate", radec, star, quaternion, file.config.sky.epoch_jyear)
    t_ns = options.parse_at("simulate", at, file.config, wrong is not None)
    file = at_moment(file, t_ns)
    if slew:
        rate_rad_s = np.radians(options.parse_numbers(slew, 3, "--slew", "X,Y,Z in deg/s"))
    else:
        rate_rad_s = np.zeros(3)
    with busy("exposing"), Simulator(file) as simulator:
        frame_noise = FrameNoise(noise, seed)
        view = simulator.view(q, rate_rad_s, t_ns)
        if wrong is None:
            faults = None
        else:
            faults = faulty_exposure(simulator, view, wrong, t_ns or 0)
        exposure = simulator.expose(view, frame_noise.rng(), faults=faults)
        if output is not None:
            files.write_exposure_fits(output, simulator, exposure, frame_noise)
        if png is not None:
            files.write_exposure_png(png, exposure.dn, file.config.tracker.detector)
        if dn_png is not None:
            files.write_dn_picture(dn_png, exposure.dn)
        summary: dict[str, Any] = {
            "stars": len(exposure.truth),
            "clipped": clipped_in(exposure.truth),
            "capped": exposure.capped,
            "dn": {
                "min": int(exposure.dn.min()),
                "mean": float(exposure.dn.mean()),
                "max": int(exposure.dn.max()),
            },
            "faults": list(exposure.faults),
            "written": [str(path) for path in targets],
            "gl_renderer": simulator.renderer.gl_renderer,
        }
    dn = summary["dn"]
    named = f", faults: {', '.join(exposure.faults)}" if exposure.faults else ""
    line = (
        f"{summary['stars']} stars{named}, DN {dn['min']} to {dn['max']}; wrote"
        f" {', '.join(summary['written'])}"
    )
    print_found(as_json, summary, [line])
    say_units_of(file)  # after the refusals: a failing command prints one line


def simulate_log(
    bench_file: Path,
    log: Path,
    frames: int | None,
    noise: "FrameNoise",
    output: Path,
    scenario: Path | None,
    statements: options.LogStatements,
) -> None:
    """The virtual tracker along a log."""
    from hilstar.attitude.logs.log_file import open_log
    from hilstar.instruments.simulate.batch import simulate_views
    from hilstar.instruments.simulate.exposures import LogFaults, log_views
    from hilstar.server.bench.bench_file import dated, read_bench_file

    wrong = optional_scenario(scenario)
    file = read_bench_file(bench_file)
    config = file.config
    read = open_log(log, statements.stated(config))
    samples = read.samples
    file = dated(file, read.conventions.scale, samples[0].t_ns)
    for _, line in [*read.told, *read.joins().told]:
        say(line)
    max_rate_rad_s = math.radians(config.attitude.max_rate_deg_s)
    views = log_views(samples, frames, config.tracker.exposure_s, max_rate_rad_s)
    if wrong is None:
        faults = None
    else:
        faults = LogFaults(wrong, samples, max_rate_rad_s)
    with progress("exposing", len(views)) as advance:
        simulate_views(file, views, noise, output, advance, faults)
    typer.echo(f"{len(views)} exposures in {output}")
    say_units_of(file)
