"""The page's addresses. What each answers, and what a page and its server say to each other, is in `docs/console-server.md`."""

from __future__ import annotations

import asyncio
import contextlib
import time
import urllib.parse
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket

from hilstar.console.feed.messages import CONTROLS, PATCH_SHARE, Answer, Order, Setup
from hilstar.console.server.guard import Guard, Refused, headers_of
from hilstar.console.server.live import Client, Crowd, told
from hilstar.console.server.metrics import CONTENT_TYPE, Metrics
from hilstar.console.server.reader import Reader

PAGE_FOLDER = Path(__file__).resolve().parents[1] / "page"
TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
MAX_BODY_BYTES = 4_000
MAX_DRAINED_BYTES = 64_000_000  # of a body that is too long, so that its sender comes to read why
BODY_S = 5.0
OPEN_PATHS = ("/", "/static/")  # the page itself has no secret; it brings the token that its address has
STATE_S = 0.5  # for a state of after an order; there are ten a second
ORDERED_S = 30.0  # a ledger on a slow disk

Give = Callable[[Order], Awaitable[Answer]]


class OrderBody(msgspec.Struct, forbid_unknown_fields=True):
    """The body of `POST /control/NAME`; a key that is misspelt must not act as if it had not been there."""

    on: bool = True
    level: float = PATCH_SHARE
    text: str = ""
    name: str = ""


class Page:
    """What the addresses have to hand."""

    def __init__(self, setup: Setup, reader: Reader, crowd: Crowd, sky: dict[str, Any], give: Give) -> None:
        self.setup, self.reader, self.crowd, self.give = setup, reader, crowd, give
        self.guard, self.metrics = Guard(setup), Metrics(reader)
        self._sky = told(sky)
        self._files = {path.name: path.read_bytes() for path in PAGE_FOLDER.iterdir() if path.suffix in TYPES}

    def app(self) -> ASGIApp:
        """The application, with its guard before it."""
        routes = [
            Route("/", self._index),
            Route("/static/{name}", self._static),
            Route("/health", self._health),
            Route("/metrics", self._metrics),
            Route("/state", self._state),
            Route("/sky", self._sky_map),
            Route("/control/{name}", self._control, methods=["POST"]),
            WebSocketRoute("/live", self._live),
        ]
        return Guarded(Starlette(routes=routes, exception_handlers={Refused: _refused}), self.guard)

    async def _index(self, _: Request) -> Response:
        return Response(self._files["index.html"], media_type="text/html")

    async def _static(self, request: Request) -> Response:
        name = request.path_params["name"]
        data = self._files.get(name)
        if data is None or name.endswith(".html"):
            return _refusal(404, "no such file")
        return Response(data, media_type=TYPES[Path(name).suffix])

    async def _health(self, _: Request) -> Response:
        found = self.reader.health_now()
        return JSONResponse(found, 200 if found["ok"] else 503)

    async def _metrics(self, _: Request) -> Response:
        self.metrics.collector.clients = len(self.crowd)
        return Response(self.metrics.text(), headers={"Content-Type": CONTENT_TYPE})

    async def _state(self, _: Request) -> Response:
        return Response(told({"hello": self.reader.hello(), "state": self.reader.state()}), media_type="application/json")

    async def _sky_map(self, _: Request) -> Response:
        return Response(self._sky, media_type="application/json")

    async def _control(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in CONTROLS:
            return _refusal(404, f"no control of that name; there are {', '.join(CONTROLS)}")
        kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        if kind != "application/json":
            return _refusal(415, "send JSON, with Content-Type: application/json")
        data = await _body(request)
        if not self.setup.control:
            return _refusal(403, "read-only: start hilstar with --control to act from here")
        try:
            body = msgspec.json.decode(data or b"{}", type=OrderBody)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            return _refusal(400, f"not the JSON of a control: {error}")
        answer = await self.give(
            Order(id=0, name=name, who=_who(request), on=body.on, level=body.level, text=body.text, fault=body.name)
        )
        await self._state_after(time.monotonic_ns())
        key = "line" if answer.status < 400 else "error"
        return JSONResponse({key: answer.line}, answer.status)

    async def _state_after(self, host_ns: int) -> None:
        """Wait until the state is one of after a moment: who asks for it next sees what an order has changed."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STATE_S):
                while self.reader.seen is not None and self.reader.seen.host_ns <= host_ns:
                    await asyncio.sleep(0.02)

    async def _live(self, socket: WebSocket) -> None:
        self.crowd.make_room()
        await socket.accept("hilstar" if "hilstar" in socket.scope["subprotocols"] else None)
        client = Client(socket)
        client.tell(told({"hello": self.reader.hello(), "state": self.reader.state(), "history": list(self.reader.points)}))
        for event in list(self.reader.events)[-90:]:
            client.tell(told({"event": event}))
        await self.crowd.follow(client)


async def _body(request: Request) -> bytes:
    """The body. Raises Refused (413, 408): what is too long is read, and thrown away, up to a bound."""
    if int(request.headers.get("content-length", "0")) > MAX_BODY_BYTES and "expect" in request.headers:
        raise Refused(413, f"a control has at most {MAX_BODY_BYTES} bytes")
    data, seen = b"", 0
    try:
        async with asyncio.timeout(BODY_S):
            async for chunk in request.stream():
                seen += len(chunk)
                if seen <= MAX_BODY_BYTES:
                    data += chunk
                elif seen > MAX_DRAINED_BYTES:
                    break
    except TimeoutError:
        raise Refused(408 if seen <= MAX_BODY_BYTES else 413, "the body did not come in time") from None
    except ClientDisconnect:
        raise Refused(400, "the body did not come") from None
    if seen > MAX_BODY_BYTES:
        raise Refused(413, f"a control has at most {MAX_BODY_BYTES} bytes")
    return data


def _refused(_: Request, error: Exception) -> Response:
    return _refusal(error.status, error.line) if isinstance(error, Refused) else _refusal(500, "")


def _who(request: Request) -> str:
    """Who asks, as the page says, and from where unless that is this machine."""
    name = urllib.parse.unquote(request.headers.get("x-operator", "")[:400], errors="replace").strip()
    address = request.client.host if request.client else ""
    place = "" if address in {"127.0.0.1", "::1", ""} else f" ({address})"
    return (name or "somebody at the page") + place


def _refusal(status: int, line: str) -> JSONResponse:
    headers = {"WWW-Authenticate": "Bearer"} if status == 401 else {"Connection": "close"} if status in {408, 413} else None
    return JSONResponse({"error": line}, status, headers)


class Guarded:
    """The application behind its guard: every request is judged first, and every answer has the same headers."""

    def __init__(self, app: ASGIApp, guard: Guard) -> None:
        self._app, self._guard = app, guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        host = ""
        try:
            self._guard.check_host(headers.get("host", ""))
            host = headers["host"]
            self._guard.check_origin(headers)
            if scope["type"] == "websocket" or not _is_open(scope["path"]):
                self._guard.check_token(headers, scope.get("subprotocols", ()))
            await self._app(scope, receive, _with_headers(send, host))
        except Refused as refused:
            await _refuse(refused, scope, receive, _with_headers(send, host))


def _is_open(path: str) -> bool:
    return path == OPEN_PATHS[0] or path.startswith(OPEN_PATHS[1])


async def _refuse(refused: Refused, scope: Scope, receive: Receive, send: Send) -> None:
    answer = _refusal(refused.status, refused.line)
    if scope["type"] == "websocket":
        await WebSocket(scope, receive, send).send_denial_response(answer)
    else:
        with contextlib.suppress(RuntimeError):
            await answer(scope, receive, send)


def _with_headers(send: Send, host: str) -> Send:
    extra = [(name.lower().encode(), value.encode("latin-1")) for name, value in headers_of(host).items()]

    async def sending(message: Any) -> None:
        if message["type"] in {"http.response.start", "websocket.http.response.start"}:
            message = message | {"headers": [*message.get("headers", ()), *extra]}
        await send(message)

    return sending
