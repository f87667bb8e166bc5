"""The backlog of missing cases, and the pool of processes that runs them on this machine."""

from collections.abc import Callable

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import HilstarError, InputError, MachineError, size_text
from hilstar.basics.process.pool import ProcessPool, WorkerProcess
from hilstar.instruments.campaign.backlog import Backlog, Done, Lost
from hilstar.instruments.campaign.job import Answered, Identity, Job, difference, peak_bytes
from hilstar.instruments.campaign.session import Session

TASK_S = 0.5  # seconds of work in a task: a kill loses about as much per worker
MAX_STARTS_LOST = 5  # processes in succession that died before they were ready


def processes_within(memory_bytes: int, own_bytes: int, worker_bytes: int, most: int) -> int:
    """How many workers of `worker_bytes` fit beside this process of `own_bytes`, at most `most`.
    Raises InputError where none does.
    """
    room = memory_bytes - own_bytes
    if room < worker_bytes:
        raise InputError(
            f"--memory {size_text(memory_bytes)}: this process and one worker take"
            f" {size_text(own_bytes + worker_bytes)}; write so much or more"
        )
    return min(most, room // worker_bytes)


class Pool:
    """`count` processes for a job, at most as many as fit into `memory_bytes` with this one. Use it
    as a context manager.

    A process that dies is replaced, and its cases are run again. `turn_to` gives the same processes
    another job, so that the campaigns of an acceptance read the catalogue once.
    """

    task_s = TASK_S

    def __init__(
        self, job: Job, identity: Identity, count: int, memory_bytes: int | None = None
    ) -> None:
        self._job = job
        self._identity = identity
        self._count = count
        self._memory_bytes = memory_bytes
        self._processes = ProcessPool(_start_session, (job,), (HilstarError,))
        self._starts_lost = 0
        self._peak_bytes = 0

    def turn_to(self, job: Job, identity: Identity) -> None:
        """Take up another job on the same bench, once `run` has returned."""
        self._job = job
        self._identity = identity

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
            for worker, news, payload in self._processes.heard():
                if news == "error":
                    raise payload
                if news == "died":
                    self._replace(worker, payload, backlog, lost)
                elif news == "ready":
                    other = difference(payload, self._identity)
                    if other is not None:
                        raise MachineError(f"a worker of this machine {other}")
                    self._starts_lost = 0
                else:
                    self._take(worker, payload, backlog, done)

    def _start_missing(self, backlog: Backlog) -> None:
        workers = self._processes.workers
        wanted = min(self._allowed(), max(1, backlog.to_run))
        while len(workers) < wanted and backlog.to_run:
            self._processes.start()
        for worker in workers:
            if worker.ready and worker.task is None:
                task = backlog.take(len(workers))
                if task is not None:
                    worker.give(task, self._job, task.begin, task.points)

    def _allowed(self) -> int:
        """How many processes may run. With a memory budget it is one, until that one has
        reported its memory.
        """
        if self._memory_bytes is None:
            return self._count
        if not self._peak_bytes:
            return 1
        return processes_within(self._memory_bytes, peak_bytes(), self._peak_bytes, self._count)

    def _take(
        self, worker: WorkerProcess, answered: Answered, backlog: Backlog, done: Done
    ) -> None:
        task = worker.task
        worker.task = None
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


class _Worker:
    """A worker's session of the last job that it was given.

    Another job needs no other look at the identity: the process, and with it program and libraries,
    is the same, and the bench file, which chooses the renderer, too.
    """

    def __init__(self, job: Job) -> None:
        self.session = Session(job)

    def run(self, job: Job, begin: int, points: FloatArray) -> Answered:
        """The rows of a job's cases from `begin` on at their points (n, dimensions)."""
        if self.session.job != job:
            self.session.close()
            self.session = Session(job)
        return self.session.run(begin, points)


def _start_session(job: Job) -> tuple[Identity, Callable[[Job, int, FloatArray], Answered]]:
    worker = _Worker(job)
    return worker.session.identity(), worker.run
