"""hilstar report: a run on one page."""

from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import Json, RunFile
from hilstar.console.terminal import print_json
from hilstar.files import check_directory


def report(
    ledger: RunFile,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Directory for report.html and report.json.")],
    as_json: Json = False,
) -> None:
    """Report a run on one page: pictures, timing, attitude age, missed frames, packets, events and memory."""
    from hilstar.console.report import report as write_report
    from hilstar.run.record.report import table_rows

    check_directory("-o", output)
    found = write_report(ledger, output)
    if as_json:
        print_json(found)
        return
    for what, how_much in table_rows(found):
        typer.echo(f"{what:32}{how_much}")
    typer.echo(f"{'page':32}{output / 'report.html'}")
