"""Reads the text of a CCSDS Attitude Ephemeris Message (AEM), 1.0 (504.0-B-1) or 2.0 (504.0-B-2),
in KVN or XML, into blocks of numbers.

An unknown keyword is refused, and so is a keyword of the other version: ignoring QUATERNION_TYP, or
QUATERNION_TYPE in a version 2.0 file, would show another orientation than the writer meant. A file
that is cut off is refused.

XML is read by Python's expat parser, element by element. A DOCTYPE is refused where it begins, so
that no entity is expanded and nothing outside the text is read. The depth, the number and the
length of elements are limited, and of each state only the numbers are stored.
"""

import difflib
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import date, timedelta
from functools import cache, lru_cache
from xml.parsers import expat

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import NS_PER_S

VERSION_KEY = "CCSDS_AEM_VERS"
HEADER = (VERSION_KEY, "CLASSIFICATION", "CREATION_DATE", "ORIGINATOR", "MESSAGE_ID")
METADATA = (
    *(
        "OBJECT_NAME",
        "OBJECT_ID",
        "CENTER_NAME",
        "REF_FRAME_A",
        "REF_FRAME_B",
        "ATTITUDE_DIR",
        "TIME_SYSTEM",
    ),
    *(
        "START_TIME",
        "USEABLE_START_TIME",
        "USEABLE_STOP_TIME",
        "STOP_TIME",
        "ATTITUDE_TYPE",
        "QUATERNION_TYPE",
    ),
    *(
        "EULER_ROT_SEQ",
        "RATE_FRAME",
        "ANGVEL_FRAME",
        "INTERPOLATION_METHOD",
        "INTERPOLATION_DEGREE",
    ),
)
SECTIONS = {"header": HEADER, "metadata": METADATA}
# Keywords that only one version has (504.0-B-2 annex J): that version, and what the other version
# has in their place.
ONLY_IN = {
    "ATTITUDE_DIR": ("1.0", "2.0 always turns from REF_FRAME_A to REF_FRAME_B"),
    "QUATERNION_TYPE": ("1.0", "2.0 always has the scalar last"),
    "RATE_FRAME": ("1.0", "2.0 has ANGVEL_FRAME"),
    "ANGVEL_FRAME": ("2.0", "1.0 has RATE_FRAME"),
}

QUATERNION, DERIVATIVE, RATE, ANGVEL = (
    "QUATERNION",
    "QUATERNION/DERIVATIVE",
    "QUATERNION/RATE",
    "QUATERNION/ANGVEL",
)
EULER, EULER_RATE = "EULER_ANGLE", "EULER_ANGLE/RATE"
EULER_DERIVATIVE, EULER_ANGVEL = "EULER_ANGLE/DERIVATIVE", "EULER_ANGLE/ANGVEL"
SPIN, SPIN_NUTATION, SPIN_NUTATION_MOM = "SPIN", "SPIN/NUTATION", "SPIN/NUTATION_MOM"
QUATERNIONS = frozenset({QUATERNION, DERIVATIVE, RATE, ANGVEL})
SPINS = frozenset({SPIN, SPIN_NUTATION, SPIN_NUTATION_MOM})
AXES = {"1": 0, "2": 1, "3": 2, "X": 0, "Y": 1, "Z": 2}
DAY_NS = 86_400 * NS_PER_S
UNIX_DAY = date(1970, 1, 1).toordinal()
# Only 23:59 has a second 60, the leap second.
EPOCH = re.compile(
    r"(\d{4}-(?:\d\d-\d\d|\d{3}))T([01]\d|2[0-3]):([0-5]\d):([0-5]\d|(?<=23:59:)60)(?:\.(\d+))?Z?",
    re.ASCII,
)
MARKERS = {  # the section that each marker ends, and the one that it begins
    "META_START": ("header", "metadata"),
    "META_STOP": ("metadata", "gap before DATA_START"),
    "DATA_START": ("gap before DATA_START", "data"),
    "DATA_STOP": ("data", "header"),
}
MAX_DEPTH = 12  # a number in an <ndm> is nine elements deep
# at one time: of the message outside the states that have been read, and in the present state
MAX_ELEMENTS = 100_000
LONG_ELEMENT = re.compile("<[^<]{1000000}")

# For each version and ATTITUDE_TYPE: a state's element in XML, and the paths in it of its numbers,
# in the order of KVN with the quaternion's scalar first.
Q = "quaternion/QC quaternion/Q1 quaternion/Q2 quaternion/Q3"
Q_RATE = " quaternionRate/QC_DOT quaternionRate/Q1_DOT quaternionRate/Q2_DOT quaternionRate/Q3_DOT"
TURNS = "rotationAngles/rotation1 rotationAngles/rotation2 rotationAngles/rotation3"
ANGLES = "ANGLE_1 ANGLE_2 ANGLE_3"
SPIN_PARTS = "SPIN_ALPHA SPIN_DELTA SPIN_ANGLE SPIN_ANGLE_VEL"
SPIN_STATES = {
    SPIN: ("spin", SPIN_PARTS),
    SPIN_NUTATION: ("spinNutation", f"{SPIN_PARTS} NUTATION NUTATION_PER NUTATION_PHASE"),
}
STATES = {
    "1.0": {
        QUATERNION: ("quaternionState", Q),
        DERIVATIVE: ("quaternionDerivative", Q + Q_RATE),
        RATE: (
            "quaternionEulerRate",
            f"{Q} rotationRates/X_RATE rotationRates/Y_RATE rotationRates/Z_RATE",
        ),
        EULER: ("eulerAngle", TURNS),
        EULER_RATE: (
            "eulerAngleRate",
            f"{TURNS} {TURNS.replace('rotationAngles', 'rotationRates')}",
        ),
        **SPIN_STATES,
    },
    "2.0": {
        QUATERNION: ("quaternionEphemeris", Q),
        DERIVATIVE: ("quaternionDerivative", Q + Q_RATE.replace("quaternionRate", "quaternionDot")),
        ANGVEL: ("quaternionAngVel", f"{Q} angVel/ANGVEL_X angVel/ANGVEL_Y angVel/ANGVEL_Z"),
        EULER: ("eulerAngle", ANGLES),
        EULER_DERIVATIVE: ("eulerAngleDerivative", f"{ANGLES} ANGLE_1_DOT ANGLE_2_DOT ANGLE_3_DOT"),
        EULER_ANGVEL: ("eulerAngleAngVel", f"{ANGLES} ANGVEL_X ANGVEL_Y ANGVEL_Z"),
        **SPIN_STATES,
        SPIN_NUTATION_MOM: (
            "spinNutationMom",
            f"{SPIN_PARTS} MOMENTUM_ALPHA MOMENTUM_DELTA NUTATION_VEL",
        ),
    },
}


class AemFaultError(Exception):
    """What is wrong in an AEM, and `where`, to append to the file's name: a line (":12"), an epoch
    (", 2024-01-01T00:00:00") or "" for the file as a whole.
    """

    def __init__(self, where: str, detail: str) -> None:
        super().__init__(detail)
        self.where = where


@dataclass(frozen=True, slots=True)
class Block:
    """One block of data: its keywords `meta`, those of the header among them; the place `where` and
    the epoch of each of its n states; and their `values` (n, numbers) in the order of KVN, the
    quaternion's scalar first, in the file's units.
    """

    meta: dict[str, str]
    where: list[str]
    epochs: list[str]
    values: FloatArray


def _fault_of(key: str, section: str, version: str) -> str | None:
    """Why a keyword (other than COMMENT) is not allowed in a section ("header" or "metadata") of
    an AEM of this version, and what to write; None where it is allowed.
    """
    if key in SECTIONS[section]:
        own, instead = ONLY_IN.get(key, (version, ""))
        if own == version or version not in STATES:
            return None
        return (
            f"{key} is of AEM {own}, and {VERSION_KEY} is {version}; {instead}: delete it, or write"
            f" {VERSION_KEY} = {own}"
        )
    other = "metadata" if section == "header" else "header"
    if key in SECTIONS[other]:
        return f"{key} is in the {section}; it belongs in the {other}"
    near = difflib.get_close_matches(key.upper()[:40], SECTIONS[section], n=1)
    if near:
        advice = f"did you mean {near[0]}?"
    else:
        advice = f"the keywords are {', '.join(SECTIONS[section])}"
    return f"{key[:40]} is not a keyword of an AEM's {section}; {advice}"


def _check_version(version: str) -> None:
    if version not in STATES:
        raise AemFaultError("", f"{VERSION_KEY} is {version[:40]}; write 1.0 or 2.0")


def _check_metadata(meta: dict[str, str], where: str) -> None:
    """Check the keywords of a block. Raises AemFaultError for a version or ATTITUDE_TYPE that is
    not supported, a missing keyword, and a QUATERNION_TYPE other than FIRST or LAST.
    """
    version = meta.get(VERSION_KEY, "missing")
    _check_version(version)
    for key in ("REF_FRAME_A", "REF_FRAME_B", "TIME_SYSTEM", "ATTITUDE_TYPE"):
        if key not in meta:
            raise AemFaultError(where, f"{key} is missing in the metadata of a block")
    order = meta.get("QUATERNION_TYPE", "LAST")
    if order not in {"FIRST", "LAST"}:
        raise AemFaultError(
            where, f"QUATERNION_TYPE is {order[:40]}; write FIRST or LAST, where the scalar is"
        )
    if meta["ATTITUDE_TYPE"] not in STATES[version]:
        types = ", ".join(STATES[version])
        raise AemFaultError(
            where,
            f"ATTITUDE_TYPE = {meta['ATTITUDE_TYPE'][:40]} of AEM {version} is not read; write one"
            f" of {types}",
        )


def plain(value: str) -> str:
    """A text value in capitals, with single underscores for blanks, to be compared: 504.0-B-2 6.8
    ignores case and treats underscores as blanks.
    """
    return "_".join(value.upper().replace("_", " ").split())


def sequence(meta: dict[str, str]) -> tuple[int, int, int]:
    """The three axes (0, 1, 2 for X, Y, Z) of EULER_ROT_SEQ, such as 321 or ZYX. Raises
    AemFaultError for other text, and for an axis twice in a row.
    """
    text = meta.get("EULER_ROT_SEQ", "missing")
    axes = [AXES.get(letter, -1) for letter in text]
    if len(axes) != 3 or -1 in axes or axes[0] == axes[1] or axes[1] == axes[2]:
        raise AemFaultError(
            "",
            f"EULER_ROT_SEQ is {text[:40]}; write three axes such as 321 or ZYX, no two alike side"
            " by side",
        )
    return axes[0], axes[1], axes[2]


def epoch_ns(where: str, text: str) -> int:
    """The time of an epoch (calendar or day-of-year form), ns since 1970-01-01T00:00:00 on the
    file's own time scale, rounded, with 86400 s in every day.

    A leap second 23:59:60 is the next day's 00:00:00. Raises AemFaultError, at `where`, for text
    that is no epoch.
    """
    match = EPOCH.fullmatch(text)
    day = _day(match[1]) if match else None
    if match is None or day is None:
        raise AemFaultError(
            where, f"the epoch is {text[:40]!r}; write YYYY-MM-DDThh:mm:ss.f or YYYY-DDDThh:mm:ss.f"
        )
    digits = (match[5] or "").ljust(10, "0")
    seconds = 3600 * int(match[2]) + 60 * int(match[3]) + int(match[4])
    return day * DAY_NS + seconds * NS_PER_S + int(digits[:9]) + (digits[9] >= "5")


@lru_cache(maxsize=1024)
def _day(text: str) -> int | None:
    """The days from 1970-01-01 to YYYY-MM-DD or YYYY-DDD; None where the calendar has no such
    day.
    """
    year, first, *second = map(int, text.split("-"))
    try:
        if second:
            day = date(year, first, second[0])
        else:
            day = date(year, 1, 1) + timedelta(days=first - 1)
    except (ValueError, OverflowError):
        return None
    if day.year == year:
        return day.toordinal() - UNIX_DAY
    return None


def epoch_text(t_ns: int) -> str:
    """The epoch, in calendar form with nine decimals of a second, of a time in ns since
    1970-01-01T00:00:00 (days of 86400 s); exact for every 64-bit value.
    """
    day, ns = divmod(t_ns, DAY_NS)
    seconds, ns = divmod(ns, NS_PER_S)
    clock = f"{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}.{ns:09}"
    return f"{date.fromordinal(UNIX_DAY + day).isoformat()}T{clock}"


def kvn_blocks(text: str) -> list[Block]:
    """The blocks of an AEM's text in KVN. Raises AemFaultError for text that is no such AEM, or is
    cut off.
    """
    header: dict[str, str] = {}
    meta: dict[str, str] = {}
    rows: list[tuple[str, list[str]]] = []
    blocks: list[Block] = []
    section = "header"
    number = 0
    for number, line in enumerate(map(str.strip, io.StringIO(text, newline=None)), start=1):
        where = f":{number}"
        if not line or line.split(maxsplit=1)[0] == "COMMENT":
            continue
        if line in MARKERS:
            if section != MARKERS[line][0]:
                raise AemFaultError(
                    where,
                    f"{line} in the {section}; the order is META_START, META_STOP, DATA_START,"
                    " DATA_STOP",
                )
            section = MARKERS[line][1]
            if line == "META_START":
                meta = dict(header)
                rows = []
            elif line == "DATA_STOP":
                blocks.append(_kvn_block(meta, rows, where))
        elif section == "data":
            rows.append((where, line.split()))
        else:
            key, value = _keyword(line, section, header.get(VERSION_KEY, ""), where)
            keywords = header if section == "header" else meta
            if key in keywords:
                raise AemFaultError(where, f"{key} appears twice in the {section}; delete one")
            keywords[key] = value
    if section != "header" or not blocks:
        raise AemFaultError(
            f":{number}",
            f"the file ends in the {section}, with {len(blocks)} complete blocks of data; is it cut"
            " off?",
        )
    return blocks


def _keyword(line: str, section: str, version: str, where: str) -> tuple[str, str]:
    key, equals, value = line.partition("=")
    if not equals or section not in {"header", "metadata"}:
        raise AemFaultError(
            where,
            f"{line[:40]!r} in the {section}; write KEYWORD = value, or a marker such as"
            " META_START",
        )
    fault = _fault_of(key.strip(), section, version)
    if fault is not None:
        raise AemFaultError(where, fault)
    return key.strip(), plain(value)


def _kvn_block(meta: dict[str, str], rows: list[tuple[str, list[str]]], where: str) -> Block:
    _check_metadata(meta, where)
    if not rows:
        raise AemFaultError(where, "the block contains no attitude")
    count = 1 + len(STATES[meta[VERSION_KEY]][meta["ATTITUDE_TYPE"]][1].split())
    order = meta.get("QUATERNION_TYPE", "LAST" if meta[VERSION_KEY] == "2.0" else "missing")
    has_quaternion = meta["ATTITUDE_TYPE"] in QUATERNIONS
    if has_quaternion and order not in {"FIRST", "LAST"}:
        raise AemFaultError(
            where, f"QUATERNION_TYPE is {order}; write FIRST or LAST, where the scalar is"
        )
    values = []
    for place, fields in rows:
        try:
            if len(fields) != count:
                raise ValueError
            values.append([float(word) for word in fields[1:]])
        except ValueError:
            wanted = f"write an epoch and {count - 1} numbers for {meta['ATTITUDE_TYPE']}"
            raise AemFaultError(place, f"{' '.join(fields)[:80]!r}; {wanted}") from None
    table = np.array(values, dtype=np.float64)
    if has_quaternion and order == "LAST":
        table[:, :4] = table[:, [3, 0, 1, 2]]
        if meta["ATTITUDE_TYPE"] == DERIVATIVE:
            table[:, 4:] = table[:, [7, 4, 5, 6]]
    return Block(meta, [place for place, _ in rows], [fields[0] for _, fields in rows], table)


@dataclass(slots=True)
class _Element:
    name: str
    line: int
    attributes: dict[str, str]
    children: "list[_Element]" = field(default_factory=list)
    text: str = ""

    def unlike(self, detail: str) -> AemFaultError:
        return AemFaultError(f":{self.line}", f"is not an AEM in XML ({detail})")

    def parts(self, *names: str) -> "list[_Element]":
        """The element's children. Raises AemFaultError where a child has none of these names, or
        text stands between them.
        """
        for child in self.children:
            if child.name not in names:
                raise child.unlike(f"<{child.name[:40]}> where <{'> or <'.join(names)}> belongs")
        if self.text.strip():
            raise self.unlike(
                f"{self.text.strip()[:40]!r} stands in <{self.name}>, where elements belong"
            )
        return self.children


@dataclass(slots=True)
class _XmlSegment:
    """The keywords `meta` of a <segment>, and the epoch and the numbers of each of its states."""

    meta: dict[str, str]
    epochs: list[str] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)


def xml_blocks(text: str) -> list[Block]:
    """The blocks of an AEM's text in XML, of an <aem> or an <ndm> with one. Raises AemFaultError
    for text that is no such AEM, or is cut off.
    """
    long = LONG_ELEMENT.search(text)
    if long is not None:
        line = text.count("\n", 0, long.start()) + 1
        raise AemFaultError(
            f":{line}", "is not an AEM in XML (an element has a million characters)"
        )
    reading = _XmlReading()
    try:
        reading.parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        raise AemFaultError(
            f":{error.lineno}", f"is not well-formed XML ({expat.ErrorString(error.code)})"
        ) from error
    if reading.messages != 1:
        raise AemFaultError("", f"the <ndm> contains {reading.messages} <aem>; write one")
    blocks: list[Block] = []
    for segment in reading.segments:
        where = [f", {epoch[:40]}" for epoch in segment.epochs]
        rows = np.array(segment.rows, dtype=np.float64)
        blocks.append(Block(segment.meta, where, segment.epochs, rows))
    return blocks


class _XmlReading:
    """Handles elements as the parser reads them. At its end a state is reduced to its numbers, and
    its elements are released.
    """

    def __init__(self) -> None:
        self.messages = 0
        self.segments: list[_XmlSegment] = []
        # With a separator, expat gives an element's name after its namespace and a blank.
        self.parser = expat.ParserCreate("utf-8", " ")
        self.parser.buffer_text = True
        self.parser.StartDoctypeDeclHandler = self._doctype
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._add_text
        self._open: list[_Element] = []
        self._kept = 0

    def _doctype(self, *_: object) -> None:
        raise AemFaultError(f":{self.parser.CurrentLineNumber}", "has a DOCTYPE; remove it")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        element = _Element(name.rpartition(" ")[2], self.parser.CurrentLineNumber, attributes)
        self._kept += 1
        if len(self._open) >= MAX_DEPTH or self._kept > MAX_ELEMENTS:
            raise element.unlike("its elements are nested too deep, or are too many")
        if self._open:
            self._open[-1].children.append(element)
        elif element.name not in {"aem", "ndm"}:
            raise element.unlike(f"<{element.name[:40]}> where <aem> or <ndm> belongs")
        self._open.append(element)
        if element.name == "aem" and len(self._open) <= 2:
            if attributes.get("id") != VERSION_KEY or "version" not in attributes:
                raise element.unlike(f'<aem> has no id="{VERSION_KEY}", or no version')
            _check_version(attributes["version"])

    def _add_text(self, text: str) -> None:
        self._open[-1].text += text

    def _end(self, _: str) -> None:
        element = self._open.pop()
        place = [each.name for each in self._open]
        if place[:1] == ["ndm"]:
            place = place[1:]
            if not place and element.name != "aem":  # another kind of message, which is passed over
                self._let_go(element)
                return
        if place == ["aem", "body", "segment"] and element.name == "metadata":
            version = next(each for each in self._open if each.name == "aem").attributes["version"]
            meta = {VERSION_KEY: version} | _keywords(element, version)
            _check_metadata(meta, f":{element.line}")
            self.segments.append(_XmlSegment(meta))
        elif place == ["aem", "body", "segment", "data"] and element.name == "attitudeState":
            if self._open[-2].children[0].name != "metadata":
                raise self._open[-2].unlike("a <segment> begins with its <metadata>")
            epoch, row = _state(element, self.segments[-1].meta)
            self.segments[-1].epochs.append(epoch)
            self.segments[-1].rows.append(row)
            self._let_go(element)
        elif place == ["aem", "body"] and element.name == "segment":
            self._check_segment(element)
        elif not place and element.name == "aem":
            self._check_message(element)

    def _let_go(self, element: _Element) -> None:
        self._open[-1].children.pop()
        self._kept = sum(1 + len(each.children) for each in self._open)

    def _check_segment(self, element: _Element) -> None:
        names = [part.name for part in element.parts("metadata", "data")]
        if names != ["metadata", "data"]:
            raise element.unlike(
                "a <segment> is one <metadata>, then one <data>; is the file cut off?"
            )
        element.children[1].parts("COMMENT")
        if not self.segments[-1].rows:
            raise element.unlike("a <segment> contains no attitude")

    def _check_message(self, element: _Element) -> None:
        self.messages += 1
        parts = {part.name: part for part in element.parts("header", "body")}
        if "header" in parts:
            _keywords(parts["header"], element.attributes["version"])
        if (
            "body" not in parts
            or not parts["body"].parts("segment")
            or len(parts) != len(element.children)
        ):
            raise element.unlike(
                "an <aem> is one <header>, then one <body> of <segment>; is the file cut off?"
            )


def _keywords(element: _Element, version: str) -> dict[str, str]:
    """The keywords in a <header> or <metadata> of an AEM of this version. Raises AemFaultError for
    one that is unknown, of the other version, or there twice.
    """
    given: dict[str, str] = {}
    for child in element.children:
        for inner in child.children:
            raise inner.unlike(f"<{inner.name[:40]}> within <{child.name[:40]}>")
        if child.name == "COMMENT":
            continue
        fault = _fault_of(child.name, element.name, version)
        if fault is None and child.name in given:
            fault = f"{child.name} appears twice in the {element.name}; delete one"
        if fault is not None:
            raise AemFaultError(f":{child.line}", fault)
        given[child.name] = plain(child.text.strip())
    if element.text.strip():
        raise element.unlike(
            f"{element.text.strip()[:40]!r} stands in <{element.name}>, where elements belong"
        )
    return given


def _state(holder: _Element, meta: dict[str, str]) -> tuple[str, list[float]]:
    """The epoch of an <attitudeState>, and its numbers in the order of KVN with the scalar first.
    Raises AemFaultError where its elements are not those of the ATTITUDE_TYPE.
    """
    name, paths = STATES[meta[VERSION_KEY]][meta["ATTITUDE_TYPE"]]
    if [child.name for child in holder.children] != [name]:
        raise AemFaultError(
            f":{holder.line}",
            f"the state is not the {meta['ATTITUDE_TYPE']} that the metadata state: <{name}>",
        )
    holder.parts(name)
    wanted = paths.split()
    numbers: dict[str, float] = {}
    epochs: list[str] = []
    for path, leaf in _leaves(holder.children[0], ""):
        if path == "EPOCH":
            epochs.append(leaf.text.strip())
            continue
        key = _key(path, leaf, wanted, meta)
        if key in numbers:
            raise leaf.unlike(f"<{leaf.name[:40]}> appears twice in a <{name}>")
        if key not in wanted:
            raise leaf.unlike(f"<{leaf.name[:40]}> has no place in a <{name}>")
        numbers[key] = _number(leaf, key)
    missing = [path for path in wanted if path not in numbers]
    if missing:
        raise holder.unlike(f"a <{name}> has one {missing[0]}")
    if len(epochs) != 1:
        raise holder.unlike(f"a <{name}> has one EPOCH")
    return epochs[0], [numbers[path] for path in wanted]


def _leaves(element: _Element, path: str) -> Iterator[tuple[str, _Element]]:
    for child in element.children:
        if child.children:
            child.parts(*(grandchild.name for grandchild in child.children))
            yield from _leaves(child, f"{path}{child.name}/")
        else:
            yield path + child.name, child


def _key(path: str, leaf: _Element, wanted: list[str], meta: dict[str, str]) -> str:
    """The path of a number as STATES writes it. The axis of a rotation may be an attribute of its
    element. Raises AemFaultError where that axis is not the one of EULER_ROT_SEQ.
    """
    if leaf.name not in {"rotation1", "rotation2", "rotation3"}:
        return path
    container = path.partition("/")[0]
    if container == "rotationAngles":
        axis = leaf.attributes.get("angle", "missing").upper()
        place = int(leaf.name[-1]) - 1
        needed = "XYZ"[sequence(meta)[place]] + "_ANGLE"
        if axis != needed:
            raise leaf.unlike(
                f"{leaf.name} is the {axis[:40]}, and EULER_ROT_SEQ has {needed} there"
            )
        return path
    if path in wanted:
        return path
    return f"{container}/{leaf.attributes.get('rate', 'missing').upper()}"


def _number(leaf: _Element, key: str) -> float:
    unit = _unit(key)
    for name, value in leaf.attributes.items():
        if name == "units" and value.lower() != unit:
            raise leaf.unlike(f"<{leaf.name}> in {value[:40]!r}; write {unit or 'no units'}")
        # a name with a blank has a namespace, and is not the AEM's
        if name not in {"units", "angle", "rate"} and " " not in name:
            raise leaf.unlike(f"<{leaf.name}> has no {name[:40]}")
    try:
        return float(leaf.text)
    except ValueError:
        raise leaf.unlike(f"<{leaf.name}> is {leaf.text.strip()[:40]!r}; write a number") from None


@cache
def _unit(key: str) -> str:
    container, _, name = key.rpartition("/")
    if container == "quaternion":
        return ""
    if container in {"quaternionRate", "quaternionDot"}:
        return "1/s"
    if name == "NUTATION_PER":
        return "s"
    if container == "rotationRates" or name.endswith(("_VEL", "_DOT")) or "ANGVEL" in name:
        return "deg/s"
    return "deg"
