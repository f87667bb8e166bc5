"""Writing to stderr without waiting: if nobody reads it, neither a frame nor the end of the process is delayed."""

from __future__ import annotations

import atexit
import contextlib
import io
import os
import sys
import threading
import time
from collections import deque
from typing import Any

MAX_WAITING_BYTES = 1 << 20
PIECE_BYTES = 4096
DESCRIPTOR = 2
LAST_WORDS_S = 1.0  # for a traceback at the very end


class QueuedStderr(io.RawIOBase):
    """Writes go to stderr from a thread, in order; beyond MAX_WAITING_BYTES they are dropped and counted."""

    def __init__(self) -> None:
        super().__init__()
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._dropped = 0
        self._changed = threading.Condition()
        threading.Thread(target=self._run, name="hilstar-stderr", daemon=True).start()

    def writable(self) -> bool:
        """True."""
        return True

    def fileno(self) -> int:
        """The descriptor of stderr itself."""
        return DESCRIPTOR

    def isatty(self) -> bool:
        """Whether stderr itself is a terminal."""
        return os.isatty(DESCRIPTOR)

    def write(self, data: Any) -> int:
        """Queue bytes; returns their number."""
        piece = bytes(data)
        with self._changed:
            if self._waiting_bytes + len(piece) > MAX_WAITING_BYTES:
                self._dropped += 1
            else:
                self._waiting.append(piece)
                self._waiting_bytes += len(piece)
                self._changed.notify_all()
        return len(piece)

    def finish(self, patience_s: float) -> None:
        """Wait until everything has been written, for at most `patience_s`."""
        end_s = time.monotonic() + patience_s
        with self._changed:
            while self._waiting_bytes and (rest_s := end_s - time.monotonic()) > 0:
                self._changed.wait(rest_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._waiting:
                    self._changed.wait()
                piece = self._waiting.popleft()
                dropped, self._dropped = self._dropped, 0
            note = f"hilstar: {dropped} lines were dropped: nothing read them\n".encode() if dropped else b""
            for data in (piece, note):
                _write_all(data)
            with self._changed:
                self._waiting_bytes -= len(piece)
                self._changed.notify_all()


def _write_all(data: bytes) -> None:
    with contextlib.suppress(OSError):  # there is no reader to tell
        while data:
            try:
                data = data[os.write(DESCRIPTOR, data[:PIECE_BYTES]) :]
            except BlockingIOError:  # another process that shares it has made it non-blocking
                time.sleep(0.01)


_queued: QueuedStderr | None = None


def queue_stderr() -> None:
    """From here on, writing to `sys.stderr` does not wait."""
    global _queued  # noqa: PLW0603 - a process has one stderr
    if _queued is None and sys.stderr is not None:
        _queued = QueuedStderr()
        encoding = getattr(sys.stderr, "encoding", None) or "utf-8"
        sys.stderr = io.TextIOWrapper(io.BufferedWriter(_queued), encoding, "backslashreplace", line_buffering=True)
        atexit.register(finish_stderr, LAST_WORDS_S)


def finish_stderr(patience_s: float) -> None:
    """Wait until everything queued has been written, for at most `patience_s`."""
    if _queued is not None:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()
        _queued.finish(patience_s)
