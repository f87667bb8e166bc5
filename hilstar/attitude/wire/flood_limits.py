"""What a flood may cost: packets a second that are looked at, memory, and files."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import time
from dataclasses import asdict, dataclass

from hilstar.notices import Notices

MAX_PACKETS_PER_S = 3000  # looked at: some 10 % of one core, and more than any serial line brings
MAX_BURST = 1000  # what may have waited while the receiver stood still
MAX_GROWTH_BYTES = 256_000_000
LOOK_S = 0.01
PAUSE_S = 0.005  # of a receiver that is flooded: the frame loop needs Python's lock
OVER_S = 1.0  # a flood without a dropped packet for so long is over
FREED_WITHIN_S = 2.0
PAGE_BYTES = resource.getpagesize()
WANTED_FILES = 65_536


@dataclass(slots=True)
class LinkCounts:
    """What became of a link's connections and messages.

    `connections` were made; `rejected` failed in the handshake; `refused` were too many at once; `lost` ended on the side that
    connects; `resets` of the link, for memory or for messages without end; `flooded` messages were dropped unread.
    """

    connections: int = 0
    rejected: int = 0
    refused: int = 0
    lost: int = 0
    resets: int = 0
    flooded: int = 0

    def summary(self) -> dict[str, int]:
        """The counts by name."""
        return asdict(self)


class FloodGate:
    """How many packets are looked at: MAX_PACKETS_PER_S, and MAX_BURST at once. The others are counted and told."""

    def __init__(self, counts: LinkCounts, notices: Notices) -> None:
        self._counts = counts
        self._notices = notices
        self._left = float(MAX_BURST)
        self._seen_s = time.monotonic()
        self._dropped_s = -OVER_S

    def admit(self, waiting: int) -> int:
        """How many of the packets that wait may be looked at; the caller drops the others. Pauses where there are others."""
        now_s = time.monotonic()
        self._left = min(self._left + (now_s - self._seen_s) * MAX_PACKETS_PER_S, MAX_BURST)
        self._seen_s = now_s
        admitted = min(waiting, int(self._left))
        self._left -= admitted
        if admitted < waiting:
            self._drop(waiting - admitted, now_s)
        return admitted

    def _drop(self, count: int, now_s: float) -> None:
        self._counts.flooded += count
        if now_s - self._dropped_s > OVER_S:
            self._notices.tell(
                "flood", f"over {MAX_PACKETS_PER_S} packets a second: the newest are taken, the others dropped unread"
            )
        self._dropped_s = now_s
        time.sleep(PAUSE_S)


class MemoryWatch:
    """Whether this process has grown by more than MAX_GROWTH_BYTES since `begin`.

    libzmq keeps a message until its last part has come, with no limit on parts, and shows nobody what it keeps: the memory of
    the process is all there is to see. Without /proc nothing is watched.
    """

    def __init__(self) -> None:
        self._file = -1
        with contextlib.suppress(OSError):  # held open: a process out of files must still see its memory
            self._file = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)
        self._base_bytes = self._used_bytes()
        self._looked_s = 0.0

    def begin(self) -> None:
        """Count from what is used now."""
        self._base_bytes = self._used_bytes()

    def grown_bytes(self) -> int:
        """How much more is used than at the beginning; looked up at most every LOOK_S, 0 meanwhile."""
        now_s = time.monotonic()
        if now_s - self._looked_s < LOOK_S:
            return 0
        self._looked_s = now_s
        return self._used_bytes() - self._base_bytes

    def await_release(self) -> None:
        """Wait a moment for memory that was given up; what stays was not a link's, and is counted from now on."""
        deadline_s = time.monotonic() + FREED_WITHIN_S
        while (used_bytes := self._used_bytes()) > self._base_bytes + MAX_GROWTH_BYTES / 2:
            if time.monotonic() > deadline_s:
                self._base_bytes = used_bytes
                return
            time.sleep(LOOK_S)
            _give_back_what_is_free()

    def _used_bytes(self) -> int:
        if self._file < 0:
            return 0
        with contextlib.suppress(OSError, ValueError, IndexError):
            return int(os.pread(self._file, 256, 0).split()[1]) * PAGE_BYTES
        return 0

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1


def _give_back_what_is_free() -> None:
    """glibc else keeps freed memory for itself, and what it keeps would count as grown."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def raise_file_limit() -> None:
    """As many open files as this user may have, up to WANTED_FILES: each connection is one, and so are ledger and display."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = WANTED_FILES if hard == resource.RLIM_INFINITY else min(hard, WANTED_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
