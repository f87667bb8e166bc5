"""Where methods fail, and hilstar's way there: each case compares two methods by one measure.

Cases that draw are measured by `hilstar study stability` where it runs (`image.py`). Mathematics is
the same on every machine: tests/authority measures those cases with every commit, and the tables
beside this file have their figures.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

COLUMNS = (
    "case",
    "verdict",
    "failing method",
    "its failure",
    "what happens",
    "why",
    "error",
    "its error",
    "tolerance",
)


@dataclass(frozen=True, slots=True)
class CaseFigures:
    """One measure of two methods, in the unit of `tolerance`: `error` is hilstar's, `fault` that
    of the failing method.
    """

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
    figures: CaseFigures

    @property
    def right(self) -> bool:
        """True where hilstar's error is within the tolerance; NaN is not."""
        return self.figures.error <= self.figures.tolerance

    def row(self) -> tuple[str | float, ...]:
        """The values of COLUMNS."""
        numbers = self.figures.error, self.figures.fault, self.figures.tolerance
        verdict = "right" if self.right else "WRONG"
        return (
            self.case,
            verdict,
            self.method,
            self.fails,
            self.happens,
            self.why,
            *map(float, numbers),
        )


def recorded(name: str) -> list[FailureCase]:
    """The recorded cases of one of the tables beside this file."""
    with Path(__file__).with_name(f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return [
            FailureCase(case, method, fails, happens, why, CaseFigures(*map(float, numbers)))
            for case, _, method, fails, happens, why, *numbers in list(csv.reader(file))[1:]
        ]
