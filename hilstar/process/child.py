"""A program of somebody else's: in a group of its own, its output read as it comes and kept up to a bound."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import IO, Self

MAX_OUTPUT_BYTES = 4_000_000  # of stdout and of stderr: a chatty solver prints some 100 kB
CHUNK_BYTES = 65_536
ENDED_WAIT_S = 1.0


class Child:
    """A running command without a shell; one that prints more than MAX_OUTPUT_BYTES is killed, and its children with it.

    Use it as a context manager: what is left of its group ends with it. Raises OSError where it cannot be started.
    """

    def __init__(self, words: list[str], folder: Path | None = None, *, keeps_stdout: bool = True) -> None:
        self.too_much = False
        self._process = subprocess.Popen(
            words,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE if keeps_stdout else subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        self._said = {"out": bytearray(), "err": bytearray()}
        streams = [("out", self._process.stdout), ("err", self._process.stderr)]
        self._readers = [threading.Thread(target=self._read, args=each, daemon=True) for each in streams if each[1] is not None]
        for reader in self._readers:
            reader.start()

    def _read(self, name: str, stream: IO[bytes]) -> None:
        kept = self._said[name]
        while chunk := os.read(stream.fileno(), CHUNK_BYTES):
            kept += chunk[: MAX_OUTPUT_BYTES - len(kept)]
            if len(kept) == MAX_OUTPUT_BYTES:
                self.too_much = True
                self.kill()
                return

    @property
    def out(self) -> str:
        """What it has printed on stdout so far."""
        return self._said["out"].decode(errors="replace")

    @property
    def err(self) -> str:
        """What it has printed on stderr so far."""
        return self._said["err"].decode(errors="replace")

    def poll(self) -> int | None:
        """Its exit code, None while it runs."""
        return self._process.poll()

    def wait(self, seconds: float) -> int | None:
        """Its exit code once it and its output have ended; None where that takes longer."""
        end_s = time.monotonic() + seconds
        for reader in self._readers:
            reader.join(max(end_s - time.monotonic(), 0.0))
        if any(reader.is_alive() for reader in self._readers):
            return None
        try:
            return self._process.wait(max(end_s - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            return None

    def kill(self) -> None:
        """End it and what it has started."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.kill()
        self._process.wait()
        for reader in self._readers:
            reader.join(ENDED_WAIT_S)  # a grandchild in a group of its own may still hold the pipe
        for stream, reader in zip((self._process.stderr, self._process.stdout), reversed(self._readers), strict=False):
            if stream is not None and not reader.is_alive():
                stream.close()
