"""Which messages of a flood are recorded in full, and which are only counted."""

from __future__ import annotations

import threading
from collections import Counter
from typing import Literal

from hilstar.run.record.backlog import Kind
from hilstar.units import NS_PER_S

Counted = Kind | Literal["pulse"]  # pulses are only counted


class Allowance:
    """How many of a kind are recorded in full: at most `burst` at once, and `per_s` each second after that."""

    def __init__(self, burst: float, per_s: float) -> None:
        self._burst, self._per_s = burst, per_s
        self._left = burst
        self._last_ns = 0

    def take(self, now_ns: int) -> bool:
        """Whether one more is recorded in full."""
        passed_s = max(0, now_ns - self._last_ns) / NS_PER_S if self._last_ns else 0.0
        self._last_ns = now_ns
        self._left = min(self._burst, self._left + passed_s * self._per_s)
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Sieve:
    """Passes the first of each kind and reason, and counts the others."""

    # Refused packets tell little after the first ones; no sender means to send more than 2000 good ones a second.
    ALLOWED = {"accepted": (4000, 2000), "refused": (20, 1), "event": (100, 10)}  # noqa: RUF012 - never changed

    def __init__(self) -> None:
        self._allowances: dict[tuple[Kind, str], Allowance] = {}
        self._counts: Counter[tuple[Counted, str]] = Counter()
        self._lock = threading.Lock()

    def keeps(self, kind: Kind, reason: str, now_ns: int) -> bool:
        """Whether a message that arrives now is recorded in full; it is counted if not."""
        with self._lock:
            allowance = self._allowances.get((kind, reason))
            if allowance is None:
                rule = "event" if kind == "event" else "accepted" if reason == "accepted" else "refused"
                allowance = self._allowances[kind, reason] = Allowance(*self.ALLOWED[rule])
            kept = allowance.take(now_ns)
            if not kept:
                self._counts[kind, reason] += 1
        return kept

    def count(self, kind: Counted, reason: str, number: int = 1) -> None:
        """Count messages that are not recorded for another reason."""
        with self._lock:
            self._counts[kind, reason] += number

    def counted(self) -> list[tuple[Counted, str, int]]:
        """The counts since the last call."""
        with self._lock:
            counts, self._counts = self._counts, Counter()
        return [(kind, reason, number) for (kind, reason), number in counts.items()]
