"""The queue of what is to be written to the ledger, bounded by bytes."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass
from typing import Literal

from hilstar.attitude.wire.packet import AttitudeSample, Refusal
from hilstar.run.record.ledger_records import EventRecord, FaultRecord, FrameRecord

Kind = Literal["packet", "frame", "event", "fault"]
MAX_WAITING_BYTES = 32_000_000  # half a minute of a plain run, if the disk stalls
FRAMES_SHARE = 0.5  # of it; the rest is for packets
# A message of JSON and the objects that it is made of, roughly; the raw bytes of a packet come on top.
ENTRY_BYTES = {"packet": 1500, "frame": 2500, "event": 1000, "fault": 4000}


@dataclass(frozen=True, slots=True)
class ReceivedPacket:
    """A packet's bytes, with the attitude in them or the reason for their refusal."""

    raw: bytes
    sample: AttitudeSample | None
    refusal: Refusal | None


@dataclass(frozen=True, slots=True)
class Entry:
    """Something to be recorded: its host time, a sequence number, and its content."""

    kind: Kind
    time_ns: int
    sequence: int
    content: ReceivedPacket | FrameRecord | EventRecord | FaultRecord

    @property
    def size_bytes(self) -> int:
        """Approximate memory."""
        raw_bytes = len(self.content.raw) if isinstance(self.content, ReceivedPacket) else 0
        return ENTRY_BYTES[self.kind] + raw_bytes


class Backlog:
    """Entries in order of arrival; never blocks, and drops frames first when there is no room."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self._entries: list[Entry] = []
        self._bytes = 0
        self._lock = threading.Lock()

    def put(self, entry: Entry) -> bool:
        """Queue an entry; False, and counted, if there is no room."""
        room = MAX_WAITING_BYTES * (FRAMES_SHARE if entry.kind == "frame" else 1)
        with self._lock:
            if self._bytes + entry.size_bytes > room:
                self.dropped[entry.kind] += 1
                return False
            self._entries.append(entry)
            self._bytes += entry.size_bytes
            return True

    def take(self) -> list[Entry]:
        """Take all entries."""
        with self._lock:
            taken, self._entries, self._bytes = self._entries, [], 0
        return taken
