"""AEM in XML, read by `ccsds-ndm` once everything that it would silently ignore has been refused."""

from __future__ import annotations

import logging
import re
from dataclasses import fields
from enum import Enum
from typing import Any

import numpy as np

from hilstar.attitude.logs.aem.angles import sequence
from hilstar.attitude.logs.aem.blocks import ELEMENTS, EULER_RATE, QUATERNIONS, Block, check_metadata, plain
from hilstar.attitude.logs.aem.keywords import VERSION_KEY, AemFaultError, fault_of
from hilstar.errors import MachineError

MISSING = re.compile(r"__init__\(\) missing \d+ required [\w-]+ arguments?: (.*)")
PYTHON = re.compile(r"__|NoneType|attribute|argument|object")


def library() -> Any:
    """The library's module for XML. Raises MachineError when ccsds-ndm is not installed."""
    try:
        from ccsds_ndm import ndm_xml_io  # type: ignore[import-untyped]
    except ImportError as error:
        raise MachineError("ccsds-ndm, which reads XML and writes AEM, is not installed; pip install ccsds-ndm") from error
    return ndm_xml_io


class _NothingDropped(logging.Filter):
    """Raises what the library only logs: a value that it drops, such as that of a repeated element."""

    def filter(self, record: logging.LogRecord) -> bool:
        raise ValueError(record.getMessage())


def _read_message(text: str) -> Any:
    """The library's tree of the text's one AEM. Raises AemFaultError, and MachineError without the library."""
    reader = library().NdmXmlIo()
    reader.parser_config.fail_on_converter_warnings = True
    text = _checked_xml(text)
    log, strict = logging.getLogger("xsdata.logger"), _NothingDropped()
    log.addFilter(strict)
    try:
        message = reader.from_string(text)
    except Exception as error:  # the library passes on whatever its layers raise
        raise AemFaultError("", f"is not an AEM in XML ({_reason(error)})") from error
    finally:
        log.removeFilter(strict)
    if getattr(message, "id", None) != VERSION_KEY:
        raise AemFaultError("", "contains another message, or several; write one <aem>")
    return message


def _reason(error: Exception) -> str:
    """What the library says, without Python's own wording."""
    text = " ".join(str(error).split())[:200]
    missing = MISSING.search(text)
    if missing:
        return f"an element lacks {missing[1]}"
    return text if text and not PYTHON.search(text) else "an element is not as the standard has it"


def _checked_xml(text: str) -> str:
    """The XML of the one <aem>, which may stand in an <ndm>.

    Raises AemFaultError for what the library would silently repair or ignore: XML that is not well formed, a DOCTYPE, unknown
    keywords, several messages.
    """
    from lxml import etree

    try:
        root: Any = etree.fromstring(text.encode(), etree.XMLParser(resolve_entities=False, no_network=True))
    except etree.XMLSyntaxError as error:
        raise AemFaultError(f":{error.lineno or 1}", f"is not well-formed XML ({error.msg})".replace("\n", " ")) from error
    if root.getroottree().docinfo.internalDTD is not None:
        raise AemFaultError("", "has a DOCTYPE; remove it")
    if etree.QName(root).localname == "ndm":
        messages = root.xpath("*[local-name() = 'aem']")
        if len(messages) != 1:
            raise AemFaultError("", f"the <ndm> contains {len(messages)} <aem>; write one")
        root = messages[0]
        text = etree.tostring(root, encoding="unicode", with_tail=False)
    _check_keywords(root)
    return text


def _check_keywords(root: Any) -> None:
    from lxml import etree

    for section in ("header", "metadata"):
        for element in root.xpath(f"descendant::*[local-name() = '{section}']/*"):
            name = etree.QName(element).localname
            fault = None if name == "COMMENT" else fault_of(name, section)
            if fault is not None:
                raise AemFaultError(f":{element.sourceline or 1}", fault)


def xml_blocks(text: str) -> list[Block]:
    """The blocks of an AEM's text in XML. Raises AemFaultError, and MachineError without the library."""
    message = _read_message(text)
    segments = message.body.segment if message.body is not None else []
    if not segments or any(s.metadata is None or s.data is None for s in segments):
        raise AemFaultError("", "a segment is missing, or lacks <metadata> or <data>; is the file cut off?")
    return [_xml_block(message.version, segment) for segment in segments]


def _xml_block(version: str, segment: Any) -> Block:
    given = {field.metadata["name"]: getattr(segment.metadata, field.name) for field in fields(segment.metadata)}
    texts = {key: value.value if isinstance(value, Enum) else value for key, value in given.items()}
    meta = {key: plain(value) for key, value in texts.items() if isinstance(value, str)} | {VERSION_KEY: version}
    check_metadata(meta, "")
    element, parts = ELEMENTS[version][meta["ATTITUDE_TYPE"]]
    states = [getattr(state, element) for state in segment.data.attitude_state]
    if not states or None in states:
        raise AemFaultError("", f"a state is missing, or is not the {meta['ATTITUDE_TYPE']} that the metadata states")
    values = [_xml_values(meta, parts.split(), state) for state in states]
    epochs = [state.epoch for state in states]
    return Block(meta, [f", {epoch[:40]}" for epoch in epochs], epochs, np.array(values, dtype=np.float64))


def _xml_values(meta: dict[str, str], parts: list[str], state: Any) -> list[float]:
    """The numbers of a state in the order of KVN."""
    if meta["ATTITUDE_TYPE"] not in QUATERNIONS:
        return [value for part in parts for value in _xml_part(part, getattr(state, part), meta)]
    q = state.quaternion
    return [q.qc, q.q1, q.q2, q.q3, *(value for part in parts for value in _xml_part(part, getattr(state, part), meta))]


def _xml_part(part: str, more: Any, meta: dict[str, str]) -> list[float]:
    match part:
        case "ang_vel":
            return [more.angvel_x.value, more.angvel_y.value, more.angvel_z.value]
        case "rotation_angles":
            turns = (more.rotation1, more.rotation2, more.rotation3)
            wanted = ["XYZ"[axis] + "_ANGLE" for axis in sequence(meta)]
            if [turn.angle.value.upper() for turn in turns] != wanted:
                raise AemFaultError("", f"the angles of a state must be {', '.join(wanted)}, as EULER_ROT_SEQ has them")
            return [turn.value for turn in turns]
        case "rotation_rates":
            if meta["ATTITUDE_TYPE"] == EULER_RATE:
                return [0.0] * 3  # not used
            axes = sorted((axis.rate.value.upper(), axis.value) for axis in (more.rotation1, more.rotation2, more.rotation3))
            if [name for name, _ in axes] != ["X_RATE", "Y_RATE", "Z_RATE"]:
                raise AemFaultError("", "the rates of a state must be X_RATE, Y_RATE and Z_RATE")
            return [value for _, value in axes]
        case "quaternion_rate" | "quaternion_dot":
            return [getattr(more, name).value for name in ("qc_dot", "q1_dot", "q2_dot", "q3_dot")]
        case _:
            return [more.value]
