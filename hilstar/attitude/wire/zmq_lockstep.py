"""ZeroMQ in lockstep: one request, one reply."""

from __future__ import annotations

import contextlib
import time

import msgspec
import zmq

from hilstar.attitude.wire.keys import NO_KEYS, CurveKeys
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import Event, Refusal, Status, TimeReply, decode, encode
from hilstar.attitude.wire.zmq_socket import ZmqSocket
from hilstar.notices import Notices


class ZmqLockstep(ZmqSocket):
    """A REP socket: one request is one attitude and gets one reply; it binds, or connects with `bind=False`."""

    def __init__(self, endpoint: str, *, bind: bool = True, keys: CurveKeys = NO_KEYS, notices: Notices | None = None) -> None:
        super().__init__(zmq.REP, endpoint, bind=bind, keys=keys, notices=notices)
        self._json = False

    def receive(self, timeout_ms: int) -> Arrival[Event] | None:
        """The next request, or None; each must be answered before the next can arrive.

        libzmq announces a request without its delimiter and then drops it: it is not waited for.
        """
        message = self._take() if self._waits(timeout_ms) else None
        if message is None:
            return None
        self._json = message[:64].lstrip()[:1] == b"{"
        return Arrival(time.monotonic_ns(), decode(message), message)

    def reply(self, status: Status, shown_ns: int, refusal: Refusal | None) -> None:
        """Answer the request: with a status packet for a packet, with an object for JSON."""
        if not self._json:
            self._answer(encode(status))
            return
        fields = {name: getattr(status, name) for name in status.__dataclass_fields__}
        trouble = None if refusal is None else {"reason": refusal.reason, "detail": refusal.detail}
        self._answer(msgspec.json.encode({**fields, "shown_ns": shown_ns, "refused": trouble}))

    def reply_time(self, reply: TimeReply) -> None:
        """Answer a time request."""
        self._answer(encode(reply))

    def _answer(self, message: bytes) -> None:
        """A peer that is gone, or does not read, gets no answer."""
        with contextlib.suppress(zmq.Again):
            self._ready().send(message, zmq.NOBLOCK)
