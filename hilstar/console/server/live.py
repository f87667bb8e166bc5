"""Who follows the run: pages on WebSockets, each told at its own speed; a slow one loses pictures, then its connection.

A page that comes always has a place. Where all are taken one gives way: one that does not read, before one that has
asked for nothing, before one that is no browser's, before one of those with the most pages from one address, the oldest.
"""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections import Counter, deque
from typing import Annotated, Any

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from hilstar.console.server.pictures import Packed
from hilstar.console.server.protocol import LINE, ReadingWebSocket

MAX_CLIENTS = 32
MAX_WAITING_TEXTS = 100  # ten seconds
SEND_S = 10.0
CLOSING_S = 5.0  # for a close to be read
MAX_WISHES = 40  # in WISHES_S
WISHES_S = 2.0
MIN_HZ, MAX_HZ = 0.1, 10.0
TRY_AGAIN, POLICY = 1013, 1008  # close codes of RFC 6455 and its registry
GIVES_WAY = 4013  # of our own: the page does not come back at once, or it would take the place of the next


class Want(msgspec.Struct):
    """What a page wants besides the state."""

    picture: bool = False
    hz: Annotated[float, msgspec.Meta(gt=0)] = 8.0
    grid: bool = False

    @property
    def picture_hz(self) -> float:
        """How often it wants pictures, within bounds; 0 for never."""
        return min(max(self.hz, MIN_HZ), MAX_HZ) if self.picture else 0.0


class Wish(msgspec.Struct):
    """A page's message."""

    want: Want


def wish_of(text: str) -> Want | None:
    """What a page's message wants; None for nonsense."""
    try:
        return msgspec.json.decode(text, type=Wish).want
    except (msgspec.MsgspecError, ValueError, RecursionError):  # not its JSON, no UTF-8, deeper than any
        return None


class Client:
    """One page."""

    def __init__(self, socket: WebSocket) -> None:
        self.socket = socket
        self._line: ReadingWebSocket = socket.scope["extensions"][LINE]
        self.address = "" if socket.client is None else socket.client.host
        self.want = Want()
        self.asked = False  # has said what it wants, as the page does at once
        self.is_page = "origin" in socket.headers
        self.closing: int | None = None
        self._texts: deque[str] = deque()
        self._packed: Packed | None = None
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

    def show(self, packed: Packed) -> None:
        """Offer a picture: sent if the page wants it now, instead of one that waits."""
        now_s = time.monotonic()
        hz = self.want.picture_hz
        if hz and now_s - self._picture_s > 0.8 / hz:
            self._picture_s, self._packed = now_s, packed
            self._wake.set()

    def close(self, code: int) -> None:
        """Have the connection closed."""
        self.closing = code
        self._wake.set()
        if code != POLICY and not self.is_read:  # it would not take the code either
            self.drop()

    def drop(self) -> None:
        """End the connection now, whatever waits to be sent."""
        self._line.drop()

    @property
    def is_read(self) -> bool:
        """Whether it has lately shown that it reads what it is sent."""
        return self._line.is_read

    async def send_all(self) -> None:
        """Send what is queued until it is to be closed; WebSocketDisconnect, TimeoutError where it cannot."""
        while self.closing is None:
            await self._wake.wait()
            self._wake.clear()
            while self._texts and self.closing is None:
                await self._send(self._texts.popleft())
            packed, self._packed = self._packed, None
            if packed is not None and self.closing is None:
                await self._send((packed.truth_with_grid if self.want.grid else packed.truth).decode())
                await self._send(packed.picture)

    async def _send(self, data: str | bytes) -> None:
        async with asyncio.timeout(SEND_S):
            await (self.socket.send_text(data) if isinstance(data, str) else self.socket.send_bytes(data))

    async def listen(self) -> None:
        """Take what the page says until it goes; nonsense, or too much of it, closes it."""
        while True:
            message = await self.socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            now_s = time.monotonic()
            if len(self._wishes_s) == MAX_WISHES and now_s - self._wishes_s[0] < WISHES_S:
                self.close(POLICY)
                return
            self._wishes_s.append(now_s)
            want = wish_of(message.get("text") or "")
            if want is None:
                self.close(POLICY)
                return
            self.want, self.asked = want, True


class Crowd:
    """All pages that are open."""

    def __init__(self) -> None:
        self._clients: dict[Client, None] = {}

    def __len__(self) -> int:
        return len(self._clients)

    @property
    def picture_hz(self) -> float:
        """How often the one that wants pictures most often wants them; 0 where nobody does."""
        return max((client.want.picture_hz for client in self._clients), default=0.0)

    def tell(self, message: dict[str, Any]) -> None:
        """Tell all of them; the text is made once."""
        if self._clients:
            text = told(message)
            for client in self._clients:
                client.tell(text)

    def show(self, packed: Packed) -> None:
        """Offer all of them a picture."""
        for client in self._clients:
            client.show(packed)

    def make_room(self) -> None:
        """Have one give way where all places are taken."""
        if len(self._clients) < MAX_CLIENTS:
            return
        pages = Counter(client.address for client in self._clients)
        worth = {c: (c.is_read, c.asked, c.is_page, -pages[c.address]) for c in self._clients}
        least = min(worth, key=worth.__getitem__)  # of equals the first, which is the oldest
        self._clients.pop(least)
        least.close(GIVES_WAY)

    async def follow(self, client: Client) -> None:
        """Serve a page until it goes, or has to."""
        self._clients[client] = None
        tasks = [asyncio.create_task(client.listen()), asyncio.create_task(client.send_all())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._clients.pop(client, None)
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
            asyncio.get_running_loop().call_later(CLOSING_S, client.drop)
            if client.closing is not None and not any(isinstance(r, WebSocketDisconnect | TimeoutError) for r in results):
                await _close(client)

    async def close_all(self, code: int) -> None:
        """Close all of them: the run ends."""
        await asyncio.gather(*(_close(client, code) for client in list(self._clients)), return_exceptions=True)


async def _close(client: Client, code: int | None = None) -> None:
    try:
        async with asyncio.timeout(1.0):
            await client.socket.close(code or client.closing or TRY_AGAIN)
    except (RuntimeError, TimeoutError, WebSocketDisconnect):
        pass  # it was gone


def told(message: dict[str, Any]) -> str:
    """A message as JSON text; a number that JSON does not know is null."""
    try:
        return _text(message)
    except ValueError:
        return _text(_known(message))


def _text(message: Any) -> str:
    return json.dumps(message, ensure_ascii=False, separators=(",", ":"), allow_nan=False)


def _known(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _known(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_known(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
