"""Conditions under which the sky that is shown is wrong, though its attitudes are fresh: what each
is, and how long it lasted.

A check of the attitudes begins a condition and ends it, as events of the run (`Notices.begin`,
`Notices.end`). Everything else follows from these events: status line, page, `/health`, `/metrics`
and the summary of a run; and, as the ledger keeps them, its report and its replay.

Laws:
1. A condition is found after it began: its event says since when it holds, and the frames from then
   on are wrong.
2. Conditions may overlap; a second is counted once.
3. A run that ends ends its conditions.
"""

import threading
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from hilstar.basics.units import NS_PER_S

RATES, CONVENTION, CLOCK = "rates-wrong", "convention-wrong", "clock-not-shared"
# Each kind of condition, and the kind of the event that ends it.
ENDS = {RATES: "rates-right", CONVENTION: "convention-right", CLOCK: "clock-shared"}
BEGINS = {end: kind for kind, end in ENDS.items()}
KINDS = frozenset({*ENDS, *BEGINS})
FOR_EVER_NS = 2**63 - 1


class Condition(NamedTuple):
    """A condition that holds: its kind, a line with figures and what to write instead, and since
    when (host time, ns).
    """

    kind: str
    text: str
    since_ns: int


class ConditionTotal(msgspec.Struct, frozen=True):
    """A kind of condition over a run: how often it began, for how long it held in all, and its
    first line.
    """

    kind: str
    count: int
    seconds: float
    text: str


class WrongSkyTotal(msgspec.Struct, frozen=True):
    """The seconds of a run in which its sky was wrong, and why."""

    seconds: float = 0.0
    conditions: list[ConditionTotal] = []


class _Span(NamedTuple):
    begin_ns: int
    end_ns: int


class WrongSky:
    """The conditions of a run, from its events. Any thread may call any of its methods; host
    times, ns.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._now: dict[str, Condition] = {}
        self._past: dict[str, list[_Span]] = {}
        self._texts: dict[str, str] = {}
        self.any = False  # one attribute, so that a frame costs nothing in a run without any

    def see(self, kind: str, text: str, host_ns: int, since_ns: int | None = None) -> None:
        """Take an event of the run; one that neither begins nor ends a condition changes
        nothing.
        """
        if kind not in KINDS:
            return
        with self._lock:
            if kind in ENDS:
                self.any = True
                self._texts.setdefault(kind, text)
                begin_ns = host_ns if since_ns is None else min(since_ns, host_ns)
                self._now.setdefault(kind, Condition(kind, text, begin_ns))
                return
            ended = self._now.pop(BEGINS[kind], None)
            if ended is not None:
                spans = self._past.setdefault(ended.kind, [])
                spans.append(_Span(ended.since_ns, max(host_ns, ended.since_ns)))

    def now(self) -> list[Condition]:
        """The conditions that hold, the oldest first."""
        with self._lock:
            return sorted(self._now.values(), key=lambda condition: condition.since_ns)

    def at(self, host_ns: int) -> list[tuple[str, str]]:
        """Kind and first line of each condition that held at a host time."""
        with self._lock:
            return [
                (kind, self._texts[kind])
                for kind, spans in self._spans()
                if _covers(spans, host_ns)
            ]

    def spans_ns(self) -> list[tuple[int, int]]:
        """Begin and end of each time of a wrong sky, in order and apart; the end of one that
        goes on is FOR_EVER_NS.
        """
        with self._lock:
            every = [span for _, spans in self._spans() for span in spans]
        return [(span.begin_ns, span.end_ns) for span in _merged(every)]

    def total(self, from_ns: int, to_ns: int) -> WrongSkyTotal:
        """The seconds of a wrong sky between two host times."""
        with self._lock:
            by_kind = self._spans()
            texts = dict(self._texts)
        conditions = []
        for kind, spans in by_kind:
            seconds = _seconds(spans, from_ns, to_ns)
            conditions.append(ConditionTotal(kind, len(spans), seconds, texts[kind]))
        every = [span for _, spans in by_kind for span in spans]
        return WrongSkyTotal(_seconds(every, from_ns, to_ns), conditions)

    def _spans(self) -> list[tuple[str, list[_Span]]]:
        spans_by_kind = []
        for kind in self._texts:
            spans = list(self._past.get(kind, ()))
            condition = self._now.get(kind)
            if condition is not None:
                spans.append(_Span(condition.since_ns, FOR_EVER_NS))
            spans_by_kind.append((kind, spans))
        return spans_by_kind


def _covers(spans: Sequence[_Span], host_ns: int) -> bool:
    return any(span.begin_ns <= host_ns < span.end_ns for span in spans)


def _merged(spans: Sequence[_Span]) -> list[_Span]:
    merged: list[_Span] = []
    for span in sorted(spans):
        if merged and span.begin_ns <= merged[-1].end_ns:
            merged[-1] = _Span(merged[-1].begin_ns, max(span.end_ns, merged[-1].end_ns))
        else:
            merged.append(span)
    return merged


def _seconds(spans: Sequence[_Span], from_ns: int, to_ns: int) -> float:
    inside_ns = (min(span.end_ns, to_ns) - max(span.begin_ns, from_ns) for span in _merged(spans))
    return round(sum(max(length_ns, 0) for length_ns in inside_ns) / NS_PER_S, 3)
