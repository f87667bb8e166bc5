"""The operator's page from outside: requests as bytes on a socket, and a WebSocket without
hilstar.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import socket
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from wsproto import ConnectionType, WSConnection
from wsproto.events import (
    AcceptConnection,
    BytesMessage,
    CloseConnection,
    Ping,
    RejectConnection,
    Request,
    TextMessage,
)

from tests.support.servers import Served
from tests.support.waiting import PATIENCE_S, wait_for

ADDRESS = re.compile(r"the operator's page is at http://([^/\s]+):(\d+)/(?:#token=(\S+))?")


@dataclass(frozen=True)
class PageAddress:
    """Where a run said that its page is."""

    host: str
    port: int
    token: str

    def ask(
        self,
        path: str,
        method: str = "GET",
        body: bytes | str | None = None,
        headers: dict[str, str] | None = None,
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers (lower case) and body of the answer; with the token unless `headers`
        says otherwise.
        """
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        own = {"Authorization": f"Bearer {self.token}"} if self.token else {}
        try:
            connection.request(method, path, body, own | (headers or {}))
            answer = connection.getresponse()
            return (
                answer.status,
                {name.lower(): value for name, value in answer.getheaders()},
                answer.read(),
            )
        finally:
            connection.close()

    def json(self, path: str) -> Any:
        """The JSON at a path."""
        return json.loads(self.ask(path)[2])

    def control(self, name: str, who: str = "", **body: object) -> tuple[int, dict[str, str]]:
        """Order something of a run."""
        headers = {"Content-Type": "application/json"} | ({"X-Operator": who} if who else {})
        status, _, data = self.ask(f"/control/{name}", "POST", json.dumps(body), headers)
        return status, json.loads(data)

    def health_is(self, ok: bool) -> bool:
        """Whether the health is so, and its status fits."""
        status, _, data = self.ask("/health")
        found = json.loads(data)["ok"]
        assert status == (200 if found else 503)
        return found == ok


def page_of(served: Served) -> PageAddress:
    """The page of a run, once it answers."""
    found: list[re.Match[str]] = []

    def told() -> bool:
        found.extend(match for line in list(served.lines) if (match := ADDRESS.search(line)))
        return bool(found)

    wait_for(told, "the page's address")
    page = PageAddress(found[0][1], int(found[0][2]), found[0][3] or "")
    wait_for(lambda: _answers(page), "the page answers")
    return page


def _answers(page: PageAddress) -> bool:
    with contextlib.suppress(OSError, http.client.HTTPException):
        return page.ask("/health")[0] in {200, 401, 503}
    return False


def raw(port: int, data: bytes, seconds: float = PATIENCE_S) -> bytes:
    """What comes back for bytes until the other side closes, or is silent for so long."""
    with socket.create_connection(("127.0.0.1", port), timeout=seconds) as connection:
        connection.sendall(data)
        parts = []
        with contextlib.suppress(OSError):
            while part := connection.recv(65536):
                parts.append(part)
        return b"".join(parts)


class Live:
    """A WebSocket to `/live`."""

    def __init__(self, connection: socket.socket, protocol: WSConnection) -> None:
        self._connection, self._protocol = connection, protocol
        self._parts: list[bytes] = []

    def want(self, **want: object) -> None:
        """Say what is wanted."""
        self.say(json.dumps({"want": want}))

    def say(self, text: str) -> None:
        """Send a text."""
        self._connection.sendall(self._protocol.send(TextMessage(text)))

    def flood(self, frame: bytes, count: int) -> None:
        """Send the bytes of a frame so many times, and read nothing."""
        for _ in range(count // 100):
            self._connection.sendall(frame * 100)

    def messages(self) -> Iterator[dict[str, Any] | bytes]:
        """Texts as JSON, and pictures as bytes, until it is closed."""
        text, parts = "", b""
        while True:
            data = self._connection.recv(65536)
            self._protocol.receive_data(data or None)
            for event in self._protocol.events():
                match event:
                    case TextMessage():
                        text += event.data
                        if event.message_finished:
                            yield json.loads(text)
                            text = ""
                    case BytesMessage():
                        parts += bytes(event.data)
                        if event.message_finished:
                            yield parts
                            parts = b""
                    case Ping():
                        self._connection.sendall(self._protocol.send(event.response()))
                    case CloseConnection():
                        return
            if not data:
                return

    def await_message(self, holds: Callable[[Any], bool], patience_s: float = PATIENCE_S) -> Any:
        """The next message for which that holds."""
        deadline_s = time.monotonic() + patience_s
        for message in self.messages():
            if holds(message):
                return message
            assert time.monotonic() < deadline_s, "no such message"
        raise AssertionError("the WebSocket was closed")


@contextmanager
def live(
    page: PageAddress, headers: dict[str, str] | None = None, token: str | None = None
) -> Iterator[Live]:
    """A WebSocket to a page that lets it in. Raises ConnectionRefusedError with the status where
    it does not.
    """
    token = page.token if token is None else token
    with socket.create_connection(("127.0.0.1", page.port), timeout=PATIENCE_S) as connection:
        protocol = WSConnection(ConnectionType.CLIENT)
        names = ["hilstar", *([f"hilstar.token.{token}"] if token else [])]
        extra = [
            (name.encode(), value.encode())
            for name, value in (headers or {}).items()
            if name != "Host"
        ]
        host = (headers or {}).get("Host", f"127.0.0.1:{page.port}")
        request = Request(host=host, target="/live", subprotocols=names, extra_headers=extra)
        connection.sendall(protocol.send(request))
        while True:
            protocol.receive_data(connection.recv(4096) or None)
            for event in protocol.events():
                if isinstance(event, RejectConnection):
                    raise ConnectionRefusedError(event.status_code)
                if isinstance(event, AcceptConnection):
                    assert event.subprotocol == "hilstar"
                    yield Live(connection, protocol)
                    return


def picture_of(message: bytes) -> tuple[dict[str, Any], np.ndarray]:
    """Head and levels of a picture's message."""
    (length,) = struct.unpack_from("<I", message)
    head = json.loads(message[4 : 4 + length])
    data = message[4 + length :]
    levels = zlib.decompress(data) if head["deflate"] else data
    return head, np.frombuffer(levels, dtype=f"<{head['dtype']}").reshape(head["h"], head["w"])


def children(pid: int, words: str) -> list[int]:
    """The processes under another whose command line says that."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError, IndexError, ValueError):
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            line = (
                (stat.parent / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            )
            if parent == pid and words in line:
                found.append(int(stat.parent.name))
    return found


def gone(pid: int) -> bool:
    """Whether a process has ended."""
    with contextlib.suppress(OSError, IndexError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    return True
