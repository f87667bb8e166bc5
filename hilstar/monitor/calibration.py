"""What is known of a monitor's light: its response, uniformity and noise, and where that knowledge comes from."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from hilstar.arrays import Float32Array, FloatArray
from hilstar.errors import InputError, did_you_mean, shortened
from hilstar.monitor.calibration_file import (
    Head,
    NotesTable,
    WeightsTable,
    add_uniformity,
    beside,
    read_grid,
    read_response,
    read_toml,
    write_calibration,
)
from hilstar.monitor.response import (
    MAX_LEVELS,
    TRIPLES,
    Response,
    Weights,
    bit_stealing_response,
    gamma_response,
    mixed_response,
    srgb_response,
    table_response,
)
from hilstar.reading import exists

FORMULAS = ("srgb", "gamma2.2")
BUILT_IN = (*FORMULAS, "lcd-example")
EXAMPLE = Path(__file__).resolve().parent / "data" / "lcd-example.toml"
REC709_WEIGHTS: Weights = (0.2126, 0.7152, 0.0722)  # a photometer's, of the sRGB primaries (IEC 61966-2-1)


@dataclass(frozen=True, slots=True)
class Calibration:
    """A monitor's light, and where that knowledge comes from.

    `uniformity` is a coarse grid (rows, columns) of relative light, rows from top to bottom, each value at the middle of its
    equal share of the screen; None where the light is the same everywhere. `noise` is the relative repeatability of a patch.
    `weights` are the shares of the primaries in white as the tracker sees them, of sum 1; None where they are not known.
    `black` of the response is that of the whole screen. `sha256` covers the bytes of every file that was read.
    """

    name: str
    response: Response
    sha256: str
    uniformity: FloatArray | None = None
    noise: float = 0.0
    weights: Weights | None = None
    who: str = ""
    when: str = ""
    instrument: str = ""
    unit: str = "relative"
    notes: dict[str, str] = field(default_factory=dict)

    @property
    def can_steal_bits(self) -> bool:
        """Whether `load_calibration` would take it with `bit_stealing`."""
        levels = (2**self.response.bits - 1) * TRIPLES + 1
        return self.weights is not None and levels <= MAX_LEVELS

    @property
    def is_formula(self) -> bool:
        """Whether it exists for any number of bits."""
        return self.name in FORMULAS

    def uniformity_map(self, resolution_px: tuple[int, int]) -> Float32Array | None:
        """Relative light of each pixel (height, width), 1 at the brightest; None where it is the same everywhere.

        Bilinear between the centres of the grid's fields, extrapolated by the same slope to the edges of the screen.
        """
        if self.uniformity is None:
            return None
        width, height = resolution_px
        rows = weights_of_grid(height, self.uniformity.shape[0])
        columns = weights_of_grid(width, self.uniformity.shape[1])
        light = rows @ self.uniformity @ columns.T
        smallest = float(self.uniformity.min()) / 2  # an extrapolated slope must not go below zero
        light = np.maximum(light, smallest)
        return np.asarray(light / light.max(), dtype=np.float32)


def weights_of_grid(pixels: int, fields: int) -> FloatArray:
    """The weight of each of a grid's fields in each pixel along one axis, (pixels, fields)."""
    if fields == 1:
        return np.ones((pixels, 1))
    place = (np.arange(pixels) + 0.5) * fields / pixels - 0.5
    left = np.clip(np.floor(place).astype(np.intp), 0, fields - 2)
    weights = np.zeros((pixels, fields))
    weights[np.arange(pixels), left] = 1 - (place - left)
    weights[np.arange(pixels), left + 1] = place - left
    return weights


def load_calibration(source: str | Path, bits: int, *, bit_stealing: bool = False) -> Calibration:
    """The calibration of a built-in name ("srgb", "gamma2.2", "lcd-example") or of a file, for a monitor of `bits`.

    With `bit_stealing` its levels are triples of codes between the greys. Raises InputError for a malformed file, for
    other bits than the file's, and for bit stealing where the weights of the primaries are not known.
    """
    name = str(source)
    if name in FORMULAS:
        grey = srgb_response(bits) if name == "srgb" else gamma_response(bits)
        response = bit_stealing_response((grey, grey, grey), REC709_WEIGHTS) if bit_stealing else grey
        digest = hashlib.sha256(f"hilstar built-in {name}, {bits} bits".encode()).hexdigest()
        return Calibration(name, response, digest, weights=REC709_WEIGHTS, instrument="none: a formula")
    path = EXAMPLE if name == "lcd-example" else Path(source)
    meant = did_you_mean(name, BUILT_IN)
    if not exists(path) and (meant or not path.suffix):
        raise InputError(
            f"calibration = {shortened(json.dumps(name))}: no such built-in or file; {meant}write "
            f"{', '.join(BUILT_IN)} or FILE.toml"
        )
    return _load_file(path, name if name == "lcd-example" else path.name, bits, bit_stealing)


def primary_lights(source: str | Path, bits: int) -> FloatArray:
    """Light above black of each primary by its code (3, 2^bits), relative to white as the tracker sees it.

    Raises InputError as `load_calibration` does with bit stealing.
    """
    if str(source) in FORMULAS:
        grey = srgb_response(bits) if str(source) == "srgb" else gamma_response(bits)
        return np.outer(REC709_WEIGHTS, grey.light)
    path, digest = EXAMPLE if str(source) == "lcd-example" else Path(source), hashlib.sha256()
    file = read_toml(path, digest)
    columns = read_response(beside(path, file.calibration.response, "[calibration] response"), bits, digest)
    above = {name: light - light[0] for name, light in columns.items()}
    if "r" in above and file.weights is None:
        light = np.stack([above[name] for name in ("r", "g", "b")])
        return np.asarray(light / light[:, -1].sum())
    if file.weights is None:
        raise InputError(f"{path}: the primaries as the tracker sees them are not known; add [weights] r, g, b")
    shares = np.array([file.weights.r, file.weights.g, file.weights.b])
    names = ("r", "g", "b") if "r" in above else ("w", "w", "w")
    light = np.stack([above[name] / above[name][-1] for name in names])
    return np.asarray(light * (shares / shares.sum())[:, None])


def with_uniformity(source: str | Path, bits: int, path: Path, grid: FloatArray | None) -> tuple[Path, ...]:
    """Write a calibration's light with another grid of relative light (rows, columns), or with none; the files, TOML first.

    `source` is a built-in name or a file, as for `load_calibration`. Raises InputError.
    """
    response, weights, noise, notes = f"{path.stem}.csv", None, 0.0, NotesTable()
    if str(source) in FORMULAS:
        light = srgb_response(bits) if str(source) == "srgb" else gamma_response(bits)
        head = Head("photometric", "", "", f"none: the formula {source}", "relative", bits, response)
        columns, weights = {"w": light.light}, WeightsTable(*REC709_WEIGHTS)
    else:
        origin, digest = EXAMPLE if str(source) == "lcd-example" else Path(source), hashlib.sha256()
        file = read_toml(origin, digest)
        columns = read_response(beside(origin, file.calibration.response, "[calibration] response"), bits, digest)
        head = msgspec.structs.replace(file.calibration, response=response)
        weights, noise, notes = file.weights, file.noise.relative if file.noise else 0.0, file.notes
    table = write_calibration(path, head, columns, noise, notes, weights)
    return (path, table) if grid is None else (path, table, add_uniformity(path, grid))


def _load_file(path: Path, name: str, bits: int, bit_stealing: bool) -> Calibration:
    digest = hashlib.sha256()
    file = read_toml(path, digest)
    head = file.calibration
    if head.bits != bits:
        raise InputError(f"{path}: [calibration] bits = {head.bits}, but the monitor has {bits}; calibrate at {bits} bits")
    columns = read_response(beside(path, head.response, "[calibration] response"), bits, digest)
    uniformity = None
    if file.uniformity is not None:
        uniformity = read_grid(beside(path, file.uniformity.file, "[uniformity] file"), digest)
    weights = (file.weights.r, file.weights.g, file.weights.b) if file.weights else None
    response, shares = _response(path, bits, columns, weights, bit_stealing)
    return Calibration(
        name=name,
        response=response,
        sha256=digest.hexdigest(),
        uniformity=uniformity,
        noise=file.noise.relative if file.noise else 0.0,
        weights=shares,
        who=head.who,
        when=head.when,
        instrument=head.instrument,
        unit=head.unit,
        notes={key: text for key, text in msgspec.structs.asdict(file.notes).items() if text},
    )


def _response(
    path: Path, bits: int, columns: dict[str, FloatArray], weights: Weights | None, bit_stealing: bool
) -> tuple[Response, Weights | None]:
    """The grey (or bit-stealing) response of measured light, and the primaries' shares of white."""
    whites = {name: float(light[-1] - light[0]) for name, light in columns.items()}
    if weights is None and "r" in columns:
        weights = whites["r"], whites["g"], whites["b"]
    if weights is not None:
        if not sum(weights) > 0:
            raise InputError(f"{path}: [weights] r, g and b are all 0; write the primaries' shares of white")
        weights = weights[0] / sum(weights), weights[1] / sum(weights), weights[2] / sum(weights)
    black = float(np.mean([light[0] for light in columns.values()])) / sum(whites.values())
    tables = {name: table_response(bits, (light - light[0]) / whites[name]) for name, light in columns.items()}
    channels = (tables["w"],) * 3 if "w" in tables else (tables["r"], tables["g"], tables["b"])
    if bit_stealing and weights is None:
        raise InputError(f"{path}: bit stealing needs the primaries as the tracker sees them; add [weights] r, g, b")
    if bit_stealing and weights is not None:
        return bit_stealing_response((channels[0], channels[1], channels[2]), weights, black), weights
    if "w" in tables or weights is None:
        return table_response(bits, tables["w"].light, black), weights
    return mixed_response((channels[0], channels[1], channels[2]), weights, black), weights
