"""An acceptance: the campaigns of a plan's sets of cases, one after the other, and the verdict of
each clause.

Each set has a directory of its own below that of the acceptance, each level of a sweep one below
that: campaigns that go on where they were. So the same command goes on where an acceptance was, and
a plan with other limits judges it again.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from hilstar.basics.charts import write_csv
from hilstar.basics.errors import MachineError, one_line
from hilstar.basics.files import write_whole
from hilstar.instruments.assess.bounded_figures import TooFewCases
from hilstar.instruments.campaign.acceptance_plan import AcceptancePlan, CaseSet, ClauseTable
from hilstar.instruments.campaign.acceptance_verdicts import (
    AcceptedBench,
    ClauseVerdict,
    CostOfSet,
    SetResult,
)
from hilstar.instruments.campaign.case_table import Columns, read_cases
from hilstar.instruments.campaign.requirements import (
    NOT_MET,
    NOT_SHOWN,
    RequirementVerdict,
    judged_figure,
    verdicts_of,
)
from hilstar.instruments.campaign.run import Campaign
from hilstar.instruments.campaign.session import Session
from hilstar.instruments.campaign.star_motion import with_motion
from hilstar.instruments.campaign.store import Directory, failures, require_parquet
from hilstar.instruments.campaign.sweep import counted, edge_figure, next_level

PLAN_FILE = "plan.toml"
TIMED_CASES = 2  # of a set, whose time tells that of all
LEDGER_COLUMNS = (
    *("case", "status", "why", "noise_seed", "ra_deg", "dec_deg", "roll_deg"),
    *("frames", "solved", "wrong", "first_attitude_s"),
    *("error_x_arcsec", "error_y_arcsec", "error_z_arcsec"),
)
RunCases = Callable[[Campaign, Directory, str], None]
TimeCases = Callable[[Campaign], tuple[float, float]]


def first_cases_s(campaign: Campaign) -> tuple[float, float]:
    """The time of a case, s: the mean of the first TIMED_CASES, after one that warms up; and how
    much longer that one took, with its session.
    """
    count = min(TIMED_CASES, campaign.cases)
    points = campaign.design.points(0, count)
    opened_s = time.perf_counter()
    session = Session(campaign.job)
    try:
        session.row(0, points[0])
        begun_s = time.perf_counter()
        for number, point in enumerate(points):
            session.row(number, point)
        case_s = (time.perf_counter() - begun_s) / count
    finally:
        session.close()
    return case_s, max(begun_s - opened_s - case_s, 0.0)


class Acceptance(AcceptedBench):
    """Runs a plan's cases and judges its clauses. Raises InputError and MachineError."""

    def __init__(
        self, plan: AcceptancePlan, bench: Path, directory: Path, solver: str, timeout_s: float
    ) -> None:
        super().__init__(plan, bench, directory, solver)
        self._timeout_s = timeout_s
        self.sets = plan.sets
        require_parquet()

    def campaign(self, case_set: CaseSet, folder: Path, level: float | None = None) -> Campaign:
        """The campaign of a set of cases, at a level of its sweep."""
        text = case_set.text(level)
        path = self.plan.path
        return Campaign(path, folder, self.solver, self._timeout_s, False, text=text)

    def check(self) -> None:
        """Refuse (InputError) sets whose campaigns could not run, before the first case. What this
        machine lacks for a set leaves that out.
        """
        self.sets = tuple(self._checked(case_set) for case_set in self.plan.sets)

    def _checked(self, case_set: CaseSet) -> CaseSet:
        """The set, with why it cannot run here."""
        if case_set.refused:
            return case_set
        start = case_set.sweep.start if case_set.sweep is not None else None
        try:
            campaign = self.campaign(case_set, self.directory / case_set.name, start)
        except MachineError as error:
            return replace(case_set, refused=one_line(str(error)))
        campaign.check_conditions(
            [clause.require for clause in self.plan.clauses_of(case_set.name)]
        )
        return case_set

    def costs(self, workers: int, timed: TimeCases = first_cases_s) -> Iterator[CostOfSet]:
        """How long each set takes, by the time of its first cases, as they are `timed`, and of a
        campaign's set-up; on a bench, by its timeout at most. The page comes on top.
        """
        for case_set in self.sets:
            if case_set.refused:
                continue
            sweep = case_set.sweep
            levels: tuple[float | None, ...] = (None,)
            run = 1
            if sweep is not None:
                # an edge in the middle may cost more than either end: there the limb of the Earth
                # is in the field
                middle = sweep.between(sweep.start, sweep.stop)
                levels = (sweep.start, middle, sweep.stop)
                run = sweep.levels
            folder = self.directory / case_set.name
            campaigns = []
            for level in levels:
                begun_s = time.perf_counter()
                campaigns.append(self.campaign(case_set, folder, level))
                set_up_s = time.perf_counter() - begun_s  # the last has the catalogue in memory
            of_level = campaigns[0].cases
            cases = of_level * run
            if self.on_bench:
                yield CostOfSet(case_set, cases, cases * campaigns[0].plan.limit_s)
                continue
            times_s = np.array([timed(campaign) for campaign in campaigns])
            case_s, warm_up_s = times_s.mean(axis=0).tolist()
            level_s = of_level * case_s / min(workers, of_level) + warm_up_s + set_up_s
            seconds = run * level_s
            yield CostOfSet(case_set, cases, seconds)

    def run(self, run_cases: RunCases) -> list[SetResult]:
        """Run what is missing of each set, in the plan's order."""
        write_whole(self.directory / PLAN_FILE, self.plan.text)
        results = []
        for case_set in self.sets:
            result = SetResult(case_set)
            folder = self.directory / case_set.name
            if not case_set.refused and case_set.sweep is None:
                result.cases = self._table(result, folder, None, run_cases)
            elif case_set.sweep is not None and not case_set.refused:
                self._run_sweep(result, folder, run_cases)
            results.append(result)
        return results

    def _run_sweep(self, result: SetResult, folder: Path, run_cases: RunCases) -> None:
        sweep = result.case_set.sweep
        assert sweep is not None
        while (level := next_level(sweep, result.levels)) is not None:
            of_level = folder / f"level-{len(result.levels):02d}"
            cases = self._table(result, of_level, level, run_cases)
            result.levels.append(counted(level, cases, sweep.star_v_mag))

    def _table(
        self, result: SetResult, folder: Path, level: float | None, run_cases: RunCases
    ) -> Columns:
        """The cases of a campaign, run where its table is not there yet."""
        case_set = result.case_set
        campaign = self.campaign(case_set, folder, level)
        directory = Directory(folder)
        try:
            directory.claim(campaign.about())
            if not directory.table.exists():
                at = "" if level is None else f" at {level:.4g}"
                run_cases(campaign, directory, f"{case_set.name}{at}")
        finally:
            directory.close()
        result.folders.append(folder)
        for why, count in failures(directory.table).items():
            result.failed[why] = result.failed.get(why, 0) + count
        return read_cases(directory.table)

    def verdicts(self, results: list[SetResult]) -> list[ClauseVerdict]:
        """The verdict of each clause, in the plan's order."""
        by_name = {result.case_set.name: result for result in results}
        judged: dict[int, ClauseVerdict] = {}
        for name, result in by_name.items():
            clauses = self.plan.clauses_of(name)
            for clause, verdict in zip(clauses, self._judged(clauses, result), strict=True):
                judged[id(clause)] = verdict
        verdicts = [judged[id(clause)] for clause in self.plan.clauses]
        tested = sum(verdict.verdict is not None for verdict in verdicts)
        return [self._together(verdict, by_name, tested) for verdict in verdicts]

    def _together(
        self, broken: ClauseVerdict, by_name: dict[str, SetResult], tested: int
    ) -> ClauseVerdict:
        """The verdict on a clause that is not met, judged again as one of so many.

        Of many clauses whose figures are at their limits, one is broken by chance more often than
        one alone is (Bonferroni). That all clauses are met needs no such care, as each has to be
        (Berger 1982).
        """
        if broken.word != NOT_MET:
            return broken
        clause = broken.clause
        shared = 1 - (1 - clause.confidence) / tested
        surer = structs.replace(clause, confidence=shared)
        (again,) = self._judged([surer], by_name[clause.of])
        return replace(broken, together=again.word)

    def _judged(self, clauses: list[ClauseTable], result: SetResult) -> list[ClauseVerdict]:
        units = [_unit(clause, result.case_set) for clause in clauses]
        refused = result.case_set.refused
        if refused:
            return [
                ClauseVerdict(clause, None, unit, refused)
                for clause, unit in zip(clauses, units, strict=True)
            ]
        requires = [clause.require for clause in clauses]
        if result.cases is None:
            verdicts = [self._edge(clause, result) for clause in clauses]
        else:
            arcsec, seconds = self.own_error
            seed = self.plan.seed
            through = self.plan.through
            cases = with_motion(result.cases, requires, self.file, self.scale, through)
            verdicts = verdicts_of(requires, cases, self.scale, seed, arcsec, seconds)
        return [
            self._told(clause, verdict, unit)
            for clause, verdict, unit in zip(clauses, verdicts, units, strict=True)
        ]

    def _told(self, clause: ClauseTable, verdict: RequirementVerdict, unit: str) -> ClauseVerdict:
        """A verdict, or why there is none: what cases alone cannot show is not tested."""
        why = ""
        if clause.quantity == "time-bias" and self.on_bench:
            why = self._no_time()
        elif verdict.verdict == NOT_SHOWN and verdict.value is None and verdict.more is None:
            why = verdict.method
        if why:
            return ClauseVerdict(clause, None, unit, why)
        return ClauseVerdict(clause, verdict, unit)

    def _no_time(self) -> str:
        """Why a tracker's stamps tell no time of measurement; "" where they do."""
        answers = self.file.config.answers
        if answers is None or answers.clock == "own" or answers.stamp == "arrival":
            return (
                "the stamps are of the tracker's own clock, whose offset hides their bias; where it"
                ' is synchronised, write [answers] clock = "unix" or "host"'
            )
        return ""

    def _edge(self, clause: ClauseTable, result: SetResult) -> RequirementVerdict:
        sweep = result.case_set.sweep
        assert sweep is not None
        try:
            figure = edge_figure(sweep, result.levels, clause.confidence)
        except TooFewCases as few:
            return RequirementVerdict(clause.require, 0, None, None, NOT_SHOWN, None, str(few))
        return judged_figure(clause.require, figure)


def _unit(clause: ClauseTable, case_set: CaseSet) -> str:
    if clause.quantity == "edge" and case_set.sweep is not None:
        return case_set.sweep.unit
    return clause.require.unit


def write_ledger(path: Path, results: list[SetResult]) -> int:
    """Write a row for each case of each set; how many there are."""
    rows: list[tuple[Any, ...]] = []
    for result in results:
        for folder in result.folders:
            cases = read_cases(folder / "cases.parquet")
            level = _level_of(cases, result)
            columns = [_cells(cases, name) for name in LEDGER_COLUMNS]
            for row in zip(*columns, strict=True):
                rows.append((result.case_set.name, level, *row))
    write_csv(path, ("set", "level", *LEDGER_COLUMNS), rows)
    return len(rows)


def _level_of(cases: Columns, result: SetResult) -> float | None:
    if result.case_set.sweep is None:
        return None
    return float(cases.numbers[f"vary.{result.case_set.sweep.key}"][0])


def _cells(cases: Columns, name: str) -> list[Any]:
    if name in cases.texts:
        return list(cases.texts[name])
    values = cases.numbers.get(name)
    if values is None:
        return [""] * len(cases.numbers["case"])
    return ["" if math.isnan(value) else f"{value:.9g}" for value in values.tolist()]
