"""Logs of JSON lines: each is the wire's JSON form of an attitude."""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO

import msgspec

from hilstar.attitude.logs.entries import LogEntry, LogReading, Stated
from hilstar.attitude.logs.log_formats import MAX_LOG_BYTES, LogFormat, Writing, readable
from hilstar.attitude.logs.packet_logs import LIKE_PACKETS, of_packets
from hilstar.attitude.wire.packet import JSON_FORM, AttitudeSample, Refusal, decode
from hilstar.reading import open_lines


@contextlib.contextmanager
def read_json_lines(path: Path, stated: Stated) -> Iterator[LogReading]:
    """The reading of JSON lines. Raises InputError."""
    with open_lines(path, readable(), MAX_LOG_BYTES) as lines:
        yield of_packets(path, _read_json_lines(lines), "JSON lines", stated)


def _read_json_lines(lines: Iterable[str]) -> Iterator[LogEntry]:
    for number, line in enumerate(lines, start=1):
        if line.strip():
            event = decode(line.strip().encode())
            if not isinstance(event, AttitudeSample | Refusal):
                event = Refusal("format", f"is not an attitude; write {JSON_FORM}")
            yield LogEntry(f":{number}", event)


def _write_json_lines(file: IO[bytes], samples: Sequence[AttitudeSample], writing: Writing) -> None:
    encoder = msgspec.json.Encoder()
    for sample in samples:
        form: dict[str, object] = {"t_ns": sample.t_ns, "q": sample.q_icrs_to_cam.tolist()}
        if sample.rate_cam_rad_s is not None:
            form["rate"] = sample.rate_cam_rad_s.tolist()
        form |= {"sequence": sample.sequence, "discontinuity": sample.discontinuity}
        file.write(encoder.encode(form) + b"\n")


log_format = LogFormat(
    "JSON lines",
    read_json_lines,
    listed="JSON lines",
    uses=LIKE_PACKETS,
    begins=lambda log: log.word.startswith("{"),
    endings=(".jsonl", ".json"),
    write=_write_json_lines,
)
