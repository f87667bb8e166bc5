"""The sending end of every road to hilstar (ZeroMQ, serial line, UDP), and `Sender`, a simulator
in Python over any of them.
"""

from __future__ import annotations  # docs/python-api.md shows annotations as they are written

import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from hilstar.attitude.wire.keys import NO_KEYS, CurveKeys
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import (
    DELIMITER,
    AnswerPacket,
    Event,
    Packet,
    Refusal,
    Status,
    TimeReply,
    TimeRequest,
    checked_sample,
    decode,
    encode,
    framed,
)
from hilstar.attitude.wire.protocol import MAX_SENDER
from hilstar.attitude.wire.roads import LinkCounts
from hilstar.attitude.wire.serial_link import SerialLink, serial_target
from hilstar.attitude.wire.udp import Datagrams
from hilstar.attitude.wire.zmq_links import ZmqSender
from hilstar.basics.attitudes import quaternion_of, rate_of, seconds_of, t_ns_of, whole_of
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.interrupts import caught

if TYPE_CHECKING:
    from hilstar.basics.attitudes import Angle, Attitude, Rate, Time

LISTEN_MS = 20
PATIENCE_S = 0.5  # a line that accepts nothing for this long has no reader
MAX_TAKEN = 100
PROBE_S = 0.02
UDP = re.compile(r"udp://(?:\[([0-9A-Fa-f:.]+(?:%\w+)?)\]|([^:\[\]/\s]+)):(\d{1,5})")
Clock = Callable[[], int]


def open_sender(
    to: str, *, connect: bool = False, keys: CurveKeys = NO_KEYS, clock: Clock = time.monotonic_ns
) -> SenderEnd:
    """The end that `to` names: serial line, UDP, or else ZeroMQ; `clock` (ns) stamps its time
    replies. Raises InputError.
    """
    line = serial_target(to)
    if line is None and not to.startswith("udp:"):
        return ZmqSender(to, bind=not connect, keys=keys)
    if keys.given or connect:
        raise InputError(
            f"{to}: only ZeroMQ has keys, and a side that connects (--connect); remove them"
        )
    if line is None:
        return UdpSender(to, clock)
    return SerialSender(*line, clock)


class TwoWay(Closing):
    """An end that also listens: a thread answers time requests by the clock, keeps the newest
    status and answer.
    """

    status: Status | None = None
    answer: AnswerPacket | None = None
    statuses = requests = 0  # that came; every request is answered

    def _listen_to(
        self,
        receive: Callable[[int], list[Arrival[Event]]],
        send: Callable[[Packet], None],
        clock: Clock,
    ) -> None:
        self._answered = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._listen, args=(receive, send, clock), name="hilstar-sender", daemon=True
        )
        self._thread.start()

    def _listen(
        self,
        receive: Callable[[int], list[Arrival[Event]]],
        send: Callable[[Packet], None],
        clock: Clock,
    ) -> None:
        while not self._stop.is_set():
            for arrival in receive(LISTEN_MS):
                match arrival.event:
                    case TimeRequest(sequence, t1_ns):
                        self.requests += 1
                        waited_ns = time.monotonic_ns() - arrival.host_ns
                        send(TimeReply(sequence, t1_ns, clock() - waited_ns, clock()))
                    case TimeReply():
                        self._answered.set()
                    case Status() as status:
                        self.status, self.statuses = status, self.statuses + 1
                    case AnswerPacket() as answer:
                        self.answer = answer

    def _stop_listening(self) -> None:
        self._stop.set()
        self._thread.join()


class SerialSender(TwoWay, SerialLink):
    """The sender's end of a serial line."""

    def __init__(self, port: str, baud: int, clock: Clock = time.monotonic_ns) -> None:
        super().__init__(port, baud)
        self.send_bytes(DELIMITER)
        self._listen_to(self.receive, self.send, clock)

    def wait_for_listener(self, timeout_s: float) -> bool:
        """A serial line cannot tell whether anybody listens."""
        return True

    def put(self, packet: bytes) -> None:
        """Frame a packet and send it, at the speed of the line."""
        self.send_bytes(framed(packet), PATIENCE_S)

    def close(self) -> None:
        """Stop listening, and close the port once everything has been sent; after a signal at
        once.
        """
        self._stop_listening()
        if caught() is None:
            self.drain()
        super().close()


class UdpSender(TwoWay):
    """The sender's end of UDP: a connected socket. Raises InputError where the endpoint is wrong
    or its host unknown.
    """

    def __init__(self, to: str, clock: Clock = time.monotonic_ns) -> None:
        match = UDP.fullmatch(to)
        if match is None or not 0 < int(match[3]) < 65_536:
            raise InputError(
                f"{shortened(to)}: write udp://HOST:PORT, such as udp://127.0.0.1:5560 or"
                " udp://[::1]:5560"
            )
        try:
            self._datagrams = Datagrams.connected(match[1] or match[2], int(match[3]))
        except OSError as error:
            raise InputError(
                f"{shortened(to)}: {error.strerror}; write the address of hilstar's machine"
            ) from error
        self.endpoint = to
        self.link_counts = LinkCounts()
        self._listen_to(self._receive, lambda packet: self.put(encode(packet)), clock)

    def _receive(self, timeout_ms: int) -> list[Arrival[Event]]:
        self._datagrams.wait(timeout_ms)
        taken = self._datagrams.take(MAX_TAKEN)
        return [
            Arrival(datagram.host_ns, decode(datagram.parts[0]), datagram.parts[0])
            for datagram in taken
        ]

    def wait_for_listener(self, timeout_s: float) -> bool:
        """True once hilstar has answered a time request."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            self.put(encode(TimeRequest(0, time.monotonic_ns())))
            if self._answered.wait(PROBE_S):
                return True
            if time.monotonic() > deadline_s:
                return False

    def put(self, packet: bytes) -> None:
        """Send one datagram, never waiting."""
        self._datagrams.put(packet)

    def close(self) -> None:
        """Stop listening, and close the socket."""
        self._stop_listening()
        self._datagrams.close()


SenderEnd = ZmqSender | SerialSender | UdpSender  # where a sender puts its packets


class Sender(Closing):
    """The sending end of a road to hilstar; `hilstar serve` is the other.

    `to` is `udp://HOST:PORT`, `serial:/dev/ttyX@BAUD`, or a ZeroMQ endpoint: `tcp://HOST:PORT` or
    `ipc:///PATH`, which this end binds unless `connect`. The key files are those of `hilstar keys`:
    `secret_key`, with `allowed_clients` where this end binds and `server_key` where it connects.
    `clock` gives the simulation's time in ns, of any zero. Over UDP and serial lines a thread
    answers hilstar's time requests on it, and keeps the newest `status`. `sender` is this sender's
    number, 1 to 254, by which hilstar tells it from another; 0: not given. Raises InputError where
    the road cannot be opened.

    >>> with hilstar.Sender("udp://127.0.0.1:5560") as sender:
    ...     sender.send([0.6987226, 0.7135120, -0.0370377, 0.0362700], [0, 0, 0.01])
    """

    def __init__(
        self,
        to: str = "tcp://127.0.0.1:5560",
        *,
        connect: bool = False,
        secret_key: str | Path | None = None,
        server_key: str | Path | None = None,
        allowed_clients: str | Path | None = None,
        clock: Clock = time.monotonic_ns,
        sender: int = 0,
    ) -> None:
        if not isinstance(to, str):
            raise InputError(f"to {shortened(repr(to))}: write a road such as tcp://127.0.0.1:5560")
        if not callable(clock):
            raise InputError(f"clock {shortened(repr(clock))}: write a function that returns ns")
        if whole_of(sender, "sender") > MAX_SENDER:
            raise InputError(f"sender {sender}: write 1 to {MAX_SENDER}, or 0 for no number")
        self._number = sender
        files = (secret_key, server_key, allowed_clients)
        keys = CurveKeys(*(None if file is None else Path(file) for file in files))
        self._clock = clock
        self._end = open_sender(to, connect=connect, keys=keys, clock=clock)
        self._sequence = 0
        self._closed = False

    @property
    def endpoint(self) -> str:
        """Where this end is: bound to a free port, its number is in it."""
        return self._end.endpoint

    @property
    def status(self) -> Status | None:
        """The newest status of hilstar; None before the first, and over ZeroMQ, which has no way
        back.
        """
        return self._end.status

    @property
    def answer(self) -> AnswerPacket | None:
        """The tracker's newest valid answer, `t_ns` on this end's clock; None as `status` is,
        and without `[answers]`.
        """
        return self._end.answer

    def wait(self, timeout_s: float = 30.0) -> bool:
        """True once hilstar listens: a subscriber (ZeroMQ), an answer (UDP), or at once where
        the road cannot tell (serial).
        """
        return self._end.wait_for_listener(seconds_of(timeout_s, "timeout_s"))

    def send(
        self,
        q_icrs_to_cam: Attitude,
        rate_cam_rad_s: Rate | None = None,
        *,
        t_ns: Time | None = None,
        discontinuity: bool = False,
        roll_deg: Angle | None = None,
    ) -> None:
        """Send one attitude: a unit quaternion (4,), scalar first, and its rate (3,), rad/s, camera
        components, if it is known.

        A SciPy Rotation or an Astropy SkyCoord with `roll_deg` is sent as q_icrs_to_cam, and
        quantities in their units. `t_ns` is the instant of the attitude on the simulation's clock,
        by default now.
        `discontinuity` says that the attitude jumped. Raises InputError for what hilstar would
        refuse. Only a full serial line is waited for, half a second at most.
        """
        if self._closed:
            raise InputError("send: the sender is closed; make another one")
        at_ns = t_ns_of(self._clock(), "clock") if t_ns is None else t_ns_of(t_ns)
        q = tuple(quaternion_of(q_icrs_to_cam, roll_deg).tolist())
        rate = None if rate_cam_rad_s is None else tuple(rate_of(rate_cam_rad_s).tolist())
        sample = checked_sample(at_ns, q, rate, self._sequence, discontinuity, self._number)
        if isinstance(sample, Refusal):
            raise InputError(f"{sample.detail} ({sample.reason})")
        self._sequence += 1
        self._end.put(encode(sample))

    def close(self) -> None:
        """Close the road; what was sent over ZeroMQ or a serial line leaves first."""
        self._closed = True
        self._end.close()
