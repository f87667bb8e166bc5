"""The campaign's table: Parquet, a row a case in their order, the same bytes for the same rows."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilstar.errors import InputError, MachineError
from hilstar.files import whole_file

if TYPE_CHECKING:
    import pyarrow as pa

COMPRESSION, COMPRESSION_LEVEL = "zstd", 3
CHUNK_BYTES = 1 << 20
INSTALL = "install it: pip install 'hilstar[campaign]'"


def require_parquet() -> None:
    """Refuse (MachineError) before the first case what could not be written after the last."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError as error:
        raise MachineError(f"a campaign's table needs pyarrow; {INSTALL}") from error


def schema_of(columns: Mapping[str, str], about: Mapping[str, str]) -> pa.Schema:
    """The Arrow schema of columns (name -> kind), with what the table is about in its metadata."""
    import pyarrow as pa

    kinds = {"int64": pa.int64(), "float64": pa.float64(), "bool": pa.bool_(), "text": pa.string()}
    return pa.schema([pa.field(name, kinds[kind]) for name, kind in columns.items()], metadata=dict(about))


def write_table(path: Path, schema: pa.Schema, blocks: Iterator[list[dict[str, Any]]]) -> None:
    """Write blocks of rows, one a row group, whole or not at all. Raises InputError where it cannot be written."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    with whole_file(path) as file:
        settings: Any = {"compression": COMPRESSION, "compression_level": COMPRESSION_LEVEL, "version": "2.6"}
        with pq.ParquetWriter(file, schema, **settings) as writer:
            for rows in blocks:
                arrays = [pa.array([_exact(row[field.name], field.type) for row in rows], field.type) for field in schema]
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema), row_group_size=max(1, len(rows)))


def _exact(value: Any, kind: Any) -> Any:
    """JSON writes a whole float without its point."""
    import pyarrow as pa

    return float(value) if kind == pa.float64() and value is not None else value


def read_columns(path: Path) -> dict[str, Any]:
    """A campaign's table as columns of Python values. Raises InputError where it is none."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{path}: cannot be read as Parquet ({error}); give the table of a campaign") from error
    return {name: table.column(name).to_pylist() for name in table.column_names}


def failures(path: Path) -> dict[str, int]:
    """How many cases failed, by their reason, in the order of their first cases."""
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
        raise InputError(f"{path}: is no table of a campaign ({error}); delete it, and run the same command again") from error
    return because


def file_sha256(path: Path) -> str:
    """The SHA-256 of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()
