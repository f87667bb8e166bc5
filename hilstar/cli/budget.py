"""hilstar budget: which magnitudes a bench can show and how well, or the noise of its tracker's
stars.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from hilstar.basics.errors import InputError, did_you_mean, shortened
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.completion import centroiders, offered, sensor_names
from hilstar.cli.declare import option, struct, switch
from hilstar.cli.options import bench_argument, json_option, output_option
from hilstar.cli.pointing import PlaceOptions, place_of
from hilstar.cli.running import say_optics
from hilstar.server.console.terminal import busy, print_found, say

if TYPE_CHECKING:
    from hilstar.server.bench import bench_file as benches


@struct
class BudgetOptions:
    """The options of `hilstar budget`."""

    bench_file: Path = bench_argument()
    output: Path | None = output_option("DIR", "Directory for a chart and a table.")
    centroider: str | None = option(
        "NAME",
        "Who finds the stars: moment, window, wide (a wider window), fit (a PSF), box3 or box5"
        " (centres of mass), or all of them; what the bench has under verify, or fit, unless"
        " given.",
        autocompletion=offered(centroiders),
    )
    noise: bool = switch(
        "The noise of the tracker's own stars by source, and the limits that it sets."
    )
    sensor: str | None = option(
        "NAME",
        "Whether this sensor (cmv4000, ...) behind the bench's lens is sensitive enough.",
        autocompletion=offered(sensor_names),
    )
    as_json: bool = json_option()


def budget(options: BudgetOptions, pointing: PlaceOptions) -> None:
    """Find which magnitudes this monitor, sprite and quantisation can show, and how accurately."""
    from hilstar.instruments.simulate.budget import By, budget_lines, write_report
    from hilstar.instruments.simulate.budget import budget as find_budget
    from hilstar.server.bench.build import load
    from hilstar.server.bench.cameras import fields_of_view
    from hilstar.server.bench.frame import colour_line, shares_line
    from hilstar.tracker.centroiders import FAMILY

    check_directory("-o", options.output)
    if options.noise or options.sensor is not None:
        if options.centroider is not None:
            flag = "--noise" if options.sensor is None else "--sensor"
            raise InputError(f"budget {flag}: has every centroider; leave out --centroider")
        star_noise(options, pointing)
        return
    for flag, given in (("--radec", pointing.radec), ("--star", pointing.star)):
        if given is not None:
            raise InputError(
                f"budget {flag}: names a field of stars whose noise is wanted; add --noise"
            )
    choices: tuple[By, ...] = (*FAMILY, "all")
    by = next((choice for choice in choices if choice == options.centroider), None)
    if options.centroider is not None and by is None:
        meant = did_you_mean(options.centroider, choices)
        wrong = shortened(options.centroider)
        raise InputError(f"--centroider {wrong}: {meant}write one of {', '.join(choices)}")
    with busy("finding the budget"), load(options.bench_file) as bench:
        fields = fields_of_view(bench.config, bench.file.folder)
        star_budget = find_budget(bench, by)
        assumed = shares_line(bench) or colour_line(bench)
    if options.output is not None:
        with busy("drawing the chart"):
            write_report(make_directory(options.output), star_budget)
    print_found(options.as_json, star_budget, budget_lines(star_budget))
    say_optics(fields, star_budget.star)
    if assumed is not None:
        say(assumed)


def star_noise(options: BudgetOptions, pointing: PlaceOptions) -> None:
    """The noise of the tracker's own stars, or of those of another sensor behind its lens."""
    import numpy as np

    from hilstar.basics.rotation import from_radec_roll_deg
    from hilstar.instruments.simulate.noise import (
        noise_budget,
        noise_lines,
        sensitivity_line,
        write_noise,
    )
    from hilstar.server.bench.bench_file import read_bench_file
    from hilstar.tracker.centroids import CentroidSettings

    file = read_bench_file(options.bench_file)
    place = place_of("budget", pointing, file.config.sky.epoch_jyear)
    attitude = None
    if place is not None:
        attitude = from_radec_roll_deg(*place)
    if options.sensor is not None:
        file = with_its_figures(file, options.sensor)
    with busy("finding the noise"):
        noise = noise_budget(file, attitude, CentroidSettings(), np.random.default_rng(0))
        if options.output is not None:
            write_noise(make_directory(options.output), noise)
    lines = list(noise_lines(noise))
    if options.sensor is not None:
        lines.insert(0, sensitivity_line(noise))
    print_found(options.as_json, noise, lines)


def with_its_figures(file: "benches.BenchFile", name: str) -> "benches.BenchFile":
    """The bench with the sensor of a name in place of its own; lines say what its sheet gives and
    lacks. Raises InputError.
    """
    from hilstar.basics.reading import parse_toml
    from hilstar.server.bench.bench_file import changed_file
    from hilstar.server.bench.config.sensor import lacking, named_keys, other_sensor
    from hilstar.tracker.sensors import sensor_named

    other = other_sensor(parse_toml(file.path, file.text), name)
    changed = changed_file(file, other.tables)
    sensor = sensor_named(name, "--sensor")
    say(f"{sensor.name}: {sensor.source}")
    if other.kept:
        beside = ""
        if other.beside:
            beside = f", with {named_keys(other.beside)}"
        say(f"its sheet has no {lacking(sensor, other.kept)}: the bench's stand{beside}")
    if other.dropped:
        say(f"left out, as they are the old sensor's: {named_keys(other.dropped)}")
    return changed
