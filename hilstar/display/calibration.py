"""A monitor's light: response, uniformity and noise, where they come from, and the files that hold
them.

configs/CALIBRATION.md describes the files (TOML and CSV).
"""

import datetime
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from hilstar.basics.arrays import Float32Array, FloatArray
from hilstar.basics.errors import InputError, did_you_mean, shortened
from hilstar.basics.files import write_whole
from hilstar.basics.reading import (
    MAX_TOML_BYTES,
    as_text,
    exists,
    named_bytes,
    parse_toml,
    read_text,
)
from hilstar.basics.text_tables import Chosen, TextTable, finite_numbers, needed, table_of
from hilstar.basics.toml_tables import Kind, Table, explained, toml_text
from hilstar.display import response as responses
from hilstar.display.identity import TABLE, MonitorIdentity

FORMULAS = ("srgb", "gamma2.2")
BUILT_IN = (*FORMULAS, "lcd-example")
EXAMPLE = Path(__file__).resolve().parent / "data" / "lcd-example.toml"
BLACKS_AGREE = 0.1  # relative: the three channels' code 0 is one and the same black screen
MAX_TABLE_BYTES = 10_000_000
ADVICE = "see configs/CALIBRATION.md"
GREY, PRIMARIES = ("w",), ("r", "g", "b")
TYPE_WORDS = {"float": "a number", "int": "a whole number", "str": "text", "object": "a table"}
Share = Annotated[float, Meta(ge=0, le=1e12)]
# a photometer's, of the sRGB primaries (IEC 61966-2-1)
REC709_WEIGHTS: responses.Weights = (0.2126, 0.7152, 0.0722)


@dataclass(frozen=True, slots=True)
class Calibration:
    """A monitor's light, and where that knowledge comes from.

    `uniformity` is a coarse grid (rows, columns) of relative light, rows from top to bottom, each
    value at the middle of its equal share of the screen; None where the light is the same
    everywhere. `noise` is the relative repeatability of a patch. `weights` are the shares of the
    primaries in white as the tracker sees them, of sum 1; None where they are not known. `black` of
    the response is that of the whole screen. `sha256` covers the bytes of every file that was read.
    """

    name: str
    response: responses.Response
    sha256: str
    uniformity: FloatArray | None = None
    uniformity_relative: float | None = None  # standard error of a field
    noise: float = 0.0
    weights: responses.Weights | None = None
    who: str = ""
    when: str = ""
    instrument: str = ""
    unit: str = "relative"
    notes: dict[str, str] = field(default_factory=dict)

    @property
    def can_steal_bits(self) -> bool:
        """Whether `load_calibration` would take it with `bit_stealing`."""
        levels = (2**self.response.bits - 1) * responses.TRIPLES + 1
        return self.weights is not None and levels <= responses.MAX_LEVELS

    @property
    def is_formula(self) -> bool:
        """Whether it exists for any number of bits."""
        return self.name in FORMULAS

    def uniformity_map(self, resolution_px: tuple[int, int]) -> Float32Array | None:
        """Relative light of each pixel (height, width), 1 at the brightest; None where it is the
        same everywhere.

        Bilinear between the centres of the grid's fields, extrapolated by the same slope to the
        edges of the screen.
        """
        if self.uniformity is None:
            return None
        width, height = resolution_px
        grid_rows, grid_columns = self.uniformity.shape
        rows = weights_of_grid(height, grid_rows)
        columns = weights_of_grid(width, grid_columns)
        light = rows @ self.uniformity @ columns.T
        smallest = float(self.uniformity.min()) / 2  # an extrapolated slope must not go below zero
        np.maximum(light, smallest, out=light)
        light /= light.max()
        return light.astype(np.float32)


def weights_of_grid(pixels: int, fields: int) -> FloatArray:
    """The weight of each of a grid's fields in each pixel along one axis, (pixels, fields)."""
    if fields == 1:
        return np.ones((pixels, 1))
    pixel = np.arange(pixels)
    place = (pixel + 0.5) * fields / pixels - 0.5
    lower_node = np.clip(np.floor(place).astype(np.intp), 0, fields - 2)
    part = place - lower_node
    weights = np.zeros((pixels, fields))
    weights[pixel, lower_node] = 1 - part
    weights[pixel, lower_node + 1] = part
    return weights


def load_calibration(source: str | Path, bits: int, *, bit_stealing: bool = False) -> Calibration:
    """The calibration of a built-in name ("srgb", "gamma2.2", "lcd-example") or of a file, for a
    monitor of `bits`.

    With `bit_stealing` its levels are triples of codes between the greys. Raises InputError for a
    malformed file, for
    other bits than the file's, and for bit stealing where the weights of the primaries are not
    known.
    """
    name = str(source)
    if name in FORMULAS:
        grey = _formula(name, bits)
        if bit_stealing:
            response = responses.bit_stealing_response((grey, grey, grey), REC709_WEIGHTS)
        else:
            response = grey
        digest = hashlib.sha256(f"hilstar built-in {name}, {bits} bits".encode()).hexdigest()
        return Calibration(
            name, response, digest, weights=REC709_WEIGHTS, instrument="none: a formula"
        )
    path = _path_of(source)
    meant = did_you_mean(name, BUILT_IN)
    if not exists(path) and (meant or not path.suffix):
        raise InputError(
            f"calibration = {shortened(json.dumps(name))}: no such built-in or file; {meant}write "
            f"{', '.join(BUILT_IN)} or FILE.toml"
        )
    read: list[bytes] = []
    file = read_toml(path, read)
    head = file.calibration
    if head.bits != bits:
        raise InputError(
            f"{path}: [calibration] bits = {head.bits}, but the monitor has {bits}; calibrate at"
            f" {bits} bits"
        )
    columns = read_response(_response_path(path, head), bits, read)
    uniformity = None
    uniformity_relative = None
    if file.uniformity is not None:
        grid_path = beside(path, file.uniformity.file, "[uniformity] file")
        uniformity = read_grid(grid_path, read)
        uniformity_relative = file.uniformity.relative
    weights = None
    if file.weights is not None:
        weights = file.weights.r, file.weights.g, file.weights.b
    response, shares = _response(path, bits, columns, weights, bit_stealing)
    return Calibration(
        name=name if name == "lcd-example" else path.name,
        response=response,
        sha256=hashlib.sha256(b"".join(read)).hexdigest(),
        uniformity=uniformity,
        uniformity_relative=uniformity_relative,
        noise=file.noise.relative if file.noise else 0.0,
        weights=shares,
        who=head.who,
        when=head.when,
        instrument=head.instrument,
        unit=head.unit,
        notes=file.notes.stated(),
    )


def _formula(name: str, bits: int) -> responses.Response:
    if name == "srgb":
        return responses.srgb_response(bits)
    return responses.gamma_response(bits)


def _path_of(source: str | Path) -> Path:
    if str(source) == "lcd-example":
        return EXAMPLE
    return Path(source)


def primary_lights(source: str | Path, bits: int) -> FloatArray:
    """Light above black of each primary by its code (3, 2^bits), relative to white as the tracker
    sees it.

    Raises InputError as `load_calibration` does with bit stealing.
    """
    if str(source) in FORMULAS:
        return np.outer(REC709_WEIGHTS, _formula(str(source), bits).light)
    path = _path_of(source)
    file = read_toml(path)
    columns = read_response(_response_path(path, file.calibration), bits)
    if "r" in columns:
        measured = [columns[name] for name in PRIMARIES]
    else:
        measured = [columns["w"]] * 3
    light = np.stack(measured)
    above = light - light[:, :1]
    whites = above[:, -1:]
    if file.weights is not None:
        shares = np.array([file.weights.r, file.weights.g, file.weights.b])
        return np.asarray(above / whites * (shares / shares.sum())[:, None])
    if "r" not in columns:
        raise InputError(
            f"{path}: the primaries as the tracker sees them are not known; add [weights] r, g, b"
        )
    return np.asarray(above / whites.sum())


def primary_responses(source: str | Path, bits: int) -> tuple[responses.Response, ...]:
    """The response of each primary, relative to its own white: a calibration's columns r, g and b,
    or its grey one for all.

    Raises InputError as `load_calibration` does.
    """
    if str(source) in FORMULAS:
        return (_formula(str(source), bits),) * 3
    path = _path_of(source)
    columns = read_response(_response_path(path, read_toml(path).calibration), bits)
    tables = []
    for light in columns.values():
        above = light - light[0]
        tables.append(responses.table_response(bits, above / above[-1]))
    if len(tables) == 1:
        return (tables[0],) * 3
    return tuple(tables)


def with_uniformity(
    source: str | Path,
    bits: int,
    path: Path,
    grid: FloatArray | None,
    identity: MonitorIdentity | None = None,
    when: str = "",
    *,
    relative: float | None = None,
) -> tuple[Path, ...]:
    """Write a calibration's light with another grid of relative light (rows, columns), or with
    none; the files, TOML first.

    `source` is a built-in name or a file, as for `load_calibration`; `when` dates a built-in's;
    `relative` is the standard error of a field. Raises InputError.
    """
    response = f"{path.stem}.csv"
    weights = None
    noise = 0.0
    notes = NotesTable()
    errors = None
    if str(source) in FORMULAS:
        head = CalibrationHead(
            "photometric", "", when, f"none: the formula {source}", "relative", bits, response
        )
        columns = {"w": _formula(str(source), bits).light}
        weights = WeightsTable(*REC709_WEIGHTS)
    else:
        origin = _path_of(source)
        file = read_toml(origin)
        columns = read_response(_response_path(origin, file.calibration), bits)
        head = msgspec.structs.replace(file.calibration, response=response)
        weights = file.weights
        noise = file.noise.relative if file.noise else 0.0
        notes = file.notes
        identity = identity or file.monitor_identity
        errors = file.errors
    table = write_calibration(
        path, head, columns, noise, notes, weights, identity=identity, errors=errors
    )
    if grid is None:
        return (path, table)
    return (path, table, add_uniformity(path, grid, relative))


def _response(
    path: Path,
    bits: int,
    columns: dict[str, FloatArray],
    weights: responses.Weights | None,
    bit_stealing: bool,
) -> tuple[responses.Response, responses.Weights | None]:
    """A calibration's response and the primaries' shares of white, of sum 1; None where they are
    not known. Raises InputError.
    """
    whites = {name: float(light[-1] - light[0]) for name, light in columns.items()}
    if weights is None and "r" in columns:
        weights = whites["r"], whites["g"], whites["b"]
    if weights is not None:
        total = sum(weights)
        if not total > 0:
            raise InputError(
                f"{path}: [weights] r, g and b are all 0; write the primaries' shares of white"
            )
        r, g, b = weights
        weights = r / total, g / total, b / total
    elif bit_stealing:
        raise InputError(
            f"{path}: bit stealing needs the primaries as the tracker sees them; add [weights] r,"
            " g, b"
        )
    black_light = float(np.mean([light[0] for light in columns.values()]))
    black = black_light / sum(whites.values())
    tables = {
        name: responses.table_response(bits, (light - light[0]) / whites[name])
        for name, light in columns.items()
    }
    if weights is None or ("w" in tables and not bit_stealing):
        return responses.table_response(bits, tables["w"].light, black), weights
    if "w" in tables:
        by_primary = tables["w"], tables["w"], tables["w"]
    else:
        by_primary = tables["r"], tables["g"], tables["b"]
    if bit_stealing:
        response = responses.bit_stealing_response(by_primary, weights, black)
    else:
        response = responses.mixed_response(by_primary, weights, black)
    return response, weights


class CalibrationHead(Table, frozen=True):
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
    """[uniformity]: where the grid of relative light is, and the standard error of one of its
    fields.
    """

    file: str
    relative: Share | None = None


class NoiseTable(Table, frozen=True):
    """[noise]: how well a patch repeats."""

    relative: Annotated[float, Meta(ge=0, le=1)]


class ErrorsTable(Table, frozen=True):
    """[errors]: at the levels measured, by their light relative to white: measured over fitted
    light less 1, and its error.

    `black` is the error of the black level over white. `common` is that of the readings of code 0
    among the others: it is part of every level's light above black, and all that is common to them.
    Without it, it is `black`.
    """

    light: list[Annotated[float, Meta(gt=0, le=1)]]
    off: list[Annotated[float, Meta(ge=-1e6, le=1e6)]]
    relative: list[Share]
    dof: Annotated[float, Meta(gt=0, le=1e9)]
    black: Share = 0.0
    common: Share | None = None


class NotesTable(Table, frozen=True):
    """[notes]: free text."""

    warm_up: str = ""
    drift: str = ""
    text: str = ""

    def stated(self) -> dict[str, str]:
        """Those that are not empty, by key."""
        return {key: text for key, text in msgspec.structs.asdict(self).items() if text}


class CalibrationFile(Table, frozen=True):
    """A whole calibration file."""

    calibration: CalibrationHead
    weights: WeightsTable | None = None
    uniformity: UniformityTable | None = None
    noise: NoiseTable | None = None
    errors: ErrorsTable | None = None
    notes: NotesTable = msgspec.field(default_factory=NotesTable)
    monitor_identity: MonitorIdentity | None = None


def _read(path: Path, read: list[bytes] | None, limit_bytes: int = MAX_TABLE_BYTES) -> str:
    """The text of a file. Its bytes are appended to `read`, from which the calibration's hash is
    made.
    """
    raw = named_bytes(path, ADVICE, limit_bytes)
    if read is not None:
        read.append(raw)
    return as_text(path, raw, ADVICE)


def beside(path: Path, name: str, key: str) -> Path:
    """The path of a file that `path` names, relative to it. Raises InputError where there is
    none.
    """
    other = path.parent / name
    if not exists(other):
        raise InputError(
            f"{path}: {key} = {shortened(json.dumps(name))}; there is no such file beside it"
        )
    return other


def _response_path(path: Path, head: CalibrationHead) -> Path:
    """The table of a calibration file. Raises InputError where it is not there."""
    return beside(path, head.response, "[calibration] response")


def read_toml(path: Path, read: list[bytes] | None = None) -> CalibrationFile:
    """Read and check a calibration file. Raises InputError: file, key, what is wrong and what to
    write.
    """
    tables = parse_toml(path, _read(path, read, MAX_TOML_BYTES))
    head = tables.get("calibration")
    # TOML has dates of its own
    if isinstance(head, dict) and isinstance(head.get("when"), datetime.date):
        head["when"] = str(head["when"])
    try:
        return msgspec.convert(tables, CalibrationFile)
    except (msgspec.ValidationError, RecursionError) as error:
        kind = Kind(CalibrationFile, "configs/CALIBRATION.md", TYPE_WORDS)
        raise InputError(f"{path}: {explained(str(error), tables, kind)}") from error


def _table(path: Path, read: list[bytes] | None) -> TextTable:
    """A table of a calibration, whose doubtful lines are told. Its bytes are appended to `read`."""
    lines = _read(path, read).splitlines(keepends=True)
    table = table_of(path, ADVICE, iter(lines))
    table.warn()
    return table


def _numbers(table: TextTable, columns: Sequence[Chosen]) -> FloatArray:
    """The numbers of a table's columns (rows, columns). Raises InputError with the line of what is
    none, or is negative.
    """
    rows = []
    names = []
    for column in columns:
        header = table.columns[column.place].header
        names.append(header or f"column {column.place + 1}")
    for line, cells in table.rows():
        texts = [table.cell(cells, column) for column in columns]
        row = finite_numbers(table.path, line, names, texts, "write numbers that are not negative")
        if not 0 <= min(row) <= max(row) < 1e30:
            raise InputError(
                f"{table.path}:{line}: {','.join(texts)[:40]!r}; write finite numbers that are not"
                " negative"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{table.path}: no row of numbers in it")
    return np.array(rows, dtype=np.float64)


def read_response(path: Path, bits: int, read: list[bytes] | None = None) -> dict[str, FloatArray]:
    """Light (2^bits,) of each channel, black level included: every code, or some of them and the
    curve between.

    Raises InputError for a table without code 0 or white, with equal or falling neighbours, or with
    blacks that disagree.
    """
    table = _table(path, read)
    header = tuple(column.name for column in table.columns)
    if header not in (("code", *GREY), ("code", *PRIMARIES)):
        raise InputError(
            f"{path}: its header is {','.join(header)[:60]!r}; write code,w or code,r,g,b"
        )
    rows = _numbers(table, [needed(table, name) for name in header])
    code = rows[:, 0]
    white = 2**bits - 1
    if np.any(code != np.rint(code)) or np.any(np.diff(code) <= 0):
        raise InputError(
            f"{path}: its codes are not whole numbers that rise; sort the rows, one to a code"
        )
    if len(code) < 2 or code[0] != 0 or code[-1] != white:
        raise InputError(
            f"{path}: its codes are {code[0]:g} to {code[-1]:g}; write 0 (black) to {white} (white"
            f" of {bits} bits)"
        )
    columns = {}
    for name, light in zip(header[1:], rows.T[1:], strict=True):
        columns[name] = _every_code(path, name, code, light, white)
    blacks = rows[0, 1:]
    if np.ptp(blacks) > BLACKS_AGREE * blacks.mean():
        listed = ", ".join(f"{black:g}" for black in blacks)
        raise InputError(
            f"{path}: code 0 has {listed}; all show one black screen, so write one light"
        )
    return columns


def _every_code(
    path: Path, name: str, code: FloatArray, light: FloatArray, white: int
) -> FloatArray:
    """Light at codes 0 to `white`: between rows, PCHIP of log light above black over log code;
    below the first, a power law.
    """
    fall = np.flatnonzero(np.diff(light) <= 0)
    if len(fall):
        first = fall[0]
        low = code[first]
        high = code[first + 1]
        raise InputError(
            f"{path}: light of channel {name} does not rise from code {low:g} to code {high:g};"
            " every code must be brighter"
        )
    if len(code) == white + 1:
        return light
    if len(code) < 3:
        raise InputError(f"{path}: two codes make no response; give some between black and white")
    black = light[0]
    log_code = np.log(code[1:])
    log_light = np.log(light[1:] - black)
    # a quarter of a second of every command that has no such file
    from scipy.interpolate import PchipInterpolator

    curve = PchipInterpolator(log_code, log_light)
    wanted = np.log(np.arange(1, white + 1))
    first_code = log_code[0]
    slope = (log_light[1] - log_light[0]) / (log_code[1] - first_code)
    power_law = log_light[0] + slope * (wanted - first_code)
    between = curve(np.maximum(wanted, first_code))
    log_above = np.where(wanted < first_code, power_law, between)
    return np.append(black, black + np.exp(log_above))


def read_grid(path: Path, read: list[bytes]) -> FloatArray:
    """A grid of relative light (rows, columns), rows from top to bottom, all positive. Raises
    InputError.
    """
    table = _table(path, read)
    if table.header:
        raise InputError(
            f"{path}:{table.header_line}: {shortened(table.names)!r} is no row of numbers"
        )
    grid = _numbers(table, [Chosen(place) for place in range(len(table.columns))])
    if not grid.min() > 0:
        raise InputError(
            f"{path}: a field of the screen has no light; every value must be more than 0"
        )
    return grid


def write_calibration(
    path: Path,
    head: CalibrationHead,
    columns: dict[str, FloatArray],
    noise: float,
    notes: NotesTable,
    weights: WeightsTable | None = None,
    *,
    identity: MonitorIdentity | None = None,
    errors: ErrorsTable | None = None,
) -> Path:
    """Write the TOML and, beside it, the response it names; the CSV's path. Raises InputError
    where they cannot be written.
    """
    table = path.parent / head.response
    lines = [",".join(["code", *columns])]
    lights = np.stack(list(columns.values()), axis=1).tolist()
    for code, code_lights in enumerate(lights):
        lines.append(",".join(map(repr, [code, *code_lights])))
    comment = f"# light in {head.unit or 'one linear unit'}, black level (code 0) included"
    lines.insert(0, comment.encode("ascii", "replace").decode())
    tables: dict[str, Any] = {
        "calibration": head,
        "weights": weights,
        "noise": {"relative": float(f"{noise:.6g}")},
    }
    tables |= {
        "notes": notes,
        "errors": errors,
        TABLE: None if identity is None else identity.known(),
    }
    write_whole(table, "\n".join(lines) + "\n")
    write_whole(path, toml_text(msgspec.to_builtins(tables)))
    return table


def add_uniformity(path: Path, grid: FloatArray, relative: float | None = None) -> Path:
    """Give a calibration file that has none a grid of relative light (rows, columns), rows from the
    top; the grid's CSV.

    `relative` is the standard error of a field. Raises InputError where it cannot be written.
    """
    table = path.with_name(f"{path.stem}-uniformity.csv")
    rows = [",".join(map(repr, row)) for row in grid.tolist()]
    write_whole(table, "".join(f"{row}\n" for row in rows))
    text = read_text(path, ADVICE, MAX_TOML_BYTES)
    if relative is None:
        known = ""
    else:
        known = f"relative = {relative:.4g}\n"
    write_whole(path, f"{text}\n[uniformity]\nfile = {json.dumps(table.name)}\n{known}")
    return table
