"""Attitudes in an MCAP file: one JSON message each on `/attitude`, as Foxglove and PlotJuggler open it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import msgspec
from mcap.exceptions import RecordLengthLimitExceeded
from mcap.records import Channel, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, Writer

from hilstar.attitude.packet import AttitudeSample, Refusal, checked_sample
from hilstar.errors import InputError
from hilstar.reading import open_regular

MCAP_MAGIC = MCAP0_MAGIC
ATTITUDE_TOPIC = "/attitude"
ATTITUDE_SCHEMA_NAME = "hilstar.Attitude"
# Plain types only: Foxglove refuses a whole file over ["integer", "null"]. What is not known is null in the message.
ATTITUDE_SCHEMA = msgspec.json.encode(
    {
        "title": ATTITUDE_SCHEMA_NAME,
        "type": "object",
        "properties": {
            "t_ns": {"type": "integer", "description": "sender's clock, ns; null in a message that was refused"},
            "sequence": {"type": "integer", "description": "sender's counter; null in a message that was refused"},
            "q": {"type": "array", "items": {"type": "number"}, "description": "q_icrs_to_cam: w, x, y, z; null when refused"},
            "rate": {"type": "array", "items": {"type": "number"}, "description": "of cam in icrs, cam axes, rad/s; or null"},
            "discontinuity": {"type": "boolean", "description": "do not interpolate from the attitude before"},
            "receive_ns": {"type": "integer", "description": "receiver's clock at arrival, ns; null when it was not received"},
            "accepted": {"type": "boolean"},
            "reason": {"type": "string", "description": "why it was refused; or null"},
            "raw": {"type": "string", "description": "the packet as received, in hexadecimal; or null"},
        },
    }
)


class _Form(msgspec.Struct):
    t_ns: int | None
    sequence: int | None = 0
    q: tuple[float, float, float, float] | None = None
    rate: tuple[float, float, float] | None = None
    discontinuity: bool = False
    receive_ns: int | None = None
    accepted: bool = True
    reason: str | None = None
    raw: str | None = None


_decoder = msgspec.json.Decoder(_Form)
_encoder = msgspec.json.Encoder()


def attitude_message(sample: AttitudeSample, receive_ns: int | None = None, raw: bytes | None = None) -> bytes:
    """The JSON of a sample that was taken; `receive_ns` is the receiver's clock, `raw` the packet as it came."""
    q, rate = sample.q_icrs_to_cam.tolist(), sample.rate_cam_rad_s
    turning = None if rate is None else tuple(rate.tolist())
    packet = None if raw is None else raw.hex()
    return _encoder.encode(_Form(sample.t_ns, sample.sequence, tuple(q), turning, sample.discontinuity, receive_ns, raw=packet))


def refused_message(reason: str, detail: str, receive_ns: int | None, raw: bytes | None) -> bytes:
    """The JSON of a packet that was refused, its reason and detail as "reason: detail"."""
    packet = None if raw is None else raw.hex()
    return _encoder.encode(
        _Form(None, None, None, receive_ns=receive_ns, accepted=False, reason=f"{reason}: {detail}", raw=packet)
    )


def register_attitudes(writer: Writer) -> int:
    """The id of a new `/attitude` channel in an MCAP writer that has been started."""
    schema_id = writer.register_schema(ATTITUDE_SCHEMA_NAME, "jsonschema", ATTITUDE_SCHEMA)
    return writer.register_channel(ATTITUDE_TOPIC, "json", schema_id)


def log_time_ns(t_ns: int, receive_ns: int | None = None) -> int:
    """The unsigned log time of a message: `receive_ns` where known, else `t_ns`, and 0 for what lies before 0."""
    return max(0, t_ns if receive_ns is None else receive_ns)


def write_attitudes(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    """Write a whole MCAP file of samples to an open file. Raises OSError."""
    writer = Writer(file)
    writer.start(profile="", library="hilstar")
    channel_id = register_attitudes(writer)
    for sample in samples:
        time_ns = log_time_ns(sample.t_ns)
        message = attitude_message(sample)
        writer.add_message(channel_id, log_time=time_ns, data=message, publish_time=time_ns, sequence=sample.sequence % 2**32)
    writer.finish()  # type: ignore[no-untyped-call]


def read_attitudes(path: Path) -> Iterator[AttitudeSample]:
    """The samples that were accepted, in the order of the file; other channels and refused packets are passed over.

    A file whose writer was killed gives everything before its last, unfinished chunk. Raises InputError for damage and
    for a message that is no attitude, OSError when the file cannot be read.
    """
    for number, data in enumerate(read_messages(path, ATTITUDE_TOPIC), start=1):
        entry = _sample(data)
        if isinstance(entry, Refusal):
            raise InputError(f"{path}: message {number} of {ATTITUDE_TOPIC}: {entry.detail}")
        if entry is not None:
            yield entry


def read_messages(path: Path, topic: str) -> Iterator[bytes]:
    """What the messages of one topic hold, in the order of the file, up to where its writer was killed.

    Raises InputError for damage, OSError when the file cannot be read.
    """
    yield from (data for name, data in read_topics(path) if name == topic)


def read_topics(path: Path) -> Iterator[tuple[str, bytes]]:
    """Topic and content of every message, in the order of the file, up to where its writer was killed.

    Raises InputError for damage, OSError when the file cannot be read.
    """
    channels: dict[int, str] = {}
    for record in _records(path):
        if isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, Message) and record.channel_id in channels:
            yield channels[record.channel_id], record.data


def read_metadata(path: Path, name: str) -> dict[str, str]:
    """The first metadata of that name, {} where there is none. Raises InputError for damage."""
    return next((dict(r.metadata) for r in _records(path) if isinstance(r, Metadata) and r.name == name), {})


def is_mcap(path: Path) -> bool:
    """True for a file that begins as MCAP does; False too where it cannot be read."""
    try:
        with open_regular(path, "") as file:
            return file.read(len(MCAP_MAGIC)) == MCAP_MAGIC
    except (OSError, InputError):
        return False


def _sample(data: bytes) -> AttitudeSample | Refusal | None:
    try:
        form = _decoder.decode(data)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        return Refusal("format", f"is not an attitude of hilstar ({error})")
    if not form.accepted:
        return None
    if form.t_ns is None or form.q is None:
        return Refusal("format", "is accepted, but has no t_ns or no q")
    return checked_sample(form.t_ns, form.q, form.rate, form.sequence or 0, form.discontinuity)


def _records(path: Path) -> Iterator[McapRecord]:
    with open_regular(path, "give the ledger of a run, or a log") as file:
        yield from _open_records(path, file)


def _open_records(path: Path, file: IO[bytes]) -> Iterator[McapRecord]:
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - len(MCAP_MAGIC)))
    finished = size > 2 * len(MCAP_MAGIC) and file.read() == MCAP_MAGIC
    file.seek(0)
    records = StreamReader(file, validate_crcs=True, record_size_limit=size).records
    while True:
        try:
            record = next(records, None)
        except Exception as error:  # the reader lets through what struct, zstd, lz4 and UTF-8 raise
            cut_off = isinstance(error, RecordLengthLimitExceeded) or not file.read(1)
            if cut_off and not finished:
                return
            detail = f"{type(error).__name__} {error}".strip()
            raise InputError(f"{path}: is damaged before byte {file.tell()} ({detail}); record the log again") from error
        if record is None:
            return
        yield record
