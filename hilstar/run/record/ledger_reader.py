"""Reading a ledger: its head, its records in their order, and the frames that are to be drawn again."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from hilstar.attitude.logs.mcap_log import ATTITUDE_TOPIC, RUN_METADATA, read_messages, read_metadata, read_topics
from hilstar.attitude.wire.packet import MAX_PLACE_KM, MAX_SPEED_KM_S, MIN_PLACE_KM, Refusal, checked_sample, rate_refusal
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.bench.config import BenchConfig
from hilstar.errors import InputError, cannot_read
from hilstar.reading import NOT_JSON, parse_toml
from hilstar.run.record.ledger_records import (
    COUNT_TOPIC,
    EVENT_TOPIC,
    FAULT_TOPIC,
    FRAME_TOPIC,
    PROCESS_TOPIC,
    CountRecord,
    EventRecord,
    FaultRecord,
    FrameRecord,
    PacketForm,
    ProcessRecord,
    RunRecord,
)

NO_FRAMES = "has no frames; give the ledger of serve or replay --ledger"
MAX_REASONS, MAX_REASON_CHARACTERS = 50, 40

_frame_decoder = msgspec.json.Decoder(FrameRecord)


def frame_records(path: Path) -> Iterator[FrameRecord]:
    """The frames of a ledger as they were written, none if the file is no ledger. Raises InputError for damage."""
    for number, data in enumerate(read_messages(path, FRAME_TOPIC), start=1):
        yield _decoded(_frame_decoder, data, f"{path}: message {number} of {FRAME_TOPIC}")


def fault_records(path: Path) -> Iterator[FaultRecord]:
    """The beginnings and ends of faults in a ledger. Raises InputError for damage.

    That its end is missing is said by whoever reads its frames.
    """
    decoder = msgspec.json.Decoder(FaultRecord)
    for number, data in enumerate(read_messages(path, FAULT_TOPIC, tell=False), start=1):
        yield _decoded(decoder, data, f"{path}: message {number} of {FAULT_TOPIC}")


def _decoded(decoder: msgspec.json.Decoder[Any], data: bytes, where: str) -> Any:
    try:
        return decoder.decode(data)
    except NOT_JSON as error:
        raise InputError(f"{where} is not one of hilstar's ({error})") from error


def drawable_frames(path: Path, max_rate_rad_s: float = math.inf) -> Iterator[FrameRecord]:
    """The frames of a ledger, to be drawn again. Raises InputError for damage, and for what the wire would refuse."""
    for number, record in enumerate(frame_records(path), start=1):
        wrong = wrong_in_frame(record, max_rate_rad_s)
        if wrong:
            raise InputError(f"{path}: message {number} of {FRAME_TOPIC}: {wrong}")
        yield record


def wrong_in_frame(record: FrameRecord, max_rate_rad_s: float = math.inf) -> str:
    """What the wire would refuse of a frame; "" where it can be drawn again."""
    if record.q is not None:
        sample = checked_sample(record.t_ns, record.q, record.rate)
        refusal = sample if isinstance(sample, Refusal) else rate_refusal(sample, max_rate_rad_s)
        if refusal is not None:
            return refusal.detail
    if math.hypot(*(record.velocity_km_s or ())) > MAX_SPEED_KM_S:
        return f"a velocity over {MAX_SPEED_KM_S:g} km/s"
    if record.place_km is not None and not MIN_PLACE_KM < math.hypot(*record.place_km) < MAX_PLACE_KM:
        return f"a place beyond {MIN_PLACE_KM:g} to {MAX_PLACE_KM:g} km"
    return ""


def run_records(path: Path) -> Iterator[RunRecord]:
    """The records of a ledger, in order. Raises InputError for a file that is no ledger or is damaged."""
    decoders: dict[str, msgspec.json.Decoder[Any]] = {
        FRAME_TOPIC: _frame_decoder,
        PROCESS_TOPIC: msgspec.json.Decoder(ProcessRecord),
        ATTITUDE_TOPIC: msgspec.json.Decoder(PacketForm),
        COUNT_TOPIC: msgspec.json.Decoder(CountRecord),
        EVENT_TOPIC: msgspec.json.Decoder(EventRecord),
    }
    try:
        for number, (topic, data) in enumerate(read_topics(path), start=1):
            if topic in decoders:
                record = _decoded(decoders[topic], data, f"{path}: message {number}, of {topic},")
                if isinstance(record, FrameRecord) and record.q is not None and not _is_unit(record.q):
                    raise InputError(f"{path}: message {number}, of {topic}: {wrong_in_frame(record)}")
                yield record
    except OSError as error:
        raise cannot_read(path, error, "give the ledger of a run") from error


def _is_unit(q: tuple[float, float, float, float]) -> bool:
    """Whether a quaternion is one as `checked_sample` has it, which costs ten times as much."""
    return abs(math.hypot(*q) - 1.0) <= NORM_TOLERANCE


class PacketTally:
    """The number of packets, accepted or by the reason for their refusal."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}

    def add(self, record: RunRecord) -> None:
        """Add a recorded packet, or a count of packets."""
        if isinstance(record, PacketForm):
            self._count("accepted" if record.accepted else (record.reason or "format").split(":")[0], 1)
        elif isinstance(record, CountRecord) and record.kind == "packet":
            self._count(record.reason, record.count)

    def _count(self, reason: str, number: int) -> None:
        key = reason[:MAX_REASON_CHARACTERS] if len(self.counts) < MAX_REASONS or reason in self.counts else "others"
        self.counts[key] = self.counts.get(key, 0) + number


@dataclass(slots=True)
class Run:
    """A whole ledger in memory: its head, its frames, the process's state, and packets by "accepted" or why refused."""

    head: dict[str, str]
    frames: list[FrameRecord] = field(default_factory=list)
    process: list[ProcessRecord] = field(default_factory=list)
    packets: dict[str, int] = field(default_factory=dict)


def read_run(path: Path) -> Run:
    """Read a ledger of a short run. Raises InputError for a file that is no ledger, has no frame, or is damaged."""
    run, tally = Run(read_head(path)), PacketTally()
    for record in run_records(path):
        tally.add(record)
        if isinstance(record, FrameRecord):
            run.frames.append(record)
        elif isinstance(record, ProcessRecord):
            run.process.append(record)
    if not run.frames:
        raise InputError(f"{path}: {NO_FRAMES}")
    run.packets = tally.counts
    return run


def read_head(path: Path) -> dict[str, str]:
    """The head of a ledger, {} if there is none. Raises InputError for damage."""
    try:
        return read_metadata(path, RUN_METADATA)
    except OSError as error:
        raise cannot_read(path, error, "give the ledger of a run") from error


def config_of(head: dict[str, str]) -> BenchConfig | None:
    """The configuration of a run, from its ledger's head; None if that holds none that can be read."""
    try:
        return msgspec.convert(parse_toml(Path("the ledger's head"), head.get("bench_text", "")), BenchConfig)
    except (InputError, msgspec.ValidationError, RecursionError):
        return None
