"""What the processes that read links have in common: they hear no signals, and end with the process that shows stars."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable
from typing import NoReturn

from hilstar.attitude.wire.apart.records import Kind, pack
from hilstar.process.interrupts import end_with_parent

WANTED_BUFFER_BYTES = 1 << 20  # the kernel gives what it allows: some hundred messages, while nobody reads them
LIFE_S = 0.1
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Wire:
    """The child's end of the socket pair; a peer that is gone raises EOFError."""

    def __init__(self, made: socket.socket) -> None:
        self.socket = made
        self._signed_s = -LIFE_S
        made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WANTED_BUFFER_BYTES)

    def sign(self) -> None:
        """Say that this process is ready, and from time to time that it still is."""
        now_s = time.monotonic()
        if now_s - self._signed_s >= LIFE_S:
            self._signed_s = now_s
            self.put(pack(Kind.READY, b""))

    def put(self, record: bytes) -> None:
        """Hand a record over; waits while the other side does not read, so that nothing grows here."""
        try:
            self.socket.sendall(record)
        except OSError as error:
            raise EOFError from error

    def said(self, timeout_ms: float) -> bool:
        """Whether the other side has said something, or is gone."""
        poll = select.poll()
        poll.register(self.socket, select.POLLIN)
        return bool(poll.poll(timeout_ms))


def run_child(read: Callable[[Wire], None]) -> NoReturn:
    """Run `read` until the other side is gone; whatever ends it early is told there in a line."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)  # whoever shows stars hears them, and ends this process
    file, parent = map(int, sys.argv[1:3])
    end_with_parent(parent)
    wire = Wire(socket.socket(fileno=file))
    code = 0
    try:
        read(wire)
    except EOFError:
        pass
    except BaseException as error:
        code = 1
        with contextlib.suppress(EOFError):
            wire.put(pack(Kind.ENDS, _told(error).encode(errors="replace")))
    os._exit(code)  # threads of libraries are not waited for


def _told(error: BaseException) -> str:
    from hilstar.errors import HilstarError, one_line

    return one_line(str(error) if isinstance(error, HilstarError) else f"{type(error).__name__}: {error}")
