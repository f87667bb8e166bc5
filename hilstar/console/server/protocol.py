"""HTTP/1.1 with bounds: a connection that says nothing, or says it slowly, is closed; of too many the oldest gives way.

(uvicorn bounds what a request may hold, but not how long it may take to come.)
"""

from __future__ import annotations

import asyncio
from typing import Any

from h11 import Request
from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_S = 5.0  # for a request's head to be whole
WHOLE_S = 20.0  # for its body, and for the answer to be read
MAX_WAITING = 100  # connections in which no request has been answered

_waiting: dict[BoundedHttp, None] = {}


class BoundedHttp(H11Protocol):
    """One connection."""

    _limit: asyncio.TimerHandle | None = None
    _timed_cycle: Any = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time for a request's head; where too many wait, the oldest is dropped."""
        super().connection_made(transport)
        _waiting[self] = None
        if len(_waiting) > MAX_WAITING:
            next(iter(_waiting))._drop()
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
        """The answer is out: the connection is one that is used."""
        self._end_time()
        _waiting.pop(self, None)
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: Request) -> None:
        """A WebSocket has bounds of its own."""
        self._end_time()
        _waiting.pop(self, None)
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """It is gone."""
        self._end_time()
        _waiting.pop(self, None)
        super().connection_lost(exc)

    def _within(self, seconds: float) -> None:
        self._end_time()
        self._limit = self.loop.call_later(seconds, self._drop)

    def _end_time(self) -> None:
        if self._limit is not None:
            self._limit.cancel()
            self._limit = None

    def _drop(self) -> None:
        _waiting.pop(self, None)
        self._end_time()
        self.transport.abort()
