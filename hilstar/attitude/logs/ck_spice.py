"""The process that evaluates a CK with SPICE: a damaged kernel may abort it, and SPICE's kernel pool is global to a process.

A request is one JSON object on stdin: `path`, `kernels` and `body`. The answer is an NPZ file on stdout: the arrays of
`_Sampled`, and `said`, JSON text with the rest, or with `error` alone. Times are spacecraft clock ticks throughout.

1. Summaries, times, counts and quaternions are checked here before SPICE evaluates a segment. SPICE trusts them, and would
   follow a damaged list of records forever.
2. Of two segments at one time, SPICE takes the later one.
3. Segments with attitudes at given times (types 1 and 3) are read at those times.
4. Types 2, 4, 5 and 6 are functions of time. They are read at even steps, halved until the interpolation between them is
   within TARGET_RAD (and the clock's resolution), or until MAX_STEPS.
5. There is a break between two pieces of coverage, unless they touch and their attitudes agree.
"""

import io
import json
import math
import os
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs.entries import GAP_INTERVALS, MAX_SAMPLES, log_joins
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.errors import InputError, shortened
from hilstar.reading import HEAD_BYTES, open_regular
from hilstar.rotation import angle_between_rad, from_matrix, rate_between_rad_s
from hilstar.units import NS_PER_S

RECORD_BYTES, WORD_BYTES = 1024, 8
ORDERS = {b"LTL-IEEE": "<", b"BIG-IEEE": ">"}
MAX_SUMMARIES = 100_000
MAX_TEXT_BYTES, MAX_BINARY_BYTES = 50_000_000, 4_000_000_000
MAX_NAMED = 1000  # kernels of one meta-kernel
ADVICE = "give a SPICE kernel (.tls, .tsc, .tf, .tm, ...)"
CK_DOUBLES, CK_INTEGERS = 2, 6
DIRECTORY = 100  # every hundredth time stands in a directory too
QUATERNION_WORDS, RATE_WORDS = 4, 3
TYPE_5_WORDS = {0: 8, 1: 4, 2: 14, 3: 7}  # words in a packet, by subtype
TYPES = range(1, 7)
Span = tuple[float, float]
# J2000 is 2000-01-01T12:00:00 TDB; days of 86400 s since 1970-01-01T00:00:00 TDB.
J2000_S = 946_728_000
SAME_MATRIX = 1e-12  # ckgp and ckgpav turn a frame by two routes, a few roundings apart
FRAME = "J2000"  # SPICE's name of the axes of the ICRF
SMOOTH = frozenset({2, 4, 5, 6})
TARGET_RAD = math.radians(1e-3 / 3600)  # 1 mas, a hundredth of the best tracker's error
FIRST_STEPS, MAX_STEPS = 128, 100_000  # for all smooth pieces together: 10 s at 0.1 ms each
PROBES = 200  # places between samples at which the error is looked at
PROBED = (math.sqrt(5) - 1) / 2  # share of a step: no symmetry of an interpolation hides its error there
DIFFERENCE_STEPS = 1 / 16  # a rate by difference, whose error h^2 w''/6 is then 1/256 of that over the step
BESIDE_S = 2e-6  # beside a boundary: twenty times what ephemeris time resolves
JUMP_RAD = math.radians(1e-2 / 3600)  # a boundary's attitudes agree within this, and three times the turn in BESIDE_S
ALL = Policy(max_extrapolation_ns=0, stale_after_ns=0)
MAX_CK_BYTES = 500_000_000
MAX_NAMED_BODIES = 12
CK_CLASS = 3  # SPICE's class of frames whose attitude is in CKs


class _Summary(NamedTuple):
    """One array of a DAF: the summary's doubles and integers, of which the last two are the first and last word (from 1)."""

    doubles: tuple[float, ...]
    integers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Daf:
    """A DAF whose list of summaries is whole, and whose arrays lie within the file."""

    path: Path
    order: str
    summaries: list[_Summary]

    def words(self, summary: _Summary) -> FloatArray:
        first, last = summary.integers[-2:]
        with open_regular(self.path, "give a SPICE kernel") as file:
            file.seek((first - 1) * WORD_BYTES)
            raw = file.read((last - first + 1) * WORD_BYTES)
        if len(raw) != (last - first + 1) * WORD_BYTES:
            raise InputError(f"{self.path}: was cut while it was read; copy it whole")
        return np.frombuffer(raw, self.order + "f8").astype(np.float64)


def _read_daf(path: Path, limit_bytes: int) -> _Daf:
    """The summaries of a DAF, in the file's order. Raises InputError for a file that is not one, or is damaged."""
    with open_regular(path, "give a SPICE kernel", limit_bytes) as file:
        size_words = os.fstat(file.fileno()).st_size // WORD_BYTES
        head = file.read(RECORD_BYTES)
        order = ORDERS.get(head[88:96])
        if len(head) < RECORD_BYTES:
            raise InputError(f"{path}: has {len(head)} bytes, less than a DAF's first record; is it cut off?")
        if not head.startswith(b"DAF/") or order is None:
            format_text = head[88:96].decode("ascii", "replace").strip() or "missing"
            raise InputError(f"{path}: is no DAF in IEEE form (its form is {shortened(format_text)}); convert it by tobin")
        doubles, integers = struct.unpack(order + "2i", head[8:16])
        if not (0 <= doubles <= 124 and 2 <= integers <= 250 and doubles + (integers + 1) // 2 <= 125):
            raise InputError(f"{path}: is a damaged DAF: its summaries have {doubles} doubles and {integers} integers")
        layout = struct.Struct(f"{order}{doubles}d{integers}i")
        summaries: list[_Summary] = []
        for raw in _raw_summaries(path, file, struct.unpack(order + "2i", head[76:84]), order, layout.size):
            numbers = layout.unpack_from(raw)
            begin, end = numbers[-2:]
            if not RECORD_BYTES // WORD_BYTES < begin <= end <= size_words:
                raise _damaged(path, f"an array has the words {begin} to {end} of {size_words}")
            summaries.append(_Summary(numbers[:doubles], numbers[doubles:]))
            if len(summaries) > MAX_SUMMARIES:
                raise InputError(f"{path}: has more than {MAX_SUMMARIES} segments; split it into several")
    return _Daf(path, order, summaries)


def _raw_summaries(path: Path, file: IO[bytes], ends: tuple[int, int], order: str, size: int) -> Iterator[bytes]:
    """The bytes of each summary, from a list of records that each name the next and the previous one."""
    (record, last), previous, words = ends, 0, -(-size // WORD_BYTES)
    records = os.fstat(file.fileno()).st_size // RECORD_BYTES
    seen: set[int] = set()
    while record:
        if record in seen or not 1 < record <= records:
            raise _damaged(path, f"its list of summaries leads to record {record}")
        seen.add(record)
        file.seek((record - 1) * RECORD_BYTES)
        raw = file.read(RECORD_BYTES)
        following, before, count = struct.unpack(order + "3d", raw[:24])
        if before != previous or not 0 <= count <= 125 // words or not (0 <= following < 2**31 and following.is_integer()):
            raise _damaged(path, f"summary record {record} is not one of its list")
        yield from (raw[(3 + k * words) * WORD_BYTES :] for k in range(int(count)))
        record, previous = int(following), record
    if previous != last:
        raise _damaged(path, f"its list of summaries ends at record {previous}, not {last}")


def _damaged(path: Path, what: str) -> InputError:
    return InputError(f"{path}: is a damaged DAF: {what}; is it cut off?")


@dataclass(frozen=True, slots=True)
class _CkSegment:
    """A segment's descriptor; `number` counts from 1 in the file, and a higher one has priority. Ticks."""

    number: int
    start: float
    stop: float
    body: int
    reference: int
    kind: int
    has_rate: bool
    summary: _Summary


@dataclass(frozen=True, slots=True)
class Coverage:
    """The intervals (n, 2) that a segment covers, and the times (n,) of its attitudes where it has some, both increasing."""

    intervals: FloatArray
    epochs: FloatArray


def _read_segments(path: Path, limit_bytes: int) -> tuple[_Daf, list[_CkSegment]]:
    """The segments of a CK in the file's order. Raises InputError for a file that is damaged or another type of segment."""
    daf = _read_daf(path, limit_bytes)
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
        segments.append(_CkSegment(number, start, stop, body, reference, kind, has_rate != 0, summary))
    if not segments:
        raise InputError(f"{path}: contains no segment; is the file cut off?")
    return daf, segments


def _coverage(daf: _Daf, segment: _CkSegment) -> Coverage | None:
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


def _epochs(words: FloatArray, segment: _CkSegment) -> Read | None:
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


def _counts(words: FloatArray, segment: _CkSegment) -> tuple[int, int, int] | None:
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


@dataclass(frozen=True, slots=True)
class _Piece:
    """Ticks from `start` to `stop` of a segment; `epochs` (n,) are the times strictly within at which it holds attitudes."""

    segment: _CkSegment
    start: float
    stop: float
    epochs: FloatArray

    def ticks(self, step: float) -> FloatArray:
        """The ticks at which it is read, both ends among them; a long pause between them is filled, as the file covers it."""
        if self.stop <= self.start:
            return np.array([self.start])
        if self.segment.kind in SMOOTH:
            return np.linspace(self.start, self.stop, max(math.ceil((self.stop - self.start) / step), 2) + 1)
        ticks = np.concatenate(([self.start], self.epochs, [self.stop]))
        spacing = np.diff(ticks)
        longest = (GAP_INTERVALS - 1) * float(np.median(spacing))
        if self.segment.kind != 3 or not (spacing > longest).any() or (self.stop - self.start) / longest > MAX_STEPS:
            return ticks
        parts = np.ceil(spacing / longest).astype(int).tolist()
        inner = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(ticks[:-1], ticks[1:], parts, strict=True)]
        return np.concatenate([*inner, ticks[-1:]])


def _pieces_of(covered: list[tuple[_CkSegment, Coverage]]) -> list[_Piece]:
    """The pieces of the segments of one structure, in order of time; segments come in the file's order."""
    owners = [(segment, cover.epochs, *span) for segment, cover in covered for span in cover.intervals.tolist()]
    if not owners:
        return []
    bounds = np.unique(np.array([owner[2:] for owner in owners]))
    owner_of_cell = np.full(len(bounds), -1)  # the cell k is from bound k to bound k + 1; the last one stays empty
    owner_of_point = np.full(len(bounds), -1)
    for index, (_, _, start, stop) in enumerate(owners):
        cells = slice(*np.searchsorted(bounds, [start, stop]))
        owner_of_cell[cells] = index
        if start == stop:
            owner_of_point[cells.start] = index
    begins = np.flatnonzero(np.diff(owner_of_cell, prepend=-1))
    ends = np.append(begins[1:], len(bounds) - 1)
    spans = [(owner_of_cell[k], k, end) for k, end in zip(begins.tolist(), ends.tolist(), strict=True) if owner_of_cell[k] >= 0]
    for k in np.flatnonzero(owner_of_point >= 0).tolist():
        if owner_of_cell[k] < 0 and (k == 0 or owner_of_cell[k - 1] < 0):
            spans.append((owner_of_point[k], k, k))
    found = []
    for owner, first, last in spans:
        (segment, epochs, *_), start, stop = owners[owner], float(bounds[first]), float(bounds[last])
        within = slice(int(np.searchsorted(epochs, start, "right")), int(np.searchsorted(epochs, stop, "left")))
        found.append(_Piece(segment, start, stop, epochs[within]))
    return sorted(found, key=lambda piece: piece.start)


@dataclass(frozen=True)
class _Structure:
    """A structure whose CK is loaded: `body` its id, `clock` that of its clock; `turning` where all its segments have rates."""

    path: Path
    spice: Any
    body: int
    turning: bool

    @cached_property
    def clock(self) -> int:
        return int(self.spice.ckmeta(self.body, "SCLK"))

    def t_s(self, tick: float) -> float:
        return float(self.spice.sct2e(self.clock, tick))

    def t_ns(self, tick: float) -> int:
        """TDB nanoseconds since 1970-01-01T00:00:00 TDB; a double of ephemeris time resolves 0.1 us."""
        seconds = self.t_s(tick)
        whole = int(seconds // 1)
        return (whole + J2000_S) * NS_PER_S + round((seconds - whole) * NS_PER_S)

    def matrix(self, tick: float) -> FloatArray:
        """The C-matrix (3, 3), which turns ICRS components into the structure's. Raises InputError where there is none."""
        matrix, _, found = self.spice.ckgp(self.body, tick, 0, FRAME)
        if not found:
            raise InputError(f"{self.path}: SPICE has no attitude of {self.body} at tick {tick:.17g}, which its segments cover")
        return np.asarray(matrix, dtype=np.float64)

    def q_icrs_to_body(self, tick: float) -> FloatArray:
        return from_matrix(self.matrix(tick))

    def attitude(self, tick: float, with_rate: bool) -> tuple[FloatArray, FloatArray | None]:
        """The attitude (4,), and the angular velocity (3,), rad/s, in the structure's components, where its segment has one.

        SPICE gives the angular velocity in components of the reference frame, and passes over segments without one.
        """
        if not with_rate:
            return self.q_icrs_to_body(tick), None
        matrix, rate, _, found = self.spice.ckgpav(self.body, tick, 0, FRAME)
        if not (found and (self.turning or np.abs(matrix - self.matrix(tick)).max() < SAME_MATRIX)):
            return self.q_icrs_to_body(tick), None
        return from_matrix(matrix), matrix @ np.asarray(rate, dtype=np.float64)

    def rate_by_difference(self, tick: float, step: float, span: tuple[float, float]) -> FloatArray:
        """The rate (3,) at a tick of a smooth segment, from attitudes `step` ticks away on both sides within `span`.

        At an end of the span, from two on one side (second order: 2 r(h) - r(2 h)).
        """
        start, stop = span
        s_per_tick = (self.t_s(stop) - self.t_s(start)) / (stop - start)

        def mean_rate(one: float, other: float) -> FloatArray:
            before, after = sorted((one, other))
            return rate_between_rad_s(self.q_icrs_to_body(before), self.q_icrs_to_body(after), (after - before) * s_per_tick)

        if start + step <= tick <= stop - step:
            return mean_rate(tick - step, tick + step)
        away = step if tick < start + step else -step
        return 2.0 * mean_rate(tick, tick + away) - mean_rate(tick, tick + 2 * away)


@dataclass(frozen=True, slots=True)
class _Sampled:
    """n attitudes of a structure, and how good they are.

    `t_ns` (n,); `q` (n, 4) is q_icrs_to_body; `rate` (n, 3), rad/s, in the structure's components, NaN where there is none;
    `breaks` (n,) where nothing leads from the one before; `tick` (n,). For segments that are functions of time, the step
    between them, s, and the largest error found between them, rad; the lengths of the gaps of coverage, s.
    """

    t_ns: npt.NDArray[np.int64]
    q: FloatArray
    rate: FloatArray
    breaks: npt.NDArray[np.bool_]
    tick: FloatArray
    step_s: float | None
    error_rad: float
    gaps_s: list[float]


def sample(structure: _Structure, pieces: Sequence[_Piece]) -> _Sampled:
    """The attitudes of pieces in order of time. Raises InputError for more than MAX_SAMPLES of them."""
    smooth = [piece for piece in pieces if piece.segment.kind in SMOOTH and piece.stop > piece.start]
    step = error_rad = 0.0
    if smooth:
        step, error_rad = _step_of(structure, smooth)
    ticks = [piece.ticks(step) for piece in pieces]
    if sum(map(len, ticks)) > MAX_SAMPLES:
        raise InputError(f"{structure.path}: contains more than {MAX_SAMPLES} attitudes; cut it into several (ckslicer)")
    broken, gaps_s = _parted(structure, pieces, ticks)
    step_s = structure.t_s(smooth[0].start + step) - structure.t_s(smooth[0].start) if smooth else None
    parts = [_attitudes(structure, *pair) for pair in zip(pieces, ticks, strict=True)]
    t_ns, q, rate = (np.concatenate(each) for each in zip(*parts, strict=True))
    breaks = np.zeros(len(t_ns), dtype=np.bool_)
    breaks[np.cumsum([0, *map(len, ticks[:-1])])] = broken
    return _Sampled(t_ns, q, rate, breaks, np.concatenate(ticks), step_s, error_rad, gaps_s)


def _step_of(structure: _Structure, smooth: Sequence[_Piece]) -> tuple[float, float]:
    """The step of the smooth pieces, ticks, and the largest error between samples that far apart, rad."""
    total = sum(piece.stop - piece.start for piece in smooth)
    steps = FIRST_STEPS
    while True:
        step = total / steps
        ticks = [piece.ticks(step) for piece in smooth]
        counts = np.cumsum([len(each) - 1 for each in ticks])
        error_rad = excess_rad = 0.0
        for place in np.unique(np.linspace(0, counts[-1] - 1, PROBES).astype(int)).tolist():
            k = int(np.searchsorted(counts, place, "right"))
            within = place - (int(counts[k - 1]) if k else 0)
            found_rad, clock_rad = _error_rad(structure, smooth[k], ticks[k], within)
            error_rad, excess_rad = max(error_rad, found_rad), max(excess_rad, found_rad - clock_rad)
        if excess_rad <= TARGET_RAD or 2 * steps > MAX_STEPS:
            return step, error_rad
        steps *= 2


def _error_rad(structure: _Structure, piece: _Piece, ticks: FloatArray, k: int) -> tuple[float, float]:
    """How far the log's interpolation is off at one place between the ticks k and k + 1 of a piece, rad.

    And the share of it that no step mends: the turn in the time that a double of ephemeris time does not resolve.
    """
    near = [
        AttitudeSample(t_ns, q, rate)
        for t_ns, q, rate in zip(*_attitudes(structure, piece, ticks[max(k - 1, 0) : k + 3]), strict=True)
    ]
    timeline = Timeline(ALL, len(near), log_joins(near))
    for event in near:
        timeline.add(event)
    tick = float(ticks[k] + PROBED * (ticks[k + 1] - ticks[k]))
    shown = timeline.at(structure.t_ns(tick))
    if shown is None or shown.rate_cam_rad_s is None:
        raise AssertionError("a tick between two samples of a piece has an attitude")
    clock_rad = 2.0 * float(np.spacing(abs(structure.t_s(tick))) * np.linalg.norm(shown.rate_cam_rad_s))
    return angle_between_rad(shown.q_icrs_to_cam, structure.q_icrs_to_body(tick)), clock_rad


def _attitudes(structure: _Structure, piece: _Piece, ticks: FloatArray) -> tuple[npt.NDArray[np.int64], FloatArray, FloatArray]:
    """Times (n,), attitudes (n, 4) and rates (n, 3) of a piece; a smooth segment without rates has them by difference."""
    by_difference = piece.segment.kind in SMOOTH and not piece.segment.has_rate and len(ticks) > 1
    step = float(ticks[1] - ticks[0]) * DIFFERENCE_STEPS if by_difference else 0.0
    t_ns, q = np.empty(len(ticks), dtype=np.int64), np.empty((len(ticks), 4))
    rates = np.full((len(ticks), 3), np.nan)
    for k, tick in enumerate(ticks.tolist()):
        t_ns[k] = structure.t_ns(tick)
        q[k], rate = structure.attitude(tick, piece.segment.has_rate)
        if by_difference:
            rate = structure.rate_by_difference(tick, step, (piece.start, piece.stop))
        if rate is not None:
            rates[k] = rate
    return t_ns, q, rates


def _parted(structure: _Structure, pieces: Sequence[_Piece], ticks: list[FloatArray]) -> tuple[list[bool], list[float]]:
    """Whether each piece begins with a break, after a gap or a jump, and the lengths of the gaps, s.

    Where two pieces touch, both ends lie on one tick: `ticks` is changed to have one of them, or both beside it. The attitude
    jumps there where it turns by more than it does in the same time before.
    """
    broken, gaps_s = [False], []
    for k, (before, after) in enumerate(pairwise(pieces), start=1):
        if before.stop < after.start:
            gaps_s.append(structure.t_s(after.start) - structure.t_s(before.stop))
            broken.append(True)
            continue
        s_per_tick = (structure.t_s(after.stop) - structure.t_s(before.start)) / (after.stop - before.start)
        shortest = min(before.stop - before.start, after.stop - after.start)
        beside = max(min(BESIDE_S / s_per_tick, shortest / 8), 2 * float(np.spacing(before.stop)))
        q = [structure.q_icrs_to_body(before.stop + n * beside) for n in (-3, -1, 1)]
        broken.append(angle_between_rad(q[1], q[2]) > JUMP_RAD + 3 * angle_between_rad(q[0], q[1]))
        if broken[-1]:
            ticks[k - 1][-1] -= beside
            ticks[k][0] += beside
        else:
            ticks[k - 1] = ticks[k - 1][:-1]
    return broken, gaps_s


def load(spice: Any, path: Path, kernels: Sequence[Path]) -> None:
    """Load the kernels and then the CK, which so comes before any other; files are checked first (InputError)."""
    for kernel in kernels:
        for file in _checked(spice, kernel):
            spice.furnsh(str(file))
    spice.furnsh(str(path))


def _checked(spice: Any, kernel: Path, meta: Path | None = None) -> list[Path]:
    """The files of a kernel, checked before SPICE opens them: itself, or those that a meta-kernel names."""
    with open_regular(kernel, ADVICE if meta is None else f"{meta} names it") as file:
        head = file.read(HEAD_BYTES)
    if meta is not None and head.startswith(b"KPL/MK"):
        raise InputError(f"{meta}: names another meta-kernel, {kernel}; name its kernels instead")
    if head.startswith(b"DAF/"):
        _read_daf(kernel, MAX_BINARY_BYTES)
        return [kernel]
    if head.startswith((b"DAFETF", b"DASETF")):
        raise InputError(f"{kernel}: is a transfer file; convert it by tobin")
    open_regular(kernel, ADVICE, MAX_TEXT_BYTES).close()
    if not head.startswith(b"KPL/MK") and kernel.suffix.lower() != ".tm":
        return [kernel]
    return [file for named in _named(spice, kernel) for file in _checked(spice, named, kernel)]


def _named(spice: Any, meta: Path) -> list[Path]:
    """The kernels that a meta-kernel names, its path symbols replaced; from the working directory, as SPICE has it."""
    names = ("KERNELS_TO_LOAD", "PATH_SYMBOLS", "PATH_VALUES")
    spice.ldpool(str(meta))
    files, symbols, values = (_strings(spice, name) for name in names)
    for name in names:
        spice.dvpool(name)
    if not files or len(symbols) != len(values):
        raise InputError(f"{meta}: names no kernels; write KERNELS_TO_LOAD, and as many PATH_VALUES as PATH_SYMBOLS")
    for symbol, value in sorted(zip(symbols, values, strict=True), key=lambda pair: -len(pair[0])):
        files = [file.replace(f"${symbol}", value) for file in files]
    return [Path(file) for file in files]


def _strings(spice: Any, name: str) -> list[str]:
    """The strings of a variable of the pool; one that ends in + goes on in the next."""
    found: list[str] = []
    for k in range(MAX_NAMED + 1):
        text, _, there = spice.stpool(name, k, "+")
        if not there:
            return found
        found.append(text)
    raise InputError(f"a meta-kernel has more than {MAX_NAMED} {name}; split it into several")


def _in_words(error: Any) -> str:
    """What SPICE says, and what to give where a kernel is missing."""
    said = shortened(" ".join(str(error.long or error.explain or error.short).split()), 300)
    if "SCLK" in said and ("not found" in said or "kernel" in said.lower()):
        return f"its clock is unknown; give its SCLK kernel, and leap seconds: --kernel FILE.tsc ({said})"
    if "frame" in said.lower():
        return f"a frame has no place among the stars; give what orients it: --kernel FILE.tf, or its own .bc, or .tpc ({said})"
    return f"SPICE refuses it ({said})"


def answer(path: Path, kernels: list[Path], stated: str | None) -> tuple[_Sampled, dict[str, Any]]:
    """The attitudes of the CK's structure, with its name and the frames that its segments refer to. Raises InputError."""
    import spiceypy

    daf, segments = _read_segments(path, MAX_CK_BYTES)
    try:
        with spiceypy.no_found_check():
            load(spiceypy, path, kernels)
            body = _body(spiceypy, path, segments, stated)
            own = [segment for segment in segments if segment.body == body]
            pieces = _pieces_of(list(zip(own, _coverages(spiceypy, daf, own), strict=True)))
            if not pieces:
                raise InputError(f"{path}: its segments of {body} cover no time")
            structure = _Structure(path, spiceypy, body, all(segment.has_rate for segment in own))
            references = sorted({spiceypy.frmnam(segment.reference) or str(segment.reference) for segment in own})
            return sample(structure, pieces), {"structure": _name(spiceypy, body), "references": references}
    except spiceypy.utils.exceptions.SpiceyError as error:
        raise InputError(f"{path}: {_in_words(error)}") from error


def _coverages(spice: Any, daf: _Daf, segments: list[_CkSegment]) -> list[Coverage]:
    """What each segment covers; SPICE tells the intervals of types 4 and 6."""
    found = [_coverage(daf, segment) for segment in segments]
    if None not in found:
        return [each for each in found if each is not None]
    words = sum(segment.summary.integers[-1] - segment.summary.integers[-2] for segment in segments)
    window = spice.ckcov(str(daf.path), segments[0].body, False, "INTERVAL", 0.0, "SCLK", spice.cell_double(words + 2))
    intervals = np.array(list(window), dtype=np.float64).reshape(-1, 2)
    result = []
    for segment, each in zip(segments, found, strict=True):
        within = np.clip(intervals, segment.start, segment.stop)
        touched = (intervals[:, 0] <= segment.stop) & (intervals[:, 1] >= segment.start)
        result.append(Coverage(within[touched], np.empty(0)) if each is None else each)
    return result


def _body(spice: Any, path: Path, segments: list[_CkSegment], stated: str | None) -> int:
    """The id of the structure: the only one, or what the user states by a number, a frame's name or a body's."""
    bodies = sorted({segment.body for segment in segments})
    named = ", ".join(_name(spice, body) for body in bodies[:MAX_NAMED_BODIES]) + (", ..." * (len(bodies) > MAX_NAMED_BODIES))
    if stated is None:
        if len(bodies) > 1:
            raise InputError(f"{path}: contains several structures, {named}; choose one: --body ID")
        return bodies[0]
    body: int | None
    try:
        body = int(stated)
    except ValueError:
        frame = spice.namfrm(stated)
        _, kind, body, found = spice.frinfo(frame) if frame else (0, 0, 0, False)
        if not found or kind != CK_CLASS:
            body, found = spice.bods2c(stated)
            body = body if found else None
    if body is None or body not in bodies:
        raise InputError(f"{path}: contains no structure {stated!r}; it has {named}: --body ID, or a name of its frame kernel")
    return body


def _name(spice: Any, body: int) -> str:
    _, name, _, found = spice.ccifrm(CK_CLASS, body)
    return f"{body} ({name})" if found and name else str(body)


def main() -> None:
    """Answer the request on stdin."""
    request = json.loads(sys.stdin.read())
    arrays: dict[str, Any] = {}
    try:
        found, said = answer(Path(request["path"]), [Path(name) for name in request["kernels"]], request["body"])
        arrays = {"t_ns": found.t_ns, "q": found.q, "rate": found.rate, "breaks": found.breaks, "tick": found.tick}
        said |= {"step_s": found.step_s, "error_rad": found.error_rad, "gaps_s": found.gaps_s}
    except InputError as error:
        said = {"error": str(error)}
    packed = io.BytesIO()
    np.savez(packed, said=np.array(json.dumps(said)), **arrays)
    sys.stdout.buffer.write(packed.getvalue())


if __name__ == "__main__":
    main()
