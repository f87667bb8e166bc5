"""The bench file of a run: read once, so that the whole run uses the bytes that were checked."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from hilstar.bench.config import GEOCENTRE, SOURCE, BenchConfig, config_of, parse_config
from hilstar.bench.config.when import UNIX, today, with_dates
from hilstar.errors import InputError
from hilstar.monitor.calibration import BUILT_IN
from hilstar.reading import MAX_TOML_BYTES, read_bytes, read_text
from hilstar.sky.spectrum import BUILT_IN_CURVES
from hilstar.sky.star_table import file_sha256

MAX_NAMED_BYTES = 100_000_000


@dataclass(frozen=True, slots=True)
class BenchFile:
    """A bench file at the moment it was read: its text, and the checked configuration in that text.

    `sha256` covers everything that makes the bench's frames: its settings, defaults included, and the files it names.
    """

    path: Path
    text: str
    config: BenchConfig
    sha256: str

    @property
    def folder(self) -> Path:
        """The folder to which the paths in the file are relative."""
        return self.path.parent


def read_bench_file(path: Path) -> BenchFile:
    """Read and check a bench file. Raises InputError: file, key, what is wrong and what to write."""
    return bench_file_of(path, read_text(path, "give the path of a bench file", MAX_TOML_BYTES))


def bench_file_of(path: Path, text: str) -> BenchFile:
    """The bench file that `path` would be with this text. Raises InputError as `read_bench_file` does."""
    config = parse_config(path, text)
    return BenchFile(path, text, today(config), _sha256(config, path.parent))


def changed_file(file: BenchFile, tables: dict[str, Any]) -> BenchFile:
    """The file as it would be with these tables, as TOML gives them. Raises InputError as `read_bench_file` does.

    Its text stays that of `file`; its hash is that of a bench file with these tables.
    """
    config = config_of(file.path, tables)
    return replace(file, config=config, sha256=_sha256(config, file.folder))


def dated(file: BenchFile, scale: str | None, first_ns: int) -> BenchFile:
    """The file for a source whose first time is `first_ns` of a time scale. Raises InputError (see `with_dates`)."""
    try:
        return replace(file, config=with_dates(file.config, scale, first_ns))
    except InputError as error:
        raise InputError(f"{file.path}: {error}") from error


def at_moment(file: BenchFile, t_ns: int | None) -> BenchFile:
    """The file for a moment that a person names: its stars are those of that day where t_ns counts from 1970."""
    return file if t_ns is None or file.config.sky.epoch_utc != UNIX else dated(file, None, t_ns)


def _sha256(config: BenchConfig, folder: Path) -> str:
    digest = hashlib.sha256(msgspec.json.encode(config, order="sorted"))
    tracker = config.tracker
    curves = (tracker.quantum_efficiency, tracker.transmission)
    files = (config.monitor.calibration, config.collimator.geometry, tracker.distortion)
    true = (config.verify.true_calibration, config.verify.true_geometry)
    orbit = None if config.spacecraft.orbit in {GEOCENTRE, SOURCE} else config.spacecraft.orbit
    bodies = config.sky.bodies
    named: tuple[str | float | None, ...] = (*curves, *files, *true, orbit, bodies.satellites, bodies.satellite_magnitudes)
    for name in named:
        if isinstance(name, str) and name not in (*BUILT_IN_CURVES, *BUILT_IN, "hipparcos"):
            digest.update(_named_bytes(folder / name))
    if config.sky.catalogue != "hipparcos":
        digest.update(_catalogue_bytes(folder / config.sky.catalogue))
    return digest.hexdigest()


def _catalogue_bytes(path: Path) -> bytes:
    """The SHA-256 of a catalogue's file, which may be large; nothing where it cannot be read."""
    try:
        return file_sha256(path, "").encode()
    except InputError:
        return b""


def _named_bytes(path: Path) -> bytes:
    """The content of a file that the bench file names; empty where it cannot be read, which its own reader explains better."""
    try:
        return read_bytes(path, "", MAX_NAMED_BYTES)
    except InputError:
        return b""
