"""The command that takes the time: bench."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilstar.cli.common import MAX_SEED, Json, app
from hilstar.console.terminal import print_json, progress
from hilstar.errors import InputError
from hilstar.files import check_directory, make_directory

OwnBench = Annotated[Path | None, typer.Argument(metavar="[BENCH.toml]", help="Your bench, at its own size.")]


@app.command()
def bench(
    bench_file: OwnBench = None,
    quick: Annotated[bool, typer.Option("--quick", help="1920x1080 only, up to 10000 stars, half a minute at most.")] = False,
    stars: Annotated[str | None, typer.Option(metavar="N,N,...", help="Stars in view.")] = None,
    sizes: Annotated[str | None, typer.Option(metavar="WxH,WxH,...", help="Image sizes.")] = None,
    seed: Annotated[int, typer.Option(help="Of the random stars beyond the catalogue.", min=0, max=MAX_SEED)] = 1,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="DIR", help="bench.csv and bench.png.")] = None,
    as_json: Json = False,
) -> None:
    """Time a whole frame and its stages, beside NumPy, numba, GalSim and photutils on the same stars."""
    from hilstar.bench.config import read_config
    from hilstar.study.speed import benchmark
    from hilstar.study.speed import report as benchmark_report

    plan = benchmark.QUICK if quick else benchmark.Plan()
    if stars is not None:
        plan = replace(plan, counts=parse_counts(stars, benchmark.MOST_STARS))
    if bench_file is not None:
        if sizes is not None:
            raise InputError(f"bench --sizes: {bench_file} has a size of its own; leave out one of them")
        plan = replace(plan, bench_file=bench_file, sizes=(read_config(bench_file).monitor.resolution_px,))
    elif sizes is not None:
        plan = replace(plan, sizes=parse_sizes(sizes))
    check_directory("-o", output)
    if output is not None:
        make_directory(output)
    with progress("measuring", len(plan.sizes) * len(plan.counts)) as advance:
        result = benchmark.run(plan, np.random.default_rng(seed), advance)
    if output is not None:
        benchmark_report.write(result, output)
    if as_json:
        print_json(result)
    else:
        typer.echo("\n".join(benchmark_report.lines(result)))


def parse_counts(text: str, most: int) -> tuple[int, ...]:
    """Star counts, each once, from "100,1000". Raises InputError."""
    parts = text.split(",")
    if not all(re.fullmatch(r"[1-9]\d{0,8}", part) and int(part) <= most for part in parts):
        raise InputError(f"--stars {text}: write whole numbers from 1 to {most} with commas between them, such as 100,1000")
    return tuple(dict.fromkeys(map(int, parts)))


def parse_sizes(text: str) -> tuple[tuple[int, int], ...]:
    """Image sizes, each once, from "640x480,1920x1080". Raises InputError."""
    found = [re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", part) for part in text.split(",")]
    if not all(match and max(int(match[1]), int(match[2])) <= 32768 for match in found):
        raise InputError(
            f"--sizes {text}: write WIDTHxHEIGHT, up to 32768 px, with commas between them, such as 640x480,1920x1080"
        )
    return tuple(dict.fromkeys((int(match[1]), int(match[2])) for match in found if match))
