"""The backlog of missing cases, and the pool of processes that runs them on this machine."""

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import HilstarError, InputError, MachineError
from hilstar.basics.process.pool import ProcessPool, WorkerProcess
from hilstar.basics.reading import size_text
from hilstar.instruments.campaign.plan import Design
from hilstar.instruments.campaign.session import (
    Answered,
    Identity,
    Job,
    Session,
    difference,
    peak_bytes,
)
from hilstar.instruments.campaign.store import Journal

FIRST_CASES, MAX_TASK_CASES = 1, 1000  # cases in a task
# A task lasts at least so long for each worker there is: one driver and one scheduler keep up with
# 50 tasks a second.
A_WORKER_S = 0.02
TASK_S = 0.5  # seconds of work in a task: a kill loses about as much per worker
SMOOTHING = 0.3
MAX_DEATHS = 3  # a case alone in its task that ends so many workers is taken for the cause
MAX_STARTS_LOST = 5  # processes in succession that died before they were ready


@dataclass(frozen=True, slots=True)
class Task:
    """Consecutive cases from `begin` on, with their points (n, dimensions)."""

    begin: int
    points: FloatArray

    def __len__(self) -> int:
        return len(self.points)


class Backlog:
    """The missing cases of a journal, in tasks of about `target_s` that get shorter at the end:
    all workers end together.
    """

    def __init__(self, design: Design, journal: Journal, target_s: float) -> None:
        self._design, self._target_s = design, target_s
        self._waiting: deque[Task] = deque()
        self._runs = self._missing_runs(journal)
        self._left: tuple[int, int] | None = None
        self.to_run = design.cases - journal.done
        self._case_s: float | None = None
        self._deaths: dict[int, int] = {}

    def _missing_runs(self, journal: Journal) -> Iterator[tuple[int, int]]:
        for block in range(journal.blocks):
            missing = np.array(journal.missing(block), dtype=np.int64)
            for part in np.split(missing, np.flatnonzero(np.diff(missing) != 1) + 1):
                if len(part):
                    yield int(part[0]), int(part[-1]) + 1

    def take(self, workers: int) -> Task | None:
        """The next task; None once all cases are handed out."""
        if self._waiting:
            return self._waiting.popleft()
        if self._left is None:
            self._left = next(self._runs, None)
        if self._left is None:
            return None
        begin, end = self._left
        stop = min(end, begin + self._size(workers))
        self._left = None if stop == end else (stop, end)
        return Task(begin, self._design.points(begin, stop))

    def _size(self, workers: int) -> int:
        if self._case_s is None:
            return FIRST_CASES
        fair = math.ceil(self.to_run / (4 * max(1, workers)))
        task_s = max(self._target_s, A_WORKER_S * workers)
        return max(1, min(MAX_TASK_CASES, fair, round(task_s / max(self._case_s, 1e-6))))

    def done(self, task: Task, seconds: float) -> None:
        """Note that a task came back after so many seconds of work."""
        self.to_run -= len(task)
        case_s = seconds / max(1, len(task))
        self._case_s = (
            case_s if self._case_s is None else (1 - SMOOTHING) * self._case_s + SMOOTHING * case_s
        )

    def give_back(self, task: Task) -> None:
        """Hand out a task again that nobody has begun."""
        self._waiting.append(task)

    def died(self, task: Task) -> int | None:
        """Note that a worker died over a task: its cases come again one by one. Returns the case
        at fault once one is known.
        """
        if len(task) == 1:
            self._deaths[task.begin] = self._deaths.get(task.begin, 0) + 1
            if self._deaths[task.begin] >= MAX_DEATHS:
                self.to_run -= 1
                return task.begin
        self._waiting.extend(Task(task.begin + k, task.points[k : k + 1]) for k in range(len(task)))
        return None


Done = Callable[[Task, Answered], None]
Lost = Callable[[Task, int | None], None]


class Pool:
    """`count` processes for a job, at most as many as fit into `memory_bytes` with this one. Use it
    as a context manager.

    A process that dies is replaced, and its cases are run again.
    """

    task_s = TASK_S

    def __init__(
        self, job: Job, identity: Identity, count: int, memory_bytes: int | None = None
    ) -> None:
        self._identity, self._count, self._memory_bytes = identity, count, memory_bytes
        self._processes = ProcessPool(_start_session, (job,), (HilstarError,))
        self._starts_lost, self._peak_bytes = 0, 0

    def run(self, backlog: Backlog, done: Done, lost: Lost) -> None:
        """Run all cases. `done` gets each task with its rows, `lost` a task whose worker died, and
        the case at fault if known.

        Raises InputError or MachineError where the workers cannot do the job.
        """
        workers = self._processes.workers
        while True:
            self._start_missing(backlog)
            if all(worker.task is None and worker.ready for worker in workers):
                return
            for worker, news, said in self._processes.heard():
                if news == "error":
                    raise said
                if news == "died":
                    self._replace(worker, said, backlog, lost)
                elif news == "ready":
                    other = difference(said, self._identity)
                    if other is not None:
                        raise MachineError(f"a worker of this machine {other}")
                    self._starts_lost = 0
                else:
                    self._take(worker, said, backlog, done)

    def _start_missing(self, backlog: Backlog) -> None:
        workers = self._processes.workers
        wanted = min(self._allowed(), max(1, backlog.to_run))
        while len(workers) < wanted and backlog.to_run:
            self._processes.start()
        for worker in workers:
            if worker.ready and worker.task is None:
                task = backlog.take(len(workers))
                if task is not None:
                    worker.give(task, task.begin, task.points)

    def _allowed(self) -> int:
        """How many processes may run. With a memory budget it is one, until that one has
        reported its memory.
        """
        if self._memory_bytes is None:
            return self._count
        if not self._peak_bytes:
            return 1
        room = self._memory_bytes - peak_bytes()
        if room < self._peak_bytes:
            raise InputError(
                f"--memory {size_text(self._memory_bytes)}: this process and one worker take"
                f" {size_text(peak_bytes() + self._peak_bytes)}; write so much or more"
            )
        return max(1, min(self._count, room // self._peak_bytes))

    def _take(
        self, worker: WorkerProcess, answered: Answered, backlog: Backlog, done: Done
    ) -> None:
        task, worker.task = worker.task, None
        self._peak_bytes = max(self._peak_bytes, answered.peak_bytes)
        backlog.done(task, answered.seconds)
        done(task, answered)
        if len(self._processes.workers) > self._allowed():
            self._processes.dismiss(worker)

    def _replace(
        self, worker: WorkerProcess, exit_code: int | None, backlog: Backlog, lost: Lost
    ) -> None:
        if not worker.ready:
            self._starts_lost += 1
            if self._starts_lost >= MAX_STARTS_LOST:
                raise MachineError(
                    f"{MAX_STARTS_LOST} workers died before they were ready (exit code"
                    f" {exit_code}); is there enough memory? write --workers 1"
                )
        if worker.task is not None:
            lost(worker.task, backlog.died(worker.task))

    def __enter__(self) -> "Pool":
        return self

    def __exit__(self, *raised: object) -> None:
        self._processes.close()


def _start_session(job: Job) -> tuple[Identity, Callable[[int, FloatArray], Answered]]:
    session = Session(job)
    return session.identity(), session.run
