"""hilstar assess: a tracker's error budget, from a run."""

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.options import Json, RunFile, check_files
from hilstar.server.console.terminal import busy, print_found, say

MAX_LATENCY_MS = 1e7


def assess(
    ledger: RunFile,
    output: Annotated[
        Path,
        Option("-o", "--output", metavar="DIR", help="Directory for budget.html and its tables."),
    ],
    telemetry: Annotated[
        Path | None,
        Argument(
            metavar="[TELEMETRY]",
            help=(
                "Its answers on its own clock: CSV t_s,qw,qx,qy,qz[,valid] (q_icrs_to_cam, scalar"
                " first), AEM, MCAP;"
                " by default the answers in the ledger."
            ),
            show_default=False,
        ),
    ] = None,
    stamp: Annotated[
        Literal["start", "middle", "end"] | None,
        Option(
            help=(
                "Where in an exposure of tracker.exposure_s t_s stands; by default the middle, for"
                " the ledger's own answers"
                " as its bench file says."
            ),
            show_default=False,
        ),
    ] = None,
    latency_ms: Annotated[
        float,
        Option(
            "--latency-ms", metavar="MS", help="How much later than that t_s is, where it is known."
        ),
    ] = 0.0,
    display_attitudes: Annotated[
        int,
        Option(
            metavar="N",
            min=0,
            max=1000,
            help="Attitudes at which the twin measures the display; 0 for none.",
        ),
    ] = 12,
    as_json: Json = False,
) -> None:
    """Find a tracker's error budget: bias, field-of-view error, pixel error, noise, clock,
    availability, wrong answers.
    """
    from hilstar.instruments.assess.assessment import AssessSettings, assess_files
    from hilstar.instruments.assess.page import write_page
    from hilstar.instruments.assess.report import budget_of, lines_of, write_tables

    check_directory("-o", output)
    if not abs(latency_ms) < MAX_LATENCY_MS:
        raise InputError(
            f"--latency-ms {latency_ms:g}: write milliseconds, less than {MAX_LATENCY_MS:g}"
            " either way"
        )
    names = ("budget.html", "budget.csv", "slices.csv", "wrong.csv", "outages.csv")
    check_files(
        [ledger, *([] if telemetry is None else [telemetry])], [output / name for name in names]
    )
    settings = AssessSettings(stamp, latency_ms / 1e3, display_attitudes)
    with busy("finding the tracker's error budget"):
        assessment = assess_files(ledger, telemetry, settings)
        make_directory(output)
        write_tables(output, assessment)
        write_page(output / "budget.html", assessment)
    rows = [
        *lines_of(assessment),
        *(("note", note) for note in assessment.notes),
        ("page", output / "budget.html"),
    ]
    print_found(as_json, budget_of(assessment), (f"{what:24}{text}" for what, text in rows))
    for note in assessment.notes if as_json else ():
        say(note)
