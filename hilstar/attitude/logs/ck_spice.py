"""The process that evaluates a CK with SPICE. It is separate because a damaged kernel may abort it,
and because SPICE's kernel pool is global to a process.

A request is one JSON object on stdin: `path`, `kernels` and `body`. The answer is an NPZ file on
stdout: the arrays of `_Sampled`, and `said`, JSON text with the rest, or with `error` alone. Times
are ticks of the spacecraft's clock throughout.

1. SPICE reads the file: its list of segments (`daf...`), what they cover (`ckcov`) and their
   attitudes (`ckgp`). What SPICE trusts without a check is checked here before: that the list of
   segments ends, that the counts fit, and that quaternions are unit.
2. Where two segments cover one time, SPICE uses the later one in the file.
3. Segments with attitudes at given times (types 1 and 3) are read at those times.
4. Types 2, 4, 5 and 6 are functions of time. They are read at even steps, which are halved until
   the interpolation between them is within TARGET_RAD (and the clock's resolution), or until there
   are MAX_STEPS.
5. There is a break between two pieces of coverage, unless they touch and their attitudes agree.
"""

import io
import json
import math
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs.entries import GAP_INTERVALS, MAX_SAMPLES, log_joins
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.reading import HEAD_BYTES, open_regular
from hilstar.basics.rotation import angle_between_rad, from_matrix, rate_between_rad_s
from hilstar.basics.units import NS_PER_S

WORD_BYTES = 8
MAX_SUMMARY_WORDS = 125  # SPICE's own limit of a summary
MAX_SUMMARIES = 100_000
MAX_TEXT_BYTES, MAX_BINARY_BYTES = 50_000_000, 4_000_000_000
MAX_NAMED = 1000  # kernels, or path symbols, in one meta-kernel
ADVICE = "give a SPICE kernel (.tls, .tsc, .tf, .tm, ...)"
CK_DOUBLES, CK_INTEGERS = 2, 6  # numbers in a segment's summary, which mark a DAF as a CK
QUATERNION_WORDS, RATE_WORDS, TYPE_2_WORDS = 4, 3, 8
DIRECTORY = 100  # every hundredth time is also in the segment's directory
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
PROBES = 200  # intervals between samples in which the error is measured
# Where in the interval, as a share of it: an interpolation's symmetry may make its error 0 at a
# half, but not here.
PROBED = (math.sqrt(5) - 1) / 2
# Half the span of a rate by difference, in steps: its error h^2 w''/6 is 1/256 of that with a whole
# step.
DIFFERENCE_STEPS = 1 / 16
BESIDE_S = 2e-6  # distance of samples from a boundary: twenty times what ephemeris time resolves
# the attitudes at a boundary agree if they differ by at most this and three times the turn before
JUMP_RAD = math.radians(1e-2 / 3600)
ALL = Policy(max_extrapolation_ns=0, stale_after_ns=0)
MAX_CK_BYTES = 500_000_000
MAX_NAMED_BODIES = 12  # structures listed in a refusal
CK_CLASS = 3  # SPICE's class of frames whose attitude is in CKs


class Segment(NamedTuple):
    """One segment of a CK, from its summary: its `number` in the file, from 1; `start` and `stop`,
    ticks; SPICE's ids of the structure (`body`) and of the `reference` frame; its type `kind`;
    and its first and last word in the file, from 1.
    """

    number: int
    start: float
    stop: float
    body: int
    reference: int
    kind: int
    has_rate: bool
    first_word: int
    last_word: int


class Coverage(NamedTuple):
    """The intervals (n, 2), ticks, that a segment covers, and the times (m,), ticks, of its
    attitudes, both increasing; no times for a function of time.
    """

    intervals: FloatArray
    epochs: FloatArray


@contextmanager
def _opened(spice: Any, path: Path) -> Iterator[int]:
    """SPICE's handle of a DAF, open within the `with`. Raises InputError for what is no regular
    file.

    An error leaves the DAF open, as this process then ends: SPICE may have closed it already, and
    closing it once more would hide SPICE's message.
    """
    open_regular(path, ADVICE).close()
    handle = spice.dafopr(str(path))
    yield handle
    spice.dafcls(handle)


def _summaries(spice: Any, path: Path, handle: int) -> Iterator[tuple[FloatArray, list[int]]]:
    """The doubles and integers of each summary of a DAF, in the file's order. Raises InputError for
    a list without an end.

    SPICE follows a damaged list for ever, even where it only looks for an attitude. So the list is
    walked through, and its entries are counted, before SPICE searches it.
    """
    doubles, integers = spice.dafhsf(handle)
    spice.dafbfs(handle)
    count = 0
    while spice.daffna():
        count += 1
        if count > MAX_SUMMARIES:
            raise InputError(
                f"{path}: has more than {MAX_SUMMARIES} segments; split it, or copy it again if it"
                " is damaged"
            )
        summary_doubles, summary_integers = spice.dafus(
            spice.dafgs(MAX_SUMMARY_WORDS), doubles, integers
        )
        yield summary_doubles, [int(number) for number in summary_integers]


def read_segments(spice: Any, path: Path, handle: int) -> list[Segment]:
    """The segments of a CK in the file's order. Raises InputError for another kind of file, a
    segment of another type, and a file that is damaged or cut off.
    """
    if tuple(spice.dafhsf(handle)) != (CK_DOUBLES, CK_INTEGERS):
        raise InputError(f"{path}: is another kind of DAF than a CK")
    size_words = path.stat().st_size // WORD_BYTES
    segments = []
    for number, (ticks, integers) in enumerate(_summaries(spice, path, handle), start=1):
        body, reference, kind, has_rate, first_word, last_word = integers
        start = float(ticks[0])
        stop = float(ticks[1])
        if not (math.isfinite(start) and math.isfinite(stop) and 0 <= start <= stop):
            raise InputError(
                f"{path}: segment {number} spans the ticks {start:g} to {stop:g}; is the file"
                " damaged?"
            )
        if kind not in TYPES:
            raise InputError(f"{path}: segment {number} is of type {kind}; types 1 to 6 are read")
        if not 0 < first_word <= last_word <= size_words:
            place = f"the words {first_word} to {last_word} of {size_words}"
            raise InputError(f"{path}: segment {number} has {place}; is the file cut off?")
        segments.append(
            Segment(
                number, start, stop, body, reference, kind, has_rate != 0, first_word, last_word
            )
        )
    if not segments:
        raise InputError(f"{path}: contains no segment; is the file cut off?")
    return segments


def _epochs(spice: Any, path: Path, handle: int, segment: Segment) -> FloatArray:
    """The times (n,), ticks, at which a segment of type 1 or 3 has attitudes; none for the other
    types.

    Raises InputError for a quaternion that is not unit, as SPICE would make an attitude even of one
    that is all zeros, and for times or counts that do not fit. The words are read directly, as
    SPICE has no other way to them: types 1, 2, 3 and 5 begin with their packets, whose first words
    are the quaternion; in all but type 2 their times follow. The packets of types 4 and 6 are
    polynomials, which SPICE itself checks.
    """
    if segment.kind in {4, 6}:
        return np.empty(0)
    numbers = np.asarray(
        spice.dafgda(handle, segment.first_word, segment.last_word), dtype=np.float64
    )
    where = f"{path}: segment {segment.number}"
    count, packet_words = _packets(numbers, segment)
    if count < 1 or packet_words < QUATERNION_WORDS or (packet_words + 1) * count > len(numbers):
        raise InputError(
            f"{where}: its counts do not fit its {len(numbers)} words; is the file damaged?"
        )
    quaternions = numbers[: packet_words * count].reshape(count, packet_words)[:, :QUATERNION_WORDS]
    norms = np.sqrt((quaternions * quaternions).sum(axis=1))
    bad = np.flatnonzero(~(np.abs(norms - 1.0) <= NORM_TOLERANCE))
    if len(bad):
        raise InputError(
            f"{where}: the norm of its quaternion {bad[0] + 1} is {norms[bad[0]]:.6g}; it must be 1"
        )
    if segment.kind in SMOOTH:
        return np.empty(0)
    epochs = numbers[packet_words * count : (packet_words + 1) * count]
    if not np.isfinite(epochs).all() or (np.diff(epochs) <= 0).any():
        raise InputError(f"{where}: its times do not increase; is the file damaged?")
    # SPICE searches the times by a directory of every hundredth time (type 3), or of the mean of it
    # and the next one (type 1). With a wrong one it would find a wrong attitude, or none.
    directory = numbers[(packet_words + 1) * count :][: (count - 1) // DIRECTORY]
    hundredth = epochs[DIRECTORY - 1 : -1 : DIRECTORY]
    following = epochs[DIRECTORY::DIRECTORY]
    if not ((hundredth <= directory) & (directory <= following)).all():
        raise InputError(f"{where}: its directory is not that of its times; is the file damaged?")
    return epochs


def _packets(words: FloatArray, segment: Segment) -> tuple[int, int]:
    """How many packets a segment of type 1, 2, 3 or 5 has, and the words in each; 0 and 0 where
    the segment's words do not say.
    """
    # Type 2 states no count. With each packet's 8 words and two times, and a directory of every
    # hundredth time, 100 packets have 1001 words.
    if segment.kind == 2:
        return -(-(100 * len(words) + 1) // 1001), TYPE_2_WORDS
    trailer_words = {1: 1, 3: 2, 5: 5}[segment.kind]
    if len(words) < trailer_words or not np.isfinite(words[-trailer_words:]).all():
        return 0, 0
    count = int(words[-1])
    if segment.kind == 5:
        return count, TYPE_5_WORDS.get(int(words[-4]), 0)
    return count, QUATERNION_WORDS + RATE_WORDS * segment.has_rate


def _coverages(spice: Any, path: Path, segments: Sequence[Segment]) -> list[Coverage]:
    """The coverage of each of these segments of one structure. Raises InputError for a damaged
    one.
    """
    with _opened(spice, path) as handle:
        epochs = [_epochs(spice, path, handle, segment) for segment in segments]
    intervals = _intervals(spice, path, segments)
    coverages = []
    for segment, own_epochs, own_intervals in zip(segments, epochs, intervals, strict=True):
        # SPICE counts each attitude of type 1 as an interval of its own; hilstar interpolates from
        # one to the next.
        if segment.kind == 1:
            spans = own_epochs[[0, -1]].reshape(1, 2)
        else:
            spans = own_intervals
        if not np.isfinite(spans).all() or (np.diff(spans.ravel()) < 0).any():
            raise InputError(
                f"{path}: segment {segment.number}: its intervals do not increase; is the file"
                " damaged?"
            )
        within = np.clip(spans, segment.start, segment.stop)
        is_covered = (within[:, 1] > within[:, 0]) | (spans[:, 1] == spans[:, 0])
        coverages.append(Coverage(within[is_covered], own_epochs))
    return coverages


def _intervals(spice: Any, path: Path, segments: Sequence[Segment]) -> list[FloatArray]:
    """The intervals (n, 2), ticks, that each segment covers, by SPICE.

    SPICE gives the coverage of a structure by all its segments together, which hides a gap in one
    of two that overlap. So in a copy of the file each segment becomes a structure of its own.
    """
    if len(segments) == 1:
        return [_covered(spice, path, segments[0].body, segments[0])]
    numbers = {segment.number for segment in segments}
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "apart.bc"
        shutil.copyfile(path, copy)
        handle = spice.dafopw(str(copy))
        for number, (ticks, integers) in enumerate(_summaries(spice, copy, handle), start=1):
            body = number if number in numbers else 0
            spice.dafrs(spice.dafps(CK_DOUBLES, CK_INTEGERS, ticks, [body, *integers[1:]]))
        spice.dafcls(handle)
        return [_covered(spice, copy, segment.number, segment) for segment in segments]


def _covered(spice: Any, path: Path, body: int, segment: Segment) -> FloatArray:
    # Every type has at least two words for each interval's two bounds, so this cell is large
    # enough.
    cell = spice.cell_double(segment.last_word - segment.first_word + 3)
    window = spice.ckcov(str(path), body, False, "INTERVAL", 0.0, "SCLK", cell)
    return np.array(list(window), dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class _Piece:
    """A part of a segment, from `start` to `stop`, ticks; `epochs` (n,) are the times strictly
    between them at which the segment has attitudes.
    """

    segment: Segment
    start: float
    stop: float
    epochs: FloatArray

    def ticks(self, step: float) -> FloatArray:
        """The ticks (n,) at which the piece is read, both ends among them; `step`, ticks, is for
        functions of time. A long pause between given times (type 3) is filled, as the file covers
        it, and would else count as a gap.
        """
        if self.stop <= self.start:
            return np.array([self.start])
        if self.segment.kind in SMOOTH:
            return np.linspace(
                self.start, self.stop, max(math.ceil((self.stop - self.start) / step), 2) + 1
            )
        ticks = np.concatenate(([self.start], self.epochs, [self.stop]))
        spacing = np.diff(ticks)
        longest = (GAP_INTERVALS - 1) * float(np.median(spacing))
        if (
            self.segment.kind != 3
            or not (spacing > longest).any()
            or (self.stop - self.start) / longest > MAX_STEPS
        ):
            return ticks
        parts = np.ceil(spacing / longest).astype(int).tolist()
        inner = []
        for a, b, n in zip(ticks[:-1], ticks[1:], parts, strict=True):
            inner.append(np.linspace(a, b, n, endpoint=False))
        return np.concatenate([*inner, ticks[-1:]])


def _pieces_of(covered: list[tuple[Segment, Coverage]]) -> list[_Piece]:
    """The pieces of the segments of one structure, in order of time. The segments are `covered` in
    the file's order: where they overlap, the later one counts, as in SPICE.
    """
    owners = [
        (segment, cover.epochs, *span)
        for segment, cover in covered
        for span in cover.intervals.tolist()
    ]
    if not owners:
        return []
    bounds = np.unique(np.array([owner[2:] for owner in owners]))
    # Cell k goes from bound k to bound k + 1; the last cell has no owner.
    owner_of_cell = np.full(len(bounds), -1)
    owner_of_point = np.full(len(bounds), -1)
    for index, (_, _, start, stop) in enumerate(owners):
        cells = slice(*np.searchsorted(bounds, [start, stop]))
        owner_of_cell[cells] = index
        if start == stop:
            owner_of_point[cells.start] = index
    begins = np.flatnonzero(np.diff(owner_of_cell, prepend=-1))
    # where a CK has single instants only, no span begins
    ends = np.append(begins[1:], len(bounds) - 1)[: len(begins)]
    spans = [
        (owner_of_cell[k], k, end)
        for k, end in zip(begins.tolist(), ends.tolist(), strict=True)
        if owner_of_cell[k] >= 0
    ]
    for k in np.flatnonzero(owner_of_point >= 0).tolist():
        if owner_of_cell[k] < 0 and (k == 0 or owner_of_cell[k - 1] < 0):
            spans.append((owner_of_point[k], k, k))
    pieces = []
    for owner, first, last in spans:
        (segment, epochs, *_), start, stop = (
            owners[owner],
            float(bounds[first]),
            float(bounds[last]),
        )
        within = slice(
            int(np.searchsorted(epochs, start, "right")), int(np.searchsorted(epochs, stop, "left"))
        )
        pieces.append(_Piece(segment, start, stop, epochs[within]))
    return sorted(pieces, key=lambda piece: piece.start)


@dataclass(frozen=True)
class _Structure:
    """A structure whose CK and kernels SPICE has loaded: `body` is its id, `clock` the id of its
    clock; `turning` says whether all its segments have rates.
    """

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
        """The time of a tick, TDB nanoseconds since 1970-01-01T00:00:00 TDB, to the 0.1 us that
        SPICE's ephemeris time, a double, resolves.
        """
        seconds = self.t_s(tick)
        whole = int(seconds // 1)
        return (whole + J2000_S) * NS_PER_S + round((seconds - whole) * NS_PER_S)

    def matrix(self, tick: float) -> FloatArray:
        """The C-matrix (3, 3), which turns ICRS components into the structure's. Raises
        InputError where there is none.
        """
        matrix, _, is_there = self.spice.ckgp(self.body, tick, 0, FRAME)
        if not is_there:
            raise InputError(
                f"{self.path}: SPICE has no attitude of {self.body} at tick {tick:.17g}, which its"
                " segments cover"
            )
        return np.asarray(matrix, dtype=np.float64)

    def q_icrs_to_body(self, tick: float) -> FloatArray:
        return from_matrix(self.matrix(tick))

    def attitude(self, tick: float, with_rate: bool) -> tuple[FloatArray, FloatArray | None]:
        """The attitude q_icrs_to_body (4,) at a tick, and the angular velocity (3,), rad/s, in the
        structure's components; None for that without `with_rate`, or where SPICE has none.

        Asked for a rate, SPICE passes over segments without one, and may answer by another segment.
        So its rate counts only where its matrix is that of `matrix`. SPICE gives the rate in
        components of J2000.
        """
        if not with_rate:
            return self.q_icrs_to_body(tick), None
        matrix, rate, _, is_there = self.spice.ckgpav(self.body, tick, 0, FRAME)
        if not (
            is_there and (self.turning or np.abs(matrix - self.matrix(tick)).max() < SAME_MATRIX)
        ):
            return self.q_icrs_to_body(tick), None
        return from_matrix(matrix), matrix @ np.asarray(rate, dtype=np.float64)

    def rate_by_difference(self, tick: float, step: float, span: tuple[float, float]) -> FloatArray:
        """The rate (3,), rad/s, in the structure's components, at a tick of a function of time,
        from its attitudes `step` ticks before and after.

        Near an end of `span` (ticks) it is from two attitudes on one side, to second order too:
        2 r(h) - r(2 h).
        """
        start, stop = span
        s_per_tick = (self.t_s(stop) - self.t_s(start)) / (stop - start)

        def mean_rate(one: float, other: float) -> FloatArray:
            before, after = sorted((one, other))
            return rate_between_rad_s(
                self.q_icrs_to_body(before),
                self.q_icrs_to_body(after),
                (after - before) * s_per_tick,
            )

        if start + step <= tick <= stop - step:
            return mean_rate(tick - step, tick + step)
        away = step if tick < start + step else -step
        return 2.0 * mean_rate(tick, tick + away) - mean_rate(tick, tick + 2 * away)


@dataclass(frozen=True, slots=True)
class _Sampled:
    """n attitudes of a structure, and how good they are.

    `t_ns` (n,), TDB from 1970; `q` (n, 4) is q_icrs_to_body; `rate` (n, 3), rad/s, in the
    structure's components, NaN where there is none; `breaks` (n,) is True where nothing is
    interpolated from the attitude before; `tick` (n,). `step_s` and `error_rad` are the step of
    functions of time (None without any) and the largest error measured between their samples.
    `gaps_s` are the lengths of the gaps of coverage.
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
    """The attitudes of the pieces, which come in order of time. Raises InputError for more than
    MAX_SAMPLES of them.
    """
    smooth = [
        piece for piece in pieces if piece.segment.kind in SMOOTH and piece.stop > piece.start
    ]
    step = error_rad = 0.0
    if smooth:
        step, error_rad = _step_of(structure, smooth)
    ticks = [piece.ticks(step) for piece in pieces]
    if sum(map(len, ticks)) > MAX_SAMPLES:
        raise InputError(
            f"{structure.path}: contains more than {MAX_SAMPLES} attitudes; cut it into several"
            " (ckslicer)"
        )
    broken, gaps_s = _parted(structure, pieces, ticks)
    if smooth:
        step_s = structure.t_s(smooth[0].start + step) - structure.t_s(smooth[0].start)
    else:
        step_s = None
    parts = [_attitudes(structure, *pair) for pair in zip(pieces, ticks, strict=True)]
    t_ns, q, rate = (np.concatenate(column) for column in zip(*parts, strict=True))
    breaks = np.zeros(len(t_ns), dtype=np.bool_)
    breaks[np.cumsum([0, *map(len, ticks[:-1])])] = broken
    return _Sampled(t_ns, q, rate, breaks, np.concatenate(ticks), step_s, error_rad, gaps_s)


def _step_of(structure: _Structure, smooth: Sequence[_Piece]) -> tuple[float, float]:
    """The step for pieces that are functions of time, ticks, and the largest error measured between
    samples with that step, rad.
    """
    total = sum(piece.stop - piece.start for piece in smooth)
    steps = FIRST_STEPS
    while True:
        step = total / steps
        ticks = [piece.ticks(step) for piece in smooth]
        counts = np.cumsum([len(piece_ticks) - 1 for piece_ticks in ticks])
        error_rad = excess_rad = 0.0
        for place in np.unique(np.linspace(0, counts[-1] - 1, PROBES).astype(int)).tolist():
            k = int(np.searchsorted(counts, place, "right"))
            within = place - (int(counts[k - 1]) if k else 0)
            found_rad, clock_rad = _error_rad(structure, smooth[k], ticks[k], within)
            error_rad = max(error_rad, found_rad)
            excess_rad = max(excess_rad, found_rad - clock_rad)
        if excess_rad <= TARGET_RAD or 2 * steps > MAX_STEPS:
            return step, error_rad
        steps *= 2


def _error_rad(
    structure: _Structure, piece: _Piece, ticks: FloatArray, k: int
) -> tuple[float, float]:
    """The error, rad, of the log's interpolation at one place between the ticks k and k + 1 of a
    piece, and the error, rad, that no smaller step removes: the turn in the time that ephemeris
    time, a double, does not resolve.
    """
    # two samples on each side, as the log's interpolation uses them
    near = []
    for t_ns, q, rate in zip(
        *_attitudes(structure, piece, ticks[max(k - 1, 0) : k + 3]), strict=True
    ):
        near.append(AttitudeSample(t_ns, q, rate))
    timeline = Timeline(ALL, len(near), log_joins(near))
    for event in near:
        timeline.add(event)
    tick = float(ticks[k] + PROBED * (ticks[k + 1] - ticks[k]))
    shown = timeline.at(structure.t_ns(tick))
    if shown is None or shown.rate_cam_rad_s is None:
        raise AssertionError("a tick between two samples of a piece has an attitude")
    clock_rad = 2.0 * float(
        np.spacing(abs(structure.t_s(tick))) * np.linalg.norm(shown.rate_cam_rad_s)
    )
    return angle_between_rad(shown.q_icrs_to_cam, structure.q_icrs_to_body(tick)), clock_rad


def _attitudes(
    structure: _Structure, piece: _Piece, ticks: FloatArray
) -> tuple[npt.NDArray[np.int64], FloatArray, FloatArray]:
    """The times (n,), ns, attitudes (n, 4) and rates (n, 3), rad/s, of a piece at `ticks` (n,). A
    function of time without rates gets them by difference.
    """
    by_difference = piece.segment.kind in SMOOTH and not piece.segment.has_rate and len(ticks) > 1
    if by_difference:
        step = float(ticks[1] - ticks[0]) * DIFFERENCE_STEPS
    else:
        step = 0.0
    t_ns = np.empty(len(ticks), dtype=np.int64)
    q = np.empty((len(ticks), 4))
    rates = np.full((len(ticks), 3), np.nan)
    for k, tick in enumerate(ticks.tolist()):
        t_ns[k] = structure.t_ns(tick)
        q[k], rate = structure.attitude(tick, piece.segment.has_rate)
        if by_difference:
            rate = structure.rate_by_difference(tick, step, (piece.start, piece.stop))
        if rate is not None:
            rates[k] = rate
    return t_ns, q, rates


def _parted(
    structure: _Structure, pieces: Sequence[_Piece], ticks: list[FloatArray]
) -> tuple[list[bool], list[float]]:
    """Whether each piece begins with a break, that is after a gap or a jump, and the lengths of the
    gaps, s.

    Where two pieces touch, both have a sample at the same tick. `ticks` is changed: without a jump
    only the later piece has that sample, with a jump each has one a little to its side of it. The
    attitude jumps where it turns by more than JUMP_RAD and three times its turn in equal time just
    before.
    """
    broken = [False]
    gaps_s = []
    for k, (before, after) in enumerate(pairwise(pieces), start=1):
        if before.stop < after.start:
            gaps_s.append(structure.t_s(after.start) - structure.t_s(before.stop))
            broken.append(True)
            continue
        s_per_tick = (structure.t_s(after.stop) - structure.t_s(before.start)) / (
            after.stop - before.start
        )
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
    """Load the kernels into SPICE, each after a check, and the CK last, so that it comes before any
    other CK. Raises InputError for a kernel that is refused.
    """
    for kernel in kernels:
        for file in _checked(spice, kernel):
            spice.furnsh(str(file))
    spice.furnsh(str(path))


def _checked(spice: Any, kernel: Path, meta: Path | None = None) -> list[Path]:
    """The files of a kernel: itself, or those that it names if it is a meta-kernel; all are checked
    before SPICE opens them. Raises InputError for one that cannot be read, is too large, or is a
    transfer file or a meta-kernel in a meta-kernel.
    """
    with open_regular(kernel, ADVICE if meta is None else f"{meta} names it") as file:
        head = file.read(HEAD_BYTES)
    if meta is not None and head.startswith(b"KPL/MK"):
        raise InputError(f"{meta}: names another meta-kernel, {kernel}; name its kernels instead")
    if head.startswith(b"DAF/"):
        open_regular(kernel, ADVICE, MAX_BINARY_BYTES).close()
        with _opened(spice, kernel) as handle:
            for _ in _summaries(spice, kernel, handle):
                pass
        return [kernel]
    if head.startswith((b"DAFETF", b"DASETF")):
        raise InputError(f"{kernel}: is a transfer file; convert it by tobin")
    open_regular(kernel, ADVICE, MAX_TEXT_BYTES).close()
    if not head.startswith(b"KPL/MK") and kernel.suffix.lower() != ".tm":
        return [kernel]
    return [file for named in _named(spice, kernel) for file in _checked(spice, named, kernel)]


def _named(spice: Any, meta: Path) -> list[Path]:
    """The kernels that a meta-kernel names, with its path symbols replaced. As in SPICE, relative
    paths are relative to the working directory. Raises InputError where it names none.
    """
    names = ("KERNELS_TO_LOAD", "PATH_SYMBOLS", "PATH_VALUES")
    spice.ldpool(str(meta))
    files, symbols, values = (_strings(spice, name) for name in names)
    for name in names:
        spice.dvpool(name)
    if not files or len(symbols) != len(values):
        raise InputError(
            f"{meta}: names no kernels; write KERNELS_TO_LOAD, and as many PATH_VALUES as"
            " PATH_SYMBOLS"
        )
    for symbol, value in sorted(zip(symbols, values, strict=True), key=lambda pair: -len(pair[0])):
        files = [file.replace(f"${symbol}", value) for file in files]
    return [Path(file) for file in files]


def _strings(spice: Any, name: str) -> list[str]:
    """The strings of a variable in SPICE's kernel pool; one that ends in + continues in the next.
    Raises InputError for more than MAX_NAMED of them.
    """
    strings: list[str] = []
    for k in range(MAX_NAMED + 1):
        text, _, there = spice.stpool(name, k, "+")
        if not there:
            return strings
        strings.append(text)
    raise InputError(f"a meta-kernel has more than {MAX_NAMED} {name}; split it into several")


def _in_words(error: Any) -> str:
    """SPICE's message in one line, and which kernel to give where one is missing."""
    reason = shortened(" ".join(str(error.long or error.explain or error.short).split()), 300)
    if "SCLK" in reason and ("not found" in reason or "kernel" in reason.lower()):
        return (
            "its clock is unknown; give its SCLK kernel, and leap seconds: --kernel FILE.tsc"
            f" ({reason})"
        )
    if "frame" in reason.lower():
        return (
            "a frame has no place among the stars; give what orients it: --kernel FILE.tf, or its"
            f" own .bc, or .tpc ({reason})"
        )
    return f"SPICE refuses it ({reason})"


def answer(path: Path, kernels: list[Path], stated: str | None) -> tuple[_Sampled, dict[str, Any]]:
    """The attitudes of a structure of the CK, and a table with its name (`structure`) and the
    names of the frames that its segments refer to (`references`). Raises InputError.
    """
    import spiceypy

    open_regular(path, ADVICE, MAX_CK_BYTES).close()
    try:
        with spiceypy.no_found_check():
            with _opened(spiceypy, path) as handle:
                segments = read_segments(spiceypy, path, handle)
            load(spiceypy, path, kernels)
            body = _body(spiceypy, path, segments, stated)
            own_segments = [segment for segment in segments if segment.body == body]
            pieces = _pieces_of(
                list(zip(own_segments, _coverages(spiceypy, path, own_segments), strict=True))
            )
            if not pieces:
                raise InputError(f"{path}: its segments of {body} cover no time")
            structure = _Structure(
                path, spiceypy, body, all(segment.has_rate for segment in own_segments)
            )
            references = sorted(
                {
                    spiceypy.frmnam(segment.reference) or str(segment.reference)
                    for segment in own_segments
                }
            )
            return sample(structure, pieces), {
                "structure": _name(spiceypy, body),
                "references": references,
            }
    except spiceypy.utils.exceptions.SpiceyError as error:
        raise InputError(f"{path}: {_in_words(error)}") from error


def _body(spice: Any, path: Path, segments: list[Segment], stated: str | None) -> int:
    """The id of the structure: the only one in the CK, or the one that the user states by its id,
    a frame's name or a body's name. Raises InputError where that is none, or several are left.
    """
    bodies = sorted({segment.body for segment in segments})
    named = ", ".join(_name(spice, body) for body in bodies[:MAX_NAMED_BODIES]) + (
        ", ..." * (len(bodies) > MAX_NAMED_BODIES)
    )
    if stated is None:
        if len(bodies) > 1:
            raise InputError(f"{path}: contains several structures, {named}; choose one: --body ID")
        return bodies[0]
    body: int | None
    try:
        body = int(stated)
    except ValueError:
        frame = spice.namfrm(stated)
        _, kind, body, is_known = spice.frinfo(frame) if frame else (0, 0, 0, False)
        if not is_known or kind != CK_CLASS:
            body, is_known = spice.bods2c(stated)
            body = body if is_known else None
    if body is None or body not in bodies:
        raise InputError(
            f"{path}: contains no structure {stated!r}; it has {named}: --body ID, or a name of its"
            " frame kernel"
        )
    return body


def _name(spice: Any, body: int) -> str:
    _, name, _, is_known = spice.ccifrm(CK_CLASS, body)
    if is_known and name:
        return f"{body} ({name})"
    return str(body)


def main() -> None:
    """Answer the request on stdin, on stdout (see the module)."""
    request = json.loads(sys.stdin.read())
    arrays: dict[str, Any] = {}
    try:
        sampled, reply = answer(
            Path(request["path"]), [Path(name) for name in request["kernels"]], request["body"]
        )
        arrays = {
            "t_ns": sampled.t_ns,
            "q": sampled.q,
            "rate": sampled.rate,
            "breaks": sampled.breaks,
            "tick": sampled.tick,
        }
        reply |= {
            "step_s": sampled.step_s,
            "error_rad": sampled.error_rad,
            "gaps_s": sampled.gaps_s,
        }
    except InputError as error:
        reply = {"error": str(error)}
    packed = io.BytesIO()
    np.savez(packed, said=np.array(json.dumps(reply)), **arrays)
    sys.stdout.buffer.write(packed.getvalue())


if __name__ == "__main__":
    main()
