"""What a ledger keeps of a run, and how it is read again."""

from __future__ import annotations

import contextlib
import math
import os
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.mcap_log import ATTITUDE_TOPIC
from hilstar.attitude.logs.mcap_reader import RUN_METADATA, read_messages, read_metadata, read_topics
from hilstar.attitude.wire.packet import Refusal, checked_sample, rate_refusal
from hilstar.bench.config import BenchConfig
from hilstar.bench.frame import Bench
from hilstar.errors import InputError, cannot_read
from hilstar.reading import parse_toml
from hilstar.run.shown import Shown

FRAME_TOPIC, PROCESS_TOPIC, EVENT_TOPIC, COUNT_TOPIC = "/frame", "/process", "/event", "/not_kept"


NO_FRAMES = "has no frames; give the ledger of serve or replay --ledger"
MAX_REASONS, MAX_REASON_CHARACTERS = 50, 40
HostNs = Annotated[int, msgspec.Meta(ge=0, le=2**62)]  # of this host's clock, which began at its start
AnyNs = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]  # of a sender's clock, or between it and the host's
Marker = Annotated[int, msgspec.Meta(ge=0, le=1)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]


class FrameRecord(msgspec.Struct, kw_only=True):
    """One frame; times ns: `t_ns` of the timeline, `light_ns` of the bench's clock, the others of this host's.

    `q` is the attitude at `light_ns`, when the middle row lights, and `rate` (rad/s, cam) the turn for which paths were
    drawn, null where stars are points. `capped` counts the stars whose paths are coarser than they should be,
    `missed_before` the refresh periods before it without a frame, `missed` those of the run, and `marker` is the photodiode
    square. `operator` says what an operator's keys changed of the sky ("blank, grid"; under a blank or a patch `q` is null),
    `hidden` why the window was not seen; "" for neither.
    """

    frame: Count
    t_ns: AnyNs
    light_ns: AnyNs
    draw_ns: HostNs
    predicted_swap_ns: HostNs | None = None
    swap_ns: HostNs
    timestamp_source: str = "headless"
    q: tuple[float, float, float, float] | None = None
    rate: tuple[float, float, float] | None = None
    attitude_sequence: int | None = None
    attitude_t_ns: AnyNs | None = None
    receive_ns: HostNs | None = None
    age_ns: AnyNs | None = None
    prediction_ns: AnyNs = 0
    stale: bool = False
    stars_drawn: Count = 0
    clipped: Count = 0
    below_step: Count = 0
    capped: Count = 0
    missed_before: Count = 0
    missed: Count = 0
    marker: Marker | None = None
    operator: str = ""
    hidden: str = ""


_KINDS: dict[Any, str] = {float: "number", str: "string", bool: "boolean"} | dict.fromkeys(
    (int, int | None, HostNs, HostNs | None, AnyNs, AnyNs | None, Count, Marker | None), "integer"
)


def schema_of(record: type[msgspec.Struct], title: str) -> bytes:
    """The JSON schema of a record, of plain types only (see `attitude.logs.mcap_log.ATTITUDE_SCHEMA`)."""
    array = {"type": "array", "items": {"type": "number"}}
    fields = {f.name: {"type": _KINDS[f.type]} if f.type in _KINDS else array for f in msgspec.structs.fields(record)}
    return msgspec.json.encode({"title": title, "type": "object", "properties": fields})


_frame_decoder = msgspec.json.Decoder(FrameRecord)


def frame_record(shown: Shown, light_ns: int, missed: int, below_step: int) -> FrameRecord:
    """What the ledger keeps of a frame; `light_ns` is on the bench's clock, `missed` counts the run's missed frames
    so far, and `below_step` the stars in view that are too faint for the monitor.
    """
    attitude, drawn = shown.attitude, shown.drawn
    record = FrameRecord(
        frame=shown.number,
        t_ns=shown.t_ns,
        light_ns=light_ns,
        draw_ns=shown.draw_ns,
        predicted_swap_ns=shown.predicted_swap_ns,
        swap_ns=shown.swap_ns,
        timestamp_source=shown.timestamp_source,
        stale=shown.stale,
        stars_drawn=drawn.star_count,
        clipped=len(drawn.clipped_hip),
        below_step=below_step,
        capped=drawn.capped,
        missed_before=shown.missed_before,
        missed=missed,
        marker=shown.marker,
        operator=shown.on_screen.operator,
        hidden=shown.on_screen.hidden,
    )
    if drawn.rate_cam_rad_s is not None:
        x, y, z = drawn.rate_cam_rad_s.tolist()
        record.rate = (x, y, z)
    if attitude is not None:
        w, x, y, z = attitude.q_icrs_to_cam.tolist()
        record.q = (w, x, y, z)
        record.attitude_sequence = attitude.sequence
        record.attitude_t_ns = _within_64_bits(light_ns - attitude.age_ns)
        record.receive_ns = attitude.received_ns
        record.age_ns = _within_64_bits(attitude.age_ns)
        record.prediction_ns = attitude.prediction_ns
    return record


def below_step(bench: Bench, shown: Shown) -> int:
    """How many stars in view of a frame are too faint for the monitor."""
    return 0 if shown.attitude is None else bench.count_faint(shown.attitude.q_icrs_to_cam)


def _within_64_bits(value_ns: int) -> int:
    return min(max(value_ns, -(2**63)), 2**63 - 1)


class ProcessRecord(msgspec.Struct, kw_only=True):
    """What the process takes of the machine at a moment of host time, ns."""

    host_ns: HostNs
    resident_bytes: Count
    cpu_s: float


class EventRecord(msgspec.Struct, kw_only=True):
    """Something that happened in a run (see `hilstar.notices`): host time, ns, its kind, and what was said."""

    host_ns: HostNs
    kind: str
    detail: str


class CountRecord(msgspec.Struct, kw_only=True):
    """What was only counted within a second, host time, ns: refused packets by reason, or what came too fast.

    `kind` is "packet", "frame" or "event"; `reason` that of a refusal, "accepted" of other packets, the kind of an event.
    """

    host_ns: HostNs
    kind: str
    reason: str
    count: Count


class ProcessProbe:
    """Asks what this process takes; opens its file once, for later there may be none to be had."""

    def __init__(self) -> None:
        self._fd: int | None = None
        with contextlib.suppress(OSError):
            self._fd = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)

    def record(self) -> ProcessRecord | None:
        """Of now; None where the system does not say."""
        if self._fd is None:
            return None
        try:
            pages = int(os.pread(self._fd, 128, 0).split()[1])
        except (OSError, ValueError, IndexError):
            return None
        used = resource.getrusage(resource.RUSAGE_SELF)
        size = os.sysconf("SC_PAGE_SIZE")
        return ProcessRecord(host_ns=time.monotonic_ns(), resident_bytes=pages * size, cpu_s=used.ru_utime + used.ru_stime)

    def close(self) -> None:
        """Close its file."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None


@dataclass(frozen=True, slots=True)
class PastFrame:
    """A frame of an earlier run: its number, its time, when it was swapped in (host time), and its attitude (None: blank).

    `rate_cam_rad_s` is the turn for which its paths were drawn, None where stars are points.
    """

    number: int
    t_ns: int
    swap_ns: int
    q_icrs_to_cam: FloatArray | None
    rate_cam_rad_s: FloatArray | None


def frame_records(path: Path) -> Iterator[FrameRecord]:
    """The frames of a ledger as they were written, none where the file is no ledger. Raises InputError for damage."""
    for number, data in enumerate(read_messages(path, FRAME_TOPIC), start=1):
        yield _decoded(_frame_decoder, data, f"{path}: message {number} of {FRAME_TOPIC}")


def _decoded(decoder: msgspec.json.Decoder[Any], data: bytes, where: str) -> Any:
    try:
        return decoder.decode(data)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise InputError(f"{where} is not one of hilstar's ({error})") from error


def past_frames(path: Path, max_rate_rad_s: float = math.inf) -> Iterator[PastFrame]:
    """The frames of a ledger, to be drawn again. Raises InputError for damage, and for what the wire would refuse."""
    for number, record in enumerate(frame_records(path), start=1):
        if record.q is None:
            yield PastFrame(record.frame, record.t_ns, record.swap_ns, None, None)
            continue
        sample = checked_sample(record.t_ns, record.q, record.rate)
        refusal = sample if isinstance(sample, Refusal) else rate_refusal(sample, max_rate_rad_s)
        if refusal is not None:
            raise InputError(f"{path}: message {number} of {FRAME_TOPIC}: {refusal.detail}")
        rate = None if record.rate is None else np.array(record.rate)
        yield PastFrame(record.frame, record.t_ns, record.swap_ns, np.array(record.q), rate)


class PacketForm(msgspec.Struct):
    """What a report reads of a packet."""

    accepted: bool = True
    reason: str | None = None


RunRecord = FrameRecord | ProcessRecord | PacketForm | CountRecord | EventRecord


def run_records(path: Path) -> Iterator[RunRecord]:
    """What a ledger holds, in its order. Raises InputError for a file that is none, or is damaged."""
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
                yield _decoded(decoders[topic], data, f"{path}: message {number}, of {topic},")
    except OSError as error:
        raise cannot_read(path, error, "give the ledger of a run") from error


class PacketTally:
    """How many packets there were, "accepted" or by why they were refused."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}

    def add(self, record: RunRecord) -> None:
        """Count a packet that was kept, or those that were only counted."""
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
    """Read a ledger of a short run. Raises InputError for a file that is none, or has no frame, or is damaged."""
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
    """The head of a ledger, {} where there is none. Raises InputError for damage."""
    try:
        return read_metadata(path, RUN_METADATA)
    except OSError as error:
        raise cannot_read(path, error, "give the ledger of a run") from error


def config_of(head: dict[str, str]) -> BenchConfig | None:
    """The bench file of a run, from its ledger's head; None where that holds none that can be read."""
    try:
        return msgspec.convert(parse_toml(Path("the ledger's head"), head.get("bench_text", "")), BenchConfig)
    except (InputError, msgspec.ValidationError, RecursionError):
        return None
