"""A lens as a file states it, in mm: surfaces, glasses, apertures, fields and wavelengths.

Readers of formats (`zemax_file.py`, `codev_file.py`) make one; `optiland_lens.py` traces it.
"""

import codecs
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NoReturn, Self

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.reading import HEAD_BYTES, wide_encoding

# Lens units: an object this far is at infinity (OpticStudio's rule; CODE V writes 1e11 and more).
MIN_INFINITE = 1e10
# Of light that glass or a mirror passes on to a detector: what is beyond is in another unit.
MIN_WAVE_UM, MAX_WAVE_UM = 0.1, 30.0
MAX_INDEX = 6.0  # germanium's 4 is the largest of a lens
LINES_UM = {"d": 0.5875618, "F": 0.4861327, "C": 0.6562725, "g": 0.4358343}
# Schott's normal line: the partial dispersion P_g,F of glasses without anomalous dispersion
# (TIE-29).
NORMAL_P_GF, NORMAL_P_GF_PER_ABBE = 0.6438, -0.001682
CONRADY_POWER = 3.5
NEAR_OBJECT = "its object is near; write a lens whose object is at infinity, as stars are"

PupilKind = Literal["diameter", "f_number", "stop"]
FieldKind = Literal["angle", "paraxial_image_height", "real_image_height"]
Shape = Literal["circle", "rectangle", "ellipse", "spider"]


def nth(values: Sequence[float], number: int) -> float:
    """A value of a list that may end earlier; 0 behind its end."""
    return values[number] if number < len(values) else 0.0


def lens_text(data: bytes) -> str:
    """The text of a lens file's bytes: UTF-16 as OpticStudio writes it, or any of one byte."""
    wide = wide_encoding(data[:HEAD_BYTES])
    if wide is not None:
        return data.decode(wide, errors="replace").removeprefix("\ufeff")
    return data.removeprefix(codecs.BOM_UTF8).decode("latin-1")


class LensLine:
    """One statement of a lens file: its line's number, its keyword in capitals, and its words."""

    __slots__ = ("keyword", "number", "text", "words")

    def __init__(self, number: int, keyword: str, words: Sequence[str], text: str) -> None:
        self.number = number
        self.keyword = keyword
        self.words = tuple(words)
        self.text = text

    def refuse(self, why: str, instead: str) -> NoReturn:
        """Raise the InputError that names this line."""
        raise InputError(f"line {self.number}: {self.keyword} {why}; {instead}")

    def value(self, place: int = 0) -> float:
        """The finite number at a place among the words. Raises InputError."""
        if place >= len(self.words):
            self.refuse(f"has {len(self.words)} numbers", "write the one that is missing")
        return self._parsed(self.words[place])

    def length(self, place: int = 0) -> float:
        """The number at a place; inf for MIN_INFINITE and more, or for a word of it."""
        if place < len(self.words) and self.words[place].lstrip("+-").upper() in {
            "INF",
            "INFINITY",
        }:
            return math.inf
        value = self.value(place)
        return math.inf if abs(value) >= MIN_INFINITE else value

    def same_as(self, other: "LensLine | None") -> bool:
        """Whether another line, if there is one, says the same."""
        return other is None or other.words == self.words

    def numbers(self) -> tuple[float, ...]:
        """All its words as numbers. Raises InputError."""
        return tuple(self._parsed(word) for word in self.words)

    def is_zero(self) -> bool:
        """Whether each of its words is the number 0."""
        return not any(self.numbers())

    def _parsed(self, word: str) -> float:
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            self.refuse(f'has "{word}" where a number stands', "write a number")
        return number


@dataclass(frozen=True, slots=True)
class Glass:
    """What light meets at a surface: air, a mirror, a catalogue's glass, or an index of its own.

    `catalogues` are searched in their order; none: all. `index_d` is given of a model glass alone;
    `abbe` 0 is a constant index, and `anomaly` is its distance from the normal line of P_g,F.
    """

    name: str = ""
    catalogues: tuple[str, ...] = ()
    index_d: float | None = None
    abbe: float = 0.0
    anomaly: float = 0.0

    @property
    def is_mirror(self) -> bool:
        """Whether the surface reflects."""
        return self.name == "MIRROR"

    @property
    def is_air(self) -> bool:
        """Whether there is no glass."""
        return not self.name and self.index_d is None

    def model_index(self, um: float | FloatArray) -> FloatArray:
        """The index of a model glass at wavelengths, um.

        Conrady's n0 + a/l + b/l^3.5 through n_d, V_d and P_g,F.
        """
        if self.index_d is None:
            raise InputError(f"the glass {self.name} has no index of its own")
        wavelength = np.asarray(um, dtype=np.float64)
        if self.abbe == 0:
            return np.full(wavelength.shape, self.index_d)
        dispersion = (self.index_d - 1) / self.abbe
        partial = NORMAL_P_GF + NORMAL_P_GF_PER_ABBE * self.abbe + self.anomaly
        rows = {name: np.array(_conrady(line)) for name, line in LINES_UM.items()}
        matrix = np.stack([rows["d"], rows["F"] - rows["C"], rows["g"] - rows["F"]])
        given = np.array([self.index_d, dispersion, partial * dispersion])
        constant, first, second = np.linalg.solve(matrix, given)
        _, by_wavelength, by_power = _conrady(wavelength)
        return np.asarray(constant + first * by_wavelength + second * by_power)


def _conrady(um: float | FloatArray) -> tuple[float, FloatArray, FloatArray]:
    wavelength = np.asarray(um, dtype=np.float64)
    return 1.0, 1 / wavelength, wavelength**-CONRADY_POWER


def glass_of_code(code: str) -> Glass | None:
    """A glass of a code such as 517642 or 516800.641700: n_d - 1 and V_d; None for another name."""
    index, _, abbe = code.partition(".")
    if not code.replace(".", "", 1).isdigit():
        return None
    if not abbe and len(index) == 6:
        index, abbe = index[:3], index[3:]
    if len(index) < 3 or len(abbe) < 3:
        return None
    index_d = 1 + float(f"0.{index}")
    return Glass(code, index_d=index_d, abbe=float(f"{abbe[:2]}.{abbe[2:]}"))


@dataclass(frozen=True, slots=True)
class Aperture:
    """A part of a surface, mm, from its vertex: where light passes alone, or where none passes.

    A circle lies between `smallest_mm` and `half_mm[0]`; a rectangle and an ellipse have
    half-widths along x and y; a spider `arms` of width 2 `half_mm[0]`, the first along +x, evenly
    in angle.
    """

    shape: Shape
    half_mm: tuple[float, float]
    is_clear: bool
    smallest_mm: float = 0.0
    centre_mm: tuple[float, float] = (0.0, 0.0)
    arms: int = 0

    def passes(self, x_mm: npt.ArrayLike, y_mm: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether light at places on the surface goes on."""
        x = np.asarray(x_mm, dtype=np.float64) - self.centre_mm[0]
        y = np.asarray(y_mm, dtype=np.float64) - self.centre_mm[1]
        inside = self._inside(x, y)
        return np.asarray(inside if self.is_clear else ~inside)

    def _inside(self, x: FloatArray, y: FloatArray) -> npt.NDArray[np.bool_]:
        half_x, half_y = self.half_mm
        if self.shape == "rectangle":
            return np.asarray((np.abs(x) <= half_x) & (np.abs(y) <= half_y))
        if self.shape == "ellipse":
            return np.asarray((x / half_x) ** 2 + (y / half_y) ** 2 <= 1)
        if self.shape == "spider":
            return self._on_arms(x, y)
        radius = np.hypot(x, y)
        return np.asarray((radius >= self.smallest_mm) & (radius <= half_x))

    def _on_arms(self, x: FloatArray, y: FloatArray) -> npt.NDArray[np.bool_]:
        on_any = np.zeros(np.shape(x), dtype=bool)
        for number in range(self.arms):
            turn_rad = 2 * np.pi * number / self.arms
            along = x * np.cos(turn_rad) + y * np.sin(turn_rad)
            across = y * np.cos(turn_rad) - x * np.sin(turn_rad)
            on_any |= (along >= 0) & (np.abs(across) <= self.half_mm[0])
        return on_any


@dataclass(frozen=True, slots=True)
class LensSurface:
    """A surface and what follows it. `polynomial` has the coefficients of r, r^2, r^3, ... in mm.

    `turn` (3, 3) turns its axes into those of the lens, `origin_mm` is its vertex there.
    """

    label: str
    curvature_per_mm: float
    conic: float
    polynomial: tuple[float, ...]
    glass: Glass
    apertures: tuple[Aperture, ...]
    is_stop: bool
    turn: FloatArray = field(repr=False)
    origin_mm: FloatArray = field(repr=False)
    paraxial_focal_mm: float | None = None

    @property
    def paraxial_curvature_per_mm(self) -> float:
        """The curvature at the vertex: a term in r^2 bends, too."""
        if len(self.polynomial) > 1:
            second = self.polynomial[1]
        else:
            second = 0.0
        return self.curvature_per_mm + 2 * second


@dataclass(frozen=True, slots=True)
class FieldPoint:
    """A point of the field: degrees, or mm of image height; and how much of its pupil is lit.

    The pupil's coordinates p (x, y; 1 at its edge) of what is lit are `shift` + p (1 -
    `compression`), along x and y.
    """

    x: float
    y: float
    compression: tuple[float, float] = (0.0, 0.0)
    shift: tuple[float, float] = (0.0, 0.0)

    @property
    def is_vignetted(self) -> bool:
        """Whether the field point has vignetting factors: a pupil that is compressed or shifted."""
        return any((*self.compression, *self.shift))


@dataclass(frozen=True, slots=True)
class LensPrescription:
    """A lens for an object at infinity; its last surface is the image.

    `pupil` is the entrance pupil's diameter (mm), the F-number, or the stop's diameter (mm), by
    `pupil_kind`. `notes` are lines for the person: what was taken where the file says nothing, and
    what it says that no star's light shows.
    """

    surfaces: tuple[LensSurface, ...]
    pupil_kind: PupilKind
    pupil: float
    field_kind: FieldKind
    fields: tuple[FieldPoint, ...]
    wavelengths_um: tuple[float, ...]
    primary: int
    notes: tuple[str, ...] = ()

    def check(self) -> Self:
        """This lens, where it can be traced. Raises InputError: what it lacks."""
        if len(self.surfaces) < 2:
            raise InputError("it has no surfaces between object and image; write the lens's")
        if not self.wavelengths_um or min(self.wavelengths_um) <= 0:
            raise InputError("it has no wavelength above 0; write those of its light")
        for wave_um in self.wavelengths_um:
            if not MIN_WAVE_UM <= wave_um <= MAX_WAVE_UM:
                known = f"write {MIN_WAVE_UM:g} to {MAX_WAVE_UM:g} um (WAVM), in nm (WL)"
                raise InputError(
                    f"its wavelength is {wave_um:g} um: is it in another unit? {known}"
                )
        if not 0 <= self.primary < len(self.wavelengths_um):
            count = len(self.wavelengths_um)
            raise InputError(f"its primary wavelength is number {self.primary + 1} of {count}")
        if self.pupil <= 0:
            raise InputError("it has no aperture above 0; write the pupil's diameter, or F-number")
        if sum(surface.is_stop for surface in self.surfaces) > 1:
            raise InputError("it has two stops; write one")
        self._check_pupil_fits()
        return self

    def _check_pupil_fits(self) -> None:
        first = self.surfaces[0]
        if self.pupil_kind != "diameter" or first.conic <= -1:
            return
        if self.pupil / 2 * abs(first.curvature_per_mm) * math.sqrt(1 + first.conic) >= 1:
            radius = f"a radius of {1 / first.curvature_per_mm:.4g} mm"
            raise InputError(
                f"{first.label} has {radius}, and the pupil is {self.pupil:.4g} mm wide: no ray at"
                " its edge meets it; are radii and curvatures, or units, mixed up?"
            )


class LensFileReader(ABC):
    """What readers of lens files share: the parts of a file, put together to a lens.

    `notes` are lines for the person. Every part raises InputError.
    """

    notes: list[str]

    def lens(self) -> LensPrescription:
        """The prescription of all that was read. Raises InputError."""
        self._check_ends()
        kind, pupil = self._pupil()
        waves, primary = self._wavelengths()
        lens = LensPrescription(
            surfaces=tuple(self._placed()),
            pupil_kind=kind,
            pupil=pupil,
            field_kind=self._field_kind(),
            fields=tuple(self._fields()),
            wavelengths_um=waves,
            primary=primary,
            notes=tuple(self.notes),
        )
        return lens.check()

    @abstractmethod
    def _check_ends(self) -> None:
        """Refuse an object that is near, and a lens without an image."""

    @abstractmethod
    def _pupil(self) -> tuple[PupilKind, float]:
        """How the pupil is stated, and its size (mm) or F-number."""

    @abstractmethod
    def _wavelengths(self) -> tuple[tuple[float, ...], int]:
        """The wavelengths, um, each once, and the place of the primary one."""

    @abstractmethod
    def _field_kind(self) -> FieldKind:
        """What the numbers of the fields are."""

    @abstractmethod
    def _fields(self) -> Iterator[FieldPoint]:
        """The fields, deg or mm."""

    @abstractmethod
    def _placed(self) -> Iterator[LensSurface]:
        """The surfaces but the object, each in the axes of the lens."""


def only_aperture(statements: Mapping[str, LensLine], names: Sequence[str], near: str) -> LensLine:
    """The one statement of a lens's aperture among `names` and `near`, that of a near object.

    Raises InputError where there is none, or several, or the one of a near object.
    """
    stated = [statements[name] for name in (*names, near) if name in statements]
    if len(stated) != 1:
        given = ", ".join(line.keyword for line in stated) or "none"
        times = f"{len(stated)} times ({given})"
        raise InputError(f"its aperture is stated {times}; write one of {_listed(names, 'and')}")
    line = stated[0]
    if line.keyword == near:
        line.refuse("is of a near object", f"write {_listed(names, 'or')}, as for stars")
    return line


def _listed(names: Sequence[str], last: str) -> str:
    return f"{', '.join(names[:-1])} {last} {names[-1]}"


def add_once(statements: dict[str, LensLine], line: LensLine, where: str = "") -> None:
    """Keep a statement by its keyword. Raises InputError for one that says otherwise before it."""
    before = statements.get(line.keyword)
    if not line.same_as(before):
        assert before is not None
        line.refuse(f"{where}says otherwise than line {before.number}", "leave one of them")
    statements[line.keyword] = line


class Frame:
    """The axes of the surface that a reader of a lens file has come to, in the axes of the lens."""

    def __init__(self) -> None:
        self.turn: FloatArray = np.eye(3)
        self.origin_mm: FloatArray = np.zeros(3)

    def move(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """Move the vertex along its own axes."""
        self.origin_mm = self.origin_mm + self.turn @ np.array([x_mm, y_mm, z_mm])

    def rotate(self, rotation: FloatArray) -> None:
        """Turn by a matrix (3, 3) of its own axes."""
        self.turn = self.turn @ rotation
