"""Several heads of one attitude determination unit beside one source: a file that names a bench file for each.

    heads = ["a.toml", "b.toml"]
    [attitude]
    endpoint = "tcp://127.0.0.1:5560"

The source's attitude is the body's; each head's `[tracker] q_body_to_cam` makes it its camera's. `[attitude]` holds for all
heads, in place of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilstar.bench.bench_file import BenchFile, bench_file_of, changed_file, read_bench_file
from hilstar.bench.config import AttitudeSettings
from hilstar.bench.config.read import HEADS
from hilstar.errors import InputError, did_you_mean, shortened
from hilstar.files import place_of
from hilstar.reading import MAX_TOML_BYTES, parse_toml, read_text

MIN_HEADS, MAX_HEADS = 2, 8
EXAMPLE = 'write heads = ["a.toml", "b.toml"], a bench file for each'


@dataclass(frozen=True, slots=True)
class HeadsFile:
    """A file with `heads`: each head's name, that of its bench file, and its bench, with the common source's settings."""

    path: Path
    names: tuple[str, ...]
    files: tuple[BenchFile, ...]

    @property
    def attitude(self) -> AttitudeSettings:
        """The common source."""
        return self.files[0].config.attitude

    @property
    def folder(self) -> Path:
        """The folder to which the source's paths are relative."""
        return self.path.parent


def read_bench_or_heads(path: Path) -> BenchFile | HeadsFile:
    """A bench file, or a file with `heads`, opened once. Raises InputError as `read_bench_file` and `read_heads` do."""
    text = read_text(path, "give the path of a bench file", MAX_TOML_BYTES)
    tables = parse_toml(path, text)
    return _heads_of(path, tables) if HEADS in tables else bench_file_of(path, text)


def _tables(path: Path) -> dict[str, Any]:
    return parse_toml(path, read_text(path, "give the path of a bench file", MAX_TOML_BYTES))


def read_heads(path: Path) -> HeadsFile:
    """Read and check a file with `heads` and the bench files it names. Raises InputError: file, key, what to write instead."""
    return _heads_of(path, _tables(path))


def _heads_of(path: Path, tables: dict[str, Any]) -> HeadsFile:
    other = sorted(set(tables) - {HEADS, "attitude"})
    if other:
        meant = did_you_mean(other[0], ["attitude"])
        raise InputError(
            f"{path}: {shortened(other[0])}: {meant}beside heads stands only [attitude]; write it in the heads' own files"
        )
    listed = tables.get(HEADS)
    if not isinstance(listed, list) or not all(isinstance(name, str) and name for name in listed):
        raise InputError(f"{path}: heads = {shortened(repr(listed))}: no list of files; {EXAMPLE}")
    if not MIN_HEADS <= len(listed) <= MAX_HEADS:
        raise InputError(f"{path}: heads names {len(listed)} files; {EXAMPLE}, from {MIN_HEADS} to {MAX_HEADS}")
    paths = [path.parent / name for name in listed]
    names = tuple(head.stem for head in paths)
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice is not None:
        raise InputError(f"{path}: heads: two are called {twice}; give each a file of its own name")
    files = tuple(_head(head, tables.get("attitude", {})) for head in paths)
    _refuse_one_twice(path, paths)
    if files[0].config.attitude.lockstep:
        raise InputError(f"{path}: [attitude] lockstep = true: several heads follow a stream that runs freely; take it out")
    return HeadsFile(path, names, files)


def _refuse_one_twice(path: Path, heads: list[Path]) -> None:
    """Two names of one file, by a link, would show one bench twice and write over each other's ledger."""
    places = [place_of(head) for head in heads]
    for k, place in enumerate(places):
        if place in places[:k]:
            first = heads[places.index(place)]
            raise InputError(f"{path}: heads: {heads[k].name} is the same file as {first.name}; give each a file of its own")


def _head(head: Path, attitude: dict[str, Any]) -> BenchFile:
    file = read_bench_file(head)
    return changed_file(file, parse_toml(head, file.text) | {"attitude": attitude})


def as_head(head: Path, heads: Path) -> BenchFile:
    """A head's bench file with the common source of the file `heads`. Raises InputError as `read_heads` does."""
    return _head(head, _tables(heads).get("attitude", {}))
