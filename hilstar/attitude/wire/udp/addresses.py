"""Where UDP is bound, and whose datagrams are read: addresses only, so that no name can lead elsewhere; no I/O."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

from hilstar.errors import InputError, shortened

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 5560
BIND_FORM = 'write bind = "ADDRESS:PORT", such as "127.0.0.1:5560" or "[::1]:5560"'
ALLOW_FORM = 'write addresses or networks, such as allow = ["192.168.1.20", "fd00::/64"]'
# ADDRESS, ADDRESS:PORT, [IPv6] or [IPv6]:PORT; an IPv6 address without brackets has no port.
PLACE = re.compile(r"(?:\[(?P<six>[0-9A-Fa-f:.]+(?:%\w+)?)\]|(?P<host>[^:\[\]/\s]+))(?::(?P<port>\d{1,5}))?")

MAX_KNOWN = 1000

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network
T = TypeVar("T")
LOOPBACK: tuple[Network, ...] = (ipaddress.IPv4Network("127.0.0.0/8"), ipaddress.IPv6Network("::1/128"))


@dataclass(frozen=True, slots=True)
class Place:
    """An address of this machine and a port, 0 for a free one."""

    host: Address
    port: int

    @property
    def loopback(self) -> bool:
        """Whether only this machine can send there."""
        return self.host.is_loopback

    def __str__(self) -> str:
        host = f"[{self.host}]" if self.host.version == 6 else str(self.host)
        return f"udp://{host}:{self.port}"


class AllowedSenders:
    """The addresses and networks whose datagrams are read: this machine alone where none are given."""

    def __init__(self, texts: Iterable[str] = ()) -> None:
        self.listed = tuple(_network(text) for text in texts)
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


def bound_place(bind: bool | str | None, port: str | int, endpoint: str | None) -> Place:
    """Where to bind, from three keys that may say the same. Raises InputError where one is wrong, or two disagree."""
    if bind is False:
        raise InputError(f"bind = false: over UDP hilstar binds and the simulator sends to it; {BIND_FORM}")
    said: dict[str, tuple[str | None, int | None]] = {}
    if isinstance(bind, str):
        said[f'bind = "{shortened(bind)}"'] = _parts(bind, f'bind = "{shortened(bind)}"')
    if port != "":
        said[f"port = {port!r}"] = (None, _port(str(port), f"port = {shortened(str(port))}"))
    if endpoint is not None:
        word = f'endpoint = "{shortened(endpoint)}"'
        if not endpoint.startswith("udp://"):
            raise InputError(f"{word}: not a UDP endpoint; write udp://ADDRESS:PORT, or {BIND_FORM.removeprefix('write ')}")
        said[word] = _parts(endpoint.removeprefix("udp://"), word)
    host = _agreed({word: host for word, (host, _) in said.items() if host is not None}, DEFAULT_HOST)
    return Place(ipaddress.ip_address(host), _agreed({word: n for word, (_, n) in said.items() if n is not None}, DEFAULT_PORT))


def _agreed(said: dict[str, T], otherwise: T) -> T:
    """What they all say. Raises InputError for the first two that differ."""
    words, values = list(said), list(said.values())
    for word, value in said.items():
        if value != values[0]:
            raise InputError(f"{words[0]} and {word} disagree; leave one of them out")
    return values[0] if values else otherwise


def _parts(text: str, word: str) -> tuple[str, int | None]:
    """Address and port of ADDRESS[:PORT] or [IPv6][:PORT]. Raises InputError."""
    text = f"[{text}]" if text.count(":") > 1 and not text.startswith("[") else text
    match = PLACE.fullmatch(text)
    if match is None:
        raise InputError(f"{word}: not an address and a port; {BIND_FORM}")
    host, port = match["six"] or match["host"], match["port"]
    try:
        address = ipaddress.ip_address("127.0.0.1" if host == "localhost" else host)
    except ValueError as error:
        raise InputError(f"{word}: {shortened(host)} is not an address of this machine; {BIND_FORM}") from error
    if address.is_multicast or getattr(address, "ipv4_mapped", None) is not None:
        raise InputError(f"{word}: {address} is not an address of one machine; {BIND_FORM}")
    return str(address), None if port is None else _port(port, word)


def _port(text: str, word: str) -> int:
    if not re.fullmatch(r"\d{1,5}", text) or int(text) > 65_535:
        raise InputError(f"{word}: not a port; write a number from 1 to 65535, such as port = {DEFAULT_PORT}")
    return int(text)


def _network(text: str) -> Network:
    try:
        return ipaddress.ip_network(text.strip("[]"))
    except ValueError as error:
        raise InputError(f'allow = ["{shortened(text)}"]: {error}; {ALLOW_FORM}') from error
