"""The tasks of a campaign that are still to be done."""

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.campaign.job import Answered
from hilstar.instruments.campaign.plan import Design
from hilstar.instruments.campaign.store import Journal

FIRST_CASES, MAX_TASK_CASES = 1, 1000  # cases in a task
# A task lasts at least so long for each worker there is: one driver and one scheduler keep up with
# 50 tasks a second.
A_WORKER_S = 0.02
SMOOTHING = 0.3
MAX_DEATHS = 3  # a case alone in its task that ends so many workers is taken for the cause


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
        self._design = design
        self._target_s = target_s
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
