"""Writing a run's report: the page, and its figures as JSON."""

from __future__ import annotations

from pathlib import Path

import msgspec

from hilstar.attitude.logs.mcap_log import NO_END, unfinished_part
from hilstar.console.report.bundle import report_page
from hilstar.console.report.pictures import run_pictures
from hilstar.console.report.run_data import run_data
from hilstar.errors import printable
from hilstar.files import make_directory, write_whole
from hilstar.run.record.report import RunReport, figures_of, summarise


def report(path: Path, directory: Path) -> RunReport:
    """Write `report.html` and `report.json` of a ledger into a directory; the figures.

    Raises InputError for a file that is no ledger, and if it cannot write.
    """
    run = figures_of(path)
    summary = summarise(run)
    data = run_data(printable(path.name), run, summary) | run_pictures(run, path)
    unfinished = unfinished_part(path)
    if unfinished is not None:
        data["facts"].insert(0, ("no end", f"{printable(unfinished.name)} {NO_END}"))
    page = report_page(data)
    make_directory(directory)
    write_whole(directory / "report.html", page.encode(errors="replace"))
    write_whole(directory / "report.json", msgspec.json.format(msgspec.json.encode(summary)))
    return summary
