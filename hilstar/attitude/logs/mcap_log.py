"""Attitudes in an MCAP file: one JSON message each on `/attitude`, which Foxglove and PlotJuggler open."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import msgspec
from mcap.writer import Writer

from hilstar.attitude.logs.mcap_reader import read_messages
from hilstar.attitude.logs.mcap_writer import Topic
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, checked_sample
from hilstar.errors import InputError
from hilstar.reading import NOT_JSON

ATTITUDE_TOPIC = "/attitude"
ATTITUDE_SCHEMA_NAME = "hilstar.Attitude"
# Plain types only: Foxglove refuses a whole file over ["integer", "null"]. Unknown values are null in the message.
ATTITUDE_SCHEMA = msgspec.json.encode(
    {
        "title": ATTITUDE_SCHEMA_NAME,
        "type": "object",
        "properties": {
            "t_ns": {"type": "integer", "description": "sender's clock, ns; null in a refused message"},
            "sequence": {"type": "integer", "description": "sender's counter; null in a refused message"},
            "q": {"type": "array", "items": {"type": "number"}, "description": "q_icrs_to_cam: w, x, y, z; null when refused"},
            "rate": {"type": "array", "items": {"type": "number"}, "description": "of cam in icrs, cam axes, rad/s; or null"},
            "discontinuity": {"type": "boolean", "description": "do not interpolate from the previous attitude"},
            "receive_ns": {"type": "integer", "description": "receiver's clock at arrival, ns; null when not received"},
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


ATTITUDE_TOPIC_OF_RUN = Topic(ATTITUDE_TOPIC, ATTITUDE_SCHEMA_NAME, ATTITUDE_SCHEMA)

_decoder = msgspec.json.Decoder(_Form)
_encoder = msgspec.json.Encoder()


def attitude_message(sample: AttitudeSample, receive_ns: int | None = None, raw: bytes | None = None) -> bytes:
    """The JSON of an accepted sample; `receive_ns` is the receiver's clock at arrival, `raw` the packet as received."""
    q, rate = sample.q_icrs_to_cam.tolist(), sample.rate_cam_rad_s
    turning = None if rate is None else tuple(rate.tolist())
    packet = None if raw is None else raw.hex()
    return _encoder.encode(_Form(sample.t_ns, sample.sequence, tuple(q), turning, sample.discontinuity, receive_ns, raw=packet))


def refused_message(reason: str, detail: str, receive_ns: int | None, raw: bytes | None) -> bytes:
    """The JSON of a refused packet, with "reason: detail"."""
    packet = None if raw is None else raw.hex()
    return _encoder.encode(
        _Form(None, None, None, receive_ns=receive_ns, accepted=False, reason=f"{reason}: {detail}", raw=packet)
    )


def register_attitudes(writer: Writer) -> int:
    """The id of a new `/attitude` channel in an MCAP writer that has been started."""
    schema_id = writer.register_schema(ATTITUDE_SCHEMA_NAME, "jsonschema", ATTITUDE_SCHEMA)
    return writer.register_channel(ATTITUDE_TOPIC, "json", schema_id)


def log_time_ns(t_ns: int, receive_ns: int | None = None) -> int:
    """The unsigned log time of a message: `receive_ns` where known, else `t_ns`, and 0 for negative times."""
    return max(0, t_ns if receive_ns is None else receive_ns)


def write_attitudes(file: IO[bytes], samples: Sequence[AttitudeSample]) -> None:
    """Write a whole MCAP file of samples to an open file. Raises OSError."""
    writer = Writer(file, enable_data_crcs=True)
    writer.start(profile="", library="hilstar")
    channel_id = register_attitudes(writer)
    for sample in samples:
        time_ns = log_time_ns(sample.t_ns)
        message = attitude_message(sample)
        writer.add_message(channel_id, log_time=time_ns, data=message, publish_time=time_ns, sequence=sample.sequence % 2**32)
    writer.finish()  # type: ignore[no-untyped-call]


def read_attitudes(path: Path) -> Iterator[AttitudeSample]:
    """The accepted samples in the order of the file; other channels and refused packets are skipped.

    A file whose writer was killed gives everything before its last, unfinished chunk. Raises InputError for damage, and for a
    message that is not an attitude.
    """
    for number, data in enumerate(read_messages(path, ATTITUDE_TOPIC), start=1):
        entry = _sample(data)
        if isinstance(entry, Refusal):
            raise InputError(f"{path}: message {number} of {ATTITUDE_TOPIC}: {entry.detail}")
        if entry is not None:
            yield entry


def _sample(data: bytes) -> AttitudeSample | Refusal | None:
    try:
        form = _decoder.decode(data)
    except NOT_JSON as error:
        return Refusal("format", f"is not a hilstar attitude ({error})")
    if not form.accepted:
        return None
    if form.t_ns is None or form.q is None:
        return Refusal("format", "is accepted, but lacks t_ns or q")
    return checked_sample(form.t_ns, form.q, form.rate, form.sequence or 0, form.discontinuity)
