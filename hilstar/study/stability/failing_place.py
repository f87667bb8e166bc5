"""What the study of stability says of one place: the method that fails there, and what hilstar does, by one measure."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Figures:
    """One measure of two methods, in the unit of `tolerance`: `error` is hilstar's, `fault` that of the failing method."""

    error: float
    fault: float
    tolerance: float


@dataclass(frozen=True, slots=True)
class Place:
    """One place where a method fails.

    `method` fails there as `fails` says in figures; `happens` says what hilstar does there, and `why`.
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

    @property
    def failing(self) -> bool:
        """True where the failing method's error, by the same measure, is not."""
        return not self.figures.fault <= self.figures.tolerance
