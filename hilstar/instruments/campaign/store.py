"""A campaign's directory: the journal of rows as they come, and the Parquet table of all rows at
the end.

The journal appends each row as one line with its checksum, to one file per block of cases. Laws:

1. A row counts as done once its line is written whole. A line that a kill, a full disk or a crash
   cut off is dropped when the journal is opened again, and its case is run again.
2. A block's file is renamed when all its cases are in it; such a file is not read again before the
   end.
3. One process writes at a time; it holds the lock of the campaign's directory.

The table has one row per case, in their order. The same rows give the same bytes.
"""

import contextlib
import hashlib
import os
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from hilstar.basics.errors import InputError, MachineError, cannot_read, cannot_write, shortened
from hilstar.basics.files import lock_alone, make_directory, whole_file, write_whole
from hilstar.basics.reading import NOT_JSON, read_bytes

if TYPE_CHECKING:
    import pyarrow as pa

COMPRESSION, COMPRESSION_LEVEL = "zstd", 3
INSTALL = "install it: pip install 'hilstar[campaign]'"
BLOCK_CASES = 16_384
OPEN, FULL = ".jsonl", ".full.jsonl"
CHECKSUM_CHARACTERS = 8

Row = dict[str, Any]  # a case's values by column; which columns there are depends on the plan
ABOUT, LOCK, JOURNAL, TABLE = "campaign.json", "campaign.lock", "journal", "cases.parquet"
MAX_ABOUT_BYTES = 50_000_000
RUNNING = "another campaign is running in it; wait for its end, or write another directory"
ANOTHER = "write another directory after -o, or delete this one"


def require_parquet() -> None:
    """Refuse (MachineError) a machine that could not write the table after the last case."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError as error:
        raise MachineError(f"a campaign's table needs pyarrow; {INSTALL}") from error


def schema_of(columns: Mapping[str, str], about: Mapping[str, str]) -> "pa.Schema":
    """The Arrow schema of columns (name -> kind), with the campaign's identity in its metadata."""
    import pyarrow as pa

    kinds = {"int64": pa.int64(), "float64": pa.float64(), "bool": pa.bool_(), "text": pa.string()}
    kinds |= {"floats": pa.list_(pa.float64())}
    return pa.schema(
        [pa.field(name, kinds[kind]) for name, kind in columns.items()], metadata=dict(about)
    )


def write_table(path: Path, schema: "pa.Schema", blocks: Iterator[list[Row]]) -> None:
    """Write blocks of rows, each as a row group, whole or not at all. Raises InputError where it
    cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with whole_file(path) as file:
        settings: Any = {
            "compression": COMPRESSION,
            "compression_level": COMPRESSION_LEVEL,
            "version": "2.6",
        }
        with pq.ParquetWriter(file, schema, **settings) as writer:
            for rows in blocks:
                columns: dict[str, list[Any]] = {}
                for field in schema:
                    values = [row[field.name] for row in rows]
                    if field.type == pa.float64():  # JSON writes a whole number without its point
                        values = [None if value is None else float(value) for value in values]
                    columns[field.name] = values
                writer.write_table(
                    pa.Table.from_pydict(columns, schema=schema), row_group_size=max(1, len(rows))
                )


def failures(path: Path) -> dict[str, int]:
    """The number of failed cases by reason, in the order of their first cases."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    because: dict[str, int] = {}
    try:
        file = pq.ParquetFile(path)
        for group in range(file.num_row_groups):
            rows = file.read_row_group(group, columns=["status", "why"]).to_pylist()
            for row in rows:
                if row["status"] == "failed":
                    because[row["why"]] = because.get(row["why"], 0) + 1
    except (OSError, pa.ArrowException, KeyError) as error:
        raise InputError(
            f"{path}: is no table of a campaign ({error}); delete it, and run the same command"
            " again"
        ) from error
    return because


def file_sha256(path: Path) -> str:
    """The SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Journal:
    """The rows of `cases` cases below `folder`. Raises InputError where it cannot be read or
    written.
    """

    def __init__(self, folder: Path, cases: int) -> None:
        self.folder = make_directory(folder)
        self.cases = cases
        self._done: dict[int, set[int]] = {}  # in blocks that are not full
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
        return sum(len(self._block(block)) for block in self._full) + sum(
            len(done) for done in self._done.values()
        )

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
        """The rows of a full block in the order of their cases. Raises InputError where one is
        missing.
        """
        rows_by_case = self._read(self._path(block, FULL))[0]
        if len(rows_by_case) != len(self._block(block)):
            raise InputError(
                f"{self._path(block, FULL)}: rows of cases are missing in it; delete it, and run"
                " the same command again"
            )
        return [rows_by_case[case] for case in sorted(rows_by_case)]

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
        with contextlib.suppress(OSError):  # another program's file is in it
            self.folder.rmdir()

    def _block(self, block: int) -> range:
        return range(block * BLOCK_CASES, min(self.cases, (block + 1) * BLOCK_CASES))

    def _path(self, block: int, ending: str) -> Path:
        return self.folder / f"{block:06d}{ending}"

    def _write(self, block: int, line: bytes) -> None:
        path = self._path(block, OPEN)
        try:
            if block not in self._files:
                self._files[block] = os.open(
                    path,
                    os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC,
                    0o666,
                )
            # a full disk may take a part: that is a cut line, dropped at the next start
            while line:
                line = line[os.write(self._files[block], line) :]
        except OSError as error:
            raise cannot_write(
                path, error, "make room, and run the same command again: it goes on"
            ) from error

    def _close_block(self, block: int) -> None:
        os.fsync(self._files[block])
        os.close(self._files.pop(block))
        self._path(block, OPEN).replace(self._path(block, FULL))
        del self._done[block]
        self._full.add(block)

    def _mended(self, block: int) -> list[int]:
        """The cases in an unfinished block, after cut lines were dropped from its file."""
        path = self._path(block, OPEN)
        rows_by_case, whole = self._read(path)
        if not whole:
            write_whole(path, b"".join(_line(row) for row in rows_by_case.values()))
        if len(rows_by_case) == len(
            self._block(block)
        ):  # killed between the last row and the new name
            self._files[block] = os.open(
                path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
            )
            self._done[block] = set(rows_by_case)
            self._close_block(block)
            return []
        return list(rows_by_case)

    def _read(self, path: Path) -> tuple[dict[int, Row], bool]:
        """The rows of a file by case, and whether all its lines were whole."""
        try:
            data = path.read_bytes()
        except OSError as error:
            raise InputError(
                f"{path}: cannot be read ({error.strerror}); run the same command again"
            ) from error
        rows_by_case: dict[int, Row] = {}
        lines = data.split(b"\n")
        whole = lines.pop() == b""
        for line in lines:
            row = _row(line)
            if (
                row is None
                or row["case"] in rows_by_case
                or row["case"] not in self._block(int(path.name[:6]))
            ):
                whole = False
            else:
                rows_by_case[row["case"]] = row
        return rows_by_case, whole


def _line(row: Row) -> bytes:
    text = msgspec.json.encode(row)
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _row(line: bytes) -> Row | None:
    text = line[CHECKSUM_CHARACTERS + 1 :]
    if line[: CHECKSUM_CHARACTERS + 1] != b"%08x " % zlib.crc32(text):
        return None
    try:
        row = msgspec.json.decode(text, type=Row)
    except NOT_JSON:  # with the right checksum: another program's line
        return None
    return row if isinstance(row.get("case"), int) else None


class About(msgspec.Struct, frozen=True):
    """The identity of a campaign: all that its rows depend on."""

    plan: dict[str, Any]
    bench_sha256: str
    files_sha256: str
    solver: str
    images: bool
    identity: dict[str, str]


class Directory:
    """The directory of a campaign, locked against a second driver until `close`. Raises
    InputError where one has it.
    """

    def __init__(self, path: Path) -> None:
        self.path = make_directory(path)
        self._lock = lock_alone(path / LOCK, RUNNING)

    @property
    def table(self) -> Path:
        """The table's path."""
        return self.path / TABLE

    def claim(self, about: About) -> None:
        """Claim the directory for this campaign. Raises InputError where it is another's, or
        holds another's files.
        """
        place = self.path / ABOUT
        if not place.exists():
            for name in (TABLE, JOURNAL):
                if (self.path / name).exists():
                    raise InputError(
                        f"{self.path / name}: is there already, and no {ABOUT} says whose it is;"
                        f" {ANOTHER}"
                    )
            write_whole(place, msgspec.json.format(msgspec.json.encode(about), indent=1))
            return
        try:
            before = msgspec.json.decode(read_bytes(place, ANOTHER, MAX_ABOUT_BYTES), type=About)
        except NOT_JSON as error:
            raise cannot_read(place, "it is no campaign's", ANOTHER) from error
        now = msgspec.json.decode(msgspec.json.encode(about), type=About)
        if self.table.exists():  # its rows are not run again, so this machine may differ
            now = msgspec.structs.replace(now, identity=before.identity)
        if before != now:
            raise InputError(
                f"{self.path}: holds another campaign: {_changed(before, about)}; {ANOTHER}"
            )

    def journal(self, cases: int) -> Journal:
        """The journal of rows that have come so far."""
        return Journal(self.path / JOURNAL, cases)

    def close(self) -> None:
        """Release the directory."""
        os.close(self._lock)


def _changed(before: About, now: About) -> str:
    """The first thing that differs, in words."""
    tables = msgspec.to_builtins(before), msgspec.to_builtins(now)
    for table, where in (("plan", "the plan's "), ("identity", "this machine's ")):
        for key in sorted(set(tables[0][table]) | set(tables[1][table])):
            old, new = (part[table].get(key) for part in tables)
            if old != new:
                old, new = (shortened(msgspec.json.encode(value).decode()) for value in (old, new))
                return f"{where}{key} was {old} and is {new}"
    for key, where in (
        ("bench_sha256", "its bench file"),
        ("files_sha256", "its log or scenario"),
        ("solver", "--solver"),
    ):
        if tables[0][key] != tables[1][key]:
            return f"{where} was {shortened(tables[0][key])} and is {shortened(tables[1][key])}"
    return "--images was another"
