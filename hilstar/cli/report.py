"""hilstar report: a run on one page."""

from pathlib import Path

from hilstar.basics.files import check_directory
from hilstar.cli.declare import struct
from hilstar.cli.options import json_option, ledger_argument, output_option
from hilstar.server.console.terminal import busy, print_found


@struct
class ReportOptions:
    """The options of `hilstar report`."""

    ledger: Path = ledger_argument()
    output: Path = output_option("DIR", "Directory for report.html and report.json.")
    as_json: bool = json_option()


def report(options: ReportOptions) -> None:
    """Report a run on one page: pictures, timing, attitude age, missed frames, packets, events
    and memory.
    """
    from hilstar.server.console.report import report as write_report
    from hilstar.server.record.run_figures import table_rows

    check_directory("-o", options.output)
    with busy("reading the run"):
        figures = write_report(options.ledger, options.output)
    rows = [*table_rows(figures), ("page", options.output / "report.html")]
    print_found(options.as_json, figures, (f"{what:32}{how_much}" for what, how_much in rows))
