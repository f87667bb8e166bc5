"""An acceptance of the small bench, whose campaigns run in this process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hilstar.instruments.campaign.acceptance import Acceptance
from hilstar.instruments.campaign.acceptance_plan import read_acceptance_plan
from hilstar.instruments.campaign.acceptance_verdicts import ClauseVerdict
from hilstar.instruments.campaign.backlog import Backlog
from hilstar.instruments.campaign.run import Campaign
from hilstar.instruments.campaign.session import Session
from hilstar.instruments.campaign.store import Directory
from tests.support.benches import bench_text
from tests.support.campaigns import DETECTOR, SMALL_TRACKER


class OneProcess:
    """Workers of a campaign: this process alone."""

    task_s = 0.5

    def __init__(self, campaign: Campaign) -> None:
        self._job = campaign.job

    def run(self, backlog: Backlog, done: Any, lost: Any) -> None:
        session = Session(self._job)
        try:
            while (task := backlog.take(1)) is not None:
                answered = session.run(task.begin, task.points)
                backlog.done(task, answered.seconds)
                done(task, answered)
        finally:
            session.close()


def run_here(campaign: Campaign, directory: Directory, of: str) -> None:
    """Run a campaign in this process."""
    campaign.run(directory, OneProcess(campaign), lambda done: None)  # type: ignore[arg-type]


def write_bench(folder: Path, **tables: Any) -> Path:
    """The small bench in a folder; its path."""
    bench = folder / "bench.toml"
    bench.write_text(bench_text({"tracker": SMALL_TRACKER, "tracker.detector": DETECTOR, **tables}))
    return bench


def accepted(folder: Path, plan: str, quick: bool = False) -> dict[str, ClauseVerdict]:
    """The verdict of each clause of a plan's text, by its quantity, and axis where it has one.

    The sky ends where the small tracker finds no star.
    """
    bench = write_bench(folder, sky={"faintest_v_mag": 7.0})
    path = folder / "plan.toml"
    path.write_text(plan)
    checked = read_acceptance_plan(path, bench, quick, None)
    acceptance = Acceptance(checked, bench, folder / "out", "centroids", 10.0)
    acceptance.check()
    (folder / "out").mkdir(exist_ok=True)
    verdicts = acceptance.verdicts(acceptance.run(run_here))
    return {key_of(each): each for each in verdicts}


def key_of(each: ClauseVerdict) -> str:
    """A clause's quantity and axis; of an edge its set of cases."""
    clause = each.clause
    if clause.quantity == "edge":
        return clause.of
    return f"{clause.quantity} {clause.axis}" if clause.axis else clause.quantity
