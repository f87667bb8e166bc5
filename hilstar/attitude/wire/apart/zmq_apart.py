"""A ZeroMQ stream whose socket another process owns: what it stamped, as a link."""

from __future__ import annotations

import json
import math
import time
from types import TracebackType
from typing import Self

from hilstar.attitude.wire.apart.reader import Reader
from hilstar.attitude.wire.apart.records import Kind, Record, unpack_message
from hilstar.attitude.wire.apart.zmq_child import order
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import Event, Packet
from hilstar.attitude.wire.zmq_links import Taken, ZmqReceiver
from hilstar.notices import Notices

CHILD = "hilstar.attitude.wire.apart.zmq_child"


class ZmqApart:
    """The stream of `link`, which was opened to see that it can be, and is closed here: it only says what messages mean.

    The socket is opened at the first read, as a link's own would be, so that no old messages collect in it.
    """

    two_way = False

    def __init__(self, link: ZmqReceiver, notices: Notices | None = None) -> None:
        link.close()
        self.verb, self.endpoint, self.conventions = link.verb, link.endpoint, link.conventions
        self.link_counts = link.link_counts
        self._meaning = link
        self._order = order(link)
        self._notices = Notices() if notices is None else notices
        self._waiting: list[Taken] = []
        self._counted_before = link.link_counts.summary()
        self._ordered = 0
        self._reader = Reader(CHILD, self._notices)

    @property
    def reconnects(self) -> int:
        """How often the sender reconnected."""
        return self._meaning.reconnects

    def await_ready(self) -> None:
        """Wait until the socket can be opened at once, or for a moment."""
        self._reader.await_ready()

    def receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        """The messages that came, oldest first, with their stamps; waits at most `timeout_ms` for the first."""
        self.wait_for_message(timeout_ms)
        waiting, self._waiting = self._waiting, []
        return self._meaning.arrivals(waiting)

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once a message has come."""
        deadline_s = time.monotonic() + timeout_ms / 1000
        while not self._waiting:
            if self._reader.tend():
                self._give_order()
            left_ms = math.ceil(max(0.0, deadline_s - time.monotonic()) * 1000)
            if self._reader.wait(left_ms):
                for record in self._reader.take():
                    self._take(record)
            elif not left_ms:
                break
        return bool(self._waiting)

    def _give_order(self) -> None:
        if self._ordered == self._reader.generation:
            return
        self._ordered = self._reader.generation
        self._counted_before = self.link_counts.summary()
        self._reader.give(self._order)

    def _take(self, record: Record) -> None:
        kind, payload = record
        if kind == Kind.MESSAGE:
            message = unpack_message(payload)
            self._waiting.append(Taken(message.host_ns, message.parts, message.waited_ns))
        elif kind == Kind.NOTICE:
            (method, *told), counts = json.loads(payload)
            self._count(counts)
            (self._notices.mention if method == "mention" else self._notices.tell)(*told)
        elif kind == Kind.COUNTS:
            self._count(json.loads(payload))

    def _count(self, counts: dict[str, int]) -> None:
        for name, count in counts.items():
            setattr(self.link_counts, name, self._counted_before[name] + count)

    def send(self, packet: Packet) -> None:
        """A subscriber cannot reply."""

    def wire_ns(self, packet: Packet) -> int:
        """Negligible."""
        return 0

    def close(self) -> None:
        """End the process, and with it the socket."""
        self._reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
