"""What answers at a ZeroMQ endpoint that does not become a partner: another socket type, other
keys, or no ZeroMQ at all.

libzmq says only that a connection ended. So the place is called once more, with the greeting of
ZMTP 3.0 (rfc.zeromq.org/spec/23), and what it answers is read: its mechanism, and without keys the
type of its socket.
"""

import contextlib
import re
import socket
import threading

from hilstar.attitude.wire.likeness import likeness
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock

GREETING_BYTES = 64
SIGNATURE = b"\xff" + bytes(8) + b"\x7f"
# libzmq sends its own mechanism once it has our version, and leaves at a mechanism that it does not
# want: ours comes last.
FIRST = SIGNATURE + b"\x03\x00"
SECOND = b"NULL".ljust(GREETING_BYTES - len(FIRST), b"\0")
MECHANISM = slice(12, 32)  # of a greeting
MAX_ANSWER_BYTES = 1024
PATIENCE_S = 1.0
AGAIN_S = 5.0  # a place is not called more often
SOCKET_TYPE = re.compile(rb"Socket-Type\x00\x00\x00([\x03-\x06])([A-Z]+)")
TCP_PLACE = re.compile(r"tcp://\[?(.+?)\]?:(\d+)")
# Which types a socket of ours takes, and what its other side has to open.
PARTNERS = {"SUB": ("PUB", "XPUB"), "REP": ("REQ", "DEALER"), "XPUB": ("SUB", "XSUB")}
KEYS = "curve_secret_key and curve_server_key"


def peer_trouble(address: str, answer: bytes | None, kind: str, keys: bool) -> str:
    """Why what answered at `address` is no partner of a socket of this kind ("SUB"), with `keys` or
    without.

    `answer` is what it sent, None where nobody is there. "" where it seems to be a partner after
    all.
    """
    wanted = PARTNERS[kind][0]
    if answer is None:
        return ""
    if not answer:
        silent = "something takes the connection there and says nothing, so it is no ZeroMQ"
        return f"{address}: {silent}; give the place of a {wanted} socket"
    if answer[:1] != SIGNATURE[:1] or len(answer) < GREETING_BYTES:
        return (
            f"{address}: no ZeroMQ answers there, but {likeness(answer).what}; give the place of a"
            f" {wanted} socket"
        )
    mechanism = answer[MECHANISM].rstrip(b"\0").decode(errors="replace")
    if keys or mechanism != "NULL":
        return _keys_trouble(address, mechanism, keys)
    socket_type = SOCKET_TYPE.search(answer, GREETING_BYTES)
    if socket_type is None or socket_type[2].decode() in PARTNERS[kind]:
        return ""
    return (
        f"{address}: a {socket_type[2].decode()} socket is there, and ours is {kind}; let the other"
        f" side open a {wanted} socket"
    )


def _keys_trouble(address: str, mechanism: str, keys: bool) -> str:
    """Why the keys of the two sides do not fit, where one of them has some."""
    if mechanism not in {"NULL", "CURVE"}:
        return f"{address}: it asks for {mechanism}; hilstar has CURVE keys, or none"
    if not keys:
        return (
            f"{address}: it asks for keys (CURVE), and we have none; give {KEYS} (hilstar keys"
            " makes them)"
        )
    if mechanism == "NULL":
        return (
            f"{address}: it has no keys, and we have; give it keys (hilstar keys), or leave"
            f" {KEYS} out"
        )
    return (
        "the other side rejected us: check its allowed_clients, and our curve_server_key, and that"
        " it is no other socket type"
    )


def answer_of(address: str, patience_s: float = PATIENCE_S) -> bytes | None:
    """What is sent there to a peer that greets as ZeroMQ does; None where nobody is there."""
    answer = b""
    try:
        with _connected(address, patience_s) as made:
            made.sendall(FIRST)
            greeted = False
            with contextlib.suppress(OSError):  # it may say nothing more, or end the connection
                while len(answer) < MAX_ANSWER_BYTES and SOCKET_TYPE.search(answer) is None:
                    more = made.recv(MAX_ANSWER_BYTES)
                    if not more:
                        break
                    answer += more
                    if len(answer) >= GREETING_BYTES and not greeted:
                        greeted = True
                        made.sendall(SECOND)
    except OSError:
        return None
    return answer


def _connected(address: str, patience_s: float) -> socket.socket:
    """A connection to a place of ZeroMQ's, tcp:// or ipc://. Raises OSError."""
    place = TCP_PLACE.fullmatch(address)
    if place is not None:
        return socket.create_connection((place[1], int(place[2])), patience_s)
    made = socket.socket(socket.AF_UNIX)
    made.settimeout(patience_s)
    try:
        made.connect(re.sub("^@", "\0", address.removeprefix("ipc://")))
    except OSError:
        made.close()
        raise
    return made


class PeerLook:
    """Looks at what answers at an address, on a thread of its own, and not too often."""

    def __init__(self, address: str, kind: str, keys: bool, clock: HostClock = HOST_CLOCK) -> None:
        self._address = address
        self._kind = kind
        self._keys = keys
        self._clock = clock
        self._found: str | None = None
        self._told = ""
        self._again = clock.within(0.0)

    def begin(self) -> None:
        """Look, unless that was done a moment ago."""
        if self._again.over:
            self._again = self._clock.within(AGAIN_S)
            threading.Thread(target=self._look, name="hilstar-peer", daemon=True).start()

    def _look(self) -> None:
        self._found = peer_trouble(self._address, answer_of(self._address), self._kind, self._keys)

    def take(self) -> str:
        """What was found, once, where it is new: a line for a person; "" for nothing, and for a
        peer that seems right.
        """
        trouble = self._found
        self._found = None
        if not trouble or trouble == self._told:
            return ""
        self._told = trouble
        return trouble
