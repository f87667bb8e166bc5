"""python -m hilstar.attitude.wire.apart.tty_child: reads an open serial device, and stamps what comes.

The process that shows stars opens the device, sets it up, writes to it and gives it away for reading: b"R", a byte that
numbers it, and the device itself; b"C" and that byte let it go. What is told of a device begins with its number.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time

from hilstar.attitude.wire.apart.child import Wire, run_child
from hilstar.attitude.wire.apart.records import Kind, pack, pack_message
from hilstar.process.scheduling import PromptWhileLight

READ, CLOSE = b"R", b"C"
COMMAND_BYTES = 2
MAX_READ_BYTES = 65_536
TEND_S = 0.1  # it says each 0.1 s that it lives


class _Device:
    """The device that is read, if there is one."""

    def __init__(self, wire: Wire) -> None:
        self.file: int | None = None
        self.empty_ns = 0
        self._wire = wire
        self._number = b""

    def obey(self) -> None:
        try:
            said, files, _, _ = socket.recv_fds(self._wire.socket, COMMAND_BYTES, 1)
        except OSError as error:
            raise EOFError from error
        if len(said) < COMMAND_BYTES:
            raise EOFError
        self.close()
        if said.startswith(READ) and files:
            self.file, self._number, self.empty_ns = files[0], said[1:], 0  # what waits already may have come at any time

    def close(self) -> None:
        file, self.file = self.file, None
        if file is not None:
            with contextlib.suppress(OSError):
                os.close(file)

    def read(self, file: int, *, timely: bool) -> None:
        try:
            chunk, why = os.read(file, MAX_READ_BYTES), "it was readable, and nothing came"
        except BlockingIOError:
            return
        except OSError as error:
            chunk, why = b"", os.strerror(error.errno or 0)
        host_ns = time.monotonic_ns()
        if chunk:
            self._wire.put(pack_message(host_ns, self.empty_ns, timely, [self._number, chunk]))
        else:
            self.close()
            self._wire.put(pack(Kind.GONE, self._number + why.encode(errors="replace")))


def read_device(wire: Wire) -> None:
    """Read what is given, until the other side is gone (EOFError)."""
    priority = PromptWhileLight()
    device = _Device(wire)
    while True:
        wire.sign()
        file = device.file
        watched: list[int | socket.socket] = [wire.socket] if file is None else [wire.socket, file]
        asked_ns = time.monotonic_ns()
        ready = select.select(watched, [], [], 0)[0]
        timely = not ready
        if timely:
            device.empty_ns = asked_ns
            ready = select.select(watched, [], [], TEND_S)[0]
        if file is not None and file in ready:
            device.read(file, timely=timely)
        if wire.socket in ready:
            device.obey()
        priority.tend()


if __name__ == "__main__":
    run_child(read_device)
