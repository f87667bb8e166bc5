"""AEM in KVN, read line by line: an unknown line is refused, and so is a block that is cut off."""

from __future__ import annotations

import io

import numpy as np

from hilstar.attitude.logs.aem.blocks import (
    COMPONENTS,
    DERIVATIVE,
    QUATERNIONS,
    VERSION_KEY,
    AemFaultError,
    Block,
    check_metadata,
    fault_of,
    plain,
)

MARKERS = {  # the section that a marker ends, and the one that it begins
    "META_START": ("header", "metadata"),
    "META_STOP": ("metadata", "gap before DATA_START"),
    "DATA_START": ("gap before DATA_START", "data"),
    "DATA_STOP": ("data", "header"),
}


def kvn_blocks(text: str) -> list[Block]:
    """The blocks of an AEM's text in KVN. Raises AemFaultError."""
    header: dict[str, str] = {}
    meta: dict[str, str] = {}
    rows: list[tuple[str, list[str]]] = []
    blocks: list[Block] = []
    section, number = "header", 0
    for number, line in enumerate(map(str.strip, io.StringIO(text, newline=None)), start=1):
        where = f":{number}"
        if not line or line.split(maxsplit=1)[0] == "COMMENT":
            continue
        if line in MARKERS:
            if section != MARKERS[line][0]:
                raise AemFaultError(
                    where, f"{line} in the {section}; the order is META_START, META_STOP, DATA_START, DATA_STOP"
                )
            section = MARKERS[line][1]
            if line == "META_START":
                meta, rows = dict(header), []
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
            f":{number}", f"the file ends in the {section}, with {len(blocks)} complete blocks of data; is it cut off?"
        )
    return blocks


def _keyword(line: str, section: str, version: str, where: str) -> tuple[str, str]:
    key, equals, value = line.partition("=")
    if not equals or section not in {"header", "metadata"}:
        raise AemFaultError(where, f"{line[:40]!r} in the {section}; write KEYWORD = value, or a marker such as META_START")
    fault = fault_of(key.strip(), section, version)
    if fault is not None:
        raise AemFaultError(where, fault)
    return key.strip(), plain(value)


def _kvn_block(meta: dict[str, str], rows: list[tuple[str, list[str]]], where: str) -> Block:
    check_metadata(meta, where)
    if not rows:
        raise AemFaultError(where, "the block contains no attitude")
    count = 1 + COMPONENTS[meta["ATTITUDE_TYPE"]]
    order = meta.get("QUATERNION_TYPE", "LAST" if meta[VERSION_KEY] == "2.0" else "missing")
    has_quaternion = meta["ATTITUDE_TYPE"] in QUATERNIONS
    if has_quaternion and order not in {"FIRST", "LAST"}:
        raise AemFaultError(where, f"QUATERNION_TYPE is {order}; write FIRST or LAST, where the scalar is")
    values = []
    for place, words in rows:
        try:
            if len(words) != count:
                raise ValueError
            values.append([float(word) for word in words[1:]])
        except ValueError:
            wanted = f"write an epoch and {count - 1} numbers for {meta['ATTITUDE_TYPE']}"
            raise AemFaultError(place, f"{' '.join(words)[:80]!r}; {wanted}") from None
    table = np.array(values, dtype=np.float64)
    if has_quaternion and order == "LAST":
        table[:, :4] = table[:, [3, 0, 1, 2]]
        if meta["ATTITUDE_TYPE"] == DERIVATIVE:
            table[:, 4:] = table[:, [7, 4, 5, 6]]
    return Block(meta, [place for place, _ in rows], [words[0] for _, words in rows], table)
