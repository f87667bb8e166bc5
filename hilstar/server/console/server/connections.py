"""Connections to pages: HTTP and WebSockets with bounds; every open page gets messages at its
own speed.
"""

import asyncio
import socket
import time
from collections import Counter, OrderedDict, deque
from typing import Any, cast

import msgspec
from h11 import Request
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.wsproto_impl import WSProtocol
from wsproto import events

from hilstar.server.console.protocol import GIVES_WAY, PageMessage, PageText, PageWants
from hilstar.server.console.server.reader import PackedPicture

HEAD_S = 5.0  # for a request's head to be whole
WHOLE_S = 20.0  # for its body, and for the answer to be read
MAX_CONNECTIONS = 100  # besides WebSockets; those with an answer give way first, then the oldest
PING_S, PONG_S = 2.0, 20.0  # interval of a WebSocket's pings, and the time limit of a pong
UNREAD_S = 4.0  # a peer without a pong for this long counts as one that does not read
MAX_UNSENT_BYTES = 65_536  # in the kernel
MAX_PONGS_BYTES = 200_000  # that wait for a peer that sends pings and reads nothing
LINE = "hilstar.line"  # in a WebSocket's scope: its `ReadingWebSocket`

_connections: "OrderedDict[BoundedHttp, None]" = OrderedDict()
MAX_CLIENTS = 32
MAX_WAITING_TEXTS = 100  # ten seconds
SEND_S = 10.0
CLOSING_S = 5.0  # for a close to be read
MAX_WISHES = 40  # in WISHES_S
WISHES_S = 2.0
TRY_AGAIN, POLICY = 1013, 1008  # close codes of RFC 6455 and its registry


class BoundedHttp(H11Protocol):
    """One connection. It is closed where the peer says nothing, says it slowly, or does not read.

    uvicorn bounds what a request may hold, but neither how long it may take nor what waits for a
    peer that does not read.
    """

    _limit: asyncio.TimerHandle | None = None
    _timed_cycle: Any = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time limit of a request's head; drop a connection where there are too many."""
        super().connection_made(transport)
        _connections[self] = None
        if len(_connections) > MAX_CONNECTIONS:
            next(iter(_connections))._drop()
        self._within(HEAD_S)

    def data_received(self, data: bytes) -> None:
        """Take bytes; once the head is complete, the rest has its own time limit."""
        if self._limit is None:
            self._within(HEAD_S)
        super().data_received(data)
        if (
            self.cycle is not None
            and self.cycle is not self._timed_cycle
            and not self.cycle.response_complete
        ):
            self._timed_cycle = self.cycle
            self._within(WHOLE_S)

    def on_response_complete(self) -> None:
        """The answer is sent: this connection may give way first."""
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
        """Forget the connection."""
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
        """Bound the bytes that wait in the kernel: a slow peer would get old data."""
        super().connection_made(transport)
        own_socket = transport.get_extra_info("socket")
        if own_socket is not None:
            own_socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, MAX_UNSENT_BYTES)

    def handle_connect(self, event: events.Request) -> None:
        """Put itself into the scope, for the application."""
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
        """The peer has read up to here."""
        if bytes(event.payload) == self.pending_ping_payload:
            self._heard_s = time.monotonic()
        super().handle_pong(event)

    def handle_ping(self, event: events.Ping) -> None:
        """Answer, unless the peer does not read the answers."""
        if self.transport.get_write_buffer_size() > MAX_PONGS_BYTES:
            self.drop()
        else:
            super().handle_ping(event)

    def keepalive_timeout(self) -> None:
        """Drop a peer that does not read."""
        self.drop()

    def drop(self) -> None:
        """Close the connection now, whatever waits to be sent."""
        self.transport.abort()


class OpenPage:
    """One page."""

    def __init__(self, socket: WebSocket) -> None:
        self.socket = socket
        self.line: ReadingWebSocket = socket.scope["extensions"][LINE]
        self.address = "" if socket.client is None else socket.client.host
        self.want = PageWants()
        self.asked = False  # has said what it wants, as the page does at once
        self.is_page = "origin" in socket.headers
        self.closing: int | None = None
        self._texts: deque[str] = deque()
        self._packed: PackedPicture | None = None
        self._picture_s = 0.0
        self._wake = asyncio.Event()
        self._wishes_s: deque[float] = deque(maxlen=MAX_WISHES)

    def tell(self, text: str) -> None:
        """Queue a text; a page that takes none for ten seconds is closed."""
        if len(self._texts) >= MAX_WAITING_TEXTS:
            self.close(TRY_AGAIN)
            return
        self._texts.append(text)
        self._wake.set()

    def show(self, packed: PackedPicture) -> None:
        """Offer a picture: sent if the page wants it now, instead of one that waits."""
        now_s = time.monotonic()
        hz = self.want.picture_hz
        if hz and now_s - self._picture_s > 0.8 / hz:
            self._picture_s = now_s
            self._packed = packed
            self._wake.set()

    def close(self, code: int) -> None:
        """Close the connection with a code, after what is being sent."""
        self.closing = code
        self._wake.set()
        if code != POLICY and not self.line.is_read:  # it would not read the code either
            self.line.drop()

    async def send_all(self) -> None:
        """Send what is queued until it is to be closed; WebSocketDisconnect, TimeoutError where
        it cannot.
        """
        while self.closing is None:
            await self._wake.wait()
            self._wake.clear()
            while self._texts and self.closing is None:
                await self._send(self._texts.popleft())
            packed = self._packed
            self._packed = None
            if packed is not None and self.closing is None:
                await self._send(packed.truth_with_grid if self.want.grid else packed.truth)
                await self._send(packed.picture)

    async def _send(self, data: str | bytes) -> None:
        async with asyncio.timeout(SEND_S):
            await (
                self.socket.send_text(data)
                if isinstance(data, str)
                else self.socket.send_bytes(data)
            )

    async def listen(self) -> None:
        """Read the page's messages until it goes; nonsense or too many messages close it."""
        while True:
            message = await self.socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            now_s = time.monotonic()
            if len(self._wishes_s) == MAX_WISHES and now_s - self._wishes_s[0] < WISHES_S:
                self.close(POLICY)
                return
            self._wishes_s.append(now_s)
            try:
                self.want = msgspec.json.decode(message.get("text") or "", type=PageMessage).want
            except (msgspec.MsgspecError, ValueError, RecursionError):
                # not its JSON, no UTF-8, deeper than any
                self.close(POLICY)
                return
            self.asked = True


class OpenPages:
    """All pages that are open. A slow one loses pictures, then its connection.

    A new page always gets a place. Where all are taken, another gives way: first one that does not
    read, then one that has asked for nothing, then one that is no browser's, then the oldest of the
    address with the most pages.
    """

    def __init__(self) -> None:
        self._clients: dict[OpenPage, None] = {}

    def __len__(self) -> int:
        return len(self._clients)

    @property
    def picture_hz(self) -> float:
        """How often the one that wants pictures most often wants them; 0 where nobody does."""
        return max((client.want.picture_hz for client in self._clients), default=0.0)

    def tell(self, message: PageText) -> None:
        """Queue a message for all pages; the text is made once."""
        if self._clients:
            text = message.json()
            for client in self._clients:
                client.tell(text)

    def show(self, packed: PackedPicture) -> None:
        """Offer a picture to all pages."""
        for client in self._clients:
            client.show(packed)

    def make_room(self) -> None:
        """Close one page where all places are taken."""
        if len(self._clients) < MAX_CLIENTS:
            return
        by_address = Counter(client.address for client in self._clients)
        worth = {}
        for c in self._clients:
            worth[c] = (c.line.is_read, c.asked, c.is_page, -by_address[c.address])
        least = min(worth, key=worth.__getitem__)  # the first of equals is the oldest
        self._clients.pop(least)
        least.close(GIVES_WAY)

    async def follow(self, client: OpenPage) -> None:
        """Serve a page until it goes or is closed."""
        self._clients[client] = None
        tasks = [asyncio.create_task(client.listen()), asyncio.create_task(client.send_all())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._clients.pop(client, None)
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
            asyncio.get_running_loop().call_later(CLOSING_S, client.line.drop)
            if client.closing is not None and not any(
                isinstance(r, WebSocketDisconnect | TimeoutError) for r in results
            ):
                await _close(client)

    async def close_all(self, code: int) -> None:
        """Close all pages at the end of the run."""
        await asyncio.gather(
            *(_close(client, code) for client in list(self._clients)), return_exceptions=True
        )


async def _close(client: OpenPage, code: int | None = None) -> None:
    try:
        async with asyncio.timeout(1.0):
            await client.socket.close(code or client.closing or TRY_AGAIN)
    except (RuntimeError, TimeoutError, WebSocketDisconnect):
        pass  # it was gone
