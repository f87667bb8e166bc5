"""CNES's CIC AEM, the attitude files of VTS and of the tools around it: CIC_AEM_VERS = 1.0 or 2.0.

The keywords are those of a CCSDS AEM 1.0. Four things differ or need care (files of CNES's tools
describe their columns in a comment: "days (MJD), sec (UTC), q0 (real part), q1, q2, q3"):
1. No marker begins or ends the data, which follow META_STOP.
2. A time is two columns, the modified Julian day (from 1858-11-17) and the seconds of that day, on
   TIME_SYSTEM. An epoch in one column, as the CCSDS writes it, is read too.
3. The real part of a quaternion comes first. Of the writers that state QUATERNION_TYPE = LAST,
   some put it first all the same and others put it last. Such a file is read only where a comment
   of its metadata names the order ("q1, q2, q3, q0 (real part)"), and in that order.
4. The quaternion is the AEM's: with A2B, its axis and angle turn the axes of REF_FRAME_A onto those
   of REF_FRAME_B, so hilstar's is its conjugate.
"""

import contextlib
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hilstar.attitude.logs import aem_blocks as ccsds
from hilstar.attitude.logs.aem import faults_named, read_blocks
from hilstar.attitude.logs.aem_blocks import AemFaultError
from hilstar.attitude.logs.entries import MAX_QUOTED_CHARACTERS, LogReading, Stated
from hilstar.attitude.logs.log_formats import LogFormat, LogHead
from hilstar.attitude.logs.log_times import ns_of_seconds
from hilstar.basics.reading import read_text
from hilstar.basics.units import NS_PER_S

VERSION_KEY = "CIC_AEM_VERS"
VERSIONS = frozenset({"1.0", "2.0"})
HEADER = frozenset({VERSION_KEY, "CREATION_DATE", "ORIGINATOR"})
METADATA = frozenset(ccsds.METADATA)
MARKERS = {"META_START": "metadata", "META_STOP": "data"}  # the section that each marker begins
FREE_KEYS = "USER_DEFINED_"  # keywords that begin so say nothing of the attitude
MAX_BYTES = 50_000_000
UNIX_MJD = 40_587  # the modified Julian day of 1970-01-01
# From Sputnik's launch (1957-10-04) to the end of 2099. A smaller number is a day from 1950, as
# CNES's own Julian days are.
DAYS = range(36_115, 88_069)
DAY_SECONDS = 86_401  # of a day with a leap second
FORM = "write the modified Julian day, its seconds and the quaternion, the real part first"
UNNAMED_BODY = "UNDEFINED"  # what some writers put where the spacecraft's frame belongs
# Match a comment that names the columns with the real part first, or last.
REAL_FIRST = re.compile(r"\bq0\b.*\bq1\b", re.IGNORECASE)
REAL_LAST = re.compile(r"\bq1\b.*\bq2\b.*\bq3\b.*\b(?:q0|q4|qc|qs|qw)\b", re.IGNORECASE)
FIRST, LAST = "FIRST", "LAST"
LAST_TO_FRONT = [3, 0, 1, 2]
NAMED_FIRST, NAMED_LAST = "COMMENT q0 (real part), q1, q2, q3", "COMMENT q1, q2, q3, q0 (real part)"


@dataclass(slots=True)
class _CicSegment:
    """One segment of the file: its keywords `meta` and their `lines` in the file (":12"), and for
    each row of data its place `where`, its epoch and its four numbers in the file's order.
    """

    meta: dict[str, str]
    lines: dict[str, str] = field(default_factory=dict)
    where: list[str] = field(default_factory=list)
    epochs: list[str] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)
    # FIRST or LAST, as a comment says where the real part is; "" without such a comment
    named_order: str = ""


@contextlib.contextmanager
def _open(path: Path, stated: Stated) -> Iterator[LogReading]:
    from hilstar.attitude.logs.earth import q_icrs_to_date  # takes 30 ms, which other logs save

    text = read_text(path, "write a shorter file", MAX_BYTES)
    notices: list[tuple[str, str]] = []
    with faults_named(path):
        blocks = [_block(segment, notices) for segment in _segments(text)]
        reading = read_blocks(blocks, q_icrs_to_date)
    conventions = replace(
        reading.conventions,
        source="CIC AEM (CNES, VTS)",
        scalar="scalar first (q0, q1, q2, q3), the conjugate of a Hamilton quaternion",
    )
    yield replace(reading, conventions=conventions, told=[*notices, *reading.told])


class _CicReading:
    """Reads a file's lines one by one; `segments` are the segments that have begun so far."""

    def __init__(self) -> None:
        self.segments: list[_CicSegment] = []
        self.section = "header"
        self._header: dict[str, str] = {}

    def take(self, where: str, line: str) -> None:
        """Read a line that is not empty; `where` is its place (":12"). Raises AemFaultError for a
        line that does not belong there.
        """
        if line.startswith("COMMENT"):
            self._comment(line)
        elif line in MARKERS:
            self._marker(where, line)
        elif self.section == "header":
            key, value = _keyword(line, HEADER, where)
            self._header[key] = value
        elif self.section == "metadata":
            _add_keyword(self.segments[-1], where, line)
        else:
            _add_row(self.segments[-1], where, line.split())

    def _comment(self, line: str) -> None:
        if not self.segments:
            return
        if REAL_FIRST.search(line):
            self.segments[-1].named_order = FIRST
        elif REAL_LAST.search(line):
            self.segments[-1].named_order = LAST

    def _marker(self, where: str, line: str) -> None:
        begins = line == "META_START"
        if begins == (self.section == "metadata"):
            detail = f"{line} in the {self.section}; META_START and META_STOP take turns"
            raise AemFaultError(where, detail)
        if begins:
            _check_header(self._header)
            self.segments.append(_CicSegment({}))
        else:
            # Checked before the rows are read, so that a file of Euler angles is refused for its
            # ATTITUDE_TYPE, not for how many numbers its rows have.
            _check_metadata(self.segments[-1])
        self.section = MARKERS[line]


def _segments(text: str) -> list[_CicSegment]:
    """The segments of a file's text. Raises AemFaultError for a line that does not belong where it
    stands, and for a text that is cut off.
    """
    reading = _CicReading()
    number = 0
    for number, raw in enumerate(io.StringIO(text, newline=None), start=1):
        line = raw.strip()
        if line:
            reading.take(f":{number}", line)
    if reading.section != "data":
        raise AemFaultError(f":{number}", f"the file ends in its {reading.section}; is it cut off?")
    return reading.segments


def _check_header(header: dict[str, str]) -> None:
    version = header.get(VERSION_KEY, "missing")
    if version not in VERSIONS:
        raise AemFaultError("", f"{VERSION_KEY} is {version[:40]}; write 1.0 or 2.0")


def _check_metadata(segment: _CicSegment) -> None:
    meta = segment.meta
    end = segment.lines.get("ATTITUDE_TYPE", "")
    for key in ("REF_FRAME_A", "REF_FRAME_B", "ATTITUDE_DIR", "TIME_SYSTEM", "ATTITUDE_TYPE"):
        if key not in meta:
            raise AemFaultError(end, f"{key} is missing in the metadata")
    if meta["ATTITUDE_TYPE"] != ccsds.QUATERNION:
        given = meta["ATTITUDE_TYPE"][:40]
        detail = f"ATTITUDE_TYPE = {given} of a CIC AEM is not read"
        raise AemFaultError(end, f"{detail}; write {ccsds.QUATERNION}")


def _keyword(line: str, known: frozenset[str], where: str) -> tuple[str, str]:
    key, equals, value = line.partition("=")
    key = key.strip()
    if not equals:
        quoted = line[:MAX_QUOTED_CHARACTERS]
        raise AemFaultError(
            where,
            f"{quoted!r} where a keyword belongs; write KEYWORD = value, or META_STOP before data",
        )
    if key not in known and not key.startswith(FREE_KEYS):
        advice = f"the keywords are {', '.join(sorted(known))}"
        raise AemFaultError(where, f"{key[:40]} is no keyword that is read here; {advice}")
    return key, ccsds.plain(value)


def _add_keyword(segment: _CicSegment, where: str, line: str) -> None:
    key, value = _keyword(line, METADATA, where)
    if key in segment.meta:
        raise AemFaultError(where, f"{key} appears twice; delete one")
    segment.meta[key] = value
    segment.lines[key] = where


def _add_row(segment: _CicSegment, where: str, words: list[str]) -> None:
    times = 1 if "T" in words[0] else 2
    quoted = " ".join(words)[:MAX_QUOTED_CHARACTERS]
    if len(words) != times + 4:
        raise AemFaultError(where, f"{quoted!r} has {len(words)} numbers; {FORM}")
    try:
        if times == 1:
            epoch = words[0]
        else:
            epoch = _epoch(where, *words[:2])
        numbers = [float(word) for word in words[times:]]
    except (ValueError, ArithmeticError):
        raise AemFaultError(where, f"{quoted!r}; {FORM}") from None
    segment.where.append(where)
    segment.epochs.append(epoch)
    segment.rows.append(numbers)


def _epoch(where: str, day_text: str, seconds_text: str) -> str:
    """The epoch, as CCSDS text, of a modified Julian day and the seconds of that day. Raises
    AemFaultError for a day or seconds out of range, ValueError or ArithmeticError for no numbers.
    """
    day = float(day_text)
    if not day.is_integer():
        raise AemFaultError(where, f"the day {day_text[:40]} is no whole number; {FORM}")
    if int(day) not in DAYS:
        span = f"from {DAYS.start} (1957) to {DAYS.stop - 1} (2099)"
        wrong = f"the day {day_text[:40]} is no modified Julian day {span}"
        raise AemFaultError(where, f"{wrong}; days from 1950, as CNES counts, are 33282 fewer")
    ns = ns_of_seconds(seconds_text)
    if not 0 <= ns < DAY_SECONDS * NS_PER_S:
        raise AemFaultError(where, f"{seconds_text[:40]} are no seconds of a day; {FORM}")
    return ccsds.epoch_text((int(day) - UNIX_MJD) * ccsds.DAY_NS + ns)


def _block(segment: _CicSegment, told: list[tuple[str, str]]) -> ccsds.Block:
    """The segment as a block of an AEM 1.0 with the scalar first; notices are appended to `told`.
    Raises AemFaultError for a segment without rows, or whose order is unclear.
    """
    meta = dict(segment.meta)
    if not segment.rows:
        end = segment.lines["ATTITUDE_TYPE"]
        raise AemFaultError(end, "the segment contains no attitude")
    order = _order(segment)
    for key in ("REF_FRAME_A", "REF_FRAME_B"):
        if meta[key] == UNNAMED_BODY:
            meta[key] = "SC_BODY"
            told.append(("log-frame", f"{key} = {UNNAMED_BODY} is taken as the spacecraft's body"))
    meta |= {ccsds.VERSION_KEY: "1.0", "QUATERNION_TYPE": FIRST}
    values = np.array(segment.rows, dtype=np.float64)
    if order == LAST:
        values = values[:, LAST_TO_FRONT]
        told.append(("log-order-of-q", "the real part is the last of four, as its comment says"))
    return ccsds.Block(meta, segment.where, segment.epochs, values)


def _order(segment: _CicSegment) -> str:
    """Where the real part is: FIRST or LAST. Raises AemFaultError where the keyword and the
    comments leave that unclear or contradict each other.
    """
    stated = segment.meta.get("QUATERNION_TYPE", "")
    named = segment.named_order
    if stated in ("", FIRST) and named != LAST:
        return FIRST
    where = segment.lines.get("QUATERNION_TYPE", "")
    if stated not in ("", FIRST, LAST):
        raise AemFaultError(where, f"QUATERNION_TYPE = {stated[:40]}; write FIRST or LAST")
    if stated == FIRST:
        detail = "QUATERNION_TYPE = FIRST, and a comment has the real part last"
        raise AemFaultError(where, f"{detail}; leave the one that is wrong out")
    if not named:
        raise AemFaultError(
            where,
            "QUATERNION_TYPE = LAST, where CIC has the real part first and writers differ; add"
            f" what its columns are: {NAMED_LAST}, or {NAMED_FIRST}",
        )
    return named


def _begins(beginning: LogHead) -> bool:
    return beginning.word.startswith(VERSION_KEY)


log_format = LogFormat(
    "a CIC AEM",
    _open,
    listed="CIC AEM (CNES, VTS)",
    uses=frozenset({"mounting"}),
    begins=_begins,
)
