"""The ledger of a run: every packet as received and every frame as drawn, in an MCAP file that survives a kill.

Messages are written without chunks, so that whatever was handed to the system is whole; a thread of its own does it, so that
no disk stops a frame. A disk that is full ends the ledger with an alarm, and never the display.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import msgspec
import numpy as np
from mcap.exceptions import McapError
from mcap.writer import Writer

from hilstar.arrays import FloatArray
from hilstar.attitude.mcap_log import attitude_message, log_time_ns, read_messages, refused_message, register_attitudes
from hilstar.attitude.packet import AttitudeSample, Refusal
from hilstar.bench.assembly import Bench
from hilstar.bench.loop import Shown
from hilstar.errors import InputError

FRAME_TOPIC = "/frame"
FRAME_SCHEMA_NAME = "hilstar.Frame"
FLUSH_S = 0.2
WAITING_MESSAGES = 100_000  # a disk that stands still for minutes; then frames go unrecorded, counted
log = logging.getLogger(__name__)


class FrameRecord(msgspec.Struct, kw_only=True):
    """One frame; times ns: `t_ns` of the timeline, `light_ns` of the bench's clock, the others of this host's."""

    frame: int
    t_ns: int
    light_ns: int
    draw_ns: int
    shown_ns: int
    timestamp_source: str = "headless"
    q: tuple[float, float, float, float] | None = None
    attitude_sequence: int | None = None
    attitude_t_ns: int | None = None
    receive_ns: int | None = None
    age_ns: int | None = None
    prediction_ns: int = 0
    stale: bool = False
    stars_drawn: int = 0
    clipped: int = 0
    missed: int = 0


_KINDS = {int: "integer", int | None: "integer", str: "string", bool: "boolean"}
FRAME_SCHEMA = msgspec.json.encode(
    {
        "title": FRAME_SCHEMA_NAME,
        "type": "object",
        "properties": {
            field.name: {"type": _KINDS[field.type]} if field.type in _KINDS else {"type": "array", "items": {"type": "number"}}
            for field in msgspec.structs.fields(FrameRecord)
        },
    }
)
_frame_decoder = msgspec.json.Decoder(FrameRecord)


def frame_record(shown: Shown, light_ns: int, missed: int) -> FrameRecord:
    """What the ledger keeps of a frame; `light_ns` is on the bench's clock, `missed` counts the run's missed frames so far."""
    attitude, drawn = shown.attitude, shown.drawn
    record = FrameRecord(
        frame=shown.number,
        t_ns=shown.t_ns,
        light_ns=light_ns,
        draw_ns=shown.draw_ns,
        shown_ns=shown.shown_ns,
        timestamp_source=shown.timestamp_source,
        stale=shown.stale,
        stars_drawn=drawn.star_count,
        clipped=len(drawn.clipped_hip),
        missed=missed,
    )
    if attitude is not None:
        w, x, y, z = attitude.q_icrs_to_cam.tolist()
        record.q = (w, x, y, z)
        record.attitude_sequence = attitude.sequence
        record.attitude_t_ns = light_ns - attitude.age_ns
        record.receive_ns = attitude.received_ns
        record.age_ns = attitude.age_ns
        record.prediction_ns = attitude.prediction_ns
    return record


class Ledger:
    """Writes a run's MCAP file. Raises InputError where it cannot be begun."""

    def __init__(self, path: Path, bench: Bench) -> None:
        self.path = path
        self.failure: str | None = None
        self.unrecorded = 0
        self._waiting: queue.SimpleQueue[tuple[str, int, int, Any] | None] = queue.SimpleQueue()
        try:
            self._file: IO[bytes] = path.open("wb")
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place for the ledger") from error
        self._writer = Writer(self._file, use_chunking=False)
        try:
            self._begin(bench)
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.close()
            raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place for the ledger") from error
        self._thread = threading.Thread(target=self._run, name="hilstar-ledger", daemon=True)
        self._thread.start()

    def _begin(self, bench: Bench) -> None:
        self._writer.start(profile="", library="hilstar")
        schema = self._writer.register_schema(FRAME_SCHEMA_NAME, "jsonschema", FRAME_SCHEMA)
        self._channels = {
            "attitude": register_attitudes(self._writer),
            "frame": self._writer.register_channel(FRAME_TOPIC, "json", schema),
        }
        head = {
            "bench_sha256": bench.bench_hash,
            "bench_file": str(bench.path),
            "bench_text": bench.path.read_text(encoding="utf-8"),
            "calibration": bench.calibration.name,
            "calibration_sha256": bench.calibration.sha256,
            "gl_renderer": bench.renderer.gl_renderer,
            "monotonic_ns": str(time.monotonic_ns()),
            "unix_ns": str(time.time_ns()),
        }
        self._writer.add_metadata("hilstar", head)
        self._file.flush()

    def packet(self, host_ns: int, raw: bytes, sample: AttitudeSample | None, refusal: Refusal | None) -> None:
        """Keep a packet; see `attitude.receiver.Watch`."""
        self._put(("attitude", host_ns, 0 if sample is None else sample.sequence, (raw, sample, refusal)))

    def frame(self, record: FrameRecord) -> None:
        """Keep a frame."""
        self._put(("frame", record.shown_ns, record.frame, record))

    def _put(self, item: tuple[str, int, int, Any]) -> None:
        if self.failure is not None or self._waiting.qsize() > WAITING_MESSAGES:
            self.unrecorded += 1
            return
        self._waiting.put(item)

    def _run(self) -> None:
        flushed_s = time.monotonic()
        while True:
            try:
                item = self._waiting.get(timeout=FLUSH_S)
            except queue.Empty:
                item = ("", 0, 0, None)
            try:
                if item is None:
                    return
                if item[0]:
                    self._write(*item)
                if time.monotonic() - flushed_s > FLUSH_S:
                    self._file.flush()
                    flushed_s = time.monotonic()
            except (OSError, ValueError, McapError) as error:
                self._fail(error)
                return

    def _write(self, kind: str, time_ns: int, sequence: int, content: Any) -> None:
        data = msgspec.json.encode(content) if kind == "frame" else _packet_message(time_ns, *content)
        log_ns = log_time_ns(time_ns)
        self._writer.add_message(self._channels[kind], log_ns, data, log_ns, sequence % 2**32)

    def _fail(self, error: Exception) -> None:
        self.failure = str(getattr(error, "strerror", None) or error)
        log.error("%s: the ledger ends here (%s); the display goes on", self.path, self.failure)

    def close(self) -> None:
        """Write what waits, and the end of the file."""
        self._waiting.put(None)
        self._thread.join()
        try:
            if self.failure is None:
                self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
        except OSError as error:
            if self.failure is None:
                self._fail(error)

    def summary(self) -> dict[str, str | int | None]:
        """Where it is, and what went wrong."""
        return {"path": str(self.path), "failure": self.failure, "unrecorded": self.unrecorded}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _packet_message(host_ns: int, raw: bytes, sample: AttitudeSample | None, refusal: Refusal | None) -> bytes:
    if refusal is not None or sample is None:
        reason, detail = ("format", "") if refusal is None else (refusal.reason, refusal.detail)
        return refused_message(reason, detail, host_ns, raw)
    return attitude_message(sample, host_ns, raw)


@dataclass(frozen=True, slots=True)
class PastFrame:
    """A frame of an earlier run: its number, its time, when it was shown (host time), and its attitude (None: blank)."""

    number: int
    t_ns: int
    shown_ns: int
    q_icrs_to_cam: FloatArray | None


def past_frames(path: Path) -> Iterator[PastFrame]:
    """The frames of a ledger, none where the file is no ledger. Raises InputError for damage."""
    for number, data in enumerate(read_messages(path, FRAME_TOPIC), start=1):
        try:
            record = _frame_decoder.decode(data)
        except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: message {number} of {FRAME_TOPIC} is not a frame of hilstar ({error})") from error
        q = None if record.q is None else np.array(record.q)
        yield PastFrame(record.frame, record.t_ns, record.shown_ns, q)
