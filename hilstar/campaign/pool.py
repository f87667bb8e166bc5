"""The cases that are still to be run, in tasks as long as a worker should have, and what becomes of a dead worker's.

The pool: processes of this machine, one GL context each; one that dies is replaced, and its cases are run again.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.campaign.plan import Design
from hilstar.campaign.session import Answered, Identity, Job, Session, difference, peak_bytes
from hilstar.campaign.store import Journal
from hilstar.errors import HilstarError, InputError, MachineError
from hilstar.process.interrupts import end_with_parent
from hilstar.reading import size_text

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

FIRST_CASES, MAX_TASK_CASES = 1, 1000  # a task
A_WORKER_S = 0.02  # of a task, so that one driver and one scheduler keep up: 50 tasks a second, whatever the workers' number
MAX_DEATHS = 3  # of workers over one case alone, which is then taken for the cause
SMOOTHING = 0.3
TASK_S = 0.5  # of work in a task: a kill loses about as much a worker
MAX_STARTS_LOST = 5  # processes that died before they were ready, one after the other
END_S = 2.0
ONE_THREAD = ("LP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Task:
    """Consecutive cases from `begin` on, with their points (n, dimensions)."""

    begin: int
    points: FloatArray

    def __len__(self) -> int:
        return len(self.points)


class Backlog:
    """Hands the missing cases of a journal out in tasks of about `target_s`, shorter at the end: all workers end together."""

    def __init__(self, design: Design, journal: Journal, target_s: float) -> None:
        self._design, self._target_s = design, target_s
        self._waiting: deque[Task] = deque()
        self._runs = self._missing_runs(journal)
        self._left: tuple[int, int] | None = None
        self.to_run = design.cases - journal.done
        self._case_s: float | None = None
        self._deaths: dict[int, int] = {}

    def _missing_runs(self, journal: Journal) -> Iterator[tuple[int, int]]:
        """Begin and end of each run of missing cases."""
        for block in range(journal.blocks):
            missing = np.array(journal.missing(block), dtype=np.int64)
            for part in np.split(missing, np.flatnonzero(np.diff(missing) != 1) + 1):
                if len(part):
                    yield int(part[0]), int(part[-1]) + 1

    def take(self, workers: int) -> Task | None:
        """The next task, None where all cases are handed out."""
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
        """A task has come back after so much work."""
        self.to_run -= len(task)
        case_s = seconds / max(1, len(task))
        self._case_s = case_s if self._case_s is None else (1 - SMOOTHING) * self._case_s + SMOOTHING * case_s

    def give_back(self, task: Task) -> None:
        """A task that nobody has begun is handed out again."""
        self._waiting.append(task)

    def died(self, task: Task) -> int | None:
        """A worker died over a task, whose cases are handed out again one by one; or the case that ended too many of them."""
        if len(task) == 1:
            self._deaths[task.begin] = self._deaths.get(task.begin, 0) + 1
            if self._deaths[task.begin] >= MAX_DEATHS:
                self.to_run -= 1
                return task.begin
        self._waiting.extend(Task(task.begin + k, task.points[k : k + 1]) for k in range(len(task)))
        return None


Done = Callable[[Task, Answered], None]
Lost = Callable[[Task, int | None], None]


@dataclass(slots=True)
class _Worker:
    process: SpawnProcess
    link: Connection
    ready: bool = False
    task: Task | None = None


class Pool:
    """`count` processes for a job, at most as many as fit into `memory_bytes` with this one. Use it as a context manager."""

    task_s = TASK_S

    def __init__(self, job: Job, identity: Identity, count: int, memory_bytes: int | None = None) -> None:
        self._job, self._identity = job, identity
        self._count, self._memory_bytes = count, memory_bytes
        self._workers: list[_Worker] = []
        self._starts_lost, self._peak_bytes = 0, 0
        self.pids: list[int] = []

    def run(self, backlog: Backlog, done: Done, lost: Lost) -> None:
        """Run all cases: `done` gets each task with its rows, `lost` one whose worker died, with the case at fault, if one is.

        Raises InputError or MachineError where the workers cannot do the job.
        """
        while True:
            self._start_missing(backlog)
            busy = [worker for worker in self._workers if worker.task is not None or not worker.ready]
            if not busy:
                return
            ends: list[Any] = [end for worker in self._workers for end in (worker.link, worker.process.sentinel)]
            ready = set(wait(ends))
            for worker in list(self._workers):
                if worker.link in ready:
                    self._hear(worker, backlog, done, lost)
                elif worker.process.sentinel in ready:
                    self._bury(worker, backlog, lost)

    def _start_missing(self, backlog: Backlog) -> None:
        wanted = min(self._allowed(), max(1, backlog.to_run))
        while len(self._workers) < wanted and backlog.to_run:
            self._workers.append(self._started())
        for worker in self._workers:
            if worker.ready and worker.task is None:
                self._give(worker, backlog)

    def _allowed(self) -> int:
        """How many processes may run: with a budget of memory one, until it has said what it takes."""
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

    def _started(self) -> _Worker:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        process = context.Process(target=_serve, args=(there, self._job), daemon=True)
        with _for_children():
            process.start()
        there.close()
        self.pids.append(process.pid or 0)
        return _Worker(process, here)

    def _give(self, worker: _Worker, backlog: Backlog) -> None:
        worker.task = backlog.take(len(self._workers))
        if worker.task is not None:
            with contextlib.suppress(OSError):  # it has just died, which its sentinel tells
                worker.link.send((worker.task.begin, worker.task.points))

    def _hear(self, worker: _Worker, backlog: Backlog, done: Done, lost: Lost) -> None:
        try:
            said = worker.link.recv()
        except (EOFError, OSError):
            self._bury(worker, backlog, lost)
            return
        if isinstance(said, HilstarError):
            raise said
        if isinstance(said, Identity):
            other = difference(said, self._identity)
            if other is not None:
                raise MachineError(f"a worker of this machine {other}")
            worker.ready, self._starts_lost = True, 0
            return
        task, worker.task = worker.task, None
        self._peak_bytes = max(self._peak_bytes, said.peak_bytes)
        if task is not None:
            backlog.done(task, said.seconds)
            done(task, said)
        if len(self._workers) > self._allowed():
            self._dismiss(worker)

    def _bury(self, worker: _Worker, backlog: Backlog, lost: Lost) -> None:
        worker.process.join(END_S)
        worker.link.close()
        self._workers.remove(worker)
        if not worker.ready:
            self._starts_lost += 1
            if self._starts_lost >= MAX_STARTS_LOST:
                raise MachineError(
                    f"{MAX_STARTS_LOST} workers died before they were ready (exit code {worker.process.exitcode});"
                    " is there enough memory? write --workers 1"
                )
        if worker.task is not None:
            lost(worker.task, backlog.died(worker.task))

    def _dismiss(self, worker: _Worker) -> None:
        """End a worker that has no task: memory for it is no longer there."""
        self._workers.remove(worker)
        _end(worker)

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.process.terminate()
        for worker in self._workers:
            _end(worker)
        self._workers.clear()


def _end(worker: _Worker) -> None:
    with contextlib.suppress(OSError):
        worker.link.close()
    worker.process.join(END_S)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join(END_S)


@contextmanager
def _for_children() -> Iterator[None]:
    """What is started here has one thread for each kind of work, and no Ctrl-C: this process ends it."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _serve(link: Connection, job: Job) -> None:
    """A worker: says what it is, and answers tasks until its link ends."""
    end_with_parent()
    try:
        session = Session(job)
        link.send(session.identity())
        while True:
            link.send(session.run(*link.recv()))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except HilstarError as error:
        with contextlib.suppress(OSError):
            link.send(error)
