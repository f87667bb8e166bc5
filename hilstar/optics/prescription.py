"""A glass from a lens's prescription: optiland traces it, and its rays become PSFs with diffraction.

Each ray is a plane wave behind the lens: the light's field in the image is the sum of exp(i k (path + L (x - x_ray) +
M (y - y_ray))) over rays evenly in the pupil, by the square root of the solid angle of each (the angular spectrum, Goodman,
Fourier Optics, section 3.10). Where the pupil would need too many rays, because what diffraction spreads is far finer than
the aberrations, rays are counted as they fall.
"""

import contextlib
import io
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.errors import InputError, MachineError
from hilstar.optics.psf_file import Glass, Stack, glass_of
from hilstar.scene.camera import Lens

CAN_INSTALL = "pip install 'hilstar[lens]'"
ADVICE = "give a lens file that optiland reads: .zmx of Zemax, .seq of CODE V, or .json of optiland"
POINTS = 5  # field points along each side
MIN_RAYS, MAX_RAYS, GEOMETRIC_RAYS = 96, 288, 400  # across the pupil
MIN_SAMPLES, MAX_SAMPLES = 4, 16  # a tracker pixel, where --oversampling does not say
PERIOD_MARGIN = 1.5  # the sum of plane waves repeats after so many stamps
CHIEF_ROUNDS, DISTORTION_RAYS = 12, 24
MIN_LIT = 1e-3  # share of a pupil below which a field point is dark


@dataclass(frozen=True, slots=True)
class Plate:
    """The detector behind a lens: its size and pixel pitch, focus positions (positive: farther from the lens), half a stamp."""

    resolution_px: tuple[int, int]
    pitch_um: float
    focuses_um: tuple[float, ...] = (0.0,)
    half_px: int = 8


@dataclass(frozen=True, slots=True)
class Traced:
    """The glass of a prescription, its focal length and its F-number."""

    glass: Glass
    focal_length_mm: float
    f_number: float


@dataclass(frozen=True, slots=True)
class _Bundle:
    """Rays of a pupil's grid (n, n) at the image: places, direction cosines, path, all mm; and their light, 0 where blocked."""

    x: FloatArray
    y: FloatArray
    cosines: FloatArray
    path: FloatArray
    light: FloatArray


def glass_of_prescription(path: Path, plate: Plate, per_px: int | None, tolerance: float) -> Traced:
    """The glass of a lens file. Raises InputError, and MachineError without optiland."""
    optic = _read(path)
    try:
        return traced(optic, plate, per_px, tolerance, f"hilstar optics lens of {path.name}")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _read(path: Path) -> Any:
    try:
        with _quiet():
            from optiland import fileio
    except ImportError as error:
        raise MachineError(f"hilstar optics lens needs optiland: {CAN_INSTALL}") from error
    readers = {".zmx": fileio.load_zemax_file, ".seq": fileio.load_codev_file, ".json": fileio.load_optiland_file}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: no lens file by its name; {ADVICE}")
    if not path.is_file():
        raise InputError(f"{path}: no such file; {ADVICE}")
    try:
        with _quiet():
            return reader(str(path))
    except Exception as error:  # optiland raises whatever a broken file causes in its layers
        raise InputError(f"{path}: optiland cannot read it ({type(error).__name__}: {str(error)[:80]}); {ADVICE}") from error


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """optiland prints on stdout, and numba warns."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def traced(optic: Any, plate: Plate, per_px: int | None, tolerance: float, made_by: str) -> Traced:
    """The glass of an optic of optiland's, at its wavelengths and within its field. Raises InputError."""
    try:
        with _quiet():
            lens = _LensRays(optic)
            return _glass(lens, plate, per_px, tolerance, made_by)
    except InputError:
        raise
    except Exception as error:  # as in `_read`
        raise InputError(f"optiland cannot trace it ({type(error).__name__}: {str(error)[:80]}); {ADVICE}") from error


class _LensRays:
    """Rays through an optic, with its vignetting factors interpolated over the field; optiland takes the nearest."""

    def __init__(self, optic: Any) -> None:
        if not optic.object_surface.is_infinite:
            raise InputError("its object is near; write a lens whose object is at infinity, as stars are")
        self.optic = optic
        fields = optic.fields.fields
        self.max_field = float(optic.fields.max_field)
        order = sorted((math.hypot(float(f.x), float(f.y)), float(f.vx), float(f.vy)) for f in fields)
        self._vignetting = np.array(order).T
        for field in fields:
            field.vx = field.vy = 0.0
        self.wavelengths_um = sorted({float(w.value) for w in optic.wavelengths.wavelengths})
        self.primary_um = float(optic.primary_wavelength)
        self.focal_length_mm = abs(float(np.asarray(optic.paraxial.f2()).ravel()[0]))
        self.f_number = abs(float(np.asarray(optic.paraxial.FNO()).ravel()[0]))
        if not math.isfinite(self.focal_length_mm) or not self.wavelengths_um:
            raise InputError("it has no focal length or no wavelength; write a lens that forms an image")

    def chiefs(self, fields: FloatArray, um: float) -> tuple[FloatArray, FloatArray]:
        """Tangents of field angles (n, 2), and the chief rays' places (n, 2), mm, at fields (n, 2) relative to the largest."""
        none = np.zeros(len(fields))
        starts = self.optic.ray_tracer.ray_generator.generate_rays(fields[:, 0], fields[:, 1], none, none, um)
        tangents = np.stack([starts.L / starts.N, starts.M / starts.N], axis=1)
        rays = self.optic.trace_generic(fields[:, 0], fields[:, 1], none, none, um)
        return tangents, np.stack([rays.x, rays.y], axis=1)

    def fields_at(self, places_mm: FloatArray) -> FloatArray:
        """The fields (n, 2) whose chief rays meet the image at places (n, 2) from the axis's, at the primary wavelength."""
        edge = np.array([[0.0, 0.0], [0.0, 0.05]])
        slope_mm = float(np.linalg.norm(np.diff(self.chiefs(edge, self.primary_um)[1], axis=0))) / 0.05
        sign = np.sign(np.diff(self.chiefs(edge, self.primary_um)[1], axis=0)[0, 1])
        fields = places_mm / slope_mm * sign
        for _ in range(CHIEF_ROUNDS):
            fields = np.clip(fields, -1.5, 1.5)
            fields = fields + (places_mm - self.chiefs(fields, self.primary_um)[1]) / slope_mm * sign
        return np.asarray(fields)

    def bundle(self, field: FloatArray, um: float, rays: int) -> _Bundle:
        """The rays of a pupil's grid at a field."""
        at = (np.arange(rays) + 0.5) / rays * 2 - 1
        across, down = np.meshgrid(at, at)
        inside = across**2 + down**2 <= 1
        radius = float(np.hypot(*field))
        vx, vy = (np.interp(radius * self.max_field, self._vignetting[0], part) for part in self._vignetting[1:])
        turn = field / radius if radius else np.array([0.0, 1.0])  # the field's direction is the factors' y
        along = across * turn[0] + down * turn[1]
        beside = across * turn[1] - down * turn[0]
        px = np.clip(across - vy * along * turn[0] - vx * beside * turn[1], -1, 1)  # beyond it only where no light is
        py = np.clip(down - vy * along * turn[1] + vx * beside * turn[0], -1, 1)
        hx, hy = np.full(px.size, field[0]), np.full(px.size, field[1])
        generate = self.optic.ray_tracer.ray_generator.generate_rays
        first = generate(hx, hy, px.ravel(), py.ravel(), um)
        x0, y0, z0, l0, m0, n0 = (np.array(getattr(first, name)).reshape(px.shape) for name in ("x", "y", "z", "L", "M", "N"))
        found = self.optic.trace_generic(hx, hy, px.ravel(), py.ravel(), um)
        x, y, *cosines, path, light = (
            np.array(getattr(found, name)).reshape(px.shape) for name in ("x", "y", "L", "M", "N", "opd", "i")
        )
        good = inside & np.isfinite(x + y + path) & (light > 0)
        # A plane wave's path up to where its rays start, and the area of the beam that each ray stands for.
        path = path + l0 * x0 + m0 * y0 + n0 * z0
        area = np.abs(_determinant(x0, y0)) * np.abs(n0)
        return _Bundle(x, y, np.stack(cosines), path, np.where(good, np.nan_to_num(light) * area, 0.0))


def _determinant(a: FloatArray, b: FloatArray) -> FloatArray:
    """The area that neighbours of a grid span in (a, b)."""
    (a_down, a_right), (b_down, b_right) = np.gradient(a), np.gradient(b)
    return np.asarray(a_right * b_down - a_down * b_right)


def _glass(lens: _LensRays, plate: Plate, per_px: int | None, tolerance: float, made_by: str) -> Traced:
    pitch_mm, (width, height) = plate.pitch_um * 1e-3, plate.resolution_px
    middle = (np.array([width, height]) - 1) / 2
    places = _field_points(lens, plate)
    fields = lens.fields_at(places * pitch_mm)
    finest_um = lens.wavelengths_um[0] * lens.f_number / 2
    samples = per_px or min(MAX_SAMPLES, max(MIN_SAMPLES, math.ceil(plate.pitch_um / finest_um)))
    grid = 2 * plate.half_px * samples + 1, pitch_mm / samples
    images, at, facts = [], [], []
    primary = lens.chiefs(fields, lens.primary_um)[1]
    axis_light: dict[float, float] = {}
    for um in lens.wavelengths_um:
        axis_light[um] = float(lens.bundle(np.zeros(2), um, MIN_RAYS).light.sum())
        lateral = (lens.chiefs(fields, um)[1] - primary) / pitch_mm
        for place, field, chief, shift in zip(places, fields, primary, lateral, strict=True):
            slopes = _slopes(lens, field, um)
            light = float(lens.bundle(field, um, MIN_RAYS).light.sum()) / axis_light[um]
            for focus_um in sorted(set(plate.focuses_um)):
                if light > MIN_LIT:
                    centre = chief + shift * pitch_mm + slopes * focus_um * 1e-3
                    image, outside = _psf(lens, (field, um, focus_um * 1e-3), centre, grid)
                else:
                    image, outside = _dark(grid[0]), 0.0
                images.append(image)
                at.append((*(middle + place), um * 1e3, focus_um))
                moved = shift + slopes * focus_um * 1e-3 / pitch_mm
                facts.append((min(light, 2.0) if light > MIN_LIT else 0.0, outside, *moved))
    stack = Stack(np.array(images), np.array(at), np.array(facts), samples)
    focal_mm, distortion = _distortion(lens)
    history = (made_by, f"focal length {focal_mm:.6g} mm, F-number {lens.f_number:.4g}")
    return Traced(glass_of(stack, tolerance, distortion, history=history), focal_mm, lens.f_number)


def _field_points(lens: _LensRays, plate: Plate) -> FloatArray:
    """Places (n, 2) from the middle, px: a grid over the detector, or as much of it as the prescription's field has."""
    half = (np.array(plate.resolution_px) - 1) / 2
    if lens.max_field == 0:
        return np.zeros((1, 2))
    edge_px = float(np.linalg.norm(lens.chiefs(np.array([[0.0, 1.0]]), lens.primary_um)[1])) / (plate.pitch_um * 1e-3)
    scale = min(1.0, edge_px / float(np.hypot(*half)))
    columns, rows = (np.unique(np.linspace(-size * scale, size * scale, POINTS)) for size in half)
    return np.stack([part.ravel() for part in np.meshgrid(columns, rows)], axis=1)


def _slopes(lens: _LensRays, field: FloatArray, um: float) -> FloatArray:
    rays = lens.optic.trace_generic(np.array([field[0]]), np.array([field[1]]), np.zeros(1), np.zeros(1), um)
    return np.array([float(rays.L[0] / rays.N[0]), float(rays.M[0] / rays.N[0])])


def _dark(side: int) -> FloatArray:
    image = np.zeros((side, side))
    image[side // 2, side // 2] = 1.0
    return image


def _psf(
    lens: _LensRays, light: tuple[FloatArray, float, float], centre: FloatArray, grid: tuple[int, float]
) -> tuple[FloatArray, float]:
    """A PSF about its chief ray's place `centre` on its stamp's samples, and the share of its light outside of them.

    `light` is its field, wavelength (um) and defocus (mm), `grid` the stamp's side and step (mm).
    """
    (field, um, defocus_mm), (side, step_mm) = light, grid
    needed = math.ceil(PERIOD_MARGIN * side * step_mm / (um * 1e-3 * lens.f_number))
    if needed > MAX_RAYS:
        return _counted(lens.bundle(field, um, GEOMETRIC_RAYS), defocus_mm, centre, side, step_mm)
    return _waves(lens.bundle(field, um, max(MIN_RAYS, needed)), um, defocus_mm, centre, (side, step_mm))


def _waves(
    rays: _Bundle, um: float, defocus_mm: float, centre: FloatArray, grid: tuple[int, float]
) -> tuple[FloatArray, float]:
    side, step_mm = grid
    finer = max(1, math.ceil(step_mm / (um * 1e-3 * 0.5 * _fastest(rays))) // 2 * 2 + 1)
    at_mm = (np.arange(side * finer) - (side * finer) // 2) * step_mm / finer
    wave = 2 * np.pi / (um * 1e-3)
    cos_x, cos_y, cos_z = rays.cosines
    angle = np.nan_to_num(np.abs(_determinant(cos_x, cos_y)))  # solid angle times its cosine
    lit = rays.light > 0
    path = rays.path + cos_z * defocus_mm - cos_x * (rays.x - centre[0]) - cos_y * (rays.y - centre[1])
    path = path[lit] - np.median(path[lit])
    light, angle, cos_x, cos_y = rays.light[lit], angle[lit], cos_x[lit], cos_y[lit]
    part = np.sqrt(light * angle) * np.exp(1j * wave * path)
    middle_x, middle_y = (np.average(cosine, weights=light) for cosine in (cos_x, cos_y))  # a phase that no light shows
    across = np.exp(1j * wave * np.outer(cos_x - middle_x, at_mm))
    down = np.exp(1j * wave * np.outer(cos_y - middle_y, at_mm))
    image = np.abs((down * part[:, None]).T @ across) ** 2
    # Parseval: the integral over the image is the wavelength squared times that of the squared amplitude over solid angles.
    total = float(light.sum()) * (um * 1e-3 / (step_mm / finer)) ** 2
    image = image.reshape(side, finer, side, finer).sum(axis=(1, 3))
    return image, float(np.clip(1 - image.sum() / total, 0, 0.999))


def _fastest(rays: _Bundle) -> float:
    """The F-number of a bundle along its wider direction."""
    lit = rays.light > 0
    return 1 / max(1e-6, float(max(np.ptp(cosine[lit]) for cosine in rays.cosines[:2])))


def _counted(rays: _Bundle, defocus_mm: float, centre: FloatArray, side: int, step_mm: float) -> tuple[FloatArray, float]:
    """Rays shared out among the four samples nearest to each."""
    lit = rays.light > 0
    light, (cos_x, cos_y, cos_z) = rays.light[lit], rays.cosines[:, lit]
    x, y = (
        (place[lit] + cosine / cos_z * defocus_mm - own) / step_mm + side // 2
        for place, cosine, own in ((rays.x, cos_x, centre[0]), (rays.y, cos_y, centre[1]))
    )
    column, row = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    image = np.zeros((side, side))
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = light * np.abs(1 - down - (y - row)) * np.abs(1 - right - (x - column))
        inside = (column + right >= 0) & (column + right < side) & (row + down >= 0) & (row + down < side)
        np.add.at(image, (row[inside] + down, column[inside] + right), share[inside])
    return image, float(np.clip(1 - image.sum() / light.sum(), 0, 0.999))


def _distortion(lens: _LensRays) -> tuple[float, Lens | None]:
    """The focal length, mm, that the chief rays at the primary wavelength have, and k1 to k3 relative to it."""
    if lens.max_field == 0:
        return lens.focal_length_mm, None
    fields = np.stack([np.zeros(DISTORTION_RAYS), np.linspace(0, 1, DISTORTION_RAYS + 1)[1:]], axis=1)
    tangents, places = lens.chiefs(fields, lens.primary_um)
    tangent = np.abs(tangents[:, 1])
    off = np.abs(places[:, 1] - lens.chiefs(np.zeros((1, 2)), lens.primary_um)[1][0, 1])
    largest = tangent[-1]
    powers = (tangent[:, None] / largest) ** np.array([1, 3, 5, 7])
    focal, *bent = np.linalg.lstsq(powers, off / largest, rcond=None)[0].tolist()
    k1, k2, k3 = (part / focal / largest ** (2 * order) for order, part in enumerate(bent, start=1))
    return focal, Lens((k1, k2, k3))
