"""CURVE keys for ZeroMQ beyond loopback: made, read, and asked for where they lack.

The side that binds is the CURVE server: it has an allow-list of its clients' public keys. The side that connects needs
the server's public key. Key files are pyzmq's certificates.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import zmq
import zmq.auth

from hilstar.errors import InputError
from hilstar.reading import read_text

MAX_KEY_BYTES = 10_000
MAKE_KEYS = "make keys with `hilstar keys -o DIR`"
LOOPBACK = re.compile(r"tcp://(127(\.\d{1,3}){3}|localhost|\[::1\]):|(ipc|inproc)://")


@dataclass(frozen=True, slots=True)
class CurveKeys:
    """One side's keys: its own secret key file, and whom it trusts.

    `server_key` is the public key file of the side that binds, for the side that connects; `allowed_clients` a
    directory of public key files, for the side that binds.
    """

    secret_key: Path | None = None
    server_key: Path | None = None
    allowed_clients: Path | None = None

    @property
    def given(self) -> bool:
        """True when any file is named."""
        return any((self.secret_key, self.server_key, self.allowed_clients))


NO_KEYS = CurveKeys()


def is_loopback(endpoint: str) -> bool:
    """True for an endpoint that nobody beyond this machine can reach."""
    return LOOPBACK.match(endpoint) is not None


def check_reach(endpoint: str, *, bind: bool, keys: CurveKeys) -> None:
    """Refuse (InputError) what reaches beyond this machine without the keys for it, or has keys of the other side."""
    if not keys.given:
        if not is_loopback(endpoint):
            verb = "binding" if bind else "connecting"
            raise InputError(f"{endpoint}: {verb} beyond loopback needs CURVE keys; {MAKE_KEYS}, or use tcp://127.0.0.1:PORT")
        return
    if keys.secret_key is None:
        raise InputError(f"{endpoint}: curve_secret_key is missing beside the other keys; {MAKE_KEYS}")
    if bind and keys.allowed_clients is None:
        raise InputError(f"{endpoint}: the side that binds needs allowed_clients, a directory of public keys; {MAKE_KEYS}")
    if not bind and keys.server_key is None:
        raise InputError(f"{endpoint}: the side that connects needs curve_server_key, the other's public key; {MAKE_KEYS}")


def make_keys(directory: Path) -> list[Path]:
    """Two key pairs, `server` for the side that binds and `client` for the other, and the server's allow-list.

    Raises InputError where keys are already there: a key that is in use is not overwritten.
    """
    allowed = directory / "allowed_clients"
    written = [directory / f"{name}.{kind}" for name in ("server", "client") for kind in ("key", "key_secret")]
    there = [path for path in written if path.exists()]
    if there:
        raise InputError(f"{there[0]}: is there already, and may be in use; choose another directory")
    try:
        allowed.mkdir(parents=True, exist_ok=True)
        for name in ("server", "client"):
            zmq.auth.create_certificates(directory, name)
            (directory / f"{name}.key_secret").chmod(0o600)
        (allowed / "client.key").write_bytes((directory / "client.key").read_bytes())
    except OSError as error:
        raise InputError(f"{directory}: cannot be written ({error.strerror}); choose another place") from error
    return [*written, allowed / "client.key"]


def load_public(path: Path) -> bytes:
    """The public key of a key file. Raises InputError."""
    return _load(path)[0]


def load_secret(path: Path) -> tuple[bytes, bytes]:
    """Public and secret key of a secret key file. Raises InputError."""
    public, secret = _load(path)
    if secret is None:
        raise InputError(f"{path}: has no secret key; name the .key_secret file that `hilstar keys` made")
    return public, secret


def _load(path: Path) -> tuple[bytes, bytes | None]:
    read_text(path, MAKE_KEYS, MAX_KEY_BYTES)  # pyzmq would wait for a pipe, and read a device for ever
    try:
        public, secret = zmq.auth.load_certificate(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: is no key file ({error}); {MAKE_KEYS}") from error
    return public, secret


def check_allow_list(directory: Path) -> None:
    """Refuse (InputError) an allow-list that allows nobody, or holds a file that is no key."""
    files = sorted(directory.glob("*.key"))
    if not files:
        raise InputError(f"{directory}: allowed_clients holds no *.key file; put each client's public key there")
    for path in files:
        load_public(path)
