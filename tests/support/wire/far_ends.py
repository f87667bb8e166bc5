"""The far end of every free-running link, without hilstar's own senders: it opens, sends numbered
attitudes, vanishes and comes back.

The k-th attitude is k ms after the first, at Q; `number` says which one a sample is.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import tty
import zlib
from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

import zmq
from cobs import cobs
from scipy.spatial.transform import Rotation

from hilstar.attitude.wire.endpoint import AllowedSenders, bound_place
from hilstar.attitude.wire.links import StreamLink
from hilstar.attitude.wire.nasa42 import MessageReader, Nasa42Link
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.serial_link import SerialApart, SerialLink
from hilstar.attitude.wire.source import Mounting
from hilstar.attitude.wire.udp import UdpLink
from hilstar.attitude.wire.vizard import DifferenceRates, Follower, vizard_broadcast
from hilstar.attitude.wire.zmq_links import ZmqApart, ZmqReceiver
from hilstar.basics.notices import Notices
from tests.support.senders import free_port
from tests.support.sources.nasa42 import BEGIN_NS, message
from tests.support.sources.viz_message import viz_message
from tests.support.waiting import PATIENCE_S, wait_for

STEP_NS = 1_000_000
Q = (0.5, 0.5, -0.5, 0.5)
LOOPBACK = "127.0.0.1"
BAUD = 921_600
JUMP = 2  # flags of the packet: bit 1, discontinuity (docs/protocol.md)


def attitude_packet(number: int, *, jump: bool) -> bytes:
    """An attitude as docs and firmware_protocol/protocol.toml lay it out."""
    body = struct.pack("<BBHIq4d3f", 1, 1, JUMP * jump, number, number * STEP_NS, *Q, 0.0, 0.0, 0.0)
    return body + struct.pack("<I", zlib.crc32(body))


class FarEnd(ABC):
    """`loses`: the link notices that it is gone. `two_way`: packets come back to it. `declares`: an
    attitude can say that it jumped. `cut`: its messages are a stream that may be cut anywhere.
    """

    loses: ClassVar[bool] = True
    two_way: ClassVar[bool] = False
    declares: ClassVar[bool] = True
    cut: ClassVar[bool] = False
    begin_ns: ClassVar[int] = 0
    junk: ClassVar[bytes] = b"x" * 64

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.come()

    @abstractmethod
    def link(self, notices: Notices) -> StreamLink:
        """hilstar's end."""

    @abstractmethod
    def come(self) -> None:
        """Begin, or begin again, at the same place."""

    @abstractmethod
    def vanish(self) -> None:
        """End without a word."""

    @abstractmethod
    def put(self, data: bytes) -> None:
        """Send bytes as they are."""

    def message(self, number: int, *, jump: bool = False) -> bytes:
        """The bytes of an attitude."""
        return attitude_packet(number, jump=jump)

    def send(self, number: int, *, jump: bool = False) -> None:
        """Send an attitude."""
        self.put(self.message(number, jump=jump))

    def number(self, sample: AttitudeSample) -> int:
        """Which attitude a sample is."""
        return (sample.t_ns - self.begin_ns) // STEP_NS

    def came_back(self) -> bytes:
        """What has come back, without waiting."""
        return b""

    def packets_back(self) -> list[bytes]:
        """The packets in that."""
        data = self.came_back()
        return [data] if data else []


class ZmqFar(FarEnd):
    """A PUB socket that binds."""

    def __init__(self, folder: Path, *, apart: bool = False) -> None:
        self._apart = apart
        self.place = f"tcp://{LOOPBACK}:{free_port()}"
        super().__init__(folder)

    def link(self, notices: Notices) -> StreamLink:
        receiver = ZmqReceiver(self.place, notices=notices)
        return ZmqApart(receiver, notices) if self._apart else receiver

    def come(self) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        self._socket.linger = 0
        self._socket.sndhwm = 0

        def bound() -> bool:
            with contextlib.suppress(zmq.ZMQError):
                self._socket.bind(self.place)
                return True
            return False

        wait_for(bound, "the port, which libzmq gives back from a thread of its own")

    def vanish(self) -> None:
        self._socket.close()
        self._context.term()

    def put(self, data: bytes) -> None:
        self._socket.send(data)


class VizardFar(ZmqFar):
    """Basilisk's broadcast: the word, two empty parts and a VizMessage."""

    declares = False

    def link(self, notices: Notices) -> StreamLink:
        follower = Follower(None, Mounting(), DifferenceRates(10**9, 1.0), "attitude")
        link = vizard_broadcast(self.place, follower, notices=notices)
        return ZmqApart(link, notices) if self._apart else link

    def message(self, number: int, *, jump: bool = False) -> bytes:
        w, x, y, z = Q  # sigma = e tan(Phi/4) of the turn that takes N's components to B's
        sigma = [-x / (1 + w), -y / (1 + w), -z / (1 + w)]
        craft = {"spacecraftName": "one", "rotation": sigma}
        return viz_message(float(number * STEP_NS), [craft], frame=number)

    def put(self, data: bytes) -> None:
        self._socket.send_multipart([b"SIM_UPDATE", b"", b"", data])


class SerialFar(FarEnd):
    """The other end of a serial line: COBS frames."""

    two_way = cut = True
    junk = b"\5nonsense\0"

    def __init__(self, folder: Path, *, apart: bool = False) -> None:
        self._kind = SerialApart if apart else SerialLink
        super().__init__(folder)

    def link(self, notices: Notices) -> StreamLink:
        return self._kind(str(self._folder / "port"), BAUD, notices)

    def come(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        port = self._folder / "port"
        port.unlink(missing_ok=True)
        port.symlink_to(os.ttyname(self._slave))

    def vanish(self) -> None:
        (self._folder / "port").unlink()
        os.close(self._master)
        os.close(self._slave)

    def message(self, number: int, *, jump: bool = False) -> bytes:
        return cobs.encode(attitude_packet(number, jump=jump)) + b"\0"

    def put(self, data: bytes) -> None:
        assert os.write(self._master, data) == len(data)

    def came_back(self) -> bytes:
        with contextlib.suppress(BlockingIOError):
            return os.read(self._master, 65_536)
        return b""

    def packets_back(self) -> list[bytes]:
        return [cobs.decode(frame) for frame in self.came_back().split(b"\0") if frame]


class UdpFar(FarEnd):
    """A socket that sends datagrams; nobody notices that it ends."""

    loses = False
    two_way = True

    def __init__(self, folder: Path) -> None:
        self._port = free_port()
        super().__init__(folder)

    def link(self, notices: Notices) -> StreamLink:
        return UdpLink(bound_place(None, self._port, None), AllowedSenders(), notices)

    def come(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def vanish(self) -> None:
        self._socket.close()

    def put(self, data: bytes) -> None:
        self._socket.sendto(data, (LOOPBACK, self._port))

    def came_back(self) -> bytes:
        with contextlib.suppress(BlockingIOError):
            return self._socket.recv(65_536)
        return b""


class Nasa42Far(FarEnd):
    """42, which listens; here it does not wait for what it is acknowledged."""

    declares = False
    cut = True
    begin_ns = BEGIN_NS
    junk = b"nonsense\n[ENDMSG]\n"

    def __init__(self, folder: Path) -> None:
        self._port = free_port()
        super().__init__(folder)

    def link(self, notices: Notices) -> StreamLink:
        reader = MessageReader(0, Mounting())
        return Nasa42Link(f"tcp://{LOOPBACK}:{self._port}", reader, notices=notices)

    def come(self) -> None:
        self._listener = socket.create_server((LOOPBACK, self._port))
        self._listener.setblocking(False)
        self._connection: socket.socket | None = None

    def vanish(self) -> None:
        self._listener.close()
        if self._connection is not None:
            self._connection.close()

    def message(self, number: int, *, jump: bool = False) -> bytes:
        turn = Rotation.from_quat(Q, scalar_first=True)
        return message(number * STEP_NS / 1e9, turn).encode()

    def put(self, data: bytes) -> None:
        if self._connection is None:
            with contextlib.suppress(BlockingIOError):
                self._connection = self._listener.accept()[0]
                self._connection.settimeout(PATIENCE_S)
        if self._connection is not None:
            self._connection.sendall(data)

    def came_back(self) -> bytes:
        if self._connection is None:
            return b""
        self._connection.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            return self._connection.recv(65_536)
        return b""
