"""A pool of worker processes: each works on one task at a time, answers over a pipe, and may die at
any moment.

The owner decides how many workers there are, what each does next, and what follows from a death.
"""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from hilstar.basics.process.closing import Closing
from hilstar.basics.process.interrupts import end_with_parent

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerProcess

END_S = 2.0  # for a worker to end by itself, and again once it is killed
ONE_THREAD = ("LP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

Work = Callable[..., Any]


@dataclass(slots=True, eq=False)
class WorkerProcess:
    """A worker, and the task that it has, as the owner names it. `ready` from the first message
    on.
    """

    process: "ForkServerProcess"
    link: Connection
    ready: bool = False
    task: Any = None

    def give(self, task: Any, *arguments: Any) -> None:
        """Hand a task to an idle worker: its work is called with `arguments`."""
        self.task = task
        with contextlib.suppress(OSError):  # the worker has just died, which `heard` reports
            self.link.send(arguments)


class News(NamedTuple):
    """A worker's greeting ("ready"), its answer, an exception of it, or its death with the exit
    code.
    """

    worker: WorkerProcess
    kind: Literal["ready", "answer", "error", "died"]
    said: Any


class ProcessPool(Closing):
    """Workers that call `start(*arguments)` once for a greeting and their work, and then the work
    for each task.

    A worker's exception of the types `told` comes back as an "error"; any other ends the worker.
    Use the pool as a context manager: its end kills the workers.
    """

    def __init__(
        self,
        start: Callable[..., tuple[Any, Work]],
        arguments: tuple[Any, ...],
        told: tuple[type[Exception], ...],
    ) -> None:
        self._serve = start, arguments, told
        self.workers: list[WorkerProcess] = []

    def start(self) -> WorkerProcess:
        """Start one more worker."""
        here, there = multiprocessing.Pipe()
        context = multiprocessing.get_context("forkserver")
        # imported once: 0.6 s of CPU for each worker but the first
        context.set_forkserver_preload([self._serve[0].__module__])
        process = context.Process(target=_serve, args=(there, *self._serve), daemon=True)
        with _for_children():
            process.start()
        there.close()
        worker = WorkerProcess(process, here)
        self.workers.append(worker)
        return worker

    def heard(self) -> Iterator[News]:
        """Wait until there is news of any worker."""
        ends: list[Any] = [
            end for worker in self.workers for end in (worker.link, worker.process.sentinel)
        ]
        ready = set(wait(ends))
        for worker in list(self.workers):
            if worker.link in ready or worker.process.sentinel in ready:
                yield self._news(worker)

    def _news(self, worker: WorkerProcess) -> News:
        with contextlib.suppress(EOFError, OSError):
            if worker.link.poll():  # an answer of one that has died since is still heard
                kind, payload = worker.link.recv()
                worker.ready = True
                return News(worker, kind, payload)
        self._remove(worker)
        return News(worker, "died", worker.process.exitcode)

    def dismiss(self, worker: WorkerProcess) -> None:
        """End a worker that has no task."""
        worker.link.close()
        self._remove(worker)

    def _remove(self, worker: WorkerProcess) -> None:
        self.workers.remove(worker)
        with contextlib.suppress(OSError):
            worker.link.close()
        worker.process.join(END_S)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join(END_S)

    def close(self) -> None:
        """Kill the workers."""
        for worker in self.workers:
            worker.process.terminate()
        for worker in list(self.workers):
            self._remove(worker)


@contextmanager
def _for_children() -> Iterator[None]:
    """Start children with one thread per library, and without a terminal's Ctrl-C: the owner
    ends them.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    # which the first child would start, and which unblocks Ctrl-C
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _serve(
    link: Connection,
    start: Callable[..., tuple[Any, Work]],
    arguments: tuple[Any, ...],
    told: tuple[type[Exception], ...],
) -> None:
    """A worker's life: greet, and answer tasks until the link ends."""
    end_with_parent()
    try:
        greeting, work = start(*arguments)
        link.send(("ready", greeting))
        while True:
            link.send(("answer", work(*link.recv())))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except told as error:
        with contextlib.suppress(OSError):
            link.send(("error", error))
