"""A campaign from its plan to its table. Finished cases stay finished, however the run ends."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.reading import MAX_TOML_BYTES, read_text
from hilstar.instruments.campaign.backlog import MAX_DEATHS, Backlog, Task
from hilstar.instruments.campaign.cases import CaseMaker, bench_columns, failed, first_row
from hilstar.instruments.campaign.job import Identity, Job, files_sha256, identity_of
from hilstar.instruments.campaign.plan import (
    BENCH_KEYS,
    MAX_BENCH_CASES,
    Design,
    Plan,
    Require,
    checked_conditions,
    grid_levels,
    parse_plan,
)
from hilstar.instruments.campaign.pool import Pool
from hilstar.instruments.campaign.session import Session
from hilstar.instruments.campaign.store import (
    About,
    Directory,
    Row,
    require_parquet,
    schema_of,
    write_table,
)
from hilstar.server.bench.bench_file import BenchFile, read_bench_file

if TYPE_CHECKING:
    from hilstar.instruments.campaign.bench_run import Display
    from hilstar.instruments.campaign.cluster import Cluster


class Campaign:
    """A campaign that is checked and ready to run; nothing is written yet. Raises InputError or
    MachineError.

    `text` is the plan's, in the place of that of the file `path`.
    """

    def __init__(
        self,
        path: Path,
        directory: Path,
        solver: str,
        timeout_s: float,
        images: bool,
        *,
        text: str | None = None,
    ) -> None:
        require_parquet()
        if text is None:
            text = read_text(path, "give the path of a plan", MAX_TOML_BYTES)
        self.path = path
        self.directory = directory
        self.plan: Plan = parse_plan(path, text)
        self.file: BenchFile = read_bench_file(path.parent / self.plan.bench)
        self.on_bench = self.plan.through == "bench"
        self.job = Job(
            plan_path=str(path.resolve()),
            plan_text=text,
            bench_path=str(self.file.path.resolve()),
            bench_text=self.file.text,
            bench_sha256=self.file.sha256,
            files_sha256=files_sha256(self.plan, path.parent),
            solver="answers" if self.on_bench else solver,
            solver_folder=str(Path.cwd()),
            timeout_s=timeout_s,
            directory=str(directory.resolve()),
            images=images,
        )
        self.identity: Identity
        self.maker: CaseMaker
        try:  # errors of plan, bench and solver are reported once, here
            if self.on_bench:
                self.identity, self.maker = (
                    identity_of("the bench"),
                    CaseMaker(self.plan, self.file, path.parent),
                )
                self.columns = bench_columns(self.maker.parameters, self.plan.columns)
            else:
                session = Session(self.job)
                try:
                    self.identity = session.identity()
                    self.maker = session.maker
                finally:
                    session.close()
                self.columns = session.columns
        except InputError as error:
            raise InputError(
                f"{path}: {error}" if "[[vary]]" in str(error) else str(error)
            ) from error
        if self.on_bench and self.file.config.answers is None:
            raise InputError(
                f'{path}: through = "bench" needs the tracker\'s answers; write [answers] with'
                f' source = "serial" or the like in {self.file.path}'
            )
        self.check_conditions(self.plan.require)
        levels = grid_levels(self.plan)
        self.cases = self.plan.cases or math.prod(levels)
        if self.on_bench and self.cases > MAX_BENCH_CASES:
            raise InputError(
                f'{path}: cases = {self.cases}: through = "bench" takes at most {MAX_BENCH_CASES}'
            )
        self.design = Design(
            self.plan.sampling, self.plan.seed, self.cases, self.maker.attitude_dimensions, levels
        )

    def check_conditions(self, requires: list[Require]) -> None:
        """Refuse (InputError) conditions on columns that its table will not have."""
        for require in requires:
            checked_conditions(require.condition, self.columns)

    def about(self) -> About:
        """Everything that the rows depend on."""
        plan = msgspec.json.decode(msgspec.json.encode(self.plan, enc_hook=str))
        for key in () if self.on_bench else BENCH_KEYS:
            del plan[key]
        del plan["require"]  # judged afterwards: another limit is no other campaign
        # so that a campaign of before they were keys is still the same
        for table, key in ((plan, "columns"), (plan, "planted"), (plan["attitudes"], "body")):
            if not table[key]:
                del table[key]
        identity = msgspec.to_builtins(self.identity)
        return About(
            plan,
            self.file.sha256,
            self.job.files_sha256,
            self.job.solver,
            self.job.images,
            identity,
        )

    def run(
        self, directory: Directory, workers: "Pool | Cluster", on_done: Callable[[int], None]
    ) -> None:
        """Run the missing cases, and write the table once none is missing. `on_done` gets the
        number of finished cases.

        Raises InputError where nothing can be written, and the workers' errors. The same call goes
        on from there.
        """
        journal = directory.journal(self.cases)
        try:
            done = journal.done
            on_done(done)

            def keep(rows: list[Row]) -> None:
                nonlocal done
                done += journal.append(rows)
                on_done(done)

            def lost(task: Task, at_fault: int | None) -> None:
                if at_fault is not None:
                    row = first_row(self.maker.case(at_fault, task.points[0]), self.columns)
                    keep([failed(row, f"its worker died {MAX_DEATHS} times over it")])

            if done < self.cases:
                workers.run(
                    Backlog(self.design, journal, workers.task_s),
                    lambda task, answered: keep(answered.rows),
                    lost,
                )
            self._write(directory, (journal.rows(block) for block in range(journal.blocks)))
            journal.remove()
        finally:
            journal.close()

    def show(
        self,
        directory: Directory,
        display: "Display",
        notices: Notices,
        on_done: Callable[[int], None],
    ) -> bool:
        """Show the missing cases on the bench, and write the tables once none is missing; False
        where a signal ended the run.

        Raises as `run` does. The same call goes on from there.
        """
        from hilstar.instruments.campaign.bench_run import (
            CHECKS,
            BenchOrder,
            BenchRun,
            write_checks,
        )
        from hilstar.server.answers.judge import AnswerRules
        from hilstar.server.answers.reader import open_answers

        config = self.file.config
        rules = replace(AnswerRules.of(config), wrong_arcsec=self.plan.wrong_above_arcsec)
        order = BenchOrder(self.plan, self.cases, self.maker, self.design)
        with open_answers(config, self.file.folder, notices) as source:
            source.await_ready()
            run = BenchRun(
                order,
                self.columns,
                directory,
                source=source,
                rules=rules,
                notices=notices,
                on_done=on_done,
            )
            try:
                if not run.run(display):
                    return False
                checks: list[Row] = []

                def blocks() -> Iterator[list[Row]]:
                    for block in range(run.journal.blocks):
                        rows = run.journal.rows(block)
                        checks.extend(row for row in rows if row["case"] >= self.cases)
                        yield [row for row in rows if row["case"] < self.cases]

                self._write(directory, blocks())
                if checks:
                    write_checks(directory.path / CHECKS, checks, self.cases)
                run.journal.remove()
            finally:
                run.journal.close()
        return True

    def _write(self, directory: Directory, blocks: Iterator[list[Row]]) -> None:
        about = {}
        for name, value in msgspec.to_builtins(self.about()).items():
            about[f"hilstar.{name}"] = (
                value if isinstance(value, str) else msgspec.json.encode(value).decode()
            )
        write_table(directory.table, schema_of(self.columns, about), blocks)
