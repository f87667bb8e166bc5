"""HTTP/1.1 and WebSockets with bounds: who says nothing, says it slowly, or does not read is closed.

(uvicorn bounds what a request may hold, but neither how long it may take to come nor what waits for a peer that does not read.)
"""

from __future__ import annotations

import asyncio
import socket
import time
from collections import OrderedDict
from typing import Any, cast

from h11 import Request
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.wsproto_impl import WSProtocol
from wsproto import events

HEAD_S = 5.0  # for a request's head to be whole
WHOLE_S = 20.0  # for its body, and for the answer to be read
MAX_CONNECTIONS = 100  # that are no WebSocket; first those give way that have had an answer, then the oldest
PING_S, PONG_S = 2.0, 20.0  # each so often a WebSocket is asked for a sign of life, and so long it may take
UNREAD_S = 4.0  # without that sign a peer counts as one that does not read
MAX_UNSENT_BYTES = 65_536  # in the kernel
MAX_PONGS_BYTES = 200_000  # that wait for a peer that sends pings and reads nothing
LINE = "hilstar.line"  # in a WebSocket's scope: its `ReadingWebSocket`

_connections: OrderedDict[BoundedHttp, None] = OrderedDict()


class BoundedHttp(H11Protocol):
    """One connection."""

    _limit: asyncio.TimerHandle | None = None
    _timed_cycle: Any = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time for a request's head; where there are too many connections, one is dropped."""
        super().connection_made(transport)
        _connections[self] = None
        if len(_connections) > MAX_CONNECTIONS:
            next(iter(_connections))._drop()
        self._within(HEAD_S)

    def data_received(self, data: bytes) -> None:
        """Take bytes; once a head is whole, the rest has its own time."""
        if self._limit is None:
            self._within(HEAD_S)
        super().data_received(data)
        if self.cycle is not None and self.cycle is not self._timed_cycle and not self.cycle.response_complete:
            self._timed_cycle = self.cycle
            self._within(WHOLE_S)

    def on_response_complete(self) -> None:
        """The answer is out: nobody waits for this connection."""
        self._end_time()
        if self in _connections:
            _connections.move_to_end(self, last=False)
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: Request) -> None:
        """A WebSocket has bounds of its own."""
        self._end_time()
        _connections.pop(self, None)
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """It is gone."""
        self._end_time()
        _connections.pop(self, None)
        super().connection_lost(exc)

    def _within(self, seconds: float) -> None:
        self._end_time()
        self._limit = self.loop.call_later(seconds, self._drop)

    def _end_time(self) -> None:
        if self._limit is not None:
            self._limit.cancel()
            self._limit = None

    def _drop(self) -> None:
        _connections.pop(self, None)
        self._end_time()
        self.transport.abort()


class ReadingWebSocket(WSProtocol):
    """A WebSocket whose peer has to read: it answers pings, and what waits for it is bounded."""

    _heard_s: float | None = None  # when it last answered one

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Let little wait in the kernel: what a slow peer is sent would be old."""
        super().connection_made(transport)
        found = transport.get_extra_info("socket")
        if found is not None:
            found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, MAX_UNSENT_BYTES)

    def handle_connect(self, event: events.Request) -> None:
        """Leave itself in the scope, for who serves the WebSocket."""
        super().handle_connect(event)
        cast(dict[str, object], self.scope["extensions"])[LINE] = self

    @property
    def is_read(self) -> bool:
        """Whether the peer has lately shown that it reads."""
        return self._heard_s is not None and time.monotonic() - self._heard_s < UNREAD_S

    def start_keepalive(self) -> None:
        """Ask at once whether the peer reads."""
        self.send_keepalive_ping()

    def handle_pong(self, event: events.Pong) -> None:
        """It has read up to here."""
        if bytes(event.payload) == self.pending_ping_payload:
            self._heard_s = time.monotonic()
        super().handle_pong(event)

    def handle_ping(self, event: events.Ping) -> None:
        """Answer, unless the answers are not read."""
        if self.transport.get_write_buffer_size() > MAX_PONGS_BYTES:
            self.drop()
        else:
            super().handle_ping(event)

    def keepalive_timeout(self) -> None:
        """It does not read: nothing more can be said to it."""
        self.drop()

    def drop(self) -> None:
        """Close the connection now, whatever waits to be sent."""
        self.transport.abort()
