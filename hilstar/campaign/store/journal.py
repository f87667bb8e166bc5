"""The journal: each row appended as it comes, one line with its checksum, in a file a block of cases.

Laws:
1. A row counts as done once its line is written whole. A line that a kill, a full disk or a crash cut off is dropped when
   the journal is opened again, and its case is run again.
2. A block's file is renamed when all its cases are in it; such a file is not read again before the end.
3. One process writes at a time; it holds the lock of the campaign's directory.
"""

from __future__ import annotations

import contextlib
import os
import zlib
from pathlib import Path
from typing import Any

import msgspec

from hilstar.errors import InputError, cannot_write
from hilstar.files import make_directory, write_whole
from hilstar.reading import NOT_JSON

BLOCK_CASES = 16_384
OPEN, FULL = ".jsonl", ".full.jsonl"
CHECKSUM_CHARACTERS = 8

Row = dict[str, Any]


class Journal:
    """The rows of `cases` cases below `folder`. Raises InputError where it cannot be read or written."""

    def __init__(self, folder: Path, cases: int) -> None:
        self.folder, self.cases = make_directory(folder), cases
        self._done: dict[int, set[int]] = {}  # of blocks that are not full
        self._full: set[int] = set()
        self._files: dict[int, int] = {}
        for block in range(self.blocks):
            if self._path(block, FULL).exists():
                self._full.add(block)
            elif self._path(block, OPEN).exists():
                self._done[block] = set(self._mended(block))

    @property
    def blocks(self) -> int:
        """How many blocks the cases make."""
        return -(-self.cases // BLOCK_CASES)

    @property
    def done(self) -> int:
        """How many cases have their row."""
        return sum(len(self._block(block)) for block in self._full) + sum(len(done) for done in self._done.values())

    def missing(self, block: int) -> list[int]:
        """The cases of a block that have no row yet, in order."""
        if block in self._full:
            return []
        done = self._done.get(block, set())
        return [case for case in self._block(block) if case not in done]

    def append(self, rows: list[Row]) -> int:
        """Write rows; returns how many are new. A case that has its row already keeps it."""
        new = 0
        for row in rows:
            case = int(row["case"])
            block = case // BLOCK_CASES
            if block in self._full or case in self._done.setdefault(block, set()):
                continue
            self._write(block, _line(row))
            self._done[block].add(case)
            new += 1
            if len(self._done[block]) == len(self._block(block)):
                self._close_block(block)
        return new

    def rows(self, block: int) -> list[Row]:
        """The rows of a full block in the order of their cases. Raises InputError where one is missing."""
        found = self._read(self._path(block, FULL))[0]
        if len(found) != len(self._block(block)):
            raise InputError(
                f"{self._path(block, FULL)}: rows of cases are missing in it; delete it, and run the same command again"
            )
        return [found[case] for case in sorted(found)]

    def close(self) -> None:
        """Close the files."""
        for fd in self._files.values():
            os.close(fd)
        self._files.clear()

    def remove(self) -> None:
        """Delete the journal, whose rows stand elsewhere."""
        self.close()
        for path in self.folder.glob("*.jsonl"):
            path.unlink()
        with contextlib.suppress(OSError):  # somebody else's file is in it
            self.folder.rmdir()

    def _block(self, block: int) -> range:
        return range(block * BLOCK_CASES, min(self.cases, (block + 1) * BLOCK_CASES))

    def _path(self, block: int, ending: str) -> Path:
        return self.folder / f"{block:06d}{ending}"

    def _write(self, block: int, line: bytes) -> None:
        path = self._path(block, OPEN)
        try:
            if block not in self._files:
                self._files[block] = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
            while line:  # a full disk may take a part; what it left is a cut line, dropped at the next start
                line = line[os.write(self._files[block], line) :]
        except OSError as error:
            raise cannot_write(path, error, "make room, and run the same command again: it goes on") from error

    def _close_block(self, block: int) -> None:
        os.fsync(self._files[block])
        os.close(self._files.pop(block))
        self._path(block, OPEN).replace(self._path(block, FULL))
        del self._done[block]
        self._full.add(block)

    def _mended(self, block: int) -> list[int]:
        """The cases in an unfinished block, after cut lines were dropped from its file."""
        path = self._path(block, OPEN)
        found, whole = self._read(path)
        if not whole:
            write_whole(path, b"".join(_line(row) for row in found.values()))
        if len(found) == len(self._block(block)):  # killed between the last row and the new name
            self._files[block] = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC)
            self._done[block] = set(found)
            self._close_block(block)
            return []
        return list(found)

    def _read(self, path: Path) -> tuple[dict[int, Row], bool]:
        """The rows in a file by case, and whether all of its lines were whole."""
        try:
            data = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); run the same command again") from error
        found: dict[int, Row] = {}
        lines = data.split(b"\n")
        whole = lines.pop() == b""
        for line in lines:
            row = _row(line)
            if row is None or row["case"] in found or row["case"] not in self._block(int(path.name[:6])):
                whole = False
            else:
                found[row["case"]] = row
        return found, whole


def _line(row: Row) -> bytes:
    text = msgspec.json.encode(row)
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _row(line: bytes) -> Row | None:
    text = line[CHECKSUM_CHARACTERS + 1 :]
    if line[: CHECKSUM_CHARACTERS + 1] != b"%08x " % zlib.crc32(text):
        return None
    try:
        row = msgspec.json.decode(text, type=Row)
    except NOT_JSON:  # with the right checksum: somebody else's line
        return None
    return row if isinstance(row.get("case"), int) else None
