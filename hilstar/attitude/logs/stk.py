"""Attitude files of STK (`.a`), by AGI's description of the format ("Attitude File Format").

1. Whatever its form, an attitude turns from CoordinateAxes to the body. A quaternion is the axis
   and half the angle by which the axes are turned, so hilstar's is its conjugate: in AGI's own
   example of AttitudeTimeQuatAngVels, +6 deg/s about z for 10 s is (0, 0, sin 30, cos 30), scalar
   last.
2. Angular velocities are deg/s of the body with respect to those axes, in the body's components.
3. The three Euler angles (degrees) are successive turns of the axes about the axes of Sequence,
   each about an axis that the turns before it made.
4. The nine numbers of a matrix are its rows; it turns components of the axes into the body's.
5. Times are counted from ScenarioEpoch (UTC), in seconds unless TimeFormat says otherwise.

Hints of interpolation are ignored. What is not in the tables below is refused by name and line:
STK would turn it into another attitude.
"""

import contextlib
import difflib
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from decimal import Decimal
from pathlib import Path

import numpy as np

from hilstar.attitude.logs import aem_blocks as ccsds
from hilstar.attitude.logs.aem import faults_named, read_blocks
from hilstar.attitude.logs.aem_blocks import AemFaultError
from hilstar.attitude.logs.entries import MAX_QUOTED_CHARACTERS, LogReading, Stated
from hilstar.attitude.logs.log_formats import LogFormat
from hilstar.attitude.logs.log_times import ns_of_seconds
from hilstar.attitude.wire.source import Conventions
from hilstar.basics.arrays import FloatArray
from hilstar.basics.reading import read_text
from hilstar.basics.rotation import conjugate, from_matrix

VERSION = "stk.v."
BEGIN, END = "BEGIN ATTITUDE", "END ATTITUDE"
MAX_BYTES = 50_000_000
# Keywords in small letters (STK ignores the case). These change what is read:
READ = (
    "numberofattitudepoints",
    "scenarioepoch",
    "centralbody",
    "coordinateaxes",
    "sequence",
    "timeformat",
)
# and these do not: how STK interpolates, how it reads, and what it says.
IGNORED = (
    "blockingfactor",
    "interpolationorder",
    "interpolationmethod",
    "attitudedeviations",
    "messagelevel",
)
NAMES = {
    name.lower(): name
    for name in (
        "NumberOfAttitudePoints",
        "ScenarioEpoch",
        "CentralBody",
        "CoordinateAxes",
        "Sequence",
        "TimeFormat",
        "BlockingFactor",
        "InterpolationOrder",
        "InterpolationMethod",
        "AttitudeDeviations",
        "MessageLevel",
    )
}
INERTIAL = {"j2000": "EME2000", "icrf": "ICRF"}
OF_EARTH = {
    "inertial": "ICRF",
    "fixed": "ITRF",
    "meanofdate": "MOD",
    "trueofdate": "TOD",
    "temeofdate": "TEME",
}
AXES = INERTIAL | OF_EARTH
# The forms of the data: the type of an AEM whose numbers each has, and how many numbers a row has.
TYPES = {
    "AttitudeTimeQuaternions": ccsds.QUATERNION,
    "AttitudeTimeQuatScalarFirst": ccsds.QUATERNION,
    "AttitudeTimeQuatAngVels": ccsds.ANGVEL,
    "AttitudeTimeEulerAngles": ccsds.EULER,
    "AttitudeTimeDCM": ccsds.QUATERNION,
    "AttitudeTimeDCMAngVels": ccsds.ANGVEL,
}
COUNTS = {
    "AttitudeTimeQuaternions": 4,
    "AttitudeTimeQuatScalarFirst": 4,
    "AttitudeTimeQuatAngVels": 7,
    "AttitudeTimeEulerAngles": 3,
    "AttitudeTimeDCM": 9,
    "AttitudeTimeDCMAngVels": 12,
}
SCALAR_LAST = frozenset({"AttitudeTimeQuaternions", "AttitudeTimeQuatAngVels"})
MATRICES = frozenset({"AttitudeTimeDCM", "AttitudeTimeDCMAngVels"})
FORM_OF = {name.lower(): name for name in TYPES}
# How many seconds the unit of a time is, and the two forms of dates.
SECONDS = {"epsec": 1, "epmin": 60, "ephr": 3600, "epday": 86_400}
DATES = frozenset({"utcg", "iso-ymd", "iso-yd"})
MONTH_NAMES = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
MONTHS = {name: number for number, name in enumerate(MONTH_NAMES, start=1)}
CLOCK = r"(\d{1,2}):(\d{1,2}):(\d{1,2})(\.\d*)?"
GREGORIAN = re.compile(rf"(\d{{1,2}}) ([A-Za-z]{{3}})[a-z]* (\d{{4}}) {CLOCK}", re.ASCII)
DATE_FORM = "write it as 1 Jan 2025 00:00:00.000 or 2025-01-01T00:00:00.000"
NO_DATE = "seconds of the file, no dates: it states no ScenarioEpoch"
MAX_OFF = 1e-3  # of a matrix from one whose rows are unit and square to each other
LAST_TO_FRONT = [3, 0, 1, 2]


@dataclass(slots=True)
class _StkFile:
    """A file as it is read: its keywords, each with its line, the form of its data, its rows."""

    keywords: dict[str, str] = field(default_factory=dict)
    lines: dict[str, str] = field(default_factory=dict)
    form: str = ""
    where: list[str] = field(default_factory=list)
    times: list[str] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)
    has_end: bool = False

    def value(self, name: str, default: str = "") -> str:
        """A keyword's value in small letters, without the quotes that a date may have."""
        return self.keywords.get(name, default).strip('"').lower()


def _values(file: _StkFile) -> FloatArray:
    """The numbers of the rows as an AEM's block has them, scalar first. Raises AemFaultError."""
    values = np.array(file.rows, dtype=np.float64)
    if file.form in MATRICES:
        return np.column_stack((_of_matrices(file, values[:, :9]), values[:, 9:]))
    if file.form in SCALAR_LAST:
        return np.column_stack((values[:, LAST_TO_FRONT], values[:, 4:]))
    return values


def _of_matrices(file: _StkFile, rows: FloatArray) -> FloatArray:
    """The quaternions (n, 4) of matrices by rows (n, 9). Raises AemFaultError for another."""
    matrices = rows.reshape(-1, 3, 3)
    with np.errstate(all="ignore"):  # of numbers that are not finite
        off = np.abs(matrices @ np.swapaxes(matrices, 1, 2) - np.eye(3)).max(axis=(1, 2))
        wrong = ~(off <= MAX_OFF) | ~(np.linalg.det(matrices) > 0)
    if wrong.any():
        where = file.where[int(wrong.argmax())]
        detail = "the nine numbers are no rotation matrix by rows"
        raise AemFaultError(where, f"{detail}; write unit rows, square to each other")
    return np.array([conjugate(from_matrix(matrix)) for matrix in matrices])


@contextlib.contextmanager
def _open(path: Path, stated: Stated) -> Iterator[LogReading]:
    from hilstar.attitude.logs.earth import q_icrs_to_date  # 30 ms

    text = read_text(path, "write a shorter file", MAX_BYTES)
    with faults_named(path):
        file = _parsed(text)
        notices = _cut_to_count(file)
        reading = read_blocks([_block(file)], q_icrs_to_date)
    notices += reading.told
    if "scenarioepoch" not in file.keywords and file.value("timeformat", "epsec") in SECONDS:
        notices.append(("log-times", f"its times are {NO_DATE}"))
    yield replace(reading, conventions=_conventions(reading.conventions, file), told=notices)


def _parsed(text: str) -> _StkFile:
    """The keywords and the rows of a file's text. Raises AemFaultError."""
    file = _StkFile()
    section = "start"
    for number, raw in enumerate(io.StringIO(text, newline=None), start=1):
        where = f":{number}"
        line = raw.split("#", 1)[0].strip()
        if not line or (section == "start" and line.startswith(VERSION)):
            continue
        plain = " ".join(line.upper().split())
        if section == "start":
            if plain != BEGIN:
                detail = f"{line[:40]!r} where BEGIN Attitude belongs"
                raise AemFaultError(where, f"{detail}; only attitude files of STK are read")
            section = "keywords"
        elif plain == END:
            file.has_end = True
            section = "end"
        elif section == "keywords":
            section = _add_keyword(file, where, line)
        elif section == "data":
            _add_row(file, where, line)
        else:
            raise AemFaultError(where, f"{line[:40]!r} after END Attitude; delete it")
    if not file.rows:
        forms = ", ".join(TYPES)
        raise AemFaultError("", f"contains no attitude; write one of {forms}, and rows below it")
    return file


def _add_keyword(file: _StkFile, where: str, line: str) -> str:
    """Take a line before the data; returns the section of the next line."""
    name, *rest = line.split(maxsplit=1)
    key = name.lower()
    if key in FORM_OF and not rest:
        file.form = FORM_OF[key]
        return "data"
    if key.startswith("attitudetime"):
        raise AemFaultError(where, f"{name[:40]} is not read; write one of {', '.join(TYPES)}")
    if key not in READ and key not in IGNORED:
        near = difflib.get_close_matches(key, NAMES, n=1)
        advice = f"read are {', '.join(NAMES.values())}"
        if near:
            advice = f"did you mean {NAMES[near[0]]}?"
        raise AemFaultError(where, f"{name[:40]} is not read; {advice}")
    if key in file.keywords:
        raise AemFaultError(where, f"{name} is there twice; delete one")
    file.keywords[key] = rest[0].strip() if rest else ""
    file.lines[key] = where
    return "keywords"


def _add_row(file: _StkFile, where: str, line: str) -> None:
    count = COUNTS[file.form]
    wanted = f"write a time and {count} numbers for {file.form}"
    fields = line.split()
    # None where the row is too short: a negative end would count from the row's own end.
    time_words = fields[: max(len(fields) - count, 0)]
    quoted = line[:MAX_QUOTED_CHARACTERS]
    # A date may be several words, and a number of seconds is one.
    is_date = file.value("timeformat", "epsec") in DATES
    if not time_words or (len(time_words) > 1 and not is_date):
        raise AemFaultError(where, f"{quoted!r}: {wanted}")
    try:
        file.rows.append([float(word) for word in fields[len(time_words) :]])
    except ValueError:
        raise AemFaultError(where, f"{quoted!r}: {wanted}") from None
    file.times.append(" ".join(time_words))
    file.where.append(where)


def _cut_to_count(file: _StkFile) -> list[tuple[str, str]]:
    """Leave out the rows beyond NumberOfAttitudePoints, as STK does; returns what to tell of it.

    Raises AemFaultError for a file that is cut off.
    """
    count = len(file.rows)
    try:
        stated = int(float(file.value("numberofattitudepoints", str(count))))
    except (ValueError, OverflowError):
        stated = -1
    if stated < 1:
        raise AemFaultError(
            file.lines["numberofattitudepoints"],
            "NumberOfAttitudePoints is no count; write a whole number",
        )
    if count < stated and not file.has_end:
        detail = f"ends after {count} of {stated} attitudes; is it cut off?"
        raise AemFaultError(file.where[-1], detail)
    for rows in (file.where, file.times, file.rows):
        del rows[stated:]
    if count != stated:
        there = f"NumberOfAttitudePoints is {stated}, and {count} are there"
        return [("log-count", f"{there}; {min(count, stated)} are read")]
    if not file.has_end and "numberofattitudepoints" not in file.keywords:
        unsaid = "it has neither END Attitude nor NumberOfAttitudePoints"
        return [("log-cut", f"{unsaid}; whether it is whole cannot be told")]
    return []


def _block(file: _StkFile) -> ccsds.Block:
    """The file as a block of an AEM 2.0. Raises AemFaultError."""
    attitude_type = TYPES[file.form]
    meta = {
        ccsds.VERSION_KEY: "2.0",
        "REF_FRAME_A": _axes(file),
        "REF_FRAME_B": "SC_BODY",
        "TIME_SYSTEM": "UTC",
        "ATTITUDE_TYPE": attitude_type,
        "QUATERNION_TYPE": _scalar_of(file),
        "ANGVEL_FRAME": "SC_BODY",
    }
    if attitude_type == ccsds.EULER:
        meta["EULER_ROT_SEQ"] = _sequence(file)
    return ccsds.Block(meta, file.where, _epochs(file), _values(file))


def _scalar_of(file: _StkFile) -> str:
    """Where the file has the scalar, in the words of an AEM; a block's own values have it first."""
    return "LAST" if file.form in SCALAR_LAST else "FIRST"


def _axes(file: _StkFile) -> str:
    """CoordinateAxes by an AEM's name. Raises AemFaultError."""
    axes = file.value("coordinateaxes")
    body = file.value("centralbody", "earth")
    where = file.lines.get("coordinateaxes", "")
    known = "J2000, ICRF, Inertial, Fixed, MeanOfDate, TrueOfDate or TEMEOfDate"
    if not axes:
        raise AemFaultError("", f"states no CoordinateAxes; write CoordinateAxes and {known}")
    if axes not in AXES:
        raise AemFaultError(
            where,
            f"CoordinateAxes {file.keywords['coordinateaxes'][:40]} are not read; write {known}",
        )
    if body != "earth" and axes not in INERTIAL:
        given = file.keywords["centralbody"][:40]
        detail = f"CoordinateAxes {axes} of CentralBody {given} are not read"
        raise AemFaultError(where, f"{detail}; write J2000 or ICRF")
    return AXES[axes]


def _sequence(file: _StkFile) -> str:
    given = file.value("sequence", "missing")
    try:
        ccsds.sequence({"EULER_ROT_SEQ": given.upper()})
    except AemFaultError:
        raise AemFaultError(
            file.lines.get("sequence", ""),
            f"Sequence is {given[:40]}; write three axes such as 321, no two alike side by side",
        ) from None
    return given


def _epochs(file: _StkFile) -> list[str]:
    """The epochs of the rows, of 1970 where the file has no dates. Raises AemFaultError."""
    unit = file.value("timeformat", "epsec")
    if unit in DATES:
        dates = zip(file.where, file.times, strict=True)
        return [ccsds.epoch_text(_date_ns(where, text)) for where, text in dates]
    if unit not in SECONDS:
        known = "EpSec, EpMin, EpHr, EpDay, UTCG, ISO-YMD or ISO-YD"
        detail = f"TimeFormat {unit[:40]} is not read; write {known}"
        raise AemFaultError(file.lines["timeformat"], detail)
    begin_ns = 0
    if "scenarioepoch" in file.keywords:
        begin_ns = _date_ns(file.lines["scenarioepoch"], file.keywords["scenarioepoch"])
    elif _axes(file) not in INERTIAL.values():
        detail = f"CoordinateAxes {_axes(file)} move, and it states no ScenarioEpoch"
        raise AemFaultError("", f"{detail}; {DATE_FORM}")
    epochs = []
    for where, text in zip(file.where, file.times, strict=True):
        try:
            since_ns = ns_of_seconds(str(Decimal(text) * SECONDS[unit]))
            epochs.append(ccsds.epoch_text(begin_ns + since_ns))
        except (ValueError, ArithmeticError):
            detail = f"the time is {text[:40]!r}; write a number for TimeFormat {unit}"
            raise AemFaultError(where, detail) from None
    return epochs


def _date_ns(where: str, text: str) -> int:
    """Nanoseconds since 1970 of a date in STK's form or the ISO's. Raises AemFaultError."""
    plain = " ".join(text.strip('"').split())
    match = GREGORIAN.fullmatch(plain)
    month = MONTHS.get(match[2].lower(), 0) if match else 0
    if match and month:
        day, _, year, hour, minute, second, fraction = match.groups(default="")
        clock = f"{int(hour):02}:{int(minute):02}:{int(second):02}{fraction.rstrip('.')}"
        plain = f"{year}-{month:02}-{int(day):02}T{clock}"
    try:
        return ccsds.epoch_ns(where, plain)
    except AemFaultError:
        raise AemFaultError(where, f"the date is {text[:40]!r}; {DATE_FORM}") from None


def _conventions(conventions: Conventions, file: _StkFile) -> Conventions:
    """What the numbers mean, in the words of the file."""
    scalar = "scalar first where it has quaternions"
    if file.form in SCALAR_LAST:
        scalar = "scalar last (q1, q2, q3, q4)"
    named = replace(
        conventions,
        source=f"STK attitude file ({file.form})",
        turns=conventions.turns.replace("SC_BODY", "the body"),
        scalar=f"{scalar}, the conjugate of a Hamilton quaternion",
    )
    dated = "scenarioepoch" in file.keywords or file.value("timeformat") in DATES
    if dated:
        return named
    return replace(named, time=NO_DATE, scale=None)


log_format = LogFormat(
    "an STK attitude file",
    _open,
    listed="STK attitude files",
    uses=frozenset({"mounting"}),
    begins=lambda log: log.word.startswith(VERSION),
)
