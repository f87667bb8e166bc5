"""The address of the page or of SCPI, the socket that listens there, and the token that admits a
browser or controller.
"""

import contextlib
import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass

from hilstar.basics.errors import InputError, shortened
from hilstar.basics.process.closing import Closing

HOST, PORT, SCPI_PORT = "127.0.0.1", 8765, 5025
MAX_PORT = 2**16 - 1
PORTS = {"--console": PORT, "--scpi": SCPI_PORT}
FORM = "write HOST:PORT, such as 127.0.0.1:8765, or 0.0.0.0:8765 to be reached from elsewhere"
BACKLOG = 512
TOKEN_BYTES = 32
# Characters that need no escapes in a URL and in a WebSocket's subprotocol.
TOKEN = re.compile(r"[A-Za-z0-9._~-]{16,200}")
NAME = re.compile(
    r"(?=.{1,253}$)[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?(\.[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?)*(:\d{1,5})?"
)


@dataclass(frozen=True, slots=True)
class ListenAddress:
    """A host (name or numeric address) and a port; port 0 means any free port."""

    host: str
    port: int

    @property
    def is_loopback(self) -> bool:
        """Whether only programs on this machine can reach the address."""
        if self.host == "localhost":
            return True
        with contextlib.suppress(ValueError):
            return ipaddress.ip_address(self.host).is_loopback
        return False


def parse_address(text: str, option: str = "--console") -> ListenAddress:
    """The address in the text of --console or --scpi: "HOST:PORT", "HOST", ":PORT" or "PORT", with
    the option's usual host and port for a missing part. Raises InputError for any other text.
    """
    wrong = InputError(f"{option} {shortened(text)}: {_form(option)}")
    if text.isdecimal() and text.isascii():
        host = HOST
        port = text
    elif text.startswith("["):
        host, bracket, rest = text[1:].partition("]")
        if not bracket or (rest and not rest.startswith(":")):
            raise wrong
        port = rest[1:]
    elif text.count(":") > 1:
        host = text
        port = ""
    else:
        host, _, port = text.partition(":")
    if port and not (
        port.isdecimal() and port.isascii() and len(port) <= 5 and int(port) <= MAX_PORT
    ):
        raise wrong
    host = host or HOST
    if NAME.fullmatch(host) is None or ":" in host or re.fullmatch(r"[\d.]+", host):
        try:
            ipaddress.ip_address(host)
        except ValueError:
            raise wrong from None
    return ListenAddress(host, int(port) if port else PORTS[option])


def _form(option: str) -> str:
    return FORM.replace(str(PORT), str(PORTS[option]))


class PageListener(Closing):
    """The listening socket of the page, its names and its token; SCPI listens by the same rules.

    If other machines can reach the page and no token is given, a random one is made (`made`).
    `names` are further names of the page, under which a proxy serves it. Raises InputError if the
    address, the token or a name cannot be used.
    """

    def __init__(
        self,
        address: ListenAddress,
        token: str | None = None,
        names: tuple[str, ...] = (),
        option: str = "--console",
    ) -> None:
        if token is not None and TOKEN.fullmatch(token) is None:
            raise InputError(
                "--token: write 16 to 200 letters, digits or . _ ~ -, as `openssl rand -hex 32`"
                " makes them"
            )
        for name in names:
            if NAME.fullmatch(name) is None:
                raise InputError(
                    f"--console-name {shortened(name)}: write a name as browsers have it, such as"
                    " stars.lab:8443"
                )
        self.names = names
        self.made = token is None and not address.is_loopback
        self.token = secrets.token_urlsafe(TOKEN_BYTES) if self.made else token or ""
        self.any_address = not address.is_loopback
        self.host = address.host
        self.socket = _listen(address, option)
        self.port: int = self.socket.getsockname()[1]

    @property
    def hosts(self) -> list[str]:
        """The host names, in lower case, under which a browser may request the page. With
        `any_address` every numeric address is allowed too.
        """
        own_hosts = ["localhost", "127.0.0.1", "[::1]", _bracketed(self.host)]
        if self.any_address:
            own_hosts += [socket.gethostname(), socket.getfqdn()]
        return sorted({name.lower() for name in own_hosts})

    @property
    def url(self) -> str:
        """The URL to open in a browser. It contains the token if hilstar made it; a token that the
        user gave is never printed.
        """
        host = self.host
        with contextlib.suppress(ValueError):
            if ipaddress.ip_address(host).is_unspecified:
                # This machine's address on its route out, by which others most likely reach it:
                # connecting a UDP socket sends nothing.
                is_v6 = self.socket.family == socket.AF_INET6
                # Addresses that are reserved for documentation (RFC 3849, RFC 5737).
                beyond, host = ("2001:db8::1", "::1") if is_v6 else ("192.0.2.1", HOST)
                with (
                    contextlib.suppress(OSError),
                    socket.socket(self.socket.family, socket.SOCK_DGRAM) as probe,
                ):
                    probe.connect((beyond, 9))
                    host = str(probe.getsockname()[0])
        return f"http://{_bracketed(host)}:{self.port}/" + (
            f"#token={self.token}" if self.made else ""
        )

    def close(self) -> None:
        """Stop listening."""
        self.socket.close()


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _listen(address: ListenAddress, option: str) -> socket.socket:
    where = f"{_bracketed(address.host)}:{address.port}"
    try:
        addresses = socket.getaddrinfo(
            address.host, address.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"{option} {where}: no such host ({getattr(error, 'strerror', error)}); {_form(option)}"
        ) from error
    family, kind, protocol, _, place = addresses[0]
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(place)
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        reason = str(error.strerror or error)
        raise InputError(
            f"{option} {where}: cannot listen there ({reason}); choose another port, or 0 for any"
        ) from error
    listener.setblocking(False)
    return listener
