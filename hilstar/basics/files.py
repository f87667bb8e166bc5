"""Files that are written: complete or not at all, never over an input or another output, and under
a name that fits.

A run's ledger is never overwritten unless the user asks for it. Temporary names are random and made
anew (O_EXCL), and what is written goes through the open file, never again by its name: nobody who
can write to the folder can turn it elsewhere.
"""

import contextlib
import errno
import fcntl
import io
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, cast

from hilstar.basics.errors import InputError, cannot_write
from hilstar.basics.reading import (
    CHUNK_BYTES,
    MAX_TOML_BYTES,
    exists,
    named_text,
    open_regular,
    parse_toml,
)

MCAP_MAGIC = b"\x89MCAP0\r\n"
LEDGER_MARK = b"bench_sha256"  # in the head of each ledger
HEAD_BYTES = 16_384
MAX_DEPTH = 3  # a bench file names a calibration, which names a table
OVERWRITE = "write another name, or add --overwrite"
PART_BYTES = 100  # part of a file's name that its temporary file's name (at most 255 bytes) keeps
# a process id in those of 0.1.0
PART_NAME = re.compile(r"\..+\.([0-9a-f]{16}|[0-9]+)\.part(\.\w+)?", re.DOTALL)
OWNER = ".owner"  # in a temporary folder: the file that its process has locked
MIN_REST_S, MAX_REST_S = 1.0, 3600.0  # before a file that was found whole is read through again
FOLDERS = "hilstar-"  # what temporary folders are called

# The endings of each kind of file; the first is the one that messages suggest.
FITS = (".fits", ".fit", ".fts")
PNG = (".png",)
PNG_OR_TIFF = (".png", ".tif", ".tiff")
CSV = (".csv",)
TOML = (".toml",)
MCAP = (".mcap",)
# Every ending by which a name says what it holds: of pictures, of text, of archives and arrays.
KNOWN = {
    *(
        FITS
        + PNG_OR_TIFF
        + (".jpg", ".jpeg", ".gif", ".bmp", ".webp", ".svg", ".pdf", ".ps", ".eps")
    ),
    *(
        ".csv",
        ".tsv",
        ".json",
        ".jsonl",
        ".toml",
        ".yaml",
        ".yml",
        ".xml",
        ".aem",
        ".kvn",
        ".mcap",
        ".html",
        ".md",
        ".txt",
    ),
    *(".npy", ".npz", ".h5", ".hdf5", ".mat", ".zip", ".tar", ".parquet", ".xlsx", ".py"),
}

Place = tuple[int, int] | str
STDOUT = Path("-")  # the output that is stdout: for text alone


def stdout_bytes() -> IO[bytes]:
    """The process's own stdout, wherever what a command prints goes meanwhile. Raises InputError
    without one.
    """
    if sys.__stdout__ is None:
        raise cannot_write("stdout", "it is closed", "write the name of a file")
    return cast(IO[bytes], sys.__stdout__.buffer)


def place_of(path: Path) -> Place | None:
    """The identity of a path: the file that it leads to, or the full path of one that does not
    exist yet.

    None for anything but a regular file, such as /dev/null.
    """
    try:
        status = path.stat()
    except (OSError, ValueError):
        return os.path.realpath(path)
    if stat.S_ISREG(status.st_mode):
        return (status.st_dev, status.st_ino)
    return None


def check_outputs(inputs: Iterable[Path | None], outputs: Iterable[Path | None]) -> None:
    """Refuse (InputError), before the first byte, an output that is an input or another output
    of the same command.
    """
    taken: dict[Place, Path] = {}
    for path in inputs:
        place = None if path is None else place_of(path)
        if path is not None and place is not None:
            taken.setdefault(place, path)
    for path in outputs:
        if path is None:
            continue
        try:
            _status(path)
        except (OSError, ValueError) as error:
            raise cannot_write(path, error) from error
        place = place_of(path)
        if place is None:
            continue
        if place in taken:
            if taken[place] == path:
                other = ""
            else:
                other = f", the same file as {taken[place]}"
            raise InputError(
                f"{path}{other}: is read or written by this command already; write another name for"
                " the output"
            )
        taken[place] = path


def files_named_in(path: Path, text: str | None = None, depth: int = 0) -> list[Path]:
    """A TOML file (of this `text`, where it has been read) and every file that it names, relative
    to it, and so on.

    Nothing is refused here.
    """
    paths = [path]
    try:
        if text is None:
            text = named_text(path, "", MAX_TOML_BYTES)
        if depth < MAX_DEPTH:
            table = parse_toml(path, text)
        else:
            table = {}
    except InputError:
        return paths
    for text in _texts(table):
        named = path.parent / text
        if len(text) < 4096 and "\0" not in text and exists(named) and named.is_file():
            paths += files_named_in(named, depth=depth + 1) if named.suffix == ".toml" else [named]
    return paths


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)


@contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """A temporary file beside `path`, open for writing; at the end it replaces `path`, and an error
    leaves that unchanged.

    Devices and pipes are written themselves, and stdout for `STDOUT`. Raises InputError where
    nothing can be written, and for a run's ledger.
    """
    if path == STDOUT:
        yield stdout_bytes()
        stdout_bytes().flush()
        return
    try:
        status = _status(path)
        if status is not None and not stat.S_ISREG(status.st_mode):
            with path.open("wb") as file:
                yield file
            return
        refuse_ledger(path)
        with _part_of(
            Path(os.path.realpath(path)), None if status is None else stat.S_IMODE(status.st_mode)
        ) as file:
            yield file
    except OSError as error:
        raise cannot_write(path, error) from error


def _status(path: Path) -> os.stat_result | None:
    """That of the file a path leads to, None where there is none yet. Raises OSError for links
    in a circle.
    """
    try:
        return path.stat()
    except FileNotFoundError:
        return None


@contextmanager
def _part_of(target: Path, mode: int | None) -> Iterator[IO[bytes]]:
    part = _part_path(target)
    with open(part, "wb", opener=_create) as file:
        try:
            yield file
            file.flush()
            if mode is not None:
                os.fchmod(file.fileno(), mode)
            if not os.path.samestat(os.fstat(file.fileno()), part.lstat()):
                raise OSError(errno.ESTALE, "its temporary file was replaced while it was written")
            part.replace(target)
        except BaseException:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise


def _part_path(target: Path) -> Path:
    """A temporary name beside a file that nobody can foresee; after a kill it is known by its
    ending.
    """
    name = os.fsdecode(os.fsencode(target.stem)[:PART_BYTES])
    return target.with_name(f".{name}.{secrets.token_hex(8)}.part{target.suffix}")


def clear_parts(folder: Path) -> None:
    """Delete what killed writers left in a directory and below it; for one that has a single
    writer, who is asking.
    """
    for path in folder.rglob(".*"):
        if PART_NAME.fullmatch(path.name) and path.is_file() and not path.is_symlink():
            with contextlib.suppress(OSError):
                path.unlink()


def _create(path: str | Path, flags: int = os.O_WRONLY | os.O_CREAT) -> int:
    """A new file, never one that is there, nor one that a link there leads to. Raises OSError."""
    return os.open(path, flags | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


def write_whole(path: Path, data: bytes | str) -> None:
    """Write a file, complete or not at all. Raises InputError."""
    with whole_file(path) as file:
        file.write(data.encode() if isinstance(data, str) else data)


@contextmanager
def as_text(file: IO[bytes]) -> Iterator[IO[str]]:
    """A file's text (UTF-8), whose lines end as they are written; the file stays open."""
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    yield text
    text.detach()


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
        raise InputError(
            f"{path}: is the ledger of a run, which cannot be made again; write another name"
        )


class NewFile:
    """A new file that grows while it is written, locked so that it has one writer.

    `fd` is its descriptor, which writes at the file's end. With `overwrite` an older file stays
    until `commit`. Raises InputError.
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
            made = self._part = _part_path(Path(os.path.realpath(path)))
        self._mtime_ns = 0
        self._look_s = 0.0
        self._rest_s = MIN_REST_S
        try:
            # Written by append: what somebody cuts off is missing for good, and the size says so.
            # Read to be compared.
            self.fd = _create(made, os.O_RDWR | os.O_CREAT | os.O_APPEND)
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

    def note(self) -> None:
        """Remember the file as this process has written it, before it looks for the next `harm`."""
        self._mtime_ns = os.fstat(self.fd).st_mtime_ns

    def harm(self, size_bytes: int, crc: int) -> str | None:
        """What somebody has done to the file, of which this process wrote so many bytes of this
        CRC-32; None for nothing.

        Raises OSError.
        """
        status = os.fstat(self.fd)
        if not status.st_nlink:
            return "deleted"
        if status.st_size != size_bytes:
            if status.st_size < size_bytes:
                return "truncated"
            return "overwritten"
        if status.st_mtime_ns == self._mtime_ns or time.monotonic() < self._look_s:
            return None
        if _crc_of(self.fd, size_bytes) != crc:
            return "overwritten"
        # It was only touched, or its file system keeps other times than it says: it is not read
        # over and over.
        self._look_s, self._rest_s = (
            time.monotonic() + self._rest_s,
            min(2 * self._rest_s, MAX_REST_S),
        )
        return None

    def discard(self) -> None:
        """Close and delete the file."""
        self.close()
        with contextlib.suppress(OSError):
            self._made.unlink()

    def close(self) -> None:
        """Close the descriptor. Raises OSError."""
        os.close(self.fd)


def _crc_of(fd: int, size_bytes: int) -> int:
    crc = place = 0
    while place < size_bytes and (
        data := os.pread(fd, min(CHUNK_BYTES, size_bytes - place), place)
    ):
        crc = zlib.crc32(data, crc)
        place = place + len(data)
    return crc


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
    """Create the directory `path` if it does not exist, and return it. Raises InputError where
    it cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise cannot_write(path, error) from error
    return path


def written(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a file by `write`, complete or not at all; an older file stays until the new one is
    complete.
    """
    with whole_file(path) as file:
        write(file)


def lock_alone(path: Path, held: str) -> int:
    """The descriptor of a lock file, made where there is none, and locked until it is closed or its
    process ends.

    A link there is not followed. Raises InputError, with `held` where another process has the lock.
    """
    try:
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    except (OSError, ValueError) as error:
        raise cannot_write(path, error) from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise InputError(f"{path.parent}: {held}") from error
    return lock


@contextmanager
def temporary_folder(kind: str) -> Iterator[Path]:
    """A folder of this process's alone, such as /tmp/hilstar-KIND-x1y2z3ab, deleted at the end.

    Where a kill left some, the next process of the same user deletes them.
    """
    clear_left()
    folder, owner = _owned_folder(f"{FOLDERS}{kind}-")
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(owner)


def _owned_folder(prefix: str) -> tuple[Path, int]:
    """A new folder, and the descriptor by which its owner holds it: the kernel lets it go
    however the owner ends.
    """
    while True:
        folder = Path(tempfile.mkdtemp(prefix=prefix))
        owner = _create(folder / OWNER)
        fcntl.flock(owner, fcntl.LOCK_EX)
        if exists(folder / OWNER):
            return folder, owner
        os.close(owner)  # somebody cleared it before it was held


def clear_left() -> None:
    """Delete the temporary folders of this user whose owner has ended; no link is followed, and
    no folder but ours.
    """
    for folder in Path(tempfile.gettempdir()).glob(f"{FOLDERS}*"):
        # it is gone, or no folder, or has no owner's file, or its owner lives
        with contextlib.suppress(OSError):
            _clear(folder)


def _clear(folder: Path) -> None:
    """Delete a folder that nobody holds. Raises OSError for any other."""
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        if os.fstat(opened).st_uid != os.geteuid():
            return
        owner = os.open(OWNER, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=opened)
        try:
            fcntl.flock(owner, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder)
        finally:
            os.close(owner)
    finally:
        os.close(opened)


def check_ending(option: str, path: Path | None, endings: tuple[str, ...]) -> None:
    """Refuse (InputError) a name with the ending of another kind of file; one without a known
    ending is accepted.

    `endings` are those of the kind that is written, and .gz after those of FITS.
    """
    if path is None:
        return
    if path == STDOUT:
        if endings in (CSV, TOML):
            return
        raise InputError(
            f"{option} -: {_article(endings)} is no text, so it does not go to stdout; write"
            f" OUT{endings[0]}"
        )
    ending = path.suffix.lower()
    if endings is FITS and ending == ".gz":
        ending = path.with_suffix("").suffix.lower()
    if ending not in endings and (ending in KNOWN or path.suffix.lower() == ".gz"):
        # A valid name on this file system, so that it can be copied from the line.
        better = path.with_suffix("").name or "OUT"
        raise InputError(
            f"{option} {path}: {_article(endings)} is written there; write {better}{endings[0]}"
        )


def refuse_stdout(option: str, path: Path) -> None:
    """Refuse (InputError) stdout where several files are written."""
    if path == STDOUT:
        raise InputError(
            f"{option} -: several files are written, which stdout cannot take; write a name"
        )


def check_directory(option: str, path: Path | None) -> None:
    """Refuse (InputError) the name of a file where a directory is created, and a place where
    nothing can be.

    For the start of a command: before its work, and before anything is created.
    """
    if path is None:
        return
    refuse_stdout(option, path)
    if path.suffix.lower() in KNOWN and not path.is_dir():
        raise InputError(
            f"{option} {path}: several files are written, into a directory; write the name of one,"
            f" such as {path.stem}"
        )
    there = next((place for place in (path, *path.parents) if exists(place)), None)
    if there is not None and not there.is_dir():
        raise cannot_write(path, os.strerror(errno.ENOTDIR))
    if there is not None and not os.access(there, os.W_OK | os.X_OK):
        raise cannot_write(path, os.strerror(errno.EACCES))


def _article(endings: tuple[str, ...]) -> str:
    names = {
        FITS: "a FITS file",
        PNG: "a PNG picture",
        PNG_OR_TIFF: "a PNG or TIFF picture",
        CSV: "a CSV table",
    }
    names |= {TOML: "a TOML file", MCAP: "an MCAP file"}
    return names.get(endings, f"a {endings[0]} file")
