"""The web application of the page: its addresses, the answer of each, and the checks of a request.
The protocol of the WebSocket is in docs/console.md.
"""

import asyncio
import contextlib
import hmac
import ipaddress
import time
import urllib.parse
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
from prometheus_client import CollectorRegistry
from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.openmetrics.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.registry import Collector
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket

from hilstar.basics.palette import palette_css
from hilstar.basics.wrong_sky import ENDS
from hilstar.server.answers.judge import VERDICTS, TrackerFigures
from hilstar.server.console.messages import Order, OrderAnswer, RunState, Setup
from hilstar.server.console.page_figures import metrics_of
from hilstar.server.console.protocol import (
    CONTROLS,
    SUBPROTOCOL,
    TOKEN_PROTOCOL,
    OrderBody,
    PageText,
    SkyMap,
)
from hilstar.server.console.server.connections import OpenPage, OpenPages
from hilstar.server.console.server.reader import RunReader

# The classes of metrics with a single value, by the kind in `page_figures`.
FAMILIES: dict[str, type[CounterMetricFamily | GaugeMetricFamily]] = {
    "counter": CounterMetricFamily,
    "gauge": GaugeMetricFamily,
}
# No name server resolves these, so that no other site can have one of them.
LOOPBACK = {"localhost", "127.0.0.1", "[::1]"}
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:;"
    " connect-src 'self'{sockets}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
TYPES = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
}
MAX_BODY_BYTES = 4_000
# A body that is too long is read up to here: its sender reads the refusal only after sending it.
MAX_DRAINED_BYTES = 64_000_000
BODY_S = 5.0
STATE_S = 0.5  # longest wait for a new state after an order; there are ten states a second
ORDERED_S = 30.0  # longest wait for an order: a ledger on a slow disk takes long
PAGE_FOLDER = Path(__file__).resolve().parents[1] / "page"


class Refused(Exception):
    """A request is refused, with an HTTP status and a line of text for the user."""

    def __init__(self, status: int, line: str) -> None:
        super().__init__(line)
        self.status = status
        self.line = line


class Guard:
    """Checks requests by their headers (with lower-case names).

    A page of another site can make a browser send requests here. With a name that it points at this
    machine (DNS rebinding) it can even read the answers. Therefore `Host` must be one of this
    page's names, and `Origin`, if there is one, the page itself.
    """

    def __init__(self, setup: Setup) -> None:
        self._hosts = set(setup.hosts)
        self._names = {name for name in setup.names if ":" in name} | {
            f"{name}{port}"
            for name in setup.names
            if ":" not in name
            for port in ("", ":443", ":80", f":{setup.port}")
        }
        self._any_address = setup.any_address
        self._port = setup.port
        self._token = setup.token

    def check_host(self, host: str) -> None:
        """Check the `Host` header. Raises Refused (421) for a name that is not the page's."""
        host = host.lower()
        if host not in self._names and not self._is_own(host):
            raise Refused(
                421,
                "this page is not served under that name; open it as hilstar printed it, or give"
                " --console-name",
            )

    def _is_own(self, host: str) -> bool:
        name, port = _split(host)
        # With any port: a tunnel, such as ssh -L, has a port of its own.
        if name in LOOPBACK and (port.isdecimal() or not port):
            return True
        if port not in {"", str(self._port)} or (not port and self._port != 80):
            return False
        if name in self._hosts:
            return True
        with contextlib.suppress(ValueError):
            return self._any_address and bool(ipaddress.ip_address(name.strip("[]")))
        return False

    def check_origin(self, headers: Mapping[str, str]) -> None:
        """Check where a request comes from. Raises Refused (403) for one that another site's page
        made.
        """
        origin = headers.get("origin")
        host = headers.get("host", "").lower()
        if origin is not None and origin.lower() not in {f"http://{host}", f"https://{host}"}:
            raise Refused(403, "another site's page may not ask here")
        if (
            headers.get("sec-fetch-site", "none") in {"cross-site", "same-site"}
            and headers.get("sec-fetch-mode") != "navigate"
        ):
            raise Refused(403, "another site's page may not ask here")

    def check_token(self, headers: Mapping[str, str], protocols: Iterable[str] = ()) -> None:
        """Check the token in the `Authorization` header or in a WebSocket's subprotocols. Raises
        Refused (401) without the right one.
        """
        if not self._token:
            return
        scheme, _, given = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            tokens = [given.strip()]
        else:
            tokens = []
        tokens += [
            name.removeprefix(TOKEN_PROTOCOL)
            for name in protocols
            if name.startswith(TOKEN_PROTOCOL)
        ]
        wanted = self._token.encode()
        # All are compared, in constant time: the time of the answer must not reveal the token.
        matches = [hmac.compare_digest(token.encode(), wanted) for token in tokens]
        if True not in matches:
            raise Refused(
                401,
                "the token is missing or wrong: open the address that hilstar printed, or send"
                " Authorization: Bearer",
            )


def _split(host: str) -> tuple[str, str]:
    """The name and the port of a `Host` header, "" without a port. A malformed port is "x", which
    no check accepts.
    """
    if host.startswith("["):
        name, _, rest = host.partition("]")
        return name + "]", rest[1:] if rest.startswith(":") else ("x" if rest else "")
    name, colon, port = host.partition(":")
    return name, port if port or not colon else "x"


class RunCollector(Collector):
    """Makes the metrics of a run when `GET /metrics` asks for them. `clients` is the number of open
    pages.
    """

    def __init__(self, reader: RunReader) -> None:
        self._reader = reader
        self.clients = 0
        self._registry = CollectorRegistry()
        self._registry.register(self)

    def text(self) -> bytes:
        """The answer of `GET /metrics`, in the OpenMetrics text format."""
        return bytes(generate_latest(self._registry))  # type: ignore[no-untyped-call]

    def collect(self) -> Iterator[Metric]:
        """The metrics with their present values."""
        hello = self._reader.setup.hello
        state = self._reader.seen or RunState(host_ns=0)
        health = self._reader.health
        ledger = state.ledger
        pacing = self._reader.pacing
        info = {
            key: str(getattr(hello, key)) for key in ("version", "command", "bench", "renderer")
        }
        yield InfoMetricFamily("hilstar_run", "What runs.", value=info)
        for metric, value in metrics_of(self._reader.state()):
            yield FAMILIES[metric.kind](f"hilstar_{metric.name}", metric.help, value=value)
        refused = CounterMetricFamily(
            "hilstar_packets_refused", "Attitude packets refused.", labels=["reason"]
        )
        for reason, count in state.counts.refused.items():
            refused.add_metric([reason], count)
        yield refused
        wrong = GaugeMetricFamily(
            "hilstar_wrong_sky", "1 while the sky shown is wrong, by kind.", labels=["kind"]
        )
        lasting = {condition.kind for condition in state.wrong_sky}
        for kind in ENDS:
            wrong.add_metric([kind], float(kind in lasting))
        yield wrong
        tracker = state.tracker
        if tracker is not None:
            yield from tracker_metrics(tracker)
        gauges: list[tuple[str, str, float]] = [
            ("healthy", "1 while the sky is right, as GET /health has it.", health.ok),
            ("health_since_timestamp_seconds", "Since when that is so.", health.since_s),
            ("attitude_missing", "1 until an attitude has come.", state.frame.missing),
            ("attitude_stale", "1 while the attitude is stale.", state.frame.stale),
            ("display_lost", "1 where the display has gone.", bool(state.display_lost)),
            (
                "operator_override",
                "1 while an operator changes the sky.",
                bool(state.operator_text),
            ),
            ("console_clients", "Pages that are open.", self.clients),
        ]
        if ledger is not None:
            gauges.append(("ledger_failing", "1 while it cannot be written.", bool(ledger.failing)))
        for name, help_text, gauged in gauges:
            yield GaugeMetricFamily(f"hilstar_{name}", help_text, value=float(gauged))
        if pacing is not None:
            help_text = "Between frames, over the last minute."
            intervals = GaugeMetricFamily(
                "hilstar_frame_interval_seconds", help_text, labels=["quantile"]
            )
            for quantile, interval_ms in (("0.5", pacing.p50_ms), ("0.99", pacing.p99_ms)):
                intervals.add_metric([quantile], interval_ms * 1e-3)
            yield intervals


def tracker_metrics(found: TrackerFigures) -> Iterator[Metric]:
    """The metrics of a tracker's answers: counts by verdict and refusal, residuals, arcsec, and
    whether the tracker is silent or its line has a fault.
    """
    answers = CounterMetricFamily(
        "hilstar_tracker_answers", "Answers of the tracker, by verdict.", labels=["verdict"]
    )
    for verdict in VERDICTS:
        answers.add_metric([verdict], getattr(found, verdict))
    yield answers
    refused = CounterMetricFamily(
        "hilstar_tracker_refused", "What was no answer, by reason.", labels=["reason"]
    )
    for reason, count in found.refused.items():
        refused.add_metric([reason], count)
    yield refused
    for name, help_text, values in (
        ("residual", "Of the newest answer.", found.residual_arcsec),
        ("residual_rms", "Of the last minute's right answers.", found.rms_arcsec),
        ("residual_sigma3", "Three standard deviations of them.", found.sigma3_arcsec),
    ):
        if values is not None:
            gauge = GaugeMetricFamily(f"hilstar_tracker_{name}_arcsec", help_text, labels=["axis"])
            for axis, value in zip("xyz", values, strict=True):
                gauge.add_metric([axis], value)
            yield gauge
    for name, help_text, trouble in (
        ("silent", "1 while the tracker does not answer.", found.silent),
        ("trouble", "1 while something is wrong with the tracker's line.", found.trouble),
    ):
        yield GaugeMetricFamily(f"hilstar_tracker_{name}", help_text, value=float(bool(trouble)))


Give = Callable[[Order], Awaitable[OrderAnswer]]


class Page:
    """The handlers of the page's addresses. `sky` is the map of the sky, `give` sends an order to
    the run.
    """

    def __init__(
        self, setup: Setup, reader: RunReader, pages: OpenPages, sky: SkyMap | None, give: Give
    ) -> None:
        self.setup = setup
        self.reader = reader
        self.pages = pages
        self.give = give
        self.guard = Guard(setup)
        self.metrics = RunCollector(reader)
        self._sky = b"{}" if sky is None else msgspec.json.encode(sky)
        self._files = {
            path.name: path.read_bytes() for path in PAGE_FOLDER.iterdir() if path.suffix in TYPES
        }
        self._files["palette.css"] = palette_css().encode()

    def app(self) -> ASGIApp:
        """The ASGI application, which checks each request before it is handled."""
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
        health = self.reader.health_now()
        return Response(
            msgspec.json.encode(health), 200 if health.ok else 503, media_type="application/json"
        )

    async def _metrics(self, _: Request) -> Response:
        self.metrics.clients = len(self.pages)
        return Response(self.metrics.text(), headers={"Content-Type": CONTENT_TYPE_LATEST})

    async def _state(self, _: Request) -> Response:
        return Response(
            PageText(hello=self.setup.hello, state=self.reader.state()).json(),
            media_type="application/json",
        )

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
        if not self.setup.hello.control:
            return _refusal(403, "read-only: start hilstar with --control to act from here")
        try:
            body = msgspec.json.decode(data or b"{}", type=OrderBody)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            return _refusal(400, f"not the JSON of a control: {error}")
        # The record of the order names the operator by the page's header, and by the address unless
        # that is this machine.
        who = urllib.parse.unquote(
            request.headers.get("x-operator", "")[:400], errors="replace"
        ).strip()
        address = request.client.host if request.client else ""
        who = (who or "somebody at the page") + (
            "" if address in {"127.0.0.1", "::1", ""} else f" ({address})"
        )
        order = Order(
            id=0, name=name, who=who, on=body.on, level=body.level, text=body.text, fault=body.name
        )
        answer = await self.give(order)
        done_ns = time.monotonic_ns()
        # The answer waits for a state after the order, so that the next request sees its effect.
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STATE_S):
                while self.reader.seen is not None and self.reader.seen.host_ns <= done_ns:
                    await asyncio.sleep(0.02)
        key = "line" if answer.status < 400 else "error"
        return JSONResponse({key: answer.line}, answer.status)

    async def _live(self, socket: WebSocket) -> None:
        self.pages.make_room()
        await socket.accept(SUBPROTOCOL if SUBPROTOCOL in socket.scope["subprotocols"] else None)
        client = OpenPage(socket)
        client.tell(
            PageText(
                hello=self.setup.hello, state=self.reader.state(), history=list(self.reader.points)
            ).json()
        )
        # Fewer than MAX_WAITING_TEXTS, at which a page would be closed.
        for event in list(self.reader.events)[-90:]:
            client.tell(PageText(event=event).json())
        await self.pages.follow(client)


async def _body(request: Request) -> bytes:
    """The body of a request. Raises Refused if it is too long (413), late (408) or cut (400)."""
    # A client that expects "100 Continue" has not sent its body yet: it is refused before it does.
    if (
        int(request.headers.get("content-length", "0")) > MAX_BODY_BYTES
        and "expect" in request.headers
    ):
        raise Refused(413, f"a control has at most {MAX_BODY_BYTES} bytes")
    data = b""
    size_bytes = 0
    try:
        async with asyncio.timeout(BODY_S):
            async for chunk in request.stream():
                size_bytes += len(chunk)
                if size_bytes <= MAX_BODY_BYTES:
                    data += chunk
                elif size_bytes > MAX_DRAINED_BYTES:
                    break
    except TimeoutError:
        raise Refused(
            408 if size_bytes <= MAX_BODY_BYTES else 413, "the body did not come in time"
        ) from None
    except ClientDisconnect:
        raise Refused(400, "the body did not come") from None
    if size_bytes > MAX_BODY_BYTES:
        raise Refused(413, f"a control has at most {MAX_BODY_BYTES} bytes")
    return data


def _refused(_: Request, error: Exception) -> Response:
    if isinstance(error, Refused):
        return _refusal(error.status, error.line)
    return _refusal(500, "")


def _refusal(status: int, line: str) -> JSONResponse:
    if status == 401:
        headers = {"WWW-Authenticate": "Bearer"}
    elif status in {408, 413}:
        headers = {"Connection": "close"}
    else:
        headers = None
    return JSONResponse({"error": line}, status, headers)


class Guarded:
    """An ASGI application that checks every request by `guard` before `app` handles it, and adds
    the security headers to every answer.
    """

    def __init__(self, app: ASGIApp, guard: Guard) -> None:
        self._app = app
        self._guard = guard

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
            # The page's files contain no secret and need no token: the page reads it from its URL.
            if scope["type"] == "websocket" or not (
                scope["path"] == "/" or scope["path"].startswith("/static/")
            ):
                self._guard.check_token(headers, scope.get("subprotocols", ()))
            await self._app(scope, receive, _with_headers(send, host))
        except Refused as refused:
            answer = _refusal(refused.status, refused.line)
            send = _with_headers(send, host)
            if scope["type"] == "websocket":
                await WebSocket(scope, receive, send).send_denial_response(answer)
            else:
                with contextlib.suppress(RuntimeError):
                    await answer(scope, receive, send)


def _with_headers(send: Send, host: str) -> Send:
    """A `send` that adds the headers of every answer. `host` is the name in the request, to which
    the page may open WebSockets, or "" in a refused one.
    """
    sockets = f" ws://{host} wss://{host}" if host else ""
    headers = HEADERS | {"Content-Security-Policy": POLICY.format(sockets=sockets)}
    extra = [(name.lower().encode(), value.encode("latin-1")) for name, value in headers.items()]

    async def sending(message: Any) -> None:
        if message["type"] in {"http.response.start", "websocket.http.response.start"}:
            message = message | {"headers": [*message.get("headers", ()), *extra]}
        await send(message)

    return sending
