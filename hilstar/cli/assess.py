"""hilstar assess: a tracker's error budget, from a run."""

from pathlib import Path
from typing import Literal

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.declare import argument, option, struct
from hilstar.cli.options import check_files, json_option, ledger_argument, output_option
from hilstar.server.console.terminal import busy, print_found, say

MAX_LATENCY_MS = 1e7  # 2.8 h: no tracker's, but a wrong number
PAGE = "budget.html"
OUTPUTS = (PAGE, "budget.csv", "slices.csv", "wrong.csv", "outages.csv")


@struct
class AssessOptions:
    """The options of `hilstar assess`."""

    ledger: Path = ledger_argument()
    output: Path = output_option("DIR", "Directory for budget.html and its tables.")
    telemetry: Path | None = argument(
        "[TELEMETRY]",
        "Its answers on its own clock: CSV t_s,qw,qx,qy,qz[,rx,ry,rz][,valid] (q_icrs_to_cam,"
        " scalar first), JSON lines, AEM, MCAP; by default the answers in the ledger.",
        show_default=False,
    )
    stamp: Literal["start", "middle", "end"] | None = option(
        "",
        "Where in an exposure of tracker.exposure_s t_s stands; by default the middle, for the"
        " ledger's own answers as its bench file says.",
        show_default=False,
    )
    latency_ms: float = option(
        "MS", "How much later than that t_s is, where it is known.", default=0.0
    )
    display_attitudes: int = option(
        "N",
        "Attitudes at which the twin measures the display; 0 for none.",
        default=12,
        min=0,
        max=1000,
    )
    as_json: bool = json_option()


def assess(options: AssessOptions) -> None:
    """Find a tracker's error budget: bias, field-of-view error, pixel error, noise, clock,
    availability, wrong answers.
    """
    from hilstar.instruments.assess.assessment import AssessSettings, assess_files
    from hilstar.instruments.assess.page import write_page
    from hilstar.instruments.assess.report import budget_of, lines_of, write_tables

    check_directory("-o", options.output)
    if not abs(options.latency_ms) < MAX_LATENCY_MS:
        raise InputError(
            f"--latency-ms {options.latency_ms:g}: write milliseconds, less than {MAX_LATENCY_MS:g}"
            " either way"
        )
    outputs = [options.output / name for name in OUTPUTS]
    check_files([options.ledger, options.telemetry], outputs)
    page = options.output / PAGE
    settings = AssessSettings(options.stamp, options.latency_ms / 1e3, options.display_attitudes)
    with busy("finding the tracker's error budget"):
        assessment = assess_files(options.ledger, options.telemetry, settings)
        make_directory(options.output)
        write_tables(options.output, assessment)
        write_page(page, assessment)
    rows = lines_of(assessment)
    rows += [("note", note) for note in assessment.notes]
    rows.append(("page", str(page)))
    lines = [f"{what:24}{text}" for what, text in rows]
    print_found(options.as_json, budget_of(assessment), lines)
    if options.as_json:
        for note in assessment.notes:
            say(note)
