"""What a flood may cost: packets decoded per second, memory, and file descriptors."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TypeVar

from hilstar.notices import Notices

MAX_PACKETS_PER_S = 3000  # decoded: some 10 % of one core, and more than any serial line carries
MAX_BURST = 1000  # as many as may have waited while the receiver was stopped
MAX_GROWTH_BYTES = 256_000_000
LOOK_S = 0.01
PAUSE_S = 0.005  # of a flooded receiver: the frame loop needs the interpreter lock
OVER_S = 1.0  # a flood is over once no packet was dropped for this long
FREED_WITHIN_S = 2.0
PAGE_BYTES = resource.getpagesize()
MAX_LOOKED_AT = 1000  # of what is passed over: a discontinuity is declared once, and not in each packet that is damaged
WANTED_FILES = 65_536
T = TypeVar("T")


@dataclass(slots=True)
class LinkCounts:
    """The counts of a link's connections and messages.

    `connections` were made; `rejected` failed in the handshake, or were datagrams of senders that are not allowed; `refused`
    were too many at once; `lost` ended on the side that connects; `resets` of the link, for memory or for messages without
    end; `flooded` messages were dropped unread.
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
    """Admits MAX_PACKETS_PER_S, and MAX_BURST at once, the newest. The others are passed over: counted and reported."""

    def __init__(self, counts: LinkCounts, notices: Notices, now_s: Callable[[], float] = time.monotonic) -> None:
        self._counts = counts
        self._notices = notices
        self._now_s = now_s
        self._left = float(MAX_BURST)
        self._seen_s = now_s()
        self._dropped_s = -OVER_S

    def newest(self, waiting: list[T], declares_discontinuity: Callable[[T], bool]) -> list[T]:
        """Of all that waits, oldest first, what may be decoded: the newest. Pauses where others are passed over.

        Of those the newest that declares a discontinuity is taken too: no attitude is interpolated across it.
        """
        passed_over = len(waiting) - self._admit(len(waiting))
        for k in range(passed_over - 1, max(passed_over - MAX_LOOKED_AT, 0) - 1, -1):
            if declares_discontinuity(waiting[k]):
                self._counts.flooded -= 1
                return [waiting[k], *waiting[passed_over:]]
        return waiting[passed_over:]

    def _admit(self, waiting: int) -> int:
        """How many of the waiting packets may be decoded."""
        now_s = self._now_s()
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
                "flood",
                f"over {MAX_PACKETS_PER_S} packets per second, or {MAX_BURST} at once: taking the newest,"
                " passing over the others unread",
            )
        self._dropped_s = now_s
        time.sleep(PAUSE_S)


class MemoryWatch:
    """Whether this process has grown by more than MAX_GROWTH_BYTES since `begin`.

    libzmq keeps a message until its last part arrives, with no limit on parts, and does not report what it keeps: only the
    memory of the process shows it. Without /proc nothing is watched.
    """

    def __init__(self) -> None:
        self._file = -1
        with contextlib.suppress(OSError):  # kept open: a process out of descriptors must still see its memory
            self._file = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)
        self._base_bytes = self._used_bytes()
        self._looked_s = 0.0

    def begin(self) -> None:
        """Count from what is used now."""
        self._base_bytes = self._used_bytes()

    def grown_bytes(self) -> int:
        """The growth since `begin`; looked up at most every LOOK_S, 0 in between."""
        now_s = time.monotonic()
        if now_s - self._looked_s < LOOK_S:
            return 0
        self._looked_s = now_s
        return self._used_bytes() - self._base_bytes

    def await_release(self) -> None:
        """Wait a moment for freed memory to be returned; what remains was not the link's, and becomes the new baseline."""
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
    """Otherwise glibc keeps freed memory, which would count as growth."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def raise_file_limit() -> None:
    """Raise the limit of open files up to WANTED_FILES: each connection needs one, and so do ledger and display."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = WANTED_FILES if hard == resource.RLIM_INFINITY else min(hard, WANTED_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
