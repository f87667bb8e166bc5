"""From one source to the processes of several heads, over ZeroMQ on this machine: time of arrival, then the message."""

from __future__ import annotations

import contextlib
import struct
from types import TracebackType
from typing import Self

import zmq

from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import AttitudeSample, Event, decode, encode
from hilstar.attitude.wire.source import Conventions, Mounting
from hilstar.attitude.wire.zmq_stream import ZmqReceiver
from hilstar.notices import Notices

STAMP = struct.Struct("<q")  # host time of arrival, ns: one clock for all processes of a machine
QUEUE_MESSAGES = 1000


class Feed:
    """A PUB socket that hands on what a source brings; a head that is slow or gone delays no other."""

    def __init__(self, endpoint: str) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, QUEUE_MESSAGES)
        self._socket.bind(endpoint)

    def give(self, arrival: Arrival[Event]) -> None:
        """Hand on a message: its bytes, or where those are the source's own words a packet of the same attitude."""
        raw = arrival.raw
        if isinstance(arrival.event, AttitudeSample) and not isinstance(decode(raw), AttitudeSample):
            raw = encode(arrival.event)
        with contextlib.suppress(zmq.Again):
            self._socket.send_multipart([STAMP.pack(arrival.host_ns), raw], zmq.NOBLOCK)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._socket.close()
        self._context.term()


class FedReceiver(ZmqReceiver):
    """A head's end of a Feed: the body's attitudes become its camera's, with the time at which they reached the feed."""

    def __init__(self, endpoint: str, mounting: Mounting, conventions: Conventions, notices: Notices | None = None) -> None:
        super().__init__(endpoint, notices=notices)
        self._mounting = mounting
        self.conventions = conventions

    def _arrival(self, host_ns: int, parts: list[bytes]) -> Arrival[Event]:
        if len(parts) != 2 or len(parts[0]) != STAMP.size:
            return super()._arrival(host_ns, parts)
        (came_ns,) = STAMP.unpack(parts[0])
        event = decode(parts[1])
        if not isinstance(event, AttitudeSample):
            return Arrival(came_ns, event, parts[1], stamped=True)
        camera = self._mounting.sample(event)
        return Arrival(came_ns, camera, encode(camera), stamped=True)
