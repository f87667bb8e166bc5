"""The verdict: the display's errors against the limits of the bench file."""

from __future__ import annotations

from dataclasses import dataclass, field

from hilstar.twin.verify.display_errors import DisplayErrors, display_errors
from hilstar.twin.verify.faulty_fields import FaultSeen
from hilstar.twin.verify.measured import Measured
from hilstar.twin.verify.reasons import reasons


@dataclass(frozen=True, slots=True)
class Verdict:
    """What was measured, the errors in it, and every reason against the bench; and the faults that were asked for."""

    measured: Measured
    errors: DisplayErrors
    reasons: list[str]
    faults: list[FaultSeen] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """True without any reason against it."""
        return not self.reasons


def judge(measured: Measured) -> Verdict:
    """The verdict over all fields."""
    errors = display_errors(measured)
    return Verdict(measured, errors, reasons(measured, errors))
