"""A glass from its pupil and its aberrations: diffraction PSFs by Zernike or Seidel coefficients
over field and wavelength.

The pupil's field is exp(2 pi i W / wavelength) within the aperture, W the wavefront's lead over the
reference sphere; poppy (Perrin et al. 2012, SPIE 8442) makes the Zernike polynomials and propagates
it. Pupil axes are the detector's, x right and y down. Coordinates in the pupil are relative to its
radius.
"""

import math
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, MachineError, shortened
from hilstar.basics.reading import parse_toml, read_text
from hilstar.basics.toml_tables import Table
from hilstar.optics.glass.psf_file import Glass, Stack, glass_of, pupil_places, samples_a_px

MAX_BYTES = 1_000_000
ADVICE = "give a TOML file as docs/optics.md has it"
PUPIL, FINER = 256, 4  # samples across the pupil, and of each of them along an axis at its edges
MAX_SAMPLES = 32  # a tracker pixel, where --oversampling does not say
MAX_STEP_WAVES = 0.5  # wavefront step between pupil samples; beyond it the PSF is an alias
CAN_INSTALL = "pip install 'hilstar[optics]'"
Positive = Annotated[float, Meta(gt=0, le=1e6)]
Nm = Annotated[float, Meta(ge=-1e6, le=1e6)]


class Term(Table, frozen=True):
    """A Zernike term by Noll's index (rms), or a Seidel one (at the pupil's edge), in nm at the
    field's corner or on the axis.

    A Zernike term grows with the field's radius to the power `field_power`, 0 for the same
    everywhere, and keeps its orientation. Seidel terms grow as they do (W131 with the field, W222
    and W220 with its square) and turn with the field. `per_nm` is added for each nm of wavelength
    over `reference_nm`.
    """

    kind: Literal["zernike", "W020", "W040", "W131", "W222", "W220"]
    nm: Nm
    noll: Annotated[int, Meta(ge=2, le=200)] = 4
    field_power: Annotated[int, Meta(ge=0, le=8)] = 0
    per_nm: Nm = 0.0


class Pupil(Table, frozen=True):
    """The file of `hilstar optics zernike`."""

    aperture_mm: Positive
    focal_length_mm: Positive
    pixel_pitch_um: Positive
    resolution_px: tuple[Annotated[int, Meta(ge=1, le=32768)], Annotated[int, Meta(ge=1, le=32768)]]
    wavelengths_nm: Annotated[
        tuple[Annotated[float, Meta(ge=100, le=20_000)], ...], Meta(min_length=1, max_length=50)
    ]
    reference_nm: Positive = 550.0
    focuses_um: Annotated[
        tuple[Annotated[float, Meta(ge=-1e5, le=1e5)], ...], Meta(min_length=1, max_length=50)
    ] = (0.0,)
    points: Annotated[int, Meta(ge=1, le=50)] = 5
    half_px: Annotated[int, Meta(ge=1, le=100)] = 8
    obstruction: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    spiders: Annotated[int, Meta(ge=0, le=12)] = 0
    spider_width_mm: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    spider_angle_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    lateral_per_nm: Annotated[float, Meta(ge=-0.01, le=0.01)] = 0.0
    cos4: bool = True
    terms: tuple[Term, ...] = ()


def glass_of_pupil(path: Path, per_px: int | None, tolerance: float) -> Glass:
    """The glass of a file's pupil. Raises InputError, and MachineError without poppy."""
    try:
        pupil = msgspec.convert(parse_toml(path, read_text(path, ADVICE, MAX_BYTES)), Pupil)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {shortened(str(error))}; {ADVICE}") from error
    f_number = pupil.focal_length_mm / pupil.aperture_mm
    shortest_um = min(pupil.wavelengths_nm) * 1e-3
    fine = samples_a_px(pupil.pixel_pitch_um, shortest_um, f_number, MAX_SAMPLES)
    samples = per_px or fine
    try:
        stack = diffracted(pupil, samples)
        return glass_of(stack, tolerance, history=(f"hilstar optics zernike of {path.name}",))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def diffracted(pupil: Pupil, per_px: int) -> Stack:
    """The PSFs of a pupil at its field points, wavelengths and focus positions. Raises
    InputError and MachineError.
    """
    pupil_field = PupilField(pupil)
    width, height = pupil.resolution_px
    middle = (np.array(pupil.resolution_px) - 1) / 2
    columns = _grid_places(width, pupil.points)
    rows = _grid_places(height, pupil.points)
    wavelengths_nm = sorted(set(pupil.wavelengths_nm))
    focuses_um = sorted(set(pupil.focuses_um))
    images = []
    places = []
    facts = []
    for x_px, y_px, nm, focus_um in product(columns, rows, wavelengths_nm, focuses_um):
        off_px = np.array([x_px, y_px]) - middle
        field = pupil_field(off_px, nm, focus_um)
        image, outside = psf_of(pupil, field, nm, per_px)
        images.append(image)
        places.append((x_px, y_px, nm, focus_um))
        px_tangent = pupil.pixel_pitch_um * 1e-3 / pupil.focal_length_mm
        slope2 = px_tangent**2 * (off_px @ off_px)
        growth = pupil.lateral_per_nm * (nm - pupil.reference_nm)
        lateral_px = growth * off_px
        illumination = (1 + slope2) ** -2 if pupil.cos4 else 1.0
        facts.append((illumination, outside, *lateral_px))
    return Stack(np.array(images), np.array(places), np.array(facts), per_px)


def _grid_places(size: int, points: int) -> FloatArray:
    """Places (points,), px, along an axis: from edge to edge, or the middle alone."""
    if points == 1:
        return np.array([(size - 1) / 2])
    return np.linspace(0, size - 1, points)


class PupilField:
    """The complex field of a pupil (PUPIL, PUPIL) at a place of the image, a wavelength and a
    focus.
    """

    def __init__(self, pupil: Pupil) -> None:
        self._pupil = pupil
        self._amplitude = aperture(pupil)
        at = pupil_places(PUPIL)
        self._x, self._y = np.meshgrid(at, at)
        self._r2 = self._x**2 + self._y**2
        radius = np.minimum(np.sqrt(self._r2), 1.0)
        polar = {"rho": radius, "theta": np.arctan2(self._y, self._x), "outside": 0.0}
        self._zernikes: dict[int, FloatArray] = {}
        for term in pupil.terms:
            if term.kind == "zernike" and term.noll not in self._zernikes:
                self._zernikes[term.noll] = _poppy().zernike.zernike1(term.noll, **polar)

    def __call__(self, off_px: FloatArray, nm: float, focus_um: float) -> FloatArray:
        """The field at a place, px from the image's middle. Raises InputError where its samples
        are too coarse.
        """
        pupil = self._pupil
        distance_px = float(np.hypot(*off_px))
        diagonal_px = float(np.hypot(*pupil.resolution_px))
        radius = distance_px / (diagonal_px / 2)
        direction_x, direction_y = off_px / max(distance_px, 1e-12)
        along = self._x * direction_x + self._y * direction_y
        # a defocus of a lens by its sagitta: the wave's at the pupil's edge is focus / (8 N^2)
        inverse_f_number = pupil.aperture_mm / pupil.focal_length_mm
        wave_nm = 1e3 * focus_um / 8 * inverse_f_number**2 * self._r2
        for term in pupil.terms:
            size_nm = term.nm + term.per_nm * (nm - pupil.reference_nm)
            match term.kind:
                case "zernike":
                    growth = radius**term.field_power
                    wave_nm = wave_nm + size_nm * growth * self._zernikes[term.noll]
                case "W020":
                    wave_nm = wave_nm + size_nm * self._r2
                case "W040":
                    wave_nm = wave_nm + size_nm * self._r2**2
                case "W131":
                    wave_nm = wave_nm + size_nm * radius * self._r2 * along
                case "W222":
                    wave_nm = wave_nm + size_nm * radius**2 * along**2
                case "W220":
                    wave_nm = wave_nm + size_nm * radius**2 * self._r2
        lit = self._amplitude > 0
        steps_down = np.abs(np.diff(wave_nm, axis=0))
        steps_right = np.abs(np.diff(wave_nm, axis=1))
        largest_down_nm = steps_down[lit[1:, :]].max(initial=0.0)
        largest_right_nm = steps_right[lit[:, 1:]].max(initial=0.0)
        waves = max(largest_down_nm, largest_right_nm) / nm
        if waves > MAX_STEP_WAVES:
            raise InputError(
                f"the wavefront at {nm:g} nm and focus {focus_um:g} um changes by {waves:.2g} waves"
                f" from one of {PUPIL} pupil samples to the next; write smaller coefficients or"
                " focus positions"
            )
        phase = np.exp(2j * np.pi / nm * wave_nm)
        return np.asarray(self._amplitude * phase)


def aperture(pupil: Pupil) -> FloatArray:
    """How much of each of the pupil's samples (PUPIL, PUPIL) is open, 0 to 1."""
    at = pupil_places(PUPIL * FINER)
    x, y = np.meshgrid(at, at)
    r2 = x * x + y * y
    is_open = (r2 <= 1) & (r2 >= pupil.obstruction**2)
    half = pupil.spider_width_mm / pupil.aperture_mm
    for k in range(pupil.spiders):
        angle = math.radians(pupil.spider_angle_deg + 360 * k / pupil.spiders)
        cosine = math.cos(angle)
        sine = math.sin(angle)
        along = x * cosine + y * sine
        across = y * cosine - x * sine
        is_open &= (np.abs(across) > half) | (along < 0)
    by_sample = is_open.reshape(PUPIL, FINER, PUPIL, FINER)
    return np.asarray(by_sample.mean(axis=(1, 3)))


def psf_of(pupil: Pupil, field: FloatArray, nm: float, per_px: int) -> tuple[FloatArray, float]:
    """The PSF of a pupil's field on the stamp's samples, and the share of its light outside of
    them.

    poppy's transform keeps the light by Parseval's theorem; that of a sample at the pupil's edge is
    its open part. The kernel is exp(+i), so that light goes against the slope of a leading
    wavefront, as rays do. Raises InputError for samples too coarse for the diffraction.
    """
    side = 2 * pupil.half_px * per_px + 1
    resolution_um = nm * 1e-3 * pupil.focal_length_mm / pupil.aperture_mm
    step = pupil.pixel_pitch_um / per_px / resolution_um  # in units of wavelength / D
    if step >= 1:
        finest = math.ceil(2 * pupil.pixel_pitch_um / resolution_um)
        raise InputError(
            f"{per_px} samples a pixel are too few for light of {nm:g} nm; write --oversampling"
            f" {finest}"
        )
    transform = _poppy().matrixDFT.MatrixFourierTransform(centering="SYMMETRIC")
    waves = transform.perform(field, side * step, side)
    image = np.abs(waves) ** 2
    inside = float(image.sum() / np.abs(field).sum())
    outside = 1 - inside
    return image, max(0.0, outside)


def _poppy() -> Any:
    """poppy, which only pupils need. Raises MachineError without it."""
    try:
        import poppy.matrixDFT
        import poppy.zernike
    except ImportError as error:
        raise MachineError(f"hilstar optics zernike needs poppy: {CAN_INSTALL}") from error
    return poppy
