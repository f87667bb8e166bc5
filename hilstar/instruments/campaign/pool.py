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


class Pool:
    """`count` processes for a job, at most as many as fit into `memory_bytes` with this one. Use it
    as a context manager.

    A process that dies is replaced, and its cases are run again.
    """

    task_s = TASK_S

    def __init__(
        self, job: Job, identity: Identity, count: int, memory_bytes: int | None = None
    ) -> None:
        self._identity = identity
        self._count = count
        self._memory_bytes = memory_bytes
        self._processes = ProcessPool(_start_session, (job,), (HilstarError,))
        self._starts_lost = 0
        self._peak_bytes = 0

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


def _start_session(job: Job) -> tuple[Identity, Callable[[int, FloatArray], Answered]]:
    session = Session(job)
    return session.identity(), session.run
