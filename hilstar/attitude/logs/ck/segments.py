"""What the segments of a CK cover and at which times they hold attitudes (CK Required Reading, types 1 to 6); ticks throughout.

Times, counts and quaternions are checked here, since SPICE believes them; it alone evaluates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.ck.daf import Daf, Summary, read_daf
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.errors import InputError

CK_DOUBLES, CK_INTEGERS = 2, 6
DIRECTORY = 100  # every hundredth time stands in a directory too
QUATERNION_WORDS, RATE_WORDS = 4, 3
TYPE_5_WORDS = {0: 8, 1: 4, 2: 14, 3: 7}  # of a packet, by subtype
TYPES = range(1, 7)
Span = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Segment:
    """A segment's descriptor; `number` counts from 1 in the file, and a higher one has priority. Ticks."""

    number: int
    start: float
    stop: float
    body: int
    reference: int
    kind: int
    has_rate: bool
    summary: Summary


@dataclass(frozen=True, slots=True)
class Coverage:
    """The intervals (n, 2) that a segment covers, and the times (n,) of its attitudes where it has some, both increasing."""

    intervals: FloatArray
    epochs: FloatArray


def read_segments(path: Path, limit_bytes: int) -> tuple[Daf, list[Segment]]:
    """The segments of a CK in the file's order. Raises InputError for a file that is damaged or another type of segment."""
    daf = read_daf(path, limit_bytes)
    segments = []
    for number, summary in enumerate(daf.summaries, start=1):
        if (len(summary.doubles), len(summary.integers)) != (CK_DOUBLES, CK_INTEGERS):
            raise InputError(f"{path}: is another kind of DAF than a CK")
        body, reference, kind, has_rate = summary.integers[:4]
        start, stop = summary.doubles
        if not (math.isfinite(start) and math.isfinite(stop) and 0 <= start <= stop):
            raise InputError(f"{path}: segment {number} spans the ticks {start:g} to {stop:g}; is the file damaged?")
        if kind not in TYPES:
            raise InputError(f"{path}: segment {number} is of type {kind}; types 1 to 6 are read")
        segments.append(Segment(number, start, stop, body, reference, kind, has_rate != 0, summary))
    if not segments:
        raise InputError(f"{path}: contains no segment; is the file cut off?")
    return daf, segments


def coverage(daf: Daf, segment: Segment) -> Coverage | None:
    """What a segment covers; None for types 4 and 6, whose intervals SPICE tells (`ckcov`). Raises InputError.

    A quaternion that is not unit is refused here: of one that is all zeros SPICE would make an attitude.
    """
    if segment.kind in {4, 6}:
        return None
    words = daf.words(segment.summary)
    read = _type_2(words) if segment.kind == 2 else _epochs(words, segment)
    where = f"{daf.path}: segment {segment.number}"
    if read is None:
        raise InputError(f"{where}: its counts or directory do not fit its {len(words)} words; is the file damaged?")
    intervals, epochs, q = read
    times = (intervals.ravel(), epochs)
    if not all(np.isfinite(each).all() for each in times) or (np.diff(epochs) <= 0).any() or (np.diff(times[0]) < 0).any():
        raise InputError(f"{where}: its times do not increase; is the file damaged?")
    norm = np.sqrt((q * q).sum(axis=1))
    bad = np.flatnonzero(~(np.abs(norm - 1.0) <= NORM_TOLERANCE))
    if len(bad):
        raise InputError(f"{where}: the norm of its quaternion {bad[0] + 1} is {norm[bad[0]]:.6g}; it must be 1")
    within = np.clip(intervals, segment.start, segment.stop)
    return Coverage(within[(within[:, 1] > within[:, 0]) | (intervals[:, 1] == intervals[:, 0])], epochs)


Read = tuple[FloatArray, FloatArray, FloatArray]  # intervals (n, 2), times (n,) and quaternions (n, 4)


def _type_2(words: FloatArray) -> Read | None:
    """N packets of 8 words, N starts, N stops, a directory of (N - 1) // 100."""
    count = -(-(DIRECTORY * len(words) + 1) // (10 * DIRECTORY + 1))
    if count < 1 or 10 * count + (count - 1) // DIRECTORY != len(words):
        return None
    starts, stops = words[8 * count : 10 * count].reshape(2, count)
    if not _is_directory(words[10 * count :], starts):
        return None
    return np.column_stack((starts, stops)), np.empty(0), words[: 8 * count].reshape(count, 8)[:, :QUATERNION_WORDS]


def _epochs(words: FloatArray, segment: Segment) -> Read | None:
    """Types 1, 3 and 5: packets, their times, a directory; 3 and 5 also the starts of intervals, a directory and counts."""
    counts = _counts(words, segment)
    if counts is None:
        return None
    packet, count, starts_count = counts
    q = words[: packet * count].reshape(count, packet)[:, :QUATERNION_WORDS]
    epochs, rest = words[packet * count : packet * count + count], words[packet * count + count :]
    directory, rest = np.split(rest, [(count - 1) // DIRECTORY])
    starts, starts_directory = rest[:starts_count], rest[starts_count : starts_count + max(starts_count - 1, 0) // DIRECTORY]
    if not (_is_directory(directory, epochs) and _is_directory(starts_directory, starts)):
        return None
    if segment.kind == 1:
        return epochs[[0, -1]].reshape(1, 2), epochs, q
    first = np.searchsorted(epochs, starts)
    if first[0] != 0 or (np.diff(first) < 1).any() or first[-1] >= count:
        return None
    return np.column_stack((starts, epochs[np.append(first[1:], count) - 1])), epochs, q


def _counts(words: FloatArray, segment: Segment) -> tuple[int, int, int] | None:
    """Words of a packet, packets and intervals, from the end of the segment; None where they do not fit its size."""
    trailer = {1: 1, 3: 2, 5: 5}[segment.kind]
    if len(words) < trailer or not np.isfinite(words[-trailer:]).all():
        return None
    count, starts_count = int(words[-1]), 0 if segment.kind == 1 else int(words[-2])
    packet = TYPE_5_WORDS.get(int(words[-4]), 0) if segment.kind == 5 else QUATERNION_WORDS + RATE_WORDS * segment.has_rate
    if count < 1 or packet == 0 or (segment.kind != 1 and not 1 <= starts_count <= count):
        return None
    directories = (count - 1) // DIRECTORY + max(starts_count - 1, 0) // DIRECTORY
    whole = packet * count + count + starts_count + directories + trailer == len(words)
    return (packet, count, starts_count) if whole else None


def _is_directory(directory: FloatArray, times: FloatArray) -> bool:
    """Whether a directory has every hundredth time: SPICE would search past the packets by another."""
    return bool((directory == times[DIRECTORY - 1 :: DIRECTORY][: len(directory)]).all())
