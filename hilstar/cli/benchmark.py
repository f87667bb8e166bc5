"""hilstar benchmark: how long a frame takes, beside other ways to the same image."""

from dataclasses import replace
from pathlib import Path

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.declare import argument, option, struct, switch
from hilstar.cli.options import json_option, output_option, parse_counts, parse_sizes, seed_option
from hilstar.server.console.terminal import print_found, progress


@struct
class BenchmarkOptions:
    """The options of `hilstar benchmark`."""

    bench_file: Path | None = argument("[BENCH.toml]", "Your bench file, at its own image size.")
    quick: bool = switch("1920x1080 only, up to 10000 stars: at most half a minute.")
    stars: str | None = option("N,N,...", "Stars in view.")
    sizes: str | None = option("WxH,WxH,...", "Image sizes.")
    seed: int = seed_option("Seed of the random stars beyond the catalogue.", default=1)
    output: Path | None = output_option(
        "DIR", "Directory for bench.csv, tracker.csv and bench.png."
    )
    as_json: bool = json_option()


def benchmark(options: BenchmarkOptions) -> None:
    """Time a whole frame and its stages, and the virtual tracker, beside NumPy, numba, GalSim,
    photutils and sep.
    """
    import numpy as np

    from hilstar.instruments.study.speed import benchmark as speed
    from hilstar.instruments.study.speed import report as speed_report
    from hilstar.server.bench.bench_file import read_bench_file

    plan = speed.QUICK if options.quick else speed.BenchmarkPlan()
    if options.stars is not None:
        plan = replace(plan, counts=parse_counts(options.stars, speed.MAX_STARS))
    if options.bench_file is not None:
        if options.sizes is not None:
            raise InputError(
                f"benchmark --sizes: {options.bench_file} has a size of its own; leave out one of"
                " them"
            )
        file = read_bench_file(options.bench_file)
        plan = replace(plan, file=file, sizes=(file.config.monitor.resolution_px,))
    elif options.sizes is not None:
        plan = replace(plan, sizes=parse_sizes(options.sizes))
    check_directory("-o", options.output)
    scenes = len(plan.sizes) * len(plan.counts)
    rng = np.random.default_rng(options.seed)
    with progress("measuring", scenes) as advance:
        result = speed.run(plan, rng, advance)
    if options.output is not None:
        speed_report.write(result, make_directory(options.output))
    print_found(options.as_json, result, speed_report.lines(result))
