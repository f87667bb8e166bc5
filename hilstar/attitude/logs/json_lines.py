"""Logs of JSON lines: each is the wire's JSON form of an attitude."""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO

import msgspec

from hilstar.attitude.logs.csv_log import invalid_notice
from hilstar.attitude.logs.entries import LogEntry, LogReading, Stated
from hilstar.attitude.logs.log_formats import MAX_LOG_BYTES, LogFormat, Writing, readable
from hilstar.attitude.logs.packet_logs import LIKE_PACKETS, of_packets
from hilstar.attitude.wire.packet import JSON_FORM, AttitudeSample, Event, Refusal, decode
from hilstar.basics.reading import open_lines

JSON_KEYS = ('"t_ns"', '"q"', '"rate"', '"sequence"', '"discontinuity"')
VALID_KEY = '"valid"'


@contextlib.contextmanager
def read_json_lines(path: Path, stated: Stated) -> Iterator[LogReading]:
    """The reading of JSON lines. Raises InputError."""
    with open_lines(path, readable(), MAX_LOG_BYTES) as lines:
        told: list[tuple[str, str]] = []
        reading = of_packets(path, _read_json_lines(lines, told), "JSON lines", stated)
        yield reading
        # Complete when the last line is read.
        reading.told.extend(told)


def _read_json_lines(lines: Iterable[str], told: list[tuple[str, str]]) -> Iterator[LogEntry]:
    """The attitudes of JSON lines; at their end `told` gets a notice of those that say `"valid":
    false`.
    """
    invalid = 0
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text:
            continue
        event: Event = _json_fault(text) or decode(text.encode())
        if not isinstance(event, AttitudeSample | Refusal):
            event = Refusal("format", f"is not an attitude; write {JSON_FORM}")
        if VALID_KEY in text and _says_invalid(text):
            invalid += 1
            continue
        yield LogEntry(f":{number}", event)
    if invalid:
        told.append(invalid_notice(invalid, "line"))


def _json_fault(text: str) -> Refusal | None:
    """What msgspec would not say of a line: an object over several lines, a key twice (it takes the
    last).
    """
    if text in ("{", "["):
        several = "a JSON object over several lines; write each on one line (jq -c . FILE)"
        return Refusal("format", several)
    for key in JSON_KEYS:
        if text.count(key) > 1:
            return Refusal("format", f"key {key} is there twice; write each once")
    return None


def _says_invalid(text: str) -> bool:
    try:
        valid = msgspec.json.decode(text, type=dict[str, object]).get("valid")
    except msgspec.MsgspecError:
        return False  # refused by `decode`
    return valid in (False, 0)


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
