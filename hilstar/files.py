"""Files that are written: complete or not at all, never over an input or another output, and under a name that fits.

A run's ledger is never overwritten unless the user asks for it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hilstar.errors import InputError, cannot_write
from hilstar.reading import MAX_TOML_BYTES, MCAP_MAGIC, exists, open_regular, parse_toml, read_text

LEDGER_MARK = b"bench_sha256"  # in the head of each ledger
HEAD_BYTES = 16_384
MAX_DEPTH = 3  # a bench file names a calibration, which names a table
OVERWRITE = "write another name, or add --overwrite"

# The endings of each kind of file; the first is the one that messages suggest.
FITS = (".fits", ".fit", ".fts")
PNG = (".png",)
PNG_OR_TIFF = (".png", ".tif", ".tiff")
CSV = (".csv",)
TOML = (".toml",)
MCAP = (".mcap",)
# Every ending by which a name says what it holds: of pictures, of text, of archives and arrays.
KNOWN = {
    *(FITS + PNG_OR_TIFF + (".jpg", ".jpeg", ".gif", ".bmp", ".webp", ".svg", ".pdf", ".ps", ".eps")),
    *(".csv", ".tsv", ".json", ".jsonl", ".toml", ".yaml", ".yml", ".xml", ".aem", ".kvn", ".mcap", ".html", ".md", ".txt"),
    *(".npy", ".npz", ".h5", ".hdf5", ".mat", ".zip", ".tar", ".parquet", ".xlsx", ".py"),
}

Place = tuple[int, int] | str


def place_of(path: Path) -> Place | None:
    """The identity of a path: the file that it leads to, or the full path of one that does not exist yet.

    None for anything but a regular file, such as /dev/null.
    """
    try:
        status = path.stat()
    except (OSError, ValueError):
        return os.path.realpath(path)
    return (status.st_dev, status.st_ino) if stat.S_ISREG(status.st_mode) else None


def check_outputs(inputs: Iterable[Path | None], outputs: Iterable[Path | None]) -> None:
    """Refuse (InputError), before the first byte, an output that is an input or another output of the same command."""
    taken: dict[Place, Path] = {}
    for path in inputs:
        place = None if path is None else place_of(path)
        if path is not None and place is not None:
            taken.setdefault(place, path)
    for path in outputs:
        place = None if path is None else place_of(path)
        if path is None or place is None:
            continue
        if place in taken:
            other = "" if taken[place] == path else f", the same file as {taken[place]}"
            raise InputError(f"{path}{other}: is read or written by this command already; write another name for the output")
        taken[place] = path


def files_named_in(path: Path, text: str | None = None, depth: int = 0) -> list[Path]:
    """A TOML file (of this `text`, where it has been read) and every file that it names, relative to it, and so on.

    Nothing is refused here.
    """
    found = [path]
    try:
        text = read_text(path, "", MAX_TOML_BYTES) if text is None else text
        table = parse_toml(path, text) if depth < MAX_DEPTH else {}
    except InputError:
        return found
    for text in _texts(table):
        named = path.parent / text
        if len(text) < 4096 and "\0" not in text and exists(named) and named.is_file():
            found += files_named_in(named, depth=depth + 1) if named.suffix == ".toml" else [named]
    return found


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to; at the end it replaces `path`, and an error leaves that unchanged.

    Devices and pipes are written themselves. Raises InputError where nothing can be written, and for a run's ledger.
    """
    try:
        with _beside(path) as part:
            yield part
    except OSError as error:
        raise cannot_write(path, error) from error


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    target = Path(os.path.realpath(path))
    status = target.stat() if target.exists() else None
    if status is not None and not stat.S_ISREG(status.st_mode):
        yield path
        return
    refuse_ledger(path)
    # The ending stays: some libraries choose the format by it.
    part = target.with_name(f".{target.stem[:100]}.{os.getpid()}.part{target.suffix}")
    try:
        yield part
        if status is not None:
            part.chmod(stat.S_IMODE(status.st_mode))
        part.replace(target)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def write_whole(path: Path, data: bytes | str) -> None:
    """Write a file, complete or not at all. Raises InputError."""
    with whole_file(path) as part:
        part.write_bytes(data.encode() if isinstance(data, str) else data)


def refuse_existing(path: Path | None, overwrite: bool) -> None:
    """Refuse (InputError) to write over what cannot be made again."""
    if path is None or overwrite or not exists(path):
        return
    if path.is_file() and not path.stat().st_size:
        return
    raise InputError(f"{path}: is there already, and cannot be made again; {OVERWRITE}")


def refuse_ledger(path: Path) -> None:
    """Refuse (InputError) to write anything over the ledger of a run."""
    head = b""
    with contextlib.suppress(InputError, OSError), open_regular(path, "") as file:
        head = file.read(HEAD_BYTES)
    if head.startswith(MCAP_MAGIC) and LEDGER_MARK in head:
        raise InputError(f"{path}: is the ledger of a run, which cannot be made again; write another name")


class NewFile:
    """A new file that grows while it is written, locked so that it has one writer.

    `fd` is its descriptor. With `overwrite` an older file stays until `commit`. Raises InputError.
    """

    def __init__(self, path: Path, overwrite: bool = False) -> None:
        self.path = path
        self._part: Path | None = None
        refuse_writer(path)
        refuse_existing(path, overwrite)
        if exists(path) and not path.is_file():
            raise cannot_write(path, "it is no file", "choose another place for the ledger")
        made = path
        if exists(path):
            target = Path(os.path.realpath(path))
            made = self._part = target.with_name(f".{target.name[:100]}.{os.getpid()}.part")
        try:
            self.fd = os.open(made, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        except FileExistsError as error:
            raise InputError(f"{path}: is there already; {OVERWRITE}") from error
        except (OSError, ValueError) as error:
            raise cannot_write(path, error, "choose another place for the ledger") from error
        self._made = made
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(self.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def commit(self) -> None:
        """Give the file its name, in the place of an older one. Raises OSError."""
        if self._part is not None:
            self._part.replace(os.path.realpath(self.path))
            self._part = None

    def discard(self) -> None:
        """Close and delete the file."""
        self.close()
        with contextlib.suppress(OSError):
            self._made.unlink()

    def close(self) -> None:
        """Close the descriptor. Raises OSError."""
        os.close(self.fd)


def refuse_writer(path: Path) -> None:
    """Refuse (InputError) a file that another run is writing."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError):
        return
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise InputError(f"{path}: another run is writing it; write another name") from error
    except OSError:
        return
    finally:
        os.close(fd)


def make_directory(path: Path) -> Path:
    """Create the directory `path` if it does not exist, and return it. Raises InputError where it cannot be created."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise cannot_write(path, error) from error
    return path


def written(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file by `write`, complete or not at all; an older file stays until the new one is complete."""
    with whole_file(path) as part:
        write(part)


def check_ending(option: str, path: Path | None, endings: tuple[str, ...]) -> None:
    """Refuse (InputError) a name with the ending of another kind of file; one without a known ending is accepted.

    `endings` are those of the kind that is written, and .gz after those of FITS.
    """
    if path is None:
        return
    ending = path.suffix.lower()
    if endings is FITS and ending == ".gz":
        ending = path.with_suffix("").suffix.lower()
    if ending not in endings and (ending in KNOWN or path.suffix.lower() == ".gz"):
        # A valid name on this file system, so that it can be copied from the line.
        better = path.with_suffix("").name or "OUT"
        raise InputError(f"{option} {path}: {_article(endings)} is written there; write {better}{endings[0]}")


def check_directory(option: str, path: Path | None) -> None:
    """Refuse (InputError) the name of a file where a directory is created, and a place where nothing can be.

    For the start of a command: before its work, and before anything is created.
    """
    if path is None:
        return
    if path.suffix.lower() in KNOWN and not path.is_dir():
        raise InputError(
            f"{option} {path}: several files are written, into a directory; write the name of one, such as {path.stem}"
        )
    there = next((place for place in (path, *path.parents) if exists(place)), None)
    if there is not None and not there.is_dir():
        raise cannot_write(path, os.strerror(errno.ENOTDIR))
    if there is not None and not os.access(there, os.W_OK | os.X_OK):
        raise cannot_write(path, os.strerror(errno.EACCES))


def _article(endings: tuple[str, ...]) -> str:
    names = {FITS: "a FITS file", PNG: "a PNG picture", PNG_OR_TIFF: "a PNG or TIFF picture", CSV: "a CSV table"}
    return (names | {TOML: "a TOML file", MCAP: "an MCAP file"})[endings]
