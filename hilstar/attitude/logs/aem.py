"""CCSDS Attitude Ephemeris Messages: 1.0 (504.0-B-1) and 2.0 (504.0-B-2) are read, as KVN or XML;
1.0 is written.

Reading:
1. One of REF_FRAME_A and REF_FRAME_B is ICRF, GCRF or EME2000, taken as the same axes (EME2000's
   differ by 23 mas). The
   other is a frame of the spacecraft: a camera by its name (STARTRACKER_1, INSTRUMENT_A, CAM, ...),
   else a body, which the mounting turns into the camera. MOD, TOD, TEME and ITRF are turned to the
   ICRS at each epoch. Any other is refused.
2. The quaternion of 504.0-B-2 annex F turns components from its first frame into its second; it is
   the conjugate of
   hilstar's. ATTITUDE_DIR says which frame is first (2.0: always A), QUATERNION_TYPE where the
   scalar is (2.0: last).
3. A rate is the angular velocity of the second frame with respect to the first.
4. EULER_ROT_SEQ names the axes of three successive turns of the frame, from the first frame to the
   second; each turn is about
   an axis of the frame that the previous turns made. The angles come in that order.
5. A spin axis is +z of the second frame, at right ascension alpha and declination delta of the
   first. The spin angle is the
   third of the turns ZXZ by alpha + 90, 90 - delta and that angle (as in Orekit). With nutation,
   the frame turns at its spin rate about +z and at the nutation rate about the angular momentum.
   The phase p and nutation angle n place the momentum in the second frame, (sin n cos p, -sin n sin
   p, cos n); the type with _MOM gives it in the first frame.
6. `t_ns` is nanoseconds from 1970-01-01T00:00:00 of the file's own time system; leap seconds are
   not counted.
7. A new block begins with a discontinuity. The TOTAL spans of blocks may overlap:
   USEABLE_START_TIME and USEABLE_STOP_TIME
   say where each is meant to be used. Where several blocks have a time, a useable one wins, then
   the one that begins later (as in Orekit). Interpolation hints are ignored.

Writing: version 1.0, which every AEM reader reads and which states the quaternion's order and
direction. Rates are written as quaternion derivatives: some readers take QUATERNION/RATE as an
angular velocity, others as Euler rates.
"""

import contextlib
import re
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import chain, pairwise
from pathlib import Path
from typing import IO, NoReturn

import numpy as np
import numpy.typing as npt

from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs import aem_blocks as ccsds
from hilstar.attitude.logs.entries import (
    MAX_QUOTED_CHARACTERS,
    LogEntry,
    LogReading,
    Stated,
    log_joins,
)
from hilstar.attitude.logs.log_formats import LogFormat, LogHead, Writing
from hilstar.attitude.logs.log_times import FIRST_DATE_NS
from hilstar.attitude.wire.packet import INT64, AttitudeSample, checked_sample
from hilstar.attitude.wire.source import Conventions, components
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.reading import read_text
from hilstar.basics.rotation import conjugate, direction_of, frame_turns, multiply, rotate
from hilstar.basics.units import NS_PER_S

MAX_OVERLAPPING = 1000
MAX_BYTES = 50_000_000
# 504.0-B-2's own examples write J2000 for EME2000; the realisations of the ICRF share its axes to
# 0.1 mas.
INERTIAL_FRAMES = frozenset({"ICRF", "ICRF1", "ICRF2", "ICRF3", "GCRF", "EME2000", "J2000"})
# SANA's registry of spacecraft body frames, whose names end in a label (SC_BODY_1, INSTRUMENT_A),
# and CAM.
CAMERA_FRAME = re.compile("(STARTRACKER|AST|INSTRUMENT|SENSOR|CAM|CAMERA)(_.*|[0-9]+)?")
BODY_FRAME = re.compile(
    "(SC_BODY|ACC|ACTUATOR|CSS|DSS|ESA|GYRO|GYRO_FRAME|IMU|IMU_FRAME|MTA|RW|SA|TAM)(_.*|[0-9]+)?|"
    + CAMERA_FRAME.pattern
)

OF_DATE_FRAME = re.compile("MOD|TOD|TEME|ITRF-?([0-9]{2}|[0-9]{4})?")
OfDate = Callable[[str, str, npt.NDArray[np.int64]], tuple[FloatArray, FloatArray, str | None]]
AMBIGUOUS = (
    f"{ccsds.EULER_RATE} of AEM 1.0 does not say whether its rates are those of the angles or an"
    " angular velocity; they are not used"
)
QUARTER_TURN_DEG = 90.0
ADVICE = "sort its lines; leap seconds are not counted, so write TAI across one"
SCALES = frozenset({"UTC", "TAI", "TT", "TDB", "TCB", "GPS", "UT1", "SCLK"})  # of AEM 1.0
COMMENTS = (
    "STARTRACKER_1 is the camera: +z boresight, +x right and +y down in its image.",
    "Epochs are the source's clock from 1970-01-01T00:00:00; leap seconds are not counted.",
)
ORDER = ("QC", "Q1", "Q2", "Q3")  # in XML; in KVN the scalar comes last


def _turned(angles_rad: FloatArray, axes: tuple[int, int, int]) -> FloatArray:
    """The rotations (n, 4) of components from the first frame to the second, by angles (n, 3)
    about axes.
    """
    first, second, third = (frame_turns(axis, angles_rad[:, k]) for k, axis in enumerate(axes))
    return multiply(third, multiply(second, first))


def _euler(values: FloatArray, meta: dict[str, str]) -> tuple[FloatArray, FloatArray | None]:
    """Rotations (n, 4) from first to second, and their rates (n, 3), rad/s in the second's
    components, for EULER_DERIVATIVE.

    `values` (n, 3 or 6) are degrees and degrees per second.
    """
    axes = ccsds.sequence(meta)
    values = np.radians(values)
    q = _turned(values[:, :3], axes)
    if meta["ATTITUDE_TYPE"] != ccsds.EULER_DERIVATIVE:
        return q, None
    rate = np.zeros((len(values), 3))
    for k, axis in enumerate(axes):  # each turn's rate, then carried through the turns after it
        rate[:, axis] += values[:, 3 + k]
        if k < 2:
            rate = rotate(frame_turns(axes[k + 1], values[:, k + 1]), rate)
    return q, rate


def _spin(values: FloatArray, kind: str) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 4) from first to second and rates (n, 3), rad/s in the second's components.

    `values` (n, 4 or 7) are alpha, delta, the angle (degrees) and its rate (degrees per second);
    then, with nutation, the angle of nutation, its period (s) and its phase, or the momentum's
    alpha and delta and the rate of nutation.
    """
    alpha, delta, angle, spin_rate = np.radians(values[:, :4].T)
    q = _turned(np.column_stack((np.pi / 2 + alpha, np.pi / 2 - delta, angle)), (2, 0, 2))
    rate = np.zeros((len(values), 3))
    rate[:, 2] = spin_rate
    if kind == ccsds.SPIN_NUTATION:
        nutation = np.radians(values[:, 4])
        phase = np.radians(values[:, 6])
        momentum = np.stack(
            (np.sin(nutation) * np.cos(phase), -np.sin(nutation) * np.sin(phase), np.cos(nutation)),
            axis=1,
        )
        rate += (2 * np.pi / values[:, 5])[:, None] * momentum
    elif kind == ccsds.SPIN_NUTATION_MOM:
        momentum = direction_of(values[:, 4], values[:, 5])
        rate += np.radians(values[:, 6])[:, None] * rotate(q, momentum)
    return q, rate


@dataclass(frozen=True)
class _DatedBlock:
    """One segment: its keywords, and its entries in the order of the file."""

    block: ccsds.Block
    times: list[int]
    entries: list[LogEntry]

    @property
    def is_whole(self) -> bool:
        """Whether every entry is an attitude, in order of time; else reading it ends in a
        refusal.
        """
        return all(isinstance(entry.event, AttitudeSample) for entry in self.entries) and all(
            before < after for before, after in pairwise(self.times)
        )

    @cached_property
    def _timeline(self) -> Timeline:
        samples = [entry.event for entry in self.entries if isinstance(entry.event, AttitudeSample)]
        timeline = Timeline(Policy(0, NS_PER_S), capacity=len(samples), joins=log_joins(samples))
        for sample in samples:
            timeline.add(sample)
        return timeline

    def at(self, t_ns: int) -> LogEntry:
        """Its attitude at a time within its span, interpolated as in a replay, at the previous
        sample's place in the file.
        """
        where, before = self.entries[bisect_right(self.times, t_ns) - 1]
        attitude = self._timeline.at(t_ns)
        if attitude is None or not isinstance(before, AttitudeSample):
            raise AssertionError("a whole segment has attitudes")
        if before.rate_cam_rad_s is None:
            rate = None
        else:
            rate = attitude.rate_cam_rad_s
        return LogEntry(where, AttitudeSample(t_ns, attitude.q_icrs_to_cam, rate))

    def useable_ns(self) -> tuple[int, int]:
        """Where it is meant to be used; without keywords, all of it. Raises AemFaultError."""
        where = self.block.where[0]
        meta = self.block.meta
        first = self.times[0]
        last = self.times[-1]
        if "USEABLE_START_TIME" in meta:
            start = ccsds.epoch_ns(where, meta["USEABLE_START_TIME"])
        else:
            start = first
        if "USEABLE_STOP_TIME" in meta:
            stop = ccsds.epoch_ns(where, meta["USEABLE_STOP_TIME"])
        else:
            stop = last
        if stop < start:
            raise ccsds.AemFaultError(where, "USEABLE_STOP_TIME is before USEABLE_START_TIME")
        return min(max(start, first), last), max(min(stop, last), first)


def _resolved(segments: list[_DatedBlock], told: dict[str, str]) -> list[list[LogEntry]]:
    """The entries of segments, which come in the order of their first epochs; those that overlap
    are made one run of pieces.
    """
    groups: list[list[_DatedBlock]] = []
    end_ns = 0
    for segment in segments:
        if (
            groups
            and segment.times[0] < end_ns
            and all(block.is_whole for block in (segment, *groups[-1]))
        ):
            groups[-1].append(segment)
            end_ns = max(end_ns, segment.times[-1])
        else:
            groups.append([segment])
            end_ns = segment.times[-1]
    several = [group for group in groups if len(group) > 1]
    if several:
        told["aem-overlap"] = (
            f"{sum(map(len, several))} segments overlap, first at"
            f" {ccsds.epoch_text(several[0][1].times[0])}: where they do, the one that its USEABLE"
            " times give is taken, and of several the one that begins later"
        )
    return [group[0].entries if len(group) == 1 else _one_run(group) for group in groups]


def _one_run(group: list[_DatedBlock]) -> list[LogEntry]:
    if len(group) > MAX_OVERLAPPING:
        where = group[0].block.where[0]
        raise ccsds.AemFaultError(
            where,
            f"{len(group)} segments overlap, and {MAX_OVERLAPPING} may; write a file for each",
        )
    useable = [segment.useable_ns() for segment in group]
    spans = [(segment.times[0], segment.times[-1]) for segment in group]
    edges = sorted(set(chain(*spans, *useable)))
    pieces: list[tuple[int, int, int]] = []  # block number, from, to
    for start, stop in pairwise(edges):
        having = [k for k, span in enumerate(spans) if span[0] <= start and stop <= span[1]]
        meant = [k for k in having if useable[k][0] <= start and stop <= useable[k][1]]
        taken = max(meant or having)  # the later one: they come in the order of their first epochs
        if pieces and pieces[-1][0] == taken:
            pieces[-1] = (taken, pieces[-1][1], stop)
        else:
            pieces.append((taken, start, stop))
    run: list[LogEntry] = []
    for k, start, stop in pieces:
        # the attitude at the end of a piece is that of the next
        last_ns = stop if stop == edges[-1] else stop - 1
        piece = _piece(group[k], start, last_ns)
        if run and isinstance(piece[0].event, AttitudeSample):
            piece[0] = LogEntry(piece[0].where, replace(piece[0].event, discontinuity=True))
        run += piece
    return run


def _piece(segment: _DatedBlock, start_ns: int, stop_ns: int) -> list[LogEntry]:
    """The attitudes of a segment from `start_ns` to `stop_ns`; an end where it has none is
    interpolated.
    """
    piece = segment.entries[
        bisect_left(segment.times, start_ns) : bisect_right(segment.times, stop_ns)
    ]
    own_samples = {
        entry.event.t_ns
        for entry in piece[:1] + piece[-1:]
        if isinstance(entry.event, AttitudeSample)
    }
    if start_ns not in own_samples:
        piece.insert(0, segment.at(start_ns))
    if stop_ns not in own_samples and stop_ns > start_ns:
        piece.append(segment.at(stop_ns))
    return piece


def read_aem(text: str, of_date: OfDate) -> LogReading:
    """The attitudes of an AEM's text, each with its place, in the order of the blocks' first
    epochs.

    `of_date` has the frames that move: of a frame's name, a time system and times (n,), ns, it
    gives the rotations (n, 4) from ICRS, the frame's own rate (3,) in its components, and a notice
    or None.

    Raises AemFaultError for anything that is not an AEM of attitudes between a spacecraft's frame
    and one of those above.
    """
    is_xml = text.lstrip().startswith("<")
    if is_xml:
        blocks = ccsds.xml_blocks(text)
    else:
        blocks = ccsds.kvn_blocks(text)
    return read_blocks(blocks, of_date)


def read_blocks(blocks: list[ccsds.Block], of_date: OfDate) -> LogReading:
    """The attitudes of blocks of an AEM, or of another format whose numbers mean what an AEM's
    do, as `read_aem` gives them.
    """
    if len({block.meta["TIME_SYSTEM"] for block in blocks}) > 1:
        raise ccsds.AemFaultError(
            "", "TIME_SYSTEM changes from block to block; write one file for each time system"
        )
    frames = [_frames(block.meta) for block in blocks]
    if len({body for _, body in frames}) > 1:
        raise ccsds.AemFaultError(
            "", "the spacecraft's frame changes from block to block; write one file for each"
        )
    timed = []
    for b in blocks:
        timed.append(
            (
                [
                    ccsds.epoch_ns(where, epoch)
                    for where, epoch in zip(b.where, b.epochs, strict=True)
                ],
                b,
            )
        )
    timed.sort(key=lambda pair: pair[0][0])
    entries: list[LogEntry] = []
    notices: dict[str, str] = {}
    segments = [
        _DatedBlock(block, times, list(_entries(block, times, of_date, notices)))
        for times, block in timed
    ]
    for following in _resolved(segments, notices):
        first = following[0]
        end = entries[-1] if entries else None
        if (
            end is not None
            and isinstance(end.event, AttitudeSample)
            and isinstance(first.event, AttitudeSample)
        ):
            # 504.0-B-1 allows it: the earlier block then ends 1 ns before
            if end.event.t_ns == first.event.t_ns:
                entries[-1] = LogEntry(end.where, replace(end.event, t_ns=end.event.t_ns - 1))
            following[0] = LogEntry(first.where, replace(first.event, discontinuity=True))
        entries += following
    if any(block.meta["ATTITUDE_TYPE"] == ccsds.EULER_RATE for block in blocks):
        notices["aem-rates"] = AMBIGUOUS
    (first_ns, *_), block = timed[0]
    return LogReading(
        entries, _conventions(block, first_ns, of_date), ADVICE, list(notices.items())
    )


def _conventions(block: ccsds.Block, first_ns: int, of_date: OfDate) -> Conventions:
    """What the numbers of a file mean, in the words of its first block; an attitude as that
    block has it at its first epoch.
    """
    meta = block.meta
    (reference, body), scale, to_body = (
        _frames(meta),
        meta["TIME_SYSTEM"],
        _second_frame_is_cam(meta),
    )
    scalar_first = meta.get("QUATERNION_TYPE") == "FIRST"
    names = "QC Q1 Q2 Q3" if scalar_first else "Q1 Q2 Q3 QC"
    first, second = (reference, body) if to_body else (body, reference)
    inertial = reference in INERTIAL_FRAMES

    def written(q: FloatArray) -> str:
        if not inertial:
            q = multiply(
                q, conjugate(of_date(reference, scale, np.array([first_ns], dtype=np.int64))[0][0])
            )
        aem_q = conjugate(q) if to_body else q
        if not scalar_first:
            aem_q = np.roll(aem_q, -1)
        when = "" if inertial else f" at {block.epochs[0]}"
        return f"{names} = {components(aem_q)}{when}"

    if inertial:
        turned = ""
    else:
        turned = f" ({reference} by hilstar: the ICRF, at each epoch)"
    if scale == "UTC":
        leap = "; leap seconds are not counted"
    else:
        leap = ""
    return Conventions(
        "CCSDS AEM",
        f"{meta['ATTITUDE_TYPE']} turns components of {first} into those of {second}{turned}",
        f"quaternions scalar {'first' if scalar_first else 'last'} ({names.replace(' ', ', ')}),"
        " the conjugate of a Hamilton quaternion (504.0-B-2 annex F)",
        f"{scale}, from 1970-01-01T00:00:00 {scale}{leap}",
        of_body=CAMERA_FRAME.fullmatch(body) is None,
        written=written,
        scale=scale,
    )


def _entries(
    block: ccsds.Block, times: list[int], of_date: OfDate, told: dict[str, str]
) -> Iterator[LogEntry]:
    q, rate = _attitudes(block)
    if block.meta["ATTITUDE_TYPE"] == ccsds.SPIN:
        # Only the rate says how often a body spins between attitudes that are more than a quarter
        # turn apart. Below that the attitudes are better: in the standard's own example (ST5)
        # SPIN_ANGLE_VEL is a fifth more than the spin angle turns.
        steps_s = np.diff(np.array(times, dtype=object)).astype(np.float64) / NS_PER_S
        if not (np.abs(block.values[:-1, 3]) * steps_s > QUARTER_TURN_DEG).any():
            rate = None
    reference, _ = _frames(block.meta)
    if reference not in INERTIAL_FRAMES:
        if any(t_ns not in INT64 for t_ns in times):
            raise ccsds.AemFaultError(
                block.where[-1],
                f"the times of the block do not fit 64 bits, so {reference} has no place there",
            )
        q_icrs_to_frame, frame_rate, notice = of_date(
            reference, block.meta["TIME_SYSTEM"], np.array(times, dtype=np.int64)
        )
        if rate is not None:
            with np.errstate(all="ignore"):
                unit = q / np.linalg.norm(q, axis=1, keepdims=True)
                rate = rate + rotate(unit, np.tile(frame_rate, (len(q), 1)))
        q = multiply(q, q_icrs_to_frame)
        if notice is not None:
            told["earth-orientation"] = notice
    rates: Sequence[tuple[float, ...] | None] = [None] * len(q)
    if rate is not None:
        rates = list(map(tuple, rate.tolist()))
    for where, t_ns, numbers, turning in zip(block.where, times, q.tolist(), rates, strict=True):
        yield LogEntry(where, checked_sample(t_ns, tuple(numbers), turning))


def _attitudes(block: ccsds.Block) -> tuple[FloatArray, FloatArray | None]:
    """`q_icrs_to_cam` (n, 4) and, where the type has it, the rate (n, 3) in cam components,
    rad/s.
    """
    meta = block.meta
    kind = block.meta["ATTITUDE_TYPE"]
    to_cam = _second_frame_is_cam(meta)
    with np.errstate(all="ignore"):  # an overflow is refused as not finite
        if kind not in ccsds.QUATERNIONS:
            rate: FloatArray | None
            if kind in ccsds.SPINS:
                q, rate = _spin(block.values, kind)
            else:
                q, rate = _euler(block.values, meta)
            if kind == ccsds.EULER_ANGVEL:
                q = q if to_cam else conjugate(q)
                return q, _rate_in_cam(meta, q, np.radians(block.values[:, 3:]))
            if to_cam:
                return q, rate
            if rate is not None:
                rate = -rotate(conjugate(q), rate)
            return conjugate(q), rate
        q = block.values[:, :4]
        more = block.values[:, 4:]
        if to_cam:
            q = conjugate(q)
        if kind == ccsds.QUATERNION:
            return q, None
        if kind == ccsds.DERIVATIVE:
            q_dot = conjugate(more) if to_cam else more
            return q, -2.0 * multiply(q_dot, conjugate(q))[:, 1:] / (q * q).sum(
                axis=1, keepdims=True
            )
        return q, _rate_in_cam(meta, q, np.radians(more))


def _rate_in_cam(meta: dict[str, str], q: FloatArray, rate: FloatArray) -> FloatArray:
    """The rate (n, 3) of cam in its components, from that of the second frame with respect to
    the first in either's.
    """
    key = "RATE_FRAME" if meta["ATTITUDE_TYPE"] == ccsds.RATE else "ANGVEL_FRAME"
    if "EULER_ROT_SEQ" in meta and meta["ATTITUDE_TYPE"] == ccsds.RATE:
        raise ccsds.AemFaultError(
            "",
            f"{ccsds.RATE} with EULER_ROT_SEQ: rates of Euler angles are not read; write"
            f" {ccsds.DERIVATIVE}",
        )
    a, b, given = meta["REF_FRAME_A"], meta["REF_FRAME_B"], meta.get(key, "missing")
    frame = {"REF_FRAME_A": a, "REF_FRAME_B": b}.get(given, given)
    if frame not in {a, b}:
        raise ccsds.AemFaultError("", f"{key} is {given}; write {a} or {b}")
    rate = rate if _second_frame_is_cam(meta) else -rate
    return rotate(q, rate) / (q * q).sum(axis=1, keepdims=True) if _is_reference(frame) else rate


def _frames(meta: dict[str, str]) -> tuple[str, str]:
    """The frame among the stars (or of a date), and the spacecraft's. Raises AemFaultError."""
    a = meta["REF_FRAME_A"]
    b = meta["REF_FRAME_B"]
    reference, body = (a, b) if _is_reference(a) else (b, a)
    if not _is_reference(reference) or not BODY_FRAME.fullmatch(body):
        wanted = "one must be ICRF, EME2000, MOD, TOD, TEME or ITRF"
        body_wanted = (
            "the other a spacecraft frame (SC_BODY_1, STARTRACKER_1, INSTRUMENT_A, CAM, ...)"
        )
        raise ccsds.AemFaultError(
            "", f"REF_FRAME_A = {a}, REF_FRAME_B = {b}; {wanted}, {body_wanted}"
        )
    return reference, body


def _is_reference(frame: str) -> bool:
    return frame in INERTIAL_FRAMES or OF_DATE_FRAME.fullmatch(frame) is not None


def _second_frame_is_cam(meta: dict[str, str]) -> bool:
    direction = meta.get("ATTITUDE_DIR", "A2B" if meta[ccsds.VERSION_KEY] == "2.0" else "missing")
    if direction not in {"A2B", "B2A"}:
        raise ccsds.AemFaultError("", f"ATTITUDE_DIR is {direction}; write A2B or B2A")
    return _is_reference(meta["REF_FRAME_A"]) == (direction == "A2B")


def aem_text(samples: Sequence[AttitudeSample], xml: bool, scale: str | None = None) -> str:
    """An AEM 1.0 of at least one sample, as KVN or XML: a new block at each discontinuity, ICRF to
    STARTRACKER_1, scalar last.

    A block whose samples all have a rate contains quaternion derivatives; other blocks drop their
    rates. Sequence numbers are dropped.
    """
    starts = [i for i, sample in enumerate(samples) if i == 0 or sample.discontinuity]
    blocks = [samples[i:j] for i, j in zip(starts, [*starts[1:], len(samples)], strict=True)]
    header = {
        "CREATION_DATE": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S"),
        "ORIGINATOR": "HILSTAR",
    }
    time_system = _time_system(samples, scale)
    written = [_written_block(block, time_system) for block in blocks]
    lines = _xml(header, written) if xml else _kvn(header, written)
    return "\n".join(lines) + "\n"


def _time_system(samples: Sequence[AttitudeSample], scale: str | None) -> str:
    """TIME_SYSTEM of times on a scale (None: of a clock that nobody named).

    Times before 2000 of such a clock are no dates: it is then the spacecraft's own, SCLK.
    """
    if scale in SCALES:
        return str(scale)
    if samples[0].t_ns >= FIRST_DATE_NS:
        return "UTC"
    return "SCLK"


def _written_block(samples: Sequence[AttitudeSample], scale: str) -> ccsds.Block:
    rates = [sample.rate_cam_rad_s for sample in samples if sample.rate_cam_rad_s is not None]
    q = np.array([sample.q_icrs_to_cam for sample in samples])
    values = conjugate(q)
    if len(rates) == len(samples):
        q_dot = multiply(np.concatenate((np.zeros((len(q), 1)), np.array(rates)), axis=1), q) / -2.0
        values = np.concatenate((values, conjugate(q_dot)), axis=1)
    epochs = [ccsds.epoch_text(sample.t_ns) for sample in samples]
    meta = {
        "OBJECT_NAME": "UNKNOWN",
        "OBJECT_ID": "UNKNOWN",
        "REF_FRAME_A": "ICRF",
        "REF_FRAME_B": "STARTRACKER_1",
        "ATTITUDE_DIR": "A2B",
        "TIME_SYSTEM": scale,
        "START_TIME": epochs[0],
        "STOP_TIME": epochs[-1],
        "ATTITUDE_TYPE": ccsds.QUATERNION if values.shape[1] == 4 else ccsds.DERIVATIVE,
        "QUATERNION_TYPE": "LAST",
    }
    return ccsds.Block(meta, [], epochs, values + 0.0)  # + 0.0: CCSDS has no -0


def _kvn(header: dict[str, str], segments: list[ccsds.Block]) -> Iterator[str]:
    yield from (
        f"{ccsds.VERSION_KEY:25}= 1.0",
        "",
        *(f"{key:25}= {value}" for key, value in header.items()),
    )
    for segment in segments:
        yield from ("", "META_START", *(f"COMMENT {line}" for line in COMMENTS))
        yield from (f"{key:25}= {value}" for key, value in segment.meta.items())
        yield from ("META_STOP", "", "DATA_START")
        for epoch, values in zip(segment.epochs, segment.values.tolist(), strict=True):
            last = [*values[1:4], values[0], *values[5:], *values[4:5]]
            yield "  ".join([epoch, *map(repr, last)])
        yield "DATA_STOP"


def _xml(header: dict[str, str], segments: list[ccsds.Block]) -> Iterator[str]:
    yield from (
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<aem id="{ccsds.VERSION_KEY}" version="1.0">',
    )
    yield from ("  <header>", *_elements(4, header), "  </header>", "  <body>")
    for segment in segments:
        yield from (
            "    <segment>",
            "      <metadata>",
            *(f"        <COMMENT>{line}</COMMENT>" for line in COMMENTS),
        )
        yield from (*_elements(8, segment.meta), "      </metadata>", "      <data>")
        if segment.meta["ATTITUDE_TYPE"] == ccsds.QUATERNION:
            name = "quaternionState"
        else:
            name = "quaternionDerivative"
        for epoch, values in zip(segment.epochs, segment.values.tolist(), strict=True):
            yield from (
                "        <attitudeState>",
                f"          <{name}>",
                f"            <EPOCH>{epoch}</EPOCH>",
            )
            for kind, ending, q in (
                ("quaternion", "", values[:4]),
                ("quaternionRate", "_DOT", values[4:]),
            ):
                if q:
                    own = {key + ending: repr(value) for key, value in zip(ORDER, q, strict=True)}
                    yield from (
                        f"            <{kind}>",
                        *_elements(14, own),
                        f"            </{kind}>",
                    )
            yield from (f"          </{name}>", "        </attitudeState>")
        yield from ("      </data>", "    </segment>")
    yield from ("  </body>", "</aem>")


def _elements(indent: int, texts: dict[str, str]) -> Iterator[str]:
    return (f"{' ' * indent}<{key}>{text}</{key}>" for key, text in texts.items())


@contextlib.contextmanager
def faults_named(path: Path) -> Iterator[None]:
    """What is wrong in a file as an InputError that names the file and the place."""
    try:
        yield
    except ccsds.AemFaultError as fault:
        raise InputError(f"{path}{fault.where}: {fault}") from fault


@contextlib.contextmanager
def _open(path: Path, stated: Stated) -> Iterator[LogReading]:
    from hilstar.attitude.logs.earth import q_icrs_to_date  # 30 ms

    text = read_text(path, "write a shorter AEM, or CSV or JSON lines", MAX_BYTES)
    with faults_named(path):
        reading = read_aem(text, q_icrs_to_date)
    yield reading


def _refuse_other(path: Path, stated: Stated) -> NoReturn:
    word = LogHead(path, b"").word[:MAX_QUOTED_CHARACTERS]
    raise InputError(
        f"{path}: starts with {word}; of the CCSDS messages, only {ccsds.VERSION_KEY} is read"
    )


def _is_aem(beginning: LogHead) -> bool:
    return beginning.word.startswith(("<", ccsds.VERSION_KEY))


def _is_other(beginning: LogHead) -> bool:
    return beginning.word.startswith("CCSDS_") and not _is_aem(beginning)


def _write(file: IO[bytes], samples: Sequence[AttitudeSample], writing: Writing) -> None:
    file.write(aem_text(samples, writing.ending == ".xml", writing.scale).encode())


log_format = LogFormat(
    "a CCSDS AEM",
    _open,
    listed="CCSDS AEM (KVN or XML)",
    uses=frozenset({"mounting"}),
    begins=_is_aem,
    endings=(".aem", ".kvn", ".xml"),
    write=_write,
)
other_ccsds = LogFormat("a CCSDS message", _refuse_other, begins=_is_other)
