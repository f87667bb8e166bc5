"""The statistics of the tracker's answers in a ledger: over the whole run, and before, during and
after each fault.

The time of an answer is the middle of its exposure. Memory does not grow with the run, except by up
to MAX_FAULTS faults.
"""

import math
from collections import deque
from dataclasses import dataclass, field

import msgspec
import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.running_statistics import Percentiles, RunningStatistics
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.server.answers.answer import StampOrder
from hilstar.server.record.ledger_records import AnswerRecord, FaultRecord, FrameRecord

AROUND_S = 10.0  # length of the spans before and after a fault
MAX_FAULTS = 500
VERDICTS = ("right", "wrong", "invalid", "unpaired", "unjudged")
MAX_WRONG = 1000  # wrong answers with a stored time


class AnswerSpan(msgspec.Struct, frozen=True, kw_only=True):
    """The answers in a part of a run: their number by verdict, and `availability`, the right
    answers over those due. Errors in arcsec: `rms_arcsec` of right answers about the camera's x, y
    and z, `largest_arcsec` of any compared answer.
    """

    length_s: float
    right: int
    wrong: int
    invalid: int
    availability: float | None
    rms_arcsec: list[float] | None
    largest_arcsec: float | None


class FaultEffect(msgspec.Struct, frozen=True, kw_only=True):
    """A fault and its effect on the answers; `start_s` and `end_s` in s after the run's first swap.

    `first_wrong_s` is the time from the fault's beginning to the exposure of the first wrong answer
    before the recovery. `recovered_s` is the time from its end to the exposure of the first right
    answer: 0 where the last answer during the fault was right, None where no right answer followed.
    """

    name: str
    kind: str
    start_s: float
    end_s: float | None
    before: AnswerSpan
    during: AnswerSpan
    after: AnswerSpan
    first_wrong_s: float | None
    recovered_s: float | None


class AnswerReport(msgspec.Struct, frozen=True, kw_only=True):
    """The statistics of the tracker's answers over a run. Errors of right answers, arcsec about the
    camera's x, y and z: `rms_arcsec` is about zero, `sigma3_arcsec` three standard deviations about
    the mean.

    `out_of_order` counts answers whose stamp lies before that of an earlier arrival, `unjudged`
    answers that were compared with nothing.
    """

    answers: int
    right: int
    wrong: int
    invalid: int
    unpaired: int
    unjudged: int
    out_of_order: int
    rate_hz: float | None
    availability: float | None
    mean_arcsec: list[float] | None
    rms_arcsec: list[float] | None
    sigma3_arcsec: list[float] | None
    latency_ms: Percentiles
    faults: list[FaultEffect]


@dataclass(slots=True)
class SpanTally:
    """Adds up the answers of a part of a run: `counts` by verdict, and the sums of the right
    answers' errors and of their squares, arcsec, (3,).
    """

    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(VERDICTS, 0))
    total: FloatArray = field(default_factory=lambda: np.zeros(3))
    squares: FloatArray = field(default_factory=lambda: np.zeros(3))
    largest_arcsec: float | None = None

    def add(self, record: AnswerRecord) -> None:
        """Add an answer."""
        self.counts[record.verdict] = self.counts.get(record.verdict, 0) + 1
        if record.residual_arcsec is None:
            return
        self.largest_arcsec = max(self.largest_arcsec or 0.0, math.hypot(*record.residual_arcsec))
        if record.verdict == "right":
            self.total = self.total + record.residual_arcsec
            self.squares = self.squares + np.square(record.residual_arcsec)

    def mean(self) -> list[float] | None:
        """The mean error of right answers, arcsec about x, y and z; None without one."""
        if self.counts["right"]:
            return _rounded(self.total / self.counts["right"])
        return None

    def rms(self) -> list[float] | None:
        """Their rms about zero, arcsec about x, y and z; None without a right answer."""
        if self.counts["right"]:
            return _rounded(np.sqrt(self.squares / self.counts["right"]))
        return None

    def sigma3(self) -> list[float] | None:
        """Three standard deviations about the mean, arcsec about x, y and z; None for fewer than
        two right answers.
        """
        count = self.counts["right"]
        if count < 2:
            return None
        return _rounded(
            3 * np.sqrt(np.maximum(self.squares - self.total**2 / count, 0) / (count - 1))
        )

    def span(self, length_s: float, cycle_s: float | None) -> AnswerSpan:
        """The statistics of a part that is `length_s` long; an answer is due every `cycle_s`, None
        if that is not known.
        """
        share = None
        if cycle_s and length_s > cycle_s / 2:
            share = round(min(self.counts["right"] / max(round(length_s / cycle_s), 1), 1.0), 4)
        return AnswerSpan(
            length_s=round(length_s, 3),
            **{verdict: self.counts[verdict] for verdict in VERDICTS[:3]},
            availability=share,
            rms_arcsec=self.rms(),
            largest_arcsec=None if self.largest_arcsec is None else round(self.largest_arcsec, 3),
        )


@dataclass(slots=True)
class _Fault:
    """A fault, and the answers before, during and after it (`parts`); times in ns, host time."""

    record: FaultRecord
    start_ns: int
    end_ns: int | None = None
    parts: tuple[SpanTally, SpanTally, SpanTally] = field(
        default_factory=lambda: (SpanTally(), SpanTally(), SpanTally())
    )
    first_wrong_ns: int | None = None
    recovered_ns: int | None = None
    was_right: bool = False  # the last answer of the fault

    def add(self, record: AnswerRecord) -> None:
        at_ns = record.middle_ns
        around_ns = AROUND_S * NS_PER_S
        if at_ns < self.start_ns:
            if at_ns >= self.start_ns - around_ns:
                self.parts[0].add(record)
            return
        if record.verdict == "wrong" and self.first_wrong_ns is None and self.recovered_ns is None:
            self.first_wrong_ns = at_ns
        if self.end_ns is None or at_ns < self.end_ns:
            self.parts[1].add(record)
            self.was_right = record.verdict == "right"
            return
        if record.verdict == "right" and self.recovered_ns is None:
            self.recovered_ns = at_ns
        if at_ns < self.end_ns + around_ns:
            self.parts[2].add(record)

    def over(self, at_ns: int) -> bool:
        """Whether an answer at `at_ns`, host time, or later no longer changes the statistics."""
        return (
            self.end_ns is not None
            and self.recovered_ns is not None
            and at_ns > self.end_ns + AROUND_S * NS_PER_S
        )

    def effect(
        self, zero_ns: int, first_ns: int, last_ns: int, cycle_s: float | None
    ) -> FaultEffect:
        end_ns = last_ns if self.end_ns is None else self.end_ns
        around_ns = round(AROUND_S * NS_PER_S)
        lengths_ns = (
            min(around_ns, self.start_ns - first_ns),
            end_ns - self.start_ns,
            0 if self.end_ns is None else min(around_ns, last_ns - self.end_ns),
        )
        before, during, after = (
            part.span(max(length_ns, 0) / NS_PER_S, cycle_s)
            for part, length_ns in zip(self.parts, lengths_ns, strict=True)
        )
        if self.recovered_ns is None:
            recovered_s = None
        else:
            recovered_s = _s(self.recovered_ns, end_ns)
        return FaultEffect(
            name=self.record.name,
            kind=self.record.kind,
            start_s=_s(self.start_ns, zero_ns),
            end_s=None if self.end_ns is None else _s(self.end_ns, zero_ns),
            before=before,
            during=during,
            after=after,
            first_wrong_s=(
                None if self.first_wrong_ns is None else _s(self.first_wrong_ns, self.start_ns)
            ),
            recovered_s=0.0 if self.was_right and recovered_s is not None else recovered_s,
        )


class AnswerTally:
    """Computes the statistics of a run's answers from its records, one by one in their order.

    A fault older than the beginning of the ledger, `begun_ns` (host time), belongs to the run that
    is replayed. `wrong_ns` are the times of wrong answers, host time.
    """

    def __init__(self, begun_ns: int = 0) -> None:
        self.whole = SpanTally()
        self._begun_ns = begun_ns
        self.wrong_ns: list[int] = []
        self.faults: list[_Fault] = []
        self._open: list[_Fault] = []
        self.replayed: dict[int, FaultRecord] = {}
        self._shown: frozenset[int] = frozenset()
        self._lately: deque[AnswerRecord] = deque()
        self._interval_s = RunningStatistics()
        self._latency_ms = RunningStatistics()
        self._order = StampOrder()
        self._first_ns = self._last_ns = self._host_ns = 0

    def answer(self, record: AnswerRecord) -> None:
        """Add an answer."""
        self.whole.add(record)
        if record.t_ns is not None:
            self._order.take(record.t_ns)
        # Where answers arrive faster than they are judged, the judged ones alone give the interval
        # and the number due.
        if record.verdict == "unjudged":
            return
        if self._host_ns:
            self._interval_s.add((record.host_ns - self._host_ns) / NS_PER_S)
        self._latency_ms.add((record.host_ns - record.middle_ns) / NS_PER_MS)
        self._host_ns, self._first_ns = record.host_ns, self._first_ns or record.middle_ns
        self._last_ns = max(self._last_ns, record.middle_ns)
        if record.verdict == "wrong" and len(self.wrong_ns) < MAX_WRONG:
            self.wrong_ns.append(record.middle_ns)
        self._lately.append(record)
        while self._lately[0].host_ns < record.host_ns - 2 * AROUND_S * NS_PER_S:
            self._lately.popleft()
        for fault in self._open:
            fault.add(record)
        self._open = [fault for fault in self._open if not fault.over(record.middle_ns)]

    def fault(self, record: FaultRecord) -> None:
        """Add the beginning or end of a fault. The faults of a replayed run come before its frames;
        the frames say when these faults are on.
        """
        if record.event == "start" and record.host_ns < self._begun_ns:
            self.replayed[record.number] = record
        elif record.event == "start":
            self._begin(record, record.host_ns)
        elif record.event == "end":
            self._end(record.number, record.host_ns)

    def frame(self, record: FrameRecord) -> None:
        """Find in a frame which faults of a replayed run begin or end with it."""
        if not self.replayed:
            return
        shown = frozenset(record.faults)
        for number in shown - self._shown:
            if number in self.replayed:
                self._begin(self.replayed[number], record.swap_ns)
        for number in self._shown - shown:
            self._end(number, record.swap_ns)
        self._shown = shown

    def _begin(self, record: FaultRecord, at_ns: int) -> None:
        if len(self.faults) == MAX_FAULTS:
            return
        fault = _Fault(record, at_ns)
        for answer in self._lately:
            fault.add(answer)
        self.faults.append(fault)
        self._open.append(fault)

    def _end(self, number: int, at_ns: int) -> None:
        for fault in self._open:
            if fault.record.number == number and fault.end_ns is None:
                fault.end_ns = at_ns

    def report(self, zero_ns: int) -> AnswerReport | None:
        """The statistics of the run, with times in s after `zero_ns`, host time; None for a run
        without answers.
        """
        counts = self.whole.counts
        answers = sum(counts.values())
        if not answers:
            return None
        cycle_s = self._interval_s.percentile(50)
        # No answer was due while no sky was shown: unpaired answers are subtracted.
        if not cycle_s:
            due = 0
        else:
            due = (
                round((self._last_ns - self._first_ns) / NS_PER_S / cycle_s)
                + 1
                - counts["unpaired"]
            )
        # The last answer stands for the time until the next one would have come.
        end_ns = self._last_ns + round((cycle_s or 0.0) * NS_PER_S)
        return AnswerReport(
            answers=answers,
            **{verdict: counts[verdict] for verdict in VERDICTS},
            out_of_order=self._order.fallen,
            rate_hz=round(1 / cycle_s, 3) if cycle_s else None,
            availability=round(min(counts["right"] / due, 1.0), 4) if due > 0 else None,
            mean_arcsec=self.whole.mean(),
            rms_arcsec=self.whole.rms(),
            sigma3_arcsec=self.whole.sigma3(),
            latency_ms=self._latency_ms.percentiles(),
            faults=[
                fault.effect(zero_ns, self._first_ns, end_ns, cycle_s) for fault in self.faults
            ],
        )


def answer_rows(found: AnswerReport | None) -> list[tuple[str, str]]:
    """The statistics as rows of text, (name, value); [] for a run without answers."""
    if found is None:
        return []
    refused = (
        f"{found.right} right, {found.wrong} wrong, {found.invalid} without an attitude,"
        f" {found.unpaired} of no sky"
    )
    if found.unjudged:
        refused += f", {found.unjudged} not judged"
    if found.out_of_order:
        refused += f"; {found.out_of_order} came out of order"
    late = found.latency_ms
    if late.p50 is None:
        times = ""
    else:
        times = f", {late.p50:.1f} / {late.p99 or 0:.1f} ms late (p50 / p99)"
    rows = [
        ("tracker's answers", f"{found.answers}: {refused}"),
        ("tracker's availability", f"{_share(found.availability)}{times}"),
        (
            "residual x, y, z, rms",
            f"{_three(found.rms_arcsec)} arcsec; mean {_three(found.mean_arcsec)}",
        ),
    ]
    for fault in found.faults:
        parts = []
        for name, span in (
            ("before", fault.before),
            ("during", fault.during),
            ("after", fault.after),
        ):
            parts.append(f"{name} {_share(span.availability)}, {_three(span.rms_arcsec)} arcsec")
        if fault.first_wrong_s is None:
            wrong = "none wrong"
        else:
            wrong = f"first wrong after {fault.first_wrong_s:.2f} s"
        if fault.recovered_s is None:
            again = "not recovered"
        else:
            again = f"recovered in {fault.recovered_s:.2f} s"
        rows.append((f"fault {fault.name}", "; ".join([*parts, wrong, again])))
    return rows


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"


def _three(values: list[float] | None) -> str:
    if values is None:
        return "-"
    return " ".join(f"{value:.1f}" for value in values)


def _s(at_ns: int, zero_ns: int) -> float:
    return round((at_ns - zero_ns) / NS_PER_S, 3)


def _rounded(values: FloatArray) -> list[float]:
    return [round(value, 3) for value in values.tolist()]
