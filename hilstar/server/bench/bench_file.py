"""The bench file of a run: read once, so that the whole run uses the bytes that were checked; and
one key of it set.

A file may also name several bench files, one for each head of an attitude determination unit:

    heads = ["a.toml", "b.toml"]
    [attitude]
    endpoint = "tcp://127.0.0.1:5560"

The source's attitude is the body's, whatever its `convention` is otherwise; each head's
`[tracker] q_body_to_cam` makes it its camera's. `[attitude]` holds for all heads, in place of their
own.
"""

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from hilstar.attitude.wire.source import HILSTARS, Mounting
from hilstar.basics.errors import InputError, did_you_mean, shortened
from hilstar.basics.files import place_of
from hilstar.basics.reading import MAX_TOML_BYTES, named_bytes, parse_toml, read_text
from hilstar.basics.toml_tables import toml_text
from hilstar.display.calibration import BUILT_IN
from hilstar.server.bench.config import (
    GAUSSIAN,
    GEOCENTRE,
    SOURCE,
    AttitudeSettings,
    BenchConfig,
    config_of,
    parse_config,
)
from hilstar.server.bench.config.bench_config import HEADS, UNIX, today, with_dates
from hilstar.server.bench.config.render import (
    DEFAULT_TOLERANCE_MAG,
    DEFAULT_TOLERANCE_PX,
    HASHED_TOLERANCE,
    RenderSettings,
)
from hilstar.sky.spectrum import BUILT_IN_CURVES
from hilstar.sky.star_table import file_sha256

if TYPE_CHECKING:
    from hilstar.attitude.logs.entries import Stated

MAX_NAMED_BYTES = 100_000_000
MIN_HEADS, MAX_HEADS = 2, 8
CHANGE_NO_FRAME = ("certify", "alignment")  # tables of what is said of a bench
EXAMPLE = 'write heads = ["a.toml", "b.toml"], a bench file for each'


@dataclass(frozen=True, slots=True)
class BenchFile:
    """A bench file at the moment it was read: its text, and the checked configuration in that text.

    `sha256` covers everything that makes the bench's frames: its settings, defaults included, and
    the files it names.
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
    """Read and check a bench file. Raises InputError: file, key, what is wrong and what to
    write.
    """
    return bench_file_of(path, read_text(path, "give the path of a bench file", MAX_TOML_BYTES))


def bench_file_of(path: Path, text: str) -> BenchFile:
    """The bench file that `path` would be with this text. Raises InputError as `read_bench_file`
    does.
    """
    config = parse_config(path, text)
    return BenchFile(path, text, today(config), _sha256(config, path.parent))


def file_of_tables(path: Path, tables: Mapping[str, Any] | BenchConfig) -> BenchFile:
    """The bench file that `path` would be with these tables, or with a configuration's; nothing is
    written. Raises InputError as `read_bench_file` does.
    """
    given = tables if isinstance(tables, Mapping) else msgspec.to_builtins(tables)
    try:
        return bench_file_of(path, toml_text(given))
    except TypeError as error:
        raise InputError(f"{path}: {error}") from error


def changed_file(file: BenchFile, tables: dict[str, Any]) -> BenchFile:
    """The file as it would be with these tables, as TOML gives them. Raises InputError as
    `read_bench_file` does.

    Its text stays that of `file`; its hash is that of a bench file with these tables.
    """
    config = config_of(file.path, tables)
    return replace(file, config=config, sha256=_sha256(config, file.folder))


def dated(file: BenchFile, scale: str | None, first_ns: int) -> BenchFile:
    """The file for a source whose first time is `first_ns` of a time scale. Raises InputError
    (see `with_dates`).
    """
    try:
        return replace(file, config=with_dates(file.config, scale, first_ns))
    except InputError as error:
        raise InputError(f"{file.path}: {error}") from error


def with_codes_ms(file: BenchFile, codes_ms: tuple[float, float] | None) -> BenchFile:
    """The file for frames of a run that measured what codes cost: it chooses as that run did.
    The hash stays that of `file`.
    """
    if codes_ms is None or file.config.render.codes_ms is not None:
        return file
    render = msgspec.structs.replace(file.config.render, codes_ms=codes_ms)
    return replace(file, config=msgspec.structs.replace(file.config, render=render))


def at_moment(file: BenchFile, t_ns: int | None) -> BenchFile:
    """The file for a moment that a person names: its stars are those of that day where t_ns
    counts from 1970.
    """
    if t_ns is None or file.config.sky.epoch_utc != UNIX:
        return file
    return dated(file, None, t_ns)


def stated_in(config: BenchConfig) -> "Stated":
    """What a bench file states of a log that is read with it: the mounting and, if it is not
    hilstar's, the convention.
    """
    from hilstar.attitude.logs.entries import Stated

    if config.attitude.convention == HILSTARS:
        convention = None
    else:
        convention = config.attitude.convention
    return Stated(
        Mounting(config.tracker.q_body_to_cam),
        convention=convention,
        convention_by="[attitude] convention",
    )


def _sha256(config: BenchConfig, folder: Path) -> str:
    kept = msgspec.to_builtins(config)
    for table in CHANGE_NO_FRAME:
        del kept[table]
    kept["render"] |= _hashed_tolerance(config.render)
    del kept["tracker"]["camera"]  # how images are taken; it changes no frame either
    del kept["tracker"]["sensor"]  # its figures stand under their own keys
    digest = hashlib.sha256(msgspec.json.encode(kept, order="sorted"))
    tracker = config.tracker
    curves = (*tracker.quantum_efficiencies.values(), tracker.transmission)
    files = (
        config.monitor.calibration,
        config.monitor.primaries.file,
        config.collimator.geometry,
        tracker.distortion,
        tracker.optics.psf,
    )
    true = (config.verify.true_calibration, config.verify.true_geometry)
    orbit = None if config.spacecraft.orbit in {GEOCENTRE, SOURCE} else config.spacecraft.orbit
    bodies = config.sky.bodies
    air = () if config.site is None else (config.site.extinction, config.site.sky_spectrum)
    sky = (orbit, bodies.satellites, bodies.satellite_magnitudes, *air)
    named: tuple[str | float | None, ...] = (*curves, *files, *true, *sky)
    for name in named:
        if isinstance(name, str) and name not in (
            *BUILT_IN_CURVES,
            *BUILT_IN,
            "hipparcos",
            GAUSSIAN,
        ):
            with suppress(InputError):  # its own reader explains better why a file cannot be read
                digest.update(named_bytes(folder / name, "", MAX_NAMED_BYTES))
    for large in (config.sky.catalogue, config.sky.diffuse.map):
        if large not in ("hipparcos", None):
            with suppress(InputError):
                digest.update(file_sha256(folder / large, "").encode())
    return digest.hexdigest()


def _hashed_tolerance(render: RenderSettings) -> dict[str, float]:
    """The tolerance as the hash has it: its default changes no frame of a bench that leaves
    nothing to it.
    """
    if render.effort == "auto" or render.quantisation == "auto" or render.psf != GAUSSIAN:
        return {}
    defaults = {"tolerance_mag": DEFAULT_TOLERANCE_MAG, "tolerance_px": DEFAULT_TOLERANCE_PX}
    return {
        key: HASHED_TOLERANCE
        for key, default in defaults.items()
        if getattr(render, key) == default
    }


@dataclass(frozen=True, slots=True)
class HeadsFile:
    """A file with `heads`: each head's name, that of its bench file, and its bench, with the
    common source's settings.
    """

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
    """A bench file, or a file with `heads`, opened once. Raises InputError as `read_bench_file`
    and `read_heads` do.
    """
    text = read_text(path, "give the path of a bench file", MAX_TOML_BYTES)
    tables = parse_toml(path, text)
    if HEADS in tables:
        return _heads_of(path, tables)
    return bench_file_of(path, text)


def _tables(path: Path) -> dict[str, Any]:
    return parse_toml(path, read_text(path, "give the path of a bench file", MAX_TOML_BYTES))


def read_heads(path: Path) -> HeadsFile:
    """Read and check a file with `heads` and the bench files it names. Raises InputError: file,
    key, what to write instead.
    """
    return _heads_of(path, _tables(path))


def _heads_of(path: Path, tables: dict[str, Any]) -> HeadsFile:
    other = sorted(set(tables) - {HEADS, "attitude"})
    if other:
        meant = did_you_mean(other[0], ["attitude"])
        raise InputError(
            f"{path}: {shortened(other[0])}: {meant}beside heads stands only [attitude]; write it"
            " in the heads' own files"
        )
    listed = tables.get(HEADS)
    if not isinstance(listed, list) or not all(isinstance(name, str) and name for name in listed):
        raise InputError(f"{path}: heads = {shortened(repr(listed))}: no list of files; {EXAMPLE}")
    if not MIN_HEADS <= len(listed) <= MAX_HEADS:
        raise InputError(
            f"{path}: heads names {len(listed)} files; {EXAMPLE}, from {MIN_HEADS} to {MAX_HEADS}"
        )
    paths = [path.parent / name for name in listed]
    names = tuple(head.stem for head in paths)
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice is not None:
        raise InputError(f"{path}: heads: two are called {twice}; give each a file of its own name")
    files = tuple(_head(head, tables.get("attitude", {})) for head in paths)
    # Two names of one file, by a link, would show one bench twice and write over each other's
    # ledger.
    places = [place_of(head) for head in paths]
    for k, place in enumerate(places):
        if place in places[:k]:
            first = paths[places.index(place)]
            raise InputError(
                f"{path}: heads: {paths[k].name} is the same file as {first.name}; give each a file"
                " of its own"
            )
    if files[0].config.attitude.lockstep:
        raise InputError(
            f"{path}: [attitude] lockstep = true: several heads follow a stream that runs freely;"
            " take it out"
        )
    return HeadsFile(path, names, files)


def _head(head: Path, attitude: dict[str, Any]) -> BenchFile:
    file = read_bench_file(head)
    file = changed_file(file, parse_toml(head, file.text) | {"attitude": attitude})
    source = file.config.attitude
    if source.convention.frame == "body":
        return file
    stated = attitude.get("convention")
    if isinstance(stated, dict) and "frame" in stated:
        raise InputError(
            f'{head}: [attitude] convention = {{ frame = "cam" }}: several heads have one source,'
            ' the attitude of the body; write frame = "body", or leave it out'
        )
    convention = msgspec.structs.replace(source.convention, frame="body")
    config = msgspec.structs.replace(
        file.config, attitude=msgspec.structs.replace(source, convention=convention)
    )
    return replace(file, config=config)


def as_head(head: Path, heads: Path) -> BenchFile:
    """A head's bench file with the common source of the file `heads`. Raises InputError as
    `read_heads` does.
    """
    return _head(head, _tables(heads).get("attitude", {}))


def with_key(
    text: str,
    table: str,
    key: str,
    value: float | str | bool | Sequence[float],
    instead_of: tuple[str, ...] = (),
) -> str:
    """TOML `text` with `key` of a plain `[table]` set: its line replaced, or that of a key in
    `instead_of`, or one added.

    Where the table is written in another TOML form, the result means something else: parse it again
    to see.
    """
    # JSON and TOML write numbers, truth values and plain text alike
    line = f"{key} = {json.dumps(value)}"
    header = re.search(rf"^[ \t]*\[{table}\][^\n]*\n?", text, re.MULTILINE)
    if header is None:
        return f"{text.rstrip()}\n\n[{table}]\n{line}\n".lstrip()
    following = re.search(r"^[ \t]*\[", text[header.end() :], re.MULTILINE)
    if following:
        end = header.end() + following.start()
    else:
        end = len(text)
    names = "|".join((key, *instead_of))
    there = re.compile(rf"^([ \t]*)(?:{names})[ \t]*=[^\n#]*?([ \t]*#[^\n]*)?$", re.MULTILINE)
    body, count = there.subn(rf"\g<1>{line}\g<2>", text[header.end() : end], count=1)
    head = text[: header.end()].removesuffix("\n") + "\n"
    return head + (body if count else f"{line}\n{body}") + text[end:]
