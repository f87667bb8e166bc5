"""The process that reads a link, as the process that shows stars has it: begun, asked, read, and begun again where it ended."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from hilstar.attitude.wire.apart.records import Kind, Record, RecordStream
from hilstar.notices import Notices

MAX_READ_BYTES = 1 << 20  # in one go
MIN_BACK_OFF_S = 0.05
MAX_BACK_OFF_S = 1.0
STEADY_S = 10 * MAX_BACK_OFF_S
HUNG_S = 0.4  # it says each 0.1 s that it lives; asleep for so long without a word, it hangs
STALLED_S = 3.0  # one that would run waits for a core for so long
STARTS_S = 30.0  # and on a machine whose cores are all busy it begins within this
READY_WITHIN_S = 5.0
ENDS_WITHIN_S = 0.3  # in order; a signal leaves a command a second for all its ends


class Reader:
    """Runs `module` with one end of a socket pair and this process's number as its arguments.

    `generation` counts its begins: whoever gave the process something gives it again to a new one. Its end raises nothing;
    it is told, and the process begun again. The process ends with this one, however this one ends.
    """

    def __init__(self, module: str, notices: Notices) -> None:
        self.generation = 0
        self._module, self._notices = module, notices
        self._process: subprocess.Popen[bytes] | None = None
        self._wire: socket.socket | None = None
        self._stream = RecordStream()
        self._why, self._ready = "", False
        self._begun_s = self._again_s = self._silent_s = 0.0
        self._back_off_s = MIN_BACK_OFF_S
        self._begin()

    def _begin(self) -> None:
        self.generation += 1
        self._begun_s, self._why, self._stream = time.monotonic(), "", RecordStream()
        self._ready, self._silent_s = False, 0.0
        wire, its_wire = socket.socketpair()
        wire.setblocking(False)
        self._wire = wire
        command = [sys.executable, "-m", self._module, str(its_wire.fileno()), str(os.getpid())]
        try:
            # In a session of its own: a Ctrl-C is for the process that shows stars.
            self._process = subprocess.Popen(
                command,
                pass_fds=[its_wire.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError as error:
            self._ended(str(error))
        finally:
            its_wire.close()

    def give(self, data: bytes, files: Sequence[int] = ()) -> None:
        """Send a few bytes, and files, to the process; lost where it has ended, which `take` notices."""
        with contextlib.suppress(OSError):
            if self._wire is not None:
                socket.send_fds(self._wire, [data], files)

    def tend(self) -> bool:
        """Begin the process again where that is due; whether there is one."""
        if self._wire is None and time.monotonic() >= self._again_s:
            self._begin()
        return self._wire is not None

    def wait(self, timeout_ms: float) -> bool:
        """True once the process has said something that was not taken, or has ended."""
        if not self.tend() or self._wire is None:
            time.sleep(max(0.0, min(self._again_s - time.monotonic(), timeout_ms / 1000)))
            return False
        poll = select.poll()
        poll.register(self._wire, select.POLLIN)
        begun_s = time.monotonic()
        said = bool(poll.poll(timeout_ms))
        # Only what was waited here counts: this process may have been stopped itself.
        self._silent_s = 0.0 if said else self._silent_s + min(time.monotonic() - begun_s, timeout_ms / 1000)
        limit_s = (STALLED_S if self._would_run() else HUNG_S) if self._ready and self._silent_s > HUNG_S else STARTS_S
        if self._silent_s > limit_s:
            self._ended(f"no sign of life for {limit_s:g} s")
        return said

    def _would_run(self) -> bool:
        """Whether the process runs, or waits for a core; one that is stopped or asleep does not."""
        with contextlib.suppress(OSError, IndexError):
            if self._process is not None:
                status = Path(f"/proc/{self._process.pid}/stat").read_text()
                return status.rpartition(")")[2].split()[0] == "R"
        return True

    def await_ready(self) -> None:
        """Wait until the process has imported what it needs; not for long, and not for one that failed."""
        deadline_s = time.monotonic() + READY_WITHIN_S
        while not self._ready and self._wire is not None and time.monotonic() < deadline_s:
            if self.wait(READY_WITHIN_S * 1000):
                self.take()

    def take(self) -> list[Record]:
        """The records that have come, without waiting."""
        if self._wire is None:
            return []
        try:
            chunk = self._wire.recv(MAX_READ_BYTES)
        except BlockingIOError:
            return []
        except OSError:  # it ended before it had read all that it was given
            chunk = b""
        if not chunk:
            self._ended("")
            return []
        try:
            records = list(self._stream.feed(chunk))
        except ValueError as error:
            self._ended(str(error))
            return []
        self._ready = self._ready or any(kind == Kind.READY for kind, _ in records)
        self._why = next((text.decode(errors="replace") for kind, text in records if kind == Kind.ENDS), self._why)
        return records

    def _ended(self, why: str) -> None:
        code = self._stop(0.0)
        now_s = time.monotonic()
        if now_s - self._begun_s > STEADY_S:
            self._back_off_s = MIN_BACK_OFF_S
        self._again_s = now_s + self._back_off_s
        self._back_off_s = min(2 * self._back_off_s, MAX_BACK_OFF_S)
        why = self._why or why or (f"signal {-code}" if code < 0 else f"exit code {code}")
        self._notices.tell("receiver-failed", f"the attitude receiver stopped ({why}); restarting it")

    def _stop(self, patience_s: float) -> int:
        """Let the process end, within `patience_s` in order; its exit code."""
        wire, self._wire = self._wire, None
        if wire is not None:
            wire.close()
        process, self._process = self._process, None
        if process is None:
            return 0
        try:
            return process.wait(patience_s or MIN_BACK_OFF_S)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()

    def close(self) -> None:
        """End the process."""
        self._stop(ENDS_WITHIN_S)
