"""hilstar calibrate geometric: the lens between monitor and tracker, from what the tracker saw of the dots."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import BenchFile, Json, check_files
from hilstar.console.terminal import print_json
from hilstar.files import PNG, TOML, check_ending


def geometric(
    bench_file: BenchFile,
    observed: Annotated[
        list[Path], typer.Argument(metavar="OBSERVED...", help="A CSV of centroids (frame,x_px,y_px), or the tracker's images.")
    ],
    plan: Annotated[Path, typer.Option(metavar="DIR", help="Directory that `calibrate dots` wrote.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="geometry.toml", help="The geometry file.")],
    tracker_is_ideal: Annotated[
        bool, typer.Option("--tracker-is-ideal", help="Take the tracker's lens as ideal; the file then holds both lenses.")
    ] = False,
    dark: Annotated[Path | None, typer.Option(metavar="FILE", help="A dark frame, taken from each image.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="OUT.png", help="The error over the screen, and the residuals.")] = None,
    as_json: Json = False,
) -> None:
    """Fit the collimator's lens, the screen's tilt and the alignment to dots that the tracker saw."""
    from hilstar.bench.bench_file import read_bench_file
    from hilstar.calibrate.geometric.calibration import calibrate_files, lines_of, write_calibrated

    check_ending("-o", output, TOML)
    check_ending("--plot", plot, PNG)
    file = read_bench_file(bench_file)
    check_files([*observed, dark, plan / "plan.csv"], [output, plot], file)
    found = calibrate_files(file, observed, plan / "plan.csv", dark, tracker_is_ideal=tracker_is_ideal)
    summary = write_calibrated(output, found, plot)
    if as_json:
        print_json(asdict(summary))
        return
    typer.echo("\n".join(lines_of(summary)))
    typer.echo(f"in the bench file, under [collimator]: geometry = {str(output.name)!r}")
