"""A serial line that another process reads: opened, written to and understood here, stamped there."""

from __future__ import annotations

import serial

from hilstar.attitude.wire.apart.reader import Reader
from hilstar.attitude.wire.apart.records import Kind, unpack_message
from hilstar.attitude.wire.apart.tty_child import CLOSE, READ
from hilstar.attitude.wire.serial_link import Chunk, SerialLink
from hilstar.notices import Notices

CHILD = "hilstar.attitude.wire.apart.tty_child"


class SerialApart(SerialLink):
    """A SerialLink whose bytes a process of its own reads and stamps.

    Raises InputError where the port cannot be opened at the start.
    """

    def __init__(self, port: str, baud: int, notices: Notices | None = None) -> None:
        self._read_by = 0  # the generation of the process that reads the device; 0 for none
        self._number = 0  # of the device: what is still told of an earlier one counts for nothing
        super().__init__(port, baud, notices)
        self._reader = Reader(CHILD, self._notices)

    def await_ready(self) -> None:
        """Wait until the device can be read, or for a moment."""
        self._reader.await_ready()

    def _read(self, device: serial.Serial, timeout_ms: int) -> list[Chunk]:
        if self._reader.tend() and self._read_by != self._reader.generation:
            self._read_by, self._number = self._reader.generation, (self._number + 1) % 256
            self._reader.give(READ + bytes([self._number]), [device.fileno()])
        if not self._reader.wait(timeout_ms):
            return []
        chunks = []
        for kind, payload in self._reader.take():
            if kind == Kind.MESSAGE:
                message = unpack_message(payload)
                number, data = message.parts
                if number[0] == self._number:
                    chunks.append(Chunk(message.host_ns, data, message.waited_ns, message.empty_ns))
            elif kind == Kind.GONE and payload[0] == self._number:
                self._lose(payload[1:].decode(errors="replace"))
        return chunks

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once something has come that was not read."""
        return self._device is not None and self._reader.wait(timeout_ms)

    def _shut(self) -> None:
        if self._read_by:
            self._read_by = 0
            self._reader.give(CLOSE + bytes([self._number]))  # else the line stays open, and locked
        super()._shut()

    def close(self) -> None:
        """Close the port, and end the process."""
        super().close()
        self._reader.close()
