"""hilstar report: a run on one page."""

from pathlib import Path
from typing import Annotated

from typer import Option

from hilstar.basics.files import check_directory
from hilstar.cli.options import Json, RunFile
from hilstar.server.console.terminal import busy, print_found


def report(
    ledger: RunFile,
    output: Annotated[
        Path,
        Option("-o", "--output", metavar="DIR", help="Directory for report.html and report.json."),
    ],
    as_json: Json = False,
) -> None:
    """Report a run on one page: pictures, timing, attitude age, missed frames, packets, events
    and memory.
    """
    from hilstar.server.console.report import report as write_report
    from hilstar.server.record.run_figures import table_rows

    check_directory("-o", output)
    with busy("reading the run"):
        figures = write_report(ledger, output)
    rows = [*table_rows(figures), ("page", output / "report.html")]
    print_found(as_json, figures, (f"{what:32}{how_much}" for what, how_much in rows))
