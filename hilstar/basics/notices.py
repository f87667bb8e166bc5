"""Events of a run, told as they happen: a line on stderr, a count in the summary, an event in the
ledger.

A kind that comes more than MAX_SAID times within SAID_WINDOW_S is only counted for a while, twice
as long each time up to MAX_QUIET_S, and then said with how many there were meanwhile; so is its
end, by `sum_up`. Where it comes on, what is only counted is not recorded either, but for what a
person did.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Self

from hilstar.basics.errors import printable
from hilstar.basics.wrong_sky import KINDS, WrongSky

MAX_SAID = 3
SAID_WINDOW_S = 10.0
MAX_QUIET_S = 640.0
MAX_RECORDED = 20  # events of a kind that are recorded; further ones are only counted
ALWAYS_RECORDED = frozenset({"fault"}) | KINDS  # a report is made from each begin and end
MAX_DETAIL_CHARACTERS = 400
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Notice:
    """One event of a run: when (host time, ns), of what kind (a word such as "stale"), a line for a
    person, and who caused it.

    `since_ns` is when the condition that it tells of began, where that was earlier.
    """

    host_ns: int
    kind: str
    detail: str
    who: str = ""
    since_ns: int | None = None

    @classmethod
    def now(cls, kind: str, detail: str, who: str = "", since_ns: int | None = None) -> Self:
        """An event of this moment, in text that JSON and a terminal hold, whatever a file in it
        is called.
        """
        return cls(
            time.monotonic_ns(),
            kind,
            printable(detail)[:MAX_DETAIL_CHARACTERS],
            printable(who),
            since_ns,
        )


def at_now(line: str) -> str:
    """A line of a run's log, with its UTC."""
    return f"{datetime.now(UTC):%H:%M:%S.%f}"[:-3] + f"Z {line}"


Listener = Callable[[Notice], None]


@dataclass(slots=True)
class _Kind:
    """How often a kind was said lately, and until when it is only counted."""

    said_ns: deque[int]
    quiet_s: float = 0.0
    until_ns: int = 0
    last_ns: int = 0
    unsaid: int = 0
    recorded: int = 0
    detail: str = ""

    def words(self, notice: Notice) -> str | None:
        """The line for one more notice of this kind; None where it is only counted."""
        now_ns = notice.host_ns
        if now_ns < self.until_ns:
            self.last_ns, self.unsaid = now_ns, self.unsaid + 1
            return None
        rare = now_ns - self.last_ns > SAID_WINDOW_S * 1e9
        self.last_ns, meanwhile, self.unsaid = now_ns, self.unsaid, 0
        if rare:
            self.quiet_s = 0.0
        self.said_ns.append(now_ns)
        often = len(self.said_ns) == MAX_SAID and now_ns - self.said_ns[0] < SAID_WINDOW_S * 1e9
        text = notice.detail + (f" ({meanwhile} more meanwhile)" if meanwhile else "")
        if not often and not (self.quiet_s and not rare):
            return text
        self.quiet_s = min(max(2 * self.quiet_s, SAID_WINDOW_S), MAX_QUIET_S)
        self.until_ns = now_ns + round(self.quiet_s * 1e9)
        return f"{text}; further ones are only counted for {self.quiet_s:.0f} s"


class Notices:
    """Takes events from any thread; never waits, never raises for what a listener does.

    `wrong_sky` has those that say that the sky shown is wrong.
    """

    def __init__(self) -> None:
        self.wrong_sky = WrongSky()
        self._counts: Counter[str] = Counter()
        self._active: dict[str, str] = {}
        self._kinds: dict[str, _Kind] = {}
        self._listeners: list[Listener] = []
        self._lock = threading.Lock()

    def listen(self, listener: Listener) -> None:
        """Hand every further event to `listener` too."""
        self._listeners.append(listener)

    def tell(self, kind: str, detail: str, who: str = "", since_ns: int | None = None) -> None:
        """Count an event, say it unless its kind floods, and hand it on.

        `who` is the person that it comes from, if one; `since_ns` is when that began of which it
        tells, host time.
        """
        notice = Notice.now(kind, detail, who, since_ns)
        self.wrong_sky.see(kind, notice.detail, notice.host_ns, since_ns)
        with self._lock:
            self._counts[kind] += 1
            known = self._kinds.setdefault(kind, _Kind(deque(maxlen=MAX_SAID)))
            known.detail = notice.detail
            text = known.words(notice)
            recorded = (
                text is not None
                or known.recorded < MAX_RECORDED
                or bool(who)
                or kind in ALWAYS_RECORDED
            )
            known.recorded += recorded
        if text is not None:
            log.warning("%s", at_now(text))
        if recorded:
            self._hand_on(notice)

    def sum_up(self) -> None:
        """Say, at a run's end, how many there were of each kind that was only counted."""
        with self._lock:
            kind_counts = []
            for kind, known in self._kinds.items():
                if known.unsaid:
                    unsaid = f"{known.unsaid} of them not said"
                    kind_counts.append(f"{kind} {self._counts[kind]} ({unsaid})")
                known.unsaid = 0
        if kind_counts:
            log.warning("%s", at_now(f"events in all: {', '.join(kind_counts)}"))

    def _hand_on(self, notice: Notice) -> None:
        for listener in self._listeners:
            listener(notice)

    def mention(self, kind: str, detail: str) -> None:
        """Say an event that is counted elsewhere, and hand it on."""
        notice = Notice.now(kind, detail)
        log.warning("%s", at_now(notice.detail))
        self._hand_on(notice)

    def begin(self, kind: str, detail: str, since_ns: int | None = None) -> None:
        """Tell of an event that lasts: its kind is in `active` until `end`. Nothing where it has
        begun already.
        """
        with self._lock:
            if kind in self._active:
                return
            self._active[kind] = detail
        self.tell(kind, detail, since_ns=since_ns)

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

    def latest(self, kind: str) -> str:
        """What was told last of a kind; "" for one that never came."""
        with self._lock:
            if kind in self._kinds:
                return self._kinds[kind].detail
            return ""

    def counts(self) -> dict[str, int]:
        """How often each kind came."""
        with self._lock:
            return dict(self._counts)
