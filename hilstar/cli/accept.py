"""hilstar accept: a tracker's whole acceptance, each capability with a verdict."""

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Option

from hilstar.basics.files import check_directory, make_directory
from hilstar.cli import running
from hilstar.cli.campaign import CENTROIDS, check_through, run_cases, show_cases
from hilstar.cli.options import BenchFile, Headless, Json
from hilstar.server.console.terminal import print_found, say

if TYPE_CHECKING:
    from hilstar.instruments.campaign.acceptance import Acceptance
    from hilstar.instruments.campaign.run import Campaign
    from hilstar.instruments.campaign.store import Directory

ECSS = Path("ecss.toml")  # the plan that ships


def accept(
    bench: BenchFile,
    output: Annotated[
        Path,
        Option(
            "-o",
            "--output",
            metavar="DIR",
            help="Directory of the acceptance; it goes on where it was.",
        ),
    ],
    plan: Annotated[
        Path,
        Option(
            metavar="FILE.toml",
            help="The plan: a file, or ecss.toml, which ships (docs: Acceptance).",
        ),
    ] = ECSS,
    quick: Annotated[
        bool, Option("--quick", help="A few cases for every clause, in minutes.")
    ] = False,
    dry_run: Annotated[
        bool,
        Option("--dry-run", help="Say how long each clause takes, by its first cases, and stop."),
    ] = False,
    through: Annotated[
        Literal["tracker", "display", "bench"] | None,
        Option(help="The virtual tracker, the display's twin, or the real bench; else the plan's."),
    ] = None,
    workers: Annotated[
        int | None,
        Option(
            metavar="N", help="Processes on this machine; by default one a core.", min=1, max=1024
        ),
    ] = None,
    solver: Annotated[
        str,
        Option(metavar="SOLVER", help="What is tested, as in a campaign; not on a real bench."),
    ] = CENTROIDS,
    solver_timeout: Annotated[
        float, Option(metavar="SECONDS", help="Time limit of one image.", min=0.01, max=86400)
    ] = 10.0,
    headless: Headless = False,
    windowed: running.Windowed = False,
    force: running.Force = False,
    feed: running.Feed = None,
    strict: Annotated[
        bool, Option("--strict", help="Exit with code 1 where a clause is not met.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Test a tracker's capabilities by a plan, and write one page with a verdict for each."""
    from hilstar.instruments.campaign.acceptance import Acceptance, write_ledger
    from hilstar.instruments.campaign.acceptance_page import (
        PAGE_FILE,
        lines_of,
        verdict_of,
        write_acceptance,
    )
    from hilstar.instruments.campaign.acceptance_plan import plan_path, read_acceptance_plan
    from hilstar.instruments.campaign.requirements import NOT_MET

    check_directory("-o", output)
    checked = read_acceptance_plan(plan_path(plan), bench, quick, through)
    acceptance = Acceptance(checked, bench, output, solver, solver_timeout)
    of_bench = {"--headless": headless, "--windowed": windowed, "--force": force}
    of_bench["--feed"] = feed is not None
    of_tracker = {"--workers": workers is not None, "--solver": solver != CENTROIDS}
    check_through("accept", "--through", acceptance.on_bench, of_bench, of_tracker)
    acceptance.check()
    count = workers or len(os.sched_getaffinity(0))
    if dry_run:
        _print_costs(acceptance, count, as_json)
        return
    make_directory(output)

    def run_missing(campaign: "Campaign", directory: "Directory", of: str) -> None:
        say(f"hilstar: {of}: {campaign.cases} cases")
        if not acceptance.on_bench:
            run_cases(campaign, directory, None, count, None)
            return
        shown_bench = partial(
            running.shown_bench, headless=headless, windowed=windowed, force=force, timed=True
        )
        show_cases(campaign, directory, shown_bench, feed, None)

    results = acceptance.run(run_missing)
    verdicts = acceptance.verdicts(results)
    rows = write_ledger(output / "ledger.csv", results)
    summary = write_acceptance(acceptance, results, verdicts, rows)
    lines = lines_of(acceptance, results, verdicts)
    lines.append(f"page  {output / PAGE_FILE}")
    print_found(as_json, summary, lines)
    if strict and verdict_of(verdicts) == NOT_MET:
        raise typer.Exit(1)


def _print_costs(acceptance: "Acceptance", workers: int, as_json: bool) -> None:
    """Print how long each set of cases takes, with the clauses that it is for."""
    costs = list(acceptance.costs(workers))
    rows = []
    lines = []
    for cost in costs:
        name = cost.case_set.name
        clauses = [clause.capability for clause in acceptance.plan.clauses_of(name)]
        rows.append({"set": name, "cases": cost.cases, "s": cost.seconds, "clauses": clauses})
        lines.append(f"{name:20}{cost.cases:8} cases  {_time_text(cost.seconds):>8}  {clauses[0]}")
        lines += [f"{'':46}{clause}" for clause in clauses[1:]]
    total_s = sum(cost.seconds for cost in costs)
    at_most = " at most" if acceptance.on_bench else f" on {workers} cores"
    lines.append(
        f"{'all':20}{sum(c.cases for c in costs):8} cases  {_time_text(total_s):>8}{at_most}"
    )
    print_found(as_json, {"sets": rows, "s": total_s}, lines)


def _time_text(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
