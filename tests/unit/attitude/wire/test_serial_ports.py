"""Serial ports: how they are named, what is there, how long a packet takes on one, and why one
cannot be opened.
"""

from __future__ import annotations

import errno

import numpy as np
import pytest
import serial
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from hilstar.attitude.wire.packet import AttitudeSample, Packet, TimeReply, TimeRequest
from hilstar.attitude.wire.serial_link import (
    RtsLine,
    SerialLink,
    adapters,
    opening_refusal,
    serial_ports,
    serial_target,
)
from hilstar.basics.errors import InputError, NotThereError
from tests.support.refusals import refusal
from tests.support.wire.ptys import serial_line

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("text", "target"),
    [
        ("serial:/dev/ttyUSB0", ("/dev/ttyUSB0", 115_200)),
        ("serial:/dev/ttyUSB0@921600", ("/dev/ttyUSB0", 921_600)),
        ("serial:COM3@9600", ("COM3", 9600)),
        ("tcp://127.0.0.1:5560", None),
        ("/dev/ttyUSB0", None),
    ],
)
def test_a_target_names_a_port_and_a_baud_rate(text, target):
    assert serial_target(text) == target


@pytest.mark.parametrize("rest", ["", "@9600", "/dev/a@", "/dev/a@0", "/dev/a@1@2", "/dev/a@fast"])
def test_a_target_that_is_written_wrong_is_refused_with_its_form(rest):
    line = refusal(serial_target, f"serial:{rest}")
    form = "write serial:/dev/ttyX@BAUD, such as serial:/dev/ttyUSB0@921600"
    assert line == f"serial:{rest}: {form}"


def port(device: str, description: str, product: str | None = None, vid: int | None = None):
    made = ListPortInfo(device)
    made.description = description
    made.product = product
    made.vid = vid
    made.pid = None if vid is None else 0x6001
    return made


def test_ports_are_listed_and_their_adapters_counted_by_kind(monkeypatch):
    ports = [
        port("/dev/ttyUSB1", "FT232R USB UART", "FT232R USB UART", 0x0403),
        port("/dev/ttyS0", "n/a"),
        port("/dev/ttyUSB0", "FT232R USB UART", "FT232R USB UART", 0x0403),
        port("/dev/ttyACM0", "no name", None, 0x00A1),
    ]
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    assert adapters() == ["USB (00a1:6001)", "UART", "2 x FT232R USB UART (0403:6001)"]
    assert serial_ports() == [
        "/dev/ttyACM0 (no name)",
        "/dev/ttyS0 (n/a)",
        "/dev/ttyUSB0 (FT232R USB UART)",
        "/dev/ttyUSB1 (FT232R USB UART)",
    ]


@pytest.mark.parametrize(
    ("packet", "wire_bytes"),
    # protocol.toml: 64, 20 and 36 bytes; COBS adds one, and 0x00 ends a frame
    [
        (AttitudeSample(1, UPRIGHT), 66),
        (TimeRequest(1, 2), 22),
        (TimeReply(1, 2, 3, 4), 38),
    ],
)
@pytest.mark.parametrize("baud", [9600, 921_600])
def test_a_packet_takes_ten_bits_a_byte_of_its_frame(packet: Packet, wire_bytes: int, baud: int):
    with serial_line() as (_, name), SerialLink(name, baud) as link:
        assert link.wire_ns(packet) == wire_bytes * 10 * 10**9 // baud


LISTED = "/dev/ttyUSB0 (an adapter)"


@pytest.mark.parametrize(
    ("error", "name", "kind", "rest"),
    [
        (
            FileNotFoundError(errno.ENOENT, "gone"),
            "tty",
            InputError,
            "no such file; write /dev/tty",
        ),
        (
            FileNotFoundError(errno.ENOENT, "gone"),
            "/dev/ttyNONE",
            NotThereError,
            f"no such device; plug it in, or write another serial port (there now: {LISTED})",
        ),
        (
            OSError(errno.ENXIO, "no device"),
            "ttyNONE",
            NotThereError,
            f"no such device; plug it in, or write another serial port (there now: {LISTED})",
        ),
        (
            OSError("Could not open port: [Errno 111] Connection refused"),
            "socket://127.0.0.1:7",
            NotThereError,
            "Could not open port: [Errno 111] Connection refused; start the server of that port, or"
            " write another port",
        ),
        (
            PermissionError(errno.EACCES, "Permission denied"),
            "/dev/ttyS0",
            InputError,
            "Permission denied; join the group that owns it (often dialout)",
        ),
        (
            OSError(errno.EAGAIN, "Resource temporarily unavailable"),
            "/dev/ttyS0",
            InputError,
            "Resource temporarily unavailable; stop the program that has it",
        ),
        (
            OSError("Could not exclusively lock port"),
            "/dev/ttyS0",
            InputError,
            "Could not exclusively lock port; stop the program that has it",
        ),
        (
            ValueError("Not a valid baudrate: 5"),
            "/dev/ttyS0",
            InputError,
            "Not a valid baudrate: 5; write a baud rate that the port supports, such as 115200 or"
            " 921600",
        ),
        (
            OSError(errno.ENOTTY, "Inappropriate ioctl for device"),
            "/dev/null",
            InputError,
            "Inappropriate ioctl for device; write the serial port, such as /dev/ttyUSB0"
            " (ls /dev/serial/by-id lists them), not '/dev/null'",
        ),
    ],
)
def test_why_a_port_cannot_be_opened_says_what_to_do(monkeypatch, error, name, kind, rest):
    monkeypatch.setattr(list_ports, "comports", lambda: [port("/dev/ttyUSB0", "an adapter")])
    made = opening_refusal("serial:x@9600", error, name)
    assert type(made) is kind
    assert str(made) == f"serial:x@9600: {rest}"


@pytest.mark.parametrize("active_high", [True, False])
def test_an_rts_line_rests_at_its_other_level_before_and_after_it_is_used(monkeypatch, active_high):
    """At pyserial's own port that hears itself."""
    made: list[serial.SerialBase] = []
    of_url = serial.serial_for_url

    def opened(*arguments: object, **options: object) -> serial.SerialBase:
        made.append(of_url(*arguments, **options))
        return made[-1]

    monkeypatch.setattr(serial, "serial_for_url", opened)
    line = RtsLine("loop://", active_high)
    (device,) = made
    levels = [device.rts]
    for active in (True, False, True):
        line.set(active)
        levels.append(device.rts)
    line.close()
    levels.append(device.rts)
    rest = not active_high
    assert levels == [rest, active_high, rest, active_high, rest]
    assert not line.is_open and not device.is_open
    with pytest.raises(OSError, match="the port is closed"):
        line.set(True)
    line.close()
