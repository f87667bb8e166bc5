"""What the readers of all formats give: each attitude, or why there is none, with where it stands in the file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.attitude.wire.source import Conventions, Mounting

MAX_QUOTED_CHARACTERS = 80
MAX_SAMPLES = 6_000_000  # 16 hours at 100 Hz; all are held, at 350 bytes each, so in 2 GB


class Entry(NamedTuple):
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

    entries: Iterable[Entry]
    conventions: Conventions
    advice: str = "sort the log by time"
    told: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Log:
    """A log as read: samples of the camera's attitude in order of time, what the file means by its numbers, and notices."""

    samples: list[AttitudeSample]
    conventions: Conventions
    told: list[tuple[str, str]]
