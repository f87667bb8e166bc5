"""Tables of stars as files: FITS, VOTable, ECSV and CSV through Astropy, only the columns that are used."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.errors import InputError, cannot_read
from hilstar.reading import HEAD_BYTES, kind_of, open_regular, size_text
from hilstar.sky.tables.columns import Layout, layout_of

WANTED = "give a table of stars as FITS, ECSV, CSV or VOTable, or the CDS I/239 hip_main.dat"
MAX_TABLE_BYTES = 4_000_000_000
MAX_XML_BYTES = 500_000_000  # a VOTable is parsed as a whole
MAX_HEAD_BYTES = 1_000_000  # of the lines before a text's rows
MAX_COLUMNS, MAX_LINE = 1000, 50_000
MAX_ROWS = 10_000_000
CHUNK_BYTES = 64_000_000  # of a text that is parsed at once
BLANKS = ("", "null", "NULL", "nan", "NaN", "--", "---")
DELIMITERS = (",", "\t", "|", ";")
ELSEWHERE = re.compile(rb"<STREAM\b[^>]*\bhref\s*=", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class RawTable:
    """The columns of a table by its own names: figures as float64 with NaN where blank, identifiers as int64 with 0."""

    layout: Layout
    columns: Mapping[str, FloatArray | npt.NDArray[np.int64]]
    unit: Mapping[str, str | None]
    row_count: int


Whole = ("gaia", "tyc1", "tyc2", "tyc3", "hip")


def read_table(path: Path) -> RawTable:
    """Read a table of stars. Raises InputError for another file, and for one that is too large."""
    with open_regular(path, WANTED, MAX_TABLE_BYTES) as file:
        head = file.read(4096)
    kind = kind_of(head[:HEAD_BYTES])
    if kind is not None and kind != "a FITS file":
        raise cannot_read(path, f"it is {kind}", "unpack it first" if kind.endswith("zip file") else WANTED)
    text = head.lstrip(b"\xef\xbb\xbf \r\n\t")
    if kind == "a FITS file":
        return _read_fits(path)
    if text[:5] == b"<?xml" or text[:8].upper() == b"<VOTABLE":
        return _read_votable(path)
    if not text:
        raise InputError(f"{path}: is empty; {WANTED}")
    return _read_text(path)


@contextmanager
def _quiet(path: Path) -> Iterator[None]:
    """Astropy's warnings silenced, and whatever its layers raise over a broken file as one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except MemoryError as error:
        raise cannot_read(path, "it needs more memory than there is", "cut it to the stars that are used") from error
    except Exception as error:
        raise cannot_read(path, f"{type(error).__name__}: {error}".rstrip(": "), WANTED) from error


def _read_fits(path: Path) -> RawTable:
    from astropy.io import fits

    with _quiet(path), fits.open(path, memmap=True) as hdus:
        table = next((hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)), None)
        if table is None:
            raise InputError(f"{path}: holds no table; {WANTED}")
        layout = layout_of(path, table.columns.names)
        _check_rows(path, int(table.header["NAXIS2"]))
        by_name = {column.name: column for column in table.columns}
        columns, unit = {}, {}
        for name in layout.needed():
            null = by_name[name].null
            values = np.asarray(table.data[name])
            mask = values == null if null is not None and values.dtype.kind in "iu" else None
            columns[name], unit[name] = _numbers(path, layout, name, values, mask), by_name[name].unit
        return RawTable(layout, columns, unit, len(table.data))


def _read_votable(path: Path) -> RawTable:
    from astropy.io import votable

    if path.stat().st_size > MAX_XML_BYTES:
        size = size_text(path.stat().st_size)
        raise cannot_read(path, f"a VOTable of {size}, {size_text(MAX_XML_BYTES)} at most", "give it as FITS")
    if ELSEWHERE.search(path.read_bytes()):
        raise cannot_read(path, "its data are in another file or at another place", "give a VOTable that holds them")
    with _quiet(path):
        table = votable.parse_single_table(path, verify="ignore")
        fields = {field.name: field for field in table.fields}
        layout = layout_of(path, list(fields))
        _check_rows(path, len(table.array))
        columns, unit = {}, {}
        for name in layout.needed():
            column = table.array[fields[name].ID if fields[name].ID in (table.array.dtype.names or ()) else name]
            columns[name] = _numbers(path, layout, name, np.asarray(column.data), np.ma.getmaskarray(column))
            unit[name] = None if fields[name].unit is None else str(fields[name].unit)
        return RawTable(layout, columns, unit, len(table.array))


def _read_text(path: Path) -> RawTable:
    names, unit, delimiter = _text_head(path)
    layout = layout_of(path, names)
    needed = layout.needed()
    parts: dict[str, list[Any]] = {name: [] for name in needed}
    count = 0
    with _quiet(path):
        for chunk in _chunks(path, needed, delimiter):
            count += len(chunk)
            _check_rows(path, count)
            for name in needed:
                column = chunk[name]
                parts[name].append(_numbers(path, layout, name, np.asarray(column), np.ma.getmaskarray(column)))
    if not count:
        raise InputError(f"{path}: has no rows; {WANTED}")
    return RawTable(layout, {name: np.concatenate(values) for name, values in parts.items()}, unit, count)


def _chunks(path: Path, needed: list[str], delimiter: str) -> Iterator[Any]:
    """Pieces of a text's rows as Astropy tables of the columns `needed`."""
    from astropy.io import ascii as text

    yield from text.read(
        path,
        format="tab" if delimiter == "\t" else "csv",
        **({} if delimiter == "\t" else {"delimiter": delimiter}),
        comment="#",
        guess=False,
        include_names=needed,
        fill_values=[(blank, "0") for blank in BLANKS],
        fast_reader={"enable": "force", "chunk_size": CHUNK_BYTES, "chunk_generator": True},
    )


def _text_head(path: Path) -> tuple[list[str], dict[str, str | None], str]:
    """The columns' names and units, and what stands between them, by the comments and the first line of a text."""
    with open_regular(path, WANTED) as file:
        head = file.read(MAX_HEAD_BYTES).decode("utf-8-sig", errors="replace")
    lines = head.splitlines()
    comments = [line[1:].strip() for line in lines if line.startswith("#")]
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    unit: dict[str, str | None] = {}
    delimiter = max(DELIMITERS, key=first.count)
    if comments and comments[0].startswith("%ECSV"):
        from astropy.table import meta

        with _quiet(path):
            header = meta.get_header_from_yaml([line for line in comments if not line.startswith("%ECSV")])
        unit = {column["name"]: column.get("unit") for column in header["datatype"]}
        delimiter = str(header.get("delimiter", " "))
    elif not first.count(delimiter):
        raise cannot_read(path, "its first line names no columns", WANTED)
    names = [name.strip().strip('"') for name in first[:MAX_LINE].split(None if delimiter == " " else delimiter)]
    if len(first) > MAX_LINE or len(names) > MAX_COLUMNS:
        raise cannot_read(path, f"its first line names more than {MAX_COLUMNS} columns or is longer than {MAX_LINE}", WANTED)
    return names, unit, delimiter


def _numbers(path: Path, layout: Layout, name: str, values: npt.NDArray[Any], mask: Any) -> Any:
    """A column as float64, or as int64 where it identifies the star. Raises InputError where it is text."""
    whole = name in {layout.role.get(role) for role in Whole}
    if values.dtype.kind not in "iufb":
        raise InputError(
            f"{path}: column {name} is no column of numbers (its first is {str(values.flat[0])[:40]!r}); write decimal figures,"
            " places in degrees"
            if values.size
            else f"{path}: has no rows; {WANTED}"
        )
    if whole:
        numbers = np.nan_to_num(values, nan=0.0) if values.dtype.kind == "f" else values
        plain = numbers.astype(np.int64)
        return plain if mask is None else np.where(mask, 0, plain)
    figures = values.astype(np.float64)
    if mask is not None:
        figures[mask] = np.nan
    return figures


def _check_rows(path: Path, count: int) -> None:
    if count > MAX_ROWS:
        raise InputError(f"{path}: has more than {MAX_ROWS} rows; cut it to the magnitudes that the tracker sees")
