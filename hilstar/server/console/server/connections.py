"""The connections of pages: HTTP and WebSockets with limits of time and memory. Every open page
gets messages at its own speed.
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

HEAD_S = 5.0  # time limit of a request's head
WHOLE_S = 20.0  # time limit of its body, and of the reading of its answer
# HTTP connections at a time. Above it one is dropped: first one whose answer is sent, then the
# oldest.
MAX_CONNECTIONS = 100
PING_S, PONG_S = 2.0, 20.0  # interval of a WebSocket's pings, and the time limit of a pong
UNREAD_S = 4.0  # a peer without a pong for this long counts as one that does not read
MAX_UNSENT_BYTES = 65_536  # unsent bytes that the kernel stores for a peer
MAX_PONGS_BYTES = 200_000  # waiting bytes at which a peer that sends pings is dropped
LINE = "hilstar.line"  # the key of the `ReadingWebSocket` in a WebSocket's scope

_connections: "OrderedDict[BoundedHttp, None]" = OrderedDict()
MAX_CLIENTS = 32
MAX_WAITING_TEXTS = 100  # ten seconds of states
SEND_S = 10.0  # time limit of sending one message
CLOSING_S = 5.0  # a page that is closed has this time to read the close code
MAX_WISHES = 40  # messages of a page in WISHES_S
WISHES_S = 2.0
TRY_AGAIN, POLICY = 1013, 1008  # close codes of RFC 6455 and its registry


class BoundedHttp(H11Protocol):
    """An HTTP connection with limits of time. It is closed if the peer sends nothing, sends too
    slowly, or does not read the answer.

    uvicorn limits the size of a request, but neither its time nor the bytes that wait for a peer
    that does not read.
    """

    _limit: asyncio.TimerHandle | None = None
    _timed_cycle: Any = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time limit of the request's head; drop a connection if there are over
        MAX_CONNECTIONS.
        """
        super().connection_made(transport)
        _connections[self] = None
        if len(_connections) > MAX_CONNECTIONS:
            next(iter(_connections))._drop()
        self._within(HEAD_S)

    def data_received(self, data: bytes) -> None:
        """Take received bytes. When the head is complete, the time limit of the rest begins."""
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
        """End the time limit. From now on this connection is the first to be dropped for others."""
        self._end_time()
        if self in _connections:
            _connections.move_to_end(self, last=False)
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: Request) -> None:
        """End the limits of HTTP: a WebSocket has its own."""
        self._end_time()
        _connections.pop(self, None)
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the closed connection from the list."""
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
    """A WebSocket whose peer must read: it has to answer pings, and the bytes that wait for it are
    limited.
    """

    _heard_s: float | None = None  # the monotonic time of its last pong

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Limit the unsent bytes in the kernel, or a slow peer would get old data."""
        super().connection_made(transport)
        own_socket = transport.get_extra_info("socket")
        if own_socket is not None:
            own_socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, MAX_UNSENT_BYTES)

    def handle_connect(self, event: events.Request) -> None:
        """Add this object to the scope, so that the application can drop the connection."""
        super().handle_connect(event)
        cast(dict[str, object], self.scope["extensions"])[LINE] = self

    @property
    def is_read(self) -> bool:
        """Whether the peer has answered a ping in the last UNREAD_S: it reads what is sent."""
        return self._heard_s is not None and time.monotonic() - self._heard_s < UNREAD_S

    def start_keepalive(self) -> None:
        """Send the first ping at once, without waiting for PING_S."""
        self.send_keepalive_ping()

    def handle_pong(self, event: events.Pong) -> None:
        """Note the time of the pong: the peer has read all that was sent before its ping."""
        if bytes(event.payload) == self.pending_ping_payload:
            self._heard_s = time.monotonic()
        super().handle_pong(event)

    def handle_ping(self, event: events.Ping) -> None:
        """Answer a ping; drop a peer that sends pings but does not read the answers."""
        if self.transport.get_write_buffer_size() > MAX_PONGS_BYTES:
            self.drop()
        else:
            super().handle_ping(event)

    def keepalive_timeout(self) -> None:
        """Drop a peer that has not answered a ping within PONG_S."""
        self.drop()

    def drop(self) -> None:
        """Close the connection at once; unsent bytes are lost."""
        self.transport.abort()


class OpenPage:
    """An open page: the messages that wait for it, and its requests (`want`)."""

    def __init__(self, socket: WebSocket) -> None:
        self.socket = socket
        self.line: ReadingWebSocket = socket.scope["extensions"][LINE]
        self.address = "" if socket.client is None else socket.client.host
        self.want = PageWants()
        self.asked = False  # whether it has sent a request; the real page does so at once
        self.is_page = "origin" in socket.headers
        self.closing: int | None = None
        self._texts: deque[str] = deque()
        self._packed: PackedPicture | None = None
        self._picture_s = 0.0
        self._wake = asyncio.Event()
        self._wishes_s: deque[float] = deque(maxlen=MAX_WISHES)

    def tell(self, text: str) -> None:
        """Queue a text. A page with MAX_WAITING_TEXTS, ten seconds of states, is closed."""
        if len(self._texts) >= MAX_WAITING_TEXTS:
            self.close(TRY_AGAIN)
            return
        self._texts.append(text)
        self._wake.set()

    def show(self, packed: PackedPicture) -> None:
        """Offer a picture. It is sent if the page's rate of pictures allows, in place of a picture
        that still waits.
        """
        now_s = time.monotonic()
        hz = self.want.picture_hz
        if hz and now_s - self._picture_s > 0.8 / hz:
            self._picture_s = now_s
            self._packed = packed
            self._wake.set()

    def close(self, code: int) -> None:
        """Close the connection with a close code, after the message that is being sent."""
        self.closing = code
        self._wake.set()
        # A peer that does not read would not read the close code either.
        if code != POLICY and not self.line.is_read:
            self.line.drop()

    async def send_all(self) -> None:
        """Send the queued messages until `close` is called. Raises WebSocketDisconnect if the page
        has gone, TimeoutError if a message takes over SEND_S.
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
        """Read the page's messages until it disconnects. A message that is not its JSON, or over
        MAX_WISHES of them in WISHES_S, close it.
        """
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
                # Not the JSON of a page, not UTF-8, or nested too deeply.
                self.close(POLICY)
                return
            self.asked = True


class OpenPages:
    """All open pages. A slow page loses pictures first, then its connection.

    A new page always gets a place. If all MAX_CLIENTS are taken, another page is closed: first one
    that does not read, then one that has requested nothing, then one that is no browser's, then the
    oldest page of the address with the most pages.
    """

    def __init__(self) -> None:
        self._clients: dict[OpenPage, None] = {}

    def __len__(self) -> int:
        return len(self._clients)

    @property
    def picture_hz(self) -> float:
        """The highest rate of pictures that any page requests, Hz; 0 if none does."""
        return max((client.want.picture_hz for client in self._clients), default=0.0)

    def tell(self, message: PageText) -> None:
        """Queue a message for all pages; it is encoded once."""
        if self._clients:
            text = message.json()
            for client in self._clients:
                client.tell(text)

    def show(self, packed: PackedPicture) -> None:
        """Offer a picture to all pages."""
        for client in self._clients:
            client.show(packed)

    def make_room(self) -> None:
        """Close a page if all places are taken, so that a new one can come."""
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
        """Serve a page until it disconnects or is closed."""
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
        """Close all pages with a close code, at the end of the run."""
        await asyncio.gather(
            *(_close(client, code) for client in list(self._clients)), return_exceptions=True
        )


async def _close(client: OpenPage, code: int | None = None) -> None:
    try:
        async with asyncio.timeout(1.0):
            await client.socket.close(code or client.closing or TRY_AGAIN)
    except (RuntimeError, TimeoutError, WebSocketDisconnect):
        pass  # the page has gone already
