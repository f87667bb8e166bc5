"""A campaign's part of a cluster, on a Dask of the test's own: which worker gets which cases, and
what becomes of those of one that fails or goes.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

import pytest

from hilstar.basics.errors import MachineError
from hilstar.instruments.campaign import cluster
from hilstar.instruments.campaign.backlog import Backlog, Task
from hilstar.instruments.campaign.cluster import Cluster, Scheduler, examine
from hilstar.instruments.campaign.job import Answered, Identity, Job
from hilstar.instruments.campaign.plan import Design
from hilstar.instruments.campaign.store import Journal

distributed = pytest.importorskip("distributed")
ADDRESS = "tcp://127.0.0.1:8786"
KIND = Identity("1.0", "a" * 64, "2.1", "1.14", "llvmpipe")
JOB = Job("p", "", "b", "", "", "", "centroids", ".", 1.0, "d", False)
CASES = 40
MOST_LOOKS = 20 * CASES  # at each a task of every worker ends


class KilledWorker(Exception):
    """As Dask names what it raises of a task whose workers died."""


class Future:
    """What a worker is to return; it is done once `end` is called."""

    def __init__(self, worker: str, answer: Callable[[], Any]) -> None:
        self.worker, self._answer = worker, answer
        self.status = "pending"
        self._value: Any = None
        self._error: Exception | None = None
        self._told: list[Callable[[Any], None]] = []

    def end(self) -> None:
        try:
            self._value = self._answer()
            self.status = "finished"
        except CancelledError:
            self.status = "cancelled"
        except Exception as error:
            self._error = error
            self.status = "error"
        for tell in self._told:
            tell(self)

    def done(self) -> bool:
        return self.status != "pending"

    def result(self, timeout: float) -> Any:
        if self._error is not None:
            raise self._error
        return self._value

    def exception(self) -> Exception | None:
        return self._error

    def add_done_callback(self, tell: Callable[[Any], None]) -> None:
        self._told.append(tell)


class Dask:
    """A client whose workers, with their threads, are those of `looks`, one look after the other;
    after each the oldest future of every worker ends.
    """

    def __init__(self, looks: list[dict[str, int]], answers: dict[str, Callable[..., Any]]) -> None:
        self.looks, self._answers = looks, answers
        self.looked = 0
        self.status = "running"
        self.scheduler = self
        self.ncores = "ncores"
        self.waiting: dict[str, list[Future]] = {}
        self.most: dict[str, int] = {}
        self.cancelled: list[Future] = []
        self.named: dict[str, Any] = {}
        self.busy = 0  # looks that the scheduler still does not answer

    def __call__(self, address: str, **named: Any) -> Dask:
        self.named = named | {"address": address}
        return self

    def scheduler_info(self) -> dict[str, str]:
        return {"address": ADDRESS}

    def sync(self, what: str, workers: None, callback_timeout: float) -> dict[str, int]:
        self.looked += 1
        assert self.looked < MOST_LOOKS, "the campaign does not end"
        if self.busy:
            self.busy -= 1
            raise TimeoutError
        present = self.looks.pop(0) if len(self.looks) > 1 else self.looks[0]
        for worker in present:
            if self.waiting.get(worker):
                self.waiting[worker].pop(0).end()
        return present

    def submit(self, function: Any, *arguments: Any, workers: list[str], **how: Any) -> Future:
        assert how == {"allow_other_workers": False, "pure": False, "retries": 0}
        (worker,) = workers
        future = Future(worker, lambda: self._answers[worker](function, *arguments))
        waiting = self.waiting.setdefault(worker, [])
        waiting.append(future)
        self.most[worker] = max(self.most.get(worker, 0), len(waiting))
        return future

    def cancel(self, futures: list[Future]) -> None:
        self.cancelled += futures

    def close(self, timeout: float) -> None:
        self.status = "closed"


def works(function: Any, job: Job, begin: int = 0, points: Any = ()) -> Any:
    """A worker of the campaign's kind."""
    assert job == JOB
    if function is examine:
        return KIND
    return Answered([{"case": begin + k} for k in range(len(points))], 0.25 * len(points), 1)


class WatchedBacklog(Backlog):
    """A backlog that remembers for how many workers its tasks were."""

    def __init__(self, folder: Path) -> None:
        super().__init__(Design("sobol", 1, CASES, 3, []), Journal(folder / "j", CASES), 1.0)
        self.workers: set[int] = set()

    def take(self, workers: int) -> Task | None:
        self.workers.add(workers)
        return super().take(workers)


class ClusterRun:
    """A run of CASES cases, the lines that it said, and the tasks that were lost."""

    def __init__(
        self,
        folder: Path,
        monkeypatch: pytest.MonkeyPatch,
        looks: list[dict[str, int]],
        answers: dict[str, Callable[..., Any]],
    ) -> None:
        for name in ("LOOK_S", "POLL_S"):
            monkeypatch.setattr(cluster, name, 0.0)
        self.dask = Dask(looks, answers)
        monkeypatch.setattr(distributed, "Client", self.dask)
        self.said: list[str] = []
        self.lost: list[tuple[int, int | None]] = []
        self.cases: list[int] = []
        self.backlog = WatchedBacklog(folder)
        self.cluster = Cluster(Scheduler(ADDRESS), JOB, KIND, self.said.append)

    def run(self) -> None:
        with self.cluster:
            self.cluster.run(self.backlog, self._done, self._lost)

    def _done(self, task: Task, answered: Answered) -> None:
        assert [row["case"] for row in answered.rows] == list(
            range(task.begin, task.begin + len(task))
        )
        self.cases += [row["case"] for row in answered.rows]

    def _lost(self, task: Task, at_fault: int | None) -> None:
        self.lost.append((task.begin, at_fault))


def test_workers_of_another_kind_are_refused_by_name_and_the_others_are_kept_busy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def old(function: Any, *_: Any) -> Identity:
        assert function is examine
        return Identity("1.0", "a" * 64, "1.9", "1.14", "llvmpipe")

    def without(function: Any, *_: Any) -> str:
        assert function is examine
        return "has no bench.toml"

    def broken(function: Any, *_: Any) -> None:
        assert function is examine
        raise ImportError("no campaign")

    present = {"good": 2, "more": 1, "old": 3, "without": 1, "broken": 1}
    answers = {"good": works, "more": works, "old": old, "without": without, "broken": broken}
    run = ClusterRun(tmp_path, monkeypatch, [present], answers)
    run.run()
    assert sorted(run.cases) == list(range(CASES)) and run.lost == []
    assert run.said == [
        "hilstar: worker old is refused: it has NumPy 1.9, and the campaign is of 2.1; install"
        " that version there",
        "hilstar: worker without is refused: it has no bench.toml",
        "hilstar: worker broken is refused: it cannot run campaigns of this hilstar (ImportError:"
        " no campaign); install the same version there",
    ]
    # a task for each thread, and one that waits
    assert run.dask.most == {"good": 3, "more": 2, "old": 1, "without": 1, "broken": 1}
    assert run.backlog.workers == {3}
    assert run.dask.named == {
        "address": ADDRESS,
        "timeout": cluster.CONNECT_S,
        "set_as_default": False,
        "name": "hilstar-campaign",
        "security": None,
    }


def test_of_a_worker_that_goes_the_task_at_work_is_lost_and_the_one_that_waits_given_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone, here = {"a": 1}, {"b": 1}
    looks = [{}, *[gone] * 3, {}, {}, here]
    run = ClusterRun(tmp_path, monkeypatch, looks, {"a": works, "b": works})
    run.run()
    ((begin, at_fault),) = run.lost
    assert at_fault is None
    assert sorted(run.cases) == list(range(CASES)) and begin in run.cases
    assert [future.worker for future in run.dask.cancelled] == ["a", "a"]
    # said once before each of the two workers
    line, again = run.said
    assert again == line
    assert line.startswith(f"hilstar: --scheduler {ADDRESS} has no worker for this campaign; start")
    assert f"dask worker {ADDRESS} --nthreads 1 --nworkers 8 --host 127.0.0.1" in line


def test_a_task_that_fails_refuses_its_worker_and_one_that_kills_it_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(function: Any, job: Job, begin: int = 0, points: Any = ()) -> Any:
        if function is not examine:
            raise RuntimeError("disk is full")
        return KIND

    def kills(function: Any, job: Job, begin: int = 0, points: Any = ()) -> Any:
        if begin <= 7 < begin + len(points):
            raise KilledWorker("7")
        return works(function, job, begin, points)

    run = ClusterRun(
        tmp_path, monkeypatch, [{"fails": 1, "kills": 1}], {"fails": fails, "kills": kills}
    )
    run.run()
    assert run.said == ["hilstar: worker fails is refused: it failed: disk is full"]
    assert [begin for begin, _ in run.lost[-3:]] == [7] * 3
    assert [at_fault for _, at_fault in run.lost if at_fault is not None] == [7]
    assert sorted(run.cases) == sorted(set(range(CASES)) - {7})


def test_tasks_of_a_connection_that_ended_are_given_back_and_no_worker_is_blamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut = [4, 3]

    def cuts(function: Any, job: Job, begin: int = 0, points: Any = ()) -> Any:
        if function is not examine and begin in cut:
            cut.remove(begin)
            raise CancelledError
        return works(function, job, begin, points)

    run = ClusterRun(tmp_path, monkeypatch, [{"a": 1, "b": 2}], {"a": cuts, "b": cuts})
    run.run()
    assert cut == []
    assert sorted(run.cases) == list(range(CASES))
    assert run.lost == [] and run.said == []


def test_a_campaign_without_a_worker_or_a_scheduler_ends_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: Any) -> str:
        return "has no bench.toml"

    monkeypatch.setattr(cluster, "MAX_WITHOUT_WORKER_S", 0.0)
    alone = ClusterRun(
        tmp_path / "a", monkeypatch, [{"a": 1, "b": 1}], {"a": refused, "b": refused}
    )
    with pytest.raises(MachineError) as error:
        alone.run()
    assert "no worker for this campaign in 0 s; 2 are refused; start some" in str(error.value)
    assert "has no worker for this campaign; 2 are refused;" in alone.said[-1]
    gone = ClusterRun(tmp_path / "b", monkeypatch, [{}], {})
    gone.dask.status = "closed"
    with pytest.raises(MachineError, match="answers no more; start it again"):
        gone.run()


def test_a_scheduler_that_is_busy_for_a_while_is_asked_again_and_one_that_stays_silent_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    busy = ClusterRun(tmp_path / "a", monkeypatch, [{"a": 1}], {"a": works})
    busy.dask.busy = 3
    busy.run()
    assert sorted(busy.cases) == list(range(CASES))
    monkeypatch.setattr(cluster, "MAX_SILENCE_S", 0.0)
    silent = ClusterRun(tmp_path / "b", monkeypatch, [{"a": 1}], {"a": works})
    silent.dask.busy = 1
    with pytest.raises(MachineError, match="answers no more; start it again"):
        silent.run()


@pytest.mark.parametrize(
    ("address", "number"),
    [("tcp://localhost:8786", ADDRESS), ("ucx://127.0.0.1:9000", "ucx://127.0.0.1:9000")],
)
def test_a_scheduler_is_reached_by_its_number(address: str, number: str) -> None:
    assert Scheduler(address).check() == number
    assert Scheduler(address.replace("tcp", "tls").replace("ucx", "tls")).check() == (
        number.replace("tcp", "tls").replace("ucx", "tls")
    )
