"""Who may ask, and how: the page's name, its origin, the token; and the headers of every answer.

A page of another site can make a browser send requests here, and by a name that it points at this machine (DNS rebinding)
even read the answers. So the name in `Host` has to be one of this page's, and an `Origin` that of the page itself.
"""

from __future__ import annotations

import contextlib
import hmac
import ipaddress
from collections.abc import Iterable, Mapping

from hilstar.console.feed.messages import Setup

LOOPBACK = {"localhost", "127.0.0.1", "[::1]"}  # no name server says where they are
TOKEN_PROTOCOL = "hilstar.token."
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
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'{sockets}; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Refused(Exception):
    """A request that is not answered: HTTP status and a line."""

    def __init__(self, status: int, line: str) -> None:
        super().__init__(line)
        self.status, self.line = status, line


class Guard:
    """Judges requests by their headers (lower-case names)."""

    def __init__(self, setup: Setup) -> None:
        self._hosts = set(setup.hosts)
        self._names = {name for name in setup.names if ":" in name} | {
            f"{name}{port}" for name in setup.names if ":" not in name for port in ("", ":443", ":80", f":{setup.port}")
        }
        self._any_address, self._port, self._token = setup.any_address, setup.port, setup.token

    @property
    def has_token(self) -> bool:
        """Whether a token is needed."""
        return bool(self._token)

    def check_host(self, host: str) -> None:
        """Raises Refused (421) for a name that is not the page's."""
        host = host.lower()
        if host not in self._names and not self._is_own(host):
            raise Refused(421, "this page is not served under that name; open it as hilstar printed it, or give --console-name")

    def _is_own(self, host: str) -> bool:
        name, port = _split(host)
        if name in LOOPBACK and (port.isdecimal() or not port):  # by any port: that of a tunnel, such as ssh -L
            return True
        if port not in {"", str(self._port)} or (not port and self._port != 80):
            return False
        if name in self._hosts:
            return True
        with contextlib.suppress(ValueError):
            return self._any_address and bool(ipaddress.ip_address(name.strip("[]")))
        return False

    def check_origin(self, headers: Mapping[str, str]) -> None:
        """Raises Refused (403) for a request that a page of another site has made."""
        origin, host = headers.get("origin"), headers.get("host", "").lower()
        if origin is not None and origin.lower() not in {f"http://{host}", f"https://{host}"}:
            raise Refused(403, "another site's page may not ask here")
        if headers.get("sec-fetch-site", "none") in {"cross-site", "same-site"} and headers.get("sec-fetch-mode") != "navigate":
            raise Refused(403, "another site's page may not ask here")

    def check_token(self, headers: Mapping[str, str], protocols: Iterable[str] = ()) -> None:
        """Raises Refused (401) without the token, in a header or as a WebSocket's subprotocol; compared in constant time."""
        if not self._token:
            return
        scheme, _, given = headers.get("authorization", "").partition(" ")
        tokens = [given.strip()] if scheme.lower() == "bearer" else []
        tokens += [name.removeprefix(TOKEN_PROTOCOL) for name in protocols if name.startswith(TOKEN_PROTOCOL)]
        wanted = self._token.encode()
        matches = [hmac.compare_digest(token.encode(), wanted) for token in tokens]  # each, whichever was right
        if True not in matches:
            raise Refused(
                401, "the token is missing or wrong: open the address that hilstar printed, or send Authorization: Bearer"
            )


def _split(host: str) -> tuple[str, str]:
    """Name and port of a Host header; the name of an IPv6 address keeps its brackets."""
    if host.startswith("["):
        name, _, rest = host.partition("]")
        return name + "]", rest[1:] if rest.startswith(":") else ("x" if rest else "")
    name, colon, port = host.partition(":")
    return name, port if port or not colon else "x"


def headers_of(host: str) -> dict[str, str]:
    """The headers of every answer to a request that was allowed under that name; "" for one that was not."""
    sockets = f" ws://{host} wss://{host}" if host else ""
    return HEADERS | {"Content-Security-Policy": POLICY.format(sockets=sockets)}
