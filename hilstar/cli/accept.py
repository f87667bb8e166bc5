"""hilstar accept: a tracker's whole acceptance, each capability with a verdict."""

from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from hilstar.basics.files import check_directory, make_directory
from hilstar.cli.campaign import CENTROIDS, CaseOptions, check_through, run_cases, show_cases
from hilstar.cli.declare import option, struct, switch
from hilstar.cli.options import bench_argument, json_option, output_option
from hilstar.cli.running import DisplayOptions
from hilstar.server.console.terminal import print_found, say

if TYPE_CHECKING:
    from hilstar.instruments.campaign.acceptance_verdicts import CostOfSet
    from hilstar.instruments.campaign.run import Campaign
    from hilstar.instruments.campaign.store import Directory

ECSS = Path("ecss.toml")  # the plan that ships


@struct
class AcceptOptions:
    """The options of `hilstar accept`."""

    bench: Path = bench_argument()
    output: Path = output_option("DIR", "Directory of the acceptance; it goes on where it was.")
    plan: Path = option(
        "FILE.toml", "The plan: a file, or ecss.toml, which ships (docs: Acceptance).", default=ECSS
    )
    quick: bool = switch("A few cases for every clause, in minutes.")
    dry_run: bool = switch("Say how long each clause takes, by its first cases, and stop.")
    through: Literal["tracker", "display", "bench"] | None = option(
        "", "The virtual tracker, the display's twin, or the real bench; else the plan's."
    )
    strict: bool = switch("Exit with code 1 where a clause is not met.")
    as_json: bool = json_option()


def accept(options: AcceptOptions, cases: CaseOptions, display: DisplayOptions) -> None:
    """Test a tracker's capabilities by a plan, and write one page with a verdict for each."""
    from hilstar.instruments.campaign.acceptance import Acceptance, write_ledger
    from hilstar.instruments.campaign.acceptance_page import (
        PAGE_FILE,
        lines_of,
        verdict_of,
        write_acceptance,
    )
    from hilstar.instruments.campaign.acceptance_plan import plan_path, read_acceptance_plan
    from hilstar.instruments.campaign.pool import Pool
    from hilstar.instruments.campaign.requirements import NOT_MET

    check_directory("-o", options.output)
    checked = read_acceptance_plan(
        plan_path(options.plan), options.bench, options.quick, options.through
    )
    acceptance = Acceptance(
        checked, options.bench, options.output, cases.solver, cases.solver_timeout
    )
    of_tracker = {"--workers": cases.workers is not None, "--solver": cases.solver != CENTROIDS}
    check_through("accept", "--through", acceptance.on_bench, display.given(), of_tracker)
    acceptance.check()
    processes = cases.processes()
    if options.dry_run:
        costs = []
        for cost in acceptance.costs(processes):
            clauses = checked.clauses_of(cost.case_set.name)
            costs.append((cost, [clause.capability for clause in clauses]))
        of_time = "at most" if acceptance.on_bench else f"on {processes} cores"
        print_found(options.as_json, *costs_table(costs, of_time))
        return
    make_directory(options.output)

    pool: Pool | None = None

    with ExitStack() as ending:

        def run_missing(campaign: "Campaign", directory: "Directory", of: str) -> None:
            nonlocal pool
            say(f"hilstar: {of}: {campaign.cases} cases")
            if acceptance.on_bench:
                show_cases(campaign, directory, display, None)
                return
            if pool is None:
                pool = ending.enter_context(Pool(campaign.job, campaign.identity, processes))
            pool.turn_to(campaign.job, campaign.identity)
            run_cases(campaign, directory, nullcontext(pool))

        results = acceptance.run(run_missing)
    verdicts = acceptance.verdicts(results)
    rows = write_ledger(options.output / "ledger.csv", results)
    summary = write_acceptance(acceptance, results, verdicts, rows)
    lines = lines_of(acceptance, results, verdicts)
    lines.append(f"page  {options.output / PAGE_FILE}")
    print_found(options.as_json, summary, lines)
    if options.strict and verdict_of(verdicts) == NOT_MET:
        raise typer.Exit(1)


def costs_table(
    costs: "list[tuple[CostOfSet, list[str]]]", of_time: str
) -> tuple[dict[str, Any], list[str]]:
    """How long each set of cases takes, with the clauses that it is for: for --json, and as lines.
    `of_time` says what the sum is of.
    """
    rows = []
    lines = []
    for cost, clauses in costs:
        name = cost.case_set.name
        rows.append({"set": name, "cases": cost.cases, "s": cost.seconds, "clauses": clauses})
        cases = f"{name:20}{cost.cases:8} cases  {_time_text(cost.seconds):>8}"
        for clause in clauses:
            lines.append(f"{cases:44}  {clause}")
            cases = ""  # once for all clauses
    total_s = sum(cost.seconds for cost, _ in costs)
    total = sum(cost.cases for cost, _ in costs)
    lines.append(f"{'all':20}{total:8} cases  {_time_text(total_s):>8} {of_time}")
    return {"sets": rows, "s": total_s}, lines


def _time_text(seconds: float) -> str:
    """A duration in the unit that gives it two or three digits."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
