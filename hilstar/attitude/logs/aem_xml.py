"""One AEM in XML, read by `ccsds-ndm` once nothing is left that it would pass over without a word."""

from __future__ import annotations

import logging
import re
from typing import Any

from hilstar.attitude.logs.aem_keywords import VERSION_KEY, AemFaultError, fault_of
from hilstar.errors import MachineError

MISSING = re.compile(r"__init__\(\) missing \d+ required [\w-]+ arguments?: (.*)")
PYTHON = re.compile(r"__|NoneType|attribute|argument|object")


def library() -> Any:
    """The library's module for XML. Raises MachineError when ccsds-ndm is not installed."""
    try:
        from ccsds_ndm import ndm_xml_io  # type: ignore[import-untyped]
    except ImportError as error:
        raise MachineError("XML is read, and AEM written, by ccsds-ndm, which is not there; pip install ccsds-ndm") from error
    return ndm_xml_io


class _NothingDropped(logging.Filter):
    """Makes a fault of what the library logs: a value that it drops, as of an element that is there twice."""

    def filter(self, record: logging.LogRecord) -> bool:
        raise ValueError(record.getMessage())


def read_message(text: str) -> Any:
    """The library's tree of the text's one AEM. Raises AemFaultError, and MachineError without the library."""
    reader = library().NdmXmlIo()
    reader.parser_config.fail_on_converter_warnings = True
    text = _checked_xml(text)
    log, strict = logging.getLogger("xsdata.logger"), _NothingDropped()
    log.addFilter(strict)
    try:
        message = reader.from_string(text)
    except Exception as error:  # the library lets through whatever its layers raise
        raise AemFaultError("", f"is no AEM in XML ({_reason(error)})") from error
    finally:
        log.removeFilter(strict)
    if getattr(message, "id", None) != VERSION_KEY:
        raise AemFaultError("", "holds other messages, or several; one <aem> is wanted")
    return message


def _reason(error: Exception) -> str:
    """What the library says, without Python's own words."""
    text = " ".join(str(error).split())[:200]
    missing = MISSING.search(text)
    if missing:
        return f"an element lacks {missing[1]}"
    return text if text and not PYTHON.search(text) else "an element is not as the standard has it"


def _checked_xml(text: str) -> str:
    """The XML of the one <aem>, which may stand in an <ndm>.

    Raises AemFaultError for what the library would mend or pass over without a word: XML that is not well formed, a
    DOCTYPE, keywords that nobody knows, several messages.
    """
    from lxml import etree

    try:
        root: Any = etree.fromstring(text.encode(), etree.XMLParser(resolve_entities=False, no_network=True))
    except etree.XMLSyntaxError as error:
        raise AemFaultError(f":{error.lineno or 1}", f"is not well-formed XML ({error.msg})".replace("\n", " ")) from error
    if root.getroottree().docinfo.internalDTD is not None:
        raise AemFaultError("", "has a DOCTYPE; an AEM has none")
    if etree.QName(root).localname == "ndm":
        messages = root.xpath("*[local-name() = 'aem']")
        if len(messages) != 1:
            raise AemFaultError("", f"the <ndm> holds {len(messages)} <aem>; one is wanted")
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
