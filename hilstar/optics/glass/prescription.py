"""A glass from a lens's prescription: optiland traces it, and its rays become PSFs with
diffraction.

Each ray is a plane wave behind the lens: the light's field in the image is the sum of exp(i k (path
+ L (x - x_ray) + M (y - y_ray))) over rays evenly in the pupil, by the square root of the solid
angle of each (the angular spectrum, Goodman, Fourier Optics, section 3.10). Where the pupil would
need too many rays, because what diffraction spreads is far finer than the aberrations, rays are
counted as they fall.

Surfaces may be tilted and decentred. The detector lies in the prescription's image surface, its
middle on the chief ray of the field's middle, its axes the surface's own.
"""

import contextlib
import io
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, MachineError, one_line
from hilstar.basics.reading import read_bytes
from hilstar.optics.camera import Lens
from hilstar.optics.glass.codev_file import read_codev
from hilstar.optics.glass.lens_data import FieldPoint, LensPrescription, LensSurface
from hilstar.optics.glass.optiland_lens import optic_of
from hilstar.optics.glass.psf_file import Glass, Stack, glass_of, pupil_places, samples_a_px
from hilstar.optics.glass.zemax_file import read_zemax

CAN_INSTALL = "pip install 'hilstar[lens]'"
ADVICE = "give a lens file: .zmx of Zemax, .seq of CODE V, or .json of optiland"
# What optiland raises for mirrors and tilts of which it knows no focal length.
NO_PARAXIAL_RAYS = "UnsupportedParaxialGeometryError"
TILTED = (
    "it is turned or beside the axis (COORDBRK in .zmx; ADE, BDE, CDE, XDE or YDE in .seq), and"
    " the focal length of mirrors so turned is not found; write the lens with its mirrors on one"
    " axis, without the flat ones that fold it"
)
ENDINGS = frozenset({".zmx", ".seq", ".json"})
MAX_BYTES = 50_000_000
POINTS = 5  # field points along each side
MIN_RAYS, MAX_RAYS, GEOMETRIC_RAYS = 96, 384, 400  # across the pupil
MAX_SAMPLES = 16  # a tracker pixel, where --oversampling does not say
# the sum of plane waves repeats after so many stamps; at 1.5 second moments were 1.3 % off
PERIOD_MARGIN = 2.0
FINER = 8  # parts of a ray's share of the pupil along each axis, at its edge
# Newton's rounds from a place to its field; distortion is fitted to rays along spokes of the field
CHIEF_ROUNDS, DISTORTION_RAYS, DISTORTION_SPOKES = 12, 24, 12
EDGE = 0.05  # share of the field from whose chief ray to the axis's the scale is taken
MIN_LIT = 1e-3  # share of a pupil below which a field point is dark


@dataclass(frozen=True, slots=True)
class Plate:
    """The detector behind a lens: its size and pixel pitch, focus positions (positive: farther
    from the lens), half a stamp.
    """

    resolution_px: tuple[int, int]
    pitch_um: float
    focuses_um: tuple[float, ...] = (0.0,)
    half_px: int = 8


@dataclass(frozen=True, slots=True)
class Traced:
    """The glass of a prescription, its focal length and F-number, and what was taken for
    granted.
    """

    glass: Glass
    focal_length_mm: float
    f_number: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Lens:
    """optiland's lens, its field points with their vignetting, notes, and what is tilted."""

    optic: Any
    fields: tuple[FieldPoint, ...]
    notes: tuple[str, ...] = ()
    # The first surface that is turned or beside the axis; "" where all are on it.
    tilted: str = ""


@dataclass(frozen=True, slots=True)
class _Bundle:
    """Rays of a pupil's grid (n, n) at the image: places, direction cosines, path, all mm; and
    their light, 0 where blocked.
    """

    x: FloatArray
    y: FloatArray
    cosines: FloatArray
    path: FloatArray
    light: FloatArray


def glass_of_prescription(path: Path, plate: Plate, per_px: int | None, tolerance: float) -> Traced:
    """The glass of a lens file. Raises InputError, and MachineError without optiland."""
    lens = _read(path)
    try:
        return _traced(lens, plate, per_px, tolerance, f"hilstar optics lens of {path.name}")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _read(path: Path) -> "_Lens":
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"{path}: no lens file by its name; {ADVICE}")
    data = read_bytes(path, ADVICE, MAX_BYTES)
    try:
        # What the file states is read first: a refusal of it needs no optiland.
        prescription = _stated(path, data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    try:
        with _quiet() as warned:
            import optiland  # noqa: F401
    except ImportError as error:
        raise MachineError(f"hilstar optics lens needs optiland: {CAN_INSTALL}") from error
    try:
        with _quiet() as warned:
            if prescription is None:
                lens = _optiland_s_own(path)
            else:
                lens = _of_prescription(prescription)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # optiland raises whatever a broken file causes in its layers
        raise InputError(
            f"{path}: optiland cannot read it ({type(error).__name__}: {str(error)[:80]}); {ADVICE}"
        ) from error
    return replace(lens, notes=(*lens.notes, *warned))


def _stated(path: Path, data: bytes) -> LensPrescription | None:
    """The prescription in a .zmx or .seq file; None for optiland's own format, which optiland
    reads.
    """
    if path.suffix.lower() == ".zmx":
        return read_zemax(data)
    if path.suffix.lower() == ".seq":
        return read_codev(data)
    return None


def _of_prescription(lens: LensPrescription) -> "_Lens":
    optic, notes = optic_of(lens)
    tilted = next(filter(_is_tilted, lens.surfaces), None)
    label = "" if tilted is None else tilted.label
    return _Lens(optic, lens.fields, (*lens.notes, *notes), label)


def _is_tilted(surface: LensSurface) -> bool:
    """Whether a surface is turned, or its vertex is beside the lens's axis."""
    is_turned = not np.allclose(surface.turn, np.eye(3))
    return is_turned or not np.allclose(surface.origin_mm[:2], 0.0)


def _optiland_s_own(path: Path) -> "_Lens":
    from optiland import fileio

    optic = fileio.load_optiland_file(str(path))
    return _Lens(optic, _fields_of(optic))


def _fields_of(optic: Any) -> tuple[FieldPoint, ...]:
    """The field points of optiland's lens, whose vignetting is symmetrical."""
    points = []
    for point in optic.fields.fields:
        compression = float(point.vx), float(point.vy)
        points.append(FieldPoint(float(point.x), float(point.y), compression))
    return tuple(points)


@contextlib.contextmanager
def _quiet() -> Iterator[list[str]]:
    """Keeps what optiland prints from stdout; its own warnings are put into the list, those of
    numba's compiler are not.
    """
    warned: list[str] = []
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield warned
    for warning in caught:
        if issubclass(warning.category, UserWarning) and "numba" not in str(warning.filename):
            warned.append(f"optiland: {one_line(str(warning.message))}")


def traced(optic: Any, plate: Plate, per_px: int | None, tolerance: float, made_by: str) -> Traced:
    """The glass of an optic of optiland's, at its wavelengths and within its field. Raises
    InputError.
    """
    return _traced(_Lens(optic, _fields_of(optic)), plate, per_px, tolerance, made_by)


def _traced(
    lens: _Lens, plate: Plate, per_px: int | None, tolerance: float, made_by: str
) -> Traced:
    try:
        with _quiet() as warned:
            made = _glass(_LensRays(lens.optic, lens.fields), plate, per_px, tolerance, made_by)
        return replace(made, notes=(*lens.notes, *warned))
    except InputError:
        raise
    except Exception as error:  # as in `_read`
        if type(error).__name__ == NO_PARAXIAL_RAYS and lens.tilted:
            raise InputError(f"{lens.tilted}: {TILTED}") from error
        raise InputError(
            f"optiland cannot trace it ({type(error).__name__}: {str(error)[:80]}); {ADVICE}"
        ) from error


class _LensRays:
    """Rays through an optic, with its vignetting factors interpolated over the field; optiland
    takes the nearest.
    """

    def __init__(self, optic: Any, points: tuple[FieldPoint, ...]) -> None:
        if not optic.object_surface.is_infinite:
            raise InputError(
                "its object is near; write a lens whose object is at infinity, as stars are"
            )
        self.optic = optic
        self.max_field = float(optic.fields.max_field)
        self._vignetting = _vignetting(points)
        for field in optic.fields.fields:
            field.vx = field.vy = 0.0
        self.wavelengths_um = sorted({float(w.value) for w in optic.wavelengths.wavelengths})
        self.primary_um = float(optic.primary_wavelength)
        self.focal_length_mm = _size_of(optic.paraxial.f2())
        self.f_number = _size_of(optic.paraxial.FNO())
        if not math.isfinite(self.focal_length_mm) or not self.wavelengths_um:
            raise InputError(
                "it has no focal length or no wavelength; write a lens that forms an image"
            )
        frame = optic.image_surface.geometry.cs
        image_mm, to_image = frame.get_effective_transform()
        self._image_mm = np.asarray(image_mm, dtype=np.float64)
        self._to_image = np.asarray(to_image, dtype=np.float64)
        self.centre_mm = np.zeros(2)
        self.sign = 1.0
        edge = np.array([[0.0, 0.0], [0.0, EDGE]])
        tangents, places = self.chiefs(edge, self.primary_um)
        if not np.isfinite(places).all():
            raise InputError(
                "the chief ray of its field's middle is lost; is a surface tilted too far, or its"
                " aperture beside it?"
            )
        # A lens with one field, on the axis, has no direction in which its image could be turned
        # round.
        tangent_step = tangents[1] - tangents[0]
        place_step = places[1] - places[0]
        self.sign = float(np.sign(tangent_step @ place_step)) or 1.0
        self.centre_mm = places[0]

    def at_image(self, rays: Any) -> tuple[FloatArray, FloatArray]:
        """Places (2, n), mm from the detector's middle, and direction cosines (3, n) of rays, by
        the image surface's axes.
        """
        from_plane = np.stack([rays.x, rays.y, rays.z - self._image_mm[2]])
        places = self._to_image.T @ from_plane
        cosines = self._to_image.T @ np.stack([rays.L, rays.M, rays.N])
        across_mm, down_mm, _ = self._image_mm
        moved = self._to_image.T @ np.array([across_mm, down_mm, 0.0])
        from_middle = places[:2] - moved[:2, None] - self.centre_mm[:, None]
        return from_middle, cosines

    def chiefs(self, fields: FloatArray, um: float) -> tuple[FloatArray, FloatArray]:
        """Tangents of field angles (n, 2), and the chief rays' places (n, 2), mm, at fields
        (n, 2) relative to the largest.
        """
        x, y = fields.T
        pupil_middle = np.zeros(len(fields))
        generate = self.optic.ray_tracer.ray_generator.generate_rays
        starts = generate(x, y, pupil_middle, pupil_middle, um)
        tangent_x = starts.L / starts.N
        tangent_y = starts.M / starts.N
        tangents = self.sign * np.stack([tangent_x, tangent_y], axis=1)
        rays = self.optic.trace_generic(x, y, pupil_middle, pupil_middle, um)
        places, _ = self.at_image(rays)
        return tangents, places.T

    def fields_at(self, places_mm: FloatArray, camera: "_Chiefs") -> FloatArray:
        """The fields (n, 2), relative to the largest, whose stars a camera images at places (n, 2),
        mm.
        """
        if self.max_field == 0:
            return np.zeros_like(places_mm)
        near_axis = np.array([[0.0, 0.0], [0.0, EDGE]])
        tangents, _ = self.chiefs(near_axis, self.primary_um)
        tangent_step = float(tangents[1, 1] - tangents[0, 1])
        slope_mm = camera.focal_length_mm * tangent_step / EDGE
        fields = places_mm / slope_mm
        for _ in range(CHIEF_ROUNDS):
            fields = np.clip(fields, -1.5, 1.5)
            tangents, _ = self.chiefs(fields, self.primary_um)
            off_mm = places_mm - camera.places_mm(tangents)
            fields = fields + off_mm / slope_mm
        return np.asarray(fields)

    def bundle(self, field: FloatArray, um: float, rays: int) -> _Bundle:
        """Rays of a pupil's grid (n, n) from a field (2,), relative to the largest, at a
        wavelength.
        """
        at = pupil_places(rays)
        across, down = np.meshgrid(at, at)
        filled = _filled(rays)
        radius = float(np.hypot(*field))
        radii, *factors = self._vignetting
        at_radius = radius * self.max_field
        beside_cut, along_cut, shift = (np.interp(at_radius, radii, part) for part in factors)
        # the field's direction is the factors' y
        turn_x, turn_y = field / radius if radius else np.array([0.0, 1.0])
        along = across * turn_x + down * turn_y
        beside = across * turn_y - down * turn_x
        moved_along = shift - along_cut * along
        moved_beside = beside_cut * beside
        # beyond it only where no light is
        vignetted_x = across + moved_along * turn_x - moved_beside * turn_y
        vignetted_y = down + moved_along * turn_y + moved_beside * turn_x
        px = np.clip(vignetted_x, -1, 1)
        py = np.clip(vignetted_y, -1, 1)
        hx = np.full(px.size, field[0])
        hy = np.full(px.size, field[1])

        def on_grid(values: Any) -> FloatArray:
            return np.array(values).reshape(px.shape)

        generate = self.optic.ray_tracer.ray_generator.generate_rays
        start = generate(hx, hy, px.ravel(), py.ravel(), um)
        x0 = on_grid(start.x)
        y0 = on_grid(start.y)
        z0 = on_grid(start.z)
        l0 = on_grid(start.L)
        m0 = on_grid(start.M)
        n0 = on_grid(start.N)
        end = self.optic.trace_generic(hx, hy, px.ravel(), py.ravel(), um)
        places, cosines = self.at_image(end)
        x = on_grid(places[0])
        y = on_grid(places[1])
        path = on_grid(end.opd)
        light = on_grid(end.i)
        arrives = np.isfinite(x + y + path) & (light > 0)
        good = (filled > 0) & arrives
        # A plane wave's path up to where its rays start, and the area of the beam that each ray
        # stands for.
        path = path + l0 * x0 + m0 * y0 + n0 * z0
        area = np.abs(_determinant(x0, y0)) * np.abs(n0)
        weighted = np.nan_to_num(light) * area * filled
        cosines = np.array(cosines).reshape(3, *px.shape)
        return _Bundle(x, y, cosines, path, np.where(good, weighted, 0.0))


def _vignetting(points: tuple[FieldPoint, ...]) -> FloatArray:
    """Field radii, and there: how much of the pupil is cut off across the field's direction and
    along it, and its shift.

    Shape (4, n). Factors are of the pupil's x and y, so a field's direction has to be one of them.
    Raises InputError.
    """
    rows = []
    for point in points:
        radius = math.hypot(point.x, point.y)
        beside, along = point.compression
        beside_shift, along_shift = point.shift
        sign = math.copysign(1.0, point.y)
        if point.x and not point.y:
            beside, along = along, beside
            beside_shift, along_shift = along_shift, beside_shift
            sign = math.copysign(1.0, point.x)
        is_even = beside == along and not point.shift[0] and not point.shift[1]
        is_diagonal = bool(point.x and point.y)
        if point.is_vignetted and (beside_shift or (is_diagonal and not is_even)):
            raise InputError(
                f"its field at {point.x:g}, {point.y:g} is vignetted along neither x nor y; write"
                " apertures of surfaces instead"
            )
        rows.append((radius, beside, along, along_shift * sign))
    return np.array(sorted(rows)).T


@lru_cache(maxsize=4)
def _filled(rays: int) -> FloatArray:
    """How much of each cell of a pupil's grid (n, n) lies within the pupil."""
    fine = pupil_places(rays * FINER)
    radius2 = fine**2 + fine[:, None] ** 2
    inside = radius2 <= 1
    cells = inside.reshape(rays, FINER, rays, FINER)
    return np.asarray(cells.mean(axis=(1, 3)))


def _size_of(value: Any) -> float:
    """The absolute value of a figure that Optiland gives as a number or as an array of one."""
    return abs(float(np.asarray(value).ravel()[0]))


def _determinant(a: FloatArray, b: FloatArray) -> FloatArray:
    """The determinant of the map from a grid's cells to (a, b): the area of each cell there."""
    a_down, a_right = np.gradient(a)
    b_down, b_right = np.gradient(b)
    return np.asarray(a_right * b_down - a_down * b_right)


def _glass(
    lens: _LensRays, plate: Plate, per_px: int | None, tolerance: float, made_by: str
) -> Traced:
    """The glass of rays' PSFs, at each place of a grid over the plate, wavelength and focus."""
    pitch_mm = plate.pitch_um * 1e-3
    middle = (np.array(plate.resolution_px) - 1) / 2
    camera = _Chiefs.of(lens)
    places = _field_points(lens, plate)
    fields = lens.fields_at(places * pitch_mm, camera)
    shortest_um = lens.wavelengths_um[0]
    samples = per_px or samples_a_px(plate.pitch_um, shortest_um, lens.f_number, MAX_SAMPLES)
    side = 2 * plate.half_px * samples + 1
    grid = (side, pitch_mm / samples)
    images = []
    at = []
    facts = []
    for um in lens.wavelengths_um:
        axis_light = float(lens.bundle(np.zeros(2), um, MIN_RAYS).light.sum())
        if axis_light <= 0:
            raise InputError(
                "no ray of its field's middle reaches the image; do apertures lie beside the beam?"
            )
        _, chiefs_mm = lens.chiefs(fields, um)
        for place, field, chief_mm in zip(places, fields, chiefs_mm, strict=True):
            slopes = _slopes(lens, field, um)
            light = float(lens.bundle(field, um, MIN_RAYS).light.sum()) / axis_light
            for focus_um in sorted(set(plate.focuses_um)):
                focused_mm = chief_mm + slopes * focus_um * 1e-3
                if light > MIN_LIT:
                    ray_of_light = (field, um, focus_um * 1e-3)
                    image, outside = _psf(lens, ray_of_light, focused_mm, grid)
                    illumination = min(light, 2.0)
                else:
                    image = _dark(side)
                    outside = 0.0
                    illumination = 0.0
                moved = focused_mm / pitch_mm - place
                images.append(image)
                at.append((*(middle + place), um * 1e3, focus_um))
                facts.append((illumination, outside, *moved))
    stack = Stack(np.array(images), np.array(at), np.array(facts), samples)
    focal_mm = camera.focal_length_mm
    history = (made_by, f"focal length {focal_mm:.6g} mm, F-number {lens.f_number:.4g}")
    glass = glass_of(stack, tolerance, camera.lens, history=history)
    return Traced(glass, focal_mm, lens.f_number)


def _field_points(lens: _LensRays, plate: Plate) -> FloatArray:
    """Places (n, 2) from the middle, px: a grid over the detector, or as much of it as the
    prescription's field has.
    """
    half = (np.array(plate.resolution_px) - 1) / 2
    if lens.max_field == 0:
        return np.zeros((1, 2))
    _, edge_mm = lens.chiefs(np.array([[0.0, 1.0]]), lens.primary_um)
    edge_px = float(np.linalg.norm(edge_mm)) / (plate.pitch_um * 1e-3)
    corner_px = float(np.hypot(*half))
    scale = min(1.0, edge_px / corner_px)
    half_x, half_y = half * scale
    columns = np.unique(np.linspace(-half_x, half_x, POINTS))
    rows = np.unique(np.linspace(-half_y, half_y, POINTS))
    x, y = np.meshgrid(columns, rows)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _slopes(lens: _LensRays, field: FloatArray, um: float) -> FloatArray:
    """How far (2,) a field's chief ray moves right and down for a step away from the lens."""
    pupil_middle = np.zeros(1)
    rays = lens.optic.trace_generic(field[:1], field[1:], pupil_middle, pupil_middle, um)
    _, cosines = lens.at_image(rays)
    across, down, along = cosines[:, 0]
    return np.array([across / along, down / along])


def _dark(side: int) -> FloatArray:
    """What stands for the PSF of a place without light: all light in its middle sample."""
    image = np.zeros((side, side))
    image[side // 2, side // 2] = 1.0
    return image


def _psf(
    lens: _LensRays,
    light: tuple[FloatArray, float, float],
    centre: FloatArray,
    grid: tuple[int, float],
) -> tuple[FloatArray, float]:
    """A PSF about its chief ray's place `centre` on its stamp's samples, and the share of its light
    outside of them.

    `light` is its field, wavelength (um) and defocus (mm), `grid` the stamp's side and step (mm).
    """
    field, um, defocus_mm = light
    side, step_mm = grid
    wave_mm = um * 1e-3
    needed = math.ceil(PERIOD_MARGIN * side * step_mm / (wave_mm * lens.f_number))
    if needed > MAX_RAYS:
        rays = lens.bundle(field, um, GEOMETRIC_RAYS)
        return _counted(rays, defocus_mm, centre, side, step_mm)
    rays = lens.bundle(field, um, max(MIN_RAYS, needed))
    return _waves(rays, um, defocus_mm, centre, grid)


def _waves(
    rays: _Bundle, um: float, defocus_mm: float, centre: FloatArray, grid: tuple[int, float]
) -> tuple[FloatArray, float]:
    """The PSF of the waves that rays stand for: their sum's square on the stamp's samples, by
    finer ones where these are wider than half a fringe.
    """
    side, step_mm = grid
    fringe_mm = um * 1e-3 * 0.5 * _fastest(rays)
    finer = max(1, math.ceil(step_mm / fringe_mm) // 2 * 2 + 1)
    samples = side * finer
    at_mm = (np.arange(samples) - samples // 2) * step_mm / finer
    wave = 2 * np.pi / (um * 1e-3)
    cos_x, cos_y, cos_z = rays.cosines
    # Solid angle times its cosine; of a cell at the pupil's edge both light and angle are a part.
    whole_angle = np.abs(_determinant(cos_x, cos_y))
    angle = np.nan_to_num(whole_angle) * _filled(len(rays.x))
    lit = rays.light > 0
    moved_x = rays.x - centre[0]
    moved_y = rays.y - centre[1]
    path = rays.path + cos_z * defocus_mm - cos_x * moved_x - cos_y * moved_y
    path = path[lit] - np.median(path[lit])
    light = rays.light[lit]
    angle = angle[lit]
    cos_x = cos_x[lit]
    cos_y = cos_y[lit]
    phase = np.exp(1j * wave * path)
    amplitude = np.sqrt(light * angle) * phase
    # a phase that no light shows
    middle_x = np.average(cos_x, weights=light)
    middle_y = np.average(cos_y, weights=light)
    across = np.exp(1j * wave * np.outer(cos_x - middle_x, at_mm))
    down = np.exp(1j * wave * np.outer(cos_y - middle_y, at_mm))
    waves = (down * amplitude[:, None]).T @ across
    intensity = np.abs(waves) ** 2
    # Parseval: the integral over the image is the wavelength squared times that of the squared
    # amplitude over solid angles.
    total = float(light.sum()) * (um * 1e-3 / (step_mm / finer)) ** 2
    image = intensity.reshape(side, finer, side, finer).sum(axis=(1, 3))
    return image, float(np.clip(1 - image.sum() / total, 0, 0.999))


def _fastest(rays: _Bundle) -> float:
    """The F-number of the fastest beam, across or down, that has light."""
    lit = rays.light > 0
    cos_x, cos_y, _ = rays.cosines
    across = np.ptp(cos_x[lit])
    down = np.ptp(cos_y[lit])
    widest = float(max(across, down))
    return 1 / max(1e-6, widest)


def _counted(
    rays: _Bundle, defocus_mm: float, centre: FloatArray, side: int, step_mm: float
) -> tuple[FloatArray, float]:
    """Rays shared out among the four samples nearest to each."""
    lit = rays.light > 0
    light = rays.light[lit]
    cos_x, cos_y, cos_z = rays.cosines[:, lit]
    x_mm = rays.x[lit] + cos_x / cos_z * defocus_mm - centre[0]
    y_mm = rays.y[lit] + cos_y / cos_z * defocus_mm - centre[1]
    x = x_mm / step_mm + side // 2
    y = y_mm / step_mm + side // 2
    first_column = np.floor(x).astype(np.intp)
    first_row = np.floor(y).astype(np.intp)
    image = np.zeros((side, side))
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share_y = np.abs(1 - down - (y - first_row))
        share_x = np.abs(1 - right - (x - first_column))
        share = light * share_y * share_x
        column = first_column + right
        row = first_row + down
        inside = (column >= 0) & (column < side) & (row >= 0) & (row < side)
        np.add.at(image, (row[inside], column[inside]), share[inside])
    return image, float(np.clip(1 - image.sum() / light.sum(), 0, 0.999))


@dataclass(frozen=True, slots=True)
class _Chiefs:
    """The camera of the chief rays at the primary wavelength: its focal length, mm, and
    Brown-Conrady distortion of tangents.
    """

    focal_length_mm: float
    lens: Lens | None

    def places_mm(self, tangents: FloatArray) -> FloatArray:
        """Places (n, 2), mm from the detector's middle, of directions (n, 2) by their tangents."""
        if self.lens is None:
            return np.asarray(self.focal_length_mm * tangents)
        u, v = self.lens.bent(*tangents.T)
        return np.asarray(self.focal_length_mm * np.stack([u, v], axis=1))

    @classmethod
    def of(cls, lens: _LensRays) -> "_Chiefs":
        """By least squares of places on the field's spokes."""
        if lens.max_field == 0:
            return cls(lens.focal_length_mm, None)
        turn = np.linspace(0, 2 * np.pi, DISTORTION_SPOKES, endpoint=False)
        radius = np.linspace(0, 1, DISTORTION_RAYS + 1)[1:]
        spokes = np.stack([np.sin(turn), np.cos(turn)], axis=1)
        fields = radius[:, None, None] * spokes
        fields = fields.reshape(-1, 2)
        tangents, places = lens.chiefs(fields, lens.primary_um)
        known = np.isfinite(places).all(axis=1)
        largest = float(np.hypot(*tangents.T).max())
        u, v = tangents[known].T / largest
        places = places[known] / largest
        r2 = u * u + v * v
        # A column of equations for each coefficient: all places' x, then all places' y.
        columns = []
        for power in range(4):
            columns.append(np.concatenate([u * r2**power, v * r2**power]))
        p1_x = 2 * u * v
        p1_y = r2 + 2 * v * v
        p2_x = r2 + 2 * u * u
        p2_y = 2 * u * v
        columns.append(np.concatenate([p1_x, p1_y]))
        columns.append(np.concatenate([p2_x, p2_y]))
        equations = np.stack(columns, axis=1)
        solution, *_ = np.linalg.lstsq(equations, places.T.ravel(), rcond=None)
        focal, *distortion = solution.tolist()
        # of tangents relative to the largest: turned back to tangents
        coefficients = []
        for relative, power in zip(distortion, (2, 4, 6, 1, 1), strict=True):
            coefficients.append(relative / focal / largest**power)
        k1, k2, k3, p1, p2 = coefficients
        return cls(focal, Lens((k1, k2, k3), (p1, p2)))
