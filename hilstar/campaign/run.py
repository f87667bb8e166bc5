"""A campaign from its plan to its table. Finished cases stay finished, however the run ends."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from hilstar.bench.bench_file import BenchFile, read_bench_file
from hilstar.campaign.cases import CaseMaker, columns, failed, first_row
from hilstar.campaign.plan import Design, Plan, checked_conditions, grid_levels, parse_plan
from hilstar.campaign.pool import MAX_DEATHS, Backlog, Pool, Task
from hilstar.campaign.session import Identity, Job, Session, files_sha256
from hilstar.campaign.store import About, Directory, Row, require_parquet, schema_of, write_table
from hilstar.errors import InputError
from hilstar.reading import MAX_TOML_BYTES, read_text

if TYPE_CHECKING:
    from hilstar.campaign.cluster import Cluster


class Campaign:
    """A campaign that is checked and ready to run; nothing is written yet. Raises InputError or MachineError."""

    def __init__(self, path: Path, directory: Path, solver: str, timeout_s: float, images: bool) -> None:
        require_parquet()
        text = read_text(path, "give the path of a plan", MAX_TOML_BYTES)
        self.path, self.directory = path, directory
        self.plan: Plan = parse_plan(path, text)
        self.file: BenchFile = read_bench_file(path.parent / self.plan.bench)
        self.job = Job(
            plan_path=str(path.resolve()),
            plan_text=text,
            bench_path=str(self.file.path.resolve()),
            bench_text=self.file.text,
            bench_sha256=self.file.sha256,
            files_sha256=files_sha256(self.plan, path.parent),
            solver=solver,
            solver_folder=str(Path.cwd()),
            timeout_s=timeout_s,
            directory=str(directory.resolve()),
            images=images,
        )
        try:
            session = Session(self.job)  # errors of plan, bench and solver are reported once, here
        except InputError as error:
            raise InputError(f"{path}: {error}" if "[[vary]]" in str(error) else str(error)) from error
        try:
            self.identity: Identity = session.identity()
            self.maker: CaseMaker = session.maker
        finally:
            session.close()
        self.columns = columns(self.maker.parameters, "stars" in session.columns)
        for require in self.plan.require:
            checked_conditions(require.condition, self.columns)
        levels = grid_levels(self.plan)
        self.cases = self.plan.cases or math.prod(levels)
        self.design = Design(self.plan.sampling, self.plan.seed, self.cases, self.maker.attitude_dimensions, levels)

    def about(self) -> About:
        """Everything that the rows depend on."""
        plan = msgspec.json.decode(msgspec.json.encode(self.plan, enc_hook=str))
        del plan["require"]  # judged afterwards: another limit is no other campaign
        identity = msgspec.to_builtins(self.identity)
        return About(plan, self.file.sha256, self.job.files_sha256, self.job.solver, self.job.images, identity)

    def run(self, directory: Directory, workers: Pool | Cluster, on_done: Callable[[int], None]) -> None:
        """Run the missing cases, and write the table once none is missing. `on_done` gets the number of finished cases.

        Raises InputError where nothing can be written, and the workers' errors. The same call goes on from there.
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
                workers.run(Backlog(self.design, journal, workers.task_s), lambda task, answered: keep(answered.rows), lost)
            about = {
                f"hilstar.{name}": value if isinstance(value, str) else msgspec.json.encode(value).decode()
                for name, value in msgspec.to_builtins(self.about()).items()
            }
            rows = (journal.rows(block) for block in range(journal.blocks))
            write_table(directory.table, schema_of(self.columns, about), rows)
            journal.remove()
        finally:
            journal.close()
