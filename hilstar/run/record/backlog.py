"""What waits to be written, bounded by bytes, and what of a flood is kept whole."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass
from typing import Any, Literal

Kind = Literal["packet", "frame", "event"]
MAX_WAITING_BYTES = 32_000_000  # half a minute of a plain run, should the disk stand still
FRAMES_SHARE = 0.5  # of it; what is left is for packets
# A message of JSON and the objects that it is made of, roughly; the raw bytes of a packet come on top.
ENTRY_BYTES = {"packet": 1500, "frame": 2500, "event": 1000}


@dataclass(frozen=True, slots=True)
class Entry:
    """Something to be kept: its host time, a sequence number, and what it is (see `ledger`)."""

    kind: Kind
    time_ns: int
    sequence: int
    content: Any
    extra_bytes: int = 0

    @property
    def size_bytes(self) -> int:
        """Of memory, roughly."""
        return ENTRY_BYTES[self.kind] + self.extra_bytes


class Backlog:
    """Entries in the order of their coming; never waits, and drops frames first when there is no room."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self._entries: list[Entry] = []
        self._bytes = 0
        self._lock = threading.Lock()

    def put(self, entry: Entry) -> bool:
        """False where there was no room for it, which is counted."""
        room = MAX_WAITING_BYTES * (FRAMES_SHARE if entry.kind == "frame" else 1)
        with self._lock:
            if self._bytes + entry.size_bytes > room:
                self.dropped[entry.kind] += 1
                return False
            self._entries.append(entry)
            self._bytes += entry.size_bytes
            return True

    def take(self) -> list[Entry]:
        """All that wait."""
        with self._lock:
            taken, self._entries, self._bytes = self._entries, [], 0
        return taken


class Allowance:
    """How many of a kind are kept whole: `burst` of them at once, and `per_s` a second after that."""

    def __init__(self, burst: float, per_s: float) -> None:
        self._burst, self._per_s = burst, per_s
        self._left = burst
        self._last_ns = 0

    def take(self, now_ns: int) -> bool:
        """Whether one more is kept."""
        passed_s = max(0, now_ns - self._last_ns) / 1e9 if self._last_ns else 0.0
        self._last_ns = now_ns
        self._left = min(self._burst, self._left + passed_s * self._per_s)
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Sieve:
    """The first of each kind and reason whole, the others counted."""

    # Refused packets say little after the first ones; more than 2000 good ones a second are no sender's plan.
    ALLOWED = {"accepted": (4000, 2000), "refused": (20, 1), "event": (100, 10)}  # noqa: RUF012 - never changed

    def __init__(self) -> None:
        self._allowances: dict[tuple[Kind, str], Allowance] = {}
        self._counts: Counter[tuple[Kind, str]] = Counter()
        self._lock = threading.Lock()

    def keeps(self, kind: Kind, reason: str, now_ns: int) -> bool:
        """Whether one that comes now is to be kept whole; it is counted if not."""
        with self._lock:
            allowance = self._allowances.get((kind, reason))
            if allowance is None:
                rule = "event" if kind == "event" else "accepted" if reason == "accepted" else "refused"
                allowance = self._allowances[kind, reason] = Allowance(*self.ALLOWED[rule])
            kept = allowance.take(now_ns)
            if not kept:
                self._counts[kind, reason] += 1
        return kept

    def count(self, kind: Kind, reason: str, number: int = 1) -> None:
        """Count what is not kept for another cause."""
        with self._lock:
            self._counts[kind, reason] += number

    def counted(self) -> list[tuple[Kind, str, int]]:
        """What was counted since the last call."""
        with self._lock:
            counts, self._counts = self._counts, Counter()
        return [(kind, reason, number) for (kind, reason), number in counts.items()]
