"""A campaign on a cluster: a Dask scheduler that the user has started, and its workers, which may
come and go during the campaign.

Each thread of a worker has its own session, with its own GL context.
"""

import asyncio
import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hilstar.attitude.wire.endpoint import check_use, parse_endpoint
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import HilstarError, InputError, MachineError, one_line
from hilstar.basics.process.closing import Closing
from hilstar.instruments.campaign.backlog import Backlog, Done, Lost, Task
from hilstar.instruments.campaign.job import Answered, Identity, Job, difference
from hilstar.instruments.campaign.session import Session

_here = threading.local()
INSTALL = "install it: pip install 'hilstar[dask]'"
PROTOCOLS = ("tcp", "tls", "ucx")
GIVE_TLS = (
    "give tls://HOST:PORT with --tls-ca-file, --tls-cert and --tls-key, as Dask's scheduler and"
    " workers have them"
)
# seconds of work in a task; handing one out costs the scheduler milliseconds (docs/campaign.md)
TASK_S = 1.0
SPARE_TASKS = 1  # tasks that wait at a worker, besides those on which its threads work
POLL_S, LOOK_S = 0.25, 0.5
CONNECT_S, ANSWER_S, MAX_SILENCE_S = 30.0, 30.0, 90.0
FETCH_S = 5.0  # the rows of a finished task come at once, or their worker has gone
MAX_WITHOUT_WORKER_S = 60.0
CLOSE_S = 0.3  # a Ctrl-C ends a command within a second


def examine(job: Job) -> Identity | str:
    """Runs on a worker: returns its identity, or a text that says why it cannot do the job."""
    try:
        return _session(job).identity()
    except HilstarError as error:
        return str(error)


def run_task(job: Job, begin: int, points: FloatArray) -> Answered:
    """Runs on a worker: returns the rows of n cases, the first of which has the number `begin`, at
    their points (n, dimensions).
    """
    return _session(job).run(begin, points)


def _session(job: Job) -> Session:
    """This thread's session of a job, opened where needed; a session of another job is closed."""
    session: Session | None = getattr(_here, "session", None)
    if session is None or session.job != job:
        _here.session = None
        if session is not None:
            session.close()
        session = _here.session = Session(job)
    return session


@dataclass(frozen=True, slots=True)
class Scheduler:
    """A scheduler's address ("tcp://HOST:PORT", "tls://HOST:PORT"), and its TLS files, named as in
    Dask.

    `tls_key` may be missing where the certificate's file contains the key, and all three where
    Dask's own configuration names them.
    """

    address: str
    tls_ca_file: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None

    def check(self) -> str:
        """The address, with `localhost` as a number: a name could be resolved to anything.

        Raises InputError for text that is no address, an address off loopback without TLS, and
        incomplete TLS. A scheduler runs all code that it is sent: without certificates, anyone who
        reaches it runs code on every worker.
        """
        named, (protocol, _, host) = f"--scheduler {self.address}", self.address.partition("://")
        if protocol not in PROTOCOLS:
            raise InputError(f"{named}: write tcp://HOST:PORT, as `dask scheduler` says it")
        try:
            endpoint = parse_endpoint(f"tcp://{host}")
            check_use(endpoint, f"tcp://{host}", bind=False)
        except InputError as error:
            raise InputError(f"{named}: {str(error).partition(': ')[2]}") from error
        files = self.tls_ca_file, self.tls_cert, self.tls_key
        if protocol == "tls":
            missing = [name for name in ("tls_ca_file", "tls_cert") if getattr(self, name) is None]
            if any(files) and missing:
                raise InputError(
                    f"{named}: --{missing[0].replace('_', '-')} is missing; {GIVE_TLS}"
                )
        elif any(files):
            raise InputError(
                f"{named}: {protocol} is not encrypted, and --tls-* would do nothing; write"
                " tls://HOST:PORT"
            )
        elif not endpoint.loopback:
            raise InputError(
                f"{named}: non-loopback endpoints require TLS; {GIVE_TLS}, or use"
                " tcp://127.0.0.1:PORT"
            )
        return f"{protocol}://{endpoint.address.removeprefix('tcp://')}"

    def security(self) -> Any:
        """Dask's security object; None for an address without TLS. Raises InputError for files that
        are no certificates, and for tls:// without any.
        """
        from distributed.security import Security

        if not self.address.startswith("tls://"):
            return None
        names = {
            "tls_ca_file": self.tls_ca_file,
            "tls_client_cert": self.tls_cert,
            "tls_client_key": self.tls_key,
        }
        made: Any = Security
        try:
            security = made(
                require_encryption=True,
                **{name: str(path) for name, path in names.items() if path is not None},
            )
            context = security.get_connection_args("client").get("ssl_context")
        except (OSError, ValueError) as error:  # ssl's errors are among them
            files = (
                ", ".join(str(path) for path in names.values() if path is not None)
                or "Dask's configuration"
            )
            raise InputError(
                f"--scheduler {self.address}: {files}: {one_line(str(error))}; {GIVE_TLS}"
            ) from error
        if context is None:
            raise InputError(f"--scheduler {self.address}: no certificate is named; {GIVE_TLS}")
        return security


@dataclass(slots=True)
class _Worker:
    """A worker: the number of its threads, whether its identity has been checked, whether it was
    refused, and its tasks (Dask's future, task), oldest first.
    """

    threads: int
    checked: bool = False
    refused: bool = False
    tasks: deque[tuple[Any, Task]] = field(default_factory=deque)


class Cluster(Closing):
    """The workers of a scheduler. Use it as a context manager.

    A worker of another version, bench or renderer is refused with a line through `say` and gets no
    case. Raises InputError as `Scheduler.check` does, and MachineError where no scheduler answers.
    """

    task_s = TASK_S

    def __init__(
        self, scheduler: Scheduler, job: Job, identity: Identity, say: Callable[[str], None]
    ) -> None:
        try:
            import distributed
        except ImportError as error:
            raise MachineError(f"--scheduler needs Dask's distributed; {INSTALL}") from error
        address = scheduler.check()
        self._address = address
        self._job = job
        self._identity = identity
        self._say = say
        self._workers: dict[str, _Worker] = {}
        self._examined: dict[Any, str] = {}
        self._alone_since_s: float | None = None
        self._looked_s = 0.0
        self._answered_s = time.monotonic()
        self._something = threading.Event()  # set when a future is done
        # Dask logs each worker that goes, which is usual here
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        security = scheduler.security()
        try:
            client: Any = distributed.Client
            named = {"set_as_default": False, "name": "hilstar-campaign", "security": security}
            self._client = client(address, timeout=CONNECT_S, **named)
        except ValueError as error:
            raise InputError(
                f"--scheduler {address}: {one_line(str(error))}; write tcp://HOST:PORT"
            ) from error
        except (OSError, TimeoutError) as error:
            if "certificate" in str(error):
                why = (
                    "the scheduler and this side do not have certificates of one CA; look at"
                    " --tls-ca-file and --tls-cert"
                )
            else:
                why = f"nothing answers there; start one: dask scheduler {self._dask_words()}"
            raise MachineError(f"--scheduler {address}: {why}") from error
        listens: str = self._client.scheduler_info()["address"]
        # A scheduler that is reached over loopback may be open to the network as well.
        if not listens.startswith("tls://"):
            with contextlib.suppress(InputError):
                if not parse_endpoint(f"tcp://{listens.partition('://')[2]}").loopback:
                    self._say(
                        f"hilstar: the scheduler listens at {listens} without TLS: who reaches that"
                        f" runs code on its workers; start it with {self._dask_words()}"
                    )

    def _dask_words(self) -> str:
        """The options, as text, with which to start a scheduler or worker for this address."""
        if self._address.startswith("tls://"):
            return "--tls-ca-file CA.pem --tls-cert CERT.pem --tls-key KEY.pem"
        return "--host 127.0.0.1"

    def run(self, backlog: Backlog, done: Done, lost: Lost) -> None:
        """Run all cases (see `Pool.run`). Raises MachineError where the scheduler, or every
        worker, is gone for too long.
        """
        while True:
            if self._client.status == "closed":
                raise self._gone()
            # In another state the client is trying to reconnect to the scheduler.
            if self._client.status == "running":
                self._look(backlog, lost)
                self._hand_out(backlog)
            if backlog.to_run <= 0:
                return
            self._check_alone()
            self._something.wait(POLL_S)
            self._something.clear()
            self._hear_examined()
            self._hear_tasks(backlog, done, lost)

    def _look(self, backlog: Backlog, lost: Lost) -> None:
        if time.monotonic() - self._looked_s < LOOK_S:
            return
        self._looked_s = time.monotonic()
        try:
            present: dict[str, int] = self._client.sync(
                self._client.scheduler.ncores, workers=None, callback_timeout=ANSWER_S
            )
        except (OSError, TimeoutError, asyncio.CancelledError, RuntimeError) as error:
            if time.monotonic() - self._answered_s < MAX_SILENCE_S:
                return  # a busy scheduler answers later
            raise self._gone() from error
        self._answered_s = time.monotonic()
        for address in [address for address in self._workers if address not in present]:
            self._bury(address, backlog, lost)
        for address, threads in present.items():
            if address not in self._workers:
                self._workers[address] = _Worker(threads)
                future = self._submit(address, examine, self._job)
                self._examined[future] = address

    def _gone(self) -> MachineError:
        return MachineError(
            f"--scheduler {self._address}: answers no more; start it again, and run the same"
            " command: it goes on"
        )

    def _bury(self, address: str, backlog: Backlog, lost: Lost) -> None:
        """Drop a worker that has gone. The tasks on which it worked may be the cause, which is
        recorded (`Backlog.died`); its other tasks are handed out again.
        """
        worker = self._workers.pop(address)
        gone = [future for future, at in self._examined.items() if at == address]
        for future in gone:
            del self._examined[future]
        self._client.cancel([*gone, *(future for future, _ in worker.tasks)])
        for place, (_, task) in enumerate(worker.tasks):
            if place < worker.threads:
                lost(task, backlog.died(task))
            else:
                backlog.give_back(task)

    def _submit(self, address: str, function: Callable[..., Any], *arguments: Any) -> Any:
        where: Any = {"workers": [address], "allow_other_workers": False}
        future = self._client.submit(function, *arguments, **where, pure=False, retries=0)
        future.add_done_callback(lambda _: self._something.set())
        return future

    def _hand_out(self, backlog: Backlog) -> None:
        good = {
            address: worker
            for address, worker in self._workers.items()
            if worker.checked and not worker.refused
        }
        for depth in range(
            1, 1 + max((worker.threads for worker in good.values()), default=0) + SPARE_TASKS
        ):
            for address, worker in good.items():
                if len(worker.tasks) < min(depth, worker.threads + SPARE_TASKS):
                    task = backlog.take(sum(other.threads for other in good.values()))
                    if task is None:
                        return
                    worker.tasks.append(
                        (self._submit(address, run_task, self._job, task.begin, task.points), task)
                    )

    def _hear_examined(self) -> None:
        for future in [future for future in self._examined if future.done()]:
            address = self._examined.pop(future)
            worker = self._workers.get(address)
            if worker is None:
                continue
            worker.checked = True
            try:
                identity = future.result(timeout=FETCH_S)
                if isinstance(identity, Identity):
                    why = difference(identity, self._identity)
                else:
                    why = str(identity)
            # A worker with an older hilstar without campaigns, or with none, raises anything.
            except Exception as error:
                # The worker or the scheduler has gone. A worker that is still there is examined
                # again.
                if future.status != "error":
                    del self._workers[address]
                    continue
                why = (
                    f"cannot run campaigns of this hilstar ({type(error).__name__}: {error});"
                    " install the same version there"
                )
            if why is not None:
                self._refuse(address, why)

    def _refuse(self, address: str, why: str) -> None:
        self._workers[address].refused = True
        self._say(one_line(f"hilstar: worker {address} is refused: it {why}"))

    def _hear_tasks(self, backlog: Backlog, done: Done, lost: Lost) -> None:
        for address, worker in self._workers.items():
            for entry in [entry for entry in worker.tasks if entry[0].done()]:
                future, task = entry
                answered = _fetched(future)
                if answered is None and future.status in ("finished", "pending"):
                    continue
                worker.tasks.remove(entry)
                if answered is not None:
                    backlog.done(task, answered.seconds)
                    done(task, answered)
                elif future.status == "cancelled":  # as the connection to the scheduler ended
                    backlog.give_back(task)
                elif (
                    future.status == "error" and type(future.exception()).__name__ != "KilledWorker"
                ):
                    backlog.give_back(task)
                    if not worker.refused:
                        self._refuse(address, f"failed: {future.exception()}")
                else:
                    lost(task, backlog.died(task))

    def _check_alone(self) -> None:
        """Say once where there is no worker for the campaign. Raises MachineError after
        MAX_WITHOUT_WORKER_S without one.
        """
        if any(not worker.refused for worker in self._workers.values()):
            self._alone_since_s = None
            return
        now_s = time.monotonic()
        if self._workers:
            refused = f"; {len(self._workers)} are refused"
        else:
            refused = ""
        advice = (
            f"start some: dask worker {self._address} --nthreads 1 --nworkers 8"
            f" {self._dask_words()}"
        )
        if self._alone_since_s is None:
            self._alone_since_s = now_s
            self._say(
                f"hilstar: --scheduler {self._address} has no worker for this campaign{refused};"
                f" {advice}"
            )
        if now_s - self._alone_since_s > MAX_WITHOUT_WORKER_S:
            raise MachineError(
                f"--scheduler {self._address}: no worker for this campaign in"
                f" {MAX_WITHOUT_WORKER_S:g} s{refused}; {advice}"
            )

    def close(self) -> None:
        """Cancel the tasks that are not done, and disconnect from the scheduler."""
        with contextlib.suppress(Exception):
            self._client.cancel(
                [future for worker in self._workers.values() for future, _ in worker.tasks]
            )
            self._client.close(timeout=CLOSE_S)


def _fetched(future: Any) -> Answered | None:
    """A task's answer; None where it failed, or where its worker died before the answer was
    fetched.
    """
    if future.status != "finished":
        return None
    with contextlib.suppress(OSError, CancelledError):
        answered: Answered = future.result(timeout=FETCH_S)
        return answered
    return None
