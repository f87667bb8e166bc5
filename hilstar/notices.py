"""Events of a run, told as they happen: a line on stderr, a count in the summary, an event in the ledger.

A kind that comes more than MAX_SAID times within SAID_WINDOW_S is counted and recorded, and said again once it is rare.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Self

from hilstar.errors import printable

MAX_SAID = 3
SAID_WINDOW_S = 10.0
MAX_DETAIL_CHARACTERS = 400
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Notice:
    """One event of a run: when (host time, ns), of what kind (a word such as "stale"), a line for a person, who caused it."""

    host_ns: int
    kind: str
    detail: str
    who: str = ""

    @classmethod
    def now(cls, kind: str, detail: str, who: str = "") -> Self:
        """An event of this moment, in text that JSON and a terminal hold, whatever a file in it is called."""
        return cls(time.monotonic_ns(), kind, printable(detail)[:MAX_DETAIL_CHARACTERS], printable(who))


def at_now(line: str) -> str:
    """A line of a run's log, with its UTC."""
    return f"{datetime.now(UTC):%H:%M:%S.%f}"[:-3] + f"Z {line}"


Listener = Callable[[Notice], None]


class Notices:
    """Takes events from any thread; never waits, never raises for what a listener does."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._active: dict[str, str] = {}
        self._said_ns: dict[str, deque[int]] = {}
        self._listeners: list[Listener] = []
        self._lock = threading.Lock()

    def listen(self, listener: Listener) -> None:
        """Hand every further event to `listener` too."""
        self._listeners.append(listener)

    def tell(self, kind: str, detail: str, who: str = "") -> None:
        """Count an event, say it unless its kind floods, and hand it on; `who` is the person that it comes from, if one."""
        notice = Notice.now(kind, detail, who)
        with self._lock:
            self._counts[kind] += 1
            said_ns = self._said_ns.setdefault(kind, deque(maxlen=MAX_SAID))
            floods = len(said_ns) == MAX_SAID and notice.host_ns - said_ns[0] < SAID_WINDOW_S * 1e9
            if not floods:
                said_ns.append(notice.host_ns)
            last_before_silence = not floods and len(said_ns) == MAX_SAID
            last_before_silence &= notice.host_ns - said_ns[0] < SAID_WINDOW_S * 1e9
        if not floods:
            further = "; further ones are only counted for a while" if last_before_silence else ""
            log.warning("%s", at_now(notice.detail + further))
        for listener in self._listeners:
            listener(notice)

    def mention(self, kind: str, detail: str) -> None:
        """Say an event that is counted elsewhere, and hand it on."""
        notice = Notice.now(kind, detail)
        log.warning("%s", at_now(notice.detail))
        for listener in self._listeners:
            listener(notice)

    def begin(self, kind: str, detail: str) -> None:
        """Tell of an event that lasts: its kind is in `active` until `end`. Nothing where it has begun already."""
        with self._lock:
            if kind in self._active:
                return
            self._active[kind] = detail
        self.tell(kind, detail)

    def end(self, kind: str, told_as: str, detail: str) -> None:
        """Tell of the end of what began, as an event of its own; nothing where it never began."""
        with self._lock:
            if kind not in self._active:
                return
            del self._active[kind]
        self.tell(told_as, detail)

    @property
    def active(self) -> frozenset[str]:
        """The kinds that have begun and not ended."""
        with self._lock:
            return frozenset(self._active)

    @property
    def lasting(self) -> dict[str, str]:
        """The kinds that have begun and not ended, with what was told of each."""
        with self._lock:
            return dict(self._active)

    def counts(self) -> dict[str, int]:
        """How often each kind came."""
        with self._lock:
            return dict(self._counts)
