"""One step of the chain: its methods with their errors and times, and which of them no other beats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hilstar.study.sweep import MAX_ROUNDS, in_turn, pareto_front


@dataclass(frozen=True, slots=True)
class Figure:
    """What is measured of a method: a name and its unit; figures under `floor` count as 0."""

    name: str
    unit: str
    floor: float = 0.0


@dataclass(frozen=True, slots=True)
class Trial:
    """A method: its error and a second figure, in the units of its `Trials`, and the work that is timed.

    `more` are further figures by the names of their columns. The exact one is what the others are measured against. `measured`
    adds the median time and its quartiles, ms; `on_front` where no other is both as accurate and as fast; and in `beaten` what
    beats the default and why it stays the default.
    """

    method: str
    error: float
    second: float
    work: Callable[[], object]
    is_default: bool = False
    is_exact: bool = False
    more: dict[str, float] = field(default_factory=dict)
    time_ms: float = np.nan
    quartiles_ms: tuple[float, float] = (np.nan, np.nan)
    on_front: bool = False
    beaten: str = ""


@dataclass(frozen=True, slots=True)
class Trials:
    """All methods of a step; `work` says what is timed, `why_default` why the default stands where another beats it.

    `remark` is what the figures alone would hide.
    """

    name: str
    work: str
    error: Figure
    second: Figure
    why_default: str
    trials: Sequence[Trial]
    remark: str = ""

    @property
    def default(self) -> Trial:
        """The method that hilstar takes."""
        return next(trial for trial in self.trials if trial.is_default)


def measured(step: Trials, budget_s: float) -> Trials:
    """Time the methods of a step in turn, mark the front, and put the fastest first."""
    works = {trial.method: lambda _, work=trial.work: work() for trial in step.trials}
    times = in_turn(works, MAX_ROUNDS, budget_s / len(works))
    low, middle, high = np.array([np.percentile([one.wall_ms for one in took], (25, 50, 75)) for took in times.values()]).T
    front = pareto_front([max(trial.error, step.error.floor) for trial in step.trials], middle)
    found = [
        replace(trial, time_ms=float(ms), quartiles_ms=(float(q1), float(q3)), on_front=bool(on))
        for trial, q1, ms, q3, on in zip(step.trials, low, middle, high, front, strict=True)
    ]
    found = [_with_reason(t, found, step) if t.is_default and not t.on_front else t for t in found]
    return replace(step, trials=sorted(found, key=lambda trial: trial.time_ms))


def _with_reason(own: Trial, trials: Sequence[Trial], step: Trials) -> Trial:
    """The default, with the fastest method that beats it and why it stays."""
    floor = step.error.floor
    beating = [t for t in trials if max(t.error, floor) <= max(own.error, floor) and t.time_ms <= own.time_ms and t is not own]
    best = min(beating, key=lambda trial: trial.time_ms)
    saved = 100 * (1 - best.time_ms / own.time_ms)
    noise = ", and the quartiles of both overlap" if best.quartiles_ms[1] >= own.quartiles_ms[0] else ""
    beaten = f"'{best.method}' is no worse and takes {saved:.0f} % less time{noise}; {step.why_default}"
    return replace(own, beaten=beaten)
