"""Writes attitudes as a CCSDS Attitude Ephemeris Message 1.0 (504.0-B-1; in XML by 505.0-B-2), in KVN or XML.

Version 1.0, because every AEM reader reads it, and it states the quaternion's order and direction in the file. Rates are
written as quaternion derivatives: some readers take QUATERNION/RATE of 1.0 as an angular velocity, others as Euler rates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from hilstar.attitude.logs.aem.blocks import DERIVATIVE, QUATERNION, VERSION_KEY
from hilstar.attitude.logs.aem.epochs import epoch_text
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.rotation import conjugate, multiply

SCALES = frozenset({"UTC", "TAI", "TT", "TDB", "TCB", "GPS", "UT1", "SCLK"})  # of AEM 1.0; other clocks are written as UTC
COMMENTS = (
    "STARTRACKER_1 is the camera: +z boresight, +x right and +y down in its image.",
    "Epochs are the source's clock from 1970-01-01T00:00:00; leap seconds are not counted.",
)
ORDER = ("QC", "Q1", "Q2", "Q3")  # in XML; in KVN the scalar comes last


class _Segment(NamedTuple):
    """The keywords of a block, the epochs of its attitudes, and their components and derivatives (none for 4 columns)."""

    meta: dict[str, str]
    epochs: list[str]
    values: list[list[float]]


def aem_text(samples: Sequence[AttitudeSample], xml: bool, scale: str | None = None) -> str:
    """An AEM 1.0 of at least one sample, as KVN or XML: a new block at each discontinuity, ICRF to STARTRACKER_1, scalar last.

    A block whose samples all have a rate contains quaternion derivatives; other blocks drop their rates. Sequence numbers are
    dropped.
    """
    starts = [i for i, sample in enumerate(samples) if i == 0 or sample.discontinuity]
    blocks = [samples[i:j] for i, j in zip(starts, [*starts[1:], len(samples)], strict=True)]
    header = {"CREATION_DATE": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S"), "ORIGINATOR": "HILSTAR"}
    lines = (_xml if xml else _kvn)(header, [_segment(block, scale) for block in blocks])
    return "\n".join(lines) + "\n"


def _segment(samples: Sequence[AttitudeSample], scale: str | None) -> _Segment:
    rates = [sample.rate_cam_rad_s for sample in samples if sample.rate_cam_rad_s is not None]
    q = np.array([sample.q_icrs_to_cam for sample in samples])
    values = conjugate(q)
    if len(rates) == len(samples):
        q_dot = multiply(np.concatenate((np.zeros((len(q), 1)), np.array(rates)), axis=1), q) / -2.0
        values = np.concatenate((values, conjugate(q_dot)), axis=1)
    epochs = [epoch_text(sample.t_ns) for sample in samples]
    meta = {
        "OBJECT_NAME": "UNKNOWN",
        "OBJECT_ID": "UNKNOWN",
        "REF_FRAME_A": "ICRF",
        "REF_FRAME_B": "STARTRACKER_1",
        "ATTITUDE_DIR": "A2B",
        "TIME_SYSTEM": scale if scale in SCALES else "UTC",
        "START_TIME": epochs[0],
        "STOP_TIME": epochs[-1],
        "ATTITUDE_TYPE": QUATERNION if values.shape[1] == 4 else DERIVATIVE,
        "QUATERNION_TYPE": "LAST",
    }
    return _Segment(meta, epochs, (values + 0.0).tolist())  # + 0.0: CCSDS has no -0


def _kvn(header: dict[str, str], segments: list[_Segment]) -> Iterator[str]:
    yield _assigned(VERSION_KEY, "1.0")
    yield ""
    yield from (_assigned(key, value) for key, value in header.items())
    for segment in segments:
        yield from ("", "META_START", *(f"COMMENT {line}" for line in COMMENTS))
        yield from (_assigned(key, value) for key, value in segment.meta.items())
        yield from ("META_STOP", "", "DATA_START")
        for epoch, values in zip(segment.epochs, segment.values, strict=True):
            last = [*values[1:4], values[0], *values[5:], *values[4:5]]
            yield "  ".join([epoch, *map(repr, last)])
        yield "DATA_STOP"


def _assigned(key: str, value: str) -> str:
    return f"{key:25}= {value}"


def _xml(header: dict[str, str], segments: list[_Segment]) -> Iterator[str]:
    """The lines; nothing in them needs an entity."""
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield f'<aem id="{VERSION_KEY}" version="1.0">'
    yield from ("  <header>", *_elements(4, header), "  </header>", "  <body>")
    for segment in segments:
        yield from ("    <segment>", "      <metadata>", *(f"        <COMMENT>{line}</COMMENT>" for line in COMMENTS))
        yield from (*_elements(8, segment.meta), "      </metadata>", "      <data>")
        name = "quaternionState" if segment.meta["ATTITUDE_TYPE"] == QUATERNION else "quaternionDerivative"
        for epoch, values in zip(segment.epochs, segment.values, strict=True):
            yield from ("        <attitudeState>", f"          <{name}>", f"            <EPOCH>{epoch}</EPOCH>")
            yield from _quaternion("quaternion", "", values[:4])
            if len(values) > 4:
                yield from _quaternion("quaternionRate", "_DOT", values[4:])
            yield from (f"          </{name}>", "        </attitudeState>")
        yield from ("      </data>", "    </segment>")
    yield from ("  </body>", "</aem>")


def _elements(indent: int, texts: dict[str, str]) -> Iterator[str]:
    return (f"{' ' * indent}<{key}>{text}</{key}>" for key, text in texts.items())


def _quaternion(name: str, ending: str, values: list[float]) -> Iterator[str]:
    yield f"            <{name}>"
    yield from _elements(14, {key + ending: repr(value) for key, value in zip(ORDER, values, strict=True)})
    yield f"            </{name}>"
