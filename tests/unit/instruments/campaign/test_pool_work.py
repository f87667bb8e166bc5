"""A campaign's pool with workers in this process: how many there are, what becomes of the cases of
one that dies, and what the same workers do for the next campaign.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from hilstar.basics.errors import MachineError
from hilstar.basics.process.pool import News, WorkerProcess
from hilstar.instruments.campaign import pool
from hilstar.instruments.campaign.backlog import Backlog, Task
from hilstar.instruments.campaign.job import Answered, Identity, Job
from hilstar.instruments.campaign.plan import Design
from hilstar.instruments.campaign.pool import MAX_STARTS_LOST, Pool
from hilstar.instruments.campaign.run import Campaign
from hilstar.instruments.campaign.session import Session
from hilstar.instruments.campaign.store import Directory, Journal
from tests.support.campaigns import read_columns, write_campaign

KIND = Identity("1.0", "a" * 64, "2.1", "1.14", "llvmpipe")
JOB = Job("p", "", "b", "", "", "", "centroids", ".", 1.0, "d", False)
CASES = 40
DIES, WORKS, DIES_AT_WORK = "dies before it is ready", "works", "dies over its second task"
MB = 1_000_000


class Inbox:
    """The link of a worker that is here: what it was sent last."""

    def __init__(self) -> None:
        self.sent: tuple[Any, ...] = ()

    def send(self, arguments: tuple[Any, ...]) -> None:
        self.sent = arguments


class WorkersHere:
    """In the place of a pool of processes: the workers' lives are `lives`, and the last one's that
    of all others.
    """

    def __init__(self, lives: list[str]) -> None:
        self.lives = lives
        self.workers: list[WorkerProcess] = []
        self.counts: list[int] = []  # of workers, at each look
        self._works: dict[Inbox, tuple[str, Callable[..., Any]]] = {}
        self._tasks: dict[Inbox, int] = {}

    def __call__(self, start: Callable[..., Any], arguments: Any, told: Any) -> WorkersHere:
        self._start, self._arguments, self._told = start, arguments, told
        return self

    def start(self) -> None:
        self.workers.append(WorkerProcess(None, Inbox()))

    def heard(self) -> Iterator[News]:
        self.counts.append(len(self.workers))
        assert len(self.counts) < 20 * CASES, "the campaign does not end"
        for worker in list(self.workers):
            if not worker.ready:
                yield self._greeting(worker)
            elif worker.task is not None:
                yield self._answer(worker)

    def _greeting(self, worker: WorkerProcess) -> News:
        life = self.lives.pop(0) if len(self.lives) > 1 else self.lives[0]
        if life == DIES:
            self.workers.remove(worker)
            return News(worker, "died", -9)
        try:
            identity, work = self._start(*self._arguments)
        except self._told as error:
            return News(worker, "error", error)
        self._works[worker.link] = life, work
        worker.ready = True
        return News(worker, "ready", identity)

    def _answer(self, worker: WorkerProcess) -> News:
        life, work = self._works[worker.link]
        tasks = self._tasks.get(worker.link, 0) + 1
        self._tasks[worker.link] = tasks
        if life == DIES_AT_WORK and tasks > 1:
            self.workers.remove(worker)
            return News(worker, "died", -11)
        return News(worker, "answer", work(*worker.link.sent))

    def dismiss(self, worker: WorkerProcess) -> None:
        assert worker.task is None
        self.workers.remove(worker)

    def close(self) -> None:
        self.workers.clear()


class PoolRun:
    """A run of so many cases on workers that take no time; each task's peak of memory is the next
    of `peaks_mb`, the last for all others.
    """

    def __init__(
        self,
        folder: Path,
        monkeypatch: pytest.MonkeyPatch,
        lives: list[str],
        *,
        cases: int = CASES,
        memory_mb: int | None = None,
        peaks_mb: tuple[int, ...] = (1,),
        kind: Identity = KIND,
    ) -> None:
        self.here = WorkersHere(lives)
        self._peaks_mb = list(peaks_mb)
        monkeypatch.setattr(pool, "ProcessPool", self.here)
        monkeypatch.setattr(pool, "_start_session", lambda job: (kind, self._work))
        monkeypatch.setattr(pool, "peak_bytes", lambda: 0)
        self.cases: list[int] = []
        self.lost: list[tuple[int, int | None]] = []
        design = Design("sobol", 1, cases, 3, [])
        self._backlog = Backlog(design, Journal(folder / "j", cases), 1.0)
        memory_bytes = None if memory_mb is None else memory_mb * MB
        self._pool = Pool(JOB, KIND, 4, memory_bytes)

    def run(self) -> None:
        with self._pool:
            self._pool.run(
                self._backlog,
                lambda task, answered: self.cases.extend(row["case"] for row in answered.rows),
                self._lose,
            )

    def _lose(self, task: Task, at_fault: int | None) -> None:
        self.lost.append((task.begin, at_fault))

    def _work(self, job: Job, begin: int, points: Any) -> Answered:
        assert job is JOB
        peak_mb = self._peaks_mb.pop(0) if len(self._peaks_mb) > 1 else self._peaks_mb[0]
        rows = [{"case": begin + k} for k in range(len(points))]
        return Answered(rows, 0.25 * len(points), peak_mb * MB)


def test_starts_that_are_lost_count_in_succession_and_the_cases_of_the_dead_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nearly = [DIES] * (MAX_STARTS_LOST - 1)
    lives = [*nearly, DIES_AT_WORK, *nearly, WORKS]
    run = PoolRun(tmp_path / "goes on", monkeypatch, lives)
    run.run()
    assert sorted(run.cases) == list(range(CASES))
    ((begin, at_fault),) = run.lost
    assert begin in run.cases and at_fault is None
    ends = PoolRun(tmp_path / "ends", monkeypatch, [DIES])
    with pytest.raises(
        MachineError, match=r"^5 workers died before they were ready \(exit code -9"
    ):
        ends.run()


def test_there_are_no_more_workers_than_cases_and_none_of_another_kind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = PoolRun(tmp_path / "few", monkeypatch, [WORKS], cases=2)
    run.run()
    assert max(run.here.counts) == 2 and sorted(run.cases) == [0, 1]
    old = Identity("1.0", "a" * 64, "1.9", "1.14", "llvmpipe")
    other = PoolRun(tmp_path / "other", monkeypatch, [WORKS], kind=old)
    with pytest.raises(MachineError, match=r"^a worker of this machine has NumPy 1\.9, and"):
        other.run()


def test_as_many_workers_run_as_fit_by_the_largest_peak_so_far(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """100 MB: one until its peak of 30 MB is known, then three, and two from a peak of 50 MB on."""
    peaks_mb = (30, 30, 30, 50, 10)
    run = PoolRun(tmp_path, monkeypatch, [WORKS], memory_mb=100, peaks_mb=peaks_mb)
    run.run()
    assert sorted(run.cases) == list(range(CASES)) and run.lost == []
    counts = run.here.counts
    in_turn = [count for k, count in enumerate(counts) if k == 0 or count != counts[k - 1]]
    assert in_turn == [1, 3, 2]


def test_the_workers_of_one_campaign_run_the_cases_of_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Real sessions: plans that differ in their seed, on one worker that stays, and that frees the
    first one's GL contexts before it takes up the second.
    """
    closed = []

    class NotedSession(Session):
        def close(self) -> None:
            closed.append(self.job)
            super().close()

    monkeypatch.setattr(pool, "ProcessPool", WorkersHere([WORKS]))
    monkeypatch.setattr(pool, "Session", NotedSession)
    campaigns = []
    for seed in (1, 2):
        folder = tmp_path / str(seed)
        folder.mkdir()
        plan = write_campaign(folder, {"key": "time_s", "values": [0.0]}, cases=2, seed=seed)
        campaigns.append(Campaign(plan, folder / "out", "centroids", 1.0, False))
    first, second = campaigns
    with Pool(first.job, first.identity, 1) as workers:
        for campaign in campaigns:
            workers.turn_to(campaign.job, campaign.identity)
            directory = Directory(campaign.directory)
            done: list[int] = []
            campaign.run(directory, workers, done.append)
            directory.close()
            assert done == [0, 1, 2]
            rows = read_columns(directory.table)
            assert rows["noise_seed"] == [
                campaign.maker.case(k, campaign.design.points(k, k + 1)[0]).noise_seed
                for k in range(2)
            ]
            assert rows["bench_sha256"] == [campaign.file.sha256] * 2
            assert rows["status"] == ["done"] * 2
    assert first.job != second.job
    assert closed == [first.job]
