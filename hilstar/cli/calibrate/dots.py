"""hilstar calibrate dots: the frames of dots that a geometric calibration wants."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import MAX_SEED, BenchFile, Json, check_files
from hilstar.cli.running import Windowed
from hilstar.console.terminal import print_json, say
from hilstar.files import check_directory, make_directory


def dots(
    bench_file: BenchFile,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Directory for plan.csv and the frames.")],
    frames: Annotated[int, typer.Option(help="Number of frames.", min=1, max=1000)] = 20,
    dots_per_frame: Annotated[int, typer.Option("--dots", help="About how many dots are lit in each.", min=1, max=5000)] = 60,
    show: Annotated[
        bool, typer.Option("--show", help="Show the frames on the display: space for the next, q to quit.")
    ] = False,
    seconds: Annotated[
        float | None, typer.Option(metavar="S", help="With --show: time for each frame, without keys.", min=0)
    ] = None,
    windowed: Windowed = False,
    seed: Annotated[int, typer.Option(help="Seed of the dots' codes.", min=0, max=MAX_SEED)] = 0,
    as_json: Json = False,
) -> None:
    """Make frames of dots for `calibrate geometric`: each dot blinks its own code."""
    import numpy as np

    from hilstar.bench.bench_file import read_bench_file
    from hilstar.bench.frame_files import write_codes_png
    from hilstar.calibrate.geometric.dots import dot_image, plan_dots, show_dots, write_plan

    check_directory("-o", output)
    file = read_bench_file(bench_file)
    monitor = file.config.monitor
    plan = plan_dots(monitor.resolution_px, frames, dots_per_frame, np.random.default_rng(seed))
    check_files([], [output / "plan.csv"], file)
    make_directory(output)
    write_plan(output / "plan.csv", plan)
    for frame in range(plan.frames):
        image = dot_image(plan, frame, monitor.resolution_px, 2**monitor.bits - 1)
        write_codes_png(output / f"frame_{frame:03}.png", image, monitor.bits)
    shown = None
    if show:
        shown = show_dots(plan, monitor, seconds, windowed=windowed)
        say(f"{shown} of {plan.frames} frames shown")
    if as_json:
        print_json({"frames": plan.frames, "dots": len(plan), "lit": int(plan.lit.sum()), "seed": seed, "written": str(output)})
    else:
        typer.echo(f"{len(plan)} dots in {plan.frames} frames, {plan.lit.sum() / plan.frames:.0f} lit in each, in {output}")
