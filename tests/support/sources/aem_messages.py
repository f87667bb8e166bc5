"""Attitude Ephemeris Messages in KVN and XML, made for tests."""

from __future__ import annotations

import re

import numpy as np

from hilstar.attitude.logs.log_file import read_log

EPOCHS = ("2024-02-29T23:59:59.25", "2024-03-01T00:00:01")
TURN_DEG_S, OFFSET_DEG = 3.0, 40.0  # of segments that overlap


def kvn(rows, version="1.0", **keywords):
    """A message of one block; a keyword that is None is omitted."""
    meta = {"OBJECT_NAME": "X", "OBJECT_ID": "X", "REF_FRAME_A": "ICRF", "REF_FRAME_B": "SC_BODY_1"}
    if version == "1.0":
        meta |= {"ATTITUDE_DIR": "A2B", "QUATERNION_TYPE": "LAST"}
    meta |= {
        "TIME_SYSTEM": "UTC",
        "START_TIME": EPOCHS[0],
        "STOP_TIME": EPOCHS[1],
        "ATTITUDE_TYPE": "QUATERNION",
    } | keywords
    lines = [f"CCSDS_AEM_VERS = {version}", "CREATION_DATE = 2024-01-01T00:00:00", "ORIGINATOR = X"]
    lines += [
        "META_START",
        *(f"{key} = {value}" for key, value in meta.items() if value is not None),
        "META_STOP",
    ]
    return "\n".join([*lines, "DATA_START", *rows, "DATA_STOP"]) + "\n"


def rows_of(*numbers):
    return [
        " ".join([epoch, *map(repr, np.asarray(row, dtype=float).tolist())])
        for epoch, row in zip(EPOCHS, numbers, strict=False)
    ]


def joined(first, *others):
    """Messages as one, of the header of the first."""
    return first + "".join(text[text.index("META_START") :] for text in others)


def segment_turn(number, second):
    """Of segment `number`, about z at a constant rate; each segment has an offset of its own, so
    that it can be told.
    """
    angle = np.radians(TURN_DEG_S * second + OFFSET_DEG * number) / 2
    return f"2024-01-01T00:00:{second:02d} 0 0 {float(np.sin(angle))!r} {float(np.cos(angle))!r}"


def overlapping(*segments):
    """Segments, each its seconds and its keywords, as one message."""
    texts = []
    for number, (seconds, keywords) in enumerate(segments):
        rows = [segment_turn(number, second) for second in seconds]
        texts.append(kvn(rows, REF_FRAME_B="CAM", **keywords))
    return joined(*texts)


def useable(start, stop):
    """The keywords of the seconds in which a segment is useable."""
    return {
        "USEABLE_START_TIME": f"2024-01-01T00:00:{start:02d}",
        "USEABLE_STOP_TIME": f"2024-01-01T00:00:{stop:02d}",
    }


def elements(names, values):
    """An element a value."""
    parts = zip(names, values, strict=True)
    return "".join(f"<{name}>{value}</{name}>" for name, value in parts)


def xml_of(text, *states):
    """The version and metadata of a message in KVN, in XML; `states` are those of its blocks."""
    version = re.search("CCSDS_AEM_VERS = (.*)", text)[1]
    segments = []
    for block, of_block in zip(text.split("META_START")[1:], states, strict=True):
        keywords = re.findall(r"(\w+) = (.*)", block.partition("META_STOP")[0])
        meta = "\n".join(f"<{key}>{value}</{key}>" for key, value in keywords)
        data = "".join(f"<attitudeState>{state}</attitudeState>" for state in of_block)
        segments.append(f"<segment><metadata>{meta}</metadata>\n<data>{data}</data></segment>")
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<aem xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" id="CCSDS_AEM_VERS" version="{version}">
<header><CREATION_DATE>2024-01-01T00:00:00</CREATION_DATE><ORIGINATOR>X</ORIGINATOR></header>
<body>{"".join(segments)}</body></aem>
"""


def in_xml(text):
    """A message of quaternions, scalar last, in XML."""
    states = []
    for block in text.split("DATA_START\n")[1:]:
        of_block = []
        for row in block.partition("DATA_STOP")[0].splitlines():
            epoch, *q = row.split()
            quaternion = elements(("Q1", "Q2", "Q3", "QC"), q)
            of_block.append(
                f"<quaternionState><EPOCH>{epoch}</EPOCH><quaternion>{quaternion}</quaternion>"
                "</quaternionState>"
            )
        states.append(of_block)
    return xml_of(text, *states)


def angle_elements(what, names):
    """The three rotations of version 1.0, by 10, 20 and -30."""
    values = zip(names, (10.0, 20.0, -30.0), strict=True)
    return "".join(
        f'<rotation{k} {what}="{n}_{what.upper()}">{v}</rotation{k}>'
        for k, (n, v) in enumerate(values, start=1)
    )


def read(tmp_path, text):
    (tmp_path / "log").write_text(text)
    return read_log(tmp_path / "log")
