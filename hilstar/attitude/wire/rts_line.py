"""The line RTS of a serial port, as an output: nothing is sent or read over the port."""

from __future__ import annotations

import contextlib
import warnings

import serial

from hilstar.attitude.wire.serial_link import opening_fault
from hilstar.errors import InputError, one_line

# What pyserial raises for a port that is gone: OSError from the system, the others from its own port over a network.
LOST = (OSError, TypeError, ValueError)


class RtsLine:
    """RTS of a port, such as "/dev/ttyUSB0" or a URL of pyserial; at rest it is cleared, or set where `active_high` is false.

    Raises InputError where the port cannot be opened, or has no such line. The system itself may set RTS for a moment while it
    opens a port.
    """

    def __init__(self, port: str, active_high: bool) -> None:
        self.port = port
        self._active_high = active_high
        self._device: serial.SerialBase | None = None
        try:
            self.open()
        except (*LOST, OverflowError) as error:
            raise InputError(f"[sync] port = {port}: {self._fault(error)}") from error

    def _fault(self, error: BaseException) -> str:
        if self._device is not None:
            self.close()
            return f"has no line RTS ({one_line(str(error))}); write a serial port with modem lines, such as /dev/ttyUSB0"
        return opening_fault(error, self.port)

    @property
    def is_open(self) -> bool:
        """Whether there is a port to pulse."""
        return self._device is not None

    def open(self) -> None:
        """Open the port, with the line at rest. Raises one of LOST."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # pyserial's own, of threads
            device = serial.serial_for_url(self.port, do_not_open=True, exclusive=True)
            device.rts = not self._active_high
            try:
                device.open()
            except LOST:
                _shut(device)
                raise
        self._device = device
        device.rts = not self._active_high  # opening suppresses that a port has no such line

    def set(self, active: bool) -> None:
        """Bring the line to its active level, or to rest. Raises one of LOST."""
        if self._device is None:
            raise OSError("the port is closed")
        self._device.rts = active == self._active_high

    def close(self) -> None:
        """Close the port with the line at rest."""
        device, self._device = self._device, None
        if device is not None:
            with contextlib.suppress(*LOST):
                device.rts = not self._active_high
            _shut(device)


def _shut(device: serial.SerialBase) -> None:
    """Close a port, and the socket that pyserial leaves open where its other side has gone."""
    behind = getattr(device, "_socket", None)
    with contextlib.suppress(*LOST):
        device.close()
    if behind is not None:
        behind.close()
