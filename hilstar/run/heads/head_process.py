"""The process of one head: its command, whether it lives, and what it says."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO

STALLED_S = 3.0  # without a sign of life; it sends one each second
STARTS_S = 60.0  # a head that has not begun by then is started again
MIN_BACK_OFF_S, MAX_BACK_OFF_S = 0.2, 5.0
US_PER_S = 1_000_000
MAX_LINE = 2000
MAX_OUTPUT = 10_000_000  # bytes of a head's own summary
NOTHING: Mapping[str, str] = {}
Command = Callable[[int, float], Sequence[str]]
Say = Callable[[str], None]


class HeadProcess:
    """A head's process, begun again whenever it ends early or says nothing.

    `command(number, drawn_s)` is that of its begin `number`, `drawn_s` after it drew first, 0 where it never did.

    It tells its life as a service does (sd_notify), to the socket `life`: ready once it draws, and a sign each second while
    frames go on.
    """

    def __init__(self, name: str, command: Command, say: Say, life: Path, secrets: Mapping[str, str] = NOTHING) -> None:
        self.name = name
        self.restarts = 0
        self.code: int | None = None  # of its end, None before that
        self.output = b""  # what it wrote to stdout, the last time
        self._command, self._say, self._secrets = command, say, secrets  # not on a command line, which all users see
        self._address = str(life)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.bind(self._address)
        self._socket.setblocking(False)
        self._back_off_s, self._again_at_s = MIN_BACK_OFF_S, 0.0
        self._process: subprocess.Popen[bytes] | None = None
        self._readers: list[threading.Thread] = []
        self._ready, self._first_ready_s = False, 0.0
        self._begin()

    def _begin(self) -> None:
        environment = {name: value for name, value in os.environ.items() if name != "WATCHDOG_PID"}
        environment |= {**self._secrets, "NOTIFY_SOCKET": self._address, "WATCHDOG_USEC": str(int(STALLED_S * US_PER_S))}
        self._drain()  # what the last one still said
        self._ready, self._begun_s = False, time.monotonic()
        self._heard_s = self._begun_s
        self._process = subprocess.Popen(
            list(self._command(self.restarts, self.drawn_s)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,  # a Ctrl-C is this process's to pass on
        )
        self._readers = [
            threading.Thread(target=self._pass_on, args=(self._process.stderr,), daemon=True),
            threading.Thread(target=self._keep, args=(self._process.stdout,), daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def _pass_on(self, stream: IO[bytes]) -> None:
        for line in iter(lambda: stream.readline(MAX_LINE), b""):
            self._say(f"{self.name}: {line.decode(errors='replace').rstrip()}")

    def _keep(self, stream: IO[bytes]) -> None:
        self.output = stream.read(MAX_OUTPUT)
        while stream.read(MAX_LINE):  # what is more is let go, so that the head does not stand still for it
            pass

    def _drain(self) -> bool:
        """Take the signs of life that wait; whether there were any."""
        heard = False
        with contextlib.suppress(BlockingIOError):
            while True:
                said = self._socket.recv(4096)
                heard = True
                if b"READY=1" in said:
                    self._ready = True
                    self._first_ready_s = self._first_ready_s or time.monotonic()
        return heard

    @property
    def drawn_s(self) -> float:
        """How long ago it drew its first frame, 0 where it never did."""
        return time.monotonic() - self._first_ready_s if self._first_ready_s else 0.0

    def tend(self) -> bool:
        """Begin it again where it ended in error or stalled; whether it still has something to do. Never waits."""
        if self.code is not None:
            return False
        now_s = time.monotonic()
        if self._process is None:
            if now_s >= self._again_at_s:
                self.restarts += 1
                self._begin()
            return True
        code = self._process.poll()
        if code is not None:
            return self._ended(code, now_s)
        if self._drain():
            self._heard_s = now_s
        limit_s = STALLED_S if self._ready else STARTS_S
        if now_s - self._heard_s > limit_s:
            self._say(f"{self.name}: no frame for {now_s - self._heard_s:.1f} s; it is started again")
            self._kill()
            self._wait_to_begin(now_s)
        return True

    def _ended(self, code: int, now_s: float) -> bool:
        for reader in self._readers:
            reader.join(1.0)
        # An end by a signal or an unforeseen error is begun again; one that the command meant (0 to 4) is the end.
        if 0 <= code <= 4 and (self._ready or code != 0):
            self.code = code
            return False
        self._say(f"{self.name}: its process ended ({_how(code)}); it is started again")
        self._wait_to_begin(now_s)
        return True

    def _wait_to_begin(self, now_s: float) -> None:
        long_ago = now_s - self._begun_s > 10 * MAX_BACK_OFF_S
        self._back_off_s = MIN_BACK_OFF_S if long_ago else min(2 * self._back_off_s, MAX_BACK_OFF_S)
        self._process, self._again_at_s = None, now_s + self._back_off_s

    def _kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def interrupt(self) -> None:
        """Ask it to end in order; one that waits to begin again does not."""
        if self._process is None:
            self.code = 0 if self.code is None else self.code
        elif self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def close(self, patience_s: float) -> None:
        """Wait for its end, at most so long; then end it."""
        if self._process is not None:
            try:
                self.code = self._process.wait(patience_s)
            except subprocess.TimeoutExpired:
                self._kill()
                self.code = -signal.SIGKILL
            for reader in self._readers:
                reader.join(1.0)
        self._socket.close()


def _how(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
