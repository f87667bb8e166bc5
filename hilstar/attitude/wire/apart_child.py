"""python -m hilstar.attitude.wire.apart_child: the process that reads a link, stamps what comes, and hands it over (`apart`).

It hears no signals: the process that shows stars does, and ends this one.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn, Protocol

import msgspec

from hilstar.attitude.wire.apart import (
    CountsRecord,
    EndRecord,
    GoneRecord,
    MessageRecord,
    NoticeRecord,
    ReadOrder,
    Record,
    SignRecord,
    ZmqStream,
    pack,
)
from hilstar.attitude.wire.links import LinkCounts, RawMessage
from hilstar.errors import HilstarError, one_line
from hilstar.notices import Notices
from hilstar.process.interrupts import ENDING, end_with_parent
from hilstar.process.scheduling import PromptWhileLight

WANTED_BUFFER_BYTES = 1 << 20  # for some hundred unread messages; the kernel may give less
MAX_ORDER_BYTES = 65_536
MAX_READ_BYTES = 65_536
LIFE_S = 0.1
POLL_MS = 20


class Wire:
    """This end of the socket pair; a peer that is gone raises EOFError."""

    def __init__(self, made: socket.socket) -> None:
        self._socket = made
        self._signed_s = -LIFE_S
        made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WANTED_BUFFER_BYTES)
        self._poll = select.poll()
        self._poll.register(made, select.POLLIN)

    def sign(self) -> None:
        """Say that this process is ready, and from time to time that it still is."""
        now_s = time.monotonic()
        if now_s - self._signed_s >= LIFE_S:
            self._signed_s = now_s
            self.put(SignRecord())

    def put(self, record: Record) -> None:
        """Hand a record over; waits while the other side does not read, so that nothing grows here."""
        try:
            self._socket.sendall(pack(record))
        except OSError as error:
            raise EOFError from error

    def order(self, timeout_ms: float) -> tuple[ReadOrder, int | None] | None:
        """The newest order, if there is one within the time, and the device's descriptor."""
        if not self._poll.poll(timeout_ms):
            return None
        said, files = b"", [-1]
        try:
            while not said.endswith(b"\n"):
                more, files, _, _ = socket.recv_fds(self._socket, MAX_ORDER_BYTES, 1)
                if not more:
                    raise EOFError
                said += more
        except OSError as error:
            raise EOFError from error
        newest = msgspec.json.decode(said.splitlines()[-1], type=ReadOrder)
        return newest, files[0] if newest.device and files else None


class Source(Protocol):
    """The thing to read. `empty_ns` is the last host time at which nothing waited."""

    empty_ns: int

    def waits(self) -> bool:
        """Whether something waits."""

    def take(self, timeout_ms: int) -> Sequence[RawMessage]:
        """The messages so far, stamped; waits at most `timeout_ms`. Raises OSError where a device no longer answers."""

    def close(self) -> None:
        """Close this process's end of it."""


class DeviceSource:
    """An open serial device, which the process that shows stars has opened and set up."""

    def __init__(self, file: int) -> None:
        self.empty_ns = 0  # bytes that already wait may have come at any time
        self._file = file

    def waits(self) -> bool:
        """Whether a byte waits."""
        return bool(select.select([self._file], [], [], 0)[0])

    def take(self, timeout_ms: int) -> Sequence[RawMessage]:
        """The bytes that came, as one message."""
        if not select.select([self._file], [], [], timeout_ms / 1000)[0]:
            return []
        try:
            chunk = os.read(self._file, MAX_READ_BYTES)
        except BlockingIOError:
            return []
        if not chunk:
            raise OSError(0, "it was readable, and nothing came")
        return [RawMessage(time.monotonic_ns(), [chunk])]

    def close(self) -> None:
        """Close this process's copy of the device."""
        with contextlib.suppress(OSError):
            os.close(self._file)


class ForwardedNotices(Notices):
    """Forwards a link's notices, each after the counts so far; drops them once the other side is gone."""

    def __init__(self, wire: Wire, order: int) -> None:
        super().__init__()
        self.link_counts = LinkCounts()  # the link's own, as soon as there is one
        self._wire, self._order, self._counted = wire, order, LinkCounts()

    def count(self) -> None:
        """Forward the growth of the counts."""
        grown, self._counted = self.link_counts - self._counted, replace(self.link_counts)
        if grown != LinkCounts():
            self._wire.put(CountsRecord(self._order, grown))

    def tell(self, kind: str, detail: str, who: str = "") -> None:
        """Forward a lasting notice."""
        with contextlib.suppress(EOFError):
            self.count()
            self._wire.put(NoticeRecord(self._order, kind, detail, who))

    def mention(self, kind: str, detail: str) -> None:
        """Forward a mention."""
        with contextlib.suppress(EOFError):
            self.count()
            self._wire.put(NoticeRecord(self._order, kind, detail, lasting=False))


class ZmqSource:
    """A SUB socket, opened here. Raises InputError where it cannot be."""

    def __init__(self, stream: ZmqStream, notices: ForwardedNotices) -> None:
        from hilstar.attitude.wire.keys import CurveKeys  # libzmq takes 30 ms, and a serial line needs none of it
        from hilstar.attitude.wire.zmq_links import ZmqReceiver

        files = (stream.secret_key, stream.server_key, stream.allowed_clients)
        self._notices = notices
        self._link = ZmqReceiver(
            stream.endpoint,
            bind=stream.bind,
            keys=CurveKeys(*(None if each is None else Path(each) for each in files)),
            notices=notices,
            topic=stream.topic,
            max_part_bytes=stream.max_part_bytes,
        )
        notices.link_counts = self._link.link_counts
        self.empty_ns = time.monotonic_ns()

    def waits(self) -> bool:
        """Whether a message waits."""
        return self._link.wait_for_message(0)

    def take(self, timeout_ms: int) -> Sequence[RawMessage]:
        """The messages that came."""
        taken = self._link.taken(timeout_ms)
        self._notices.count()
        return taken

    def close(self) -> None:
        """Close the socket."""
        self._link.close()


def _source(wire: Wire, order: ReadOrder, file: int | None) -> Source | None:
    if order.stream is not None:
        return ZmqSource(order.stream, ForwardedNotices(wire, order.number))
    return None if file is None else DeviceSource(file)


def _hand_over(wire: Wire, order: int, source: Source) -> None:
    """Stamp and hand over what came."""
    asked_ns = time.monotonic_ns()
    waits = source.waits()
    if not waits:
        source.empty_ns = asked_ns
    taken = source.take(POLL_MS)
    for k, message in enumerate(taken):
        # The newest of those that arrived while this process slept woke it; the others had to wait.
        timely = not waits and k == len(taken) - 1
        wire.put(MessageRecord(order, message._replace(empty_ns=source.empty_ns, timely=timely)))


def read_as_ordered(wire: Wire) -> NoReturn:
    """Read what is ordered until the other side is gone (EOFError). Raises InputError where a socket cannot be opened."""
    priority = PromptWhileLight()
    number, source = 0, None
    while True:
        wire.sign()
        ordered = wire.order(LIFE_S * 1000 if source is None else 0)
        if ordered is not None:
            if source is not None:
                source.close()
            number, source = ordered[0].number, _source(wire, *ordered)
        if source is not None:
            try:
                _hand_over(wire, number, source)
            except OSError as error:
                source.close()
                source = None
                wire.put(GoneRecord(number, error.strerror or str(error)))
        priority.tend()


def main() -> NoReturn:
    """Read until the other side is gone; report there in a line what ends this process early."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)
    file, parent = map(int, sys.argv[1:3])
    end_with_parent(parent)
    wire = Wire(socket.socket(fileno=file))
    code = 0
    try:
        read_as_ordered(wire)
    except EOFError:
        pass
    except BaseException as error:
        code = 1
        why = str(error) if isinstance(error, HilstarError) else f"{type(error).__name__}: {error}"
        with contextlib.suppress(EOFError):
            wire.put(EndRecord(one_line(why)))
    os._exit(code)  # threads of libraries are not waited for


if __name__ == "__main__":
    main()
