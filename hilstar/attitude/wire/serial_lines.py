"""Lines of text from a serial device, each with the host time of its last byte."""

from __future__ import annotations

import time
from collections.abc import Iterator

import serial

from hilstar.attitude.wire.serial_link import BITS_PER_BYTE, opening_fault
from hilstar.errors import InputError
from hilstar.units import NS_PER_S

READ_S = 0.05
MAX_LINE_BYTES = 256


def read_lines(port: str, baud: int, seconds: float) -> Iterator[tuple[int, bytes]]:
    """Host time (monotonic ns, less the time on the wire) and text of each line that arrives within `seconds`.

    Raises InputError where the port cannot be opened, or disappears.
    """
    name = f"serial:{port}@{baud}"
    try:
        device = serial.Serial(port, baud, timeout=READ_S, exclusive=True)
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: {opening_fault(error, port)}") from error
    with device:
        device.reset_input_buffer()
        end_s = time.monotonic() + seconds
        line = b""
        while time.monotonic() < end_s:
            try:
                byte = device.read(1)
            except (OSError, TypeError) as error:
                raise InputError(f"{name}: disconnected ({error}); plug it in and start again") from error
            if byte == b"\n":
                wire_ns = (len(line) + 1) * BITS_PER_BYTE * NS_PER_S // baud
                yield time.monotonic_ns() - wire_ns, line.strip()
                line = b""
            else:
                line = (line + byte)[-MAX_LINE_BYTES:]
