"""hilstar benchmark: how long a frame takes, beside other ways to the same image."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.options import Json, parse_counts, parse_sizes, seed_option
from hilstar.server.console.terminal import print_found, progress

OwnBench = Annotated[
    Path | None, Argument(metavar="[BENCH.toml]", help="Your bench file, at its own image size.")
]


def benchmark(
    bench_file: OwnBench = None,
    quick: Annotated[
        bool, Option("--quick", help="1920x1080 only, up to 10000 stars: at most half a minute.")
    ] = False,
    stars: Annotated[str | None, Option(metavar="N,N,...", help="Stars in view.")] = None,
    sizes: Annotated[str | None, Option(metavar="WxH,WxH,...", help="Image sizes.")] = None,
    seed: Annotated[int, seed_option("Seed of the random stars beyond the catalogue.")] = 1,
    output: Annotated[
        Path | None,
        Option(
            "-o",
            "--output",
            metavar="DIR",
            help="Directory for bench.csv, tracker.csv and bench.png.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Time a whole frame and its stages, and the virtual tracker, beside NumPy, numba, GalSim,
    photutils and sep.
    """
    import numpy as np

    from hilstar.instruments.study.speed import benchmark as speed
    from hilstar.instruments.study.speed import report as speed_report
    from hilstar.server.bench.bench_file import read_bench_file

    plan = speed.QUICK if quick else speed.BenchmarkPlan()
    if stars is not None:
        plan = replace(plan, counts=parse_counts(stars, speed.MAX_STARS))
    if bench_file is not None:
        if sizes is not None:
            raise InputError(
                f"benchmark --sizes: {bench_file} has a size of its own; leave out one of them"
            )
        file = read_bench_file(bench_file)
        plan = replace(plan, file=file, sizes=(file.config.monitor.resolution_px,))
    elif sizes is not None:
        plan = replace(plan, sizes=parse_sizes(sizes))
    check_directory("-o", output)
    with progress("measuring", len(plan.sizes) * len(plan.counts)) as advance:
        result = speed.run(plan, np.random.default_rng(seed), advance)
    if output is not None:
        speed_report.write(result, make_directory(output))
    print_found(as_json, result, speed_report.lines(result))
