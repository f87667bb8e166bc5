"""hilstar verify: the digital twin of a bench."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import MAX_SEED, BenchFile, Json
from hilstar.console.terminal import print_json, progress
from hilstar.files import check_directory


def verify(
    bench_file: BenchFile,
    fields: Annotated[int, typer.Option(help="Number of random attitudes.", min=1, max=100_000)] = 10,
    seed: Annotated[int, typer.Option(help="Seed of the attitudes and the noise.", min=0, max=MAX_SEED)] = 0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Directory for charts and a table.")
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with code 1 if the bench does not pass.")] = False,
    as_json: Json = False,
) -> None:
    """Run the digital twin: what the tracker would measure of the stars shown, against the sky."""
    import numpy as np

    from hilstar.bench.bench_file import read_bench_file
    from hilstar.files import make_directory
    from hilstar.twin.verify.report import write_report
    from hilstar.twin.verify.run import verify as run_twin
    from hilstar.twin.verify.summary import summarise, summary_lines

    check_directory("-o", output)
    if output is not None:
        make_directory(output)
    file = read_bench_file(bench_file)
    with progress("verifying", fields) as advance:
        verdict = run_twin(file, fields, np.random.default_rng(seed), advance)
    if output is not None:
        write_report(output, verdict)
    summary = summarise(verdict)
    if as_json:
        print_json(asdict(summary))
    else:
        typer.echo("\n".join(summary_lines(summary)))
    if strict and not verdict.passed:
        raise typer.Exit(1)
