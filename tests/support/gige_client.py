"""A GigE Vision client of plain sockets, without hilstar: GVCP commands and GVSP packets by struct,
from the standard's tables.
"""

from __future__ import annotations

import ipaddress
import itertools
import os
import re
import select
import socket
import struct
import time
from typing import Self

import numpy as np

from tests.support.waiting import PATIENCE_S, wait_for

PORT = 3956
DISCOVER, READ, WRITE, READ_MEMORY, RESEND = 0x0002, 0x0080, 0x0082, 0x0084, 0x0040
PRIVILEGE, STREAM_PORT, PACKET_BYTES, STREAM_ADDRESS = 0x0A00, 0x0D00, 0x0D04, 0x0D18
CONTROL = 2
HEARTBEAT_S = 1.0  # a camera lets a client go that it has not heard for 3 s
AGAIN_S = 0.05  # between two requests for packets that were lost


# Each process of tests has addresses of its own: a camera's port is fixed.
_addresses = itertools.count(os.getpid() % 60_000 * 256 + 2)


def own_address() -> str:
    """An address of this machine that no other test has."""
    number = (1 << 16) + next(_addresses) % 0xFE_0000
    return str(ipaddress.IPv4Address("127.0.0.0") + number)


def command(kind: int, body: bytes = b"", number: int = 1, flags: int = 1) -> bytes:
    """A command."""
    return struct.pack(">BBHHH", 0x42, flags, kind, len(body), number) + body


def write_of(address: int, value: int) -> bytes:
    """The body of a register's write."""
    return struct.pack(">II", address, value)


class GigEClient:
    """A client of the camera at an address."""

    def __init__(self, address: str, own: str = "127.0.0.1") -> None:
        self.address = address
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((own, 0))
        self.socket.settimeout(PATIENCE_S)
        self.stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
        self.stream.bind((own, 0))
        self.stream.settimeout(PATIENCE_S)
        self._number = 0
        self._blocks: dict[int, dict[int, bytes]] = {}  # that are coming, by their numbers
        self._last: dict[int, int] = {}  # their trailers' packets
        self._newest = 0
        self._asked_s = self._heard_s = 0.0
        self.registers: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()
        self.stream.close()

    def ask(self, kind: int, body: bytes = b"") -> tuple[int, bytes]:
        """The status and the body of an answer."""
        self._heard_s = time.monotonic()
        self._number = self._number % 0xFFFF + 1
        self.socket.sendto(command(kind, body, self._number), (self.address, PORT))
        while True:
            status, _, _, number = struct.unpack(">HHHH", (data := self.socket.recv(2048))[:8])
            if number == self._number:
                return status, data[8:]

    def read(self, address: int) -> int:
        """A register."""
        status, body = self.ask(READ, struct.pack(">I", address))
        assert status == 0, hex(status)
        return int.from_bytes(body, "big")

    def write(self, address: int, value: int) -> int:
        """Write a register; the status."""
        return self.ask(WRITE, write_of(address, value))[0]

    def memory(self, address: int, count: int) -> bytes:
        """Bytes of the camera's memory, in pieces."""
        pieces = []
        for at in range(address, address + count, 512):
            size = min(512, address + count - at)
            status, body = self.ask(READ_MEMORY, struct.pack(">IHH", at, 0, -(-size // 4) * 4))
            assert status == 0, hex(status)
            pieces.append(body[4:])
        return b"".join(pieces)[:count]

    def describe(self) -> str:
        """The camera's description; `registers` then has the features' addresses."""
        url = self.memory(0x0200, 512).split(b"\0")[0].decode()
        place, size = re.fullmatch(r"Local:[\w.]+;([0-9A-F]+);([0-9A-F]+)", url).groups()  # type: ignore[union-attr]
        text = self.memory(int(place, 16), int(size, 16)).decode()
        rows = re.findall(r'Name="(\w+)Register"><Address>0x([0-9A-F]+)<', text)
        self.registers = {name: int(address, 16) for name, address in rows}
        return text

    def control(self) -> int:
        """Take the camera's control and have its images sent here; the status of the first."""
        status = self.write(PRIVILEGE, CONTROL)
        if not status:
            self.write(STREAM_ADDRESS, struct.unpack(">I", socket.inet_aton("127.0.0.1"))[0])
            self.write(STREAM_PORT, self.stream.getsockname()[1])
        return status

    def set(self, feature: str, value: int) -> int:
        """Write a feature; the status."""
        return self.write(self.registers[feature], value)

    def block(self) -> tuple[int, int, dict[int, bytes]]:
        """The next image: its number, timestamp, and its packets by their number. Those that were
        lost on the way are asked for again.
        """
        end_s = time.monotonic() + PATIENCE_S
        while not (self._blocks and self._missing(oldest := min(self._blocks)) is None):
            assert time.monotonic() < end_s, "no image came"
            if time.monotonic() > self._heard_s + HEARTBEAT_S:
                self.read(PRIVILEGE)
            ready, _, _ = select.select([self.stream], [], [], AGAIN_S)
            if ready:
                self._receive()
            if self._blocks and (not ready or self._is_late(min(self._blocks))):
                self._ask_again(min(self._blocks))
        packets = self._blocks.pop(oldest)
        return oldest, struct.unpack(">Q", packets[0][4:12])[0], packets

    def _receive(self) -> None:
        data = self.stream.recv(65536)
        status, number, kind_and_packet = struct.unpack(">HHI", data[:8])
        if status:  # the camera has this block no more
            self._blocks.pop(number, None)
            return
        packet, kind = kind_and_packet & 0xFF_FFFF, kind_and_packet >> 24
        if number > self._newest:
            self._newest = number
            self._blocks[number] = {}
        if number not in self._blocks:  # a packet that came twice
            return
        self._blocks[number][packet] = data[8:]
        if kind == 2:
            self._last[number] = packet

    def _missing(self, number: int) -> tuple[int, int] | None:
        """The first and the last packet of a block that has not come; None where all have."""
        packets = self._blocks[number]
        last = self._last.get(number, 0xFF_FFFF)
        if len(packets) == last + 1:
            return None
        first = next(k for k in itertools.count() if k not in packets)
        return first, max(k for k in range(first, min(last, first + 511) + 1) if k not in packets)

    def _is_late(self, number: int) -> bool:
        return number in self._last or number < self._newest

    def _ask_again(self, number: int) -> None:
        if (missing := self._missing(number)) is None or time.monotonic() < self._asked_s + AGAIN_S:
            return
        self._asked_s = time.monotonic()
        body = struct.pack(">HHII", 0, number, *missing)
        self.socket.sendto(command(RESEND, body, 0xFFFF, flags=0), (self.address, PORT))

    def image(self, height: int, width: int, kind: str = "<u2") -> tuple[int, int, np.ndarray]:
        """The next image as DN (height, width), with its number and timestamp."""
        number, stamp, packets = self.block()
        data = b"".join(packets[k] for k in range(1, len(packets) - 1))
        return number, stamp, np.frombuffer(data, kind).reshape(height, width)


def opened(client: GigEClient) -> GigEClient:
    """The client once the camera answers."""

    def answers() -> bool:
        client.socket.settimeout(0.5)
        try:
            client.describe()
        except OSError:
            return False
        return True

    wait_for(answers, "the camera answers")
    client.socket.settimeout(PATIENCE_S)
    return client
