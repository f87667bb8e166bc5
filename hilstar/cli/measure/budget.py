"""hilstar budget: which magnitudes a bench can show, and how well."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import BenchFile, Json
from hilstar.console.terminal import print_json
from hilstar.files import check_directory


def budget(
    bench_file: BenchFile,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Directory for a chart and a table.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Find which magnitudes this monitor, sprite and quantisation can show, and how accurately."""
    from hilstar.bench.build import load
    from hilstar.files import make_directory
    from hilstar.twin.budget import budget as find_budget
    from hilstar.twin.budget_report import budget_lines, write_report

    check_directory("-o", output)
    with load(bench_file) as bench:
        found = find_budget(bench)
    if output is not None:
        write_report(make_directory(output), found)
    if as_json:
        print_json(asdict(found))
    else:
        typer.echo("\n".join(budget_lines(found)))
