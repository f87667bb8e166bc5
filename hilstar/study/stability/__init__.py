"""Where methods fail, and what hilstar does there: each case compares two methods by one measure."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Figures:
    """One measure of two methods, in the unit of `tolerance`: `error` is hilstar's, `fault` that of the failing method."""

    error: float
    fault: float
    tolerance: float


@dataclass(frozen=True, slots=True)
class FailureCase:
    """One case in which a method fails.

    `fails` says in figures how `method` fails, `happens` what hilstar does instead, and `why`.
    """

    case: str
    method: str
    fails: str
    happens: str
    why: str
    figures: Figures

    @property
    def right(self) -> bool:
        """True where hilstar's error is within the tolerance; NaN is not."""
        return self.figures.error <= self.figures.tolerance
