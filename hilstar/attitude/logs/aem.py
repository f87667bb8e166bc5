"""CCSDS Attitude Ephemeris Messages, 1.0 (CCSDS 504.0-B-1) and 2.0 (504.0-B-2), as KVN or XML.

Rules:
1. One of REF_FRAME_A and REF_FRAME_B is ICRF, GCRF or EME2000, taken as the same axes (EME2000's differ by 23 mas); the
   other is a frame of the spacecraft, and is taken as `cam`. Any other frame is refused.
2. The quaternion of 504.0-B-2 annex F turns components from its first frame into its second; it is the conjugate of
   hilstar's. ATTITUDE_DIR says which frame is first (2.0: always A), QUATERNION_TYPE where the scalar is (2.0: last).
3. A rate is the angular velocity of the second frame with respect to the first.
4. `t_ns` is nanoseconds from 1970-01-01T00:00:00 of the file's own time system; leap seconds are not counted.
5. A second block of data begins with a discontinuity. Interpolation hints and useable spans are ignored.

XML is read by `ccsds-ndm`. KVN is read here: that library (3.1) reads no AEM 2.0 in KVN, and drops lines that it does not
know and a block that is cut off without a word.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from datetime import date, timedelta
from enum import Enum
from functools import lru_cache
from typing import Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.aem_keywords import VERSION_KEY, AemFaultError, fault_of
from hilstar.attitude.logs.aem_xml import read_message
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, checked_sample
from hilstar.rotation import conjugate, multiply
from hilstar.units import NS_PER_S

DAY_NS = 86_400 * NS_PER_S
UNIX_DAY = date(1970, 1, 1).toordinal()

# 504.0-B-2's own examples write J2000 for EME2000; the realisations of the ICRF share its axes to 0.1 mas.
INERTIAL_FRAMES = frozenset({"ICRF", "ICRF1", "ICRF2", "ICRF3", "GCRF", "EME2000", "J2000"})
# SANA's registry of spacecraft body frames, whose names end in a label (SC_BODY_1, INSTRUMENT_A), and CAM.
BODY_FRAME = re.compile(
    "(SC_BODY|STARTRACKER|AST|INSTRUMENT|SENSOR|CAM|CAMERA|ACC|ACTUATOR|CSS|DSS|ESA|GYRO|GYRO_FRAME"
    "|IMU|IMU_FRAME|MTA|RW|SA|TAM)(_.*|[0-9]+)?"
)

QUATERNION, DERIVATIVE, RATE, ANGVEL = "QUATERNION", "QUATERNION/DERIVATIVE", "QUATERNION/RATE", "QUATERNION/ANGVEL"
COMPONENTS = {QUATERNION: 4, DERIVATIVE: 8, RATE: 7, ANGVEL: 7}
# For each version and type: the state's element in the library's tree, and the part of it beside the quaternion.
ELEMENTS = {
    "1.0": {
        QUATERNION: ("quaternion_state", ""),
        DERIVATIVE: ("quaternion_derivative", "quaternion_rate"),
        RATE: ("quaternion_euler_rate", "rotation_rates"),
    },
    "2.0": {
        QUATERNION: ("quaternion_ephemeris", ""),
        DERIVATIVE: ("quaternion_derivative", "quaternion_dot"),
        ANGVEL: ("quaternion_ang_vel", "ang_vel"),
    },
}

EPOCH = re.compile(r"(\d{4}-(?:\d\d-\d\d|\d{3}))T(\d\d):(\d\d):(\d\d)(?:\.(\d+))?Z?", re.ASCII)
MARKERS = {  # the section that a marker ends, and the one that it begins
    "META_START": ("header", "metadata"),
    "META_STOP": ("metadata", "gap before DATA_START"),
    "DATA_START": ("gap before DATA_START", "data"),
    "DATA_STOP": ("data", "header"),
}

Entry = tuple[str, AttitudeSample | Refusal]


@dataclass(frozen=True, slots=True)
class _Block:
    """One block of data: its keywords, and per state where it stands, its epoch, and `values` (n, 4, 7 or 8), scalar first."""

    meta: dict[str, str]
    where: list[str]
    epochs: list[str]
    values: FloatArray


def read_aem(text: str) -> list[Entry]:
    """The attitudes of an AEM's text, each with where it stands, in the order of the blocks' first epochs.

    Raises AemFaultError for anything that is not an AEM of quaternions between a body frame and the ICRF.
    """
    blocks = _xml_blocks(text) if text.lstrip().startswith("<") else _kvn_blocks(text)
    if len({block.meta["TIME_SYSTEM"] for block in blocks}) > 1:
        raise AemFaultError("", "TIME_SYSTEM changes from block to block; write one file for each time system")
    timed = [([epoch_ns(where, epoch) for where, epoch in zip(b.where, b.epochs, strict=True)], b) for b in blocks]
    timed.sort(key=lambda pair: pair[0][0])
    entries: list[Entry] = []
    for times, block in timed:
        following = list(_entries(block, times))
        if entries:
            _part(entries, following)
        entries += following
    return entries


def _part(entries: list[Entry], following: list[Entry]) -> None:
    """Mark the break between two blocks. 504.0-B-1 lets them share an epoch: the earlier then ends 1 ns before it."""
    (end_where, end), (where, first) = entries[-1], following[0]
    if isinstance(end, AttitudeSample) and isinstance(first, AttitudeSample):
        if end.t_ns == first.t_ns:
            entries[-1] = (end_where, replace(end, t_ns=end.t_ns - 1))
        following[0] = (where, replace(first, discontinuity=True))


def _entries(block: _Block, times: list[int]) -> Iterator[Entry]:
    q, rate = _attitudes(block)
    rates: Sequence[list[float] | None] = [None] * len(q) if rate is None else rate.tolist()
    for where, t_ns, components, turning in zip(block.where, times, q.tolist(), rates, strict=True):
        yield where, checked_sample(t_ns, tuple(components), None if turning is None else tuple(turning))


def _attitudes(block: _Block) -> tuple[FloatArray, FloatArray | None]:
    """`q_icrs_to_cam` (n, 4) and, where the type has it, the rate (n, 3) in cam components, rad/s."""
    meta, kind = block.meta, block.meta["ATTITUDE_TYPE"]
    to_cam = _second_frame_is_cam(meta)
    q, more = block.values[:, :4], block.values[:, 4:]
    with np.errstate(all="ignore"):  # what overflows is refused as not finite
        if to_cam:
            q = conjugate(q)
        norm2 = (q * q).sum(axis=1, keepdims=True)
        if kind == QUATERNION:
            return q, None
        if kind == DERIVATIVE:
            q_dot = conjugate(more) if to_cam else more
            return q, -2.0 * multiply(q_dot, conjugate(q))[:, 1:] / norm2
        rate = np.radians(more if to_cam else -more)
        if not _rate_is_in_cam(meta):
            pure = np.concatenate((np.zeros((len(rate), 1)), rate), axis=1)
            rate = multiply(multiply(q, pure), conjugate(q))[:, 1:] / norm2
    return q, rate


def _second_frame_is_cam(meta: dict[str, str]) -> bool:
    a, b = meta["REF_FRAME_A"], meta["REF_FRAME_B"]
    inertial, body = (a, b) if a in INERTIAL_FRAMES else (b, a)
    if inertial not in INERTIAL_FRAMES or not BODY_FRAME.fullmatch(body):
        wanted = (
            "one has to be ICRF or EME2000, the other a spacecraft frame (SC_BODY_1, STARTRACKER_1, INSTRUMENT_A, CAM, ...)"
        )
        raise AemFaultError("", f"REF_FRAME_A = {a}, REF_FRAME_B = {b}; {wanted}")
    direction = meta.get("ATTITUDE_DIR", "A2B" if meta[VERSION_KEY] == "2.0" else "not there")
    if direction not in {"A2B", "B2A"}:
        raise AemFaultError("", f"ATTITUDE_DIR is {direction}; write A2B or B2A")
    return (a in INERTIAL_FRAMES) == (direction == "A2B")


def _rate_is_in_cam(meta: dict[str, str]) -> bool:
    key = "ANGVEL_FRAME" if meta["ATTITUDE_TYPE"] == ANGVEL else "RATE_FRAME"
    if "EULER_ROT_SEQ" in meta:
        raise AemFaultError("", f"{RATE} with EULER_ROT_SEQ: rates of Euler angles are not read; write {DERIVATIVE}")
    a, b, given = meta["REF_FRAME_A"], meta["REF_FRAME_B"], meta.get(key, "not there")
    frame = {"REF_FRAME_A": a, "REF_FRAME_B": b}.get(given, given)
    if frame not in {a, b}:
        raise AemFaultError("", f"{key} is {given}; write {a} or {b}")
    return frame not in INERTIAL_FRAMES


def _checked_meta(meta: dict[str, str], where: str) -> None:
    """Raises AemFaultError for a version or a type that is not read, or a keyword that is not there."""
    version = meta.get(VERSION_KEY, "not there")
    if version not in ELEMENTS:
        raise AemFaultError("", f"{VERSION_KEY} is {version}; 1.0 and 2.0 are read")
    for key in ("REF_FRAME_A", "REF_FRAME_B", "TIME_SYSTEM", "ATTITUDE_TYPE"):
        if key not in meta:
            raise AemFaultError(where, f"{key} is missing in the metadata of a block")
    if meta["ATTITUDE_TYPE"] not in ELEMENTS[version]:
        types = ", ".join(ELEMENTS[version])
        raise AemFaultError(
            where, f"ATTITUDE_TYPE = {meta['ATTITUDE_TYPE']} of AEM {version} is not read; write one of {types}"
        )


def _plain(value: str) -> str:
    """A text value as it is compared: 504.0-B-2 6.8 lets case differ, and blanks stand for underscores."""
    return "_".join(value.upper().replace("_", " ").split())


# Epochs


def epoch_ns(where: str, text: str) -> int:
    """Nanoseconds from 1970-01-01T00:00:00 to an epoch (calendar or day-of-year form), rounded; every day has 86400 s.

    A leap second 23:59:60 is the next day's 00:00:00. Raises AemFaultError.
    """
    match = EPOCH.fullmatch(text)
    day = _day(match[1]) if match else None
    if match is None or day is None or not _is_time(*(int(match[i]) for i in (2, 3, 4))):
        wanted = "YYYY-MM-DDThh:mm:ss.f or YYYY-DDDThh:mm:ss.f is wanted"
        raise AemFaultError(where, f"the epoch is {text[:40]!r}; {wanted}")
    digits = (match[5] or "").ljust(10, "0")
    seconds = 3600 * int(match[2]) + 60 * int(match[3]) + int(match[4])
    return day * DAY_NS + seconds * NS_PER_S + int(digits[:9]) + (digits[9] >= "5")


def _is_time(hours: int, minutes: int, seconds: int) -> bool:
    return hours < 24 and minutes < 60 and (seconds < 60 or (hours, minutes, seconds) == (23, 59, 60))


@lru_cache(maxsize=1024)
def _day(text: str) -> int | None:
    """Days from 1970-01-01 to YYYY-MM-DD or YYYY-DDD, or None when the calendar has no such day."""
    year, first, *second = map(int, text.split("-"))
    try:
        day = date(year, first, second[0]) if second else date(year, 1, 1) + timedelta(days=first - 1)
    except (ValueError, OverflowError):
        return None
    return day.toordinal() - UNIX_DAY if day.year == year else None


def epoch_text(t_ns: int) -> str:
    """The calendar form of `t_ns` with all nine digits; exact for every 64-bit value."""
    day, ns = divmod(t_ns, DAY_NS)
    seconds, ns = divmod(ns, NS_PER_S)
    clock = f"{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}.{ns:09}"
    return f"{date.fromordinal(UNIX_DAY + day).isoformat()}T{clock}"


# Reading


def _kvn_blocks(text: str) -> list[_Block]:
    header: dict[str, str] = {}
    meta: dict[str, str] = {}
    rows: list[tuple[str, list[str]]] = []
    blocks: list[_Block] = []
    section, number = "header", 0
    for number, line in enumerate(map(str.strip, io.StringIO(text, newline=None)), start=1):
        where = f":{number}"
        if not line or line.split(maxsplit=1)[0] == "COMMENT":
            continue
        if line in MARKERS:
            if section != MARKERS[line][0]:
                raise AemFaultError(
                    where, f"{line} in the {section}; META_START, META_STOP, DATA_START, DATA_STOP is the order"
                )
            section = MARKERS[line][1]
            if line == "META_START":
                meta, rows = dict(header), []
            elif line == "DATA_STOP":
                blocks.append(_kvn_block(meta, rows, where))
        elif section == "data":
            rows.append((where, line.split()))
        else:
            key, value = _keyword(line, section, where)
            keywords = header if section == "header" else meta
            if key in keywords:
                raise AemFaultError(where, f"{key} is there twice in the {section}; leave one of them out")
            keywords[key] = value
    if section != "header" or not blocks:
        raise AemFaultError(
            f":{number}", f"the file ends in the {section}, with {len(blocks)} blocks of data whole; is it cut off?"
        )
    return blocks


def _keyword(line: str, section: str, where: str) -> tuple[str, str]:
    key, equals, value = line.partition("=")
    if not equals or section not in {"header", "metadata"}:
        raise AemFaultError(where, f"{line[:40]!r} in the {section}; KEYWORD = value or a marker such as META_START is wanted")
    fault = fault_of(key.strip(), section)
    if fault is not None:
        raise AemFaultError(where, fault)
    return key.strip(), _plain(value)


def _kvn_block(meta: dict[str, str], rows: list[tuple[str, list[str]]], where: str) -> _Block:
    _checked_meta(meta, where)
    if not rows:
        raise AemFaultError(where, "the block holds no attitude")
    count = 1 + COMPONENTS[meta["ATTITUDE_TYPE"]]
    order = meta.get("QUATERNION_TYPE", "LAST" if meta[VERSION_KEY] == "2.0" else "not there")
    if order not in {"FIRST", "LAST"}:
        raise AemFaultError(where, f"QUATERNION_TYPE is {order}; write FIRST or LAST, where the scalar is")
    values = []
    for place, words in rows:
        try:
            if len(words) != count:
                raise ValueError
            values.append([float(word) for word in words[1:]])
        except ValueError:
            wanted = f"an epoch and {count - 1} numbers are wanted for {meta['ATTITUDE_TYPE']}"
            raise AemFaultError(place, f"{' '.join(words)[:80]!r}; {wanted}") from None
    table = np.array(values, dtype=np.float64)
    if order == "LAST":
        table[:, :4] = table[:, [3, 0, 1, 2]]
        if meta["ATTITUDE_TYPE"] == DERIVATIVE:
            table[:, 4:] = table[:, [7, 4, 5, 6]]
    return _Block(meta, [place for place, _ in rows], [words[0] for _, words in rows], table)


def _xml_blocks(text: str) -> list[_Block]:
    message = read_message(text)
    segments = message.body.segment if message.body is not None else []
    if not segments or any(s.metadata is None or s.data is None for s in segments):
        raise AemFaultError("", "a segment has no <metadata> or no <data>, or there is none; is it cut off?")
    return [_xml_block(message.version, segment) for segment in segments]


def _xml_block(version: str, segment: Any) -> _Block:
    given = {field.metadata["name"]: getattr(segment.metadata, field.name) for field in fields(segment.metadata)}
    texts = {key: value.value if isinstance(value, Enum) else value for key, value in given.items()}
    meta = {key: _plain(value) for key, value in texts.items() if isinstance(value, str)} | {VERSION_KEY: version}
    _checked_meta(meta, "")
    element, part = ELEMENTS[version][meta["ATTITUDE_TYPE"]]
    states = [getattr(state, element) for state in segment.data.attitude_state]
    if not states or None in states:
        raise AemFaultError("", f"a state is missing, or is not the {meta['ATTITUDE_TYPE']} that the metadata states")
    values = []
    for state in states:
        q = state.quaternion
        values.append([q.qc, q.q1, q.q2, q.q3, *_xml_part(part, getattr(state, part or "quaternion"))])
    epochs = [state.epoch for state in states]
    return _Block(meta, [f", {epoch[:40]}" for epoch in epochs], epochs, np.array(values, dtype=np.float64))


def _xml_part(part: str, more: Any) -> list[float]:
    match part:
        case "":
            return []
        case "ang_vel":
            return [more.angvel_x.value, more.angvel_y.value, more.angvel_z.value]
        case "rotation_rates":
            axes = sorted((axis.rate.value.upper(), axis.value) for axis in (more.rotation1, more.rotation2, more.rotation3))
            if [name for name, _ in axes] != ["X_RATE", "Y_RATE", "Z_RATE"]:
                raise AemFaultError("", "a state's rates have to be X_RATE, Y_RATE and Z_RATE")
            return [value for _, value in axes]
        case _:
            return [getattr(more, name).value for name in ("qc_dot", "q1_dot", "q2_dot", "q3_dot")]
