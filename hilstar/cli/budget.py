"""hilstar budget: which magnitudes a bench can show and how well, or the noise of its tracker's
stars.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from hilstar.basics.errors import InputError, did_you_mean, shortened
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.completion import centroiders, offered, sensor_names
from hilstar.cli.options import BenchFile, Json
from hilstar.cli.pointing import RadecText, StarText, optional_attitude
from hilstar.cli.running import say_optics
from hilstar.server.console.terminal import busy, print_found, say

if TYPE_CHECKING:
    from hilstar.server.bench import bench_file as benches


def budget(
    bench_file: BenchFile,
    output: Annotated[
        Path | None,
        Option("-o", "--output", metavar="DIR", help="Directory for a chart and a table."),
    ] = None,
    centroider: Annotated[
        str | None,
        Option(
            metavar="NAME",
            autocompletion=offered(centroiders),
            help=(
                "Who finds the stars: moment, window, wide (a wider window), fit (a PSF), box3 or"
                " box5 (centres of mass), or "
                "all of them; what the bench has under verify, or fit, unless given."
            ),
        ),
    ] = None,
    noise: Annotated[
        bool,
        Option(
            "--noise",
            help="The noise of the tracker's own stars by source, and the limits that it sets.",
        ),
    ] = False,
    radec: RadecText = None,
    star: StarText = None,
    sensor: Annotated[
        str | None,
        Option(
            "--sensor",
            metavar="NAME",
            autocompletion=offered(sensor_names),
            help="Whether this sensor (cmv4000, ...) behind the bench's lens is sensitive enough.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Find which magnitudes this monitor, sprite and quantisation can show, and how accurately."""
    from hilstar.instruments.simulate.budget import By, budget_lines, write_report
    from hilstar.instruments.simulate.budget import budget as find_budget
    from hilstar.server.bench.build import load
    from hilstar.server.bench.cameras import fields_of_view
    from hilstar.server.bench.frame import colour_line, shares_line
    from hilstar.tracker.centroiders import FAMILY

    check_directory("-o", output)
    if noise or sensor is not None:
        if centroider is not None:
            option = "--sensor" if sensor is not None else "--noise"
            raise InputError(f"budget {option}: has every centroider; leave out --centroider")
        star_noise(bench_file, output, radec, star, sensor, as_json)
        return
    for option, given in (("--radec", radec), ("--star", star)):
        if given is not None:
            raise InputError(
                f"budget {option}: names a field of stars whose noise is wanted; add --noise"
            )
    choices: tuple[By, ...] = (*FAMILY, "all")
    by = next((choice for choice in choices if choice == centroider), None)
    if centroider is not None and by is None:
        meant = did_you_mean(centroider, choices)
        raise InputError(
            f"--centroider {shortened(centroider)}: {meant}write one of {', '.join(choices)}"
        )
    with busy("finding the budget"), load(bench_file) as bench:
        fields = fields_of_view(bench.config, bench.file.folder)
        star_budget = find_budget(bench, by)
        assumed = shares_line(bench) or colour_line(bench)
    if output is not None:
        with busy("drawing the chart"):
            write_report(make_directory(output), star_budget)
    print_found(as_json, star_budget, budget_lines(star_budget))
    say_optics(fields, star_budget.star)
    if assumed is not None:
        say(assumed)


def star_noise(
    bench_file: Path,
    output: Path | None,
    radec: str | None,
    star: str | None,
    sensor: str | None,
    as_json: bool,
) -> None:
    """The noise of the tracker's own stars, or of those of another sensor behind its lens."""
    import numpy as np

    from hilstar.instruments.simulate.noise import (
        noise_budget,
        noise_lines,
        sensitivity_line,
        write_noise,
    )
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.tracker.centroids import CentroidSettings

    file = read_bench_file(bench_file)
    epoch_jyear = file.config.sky.epoch_jyear
    attitude = optional_attitude("budget", radec, star, None, epoch_jyear)
    if sensor is not None:
        file = with_its_figures(file, sensor)
    with busy("finding the noise"):
        noise = noise_budget(file, attitude, CentroidSettings(), np.random.default_rng(0))
        if output is not None:
            write_noise(make_directory(output), noise)
    answer = [] if sensor is None else [sensitivity_line(noise)]
    print_found(as_json, noise, [*answer, *noise_lines(noise)])


def with_its_figures(file: "benches.BenchFile", name: str) -> "benches.BenchFile":
    """The bench with another sensor, and a line about where its figures are from."""
    from hilstar.basics.reading import parse_toml
    from hilstar.server.bench.bench_file import changed_file
    from hilstar.server.bench.config.sensor import lacking, named_keys, other_sensor
    from hilstar.tracker.sensors import sensor_named

    other = other_sensor(parse_toml(file.path, file.text), name)
    changed = changed_file(file, other.tables)
    sensor = sensor_named(name, "--sensor")
    say(f"{sensor.name}: {sensor.source}")
    if other.kept:
        beside = f", with {named_keys(other.beside)}" if other.beside else ""
        say(f"its sheet has no {lacking(sensor, other.kept)}: the bench's stand{beside}")
    if other.dropped:
        say(f"left out, as they are the old sensor's: {named_keys(other.dropped)}")
    return changed
