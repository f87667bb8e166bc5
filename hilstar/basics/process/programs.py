"""Programs around this process: another program that it runs, and systemd, which runs it
(sd_notify).

`Child` runs a command in a group of its own and reads its output as it comes, up to a bound.
`Service` tells systemd in datagrams that the service is ready and alive, and its status in a line.
The watchdog's datagrams are sent only while `alive` says that the service does its work, so that a
service whose work hangs is restarted, whatever its other threads do.
"""

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Self

from hilstar.basics.process.closing import Closing

MAX_OUTPUT_BYTES = 4_000_000  # each of stdout and stderr: a chatty solver prints some 100 kB
CHUNK_BYTES = 65_536
ENDED_WAIT_S = 1.0  # a grandchild may hold a killed command's pipe open for ever
EACH_S = 1.0  # the status, and the watchdog where it asks for less
READY_POLL_S = 0.05
US_PER_S = 1_000_000


class Child(Closing):
    """A running command without a shell; one that prints more than MAX_OUTPUT_BYTES is killed, and
    its children with it.

    Use it as a context manager: what is left of its group ends with it. Raises OSError where it
    cannot be started.
    """

    def __init__(
        self, words: list[str], folder: Path | None = None, *, keeps_stdout: bool = True
    ) -> None:
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
        self._readers = [
            threading.Thread(target=self._read, args=stream, daemon=True)
            for stream in streams
            if stream[1] is not None
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, name: str, stream: IO[bytes]) -> None:
        buffer = self._said[name]
        while chunk := os.read(stream.fileno(), CHUNK_BYTES):
            buffer += chunk[: MAX_OUTPUT_BYTES - len(buffer)]
            if len(buffer) == MAX_OUTPUT_BYTES:
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

    def close(self) -> None:
        """End what is left of its group."""
        self.kill()
        self._process.wait()
        for reader in self._readers:
            # a grandchild in another process group may still hold the pipe
            reader.join(ENDED_WAIT_S)
        for stream, reader in zip(
            (self._process.stderr, self._process.stdout), reversed(self._readers), strict=False
        ):
            if stream is not None and not reader.is_alive():
                stream.close()


class Service(Closing):
    """This process as a service of systemd's; without one (no NOTIFY_SOCKET) it does nothing.

    `ready` tells when it does its work, `alive` whether it still does, and `status` what a person
    may read of it.
    """

    def __init__(
        self,
        ready: Callable[[], bool],
        alive: Callable[[], bool],
        status: Callable[[], str],
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        self._ready = ready
        self._alive = alive
        self._status = status
        self._address = environment.get("NOTIFY_SOCKET", "")
        self._each_s = sign_period_s(environment, os.getpid())
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hilstar-service", daemon=True)

    def _send(self, text: str) -> None:
        if self._address.startswith("@"):
            address = "\0" + self._address[1:]
        else:
            address = self._address
        with contextlib.suppress(OSError):  # nobody listens, or its queue is full
            self._socket.sendto(text.encode(errors="replace"), address)

    def _run(self) -> None:
        while not self._ready():
            if self._stop.wait(READY_POLL_S):
                return
        self._send(f"READY=1\nSTATUS={' '.join(self._status().split())}")
        while not self._stop.wait(self._each_s):
            if self._alive():
                self._send(f"WATCHDOG=1\nSTATUS={' '.join(self._status().split())}")

    def __enter__(self) -> Self:
        if self._address:
            self._thread.start()
        return self

    def close(self) -> None:
        """Tell that the service ends."""
        self._stop.set()
        if self._address:
            self._thread.join()
            self._send("STOPPING=1")
        self._socket.close()


def sign_period_s(environment: Mapping[str, str], process: int) -> float:
    """How often a process of this number gives systemd a sign: each second, or where systemd
    watches it, by half of what that waits (sd_watchdog_enabled(3)).
    """
    with contextlib.suppress(ValueError, KeyError):
        if int(environment.get("WATCHDOG_PID", process)) == process:
            return min(int(environment["WATCHDOG_USEC"]) / US_PER_S / 2, EACH_S)
    return EACH_S
