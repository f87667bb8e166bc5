"""One step of the chain: its methods with their errors and times, and which of them no other beats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hilstar.study.sweep import interleaved, pareto_front


@dataclass(frozen=True, slots=True)
class Figure:
    """What is measured of a method: a name and its unit; figures under `floor` count as 0."""

    name: str
    unit: str
    floor: float = 0.0


@dataclass(frozen=True, slots=True)
class Trial:
    """A method to be timed: its error and a second figure, in the units of its `Trials`, and the work itself.

    `more` are further figures by the names of their columns. The exact one is what the others are measured against.
    """

    method: str
    error: float
    second: float
    work: Callable[[], object]
    is_default: bool = False
    is_exact: bool = False
    more: dict[str, float] = field(default_factory=dict)


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


@dataclass(frozen=True, slots=True)
class MethodRow:
    """A method as measured: median time and its quartiles, ms; `on_front` where no other is both as accurate and as fast.

    `beaten` says what beats the default and why it stays the default; it is empty for all others.
    """

    method: str
    error: float
    second: float
    time_ms: float
    quartiles_ms: tuple[float, float]
    is_default: bool
    is_exact: bool
    on_front: bool
    beaten: str = ""
    more: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TradeoffStep:
    """A step of the chain with a row for each method, the fastest first."""

    name: str
    work: str
    error: Figure
    second: Figure
    rows: tuple[MethodRow, ...]
    remark: str = ""

    @property
    def default(self) -> MethodRow:
        """The row of the method that hilstar takes."""
        return next(row for row in self.rows if row.is_default)


def measured(trials: Trials, budget_s: float) -> TradeoffStep:
    """Time the methods of a step in interleaved rounds, and mark the front."""
    times = interleaved([trial.work for trial in trials.trials], budget_s)
    low, middle, high = np.array([np.percentile(values, (25, 50, 75)) for values in times]).T
    front = pareto_front([max(trial.error, trials.error.floor) for trial in trials.trials], middle)
    rows = [
        MethodRow(
            t.method, t.error, t.second, float(ms), (float(q1), float(q3)), t.is_default, t.is_exact, bool(on), more=t.more
        )
        for t, q1, ms, q3, on in zip(trials.trials, low, middle, high, front, strict=True)
    ]
    rows = [_with_reason(row, rows, trials) if row.is_default and not row.on_front else row for row in rows]
    rows.sort(key=lambda row: row.time_ms)
    return TradeoffStep(trials.name, trials.work, trials.error, trials.second, tuple(rows), trials.remark)


def _with_reason(row: MethodRow, rows: Sequence[MethodRow], trials: Trials) -> MethodRow:
    """The default's row, with the fastest method that beats it and why it stays."""
    floor = trials.error.floor
    beating = [r for r in rows if max(r.error, floor) <= max(row.error, floor) and r.time_ms <= row.time_ms and r is not row]
    best = min(beating, key=lambda r: r.time_ms)
    saved = 100 * (1 - best.time_ms / row.time_ms)
    noise = ", and the quartiles of both overlap" if best.quartiles_ms[1] >= row.quartiles_ms[0] else ""
    beaten = f"'{best.method}' is no worse and takes {saved:.0f} % less time{noise}; {trials.why_default}"
    return replace(row, beaten=beaten)
