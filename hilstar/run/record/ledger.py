"""The ledger of a run: every packet as received and every frame as drawn, in an MCAP file that survives a kill.

A thread of its own writes a chunk five times a second, whole and with its CRC, so that no disk stops a frame. In a flood
the first are kept whole and the others counted second by second. When a disk fills up, frames are dropped first and packets
last; a disk that fails is tried again, and never ends the display. Where somebody deletes, truncates or overwrites the file,
that is said and the run goes on in another, for nobody could read the rest of the first.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec

from hilstar.attitude.logs.mcap_log import (
    ATTITUDE_TOPIC_OF_RUN,
    RUN_METADATA,
    McapWriter,
    Topic,
    attitude_message,
    log_time_ns,
    part_path,
    refused_message,
)
from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.bench.frame import Bench
from hilstar.errors import InputError, cannot_write, printable
from hilstar.files import NewFile
from hilstar.notices import Notice, Notices
from hilstar.process.interrupts import caught
from hilstar.run.record.backlog import Backlog, Entry, Kind, ReceivedPacket
from hilstar.run.record.flood_sieve import Sieve
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
    ProcessRecord,
    schema_of,
)
from hilstar.run.record.process_probe import ProcessProbe

NO_ROOM = "no room"  # the reason given for lost messages
FLUSH_S = 0.2
EACH_S = 1.0  # how often counts, the process and the disk are looked at
MAX_CHUNK_BYTES = 1_000_000
MAX_RAW_BYTES = 1024  # of a message; every packet is shorter, a simulator's own messages may be cut
MAX_DETAIL_CHARACTERS = 200
DISK_WAITS_S, STOPPED_DISK_WAITS_S = 20.0, 0.4  # for a disk that stalls at the end, without and with a signal
MAX_REST_S = 60.0  # between two files begun because one was deleted, truncated or overwritten
STALLED_S = 5.0  # since the writer's last pass
LOW_SHARE, WELL_SHARE = 0.10, 0.12  # of the disk
FRAMES_RESERVE_BYTES, FRAMES_RESERVE_SHARE = 64_000_000, 0.02  # reserved for packets, the smaller of the two


@dataclass(frozen=True, slots=True)
class Split:
    """When a ledger continues in another file."""

    bytes: float = math.inf
    seconds: float = math.inf


NO_SPLIT = Split()


class Ledger:
    """Writes a run's MCAP file. Raises InputError if it cannot be created."""

    def __init__(
        self,
        path: Path,
        bench: Bench,
        notices: Notices | None = None,
        overwrite: bool = False,
        split: Split = NO_SPLIT,
    ) -> None:
        self.path = self._asked = path
        self.failure: str | None = None
        self._notices = Notices() if notices is None else notices
        self._overwrite, self._split = overwrite, split
        self._head = _head_of(bench) | {"run_id": uuid.uuid4().hex}
        self._backlog, self._sieve = Backlog(), Sieve()
        self._lost = self._counted = 0
        self._thin = False
        self._part = 0
        self._renewed_s, self._rest_s = -math.inf, EACH_S
        self._moved = False
        self.standing: Callable[[], list[FaultRecord]] = list  # what a file has to know that begins in the middle of a run
        self._file, self._writer = self._begin(path, overwrite)
        self._notices.end("ledger-lost", "ledger-new", f"{path}: a new ledger is begun")
        self._begun_s = self._alive_s = time.monotonic()
        self._each_s = 0.0
        self._probe = ProcessProbe()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hilstar-ledger", daemon=True)
        self._thread.start()

    def _begin(self, path: Path, overwrite: bool) -> tuple[NewFile, McapWriter]:
        """Create a file and write its head. Raises InputError."""
        file = NewFile(path, overwrite)
        try:
            writer = McapWriter(file.fd, TOPICS, RUN_METADATA, self._head | {"part": str(self._part)})
            file.commit()
            file.note()
        except OSError as error:
            file.discard()
            raise cannot_write(path, error, "choose another place for the ledger") from error
        return file, writer

    @property
    def size_bytes(self) -> int:
        """The size of its newest file."""
        try:
            return os.fstat(self._file.fd).st_size
        except OSError:  # between two files
            return 0

    # Called by the run, from any thread

    def packet(self, host_ns: int, raw: bytes, sample: AttitudeSample | None, refusal: Refusal | None) -> None:
        """Record a packet; see `attitude.receiver.Watch`."""
        if refusal is None and sample is None:
            refusal = Refusal("format", "")
        if not self._sieve.keeps("packet", "accepted" if refusal is None else refusal.reason, host_ns):
            return
        sequence = 0 if sample is None else sample.sequence
        self._backlog.put(Entry("packet", host_ns, sequence, ReceivedPacket(raw[:MAX_RAW_BYTES], sample, refusal)))

    def frame(self, record: FrameRecord) -> None:
        """Record a frame."""
        self._backlog.put(Entry("frame", record.swap_ns, record.frame, record))
        if time.monotonic() - self._alive_s > STALLED_S:
            self._notices.begin(
                "ledger-stalled", f"{self.path}: the disk has accepted nothing for {STALLED_S:g} s; the display goes on"
            )

    def notice(self, notice: Notice) -> None:
        """Record an event of the run."""
        if self._sieve.keeps("event", notice.kind, notice.host_ns):
            record = EventRecord(host_ns=notice.host_ns, kind=notice.kind, detail=notice.detail, who=notice.who)
            self._backlog.put(Entry("event", notice.host_ns, 0, record))

    def fault(self, record: FaultRecord) -> None:
        """Record the beginning or the end of a fault; a replay needs each."""
        self._backlog.put(Entry("fault", record.host_ns, record.number, record))

    def pulse(self, what: str) -> None:
        """Count what became of a pulse: "sent", "skipped" or "lost"."""
        self._sieve.count("pulse", what)

    # The writer's thread

    def _run(self) -> None:
        while not self._closing.wait(FLUSH_S):
            self._turn(last=False)
        self._turn(last=True)
        with contextlib.suppress(OSError):
            self._file.close()

    def _turn(self, last: bool) -> None:
        try:
            self._look_at_file(last)
            for entry in self._backlog.take():
                self._take(entry)
            now_s = time.monotonic()
            if last or now_s - self._each_s >= EACH_S:
                self._each_s = now_s
                self._each_second()
            self._flush()
            self._file.note()
            if last:
                self._writer.finish()
            elif self._writer.size_bytes >= self._split.bytes or now_s - self._begun_s >= self._split.seconds:
                self._go_on_in_another()
        except Exception as error:  # no error ends the ledger or the run
            self._failed(error)
            if last:
                self._lose("packet", self._writer.drop())
        self._alive_s = time.monotonic()
        self._notices.end("ledger-stalled", "ledger-back", f"{self.path}: the disk accepts the ledger again")

    def _take(self, entry: Entry) -> None:
        if entry.kind == "frame" and self._thin:
            self._lose("frame", 1)
            return
        content, at_ns = entry.content, entry.time_ns
        data = _packet_message(at_ns, content) if isinstance(content, ReceivedPacket) else msgspec.json.encode(content)
        self._add(entry.kind, entry.time_ns, data, entry.sequence)

    def _add(self, key: str, time_ns: int, data: bytes, sequence: int = 0) -> None:
        self._writer.add(key, log_time_ns(time_ns), data, sequence)
        if self._writer.pending_bytes > MAX_CHUNK_BYTES:
            self._flush()

    def _each_second(self) -> None:
        now_ns = time.monotonic_ns()
        dropped, self._backlog.dropped = self._backlog.dropped, type(self._backlog.dropped)()
        for kind, number in dropped.items():
            self._lose(kind, number)
        for kind, reason, number in self._sieve.counted():
            self._counted += 0 if reason == NO_ROOM or kind == "pulse" else number
            record = CountRecord(host_ns=now_ns, kind=kind, reason=reason, count=number)
            self._add("count", now_ns, msgspec.json.encode(record))
        process = self._probe.record()
        if process is not None:
            self._add("process", now_ns, msgspec.json.encode(process))
        self._look_at_disk()

    def _look_at_file(self, last: bool) -> None:
        """Go on in another file where this one was deleted, truncated or overwritten."""
        harm = self._file.harm(self._writer.size_bytes, self._writer.crc)
        if harm is None:
            self._look_at_place()
        elif last or time.monotonic() - self._renewed_s > self._rest_s:
            self._renew(harm, last)

    def _renew(self, harm: str, last: bool) -> None:
        if self._renewed_s > 0:  # whoever does this again and again does not fill the disk with files
            self._rest_s = min(2 * self._rest_s, MAX_REST_S)
        self._renewed_s = time.monotonic()
        before, lost, part = part_path(self.path, self._part), self._writer.written, self._part
        self.failure = f"{before} was {harm} while it was written"
        self._part = 0
        try:
            path = _free_path(self._asked)
            file, writer = self._begin(path, overwrite=False)
        except InputError as error:
            self._part = part
            self._lost += lost if last else 0
            self._say_lost(f"{self.failure}, and no other can be begun: {error}; the display goes on")
            return
        self._say_lost(f"{self.failure}: {lost} messages in it may be lost; the ledger goes on in {path}")
        self._lost += lost
        writer.take_over(self._writer)
        old, self._file, self._writer, self.path = self._file, file, writer, path
        self._begun_s, self._moved = time.monotonic(), False
        for record in self.standing():
            self._add("fault", record.host_ns, msgspec.json.encode(record), record.number)
        old.close()

    def _say_lost(self, line: str) -> None:
        """Say it each time; it lasts until another ledger is begun."""
        if "ledger-lost" in self._notices.active:
            self._notices.tell("ledger-lost", line)
        else:
            self._notices.begin("ledger-lost", line)

    def _look_at_place(self) -> None:
        """Say once that the file has another name now: all of it is there."""
        if self._moved:
            return
        place = part_path(self.path, self._part)
        try:
            self._moved = not os.path.samestat(place.stat(), os.fstat(self._file.fd))
        except FileNotFoundError:
            self._moved = True
        if self._moved:
            self._notices.tell("ledger-moved", f"{place}: was moved while it is written; the ledger goes on where it is now")

    def _lose(self, kind: Kind | str, number: int) -> None:
        """Count messages that were lost for lack of room."""
        self._lost += number
        self._sieve.count("frame" if kind == "frame" else "packet" if kind == "packet" else "event", NO_ROOM, number)

    def _look_at_disk(self) -> None:
        disk = os.fstatvfs(self._file.fd)
        free, total = disk.f_bavail * disk.f_frsize, disk.f_blocks * disk.f_frsize
        if not total:
            return
        left = f"{self.path}: {free / 1e6:.0f} MB, {free / total:.0%} of the disk, is free"
        if free < LOW_SHARE * total:
            self._notices.begin("disk-low", left)
        elif free > WELL_SHARE * total:
            self._notices.end("disk-low", "disk-well", left)
        self._thin = free < min(FRAMES_RESERVE_BYTES, FRAMES_RESERVE_SHARE * total)
        if self._thin:
            self._notices.begin("ledger-thin", f"{left}: frames are no longer recorded, packets still are")
        else:
            self._notices.end("ledger-thin", "ledger-whole", f"{left}: frames are recorded again")

    def _flush(self) -> None:
        """Write the chunk; if there is no room for it, without its frames."""
        try:
            self._writer.flush()
        except OSError:
            self._lose("frame", self._writer.drop("frame"))
            try:
                self._writer.flush()
            except OSError as error:
                self._failed(error)
                if self._writer.pending_bytes > MAX_CHUNK_BYTES:
                    self._lose("packet", self._writer.drop())
                return
        self._notices.end("ledger-failed", "ledger-back", f"{self.path}: the ledger can be written again")

    def _failed(self, error: Exception) -> None:
        self.failure = str(getattr(error, "strerror", None) or f"{type(error).__name__} {error}".strip())
        self._notices.begin("ledger-failed", f"{self.path}: cannot be written ({self.failure}); the display goes on")

    def _go_on_in_another(self) -> None:
        """Open the next file, then finish this one."""
        self._part += 1
        try:
            file, writer = self._begin(part_path(self.path, self._part), self._overwrite)
        except InputError as error:
            self._part -= 1
            self._begun_s = time.monotonic()  # so that it is not tried at each pass
            self._notices.tell("ledger-split-failed", f"{error}; the ledger stays in its present file")
            return
        try:
            self._writer.finish()
            self._file.close()
        finally:
            self._file, self._writer, self._begun_s = file, writer, time.monotonic()

    # The end

    def close(self) -> None:
        """Write what is waiting and the end of the file; a disk that does not accept it in time has failed."""
        self._closing.set()
        patience_s = DISK_WAITS_S if caught() is None else STOPPED_DISK_WAITS_S
        self._thread.join(patience_s)
        if self._thread.is_alive():  # it still owns the file, so nothing more can be done
            self._failed(TimeoutError(f"the disk did not take its last messages within {patience_s:g} s"))
            return
        self._probe.close()

    def summary(self) -> dict[str, str | int | None]:
        """Its path, what went wrong, how many messages were lost, and how many of a flood were only counted."""
        lost = self._lost + sum(self._backlog.dropped.values())
        told: dict[str, str | int | None] = {"path": str(self.path), "failure": self.failure, "unrecorded": lost}
        if self._counted:
            told["only_counted"] = self._counted
        if self._part:
            told["files"] = self._part + 1
        return told

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _free_path(path: Path) -> Path:
    """RUN.next1.mcap, or the first such name that nothing has."""
    names = (path.with_name(f"{path.stem}.next{k}{path.suffix}") for k in itertools.count(1))
    return next(name for name in names if not os.path.lexists(name))


def _topic(name: str, schema_name: str, record: type[msgspec.Struct]) -> Topic:
    return Topic(name, schema_name, schema_of(record, schema_name))


TOPICS = {
    "packet": ATTITUDE_TOPIC_OF_RUN,
    "frame": _topic(FRAME_TOPIC, "hilstar.Frame", FrameRecord),
    "event": _topic(EVENT_TOPIC, "hilstar.Event", EventRecord),
    "process": _topic(PROCESS_TOPIC, "hilstar.Process", ProcessRecord),
    "count": _topic(COUNT_TOPIC, "hilstar.Count", CountRecord),
    "fault": _topic(FAULT_TOPIC, "hilstar.Fault", FaultRecord),
}


def _head_of(bench: Bench) -> dict[str, str]:
    return {
        "bench_sha256": bench.file.sha256,
        "bench_file": printable(str(bench.file.path)),
        "bench_text": bench.file.text,
        "calibration": bench.calibration.name,
        "calibration_sha256": bench.calibration.sha256,
        "gl_renderer": bench.renderer.gl_renderer,
        "gl_version": bench.renderer.gl_version,
        "render_path": bench.renderer.path,
        "monotonic_ns": str(time.monotonic_ns()),
        "unix_ns": str(time.time_ns()),
    }


def _packet_message(host_ns: int, packet: ReceivedPacket) -> bytes:
    sample, refusal = packet.sample, packet.refusal
    if refusal is not None or sample is None:
        reason, detail = ("format", "") if refusal is None else (refusal.reason, refusal.detail[:MAX_DETAIL_CHARACTERS])
        return refused_message(reason, detail, host_ns, packet.raw)
    return attitude_message(sample, host_ns, packet.raw)
