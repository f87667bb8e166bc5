"""Addresses that links bind or connect to, and whose datagrams UDP accepts: text in, checked places
out, no I/O.

ZeroMQ: a whitelist of forms, so that libzmq reads exactly what was checked here. libzmq itself also
accepts tcp://SOURCE;DESTINATION, names of interfaces, octal addresses, ports modulo 65536, and text
after the port; and binding ipc://FILE deletes that file.

    tcp://HOST:PORT   HOST an IPv4 address, an IPv6 address in brackets, a host name, or * (bind
    only; every interface);
                      PORT 1 to 65535, or * (bind only; a free one, which is reported)
    ipc:///PATH       a Unix socket, its absolute path; in an existing directory, with nothing there
    but an unserved socket

UDP takes numeric addresses only, so that no name can lead elsewhere.
"""

import contextlib
import ipaddress
import os
import re
import socket
import stat
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from hilstar.basics.errors import InputError, shortened

ENDPOINT_FORM = "write tcp://HOST:PORT, such as tcp://127.0.0.1:5560"
PATH_FORM = "write the absolute path of a socket, such as ipc:///run/user/1000/attitude"
LABEL = "(?!-)[A-Za-z0-9-]{1,63}(?<!-)"
# The last label of a name is not a number: that would be an address in an older notation (127.1,
# 0x7f.1).
HOST_NAME = re.compile(rf"(?:{LABEL}\.)*(?!0[xX])(?=[A-Za-z0-9-]*[A-Za-z]){LABEL}")
TCP = re.compile(r"tcp://(\[[0-9A-Fa-f:.%A-Za-z]+\]|[^\[\]:/;@%\s]+):([0-9]{1,5}|\*)")
MAX_HOST_CHARACTERS = 253
MAX_PATH_BYTES = 107  # the limit of sockaddr_un
FREE_PORTS = ("*", "0")
DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 5560
BIND_FORM = 'write bind = "ADDRESS:PORT", such as "127.0.0.1:5560" or "[::1]:5560"'
ALLOW_FORM = 'write addresses or networks, such as allow = ["192.168.1.20", "fd00::/64"]'
# ADDRESS, ADDRESS:PORT, [IPv6] or [IPv6]:PORT; an IPv6 address without brackets has no port.
PLACE = re.compile(
    r"(?:\[(?P<six>[0-9A-Fa-f:.]+(?:%\w+)?)\]|(?P<host>[^:\[\]/\s]+))(?::(?P<port>\d{1,5}))?"
)

MAX_KNOWN = 1000

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network
LOOPBACK: tuple[Network, ...] = (
    ipaddress.IPv4Network("127.0.0.0/8"),
    ipaddress.IPv6Network("::1/128"),
)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A checked endpoint: `address` as libzmq gets it, and whether it is reachable only from
    this machine.
    """

    address: str
    loopback: bool
    any_host: bool = False
    any_port: bool = False
    path: Path | None = None


def parse_endpoint(text: str) -> Endpoint:
    """The endpoint of a text. Raises InputError for any form except those listed in this
    module's docstring.
    """
    if text.startswith("ipc://"):
        name = text.removeprefix("ipc://")
        if (
            not name.startswith("/")
            or not name.isprintable()
            or len(os.fsencode(name)) > MAX_PATH_BYTES
        ):
            raise InputError(
                f"{shortened(text)}: not an absolute path of at most {MAX_PATH_BYTES} bytes;"
                f" {PATH_FORM}"
            )
        return Endpoint(text, loopback=True, path=Path(name))
    match = TCP.fullmatch(text)
    port = match[2] if match else ""
    if match is None or (port != "*" and int(port) > 65_535):
        raise InputError(f"{shortened(text)}: not an endpoint; {ENDPOINT_FORM}")
    free = port in FREE_PORTS
    host, loopback, everywhere = _judge_host(match[1], text)
    return Endpoint(f"tcp://{host}:{'*' if free else int(port)}", loopback, everywhere, free)


def _judge_host(host: str, text: str) -> tuple[str, bool, bool]:
    """The host as libzmq gets it, whether it is loopback, and whether it is every interface."""
    if host == "*":
        return host, False, True
    if host == "localhost":  # as an address: a name could be resolved to anything
        return "127.0.0.1", True, False
    bracketed = host.startswith("[")
    try:
        address = ipaddress.IPv6Address(host[1:-1]) if bracketed else ipaddress.IPv4Address(host)
    except ValueError as error:
        if bracketed or len(host) > MAX_HOST_CHARACTERS or not HOST_NAME.fullmatch(host):
            raise InputError(
                f"{shortened(text)}: {shortened(host)} is neither an address nor a host name;"
                f" {ENDPOINT_FORM}"
            ) from error
        return host, False, False
    if address.is_multicast:
        raise InputError(
            f"{shortened(text)}: {address} is not an address of one machine; {ENDPOINT_FORM}"
        )
    mapped = getattr(address, "ipv4_mapped", None)
    if mapped is not None:
        raise InputError(
            f"{shortened(text)}: an IPv4-mapped IPv6 address; write tcp://{mapped}:PORT"
        )
    return (
        f"[{address}]" if bracketed else str(address),
        address.is_loopback,
        address.is_unspecified,
    )


def check_use(endpoint: Endpoint, text: str, *, bind: bool) -> None:
    """Refuse (InputError) an endpoint that cannot be bound or connected, or whose file a bind
    would delete, as libzmq does.
    """
    path = endpoint.path
    if path is None:
        if not bind and (endpoint.any_host or endpoint.any_port):
            where, what = (
                ("every interface", "address") if endpoint.any_host else ("a free port", "port")
            )
            raise InputError(
                f"{text}: cannot connect to {where}; write the {what} of the side that binds"
            )
        return
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        mode = None
    except OSError as error:
        raise InputError(f"{text}: {error.strerror}; {PATH_FORM}") from error
    if bind and not path.parent.is_dir():
        raise InputError(
            f"{text}: the directory {path.parent} does not exist; create it, or write another path"
        )
    if mode is not None and not stat.S_ISSOCK(mode):
        raise InputError(
            f"{text}: an existing file that is not a socket, and binding would delete it; write"
            " another path"
        )
    if mode is not None and bind and _is_served(path):
        raise InputError(
            f"{text}: in use by a running program; stop that program, or write another path"
        )


def _is_served(path: Path) -> bool:
    """Whether a program listens at the socket `path`, or may."""
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as asker:
        asker.setblocking(False)
        try:
            asker.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:  # its queue is full (EAGAIN), or it belongs to another user
            return True
    return True


@dataclass(frozen=True, slots=True)
class UdpPlace:
    """An address of this machine and a port, 0 for a free one."""

    host: Address
    port: int

    @property
    def loopback(self) -> bool:
        """Whether only this machine can send there."""
        return self.host.is_loopback

    def __str__(self) -> str:
        if self.host.version == 6:
            host = f"[{self.host}]"
        else:
            host = str(self.host)
        return f"udp://{host}:{self.port}"


class AllowedSenders:
    """The addresses and networks whose datagrams are read: this machine alone where none are
    given.
    """

    def __init__(self, texts: Iterable[str] = ()) -> None:
        networks: list[Network] = []
        for text in texts:
            try:
                networks.append(ipaddress.ip_network(text.strip("[]")))
            except ValueError as error:
                raise InputError(f'allow = ["{shortened(text)}"]: {error}; {ALLOW_FORM}') from error
        self.listed = tuple(networks)
        self._known: dict[str, bool] = {}  # a flood asks for each of its datagrams

    def __bool__(self) -> bool:
        return bool(self.listed)

    @property
    def networks(self) -> tuple[Network, ...]:
        """The networks whose datagrams are read."""
        return self.listed or LOOPBACK

    def admits(self, host: str) -> bool:
        """Whether the datagrams of an address, as the kernel gives it, are read."""
        known = self._known.get(host)
        if known is None:
            if len(self._known) >= MAX_KNOWN:
                self._known.clear()
            address = ipaddress.ip_address(host)
            known = self._known[host] = any(address in network for network in self.networks)
        return known


def bound_place(bind: bool | str | None, port: str | int, endpoint: str | None) -> UdpPlace:
    """Where to bind, from three keys that may say the same. Raises InputError where one is
    wrong, or two disagree.
    """
    if bind is False:
        raise InputError(
            f"bind = false: over UDP hilstar binds and the simulator sends to it; {BIND_FORM}"
        )
    places: dict[str, tuple[str | None, int | None]] = {}
    if isinstance(bind, str):
        places[f'bind = "{shortened(bind)}"'] = _parts(bind, f'bind = "{shortened(bind)}"')
    if port != "":
        places[f"port = {port!r}"] = (None, _port(str(port), f"port = {shortened(str(port))}"))
    if endpoint is not None:
        word = f'endpoint = "{shortened(endpoint)}"'
        if not endpoint.startswith("udp://"):
            raise InputError(
                f"{word}: not a UDP endpoint; write udp://ADDRESS:PORT, or"
                f" {BIND_FORM.removeprefix('write ')}"
            )
        places[word] = _parts(endpoint.removeprefix("udp://"), word)
    hosts = {word: host for word, (host, _) in places.items() if host is not None} or {
        "": DEFAULT_HOST
    }
    ports = {word: number for word, (_, number) in places.items() if number is not None} or {
        "": DEFAULT_PORT
    }
    for values in (hosts, ports):
        first, *others = values.items()
        for word, value in others:
            if value != first[1]:
                raise InputError(f"{first[0]} and {word} disagree; leave one of them out")
    return UdpPlace(ipaddress.ip_address(next(iter(hosts.values()))), next(iter(ports.values())))


def _parts(text: str, word: str) -> tuple[str, int | None]:
    if text.count(":") > 1 and not text.startswith("["):
        text = f"[{text}]"
    match = PLACE.fullmatch(text)
    if match is None:
        raise InputError(f"{word}: not an address and a port; {BIND_FORM}")
    host = match["six"] or match["host"]
    port = match["port"]
    try:
        address = ipaddress.ip_address("127.0.0.1" if host == "localhost" else host)
    except ValueError as error:
        raise InputError(
            f"{word}: {shortened(host)} is not an address of this machine; {BIND_FORM}"
        ) from error
    if address.is_multicast or getattr(address, "ipv4_mapped", None) is not None:
        raise InputError(f"{word}: {address} is not an address of one machine; {BIND_FORM}")
    return str(address), None if port is None else _port(port, word)


def _port(text: str, word: str) -> int:
    if not re.fullmatch(r"\d{1,5}", text) or int(text) > 65_535:
        raise InputError(
            f"{word}: not a port; write a number from 1 to 65535, such as port = {DEFAULT_PORT}"
        )
    return int(text)
