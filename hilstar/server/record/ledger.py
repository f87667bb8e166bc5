"""Writes the ledger of a run: every packet as received and every frame as drawn, in an MCAP file
that stays readable if the process is killed.

A separate thread writes a complete chunk with its CRC five times a second, so that no disk delays a
frame. In a flood the first messages are recorded whole and the others counted second by second.
When a disk fills up, frames are dropped first and packets last. A disk that fails is tried again
and never ends the display. If somebody deletes, truncates or overwrites the file, an event reports
it and the ledger continues in another file, because the rest of the first could not be read.
"""

import contextlib
import itertools
import json
import math
import os
import resource
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal, Self

import msgspec

from hilstar.attitude.logs.mcap_log import (
    ATTITUDE_TOPIC_OF_RUN,
    RUN_METADATA,
    JsonTopic,
    McapWriter,
    attitude_message,
    log_time_ns,
    part_path,
    refused_message,
)
from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.basics.allowance import Allowance
from hilstar.basics.errors import InputError, cannot_write, printable
from hilstar.basics.files import NewFile
from hilstar.basics.notices import Notice, Notices
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.interrupts import caught, stop_on_signal
from hilstar.basics.wrong_sky import BEGINS, ENDS
from hilstar.server.bench.certificate_file import certificate_number
from hilstar.server.bench.frame import Bench
from hilstar.server.record.ledger_records import (
    LOST,
    MAX_RAW_BYTES,
    RECORDS,
    AnswerRecord,
    CountRecord,
    EventRecord,
    FaultRecord,
    FrameRecord,
    ProcessRecord,
    raw_convention,
    schema_of,
)

Kind = Literal["packet", "frame", "event", "fault", "answer"]
MAX_WAITING_BYTES = 32_000_000  # half a minute of a plain run, if the disk stalls
FRAMES_SHARE = 0.5  # frames may use this share of it; the rest is for packets
# Approximate size of a JSON message and its objects; a packet's raw bytes are added.
ENTRY_BYTES = {"packet": 1500, "frame": 2500, "event": 1000, "fault": 4000, "answer": 4000}
NO_ROOM = "no room"  # the reason given for lost messages
FLUSH_S = 0.2
EACH_S = 1.0  # interval at which counts and the process are recorded and the disk is checked
MAX_CHUNK_BYTES = 1_000_000
MAX_DETAIL_CHARACTERS = 200
# How long `close` waits for a disk that stalls, without and after a signal that ends the run.
DISK_WAITS_S, STOPPED_DISK_WAITS_S = 20.0, 0.4
# Longest pause between new files after repeated damage, and the pause after a part that could not
# be begun.
MAX_REST_S = 60.0
STALLED_S = 5.0  # without a pass of the writer's thread the disk counts as stalled
# Free shares of the disk at which the warning begins and ends.
LOW_SHARE, WELL_SHARE = 0.10, 0.12
# Below the smaller of these frames are no longer recorded: the rest of the disk is for packets.
FRAMES_RESERVE_BYTES, FRAMES_RESERVE_SHARE = 64_000_000, 0.02
TOPICS = {"packet": ATTITUDE_TOPIC_OF_RUN} | {
    key: JsonTopic(topic, f"hilstar.{key.title()}", schema_of(record, f"hilstar.{key.title()}"))
    for key, (topic, record) in RECORDS.items()
}


@dataclass(frozen=True, slots=True)
class QueueEntry:
    """A message to be written: its kind, host time and sequence number. `encoded` makes its JSON
    when the writer's thread needs it; `raw_bytes` is the length of a packet's bytes in it.
    """

    kind: Kind
    time_ns: int
    sequence: int
    encoded: Callable[[], bytes]
    raw_bytes: int = 0

    @property
    def size_bytes(self) -> int:
        """Approximate size in memory, bytes."""
        return ENTRY_BYTES[self.kind] + self.raw_bytes


class LedgerQueue:
    """The messages that wait for the writer, in order of arrival, limited in bytes. Never waits
    for the disk. When it is full, frames are dropped before packets, and counted by kind.
    """

    def __init__(self) -> None:
        self._dropped: Counter[str] = Counter()
        self._entries: list[QueueEntry] = []
        self._bytes = 0
        self._lock = threading.Lock()

    def put(self, entry: QueueEntry) -> bool:
        """Queue an entry and return True; without room count it as dropped and return False."""
        room = MAX_WAITING_BYTES * (FRAMES_SHARE if entry.kind == "frame" else 1)
        with self._lock:
            if self._bytes + entry.size_bytes > room:
                self._dropped[entry.kind] += 1
                return False
            self._entries.append(entry)
            self._bytes += entry.size_bytes
            return True

    def take(self) -> list[QueueEntry]:
        """Remove and return all entries, oldest first."""
        with self._lock:
            taken = self._entries
            self._entries = []
            self._bytes = 0
        return taken

    def take_dropped(self) -> Counter[str]:
        """Remove and return the counts by kind of what was dropped."""
        with self._lock:
            dropped = self._dropped
            self._dropped = Counter()
        return dropped

    @property
    def dropped(self) -> int:
        """How many entries were dropped since their counts were taken."""
        with self._lock:
            return self._dropped.total()


Counted = Kind | Literal["pulse", "lost"]  # pulses and lost packets are only counted


class FloodFilter:
    """Decides in a flood which messages are recorded: the first of each kind and reason; the
    others are only counted.
    """

    # Burst, and messages a second. After the first ones refused packets add little information; no
    # sender sends more than 2000 good ones a second on purpose.
    ALLOWED: ClassVar[Mapping[str, tuple[int, int]]] = {
        "accepted": (4000, 2000),
        "refused": (20, 1),
        "event": (100, 10),
    }

    def __init__(self) -> None:
        self._allowances: dict[tuple[Kind, str], Allowance] = {}
        self._counts: Counter[tuple[Counted, str]] = Counter()
        self._lock = threading.Lock()

    def keeps(self, kind: Kind, reason: str, now_ns: int) -> bool:
        """Whether a message that arrives at `now_ns`, host time, is to be recorded in full. If not,
        it is counted.
        """
        with self._lock:
            allowance = self._allowances.get((kind, reason))
            if allowance is None:
                if kind == "event":
                    rule = "event"
                elif reason == "accepted":
                    rule = "accepted"
                else:
                    rule = "refused"
                allowance = self._allowances[kind, reason] = Allowance(*self.ALLOWED[rule])
            is_kept = allowance.take(now_ns)
            if not is_kept:
                self._counts[kind, reason] += 1
        return is_kept

    def count(self, kind: Counted, reason: str, number: int = 1) -> None:
        """Count `number` messages that are not recorded for another reason than a flood."""
        with self._lock:
            self._counts[kind, reason] += number

    def counted(self) -> Counter[tuple[Counted, str]]:
        """The counts since the last call, by kind and reason."""
        with self._lock:
            counts = self._counts
            self._counts = Counter()
        return counts


class ProcessProbe:
    """Measures the memory and CPU time of this process. Opens its file in /proc at the start,
    because the process may have no free descriptor later.
    """

    def __init__(self) -> None:
        self._fd: int | None = None
        with contextlib.suppress(OSError):
            self._fd = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)

    def record(self) -> ProcessRecord | None:
        """Resident memory and CPU time now; None where /proc cannot be read."""
        if self._fd is None:
            return None
        try:
            pages = int(os.pread(self._fd, 128, 0).split()[1])
        except (OSError, ValueError, IndexError):
            return None
        used = resource.getrusage(resource.RUSAGE_SELF)
        size = os.sysconf("SC_PAGE_SIZE")
        return ProcessRecord(
            host_ns=time.monotonic_ns(),
            resident_bytes=pages * size,
            cpu_s=used.ru_utime + used.ru_stime,
        )

    def close(self) -> None:
        """Close its file."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None


@dataclass(frozen=True, slots=True)
class SplitLimits:
    """The size, bytes, or age, s, at which a ledger continues in another file."""

    bytes: float = math.inf
    seconds: float = math.inf


NO_SPLIT = SplitLimits()


class Ledger(Closing):
    """Writes the MCAP file of a run, whose head describes `bench`. Raises InputError if it cannot
    be created.

    `path` is the newest file. `failure` says why it could not be written, None without a failure.
    """

    def __init__(
        self,
        path: Path,
        bench: Bench,
        notices: Notices | None = None,
        overwrite: bool = False,
        split: SplitLimits = NO_SPLIT,
    ) -> None:
        self.path = self._asked = path
        self.failure: str | None = None
        self._notices = Notices() if notices is None else notices
        self._overwrite = overwrite
        self._split = split
        self._head = {
            "bench_sha256": bench.file.sha256,
            "bench_file": printable(str(bench.file.path)),
            "bench_text": bench.file.text,
            "calibration": bench.calibration.name,
            "calibration_sha256": bench.calibration.sha256,
            "certificate": certificate_number(bench.file),
            "gl_renderer": bench.renderer.gl_renderer,
            "gl_version": bench.renderer.gl_version,
            "render_path": bench.renderer.path,
            "quantisation": bench.renderer.target.quantisation,
            "codes_ms": json.dumps(bench.config.render.codes_ms),
            "raw_convention": raw_convention(bench.config),
            "output": json.dumps(bench.output),
            # Both clocks at one moment: a report converts host times to UTC by them.
            "monotonic_ns": str(time.monotonic_ns()),
            "unix_ns": str(time.time_ns()),
            "run_id": uuid.uuid4().hex,
        }
        self._queue = LedgerQueue()
        self._filter = FloodFilter()
        self._lost = self._counted = self._part = 0
        self._thin = self._moved = False
        self._renewed_s = -math.inf
        self._rest_s = EACH_S
        self._split_after_s = -math.inf
        # The records with which a new file begins during a run: faults and a wrong sky that last.
        self.standing: Callable[[], list[FaultRecord | EventRecord]] = list
        self._file, self._writer = self._begin(path, overwrite)
        self._notices.end("ledger-lost", "ledger-new", f"{path}: a new ledger is begun")
        self._begun_s = self._alive_s = time.monotonic()
        self._each_s = 0.0
        self._probe = ProcessProbe()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hilstar-ledger", daemon=True)
        self._thread.start()

    def _begin(self, path: Path, overwrite: bool) -> tuple[NewFile, McapWriter]:
        file = NewFile(path, overwrite)
        try:
            writer = McapWriter(
                file.fd, TOPICS, RUN_METADATA, self._head | {"part": str(self._part)}
            )
            file.commit()
            file.note()
        except OSError as error:
            file.discard()
            raise cannot_write(path, error, "choose another place for the ledger") from error
        return file, writer

    @property
    def size_bytes(self) -> int:
        """The size of its newest file, bytes."""
        try:
            return os.fstat(self._file.fd).st_size
        except OSError:  # between two files
            return 0

    # Called by the run, from any thread

    def packet(
        self, host_ns: int, raw: bytes, sample: AttitudeSample | None, refusal: Refusal | None
    ) -> None:
        """Record a packet that arrived at host time `host_ns`: its attitude, or its `refusal`. See
        `attitude.receiver.Watch`.
        """
        raw = raw[:MAX_RAW_BYTES]
        if sample is not None and refusal is None:
            reason = "accepted"
            sequence = sample.sequence
            encoded = partial(attitude_message, sample, host_ns, raw)
        else:
            refusal = refusal or Refusal("format", "")
            sequence = 0 if sample is None else sample.sequence
            reason = refusal.reason
            detail = refusal.detail[:MAX_DETAIL_CHARACTERS]
            encoded = partial(refused_message, reason, detail, host_ns, raw)
        if self._filter.keeps("packet", reason, host_ns):
            self._queue.put(QueueEntry("packet", host_ns, sequence, encoded, len(raw)))

    def frame(self, record: FrameRecord) -> None:
        """Record a frame. Also reports a disk that stalls: the writer's thread cannot, while it
        waits for the disk.
        """
        self._queue.put(
            QueueEntry("frame", record.swap_ns, record.frame, partial(msgspec.json.encode, record))
        )
        if time.monotonic() - self._alive_s > STALLED_S:
            self._notices.begin(
                "ledger-stalled",
                f"{self.path}: the disk has accepted nothing for {STALLED_S:g} s; the display"
                " goes on",
            )

    def notice(self, notice: Notice) -> None:
        """Record an event of the run."""
        if self._filter.keeps("event", notice.kind, notice.host_ns):
            record = event_record(notice)
            self._queue.put(
                QueueEntry("event", notice.host_ns, 0, partial(msgspec.json.encode, record))
            )

    def stands(self, record: EventRecord) -> None:
        """Record an event that began before this ledger and lasts; no flood filter applies."""
        self._queue.put(
            QueueEntry("event", record.host_ns, 0, partial(msgspec.json.encode, record))
        )

    def fault(self, record: FaultRecord) -> None:
        """Record the beginning or end of a fault; no flood filter applies, because a replay needs
        each.
        """
        self._queue.put(
            QueueEntry("fault", record.host_ns, record.number, partial(msgspec.json.encode, record))
        )

    def answer(self, record: AnswerRecord) -> None:
        """Record an answer of the tracker."""
        if self._filter.keeps("answer", "accepted", record.host_ns):
            self._queue.put(
                QueueEntry("answer", record.host_ns, 0, partial(msgspec.json.encode, record))
            )

    def pulse(self, what: str) -> None:
        """Count a pulse by its outcome `what`: "sent", "skipped" or "lost" (see PULSES)."""
        self._filter.count("pulse", what)

    def lost(self, number: int) -> None:
        """Count `number` packets that a gap in their `sequence` shows as lost."""
        self._filter.count("lost", LOST, number)

    # The writer's thread

    def _run(self) -> None:
        while not self._closing.wait(FLUSH_S):
            self._turn(last=False)
        self._turn(last=True)
        with contextlib.suppress(OSError):
            self._file.close()

    def _turn(self, last: bool) -> None:
        """Write what is queued; `last` also the end of the file. No error leaves it."""
        try:
            harm = self._file.harm(self._writer.size_bytes, self._writer.crc)
            # At the end of a run a damaged file is replaced without the pause between new files.
            if harm is None:
                self._look_at_place()
            elif last or time.monotonic() - self._renewed_s > self._rest_s:
                self._renew(harm, last)
            for entry in self._queue.take():
                if entry.kind == "frame" and self._thin:
                    self._lose("frame", 1)
                else:
                    self._add(entry.kind, entry.time_ns, entry.encoded(), entry.sequence)
            now_s = time.monotonic()
            if last or now_s - self._each_s >= EACH_S:
                self._each_s = now_s
                self._each_second()
            self._flush()
            self._file.note()
            if last:
                self._writer.finish()
            elif self._is_whole(now_s):
                self._go_on_in_another()
        except Exception as error:  # no error ends the ledger or the run
            self._failed(error)
            if last:
                self._lose("packet", self._writer.drop())
        self._alive_s = time.monotonic()
        self._notices.end(
            "ledger-stalled", "ledger-back", f"{self.path}: the disk accepts the ledger again"
        )

    def _add(self, key: str, time_ns: int, data: bytes, sequence: int = 0) -> None:
        self._writer.add(key, log_time_ns(time_ns), data, sequence)
        if self._writer.pending_bytes > MAX_CHUNK_BYTES:
            self._flush()

    def _each_second(self) -> None:
        """Record the counts and the process, and check the disk."""
        now_ns = time.monotonic_ns()
        for kind, number in self._queue.take_dropped().items():
            self._lose(kind, number)
        for (kind, reason), number in self._filter.counted().items():
            # The summary counts what a flood left out; pulses and lost packets have no message.
            self._counted += 0 if reason == NO_ROOM or kind in {"pulse", "lost"} else number
            record = CountRecord(host_ns=now_ns, kind=kind, reason=reason, count=number)
            self._add("count", now_ns, msgspec.json.encode(record))
        process = self._probe.record()
        if process is not None:
            self._add("process", now_ns, msgspec.json.encode(process))
        self._look_at_disk()

    def _renew(self, harm: str, last: bool) -> None:
        """Continue in another file; `harm` is "deleted", "truncated" or "overwritten"."""
        if self._renewed_s > 0:  # repeated damage must not fill the disk with files
            self._rest_s = min(2 * self._rest_s, MAX_REST_S)
        self._renewed_s = time.monotonic()
        before = part_path(self.path, self._part)
        lost = self._writer.written
        part = self._part
        self.failure = f"{before} was {harm} while it was written"
        self._part = 0
        names = (
            self._asked.with_name(f"{self._asked.stem}.next{k}{self._asked.suffix}")
            for k in itertools.count(1)
        )
        path = next(name for name in names if not os.path.lexists(name))
        try:
            file, writer = self._begin(path, overwrite=False)
        except InputError as error:
            self._part = part
            self._lost += lost if last else 0
            self._say_lost(
                f"{self.failure}, and no other can be begun: {error}; the display goes on"
            )
            return
        self._say_lost(
            f"{self.failure}: {lost} messages in it may be lost; the ledger goes on in {path}"
        )
        self._lost += lost
        writer.take_over(self._writer)
        old = self._file
        self._file = file
        self._writer = writer
        self.path = path
        self._begun_s = time.monotonic()
        self._moved = False
        for record in self.standing():
            kind, number = (
                ("fault", record.number) if isinstance(record, FaultRecord) else ("event", 0)
            )
            self._add(kind, record.host_ns, msgspec.json.encode(record), number)
        old.close()

    def _say_lost(self, line: str) -> None:
        if "ledger-lost" in self._notices.active:
            self._notices.tell("ledger-lost", line)
        else:
            self._notices.begin("ledger-lost", line)

    def _look_at_place(self) -> None:
        """Report once that the file was moved: it is still written, at its new place."""
        if self._moved:
            return
        place = part_path(self.path, self._part)
        try:
            self._moved = not os.path.samestat(place.stat(), os.fstat(self._file.fd))
        except FileNotFoundError:
            self._moved = True
        if self._moved:
            self._notices.tell(
                "ledger-moved",
                f"{place}: was moved while it is written; the ledger goes on where it is now",
            )

    def _lose(self, kind: Kind | str, number: int) -> None:
        self._lost += number
        self._filter.count(
            kind if kind in {"frame", "packet", "answer"} else "event", NO_ROOM, number
        )

    def _look_at_disk(self) -> None:
        disk = os.fstatvfs(self._file.fd)
        free = disk.f_bavail * disk.f_frsize
        total = disk.f_blocks * disk.f_frsize
        if not total:
            return
        free_text = f"{self.path}: {free / 1e6:.0f} MB, {free / total:.0%} of the disk, is free"
        if free < LOW_SHARE * total:
            self._notices.begin("disk-low", free_text)
        elif free > WELL_SHARE * total:
            self._notices.end("disk-low", "disk-well", free_text)
        self._thin = free < min(FRAMES_RESERVE_BYTES, FRAMES_RESERVE_SHARE * total)
        if self._thin:
            self._notices.begin(
                "ledger-thin", f"{free_text}: frames are no longer recorded, packets still are"
            )
        else:
            self._notices.end(
                "ledger-thin", "ledger-whole", f"{free_text}: frames are recorded again"
            )

    def _flush(self) -> None:
        """Write the pending chunk; if that fails, without its frames, so that packets may fit."""
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
        self._notices.end(
            "ledger-failed", "ledger-back", f"{self.path}: the ledger can be written again"
        )

    def _failed(self, error: Exception) -> None:
        self.failure = str(
            getattr(error, "strerror", None) or f"{type(error).__name__} {error}".strip()
        )
        self._notices.begin(
            "ledger-failed", f"{self.path}: cannot be written ({self.failure}); the display goes on"
        )

    def _is_whole(self, now_s: float) -> bool:
        """Whether the next part of a split ledger is due, at `now_s` of the monotonic clock."""
        if now_s < self._split_after_s:
            return False
        is_full = self._writer.size_bytes >= self._split.bytes
        return is_full or now_s - self._begun_s >= self._split.seconds

    def _go_on_in_another(self) -> None:
        """Continue in the next part of a split ledger, or stay if it cannot be created."""
        self._part += 1
        try:
            file, writer = self._begin(part_path(self.path, self._part), self._overwrite)
        except InputError as error:
            self._part -= 1
            self._split_after_s = time.monotonic() + MAX_REST_S  # not tried at each pass
            self._notices.tell(
                "ledger-split-failed", f"{error}; the ledger stays in its present file"
            )
            return
        try:
            self._writer.finish()
            self._file.close()
        finally:
            self._file = file
            self._writer = writer
            self._begun_s = time.monotonic()

    # The end

    def close(self) -> None:
        """Write the queued messages and the end of the file. If the disk does not accept them in
        time (DISK_WAITS_S), the ledger has failed.
        """
        self._closing.set()
        if caught() is None:
            patience_s = DISK_WAITS_S
        else:
            patience_s = STOPPED_DISK_WAITS_S
        self._thread.join(patience_s)
        if self._thread.is_alive():  # it still owns the file, so nothing more can be done
            self._failed(
                TimeoutError(f"the disk did not take its last messages within {patience_s:g} s")
            )
            return
        self._probe.close()

    def summary(self) -> dict[str, str | int | None]:
        """The ledger in the run's summary: its `path`, its `failure` or None, the number of lost
        messages (`unrecorded`), of messages of a flood that were `only_counted`, and of its
        `files`, where there are several.
        """
        told: dict[str, str | int | None] = {
            "path": str(self.path),
            "failure": self.failure,
            "unrecorded": self._lost + self._queue.dropped,
        }
        if self._counted:
            told["only_counted"] = self._counted
        if self._part:
            told["files"] = self._part + 1
        return told


def event_record(notice: Notice) -> EventRecord:
    """The ledger's record of a notice."""
    return EventRecord(
        host_ns=notice.host_ns,
        kind=notice.kind,
        detail=notice.detail,
        who=notice.who,
        since_ns=notice.since_ns,
    )


class LedgerSwitch:
    """Passes the records of a run to the current ledger, which an operator may begin and end during
    the run; without a ledger they are dropped.

    Any thread may add records, and none waits. `begin` and `end` are for one thread at a time,
    which may wait for a disk.
    """

    def __init__(self, ledger: Ledger | None = None) -> None:
        self.current = self.last = ledger  # `last` is the newest one
        # The end of a run waits until a ledger that an operator ends is complete.
        self._ending = threading.Lock()
        self._scenario: list[FaultRecord] = []
        self._faults_on: dict[int, FaultRecord] = {}
        self._wrong_sky: dict[str, EventRecord] = {}
        if ledger is not None:
            ledger.standing = self._standing

    @property
    def on(self) -> bool:
        """Whether there is a ledger now."""
        return self.current is not None

    @property
    def failure(self) -> str | None:
        """Why the newest ledger could not be written, None without a failure."""
        return None if self.last is None else self.last.failure

    def packet(
        self, host_ns: int, raw: bytes, sample: AttitudeSample | None, refusal: Refusal | None
    ) -> None:
        """Record a packet that arrived at host time `host_ns`; see `attitude.receiver.Watch`."""
        ledger = self.current
        if ledger is not None:
            ledger.packet(host_ns, raw, sample, refusal)

    def frame(self, record: FrameRecord) -> None:
        """Record a frame."""
        ledger = self.current
        if ledger is not None:
            ledger.frame(record)

    def notice(self, notice: Notice) -> None:
        """Record an event of the run. The conditions of a wrong sky that last are repeated in a
        ledger that begins later.
        """
        if notice.kind in ENDS:
            self._wrong_sky[notice.kind] = event_record(notice)
        elif notice.kind in BEGINS:
            self._wrong_sky.pop(BEGINS[notice.kind], None)
        ledger = self.current
        if ledger is not None:
            ledger.notice(notice)

    def answer(self, record: AnswerRecord) -> None:
        """Record an answer of the tracker."""
        ledger = self.current
        if ledger is not None:
            ledger.answer(record)

    def lost(self, number: int) -> None:
        """Count `number` packets that a gap in their `sequence` shows as lost."""
        ledger = self.current
        if ledger is not None:
            ledger.lost(number)

    def pulse(self, what: str) -> None:
        """Count a pulse by its outcome `what`: "sent", "skipped" or "lost"."""
        ledger = self.current
        if ledger is not None:
            ledger.pulse(what)

    def fault(self, record: FaultRecord) -> None:
        """Record an event of a fault. The scenario and the faults that are on are repeated in a
        ledger that begins later.
        """
        if record.event == "scenario":
            self._scenario.append(record)
        elif record.event == "start":
            self._faults_on[record.number] = record
        else:
            self._faults_on.pop(record.number, None)
        ledger = self.current
        if ledger is not None:
            ledger.fault(record)

    def begin(self, make: Callable[[], Ledger]) -> Ledger:
        """Begin the ledger that `make` creates if there is none, and return the current one. Raises
        InputError if it cannot be created.
        """
        ledger = self.current
        if ledger is None:
            ledger = make()
            ledger.standing = self._standing
            for record in self._standing():
                if isinstance(record, FaultRecord):
                    ledger.fault(record)
                else:
                    ledger.stands(record)
            self.last = self.current = ledger
        return ledger

    def _standing(self) -> list[FaultRecord | EventRecord]:
        return [*self._scenario, *list(self._faults_on.values()), *list(self._wrong_sky.values())]

    def end(self) -> Ledger | None:
        """End the current ledger, wait until it is complete on the disk, and return it; None where
        there is none.
        """
        # A signal that arrives meanwhile must not leave the file without its end.
        with self._ending, stop_on_signal(threading.Event()):
            ledger = self.current
            self.current = None
            if ledger is not None:
                ledger.close()
        return ledger

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
