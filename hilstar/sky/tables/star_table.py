"""The catalogue of a bench: the packaged one, a `hip_main.dat`, or a user's table, alone or added to Hipparcos."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, replace
from pathlib import Path

from hilstar.errors import InputError
from hilstar.reading import open_regular
from hilstar.sky.astrometry import unit_vectors_icrs
from hilstar.sky.catalog import PACKAGED_CATALOG, Catalog, load_catalog
from hilstar.sky.cells import cell_grid
from hilstar.sky.tables.assemble import GAIA_DR3_JYEAR, assemble
from hilstar.sky.tables.join import join
from hilstar.sky.tables.reader import MAX_TABLE_BYTES, WANTED, read_table
from hilstar.sky.tables.store import Kept, file_sha256, keep, kept, store_path

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Choice:
    """A bench's catalogue as its file names it; `epoch_jyear` is that of a table's places, where the file states it."""

    source: str | Path = "hipparcos"
    with_hipparcos: bool = False
    epoch_jyear: float | None = None


def choose_catalog(choice: Choice) -> Catalog:
    """The stars of a choice, with notes on what became of a table's rows.

    A table is read once; then what was made of it comes from the user's cache directory. Rows that are no star, and an overlap
    that does not fit, are said in the log each time. Raises InputError.
    """
    packaged = str(choice.source) == "hipparcos"
    if packaged or _is_hip_main(Path(choice.source)):
        if choice.with_hipparcos:
            raise InputError("[sky] with_hipparcos adds a table's stars to Hipparcos; name a table as [sky] catalogue")
        if choice.epoch_jyear is not None:
            raise InputError("[sky] catalogue_epoch_jyear is for a table; Hipparcos has its own, J1991.25")
        return load_catalog(choice.source)
    path = Path(choice.source)
    made_of = (
        path.name,
        file_sha256(path, WANTED),
        repr(choice.epoch_jyear),
        _packaged_sha256() if choice.with_hipparcos else "",
    )
    place = store_path(made_of)
    made = kept(place) if place is not None else None
    if made is None:
        made = _made(path, choice)
        if place is not None:
            keep(place, made)
    for line in made.doubts:
        log.warning("%s", line)
    return made.catalog


def _made(path: Path, choice: Choice) -> Kept:
    found = assemble(path, read_table(path), choice.epoch_jyear, choice.with_hipparcos)
    doubts = [found.line] if found.dropped else []
    if not choice.with_hipparcos:
        return Kept(_by_cell(found.catalog, found.line), tuple(doubts))
    joined = join(load_catalog(), found.catalog)
    if joined.doubt is not None:
        doubts.append(f"{path.name}: {joined.doubt}")
    return Kept(_by_cell(joined.catalog, found.line, joined.line), tuple(doubts))


def _by_cell(catalog: Catalog, *notes: str) -> Catalog:
    """The same stars, neighbours together: a bench that sorts them by cell then reads each array from its start to its end."""
    return replace(catalog.taken(cell_grid(unit_vectors_icrs(catalog, GAIA_DR3_JYEAR)).order), notes=notes)


def _is_hip_main(path: Path) -> bool:
    with open_regular(path, WANTED, MAX_TABLE_BYTES) as file:
        return file.read(2) == b"H|"


def _packaged_sha256() -> str:
    return hashlib.sha256(PACKAGED_CATALOG.read_bytes()).hexdigest()
