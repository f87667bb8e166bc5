"""Where a ZeroMQ socket binds or connects: a whitelist of forms, so that libzmq reads exactly what was judged here.

libzmq itself also takes tcp://SOURCE;DESTINATION, names of interfaces, octal addresses, ports modulo 65536, and text after
the port; and binding ipc://FILE deletes that file.

    tcp://HOST:PORT   HOST an IPv4 address, an IPv6 address in brackets, a host's name, or * (bind only; every interface);
                      PORT 1 to 65535, or * (bind only; a free one, which is told)
    ipc:///PATH       a Unix socket, its whole path; a directory that exists, and nothing there but a socket that nobody serves
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import re
import socket
import stat
from dataclasses import dataclass
from pathlib import Path

from hilstar.errors import InputError, shortened

ENDPOINT_FORM = "write tcp://HOST:PORT, such as tcp://127.0.0.1:5560"
PATH_FORM = "write the whole path of a socket, such as ipc:///run/user/1000/attitude"
LABEL = "(?!-)[A-Za-z0-9-]{1,63}(?<!-)"
# The last label of a name is no number: what looks like one is an address in some older spelling (127.1, 0x7f.1).
HOST_NAME = re.compile(rf"(?:{LABEL}\.)*(?!0[xX])(?=[A-Za-z0-9-]*[A-Za-z]){LABEL}")
TCP = re.compile(r"tcp://(\[[0-9A-Fa-f:.%A-Za-z]+\]|[^\[\]:/;@%\s]+):([0-9]{1,5}|\*)")
MAX_HOST_CHARACTERS = 253
MAX_PATH_BYTES = 107  # of sockaddr_un
FREE_PORTS = ("*", "0")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """An endpoint that was judged: `address` as libzmq gets it, and whether nobody beyond this machine can reach it."""

    address: str
    loopback: bool
    any_host: bool = False
    any_port: bool = False
    path: Path | None = None


def parse_endpoint(text: str) -> Endpoint:
    """What an endpoint's text says. Raises InputError for any form but those at the head of this module."""
    if text.startswith("ipc://"):
        return _parse_ipc(text)
    match = TCP.fullmatch(text)
    port = match[2] if match else ""
    if match is None or (port != "*" and int(port) > 65_535):
        raise InputError(f"{shortened(text)}: not an endpoint; {ENDPOINT_FORM}")
    free = port in FREE_PORTS
    host, loopback, everywhere = _judge_host(match[1], text)
    return Endpoint(f"tcp://{host}:{'*' if free else int(port)}", loopback, everywhere, free)


def _judge_host(host: str, text: str) -> tuple[str, bool, bool]:
    """The host as libzmq gets it, whether it is this machine's loopback, and whether it is every interface."""
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
                f"{shortened(text)}: {shortened(host)} is no address and no host's name; {ENDPOINT_FORM}"
            ) from error
        return host, False, False
    mapped = getattr(address, "ipv4_mapped", None)
    if mapped is not None:
        raise InputError(f"{shortened(text)}: an IPv4 address inside an IPv6 one; write tcp://{mapped}:PORT")
    return f"[{address}]" if bracketed else str(address), address.is_loopback, address.is_unspecified


def _parse_ipc(text: str) -> Endpoint:
    name = text.removeprefix("ipc://")
    if not name.startswith("/") or not name.isprintable() or len(os.fsencode(name)) > MAX_PATH_BYTES:
        raise InputError(f"{shortened(text)}: not a path of at most {MAX_PATH_BYTES} bytes; {PATH_FORM}")
    return Endpoint(text, loopback=True, path=Path(name))


def check_use(endpoint: Endpoint, text: str, *, bind: bool) -> None:
    """Refuse (InputError) what cannot be bound or connected, and what a bind would destroy."""
    if endpoint.path is not None:
        _check_socket_file(endpoint.path, text, bind)
    elif not bind and endpoint.any_host:
        raise InputError(f"{text}: every interface is nothing to connect to; write the address of the side that binds")
    elif not bind and endpoint.any_port:
        raise InputError(f"{text}: a free port is nothing to connect to; write the port that the side that binds has")


def _check_socket_file(path: Path, text: str, bind: bool) -> None:
    """libzmq deletes whatever has the name that it binds."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        mode = None
    except OSError as error:
        raise InputError(f"{text}: {error.strerror}; {PATH_FORM}") from error
    if bind and not path.parent.is_dir():
        raise InputError(f"{text}: there is no directory {path.parent}; make it, or write another path")
    if mode is None:
        return
    if not stat.S_ISSOCK(mode):
        raise InputError(f"{text}: is there and is no socket, and binding would delete it; write another path")
    if bind and _is_served(path):
        raise InputError(f"{text}: a running program serves it; stop that program, or write another path")


def _is_served(path: Path) -> bool:
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as asker:
        asker.setblocking(False)
        try:
            asker.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:  # its queue is full (EAGAIN), or it is not ours
            return True
    return True
