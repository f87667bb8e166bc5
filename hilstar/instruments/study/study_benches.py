"""Shared by studies: their benches, the optics of the brightness studies, and stars that stand
alone in an image.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import magnitude
from hilstar.display.quantise import shown_light
from hilstar.display.render.reference import linear_image
from hilstar.display.response import Levels
from hilstar.optics.frame_motion import CameraTurn, swept_sprites
from hilstar.optics.scan import Scan
from hilstar.optics.sprites import FrameLight
from hilstar.server.bench.build import load
from hilstar.server.bench.code_errors import NO_THRESHOLD
from hilstar.server.bench.frame import Bench
from hilstar.sky.electrons import Optics, fit_table, load_library
from hilstar.sky.spectral_types import bare_and_dusty, fit_spectra, read_types
from hilstar.sky.spectrum import load_curve
from hilstar.tracker.centroiders import Centroider
from hilstar.tracker.star_errors import stamp_errors

Value = str | float | tuple[int, int]
Table = Mapping[str, Value]

TRACKER: Table = {
    "aperture_mm": 30,
    "focal_length_mm": 70,
    "pixel_pitch_um": 13,
    "quantum_efficiency": "ccd47-20",
}
FULL_HD: Table = {"resolution_px": (1920, 1080), "pixel_pitch_um": 57.65}
APERTURE_MM = 30.0
GLASS = "n-bk7-10mm"
MAX_RELIABLE_VI_MAG = 2.5
Window = tuple[slice, slice]


@dataclass(frozen=True, slots=True)
class Isolation:
    """The margin of a window around a star's sprites, px, and the share of its light that other
    stars may add there.
    """

    margin_px: float
    max_share: float


LONE = Isolation(margin_px=7, max_share=2e-4)  # 2e-4 of its light is 2e-4 mag


def bench_text(tables: Mapping[str, Table]) -> str:
    """The text of a bench file with `tables` by name; [tracker] extends TRACKER."""
    lines = []
    for name, table in tables.items():
        whole = dict(table)
        if name == "tracker":
            whole = {**TRACKER, **table}
        lines.append(f"[{name}]")
        for key, value in whole.items():
            # Text, numbers and pairs are written alike in JSON and TOML.
            lines.append(f"{key} = {json.dumps(value)}")
    return "\n".join(lines) + "\n"


def study_bench(path: Path, tables: Mapping[str, Table]) -> Bench:
    """The bench of `bench_text`, whose file is written to `path`. Raises InputError or
    MachineError.
    """
    path.write_text(bench_text(tables), encoding="utf-8")
    return load(path)


def study_optics(sensor: str) -> Optics:
    """A sensor behind an aperture of 30 mm and 10 mm of N-BK7."""
    return Optics(APERTURE_MM, load_curve(sensor, sensor), load_curve(GLASS, GLASS))


def held_out_errors(rates: FloatArray) -> FloatArray:
    """Relative error (m,) of each library star's rate by a table fitted to the others, each star
    held out in turn.
    """
    library = load_library()
    bv_mag = library.bv_mag
    vi_mag = library.vi_mag
    errors = np.empty(len(rates))
    for k in range(len(rates)):
        others = np.arange(len(rates)) != k
        table = fit_table(bv_mag[others], vi_mag[others], rates[others])
        predicted = table.electrons_per_s(np.zeros(1), bv_mag[[k]], vi_mag[[k]])
        errors[k] = predicted[0] / rates[k] - 1
    return errors


def held_out_by_type(rates: FloatArray) -> FloatArray:
    """Relative error (2m,) of each rate by spectral type, over `bare_and_dusty`; each star is held
    out together with its dusty copy.
    """
    library = bare_and_dusty()
    kind = read_types(np.array(library.spectral_type, dtype=np.bytes_))
    count = len(rates) // 2
    errors = np.empty(len(rates))
    bv_mag = library.bv_mag
    vi_mag = library.vi_mag
    for k in range(count):
        pair = np.array([k, k + count])
        others = np.delete(np.arange(len(rates)), pair)
        known = replace(library, bv_mag=bv_mag[others], vi_mag=vi_mag[others])
        table = fit_spectra(kind[others], known, rates[others])
        predicted = table.electrons_per_s(np.zeros(2), bv_mag[pair], vi_mag[pair], kind[pair])
        errors[pair] = predicted / rates[pair] - 1
    return errors


def lone_windows(
    sprites: FrameLight,
    x_px: FloatArray,
    y_px: FloatArray,
    size_px: tuple[int, int],
    isolation: Isolation,
) -> Iterator[tuple[int, Window]]:
    """Each isolated star with its window, where that lies on an image of `size_px` (width, height).

    `x_px` and `y_px` (n,) are the places of the sprites on that image. A window is rows and
    columns.
    """
    light = sprites.data["electrons_per_s"]
    width, height = size_px
    margin = isolation.margin_px
    for star in np.unique(sprites.star):
        is_own = sprites.star == star
        first_x = x_px[is_own].min() - margin
        last_x = x_px[is_own].max() + margin
        first_y = y_px[is_own].min() - margin
        last_y = y_px[is_own].max() + margin
        if first_x < 0 or first_y < 0 or last_x > width - 1 or last_y > height - 1:
            continue
        near = (x_px > first_x - margin) & (x_px < last_x + margin)
        near &= (y_px > first_y - margin) & (y_px < last_y + margin)
        others = light[near & ~is_own].sum()
        if others <= isolation.max_share * light[is_own].sum():
            rows = slice(int(first_y), int(last_y) + 1)
            columns = slice(int(first_x), int(last_x) + 1)
            yield int(star), (rows, columns)


def squares(image: FloatArray, windows: Sequence[Window]) -> FloatArray:
    """The windows of an image, each in the middle of an equal square: (n, side, side), side odd."""
    sides = [part.stop - part.start for window in windows for part in window]
    side = max(sides) | 1
    stamps = np.zeros((len(windows), side, side))
    for square, window in zip(stamps, windows, strict=True):
        height, width = image[window].shape
        row = (side - height) // 2
        column = (side - width) // 2
        square[row : row + height, column : column + width] = image[window]
    return stamps


@dataclass(frozen=True, slots=True)
class StarError:
    """The error of a shown star: light, mag (positive: too faint), and centroid, px; NaN where
    it is dark.
    """

    flux_mag: float
    centroid_px: float


def star_error(shown: FloatArray, true: FloatArray, window: Window) -> StarError:
    """The error of the star in a window of `shown`, against the same window of `true`."""
    light = float(shown[window].sum())
    true_light = float(true[window].sum())
    x_px, y_px = centroid_px(shown, window)
    true_x_px, true_y_px = centroid_px(true, window)
    off_px = math.hypot(x_px - true_x_px, y_px - true_y_px)
    return StarError(magnitude(light / true_light), off_px)


def centroid_px(image: FloatArray, window: Window) -> tuple[float, float]:
    """The centre of gravity (x, y) of a window of an image (h, w), px; NaN where it is dark."""
    part = image[window]
    y_px, x_px = np.mgrid[window]
    total = float(part.sum())
    if total <= 0:
        return math.nan, math.nan
    x = float((part * x_px).sum() / total)
    y = float((part * y_px).sum() / total)
    return x, y


@dataclass(frozen=True, slots=True)
class LoneErrors:
    """Errors of the lone stars (n,) of a frame: of each star's light and centre of gravity on the
    monitor, and of its place (2, n), px, by each centroider of the tracker.
    """

    stars: tuple[StarError, ...]
    off_px: Mapping[Centroider, FloatArray]


def lone_errors(bench: Bench, turn: CameraTurn, levels: Levels) -> LoneErrors:
    """The errors of a frame's lone stars, of which none clips at any place within a pixel."""
    size_px = bench.camera.resolution_px
    sprites = turning_sprites(bench, turn)
    shown = shown_light(levels, bench.panel)
    true = linear_image(sprites, size_px, bench.psf)
    rates = sprites.data["electrons_per_s"]
    errors = []
    windows = []
    for star, window in lone_windows(sprites, sprites.x_px, sprites.y_px, size_px, LONE):
        if rates[sprites.star == star].sum() > 2 * bench.flux_at_white_e_per_s:
            continue  # clips at some places within a pixel
        errors.append(star_error(shown, true, window))
        windows.append(window)
    optics = bench.renderer.target.seen
    off_px = stamp_errors(
        squares(shown, windows),
        squares(true, windows),
        bench.psf.width_px,
        optics.blur_px,
        optics.pixel_px,
        box_share=NO_THRESHOLD,
    )
    return LoneErrors(tuple(errors), off_px)


def turning_sprites(bench: Bench, turn: CameraTurn) -> FrameLight:
    """A frame's stars as whole sprites, along their paths while the rows are lit."""
    scan = Scan(bench.scan.down, bench.scan.scanout_s, bench.scan.hold_s)
    return swept_sprites(bench.stars, turn, scan, bench.camera, bench.psf)
