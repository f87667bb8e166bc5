"""Catalogues made of tables, kept in the user's cache directory: whole or not at all, and made anew where they are damaged.

A file is found by what it was made of. Nothing depends on it: without a cache directory, on a full disk or beside another
process that writes the same file, a table is read again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from hilstar.errors import HilstarError
from hilstar.files import make_directory, whole_file
from hilstar.reading import open_regular
from hilstar.sky.catalog import RANGES, Catalog, column_names
from hilstar.sky.tables.reader import MAX_TABLE_BYTES

VERSION = 1  # of what a table is made into: count up with each change of its result
KEPT_FILES = 6  # the newest; 250 MB each for 2.5 million stars
HASH_BYTES = 1 << 22
MAX_STORED_BYTES = 3_000_000_000
DTYPES = {"hip": "i4", "identifier": "i8", "variable": "S1", "multiple": "S1"} | dict.fromkeys(
    ("range_mag", "period_d", "separation_arcsec"), "f4"
)
ALWAYS_KNOWN = ("ra_deg", "dec_deg", "v_mag", "bv_mag", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")


@dataclass(frozen=True, slots=True)
class Kept:
    """A catalogue, and what is to be said of it each time."""

    catalog: Catalog
    doubts: tuple[str, ...] = ()


def file_sha256(path: Path, advice: str) -> str:
    """The SHA-256 of a file of at most MAX_TABLE_BYTES, computed once for each state of it. Raises InputError."""
    with open_regular(path, advice, MAX_TABLE_BYTES) as file:
        status = os.fstat(file.fileno())
    return _sha256(path, (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns), advice)


@cache
def _sha256(path: Path, state: tuple[int, ...], advice: str) -> str:
    del state
    digest = hashlib.sha256()
    with open_regular(path, advice) as file:
        while block := file.read(HASH_BYTES):
            digest.update(block)
    return digest.hexdigest()


def store_path(made_of: Sequence[str]) -> Path | None:
    """The cache's file for what was made of these words (a file's hash, settings); None where there is no cache directory."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    try:
        root = Path(named) if named.startswith("/") else Path.home() / ".cache"
    except RuntimeError:  # no home
        return None
    key = hashlib.sha256(json.dumps([VERSION, *made_of]).encode()).hexdigest()
    return root / "hilstar" / f"catalogue-{key[:40]}.npz"


def kept(path: Path) -> Kept | None:
    """What the cache holds at `path`; None where it holds nothing that can be trusted."""
    try:
        with open_regular(path, "", MAX_STORED_BYTES) as file:
            status = os.fstat(file.fileno())
            if status.st_uid != os.getuid() or not _is_plain(zipfile.ZipFile(file)):
                return None
            file.seek(0)
            with np.load(file, allow_pickle=False) as packed:
                columns = {name: packed[name] for name in column_names()}
                about = json.loads(str(packed["about"]))
        notes = tuple(map(str, about["notes"]))
        catalog = Catalog(**columns, designation=str(about["designation"]), rows_read=int(about["rows_read"]), notes=notes)
        found = Kept(catalog, tuple(map(str, about["doubts"])))
    except Exception:  # whatever a damaged file raises in the layers of zipfile, NumPy and json
        return None
    return found if _is_sound(catalog) else None


def _is_plain(archive: zipfile.ZipFile) -> bool:
    """Whether nothing in an archive is packed, so that it cannot unfold into more than the file is long."""
    return all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist())


def _is_sound(catalog: Catalog) -> bool:
    """Whether each column has its type, one length, and figures that a star can have."""
    for name in column_names():
        values = getattr(catalog, name)
        if values.shape != catalog.v_mag.shape or values.ndim != 1 or values.dtype != np.dtype(DTYPES.get(name, "f8")):
            return False
        if name in RANGES:
            low, high = RANGES[name]
            bounds = (values.min(initial=high), values.max(initial=low)) if name in ALWAYS_KNOWN else (low, high)
            if not (low <= bounds[0] and bounds[1] <= high):  # NaN too
                return False
    return bool(np.isfinite(catalog.epoch_jyear).all())


def keep(path: Path, made: Kept) -> None:
    """Put a catalogue into the cache, and drop the oldest others; nothing happens where that cannot be."""
    about = {"designation": made.catalog.designation, "rows_read": made.catalog.rows_read}
    about |= {"notes": made.catalog.notes, "doubts": made.doubts}
    columns = {name: getattr(made.catalog, name) for name in column_names()}
    with contextlib.suppress(OSError, HilstarError):
        make_directory(path.parent)
        with whole_file(path) as file:
            np.savez(file, allow_pickle=False, about=np.array(json.dumps(about)), **columns)
        by_age = sorted(path.parent.glob("catalogue-*.npz"), key=lambda file: file.stat().st_mtime_ns, reverse=True)
        for old in by_age[KEPT_FILES:]:
            old.unlink(missing_ok=True)
