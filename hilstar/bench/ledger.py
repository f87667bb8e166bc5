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
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import msgspec
from mcap.exceptions import McapError
from mcap.writer import Writer

from hilstar.attitude.mcap_log import attitude_message, log_time_ns, refused_message, register_attitudes
from hilstar.attitude.packet import AttitudeSample, Refusal
from hilstar.bench.assembly import Bench
from hilstar.bench.records import (
    EVENT_SCHEMA_NAME,
    EVENT_TOPIC,
    FRAME_SCHEMA_NAME,
    FRAME_TOPIC,
    HEAD,
    PROCESS_SCHEMA_NAME,
    PROCESS_TOPIC,
    EventRecord,
    FrameRecord,
    ProcessRecord,
    process_record,
    schema_of,
)
from hilstar.errors import InputError, printable
from hilstar.interrupts import caught
from hilstar.notices import Notice

FLUSH_S = 0.2
PROCESS_S = 1.0
DISK_WAITS_S, STOPPED_DISK_WAITS_S = 20.0, 0.4  # for a disk that stands still at the end, without and with a signal
WAITING_MESSAGES = 100_000  # a disk that stands still for minutes; then frames go unrecorded, counted
log = logging.getLogger(__name__)


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
        self._channels = {
            "attitude": register_attitudes(self._writer),
            "frame": self._register(FRAME_TOPIC, FRAME_SCHEMA_NAME, FrameRecord),
            "event": self._register(EVENT_TOPIC, EVENT_SCHEMA_NAME, EventRecord),
            "process": self._register(PROCESS_TOPIC, PROCESS_SCHEMA_NAME, ProcessRecord),
        }
        head = {
            "bench_sha256": bench.bench_hash,
            "bench_file": printable(str(bench.path)),
            "bench_text": bench.path.read_text(encoding="utf-8"),
            "calibration": bench.calibration.name,
            "calibration_sha256": bench.calibration.sha256,
            "gl_renderer": bench.renderer.gl_renderer,
            "monotonic_ns": str(time.monotonic_ns()),
            "unix_ns": str(time.time_ns()),
        }
        self._writer.add_metadata(HEAD, head)
        self._file.flush()

    def _register(self, topic: str, name: str, record: type[msgspec.Struct]) -> int:
        schema = self._writer.register_schema(name, "jsonschema", schema_of(record, name))
        return self._writer.register_channel(topic, "json", schema)

    def packet(self, host_ns: int, raw: bytes, sample: AttitudeSample | None, refusal: Refusal | None) -> None:
        """Keep a packet; see `attitude.receiver.Watch`."""
        self._put(("attitude", host_ns, 0 if sample is None else sample.sequence, (raw, sample, refusal)))

    def frame(self, record: FrameRecord) -> None:
        """Keep a frame."""
        self._put(("frame", record.swap_ns, record.frame, record))

    def notice(self, notice: Notice) -> None:
        """Keep an event of the run."""
        record = EventRecord(host_ns=notice.host_ns, kind=notice.kind, detail=notice.detail)
        self._put(("event", notice.host_ns, 0, record))

    def _put(self, item: tuple[str, int, int, Any]) -> None:
        if self.failure is not None or self._waiting.qsize() > WAITING_MESSAGES:
            self.unrecorded += 1
            return
        self._waiting.put(item)

    def _run(self) -> None:
        flushed_s, looked_s = time.monotonic(), 0.0
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
                if time.monotonic() - looked_s > PROCESS_S:
                    looked_s = time.monotonic()
                    self._write("process", time.monotonic_ns(), 0, process_record())
                if time.monotonic() - flushed_s > FLUSH_S:
                    self._file.flush()
                    flushed_s = time.monotonic()
            except (OSError, ValueError, McapError) as error:
                self._fail(error)
                return

    def _write(self, kind: str, time_ns: int, sequence: int, content: Any) -> None:
        data = _packet_message(time_ns, *content) if kind == "attitude" else msgspec.json.encode(content)
        log_ns = log_time_ns(time_ns)
        self._writer.add_message(self._channels[kind], log_ns, data, log_ns, sequence % 2**32)

    def _fail(self, error: Exception) -> None:
        self.failure = str(getattr(error, "strerror", None) or error)
        log.error("%s: the ledger ends here (%s); the display goes on", self.path, self.failure)

    def close(self) -> None:
        """Write what waits, and the end of the file; a disk that does not take it in time has failed."""
        self._waiting.put(None)
        patience_s = DISK_WAITS_S if caught() is None else STOPPED_DISK_WAITS_S
        self._thread.join(patience_s)
        if self._thread.is_alive():  # and has the file: nothing more can be done with it
            self._fail(TimeoutError(f"the disk did not take its last messages within {patience_s:g} s"))
            return
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
