"""CCSDS Attitude Ephemeris Messages, 1.0 (CCSDS 504.0-B-1) and 2.0 (504.0-B-2), as KVN or XML.

Rules:
1. One of REF_FRAME_A and REF_FRAME_B is ICRF, GCRF or EME2000, taken as the same axes (EME2000's differ by 23 mas); the
   other is a frame of the spacecraft: a camera's by its name (STARTRACKER_1, INSTRUMENT_A, CAM, ...), else a body's, which
   the mounting makes the camera's. MOD, TOD, TEME and the ITRF are turned to the ICRS at each epoch. Any other is refused.
2. The quaternion of 504.0-B-2 annex F turns components from its first frame into its second; it is the conjugate of
   hilstar's. ATTITUDE_DIR says which frame is first (2.0: always A), QUATERNION_TYPE where the scalar is (2.0: last).
3. A rate is the angular velocity of the second frame with respect to the first. Euler angles and spins: `angles`.
4. `t_ns` is nanoseconds from 1970-01-01T00:00:00 of the file's own time system; leap seconds are not counted.
5. A second block of data begins with a discontinuity; blocks that overlap: `overlaps`. Interpolation hints are ignored.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.aem.angles import euler, rotated, spin
from hilstar.attitude.logs.aem.blocks import (
    DERIVATIVE,
    EULER_ANGVEL,
    EULER_RATE,
    QUATERNION,
    QUATERNIONS,
    RATE,
    SPIN,
    SPINS,
    VERSION_KEY,
    AemFaultError,
    Block,
)
from hilstar.attitude.logs.aem.epochs import epoch_ns
from hilstar.attitude.logs.aem.kvn import kvn_blocks
from hilstar.attitude.logs.aem.overlaps import Segment, resolved
from hilstar.attitude.logs.aem.xml import xml_blocks
from hilstar.attitude.logs.entries import Entry, LogReading
from hilstar.attitude.wire.packet import INT64, AttitudeSample, checked_sample
from hilstar.attitude.wire.source import Conventions, components
from hilstar.rotation import conjugate, multiply
from hilstar.units import NS_PER_S

# 504.0-B-2's own examples write J2000 for EME2000; the realisations of the ICRF share its axes to 0.1 mas.
INERTIAL_FRAMES = frozenset({"ICRF", "ICRF1", "ICRF2", "ICRF3", "GCRF", "EME2000", "J2000"})
# SANA's registry of spacecraft body frames, whose names end in a label (SC_BODY_1, INSTRUMENT_A), and CAM.
CAMERA_FRAME = re.compile("(STARTRACKER|AST|INSTRUMENT|SENSOR|CAM|CAMERA)(_.*|[0-9]+)?")
BODY_FRAME = re.compile(
    "(SC_BODY|ACC|ACTUATOR|CSS|DSS|ESA|GYRO|GYRO_FRAME|IMU|IMU_FRAME|MTA|RW|SA|TAM)(_.*|[0-9]+)?|" + CAMERA_FRAME.pattern
)

OF_DATE_FRAME = re.compile("MOD|TOD|TEME|ITRF-?([0-9]{2}|[0-9]{4})?")
OfDate = Callable[[str, str, npt.NDArray[np.int64]], tuple[FloatArray, FloatArray, str | None]]
AMBIGUOUS = (
    f"{EULER_RATE} of AEM 1.0 does not say whether its rates are those of the angles or an angular velocity; they are not used"
)
QUARTER_TURN_DEG = 90.0
ADVICE = "sort its lines; leap seconds are not counted, so write TAI across one"


def read_aem(text: str, of_date: OfDate) -> LogReading:
    """The attitudes of an AEM's text, each with its place, in the order of the blocks' first epochs.

    `of_date` has the frames that move: from a frame's name, a time system and times (n,), ns, the rotations (n, 4) from ICRS
    the frame's own rate (3,) in its components, and a notice or None.

    Raises AemFaultError for anything that is not an AEM of attitudes between a spacecraft's frame and one of those above.
    """
    blocks = xml_blocks(text) if text.lstrip().startswith("<") else kvn_blocks(text)
    if len({block.meta["TIME_SYSTEM"] for block in blocks}) > 1:
        raise AemFaultError("", "TIME_SYSTEM changes from block to block; write one file for each time system")
    frames = [_frames(block.meta) for block in blocks]
    if len({body for _, body in frames}) > 1:
        raise AemFaultError("", "the spacecraft's frame changes from block to block; write one file for each")
    timed = [([epoch_ns(where, epoch) for where, epoch in zip(b.where, b.epochs, strict=True)], b) for b in blocks]
    timed.sort(key=lambda pair: pair[0][0])
    entries: list[Entry] = []
    told: dict[str, str] = {}
    runs, overlap = resolved([Segment(block, times, list(_entries(block, times, of_date, told))) for times, block in timed])
    if overlap is not None:
        told["aem-overlap"] = overlap
    for following in runs:
        if entries:
            _part(entries, following)
        entries += following
    if any(block.meta["ATTITUDE_TYPE"] == EULER_RATE for block in blocks):
        told["aem-rates"] = AMBIGUOUS
    (first_ns, *_), first = timed[0]
    return LogReading(entries, _conventions(first, first_ns, of_date), ADVICE, list(told.items()))


def _conventions(block: Block, first_ns: int, of_date: OfDate) -> Conventions:
    """What the numbers of a file mean, in the words of its first block; an attitude as that block has it at its first epoch."""
    meta = block.meta
    (reference, body), scale, to_body = _frames(meta), meta["TIME_SYSTEM"], _second_frame_is_cam(meta)
    scalar_first = meta.get("QUATERNION_TYPE") == "FIRST"
    names = "QC Q1 Q2 Q3" if scalar_first else "Q1 Q2 Q3 QC"
    first, second = (reference, body) if to_body else (body, reference)
    inertial = reference in INERTIAL_FRAMES

    def written(q: FloatArray) -> str:
        if not inertial:
            q = multiply(q, conjugate(of_date(reference, scale, np.array([first_ns], dtype=np.int64))[0][0]))
        own = conjugate(q) if to_body else q
        when = "" if inertial else f" at {block.epochs[0]}"
        return f"{names} = {components(own if scalar_first else np.roll(own, -1))}{when}"

    turned = "" if inertial else f" ({reference} by hilstar: the ICRF, at each epoch)"
    leap = "; leap seconds are not counted" if scale == "UTC" else ""
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


def _part(entries: list[Entry], following: list[Entry]) -> None:
    """Mark the break between two blocks. 504.0-B-1 allows them a common epoch: the earlier then ends 1 ns before it."""
    (end_where, end), (where, first) = entries[-1], following[0]
    if isinstance(end, AttitudeSample) and isinstance(first, AttitudeSample):
        if end.t_ns == first.t_ns:
            entries[-1] = Entry(end_where, replace(end, t_ns=end.t_ns - 1))
        following[0] = Entry(where, replace(first, discontinuity=True))


def _entries(block: Block, times: list[int], of_date: OfDate, told: dict[str, str]) -> Iterator[Entry]:
    q, rate = _attitudes(block)
    if block.meta["ATTITUDE_TYPE"] == SPIN and not _alias(block, times):
        rate = None
    reference, _ = _frames(block.meta)
    if reference not in INERTIAL_FRAMES:
        if any(t_ns not in INT64 for t_ns in times):
            raise AemFaultError(
                block.where[-1], f"the times of the block do not fit 64 bits, so {reference} has no place there"
            )
        q_icrs_to_frame, frame_rate, notice = of_date(reference, block.meta["TIME_SYSTEM"], np.array(times, dtype=np.int64))
        q, rate = _from_icrs(q, rate, q_icrs_to_frame, frame_rate)
        if notice is not None:
            told["earth-orientation"] = notice
    rates: Sequence[list[float] | None] = [None] * len(q) if rate is None else rate.tolist()
    for where, t_ns, numbers, turning in zip(block.where, times, q.tolist(), rates, strict=True):
        yield Entry(where, checked_sample(t_ns, tuple(numbers), None if turning is None else tuple(turning)))


def _from_icrs(
    q: FloatArray, rate: FloatArray | None, q_icrs_to_frame: FloatArray, turning_rad_s: FloatArray
) -> tuple[FloatArray, FloatArray | None]:
    """Attitude and rate with respect to the ICRS of those with respect to a frame that moves."""
    with np.errstate(all="ignore"):
        unit = q / np.linalg.norm(q, axis=1, keepdims=True)
        own = rotated(unit, np.tile(turning_rad_s, (len(q), 1)))
    return multiply(q, q_icrs_to_frame), None if rate is None else rate + own


def _alias(block: Block, times: list[int]) -> bool:
    """Whether a spin turns by more than a quarter between its attitudes, so that only its rate tells by how much.

    Where it does not, the attitudes are better: in the standard's own example (ST5) SPIN_ANGLE_VEL is that of a nutating body
    with respect to its nutation, a fifth more than the spin angle turns.
    """
    turned_deg = np.abs(block.values[:-1, 3]) * np.diff(np.array(times, dtype=object)).astype(np.float64) / NS_PER_S
    return bool((turned_deg > QUARTER_TURN_DEG).any())


def _attitudes(block: Block) -> tuple[FloatArray, FloatArray | None]:
    """`q_icrs_to_cam` (n, 4) and, where the type has it, the rate (n, 3) in cam components, rad/s."""
    meta, kind = block.meta, block.meta["ATTITUDE_TYPE"]
    to_cam = _second_frame_is_cam(meta)
    with np.errstate(all="ignore"):  # an overflow is refused as not finite
        if kind not in QUATERNIONS:
            q, rate = spin(block.values, kind) if kind in SPINS else euler(block.values, meta)
            if kind == EULER_ANGVEL:
                q = q if to_cam else conjugate(q)
                return q, _rate_in_cam(meta, q, np.ones((len(q), 1)), np.radians(block.values[:, 3:]))
            return (q, rate) if to_cam else (conjugate(q), None if rate is None else -rotated(conjugate(q), rate))
        q, more = block.values[:, :4], block.values[:, 4:]
        if to_cam:
            q = conjugate(q)
        norm2 = (q * q).sum(axis=1, keepdims=True)
        if kind == QUATERNION:
            return q, None
        if kind == DERIVATIVE:
            q_dot = conjugate(more) if to_cam else more
            return q, -2.0 * multiply(q_dot, conjugate(q))[:, 1:] / norm2
        return q, _rate_in_cam(meta, q, norm2, np.radians(more))


def _rate_in_cam(meta: dict[str, str], q: FloatArray, norm2: FloatArray, rate: FloatArray) -> FloatArray:
    """The rate (n, 3) of cam in its components, of the second frame's with respect to the first, in either frame's."""
    if not _second_frame_is_cam(meta):
        rate = -rate
    return rate if _rate_is_in_cam(meta) else rotated(q, rate) / norm2


def _frames(meta: dict[str, str]) -> tuple[str, str]:
    """The frame among the stars (or of a date), and the spacecraft's. Raises AemFaultError."""
    a, b = meta["REF_FRAME_A"], meta["REF_FRAME_B"]
    reference, body = (a, b) if _is_reference(a) else (b, a)
    if not _is_reference(reference) or not BODY_FRAME.fullmatch(body):
        wanted = "one must be ICRF, EME2000, MOD, TOD, TEME or ITRF"
        body_wanted = "the other a spacecraft frame (SC_BODY_1, STARTRACKER_1, INSTRUMENT_A, CAM, ...)"
        raise AemFaultError("", f"REF_FRAME_A = {a}, REF_FRAME_B = {b}; {wanted}, {body_wanted}")
    return reference, body


def _is_reference(frame: str) -> bool:
    return frame in INERTIAL_FRAMES or OF_DATE_FRAME.fullmatch(frame) is not None


def _second_frame_is_cam(meta: dict[str, str]) -> bool:
    direction = meta.get("ATTITUDE_DIR", "A2B" if meta[VERSION_KEY] == "2.0" else "missing")
    if direction not in {"A2B", "B2A"}:
        raise AemFaultError("", f"ATTITUDE_DIR is {direction}; write A2B or B2A")
    return _is_reference(meta["REF_FRAME_A"]) == (direction == "A2B")


def _rate_is_in_cam(meta: dict[str, str]) -> bool:
    key = "RATE_FRAME" if meta["ATTITUDE_TYPE"] == RATE else "ANGVEL_FRAME"
    if "EULER_ROT_SEQ" in meta and meta["ATTITUDE_TYPE"] == RATE:
        raise AemFaultError("", f"{RATE} with EULER_ROT_SEQ: rates of Euler angles are not read; write {DERIVATIVE}")
    a, b, given = meta["REF_FRAME_A"], meta["REF_FRAME_B"], meta.get(key, "missing")
    frame = {"REF_FRAME_A": a, "REF_FRAME_B": b}.get(given, given)
    if frame not in {a, b}:
        raise AemFaultError("", f"{key} is {given}; write {a} or {b}")
    return not _is_reference(frame)
