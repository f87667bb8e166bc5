"""python -m hilstar.attitude.wire.apart_child: the process that reads a link, stamps what comes,
and hands it over (`apart`).

It hears no signals: the process that shows stars does, and ends this one.
"""

import contextlib
import os
import pickle
import select
import signal
import socket
import sys
from dataclasses import replace
from typing import NoReturn

from hilstar.attitude.wire.apart import RawLink, ReadOrder, Record, pack
from hilstar.attitude.wire.roads import LinkCounts, RawMessage, is_readable, read_device
from hilstar.basics.errors import HilstarError, one_line
from hilstar.basics.notices import Notices
from hilstar.basics.process.interrupts import ENDING, end_with_parent
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock, PromptWhileLight

WANTED_BUFFER_BYTES = 1 << 20  # for some hundred unread messages; the kernel may give less
MAX_ORDER_BYTES = 65_536
LIFE_S = 0.1
POLL_MS = 20


class Wire:
    """This end of the socket pair; a peer that is gone raises EOFError."""

    def __init__(self, made: socket.socket, clock: HostClock = HOST_CLOCK) -> None:
        self._socket = made
        self._clock = clock
        self._next_sign = clock.within(0.0)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WANTED_BUFFER_BYTES)
        self._poll = select.poll()
        self._poll.register(made, select.POLLIN)

    def sign(self) -> None:
        """Say that this process is ready, and from time to time that it still is."""
        if self._next_sign.over:
            self._next_sign = self._clock.within(LIFE_S)
            self.put(Record())

    def put(self, record: Record) -> None:
        """Hand a record over; waits while the other side does not read, so that nothing grows
        here.
        """
        try:
            self._socket.sendall(pack(record))
        except OSError as error:
            raise EOFError from error

    def order(self, timeout_ms: float) -> tuple[ReadOrder, int | None] | None:
        """The newest order, if there is one within the time, and the device's descriptor."""
        if not self._poll.poll(timeout_ms):
            return None
        order_bytes = b""
        files = [-1]
        try:
            while not order_bytes.endswith(b"\n"):
                more, files, _, _ = socket.recv_fds(self._socket, MAX_ORDER_BYTES, 1)
                if not more:
                    raise EOFError
                order_bytes += more
        except OSError as error:
            raise EOFError from error
        newest: ReadOrder = pickle.loads(bytes.fromhex(order_bytes.splitlines()[-1].decode()))
        return newest, files[0] if newest.device and files else None


class _OpenDevice:
    def __init__(self, file: int, clock: HostClock = HOST_CLOCK) -> None:
        self.link_counts = LinkCounts()
        self._file = file
        self._clock = clock

    def wait_for_message(self, timeout_ms: int) -> bool:
        return is_readable(self._file, timeout_ms)

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        return read_device(self._file, timeout_ms, self._clock)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            os.close(self._file)


class _ForwardedNotices(Notices):
    def __init__(self, wire: Wire, order: int) -> None:
        super().__init__()
        self.link_counts = LinkCounts()  # the link's own, as soon as there is one
        self._wire = wire
        self._order = order
        self._counted = LinkCounts()

    def count(self) -> None:
        grown = self.link_counts - self._counted
        self._counted = replace(self.link_counts)
        if grown != LinkCounts():
            self._wire.put(Record(self._order, counts=grown))

    def tell(
        self,
        kind: str,
        detail: str,
        who: str = "",
        since_ns: int | None = None,
        *,
        lasting: bool = True,
    ) -> None:
        with contextlib.suppress(EOFError):
            self.count()
            self._wire.put(Record(self._order, notice=(kind, detail, who), lasting=lasting))

    def mention(self, kind: str, detail: str) -> None:
        self.tell(kind, detail, lasting=False)


def as_read(taken: list[RawMessage], had_waited: bool, empty_ns: int) -> list[RawMessage]:
    """Messages that were read together, as a process that slept until they came stamps them: the
    newest woke it, and the others had to wait; all had to where one `had_waited` before.
    """
    last = len(taken) - 1
    return [
        message._replace(empty_ns=empty_ns, timely=k == last and not had_waited)
        for k, message in enumerate(taken)
    ]


class _Reading:
    """An order that is carried out. Raises InputError where its socket cannot be opened."""

    def __init__(
        self, wire: Wire, order: ReadOrder, file: int | None, clock: HostClock = HOST_CLOCK
    ) -> None:
        self._wire = wire
        self._number = order.number
        self._clock = clock
        self._notices = _ForwardedNotices(wire, order.number)
        self._empty_ns = clock.now_ns()
        self.link: RawLink | None = None
        if order.stream is not None:
            self.link = order.stream(notices=self._notices)
            self._notices.link_counts = self.link.link_counts
        elif file is not None:
            self._empty_ns = 0  # bytes that already wait may have come at any time
            self.link = _OpenDevice(file, clock)

    def hand_over(self, link: RawLink) -> None:
        """Stamp and hand over what came; a device that does not answer any more is said, and
        closed.
        """
        asked_ns = self._clock.now_ns()
        try:
            waits = link.wait_for_message(0)
            if not waits:
                self._empty_ns = asked_ns
            taken = link.taken(POLL_MS)
        except OSError as error:
            self.close()
            self._wire.put(Record(self._number, gone=error.strerror or str(error)))
            return
        self._notices.count()
        for message in as_read(taken, waits, self._empty_ns):
            self._wire.put(Record(self._number, message))

    def close(self) -> None:
        if self.link is not None:
            self.link.close()
        self.link = None


def main() -> NoReturn:
    """Read what is ordered until the other side is gone; report there in a line what ends this
    process early.
    """
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)
    file, parent = map(int, sys.argv[1:3])
    end_with_parent(parent)
    wire = Wire(socket.socket(fileno=file))
    code = 0
    try:
        priority = PromptWhileLight()
        reading = _Reading(wire, ReadOrder(0), None)
        while True:
            wire.sign()
            ordered = wire.order(LIFE_S * 1000 if reading.link is None else 0)
            if ordered is not None:
                reading.close()
                # which may loop for ever, and is imported as the link is opened
                if ordered[0].runs_user_code:
                    priority.give_up()
                reading = _Reading(wire, *ordered)
                wire.put(Record(ordered[0].number))  # a user's module may take seconds to import
            if reading.link is not None:
                reading.hand_over(reading.link)
            priority.tend()
    except EOFError:
        pass
    except BaseException as error:
        code = 1
        if isinstance(error, HilstarError):
            why = str(error)
        else:
            why = f"{type(error).__name__}: {error}"
        with contextlib.suppress(EOFError):
            wire.put(Record(end=one_line(why)))
    os._exit(code)  # threads of libraries are not waited for


if __name__ == "__main__":
    main()
