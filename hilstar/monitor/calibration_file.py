"""The files of a calibration: TOML and CSV, read, checked and written. Described in configs/CALIBRATION.md."""

from __future__ import annotations

import csv
import datetime
import json
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import msgspec
import numpy as np
from msgspec import Meta

from hilstar.arrays import FloatArray
from hilstar.errors import InputError, shortened
from hilstar.files import write_whole
from hilstar.reading import MAX_TOML_BYTES, as_text, exists, parse_toml, read_bytes, read_text
from hilstar.toml_tables import Kind, Table, explained

BLACKS_AGREE = 0.1  # relative: the three channels' code 0 is one and the same black screen
MAX_TABLE_BYTES = 10_000_000
ADVICE = "see configs/CALIBRATION.md"
GREY, PRIMARIES = ("w",), ("r", "g", "b")
TYPE_WORDS = {"float": "a number", "int": "a whole number", "str": "text", "object": "a table"}
Share = Annotated[float, Meta(ge=0, le=1e12)]


class Digest(Protocol):
    """What hashlib gives."""

    def update(self, data: bytes, /) -> None:
        """Take more bytes."""

    def hexdigest(self) -> str:
        """The hash so far."""


class Head(Table, frozen=True):
    """[calibration]: who measured what."""

    kind: Literal["photometric"]
    who: str
    when: str
    instrument: str
    unit: str
    bits: Annotated[int, Meta(ge=1, le=16)]
    response: str


class WeightsTable(Table, frozen=True):
    """[weights]: the primaries as the tracker sees them, any scale."""

    r: Share
    g: Share
    b: Share


class UniformityTable(Table, frozen=True):
    """[uniformity]: where the grid of relative light is."""

    file: str


class NoiseTable(Table, frozen=True):
    """[noise]: how well a patch repeats."""

    relative: Annotated[float, Meta(ge=0, le=1)]


class NotesTable(Table, frozen=True):
    """[notes]: free text."""

    warm_up: str = ""
    drift: str = ""
    text: str = ""


class CalibrationFile(Table, frozen=True):
    """A whole calibration file."""

    calibration: Head
    weights: WeightsTable | None = None
    uniformity: UniformityTable | None = None
    noise: NoiseTable | None = None
    notes: NotesTable = msgspec.field(default_factory=NotesTable)


KIND = Kind(CalibrationFile, "configs/CALIBRATION.md", TYPE_WORDS)


def _read(path: Path, digest: Digest, limit_bytes: int = MAX_TABLE_BYTES) -> str:
    raw = read_bytes(path, ADVICE, limit_bytes)
    digest.update(raw)
    return as_text(path, raw, ADVICE)


def beside(path: Path, name: str, key: str) -> Path:
    """The path of a file that `path` names, relative to it. Raises InputError where there is none."""
    other = path.parent / name
    if not exists(other):
        raise InputError(f"{path}: {key} = {shortened(json.dumps(name))}; there is no such file beside it")
    return other


def read_toml(path: Path, digest: Digest) -> CalibrationFile:
    """Read and check a calibration file. Raises InputError: file, key, what is wrong and what to write."""
    tables = parse_toml(path, _read(path, digest, MAX_TOML_BYTES))
    head = tables.get("calibration")
    if isinstance(head, dict) and isinstance(head.get("when"), datetime.date):  # TOML has dates of its own
        head["when"] = str(head["when"])
    try:
        return msgspec.convert(tables, CalibrationFile)
    except (msgspec.ValidationError, RecursionError) as error:
        raise InputError(f"{path}: {explained(str(error), tables, KIND)}") from error


def _numbers(path: Path, lines: list[tuple[int, str]], columns: int) -> FloatArray:
    """Rows of finite, non-negative numbers, all of the same length."""
    rows = []
    for number, line in lines:
        try:
            row = [float(cell) for cell in next(csv.reader([line]))]
        except (ValueError, csv.Error) as error:
            raise InputError(f"{path}: line {number}: {line.strip()[:40]!r} is no row of numbers") from error
        if len(row) != columns:
            raise InputError(f"{path}: line {number}: {len(row)} cells; write {columns}")
        if not all(0 <= cell < 1e30 for cell in row):
            raise InputError(f"{path}: line {number}: {line.strip()[:40]!r}; write finite numbers that are not negative")
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: no row of numbers in it")
    return np.array(rows, dtype=np.float64)


def _lines(text: str) -> list[tuple[int, str]]:
    numbered = enumerate(text.splitlines(), start=1)
    return [(number, line) for number, line in numbered if line.strip() and not line.lstrip().startswith("#")]


def read_response(path: Path, bits: int, digest: Digest) -> dict[str, FloatArray]:
    """Light (2^bits,) of each channel, black level included: every code, or some of them and the curve between.

    Raises InputError for a table without code 0 or white, with equal or falling neighbours, or with blacks that disagree.
    """
    lines = _lines(_read(path, digest))
    header = tuple(cell.strip() for cell in lines[0][1].split(",")) if lines else ()
    if header not in (("code", *GREY), ("code", *PRIMARIES)):
        raise InputError(f"{path}: its header is {','.join(header)[:60]!r}; write code,w or code,r,g,b")
    rows = _numbers(path, lines[1:], len(header))
    code, white = rows[:, 0], 2**bits - 1
    if np.any(code != np.rint(code)) or np.any(np.diff(code) <= 0):
        raise InputError(f"{path}: its codes are not whole numbers that rise; sort the rows, one to a code")
    if len(code) < 2 or code[0] != 0 or code[-1] != white:
        raise InputError(
            f"{path}: its codes are {code[0]:g} to {code[-1]:g}; write 0 (black) to {white} (white of {bits} bits)"
        )
    columns = {name: _every_code(path, name, code, rows[:, place + 1], white) for place, name in enumerate(header[1:])}
    blacks = rows[0, 1:]
    if np.ptp(blacks) > BLACKS_AGREE * blacks.mean():
        raise InputError(
            f"{path}: code 0 has {', '.join(f'{b:g}' for b in blacks)}; all show one black screen, so write one light"
        )
    return columns


def _every_code(path: Path, name: str, code: FloatArray, light: FloatArray, white: int) -> FloatArray:
    """Light at codes 0 to `white`: between rows, PCHIP of log light above black over log code; below the first, a power law."""
    fall = np.flatnonzero(np.diff(light) <= 0)
    if len(fall):
        low, high = code[fall[0]], code[fall[0] + 1]
        raise InputError(
            f"{path}: light of channel {name} does not rise from code {low:g} to code {high:g}; every code must be brighter"
        )
    if len(code) == white + 1:
        return light
    if len(code) < 3:
        raise InputError(f"{path}: two codes make no response; give some between black and white")
    log_code, log_light = np.log(code[1:]), np.log(light[1:] - light[0])
    from scipy.interpolate import PchipInterpolator  # a quarter of a second of every command that has no such file

    curve = PchipInterpolator(log_code, log_light)
    wanted = np.log(np.arange(1, white + 1))
    slope = (log_light[1] - log_light[0]) / (log_code[1] - log_code[0])
    below = log_light[0] + slope * (wanted - log_code[0])
    return np.append(light[0], light[0] + np.exp(np.where(wanted < log_code[0], below, curve(np.maximum(wanted, log_code[0])))))


def read_grid(path: Path, digest: Digest) -> FloatArray:
    """A grid of relative light (rows, columns), rows from top to bottom, all positive. Raises InputError."""
    lines = _lines(_read(path, digest))
    grid = _numbers(path, lines, lines[0][1].count(",") + 1 if lines else 1)
    if not grid.min() > 0:
        raise InputError(f"{path}: a field of the screen has no light; every value must be more than 0")
    return grid


def write_calibration(
    path: Path,
    head: Head,
    columns: dict[str, FloatArray],
    noise: float,
    notes: NotesTable,
    weights: WeightsTable | None = None,
) -> Path:
    """Write the TOML and, beside it, the response it names; the CSV's path. Raises InputError where they cannot be written."""
    table = path.parent / head.response
    codes = np.arange(len(next(iter(columns.values()))))
    rows = "".join(",".join([str(code), *(f"{float(light[code])!r}" for light in columns.values())]) + "\n" for code in codes)
    comment = f"# light in {head.unit or 'one linear unit'}, black level (code 0) included\n".encode(
        "ascii", "replace"
    ).decode()
    lines = ["[calibration]", *_keys(msgspec.structs.asdict(head)), ""]
    if weights is not None:
        lines += ["[weights]", *(f"{name} = {share!r}" for name, share in msgspec.structs.asdict(weights).items()), ""]
    lines += ["[noise]", f"relative = {noise:.6g}", "", "[notes]", *_keys(msgspec.structs.asdict(notes))]
    write_whole(table, comment + ",".join(["code", *columns]) + "\n" + rows)
    write_whole(path, "\n".join(lines) + "\n")
    return table


def add_uniformity(path: Path, grid: FloatArray) -> Path:
    """Give a calibration file that has none a grid of relative light (rows, columns), rows from the top; the grid's CSV.

    Raises InputError where it cannot be written.
    """
    table = path.with_name(f"{path.stem}-uniformity.csv")
    write_whole(table, "".join(",".join(f"{value!r}" for value in row) + "\n" for row in grid.tolist()))
    text = read_text(path, ADVICE, MAX_TOML_BYTES)
    write_whole(path, f"{text}\n[uniformity]\nfile = {json.dumps(table.name)}\n")
    return table


def _keys(table: dict[str, Any]) -> list[str]:
    return [f"{key} = {json.dumps(value if isinstance(value, int) else str(value))}" for key, value in table.items()]
