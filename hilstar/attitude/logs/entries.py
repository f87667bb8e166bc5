"""The entries that a log's reader returns: each attitude, or why it was refused, and its place in the file; and their order.

Recorders write messages as they arrive, which is not always the order of their stamps (`in_order`):
1. Attitudes out of order by at most REORDER_NS are sorted, and counted.
2. Exact repeats (same time, attitude and rate) are dropped, and counted.
3. Any other time that does not increase is passed on, and the log is refused there.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.attitude.wire.source import Conventions, Mounting
from hilstar.units import NS_PER_S

MAX_QUOTED_CHARACTERS = 80
MAX_SAMPLES = 6_000_000  # 16 hours at 100 Hz; all are held, at 350 bytes each, so in 2 GB
REORDER_NS = NS_PER_S  # queues between a driver and a recorder hold less; a clock that was set back jumps by more


class LogEntry(NamedTuple):
    """`where` is a line (":12"), an epoch or a count, as it follows the file's name in a message."""

    where: str
    event: AttitudeSample | Refusal


@dataclass(frozen=True, slots=True)
class Stated:
    """What the user states of a log, where the file itself does not say it; None where nothing is stated.

    `kernels` are SPICE kernels; `topic` and `body` choose one of several; `reference` names the frame that attitudes refer to;
    `epoch_utc` is the UTC of the log's time zero; `place` is latitude and longitude in degrees and height in metres (WGS84).
    """

    mounting: Mounting = field(default_factory=Mounting)
    kernels: tuple[Path, ...] = ()
    topic: str | None = None
    body: str | None = None
    reference: str | None = None
    epoch_utc: str | None = None
    place: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class LogReading:
    """What a reader gives: the entries in the file's order, attitudes of the body where the conventions say so.

    `advice` is what to do when times do not increase; `told` are notices for the user, kinds and lines.
    """

    entries: Iterable[LogEntry]
    conventions: Conventions
    advice: str = "sort the log by time"
    told: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class AttitudeLog:
    """A log as read: samples of the camera's attitude in order of time, what the file means by its numbers, and notices."""

    samples: list[AttitudeSample]
    conventions: Conventions
    told: list[tuple[str, str]]


def in_order(entries: Iterable[LogEntry], told: list[tuple[str, str]]) -> Iterator[LogEntry]:
    """The entries by time, without exact repeats; at their end `told` gets a notice of each kind of change."""
    waiting: list[tuple[int, int, LogEntry]] = []
    newest_ns, late, latest_ns, repeats = None, 0, 0, 0
    last: AttitudeSample | None = None
    ended: Iterator[LogEntry | None] = itertools.chain(entries, (None,))
    for number, entry in enumerate(ended):
        if entry is not None:
            if not isinstance(entry.event, AttitudeSample):
                yield entry
                continue
            t_ns = entry.event.t_ns
            if newest_ns is not None and t_ns < newest_ns:
                late, latest_ns = late + 1, max(latest_ns, newest_ns - t_ns)
            newest_ns = t_ns if newest_ns is None else max(newest_ns, t_ns)
            heapq.heappush(waiting, (t_ns, number, entry))
        while waiting and newest_ns is not None and (entry is None or waiting[0][0] <= newest_ns - REORDER_NS):
            first = heapq.heappop(waiting)[2]
            sample = first.event
            assert isinstance(sample, AttitudeSample)
            if last is not None and _repeats(last, sample):
                repeats += 1
                continue
            last = sample
            yield first
    if late:
        told.append(("log-order", f"{late} attitudes came out of order, by up to {latest_ns / NS_PER_S:.3g} s, and are sorted"))
    if repeats:
        told.append(("log-repeats", f"{repeats} attitudes are exact repeats of the one before, and are dropped"))


def _repeats(last: AttitudeSample, sample: AttitudeSample) -> bool:
    if last.t_ns != sample.t_ns or sample.discontinuity or not np.array_equal(last.q_icrs_to_cam, sample.q_icrs_to_cam):
        return False
    one, other = last.rate_cam_rad_s, sample.rate_cam_rad_s
    return one is other if one is None or other is None else np.array_equal(one, other)
