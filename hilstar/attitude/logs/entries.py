"""The entries of a log: each attitude, or why it was refused, and its place in the file; their
order, and how they join.

Recorders write messages as they arrive, which is not always the order of their stamps (`in_order`):
1. Attitudes out of order by at most REORDER_NS are sorted, and counted.
2. Exact repeats (same time, attitude and rate) are dropped, and counted.
3. Any other time that does not increase is passed on, and the log is refused there.

A log's own usual interval says what a gap is, never the stale limit of a live stream (`log_joins`):
1. Before a discontinuity the attitude is held.
2. Two samples whose rates fit the turn between them are blended, however long the interval.
3. Other samples are joined by SLERP, the shorter way.
4. But an interval of more than GAP_INTERVALS usual ones is a gap: the attitude within it is
   unknown, and is held.
"""

import heapq
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.attitude.clock.rate_causes import AS_PACKETS, Cause, ReadAs
from hilstar.attitude.clock.rate_check import cause_in
from hilstar.attitude.clock.timeline import Join
from hilstar.attitude.logs.log_times import TIMES
from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.attitude.wire.source import Convention, Conventions, Mounting
from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import conjugate, multiply
from hilstar.basics.units import NS_PER_S

MAX_QUOTED_CHARACTERS = 80
SORT_ADVICE = "sort the log by time"
MAX_SAMPLES = 6_000_000  # 16 hours at 100 Hz; all are held, at 350 bytes each, so in 2 GB
# queues between a driver and a recorder hold less; a clock that was set back jumps by more
REORDER_NS = NS_PER_S
GAP_INTERVALS = 5  # usual (median) intervals; four packets lost in a row are not a gap
# Rates fit where their mean turns one attitude into the other within this share of the turn. For a
# sine the mean is off by (2 pi / samples per period)^2 / 12: seven samples per period still fit.
FIT_SHARE, GAP_FIT_SHARE = 0.2, 0.02
# and at most this: after many turns a share of them means nothing
FIT_RAD, GAP_FIT_RAD = 0.5, np.radians(1.0)
ALIKE_RAD = np.radians(1 / 3600)  # this close, all ways of joining agree
LOOKED_AT = 2000  # samples, for the cause of rates that do not fit
NO_GAPS: frozenset[int] = frozenset()


# The statements, and the option of a command by which each is made.
OPTIONS = {
    "mounting": "--mounting",
    "kernels": "--kernel",
    "topic": "--topic",
    "body": "--body",
    "reference": "--reference",
    "epoch_utc": "--epoch-utc",
    "place": "--place",
    "convention": "--convention",
}


class LogEntry(NamedTuple):
    """`where` is a line (":12"), an epoch or a count, as it follows the file's name in a
    message.
    """

    where: str
    event: AttitudeSample | Refusal


@dataclass(frozen=True, slots=True)
class Stated:
    """What the user states of a log, where the file itself does not say it; None where nothing is
    stated.

    `kernels` are SPICE kernels; `topic` and `body` choose one of several; `reference` names the
    frame that attitudes refer to; `epoch_utc` is the UTC of the log's time zero; `place` is
    latitude and longitude in degrees and
    height in metres (WGS84); `convention` is that of the quaternions of CSV, JSON lines and MCAP,
    `convention_by` who states it.
    """

    mounting: Mounting = field(default_factory=Mounting)
    kernels: tuple[Path, ...] = ()
    topic: str | None = None
    body: str | None = None
    reference: str | None = None
    epoch_utc: str | None = None
    place: tuple[float, float, float] | None = None
    convention: Convention | None = None
    convention_by: str = "--convention"

    def __iter__(self) -> Iterator[tuple[str, str]]:
        """The field of each statement that the user makes, and how it is written; a bench file's
        mounting is none.
        """
        for name, option in OPTIONS.items():
            if name == "mounting":
                stated = self.mounting.by_option
            elif name == "convention":
                stated = self.convention is not None
                option = self.convention_by
            else:
                stated = getattr(self, name) not in (None, ())
            if stated:
                yield name, option


@dataclass(frozen=True, slots=True)
class LogReading:
    """What a reader gives: the entries in the file's order, attitudes of the body where the
    conventions say so.

    `advice` is what to do when times do not increase; `told` are notices for the user, kinds and
    lines.
    """

    entries: Iterable[LogEntry]
    conventions: Conventions
    advice: str = SORT_ADVICE
    told: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class AttitudeLog:
    """A log as read: samples of the camera's attitude in order of time, what the file means by its
    numbers, and notices.

    `read_as` is how its quaternions have become the camera's.
    """

    samples: list[AttitudeSample]
    conventions: Conventions
    told: list[tuple[str, str]]
    read_as: ReadAs = AS_PACKETS

    def joins(self) -> "LogJoins":
        """How its samples join (see `log_joins`)."""
        return log_joins(self.samples, self.told, self.read_as)


def in_order(entries: Iterable[LogEntry], told: list[tuple[str, str]]) -> Iterator[LogEntry]:
    """The entries by time, without exact repeats; at their end `told` gets a notice of each kind
    of change.
    """
    waiting: list[tuple[int, int, LogEntry]] = []
    newest_ns = None
    late = 0
    latest_ns = 0
    repeats = 0
    last: AttitudeSample | None = None
    ended: Iterator[LogEntry | None] = itertools.chain(entries, (None,))
    for number, entry in enumerate(ended):
        if entry is not None:
            if not isinstance(entry.event, AttitudeSample):
                # What waits is before it; a refusal ends the reading, or is of before the first
                # attitude.
                yield from (heapq.heappop(waiting)[2] for _ in range(len(waiting)))
                yield entry
                continue
            t_ns = entry.event.t_ns
            if newest_ns is not None and t_ns < newest_ns:
                late = late + 1
                latest_ns = max(latest_ns, newest_ns - t_ns)
            if newest_ns is None:
                newest_ns = t_ns
            else:
                newest_ns = max(newest_ns, t_ns)
            heapq.heappush(waiting, (t_ns, number, entry))
        while (
            waiting
            and newest_ns is not None
            and (entry is None or waiting[0][0] <= newest_ns - REORDER_NS)
        ):
            first = heapq.heappop(waiting)[2]
            sample = first.event
            assert isinstance(sample, AttitudeSample)
            if last is not None and _repeats(last, sample):
                repeats += 1
                continue
            last = sample
            yield first
    if late:
        told.append(
            (
                "log-order",
                (
                    f"{late} attitudes came out of order, by up to {latest_ns / NS_PER_S:.3g} s,"
                    " and are sorted"
                ),
            )
        )
    if repeats:
        told.append(
            (
                "log-repeats",
                f"{repeats} attitudes are exact repeats of the one before, and are dropped",
            )
        )


def _repeats(last: AttitudeSample, sample: AttitudeSample) -> bool:
    if (
        last.t_ns != sample.t_ns
        or sample.discontinuity
        or not np.array_equal(last.q_icrs_to_cam, sample.q_icrs_to_cam)
    ):
        return False
    last_rate = last.rate_cam_rad_s
    other = sample.rate_cam_rad_s
    if last_rate is None or other is None:
        return last_rate is other
    return np.array_equal(last_rate, other)


@dataclass(frozen=True, slots=True)
class LogJoins:
    """How each sample of a log joins the next, and what the user must know of it; the sets hold
    the earlier sample's t_ns.
    """

    blended_ns: frozenset[int] = NO_GAPS
    held_ns: frozenset[int] = NO_GAPS
    usual_s: float = 0.0
    longest_s: float = 0.0
    misfits: int = 0
    cause: Cause | None = None

    def __call__(self, before: AttitudeSample, after: AttitudeSample) -> Join:
        """How a timeline joins two successive samples."""
        if after.discontinuity or before.t_ns in self.held_ns:
            return "hold"
        if before.t_ns in self.blended_ns:
            return "blend"
        return "slerp"

    @property
    def told(self) -> list[tuple[str, str]]:
        """The kind and the text of each notice for the user."""
        lines = []
        if self.held_ns:
            if len(self.held_ns) == 1:
                gaps = "1 gap"
            else:
                gaps = f"{len(self.held_ns)} gaps"
            sizes = (
                f"the longest {self.longest_s:.6g} s (over {GAP_INTERVALS} times its usual"
                f" {self.usual_s:.6g} s)"
            )
            lines.append(("log-gap", f"the log has {gaps}, {sizes}; the attitude is held there"))
        if self.misfits:
            if self.cause is not None and self.cause.reading is not None:
                advice = self.cause.reading.advice
                elsewhere = (
                    f"{self._misfits}{self._why}: the sky is drawn at another place; {advice}"
                )
                lines.append((self.cause.kind, elsewhere))
            lines.append(("log-rates", f"{self._misfits}, and are ignored there{self._why}"))
        return lines

    @property
    def doubt(self) -> str:
        """What the log's rates say against its attitudes, for whoever draws nothing; "" where
        they fit.
        """
        if not self.misfits:
            return ""
        if self.cause is None:
            reading = None
        else:
            reading = self.cause.reading
        return f"{self._misfits}{self._why}" + ("" if reading is None else f": {reading.advice}")

    @property
    def _misfits(self) -> str:
        return f"in {self.misfits} intervals the log's rates do not fit its attitudes"

    @property
    def _why(self) -> str:
        if self.cause is None:
            return ""
        return f"; probably {self.cause.text}"


def log_joins(
    samples: Sequence[AttitudeSample],
    told: Iterable[tuple[str, str]] = (),
    read_as: ReadAs = AS_PACKETS,
) -> LogJoins:
    """How the samples of a log join; their times must increase. `told` are notices that may explain
    rates that do not fit, `read_as` is how quaternions have become the camera's.
    """
    if len(samples) < 2:
        return LogJoins()
    t_ns = np.array([sample.t_ns for sample in samples], dtype=object)
    seconds = np.asarray(np.diff(t_ns) / NS_PER_S, dtype=np.float64)
    usual_s = float(np.median(seconds))
    gap = seconds > GAP_INTERVALS * usual_s
    known, fits = _fits(samples, seconds, gap)
    broken = np.array([sample.discontinuity for sample in samples[1:]])
    held = gap & ~fits & ~broken
    misfit = known & ~fits & ~broken & ~gap
    cause: Cause | None = None
    # what is probably wrong from the first rate on that does not fit
    if misfit.any() and TIMES not in dict(told):
        first = int(misfit.argmax())
        with_rates = [
            sample
            for sample in samples[first : first + LOOKED_AT]
            if sample.rate_cam_rad_s is not None
        ]
        cause = cause_in(with_rates, read_as)
    return LogJoins(
        frozenset(t_ns[:-1][fits & ~broken].tolist()),
        frozenset(t_ns[:-1][held].tolist()),
        usual_s,
        float(seconds[held].max(initial=0.0)),
        int(misfit.sum()),
        cause,
    )


def _fits(
    samples: Sequence[AttitudeSample], seconds: FloatArray, gap: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Two masks (n,) over intervals: both samples have rates; and those fit the turn between
    them.
    """
    nothing = np.full(3, np.nan)
    rate = np.array([nothing if s.rate_cam_rad_s is None else s.rate_cam_rad_s for s in samples])
    q = np.array([sample.q_icrs_to_cam for sample in samples])
    mean = (rate[1:] + rate[:-1]) / 2
    known = np.isfinite(mean).all(axis=1)
    turned_rad = (
        seconds * (np.linalg.norm(rate[1:], axis=1) + np.linalg.norm(rate[:-1], axis=1)) / 2
    )
    vector = -0.5 * seconds[:, None] * mean
    half = np.linalg.norm(vector, axis=1)
    step = np.column_stack((np.cos(half), np.sinc(half / np.pi)[:, None] * vector))
    rest = multiply(multiply(q[1:], conjugate(q[:-1])), conjugate(step))
    off_rad = 2 * np.arctan2(np.linalg.norm(rest[:, 1:], axis=1), np.abs(rest[:, 0]))
    share = np.where(gap, GAP_FIT_SHARE, FIT_SHARE)
    most_rad = np.where(gap, GAP_FIT_RAD, FIT_RAD)
    return known, known & (off_rad <= np.minimum(share * turned_rad, most_rad) + ALIKE_RAD)
