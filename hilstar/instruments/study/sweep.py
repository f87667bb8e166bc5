"""Methods side by side: their times in turn, the front of error against time, and how busy the
machine was meanwhile.

Works are timed in rounds, so that other load on the machine is in the times of all of them. On a
busy machine no time says which method is faster, so a study also notes the load by others.
"""

import math
import os
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray
from hilstar.basics.charts import capital

MIN_ROUNDS = 3  # every work runs this often, whatever its share of a budget
MAX_ROUNDS = 500  # more do not move a median
SEED = 1  # of the orders of rounds
# share of the cores taken by others above which times are 5 % and more off: a third of one of two
# cores
BUSY_SHARE = 0.15
STAT = Path("/proc/stat")
NOT_JUDGED = "the times were taken on a busy machine: none is named the faster"


# What a study found, a line each, and whether it was right: None where its times cannot be judged.
Judged = tuple[list[str], bool | None]


@dataclass(frozen=True, slots=True)
class Load:
    """The cores that other processes used while times were taken, and what to say of the times."""

    cores: float = 0.0

    @property
    def busy(self) -> bool:
        """Whether other work makes times worthless."""
        return self.cores > BUSY_SHARE * (os.cpu_count() or 1)

    @property
    def caution(self) -> str:
        """The line about times taken beside other work."""
        return (
            f"a busy machine: other processes took {self.cores:.1f} of its {os.cpu_count()} cores"
            " meanwhile, so these times name no winner; run it again when the machine is idle"
        )

    def title(self, finding: str, errors: str = "The errors hold") -> str:
        """The title of a chart of times: `finding`; on a busy machine `errors` and NOT_JUDGED."""
        if self.busy:
            return f"{errors}; {NOT_JUDGED}"
        return finding

    def note(self, note: str) -> str:
        """The note of a chart that draws times; on a busy machine with the caution about them."""
        if not self.busy:
            return note
        return f"{note} {capital(self.caution)}."

    def judged(self, lines: Sequence[str]) -> Judged:
        """The lines of a study of times and True; on a busy machine the caution with them, and
        None, as such times are not judged.
        """
        if self.busy:
            return [*lines, self.caution], None
        return list(lines), True


class Spent(NamedTuple):
    """The wall time and the processor time (all threads) of one call, ms."""

    wall_ms: float
    cpu_ms: float


def spent(work: Callable[[], object]) -> Spent:
    """Call a work once and time it."""
    begin_cpu = time.process_time()
    begin = time.perf_counter()
    work()
    wall_s = time.perf_counter() - begin
    return Spent(1e3 * wall_s, 1e3 * (time.process_time() - begin_cpu))


def in_turn(
    works: Mapping[str, Callable[[int], object]], rounds: int, share_s: float = math.inf
) -> dict[str, list[Spent]]:
    """The times of at most `rounds` calls of each work, which is given the number of its round.

    Each round has an order of its own, so that no work always follows the same one. A work that has
    had `share_s` skips the rounds after MIN_ROUNDS. Round 0 is not counted: it compiles shaders and
    fills caches.
    """
    times: dict[str, list[Spent]] = {name: [] for name in works}
    names = list(works)
    rng = np.random.default_rng(SEED)
    for number in range(rounds + 1):
        for place in rng.permutation(len(names)):
            name = names[place]
            so_far_ms = sum(taken.wall_ms for taken in times[name])
            if number > MIN_ROUNDS and so_far_ms > 1e3 * share_s:
                continue
            taken = spent(partial(works[name], number))
            if number > 0:
                times[name].append(taken)
    return times


def medians_ms(works: Mapping[str, Callable[[int], object]], rounds: int) -> dict[str, float]:
    """The median wall time of each work over `rounds` rounds, ms; see `in_turn`."""
    medians = {}
    for name, times in in_turn(works, rounds).items():
        medians[name] = float(np.median([taken.wall_ms for taken in times]))
    return medians


def beaten_by(errors: npt.ArrayLike, times_ms: npt.ArrayLike) -> BoolArray:
    """Whether the method of a row is beaten by that of a column, (n, n).

    A method is beaten by another whose error and time are both no larger, and one of them smaller.
    """
    error = np.asarray(errors, dtype=np.float64)
    taken = np.asarray(times_ms, dtype=np.float64)
    as_good = (error <= error[:, None]) & (taken <= taken[:, None])
    better = (error < error[:, None]) | (taken < taken[:, None])
    return np.asarray(as_good & better)


def pareto_front(errors: npt.ArrayLike, times_ms: npt.ArrayLike) -> BoolArray:
    """Which methods (n,) no other beats, by error and time; two that are equal in both are both
    on the front.
    """
    return np.asarray(~beaten_by(errors, times_ms).any(axis=1))


class OtherWork:
    """Counts the cores that other processes use from now on; this process's children are not
    others.
    """

    def __init__(self) -> None:
        self._before = self._times_s()

    def cores(self) -> float:
        """How many cores the others took on average since creation; 0 where the system does not
        say.
        """
        all_before_s, others_before_s = self._before
        all_now_s, others_now_s = self._times_s()
        all_s = all_now_s - all_before_s
        others_s = max(others_now_s - others_before_s, 0.0)
        if all_s > 0:
            return others_s / all_s * (os.cpu_count() or 1)
        return 0.0

    def load(self) -> Load:
        """The use by others since creation."""
        return Load(self.cores())

    @staticmethod
    def _times_s() -> tuple[float, float]:
        """Processor time since the machine started, s: of all cores, idle or busy, and that of
        other processes.
        """
        try:
            first_line = STAT.read_text(encoding="ascii").split("\n", 1)[0]
            ticks = [int(word) for word in first_line.split()[1:9]]
            user, nice, system, idle, waiting, *interrupts = ticks
        except (OSError, ValueError):
            return 0.0, 0.0
        tick_s = 1 / os.sysconf("SC_CLK_TCK")
        busy = user + nice + system + sum(interrupts)
        own_s = 0.0
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN):
            usage = resource.getrusage(who)
            own_s += usage.ru_utime + usage.ru_stime
        return (busy + idle + waiting) * tick_s, busy * tick_s - own_s
