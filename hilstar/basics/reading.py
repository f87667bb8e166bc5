"""Files that a user names: regular ones only, and of a bounded size.

A pipe would be awaited for ever, a device never ends, and a file of gigabytes is no bench file:
each is refused instead.

A file that a bench file names is opened once: its hash, its checks and its readers have the same
bytes (`named_bytes`).
"""

import codecs
import io
import logging
import os
import re
import stat
import threading
import time
import tomllib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO, Any

import msgspec

from hilstar.basics.errors import InputError, cannot_read, shortened, size_text

# What msgspec raises for bytes that are no JSON of the wanted form: for some that are no UTF-8 it
# is Python's own error.
NOT_JSON = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
HEAD_BYTES = 16
MAX_LINE_CHARACTERS = 1_000_000
CHUNK_BYTES = 1 << 20
MAX_TOML_BYTES = 200_000
MAX_KEY_PARTS = 32  # tomllib's time and memory grow as their square
DEEP_KEY = re.compile(
    rf"(?<![\w-])(?:[\"']?[\w-]{{0,40}}[\"']?[ \t]*\.[ \t]*){{{MAX_KEY_PARTS - 1}}}"
)
NOT_FILES = {
    stat.S_ISDIR: "is a directory",
    stat.S_ISFIFO: "is a pipe; write it to a file first",
    stat.S_ISSOCK: "is a socket",
    stat.S_ISCHR: "is a device",
    stat.S_ISBLK: "is a device",
}
# The first bytes of kinds of files that users have beside attitude logs and bench files.
MAGIC = {
    b"DAF/": "a SPICE kernel",
    b"DAFETF NAIF": "a SPICE kernel",
    b"NAIF/": "a SPICE kernel",
    b"\x89HDF\r\n\x1a\n": "an HDF5 file",
    b"SIMPLE  =": "a FITS file",
    b"PK\x03\x04": "a zip archive",
    b"\x1f\x8b": "a gzip file",
    b"BZh": "a bzip2 file",
    b"\xfd7zXZ\x00": "an xz file",
    b"\x28\xb5\x2f\xfd": "a Zstandard file",
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"%PDF": "a PDF",
    b"\x7fELF": "a program",
    b"\x93NUMPY": "a NumPy array",
    b"MATLAB 5.0": "a MATLAB file",
    b"PAR1": "a Parquet file",
    b"\x80\x02": "a pickle",
    b"\x80\x03": "a pickle",
    b"\x80\x04": "a pickle",
    b"\x80\x05": "a pickle",
    b"\xff\xfe\0\0": "text in UTF-32, not UTF-8",
    b"\xff\xfe": "text in UTF-16, not UTF-8",
    b"\xfe\xff": "text in UTF-16, not UTF-8",
}
# UTF-32's little-endian mark begins as UTF-16's does, so it comes first.
ENCODING_MARKS = {
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
# How a text of ASCII begins in encodings without a mark: which of each bytes are zeros.
UNMARKED = {
    "utf-32-le": re.compile(rb"(?:[^\0]\0{3}){2}"),
    "utf-32-be": re.compile(rb"(?:\0{3}[^\0]){2}"),
    "utf-16-le": re.compile(rb"(?:[^\0]\0){4}"),
    "utf-16-be": re.compile(rb"(?:\0[^\0]){4}"),
}
# Bytes that no text in Windows-1252 has: control characters other than tabs, line ends and form
# feeds, and the five bytes that are no character of it.
NO_TEXT = re.compile("[\x00-\x08\x0b\x0e-\x1f\x7f\x81\x8d\x8f\x90\x9d]")
PLAIN = re.compile(rb"[\t\n\f\r -~]*")

# Two writes within a file system's step of time (2 s on FAT) leave the same times.
SETTLED_NS = 2_000_000_000
MAX_KEPT_BYTES = 256_000_000

log = logging.getLogger(__name__)


# Where other rooms say what kinds of files they read; asked only of a file that is no plain text.
_kinds_of_rooms: list[Callable[[], Mapping[bytes, str]]] = []


def add_kinds(kinds: Callable[[], Mapping[bytes, str]]) -> None:
    """Let a room name the kinds of files that it reads: what a file is, by its first bytes."""
    if kinds not in _kinds_of_rooms:
        _kinds_of_rooms.append(kinds)


def kind_of(head: bytes) -> str | None:
    """What a file is by its first bytes (HEAD_BYTES of them): "a zip archive" or the like; None
    where that says nothing.
    """
    for kinds in (*[room() for room in _kinds_of_rooms], MAGIC):
        for magic, kind in kinds.items():
            if head.startswith(magic):
                return kind
    return None


def begins_as_text(head: bytes) -> bool:
    """Whether a file's first bytes are plain text in ASCII, and of no kind that MAGIC has."""
    return PLAIN.fullmatch(head) is not None and not head.startswith(tuple(MAGIC))


def exists(path: Path) -> bool:
    """Whether anything has that name, for any text that a user may write."""
    try:
        return path.exists()
    except (OSError, ValueError):  # a name too long, or with a NUL
        return False


def by_number(path: Path) -> list[str | int]:
    """A key that sorts files by name as people number them: NAME_9 before NAME_10."""
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if part.isdigit() else part for part in parts]


def open_regular(path: Path, advice: str, limit_bytes: int | None = None) -> io.BufferedReader:
    """A regular file, open for reading. `advice` is what to give instead, such as "give the path of
    a bench file".

    Raises InputError for anything else (a pipe is not awaited), and for a file of more than
    `limit_bytes`.
    """
    try:
        # before the open, which some devices take as a command
        _refuse_other(path, path.stat().st_mode, advice)
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "no file has such a name"
        raise cannot_read(path, reason, advice) from error
    try:
        status = os.fstat(file.fileno())
        _refuse_other(path, status.st_mode, advice)
        if limit_bytes is not None and status.st_size > limit_bytes:
            raise cannot_read(path, _too_large(status.st_size, limit_bytes), advice)
    except InputError:
        file.close()
        raise
    return file


def read_bytes(path: Path, advice: str, limit_bytes: int) -> bytes:
    """What a regular file of at most `limit_bytes` holds. Raises InputError."""
    with open_regular(path, advice, limit_bytes) as file:
        try:
            raw = file.read(limit_bytes + 1)  # files of /proc have no size
        except OSError as error:
            raise cannot_read(path, error, advice) from error
    if len(raw) > limit_bytes:
        raise cannot_read(path, _too_large(len(raw), limit_bytes), advice)
    return raw


class KeptFiles:
    """What files held, each with the state in which it was read: a file that changed is read anew.

    The files that were taken longest ago go where all hold more than MAX_KEPT_BYTES.
    """

    def __init__(self) -> None:
        self._contents: OrderedDict[tuple[int, ...], bytes] = OrderedDict()
        self._lock = threading.Lock()

    def content(self, state: tuple[int, ...] | None) -> bytes | None:
        """What a file of this state holds, without opening it; None where it is not kept."""
        with self._lock:
            if state is None or state not in self._contents:
                return None
            self._contents.move_to_end(state)
            return self._contents[state]

    def keep(self, state: tuple[int, ...] | None, content: bytes) -> None:
        """Keep what a file held that had this state before it was read; None is not kept."""
        if state is None or len(content) > MAX_KEPT_BYTES:
            return
        with self._lock:
            self._contents[state] = content
            while sum(map(len, self._contents.values())) > MAX_KEPT_BYTES:
                self._contents.popitem(last=False)


_named = KeptFiles()


def _settled_state(path: Path) -> tuple[int, ...] | None:
    """What changes with a file's content: its device, inode, size and times; None for a file that
    is missing or changed in the last SETTLED_NS.
    """
    try:
        status = path.stat()
    except (OSError, ValueError):  # its reader says why
        return None
    changed_ns = max(status.st_mtime_ns, status.st_ctime_ns)
    if changed_ns > time.time_ns() - SETTLED_NS:
        return None
    return (
        status.st_dev,
        status.st_ino,
        status.st_size,
        status.st_mtime_ns,
        status.st_ctime_ns,
    )


def named_bytes(path: Path, advice: str, limit_bytes: int) -> bytes:
    """What a file holds that a bench file names, as `read_bytes`; the same again is the same
    object. Raises InputError.
    """
    state = _settled_state(path)
    content = _named.content(state)
    if content is None:
        content = read_bytes(path, advice, limit_bytes)
        _named.keep(state, content)
    if len(content) > limit_bytes:
        raise cannot_read(path, _too_large(len(content), limit_bytes), advice)
    return content


def open_named(path: Path, advice: str, limit_bytes: int) -> io.BufferedReader | io.BytesIO:
    """A file that a bench file names, open for reading: from memory where it can be kept, so that
    it is opened once. Raises InputError.
    """
    try:
        is_kept = path.stat().st_size <= MAX_KEPT_BYTES
    except (OSError, ValueError):
        is_kept = False
    if not is_kept or _settled_state(path) is None:
        return open_regular(path, advice, limit_bytes)
    return io.BytesIO(named_bytes(path, advice, limit_bytes))


def named_text(path: Path, advice: str, limit_bytes: int) -> str:
    """The text of a file that a bench file names, as `read_text`. Raises InputError."""
    return as_text(path, named_bytes(path, advice, limit_bytes), advice)


def read_text(path: Path, advice: str, limit_bytes: int) -> str:
    """The text (UTF-8; a byte order mark is dropped) of a regular file of at most `limit_bytes`.
    Raises InputError.
    """
    return as_text(path, read_bytes(path, advice, limit_bytes), advice)


def as_text(path: Path, raw: bytes, advice: str) -> str:
    """The text of a file's bytes. Raises InputError with the kind of file, or the first byte
    that is not UTF-8.
    """
    refuse_kind(path, raw[:HEAD_BYTES], advice)
    wide = wide_encoding(raw[:HEAD_BYTES])
    if wide is not None:
        raise cannot_read(path, f"it is text in {wide[:6].upper()}, not UTF-8", advice)
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise cannot_read(path, _not_text(io.BytesIO(raw)), advice) from error


def wide_encoding(head: bytes) -> str | None:
    """The UTF-16 or UTF-32 of a text by its first bytes, with or without its mark; None for
    others.
    """
    for mark, encoding in ENCODING_MARKS.items():
        if head.startswith(mark):
            return encoding
    for encoding, beginning in UNMARKED.items():
        if beginning.match(head):
            return encoding
    return None


def refuse_kind(path: Path, head: bytes, advice: str) -> None:
    """Refuse (InputError) a file whose first bytes say that it is no text, by the name of its
    kind.
    """
    # Rooms take 0.05 s to say what they read, and each of these kinds has bytes that are no text.
    if begins_as_text(head):
        return
    kind = kind_of(head)
    if kind is not None:
        raise cannot_read(path, f"it is {kind}", advice)


@contextmanager
def open_lines(
    path: Path, advice: str, limit_bytes: int, whole_lines: bool = True
) -> Iterator[Iterator[str]]:
    """The lines of a text, one after another, so that a large file needs no memory; each ends as in
    the file.

    UTF-8, UTF-16 and UTF-32, and Windows-1252 with a warning: a line that is no UTF-8.
    Raises InputError as `read_text` does, for what is no text, and for a line of more than
    MAX_LINE_CHARACTERS: unless `whole_lines`, such a line is given in pieces of that length.
    """
    content = _named.content(_settled_state(path))
    if content is None or len(content) > limit_bytes:
        opened: IO[bytes] = open_regular(path, advice, limit_bytes)
    else:
        opened = io.BytesIO(content)
    with opened as file:
        try:
            head = file.read(HEAD_BYTES)
            file.seek(0)
            wide = wide_encoding(head)
            encoding = wide or "utf-8-sig"
            if wide is None:
                refuse_kind(path, head, advice)
            text = io.TextIOWrapper(file, encoding=encoding, errors="surrogateescape", newline="")
            yield _bounded(path, text, advice, whole_lines)
        except UnicodeDecodeError as error:
            raise cannot_read(
                path, f"it is cut off or damaged: not {encoding.upper()} to its end", advice
            ) from error
        except OSError as error:
            raise cannot_read(path, error, advice) from error


def _bounded(path: Path, text: IO[str], advice: str, whole_lines: bool) -> Iterator[str]:
    number = 0
    while line := text.readline(MAX_LINE_CHARACTERS):
        number += 1
        is_piece = len(line) == MAX_LINE_CHARACTERS and line[-1] not in "\r\n"
        if is_piece and whole_lines:
            raise InputError(
                f"{path}:{number}: the line has {MAX_LINE_CHARACTERS} characters or more; {advice}"
            )
        if not line.isascii():
            line = _decoded(path, number, line, advice)
        yield line


def _decoded(path: Path, number: int, line: str, advice: str) -> str:
    """A line as it is, or as Windows-1252 where bytes of it are no UTF-8. Raises InputError for
    bytes of no text.
    """
    try:
        line.encode("utf-8")
    except UnicodeEncodeError:
        raw = line.encode("utf-8", "surrogateescape")
        wrong = NO_TEXT.search(raw.decode("latin-1"))
        if wrong:
            byte = ord(wrong[0])
            raise cannot_read(
                path, f"it is no text: line {number} has a byte 0x{byte:02x}", advice
            ) from None
        warn_once(
            f"{path}: line {number} is not UTF-8, and is read as Windows-1252; save the file as"
            " UTF-8"
        )
        return raw.decode("cp1252")
    return line


@cache
def warn_once(line: str) -> None:
    """Log a warning, once in a process: a file is read several times in one command."""
    log.warning("%s", line)


def _not_text(file: IO[bytes]) -> str:
    decoder = codecs.getincrementaldecoder("utf-8")()
    offset = 0
    while chunk := file.read(CHUNK_BYTES):
        waiting = len(decoder.getstate()[0])
        try:
            decoder.decode(chunk)
        except UnicodeDecodeError as error:
            place = offset - waiting + error.start
            byte = error.object[error.start]
            return f"it is not UTF-8: byte {place} is 0x{byte:02x}"
        offset += len(chunk)
    return f"it is not UTF-8: it ends within a character, at byte {offset}"


def parse_toml(path: Path, text: str) -> dict[str, Any]:
    """The tables of a TOML file's text. Raises InputError with the line."""
    if DEEP_KEY.search(text):
        raise InputError(
            f"{path}: not TOML that anybody wrote: a key has {MAX_KEY_PARTS} parts or more"
        )
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not TOML: {shortened(error)}") from error
    except RecursionError as error:
        raise InputError(
            f"{path}: not TOML that anybody wrote: its values are nested too deep"
        ) from error
    except ValueError as error:  # Python reads no integer of more than 4300 digits
        raise InputError(f"{path}: not TOML: a whole number has thousands of digits") from error


def _refuse_other(path: Path, mode: int, advice: str) -> None:
    if not stat.S_ISREG(mode):
        what = next(
            (kind_text for test, kind_text in NOT_FILES.items() if test(mode)), "is no file"
        )
        raise cannot_read(path, f"it {what}", advice)


def _too_large(size_bytes: int, limit_bytes: int) -> str:
    return f"it has {size_text(size_bytes)} or more, and at most {size_text(limit_bytes)} are read"
