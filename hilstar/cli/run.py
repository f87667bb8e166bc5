"""Commands about a run that was kept in a ledger: report, latency."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.common import Json, app
from hilstar.console import print_json

RunFile = Annotated[Path, typer.Argument(metavar="RUN.mcap", help="The ledger of serve or replay.")]


@app.command()
def report(
    ledger: RunFile,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where report.html and its charts go.")],
    as_json: Json = False,
) -> None:
    """Timing, age of the attitude, missed frames and memory of a run, on one page with charts."""
    from hilstar.bench.output import make_directory
    from hilstar.study.report import report as write_report
    from hilstar.study.report import table_rows

    make_directory(output)
    summary = write_report(ledger, output)
    if as_json:
        print_json(summary)
        return
    for what, how_much in table_rows(summary):
        typer.echo(f"{what:32}{how_much}")
    typer.echo(f"{'page':32}{output / 'report.html'}")
