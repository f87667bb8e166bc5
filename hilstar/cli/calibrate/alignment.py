"""hilstar calibrate alignment: how the tracker stands before the screen, from the attitudes that it reports."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import BenchFile, Json, check_files
from hilstar.console.terminal import print_json
from hilstar.errors import InputError
from hilstar.files import TOML, check_ending

MAX_OFFSET_S = 4e9  # int64 nanoseconds hold that


def alignment(
    bench_file: BenchFile,
    pairs: Annotated[
        Path,
        typer.Argument(
            metavar="PAIRS.csv",
            help="Commanded and reported q_icrs_to_cam, scalar first: qw,qx,qy,qz,tw,tx,ty,tz[,valid]. With --ledger, the"
            " tracker's telemetry: t_s,qw,qx,qy,qz[,valid].",
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="geometry.toml", help="The geometry file.")],
    ledger: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN.mcap",
            help="The ledger of the run that the telemetry is of: t_s is the middle of an exposure in seconds of the ledger's"
            " light_ns, the sender's clock.",
        ),
    ] = None,
    offset_s: Annotated[
        float | None, typer.Option("--offset-s", help="With --ledger: seconds to add to the telemetry's t_s; 0 by default.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Find how the tracker stands before the screen from the attitudes that it reports, for one that gives nothing else."""
    from hilstar.bench.bench_file import read_bench_file
    from hilstar.calibrate.alignment import align_files, lines_of, write_alignment

    check_ending("-o", output, TOML)
    if offset_s is not None and ledger is None:
        raise InputError("--offset-s: pairs have no times; give it with --ledger RUN.mcap and the tracker's telemetry")
    if offset_s is not None and not abs(offset_s) < MAX_OFFSET_S:
        raise InputError(f"--offset-s {offset_s}: write seconds, less than {MAX_OFFSET_S:g} either way")
    file = read_bench_file(bench_file)
    check_files([pairs, ledger], [output], file)
    found = align_files(file, pairs, ledger, offset_s or 0.0)
    summary = write_alignment(output, found, file)
    if as_json:
        print_json(asdict(summary))
        return
    typer.echo("\n".join(lines_of(summary)))
    typer.echo(f"in the bench file, under [collimator]: geometry = {str(output.name)!r}")
