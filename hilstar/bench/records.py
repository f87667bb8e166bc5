"""What a ledger keeps of a run, and how it is read again."""

from __future__ import annotations

import os
import resource
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.mcap_log import ATTITUDE_TOPIC, read_messages, read_metadata, read_topics
from hilstar.bench.config import BenchConfig
from hilstar.bench.loop import Shown
from hilstar.errors import InputError

FRAME_TOPIC, PROCESS_TOPIC, EVENT_TOPIC = "/frame", "/process", "/event"
FRAME_SCHEMA_NAME, PROCESS_SCHEMA_NAME, EVENT_SCHEMA_NAME = "hilstar.Frame", "hilstar.Process", "hilstar.Event"
HEAD = "hilstar"


class FrameRecord(msgspec.Struct, kw_only=True):
    """One frame; times ns: `t_ns` of the timeline, `light_ns` of the bench's clock, the others of this host's.

    `q` is the attitude at `light_ns`, when the middle row lights, and `rate` (rad/s, cam) the turn for which paths were
    drawn, null where stars are points. `capped` counts the stars whose paths are coarser than they should be,
    `missed_before` the refresh periods before it without a frame, `missed` those of the run, and `marker` is the photodiode
    square. `operator` says what an operator's keys changed of the sky ("blank, grid"; under a blank or a patch `q` is null),
    `hidden` why the window was not seen; "" for neither.
    """

    frame: int
    t_ns: int
    light_ns: int
    draw_ns: int
    predicted_swap_ns: int | None = None
    swap_ns: int
    timestamp_source: str = "headless"
    q: tuple[float, float, float, float] | None = None
    rate: tuple[float, float, float] | None = None
    attitude_sequence: int | None = None
    attitude_t_ns: int | None = None
    receive_ns: int | None = None
    age_ns: int | None = None
    prediction_ns: int = 0
    stale: bool = False
    stars_drawn: int = 0
    clipped: int = 0
    below_step: int = 0
    capped: int = 0
    missed_before: int = 0
    missed: int = 0
    marker: int | None = None
    operator: str = ""
    hidden: str = ""


_KINDS: dict[Any, str] = {int: "integer", float: "number", int | None: "integer", str: "string", bool: "boolean"}


def schema_of(record: type[msgspec.Struct], title: str) -> bytes:
    """The JSON schema of a record, of plain types only (see `attitude.mcap_log.ATTITUDE_SCHEMA`)."""
    array = {"type": "array", "items": {"type": "number"}}
    fields = {f.name: {"type": _KINDS[f.type]} if f.type in _KINDS else array for f in msgspec.structs.fields(record)}
    return msgspec.json.encode({"title": title, "type": "object", "properties": fields})


_frame_decoder = msgspec.json.Decoder(FrameRecord)


def frame_record(shown: Shown, light_ns: int, missed: int) -> FrameRecord:
    """What the ledger keeps of a frame; `light_ns` is on the bench's clock, `missed` counts the run's missed frames so far."""
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
        below_step=drawn.below_step,
        capped=drawn.capped,
        missed_before=shown.missed_before,
        missed=missed,
        marker=shown.marker,
        operator=shown.on_screen.operator,
        hidden=shown.on_screen.hidden,
    )
    if drawn.turn is not None:
        x, y, z = drawn.turn.rate_cam_rad_s.tolist()
        record.rate = (x, y, z)
    if attitude is not None:
        w, x, y, z = attitude.q_icrs_to_cam.tolist()
        record.q = (w, x, y, z)
        record.attitude_sequence = attitude.sequence
        record.attitude_t_ns = light_ns - attitude.age_ns
        record.receive_ns = attitude.received_ns
        record.age_ns = attitude.age_ns
        record.prediction_ns = attitude.prediction_ns
    return record


class ProcessRecord(msgspec.Struct, kw_only=True):
    """What the process takes of the machine at a moment of host time, ns."""

    host_ns: int
    resident_bytes: int
    cpu_s: float


class EventRecord(msgspec.Struct, kw_only=True):
    """Something that happened in a run (see `hilstar.notices`): host time, ns, its kind, and what was said."""

    host_ns: int
    kind: str
    detail: str


def process_record() -> ProcessRecord:
    """Of this process, now."""
    with Path("/proc/self/statm").open("rb") as file:
        pages = int(file.read().split()[1])
    used = resource.getrusage(resource.RUSAGE_SELF)
    size = os.sysconf("SC_PAGE_SIZE")
    return ProcessRecord(host_ns=time.monotonic_ns(), resident_bytes=pages * size, cpu_s=used.ru_utime + used.ru_stime)


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


def past_frames(path: Path) -> Iterator[PastFrame]:
    """The frames of a ledger, to be drawn again. Raises InputError for damage."""
    for record in frame_records(path):
        q, rate = (None if part is None else np.array(part) for part in (record.q, record.rate))
        yield PastFrame(record.frame, record.t_ns, record.swap_ns, q, rate)


class _PacketForm(msgspec.Struct):
    accepted: bool = True
    reason: str | None = None


@dataclass(slots=True)
class Run:
    """A whole ledger: its head, its frames, the process's state, and packets by "accepted" or why they were refused."""

    head: dict[str, str]
    frames: list[FrameRecord] = field(default_factory=list)
    process: list[ProcessRecord] = field(default_factory=list)
    packets: dict[str, int] = field(default_factory=dict)


def read_run(path: Path) -> Run:
    """Read a ledger. Raises InputError for a file that is none, or has no frame, or is damaged."""
    try:
        run = Run(read_metadata(path, HEAD))
        decoders: dict[str, msgspec.json.Decoder[Any]] = {
            FRAME_TOPIC: _frame_decoder,
            PROCESS_TOPIC: msgspec.json.Decoder(ProcessRecord),
            ATTITUDE_TOPIC: msgspec.json.Decoder(_PacketForm),
        }
        for number, (topic, data) in enumerate(read_topics(path), start=1):
            if topic in decoders:
                _take(run, _decoded(decoders[topic], data, f"{path}: message {number}, of {topic},"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give the ledger of a run") from error
    if not run.frames:
        raise InputError(f"{path}: has no frames; give the ledger of serve or replay --ledger")
    return run


def config_of(run: Run) -> BenchConfig | None:
    """The bench file of a run, from its ledger's head; None where that holds none that can be read."""
    try:
        return msgspec.convert(tomllib.loads(run.head.get("bench_text", "")), BenchConfig)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError):
        return None


def _take(run: Run, record: FrameRecord | ProcessRecord | _PacketForm) -> None:
    if isinstance(record, FrameRecord):
        run.frames.append(record)
    elif isinstance(record, ProcessRecord):
        run.process.append(record)
    else:
        key = "accepted" if record.accepted else (record.reason or "format").split(":")[0]
        run.packets[key] = run.packets.get(key, 0) + 1
