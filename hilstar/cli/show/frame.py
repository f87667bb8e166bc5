"""hilstar frame: one frame into files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hilstar.cli.options import BenchFile, Explain, Json, QuaternionText, RadecText, check_files
from hilstar.cli.parsers import parse_attitude
from hilstar.cli.show.running import explain_bench
from hilstar.console.terminal import print_json
from hilstar.errors import InputError
from hilstar.files import CSV, FITS, PNG, check_ending


def frame(
    bench_file: BenchFile,
    radec: RadecText = None,
    quaternion: QuaternionText = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="OUT.fits", help="The linear image, electrons per second.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(metavar="OUT.csv", help="The truth table: one row for each star in view.")
    ] = None,
    codes: Annotated[Path | None, typer.Option(metavar="OUT.png", help="The code values.")] = None,
    preview: Annotated[Path | None, typer.Option(metavar="OUT.png", help="A picture stretched for the eye.")] = None,
    explain: Explain = False,
    as_json: Json = False,
) -> None:
    """Draw one frame and write it to files."""
    import numpy as np

    from hilstar.bench import frame_files as files
    from hilstar.bench.bench_file import read_bench_file
    from hilstar.bench.build import open_bench

    q = parse_attitude("frame", radec, quaternion)
    targets = [path for path in (output, truth, codes, preview) if path is not None]
    if not targets:
        raise InputError("frame: no output was asked for; add -o OUT.fits, --truth OUT.csv or --codes OUT.png")
    check_ending("-o", output, FITS)
    check_ending("--truth", truth, CSV)
    check_ending("--codes", codes, PNG)
    check_ending("--preview", preview, PNG)
    file = read_bench_file(bench_file)
    check_files([], targets, file)
    with open_bench(file) as bench:
        if explain:
            explain_bench(bench)
        shot = bench.frame(q)
        if output is not None:
            files.write_frame_fits(output, bench, shot)
        if truth is not None:
            files.write_truth_csv(truth, shot)
        if codes is not None:
            files.write_codes_png(codes, shot.codes, bench.config.monitor.bits)
        if preview is not None:
            files.write_preview_png(preview, shot.levels)
        clipped = shot.truth["hip"][shot.truth["clipped"]].tolist()
        summary = {
            "stars": len(shot.truth),
            "electrons_per_s": float(shot.linear.sum(dtype=np.float64)),
            "flux_at_white_e_per_s": bench.flux_at_white_e_per_s,
            "clipped": clipped,
            "clipped_mag": bench.losses_mag(shot),
            "left_out": left_out(shot.truth),
            "calibration": {"name": bench.calibration.name, "sha256": bench.calibration.sha256},
            "written": [str(path) for path in targets],
            "gl_renderer": bench.renderer.gl_renderer,
        }
    if as_json:
        print_json(summary)
    else:
        losses = ", ".join(f"{hip} by {mag:.2f} mag" for hip, mag in summary["clipped_mag"].items())
        names = f", clipped: HIP {losses}" if clipped else ""
        missing = summary["left_out"]
        if missing["stars"]:
            names += f", {missing['stars']} too faint to show ({missing['flux_share']:.2%} of all light)"
        typer.echo(f"{len(shot.truth)} stars{names}; wrote {', '.join(summary['written'])}")


def left_out(truth: Any) -> dict[str, float | int]:
    """The stars in view that the monitor cannot show: how many, and their part of all light."""
    missing = truth["electrons_per_s"][~truth["drawn"]]
    total = float(truth["electrons_per_s"].sum())
    return {"stars": len(missing), "flux_share": float(missing.sum()) / total if total else 0.0}
