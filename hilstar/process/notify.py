"""Tells systemd how a service is (sd_notify): ready, still alive, and in a line what it does; a datagram each.

The watchdog's datagrams are sent only while `alive` says that the service does its work, so that one whose work hangs is
started again, whatever its other threads do.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Self

EACH_S = 1.0  # the status, and the watchdog where it asks for less
READY_POLL_S = 0.05
US_PER_S = 1_000_000


class Service:
    """This process as a service of systemd's; without one (no NOTIFY_SOCKET) it does nothing.

    `ready` tells when it does its work, `alive` whether it still does, and `status` what a person may read of it.
    """

    def __init__(
        self,
        ready: Callable[[], bool],
        alive: Callable[[], bool],
        status: Callable[[], str],
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        self._ready, self._alive, self._status = ready, alive, status
        self._address = environment.get("NOTIFY_SOCKET", "")
        self._each_s = min(_watchdog_s(environment) / 2, EACH_S)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hilstar-service", daemon=True)

    def _send(self, text: str) -> None:
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        with contextlib.suppress(OSError):  # nobody listens, or its queue is full
            self._socket.sendto(text.encode(errors="replace"), address)

    def _run(self) -> None:
        while not self._ready():
            if self._stop.wait(READY_POLL_S):
                return
        self._send(f"READY=1\nSTATUS={self._line()}")
        while not self._stop.wait(self._each_s):
            if self._alive():
                self._send(f"WATCHDOG=1\nSTATUS={self._line()}")

    def _line(self) -> str:
        return " ".join(self._status().split())

    def __enter__(self) -> Self:
        if self._address:
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self._stop.set()
        if self._address:
            self._thread.join()
            self._send("STOPPING=1")
        self._socket.close()


def _watchdog_s(environment: Mapping[str, str]) -> float:
    """The time after which systemd takes this process for dead; infinite where it does not watch it."""
    with contextlib.suppress(ValueError):
        if int(environment.get("WATCHDOG_PID", os.getpid())) == os.getpid():
            return int(environment["WATCHDOG_USEC"]) / US_PER_S if "WATCHDOG_USEC" in environment else float("inf")
    return float("inf")
