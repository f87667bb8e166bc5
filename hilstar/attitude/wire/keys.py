"""CURVE keys for ZeroMQ: this module makes them, reads them, and refuses endpoints beyond this
machine without them.

The side that binds is the CURVE server, with an allow-list of its clients' public keys. The side
that connects needs the server's public key. Key files are pyzmq certificates.
"""

import contextlib
import logging
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import zmq
import zmq.auth
from zmq.utils import z85

from hilstar.attitude.wire.endpoint import Endpoint
from hilstar.basics.errors import InputError, cannot_write, one_line
from hilstar.basics.reading import exists, read_bytes

MAKE_KEYS = "make keys with `hilstar keys -o DIR`"
MAX_KEY_FILE_BYTES = 16_384
KEY_BYTES = 32
OTHERS = 0o077  # file mode bits: the rights of the file's group and of all other users
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class CurveKeys:
    """One side's keys, as paths: its own secret key file, and the peers that it trusts.

    The side that connects has `server_key`, the public key file of the side that binds. The side
    that binds has `allowed_clients`, a directory with its clients' public key files.
    """

    secret_key: Path | None = None
    server_key: Path | None = None
    allowed_clients: Path | None = None

    @property
    def given(self) -> bool:
        """True where at least one of the three paths is given."""
        return any((self.secret_key, self.server_key, self.allowed_clients))


NO_KEYS = CurveKeys()


def check_reach(endpoint: Endpoint, text: str, *, bind: bool, keys: CurveKeys) -> None:
    """Check that the keys suit an endpoint, which the user wrote as `text`. Raises InputError for a
    non-loopback endpoint without keys, and for keys that lack one that this side needs.
    """
    if not keys.given:
        if not endpoint.loopback:
            raise InputError(
                f"{text}: non-loopback endpoints require CURVE keys; {MAKE_KEYS}, or use"
                " tcp://127.0.0.1:PORT"
            )
        return
    if keys.secret_key is None:
        raise InputError(
            f"{text}: curve_secret_key is missing; {MAKE_KEYS}, and name this side's secret key"
        )
    if bind and keys.allowed_clients is None:
        raise InputError(
            f"{text}: the side that binds requires allowed_clients, a directory of public keys;"
            f" {MAKE_KEYS}"
        )
    if not bind and keys.server_key is None:
        raise InputError(
            f"{text}: the side that connects requires curve_server_key, the other side's public"
            f" key; {MAKE_KEYS}"
        )


def make_keys(directory: Path) -> list[Path]:
    """Make two key pairs in a directory, `server` for the side that binds and `client` for the side
    that connects, and the server's allow-list. Returns the paths of the files.

    From its first byte on, only its owner can read a secret key. Raises InputError where a key
    file exists already, as a key in use is never overwritten, or where the files cannot be written.
    """
    allowed = directory / "allowed_clients"
    written = [
        directory / f"{name}.{kind}"
        for name in ("server", "client")
        for kind in ("key", "key_secret")
    ]
    written.append(allowed / "client.key")
    before = os.umask(OTHERS)
    try:
        there = [path for path in written if exists(path)]
        if there:
            raise InputError(
                f"{there[0]}: exists already, and may be in use; choose another directory"
            )
        allowed.mkdir(parents=True, exist_ok=True)
        # An incomplete set of keys is useless, so all are made in a temporary directory, and only
        # then renamed into place.
        with tempfile.TemporaryDirectory(dir=directory, prefix=".keys") as folder:
            for name in ("server", "client"):
                zmq.auth.create_certificates(folder, name)
            made = Path(folder)
            (made / "allowed").write_bytes((made / "client.key").read_bytes())
            (made / "allowed").rename(allowed / "client.key")
            for path in sorted(made.iterdir()):
                path.rename(directory / path.name)
    except (OSError, ValueError) as error:
        raise cannot_write(directory, error) from error
    finally:
        os.umask(before)
    return written


def load_public(path: Path) -> bytes:
    """The public key (Z85) in a key file. Raises InputError where it is missing or no key file."""
    return _load(path)[0]


def load_secret(path: Path) -> tuple[bytes, bytes]:
    """The public and the secret key (Z85) in a secret key file; logs a warning where other users
    may read it. Raises InputError where it is missing, or contains no secret key.
    """
    public, secret = _load(path)
    if secret is None:
        raise InputError(
            f"{path}: contains no secret key; name the .key_secret file that `hilstar keys` made"
        )
    mode = path.stat().st_mode
    if mode & OTHERS:
        log.warning(
            "%s: this secret key is readable by other users (mode %03o); run chmod 600 on it",
            path,
            mode & 0o777,
        )
    return public, secret


def _load(path: Path) -> tuple[bytes, bytes | None]:
    if not exists(path):
        raise InputError(f"{path}: no such key file; {MAKE_KEYS}")
    try:
        # pyzmq would read anything: this refuses pipes, devices and large files before that
        read_bytes(path, MAKE_KEYS, MAX_KEY_FILE_BYTES)
        public, secret = zmq.auth.load_certificate(path)
        for key in (public, secret):
            if key is not None and len(z85.decode(key)) != KEY_BYTES:
                raise ValueError("a key is 40 characters of Z85")
    except (OSError, ValueError, KeyError, IndexError, OverflowError) as error:
        raise InputError(f"{path}: not a key file ({one_line(str(error))}); {MAKE_KEYS}") from error
    return public, secret


class AllowList:
    """The clients whose public keys are in a directory. The directory is read again at a handshake
    where a key file has been added, removed or changed.

    pyzmq calls `callback` at each handshake, in one thread. Raises InputError at the start where
    the directory contains no key file, or one without a valid key. Later such a file causes a
    warning, and its client is rejected.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._seen = self._look()
        if not self._seen:
            raise InputError(
                f"{directory}: allowed_clients contains no *.key file; put each client's public key"
                " there"
            )
        self._keys = {load_public(path) for path in self._seen}

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether a client with this public key (Z85) may connect."""
        file_stamps = self._look()
        if file_stamps != self._seen:
            self._seen = file_stamps
            self._keys = set()
            for path in file_stamps:
                try:
                    self._keys.add(load_public(path))
                except InputError as error:
                    log.warning("%s", error)
        return key in self._keys

    def _look(self) -> dict[Path, tuple[int, int, int]]:
        """Each key file with its modification time, size and inode: at least one of them changes
        when the file is written or replaced.
        """
        file_stamps = {}
        with contextlib.suppress(OSError):
            for path in sorted(self._directory.glob("*.key")):
                status = path.stat()
                file_stamps[path] = (status.st_mtime_ns, status.st_size, status.st_ino)
        return file_stamps
