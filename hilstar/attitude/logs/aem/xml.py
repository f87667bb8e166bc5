"""AEM in XML, read element by element by Python's own parser; what would be passed over is refused.

The text is bounded by its reader. A DOCTYPE is refused where it begins, so that no entity is expanded and nothing outside the
text is read; depth and the size of an element are bounded; and of each state only its numbers are kept.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from xml.parsers import expat

import numpy as np

from hilstar.attitude.logs.aem.angles import sequence
from hilstar.attitude.logs.aem.blocks import (
    ANGVEL,
    DERIVATIVE,
    EULER,
    EULER_ANGVEL,
    EULER_DERIVATIVE,
    EULER_RATE,
    QUATERNION,
    RATE,
    SPIN,
    SPIN_NUTATION,
    SPIN_NUTATION_MOM,
    VERSION_KEY,
    AemFaultError,
    Block,
    check_metadata,
    check_version,
    fault_of,
    plain,
)

MAX_DEPTH = 12  # in an <ndm> a number stands nine deep
MAX_ELEMENTS = 100_000  # besides the states, and in one of them
LONG_ELEMENT = re.compile("<[^<]{1000000}")

# A state's numbers by their elements within it, in the order of KVN, with the quaternion's scalar first.
Q = "quaternion/QC quaternion/Q1 quaternion/Q2 quaternion/Q3"
Q_RATE = " quaternionRate/QC_DOT quaternionRate/Q1_DOT quaternionRate/Q2_DOT quaternionRate/Q3_DOT"
Q_DOT = Q_RATE.replace("quaternionRate", "quaternionDot")
TURNS = "rotationAngles/rotation1 rotationAngles/rotation2 rotationAngles/rotation3"
RATES = " rotationRates/X_RATE rotationRates/Y_RATE rotationRates/Z_RATE"
UNUSED_RATES = " rotationRates/rotation1 rotationRates/rotation2 rotationRates/rotation3"
ANGLES = "ANGLE_1 ANGLE_2 ANGLE_3"
SPIN_PARTS = "SPIN_ALPHA SPIN_DELTA SPIN_ANGLE SPIN_ANGLE_VEL"
NUTATION_PARTS = f"{SPIN_PARTS} NUTATION NUTATION_PER NUTATION_PHASE"
STATES = {
    "1.0": {
        QUATERNION: ("quaternionState", Q),
        DERIVATIVE: ("quaternionDerivative", Q + Q_RATE),
        RATE: ("quaternionEulerRate", Q + RATES),
        EULER: ("eulerAngle", TURNS),
        EULER_RATE: ("eulerAngleRate", TURNS + UNUSED_RATES),
        SPIN: ("spin", SPIN_PARTS),
        SPIN_NUTATION: ("spinNutation", NUTATION_PARTS),
    },
    "2.0": {
        QUATERNION: ("quaternionEphemeris", Q),
        DERIVATIVE: ("quaternionDerivative", Q + Q_DOT),
        ANGVEL: ("quaternionAngVel", Q + " angVel/ANGVEL_X angVel/ANGVEL_Y angVel/ANGVEL_Z"),
        EULER: ("eulerAngle", ANGLES),
        EULER_DERIVATIVE: ("eulerAngleDerivative", f"{ANGLES} ANGLE_1_DOT ANGLE_2_DOT ANGLE_3_DOT"),
        EULER_ANGVEL: ("eulerAngleAngVel", f"{ANGLES} ANGVEL_X ANGVEL_Y ANGVEL_Z"),
        SPIN: ("spin", SPIN_PARTS),
        SPIN_NUTATION: ("spinNutation", NUTATION_PARTS),
        SPIN_NUTATION_MOM: ("spinNutationMom", f"{SPIN_PARTS} MOMENTUM_ALPHA MOMENTUM_DELTA NUTATION_VEL"),
    },
}


@dataclass(slots=True)
class _Element:
    """An element that is being read, or has been."""

    name: str
    line: int
    attributes: dict[str, str]
    children: list[_Element] = field(default_factory=list)
    text: str = ""

    def unlike(self, detail: str) -> AemFaultError:
        """What is wrong with it."""
        return AemFaultError(f":{self.line}", f"is not an AEM in XML ({detail})")

    def parts(self, *names: str) -> list[_Element]:
        """Its children, each of one of these names, with nothing between them. Raises AemFaultError."""
        for child in self.children:
            if child.name not in names:
                raise child.unlike(f"<{child.name[:40]}> where <{'> or <'.join(names)}> belongs")
        if self.text.strip():
            raise self.unlike(f"{self.text.strip()[:40]!r} stands in <{self.name}>, where elements belong")
        return self.children

    def leaf_text(self) -> str:
        """Its text. Raises AemFaultError where it has children."""
        for child in self.children:
            raise child.unlike(f"<{child.name[:40]}> within <{self.name[:40]}>")
        return self.text.strip()


@dataclass(slots=True)
class _Segment:
    """The keywords of a <segment>, and of each of its states the epoch and the numbers."""

    meta: dict[str, str]
    epochs: list[str] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)


def xml_blocks(text: str) -> list[Block]:
    """The blocks of an AEM's text in XML. Raises AemFaultError."""
    long = LONG_ELEMENT.search(text)
    if long is not None:
        line = text.count("\n", 0, long.start()) + 1
        raise AemFaultError(f":{line}", "is not an AEM in XML (an element has a million characters)")
    reading = _Reading()
    try:
        reading.parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        raise AemFaultError(f":{error.lineno}", f"is not well-formed XML ({expat.ErrorString(error.code)})") from error
    if reading.messages != 1:
        raise AemFaultError("", f"the <ndm> contains {reading.messages} <aem>; write one")
    return [
        Block(each.meta, [f", {epoch[:40]}" for epoch in each.epochs], each.epochs, np.array(each.rows, dtype=np.float64))
        for each in reading.segments
    ]


class _Reading:
    """The elements as the parser meets them. A state is made numbers, and let go, where it ends."""

    def __init__(self) -> None:
        self.messages = 0
        self.segments: list[_Segment] = []
        self.parser = expat.ParserCreate("utf-8", " ")  # names come with their namespace and a blank before them
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
        if not self._open and element.name not in {"aem", "ndm"}:
            raise element.unlike(f"<{element.name[:40]}> where <aem> or <ndm> belongs")
        if self._open:
            self._open[-1].children.append(element)
        elif element.name == "aem":
            _check_version(element)
        self._open.append(element)
        if element.name == "aem" and len(self._open) == 2:
            _check_version(element)

    def _add_text(self, text: str) -> None:
        self._open[-1].text += text

    def _end(self, name: str) -> None:
        element = self._open.pop()
        place = [each.name for each in self._open]
        if place[:1] == ["ndm"]:
            place = place[1:]
            if not place and element.name != "aem":  # another message
                self._let_go(element)
                return
        if place == ["aem", "body", "segment"] and element.name == "metadata":
            self._begin_segment(element)
        elif place == ["aem", "body", "segment", "data"] and element.name == "attitudeState":
            self._take_state(element)
        elif place == ["aem", "body"] and element.name == "segment":
            self._check_segment(element)
        elif not place and element.name == "aem":
            self._check_message(element)

    def _let_go(self, element: _Element) -> None:
        """Forget an element that has been read."""
        self._open[-1].children.pop()
        self._kept = sum(1 + len(each.children) for each in self._open)

    @property
    def _version(self) -> str:
        return next(each for each in self._open if each.name == "aem").attributes["version"]

    def _begin_segment(self, metadata: _Element) -> None:
        meta = {VERSION_KEY: self._version} | _keywords(metadata, self._version)
        check_metadata(meta, f":{metadata.line}")
        self.segments.append(_Segment(meta))

    def _take_state(self, holder: _Element) -> None:
        segment_element = self._open[-2]
        if segment_element.children[0].name != "metadata":
            raise segment_element.unlike("a <segment> begins with its <metadata>")
        segment = self.segments[-1]
        epoch, row = _state(holder, segment.meta)
        segment.epochs.append(epoch)
        segment.rows.append(row)
        self._let_go(holder)

    def _check_segment(self, element: _Element) -> None:
        names = [part.name for part in element.parts("metadata", "data")]
        if names != ["metadata", "data"]:
            raise element.unlike("a <segment> is one <metadata>, then one <data>; is the file cut off?")
        element.children[1].parts("COMMENT")
        if not self.segments[-1].rows:
            raise element.unlike("a <segment> contains no attitude")

    def _check_message(self, element: _Element) -> None:
        self.messages += 1
        parts = {part.name: part for part in element.parts("header", "body")}
        if "header" in parts:
            _keywords(parts["header"], element.attributes["version"])
        if "body" not in parts or not parts["body"].parts("segment") or len(parts) != len(element.children):
            raise element.unlike("an <aem> is one <header>, then one <body> of <segment>; is the file cut off?")


def _check_version(element: _Element) -> None:
    if element.attributes.get("id") != VERSION_KEY or "version" not in element.attributes:
        raise element.unlike(f'<aem> has no id="{VERSION_KEY}", or no version')
    check_version(element.attributes["version"])


def _keywords(element: _Element, version: str) -> dict[str, str]:
    """The keywords of a <header> or <metadata>. Raises AemFaultError."""
    given: dict[str, str] = {}
    for child in element.children:
        text = child.leaf_text()
        if child.name == "COMMENT":
            continue
        fault = fault_of(child.name, element.name, version)
        if fault is None and child.name in given:
            fault = f"{child.name} appears twice in the {element.name}; delete one"
        if fault is not None:
            raise AemFaultError(f":{child.line}", fault)
        given[child.name] = plain(text)
    if element.text.strip():
        raise element.unlike(f"{element.text.strip()[:40]!r} stands in <{element.name}>, where elements belong")
    return given


def _state(holder: _Element, meta: dict[str, str]) -> tuple[str, list[float]]:
    """The epoch of an <attitudeState>, and its numbers in the order of KVN. Raises AemFaultError."""
    name, paths = STATES[meta[VERSION_KEY]][meta["ATTITUDE_TYPE"]]
    if [child.name for child in holder.children] != [name]:
        raise AemFaultError(
            f":{holder.line}", f"the state is not the {meta['ATTITUDE_TYPE']} that the metadata state: <{name}>"
        )
    holder.parts(name)
    wanted = paths.split()
    found: dict[str, float] = {}
    epochs: list[str] = []
    for path, leaf in _leaves(holder.children[0], ""):
        if path == "EPOCH":
            epochs.append(leaf.text.strip())
            continue
        key = _key(path, leaf, wanted, meta)
        if key not in wanted or key in found:
            raise leaf.unlike(f"<{leaf.name[:40]}> {'appears twice' if key in found else 'has no place'} in a <{name}>")
        found[key] = _number(leaf, key)
    missing = [path for path in wanted if path not in found]
    if missing or len(epochs) != 1:
        raise holder.unlike(f"a <{name}> has one {missing[0] if missing else 'EPOCH'}")
    return epochs[0], [found[path] for path in wanted]


def _leaves(element: _Element, path: str) -> Iterator[tuple[str, _Element]]:
    """The elements without children below one, and their paths from it."""
    for child in element.children:
        if child.children:
            child.parts(*(each.name for each in child.children))
            yield from _leaves(child, f"{path}{child.name}/")
        else:
            yield path + child.name, child


def _key(path: str, leaf: _Element, wanted: list[str], meta: dict[str, str]) -> str:
    """The path by which a number is known: of a rotation about an axis that its attribute names."""
    if leaf.name not in {"rotation1", "rotation2", "rotation3"}:
        return path
    container = path.partition("/")[0]
    if container == "rotationAngles":
        axis, place = leaf.attributes.get("angle", "missing").upper(), int(leaf.name[-1]) - 1
        needed = "XYZ"[sequence(meta)[place]] + "_ANGLE"
        if axis != needed:
            raise leaf.unlike(f"{leaf.name} is the {axis[:40]}, and EULER_ROT_SEQ has {needed} there")
        return path
    return path if path in wanted else f"{container}/{leaf.attributes.get('rate', 'missing').upper()}"


def _number(leaf: _Element, key: str) -> float:
    unit = _unit(key)
    for name, value in leaf.attributes.items():
        if name == "units" and value.lower() != unit:
            raise leaf.unlike(f"<{leaf.name}> in {value[:40]!r}; write {unit or 'no units'}")
        if name not in {"units", "angle", "rate"} and " " not in name:  # with a blank it is of a namespace
            raise leaf.unlike(f"<{leaf.name}> has no {name[:40]}")
    try:
        return float(leaf.text)
    except ValueError:
        raise leaf.unlike(f"<{leaf.name}> is {leaf.text.strip()[:40]!r}; write a number") from None


@cache
def _unit(key: str) -> str:
    """The unit of a number; "" for one that has none."""
    container, _, name = key.rpartition("/")
    if container == "quaternion":
        return ""
    if container in {"quaternionRate", "quaternionDot"}:
        return "1/s"
    if name == "NUTATION_PER":
        return "s"
    return "deg/s" if container == "rotationRates" or name.endswith(("_VEL", "_DOT")) or "ANGVEL" in name else "deg"
