"""JSON lines: the wire's JSON form of an attitude, one object a line."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import IO

import msgspec

from hilstar.attitude.logs.entries import Entry
from hilstar.attitude.wire.packet import JSON_FORM, AttitudeSample, Refusal, decode


def read_json_lines(lines: Iterable[str]) -> Iterator[Entry]:
    """The entries of a log's lines; blank ones are ignored."""
    for number, line in enumerate(lines, start=1):
        if line.strip():
            event = decode(line.strip().encode())
            if not isinstance(event, AttitudeSample | Refusal):
                event = Refusal("format", f"is not an attitude; write {JSON_FORM}")
            yield Entry(f":{number}", event)


def write_json_lines(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    """Write one object for each sample; a rate that is not known has no key. Raises OSError."""
    encoder = msgspec.json.Encoder()
    for sample in samples:
        form: dict[str, object] = {"t_ns": sample.t_ns, "q": sample.q_icrs_to_cam.tolist()}
        if sample.rate_cam_rad_s is not None:
            form["rate"] = sample.rate_cam_rad_s.tolist()
        form |= {"sequence": sample.sequence, "discontinuity": sample.discontinuity}
        file.write(encoder.encode(form) + b"\n")
