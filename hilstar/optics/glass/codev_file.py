"""Reads .seq of CODE V, by a list of commands that are used and one of those ignored.

A command on neither list is refused by its line: what it does to light is not known. Commands are
those of CODE V's reference manual; names have three letters, of which longer ones are forms
(TITLE). The file's own solves and pickups are passed over, as it has the values that they gave.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.optics.glass.lens_data import (
    MAX_INDEX,
    NEAR_OBJECT,
    Aperture,
    FieldKind,
    FieldPoint,
    Frame,
    Glass,
    LensFileReader,
    LensLine,
    LensPrescription,
    LensSurface,
    PupilKind,
    Shape,
    add_once,
    glass_of_code,
    lens_text,
    nth,
    only_aperture,
)

AIR, MIRROR = Glass(), Glass("MIRROR")
MM_PER_UNIT = {"M": 1.0, "MM": 1.0, "C": 10.0, "CM": 10.0, "I": 25.4, "IN": 25.4}
NM_PER_UM = 1000.0
LONG_FORMS = {"TITLE": "TIT", "STOP": "STO"}
SURFACES = frozenset({"SO", "S", "SI"})
ONCE = frozenset({"RDM", "DIM", "WL", "REF", "EPD", "FNO", "NA", "NAO", "TEM", "POL"})
FIELDS = frozenset({"XAN", "YAN", "XIM", "YIM", "XRI", "YRI", "VUX", "VLX", "VUY", "VLY"})
FIELD_LISTS: dict[FieldKind, tuple[str, str]] = {
    "angle": ("XAN", "YAN"),
    "paraxial_image_height": ("XIM", "YIM"),
    "real_image_height": ("XRI", "YRI"),
}
TERMS = "ABCDEFGHJ"  # of r^4, r^6, ... r^20
VALUES = frozenset({"K", "XDE", "YDE", "ZDE", "ADE", "BDE", "CDE", "ADX", "ADY", "ARO", *TERMS})
MARKS = frozenset({"STO", "SPH", "CON", "ASP", "DAR", "BEN", "REV"})
SHAPES: dict[str, Shape] = {
    "CIR": "circle",
    "REX": "rectangle",
    "REY": "rectangle",
    "ELX": "ellipse",
    "ELY": "ellipse",
}
OTHER_COMMANDS = {"REX": "REY", "REY": "REX", "ELX": "ELY", "ELY": "ELX"}
Halves = dict[tuple[str, str], float]
KINDS_OF_EDGE = frozenset({"OBS", "HOL", "EDG", "CLR"})
# What no star's light shows. Each group has its reason.
IGNORED = frozenset(
    {
        *(
            "LEN",
            "TIT",
            "INI",
            "SLB",
            "GO",
            "END",
            "COM",
            "CLS",
            "OUT",
            "VER",
        ),  # words for people, drawings, the end
        *(
            "WTW",
            "WTF",
            "DER",
            "TOL",
            "CA",
            "DEL",
        ),  # weights, tolerances, and the rule of apertures that are not stated
        *(
            "CCY",
            "THC",
            "GLC",
            "KC",
            "CUC",
            "PIK",
            "PIM",
            "HMY",
            "RDC",
        ),  # which values may vary; solves, whose values are here
        *(f"{term}C" for term in TERMS),
        *("XDC", "YDC", "ZDC", "ADC", "BDC", "CDC"),
        *("CUM", "THM"),  # a mirror's back
    }
)
# Those that are 0 where they change nothing.
IGNORED_AT_ZERO = frozenset({"CUF", "IC", "XOD", "YOD", "ZOD"})
STANDARD_C = 20.0
# A smaller radius, by the thickness behind it, is refused where no RDM says what the number is.
MIN_RADIUS_OF_THICKNESS = 0.05
PRIVATE_START, PRIVATE_END = "PRV", "END"
ADVICE = "save the lens without it"
CAN_WRITE = "save it from CODE V as a sequence file (.seq)"


@dataclass(slots=True)
class _Surface:
    number: int
    line: LensLine
    values: dict[str, LensLine] = field(default_factory=dict)
    apertures: list[LensLine] = field(default_factory=list)

    @property
    def label(self) -> str:
        if self.line.keyword == "SI":
            name = "image"
        else:
            name = f"surface {self.number}"
        return f"{name} (line {self.line.number})"

    def number_of(self, keyword: str) -> float:
        line = self.values.get(keyword)
        return 0.0 if line is None else line.value()


def read_codev(data: bytes) -> LensPrescription:
    """The lens of a file's bytes. Raises InputError that names the line."""
    return _Reader(list(_statements(data))).lens()


def _statements(data: bytes) -> Iterator[LensLine]:
    """Commands with their words.

    `;` ends one, `&` at a line's end goes on, `!` begins a comment; quoted words are whole.
    """
    before = ""
    start = 0
    for number, line in enumerate(lens_text(data).splitlines(), 1):
        start = start if before else number
        whole = before + _without_comment(line)
        if whole.rstrip().endswith("&"):
            before = whole.rstrip()[:-1] + " "
            continue
        before = ""
        for part in _parts(whole):
            items = re.findall(r"'[^']*'|\"[^\"]*\"|\S+", part)
            if items:
                keyword = items[0].upper()
                yield LensLine(start, LONG_FORMS.get(keyword, keyword), items[1:], part)


def _without_comment(line: str) -> str:
    return re.match(r"(?:'[^']*'|\"[^\"]*\"|[^!])*", line)[0]  # type: ignore[index]


def _parts(line: str) -> list[str]:
    return re.findall(r"(?:'[^']*'|\"[^\"]*\"|[^;])+", line)


class _Reader(LensFileReader):
    """Goes through the commands once, into system data and surfaces, and makes the lens of them."""

    def __init__(self, lines: list[LensLine]) -> None:
        self.system: dict[str, LensLine] = {}
        self.surfaces: list[_Surface] = []
        self.private: dict[str, int] = {}
        self.notes: list[str] = []
        self._is_private = False
        for line in lines:
            self._take(line)
        if not self.surfaces or self.surfaces[0].line.keyword != "SO":
            raise InputError(f"it has no object surface (SO); {CAN_WRITE}")
        self.mm = self._unit_mm()
        self.has_radii = self._radius_mode()
        self._check_system()

    def _take(self, line: LensLine) -> None:
        if self._is_private:
            self._take_private(line)
        elif line.keyword == PRIVATE_START:
            self._is_private = True
        elif line.keyword in SURFACES:
            self.surfaces.append(_Surface(len(self.surfaces), line))
        elif line.keyword in ONCE or line.keyword in FIELDS:
            add_once(self.system, line)
        elif not self._is_ignored(line):
            self._take_of_surface(line)

    def _is_ignored(self, line: LensLine) -> bool:
        """Whether no star shows it.

        `THI HMY 0` states how a thickness came about that the surface's own line has.
        """
        is_named = len(line.words) > 1 and line.words[0].isalpha()
        is_solve = is_named and line.keyword in {"THI", "CUY", "RDY"}
        is_nothing = line.keyword in IGNORED_AT_ZERO and line.is_zero()
        return line.keyword in IGNORED or is_solve or is_nothing

    def _take_private(self, line: LensLine) -> None:
        """Private glasses are refused where a surface has one."""
        name = line.keyword.strip("'\"")
        if line.keyword == PRIVATE_END:
            self._is_private = False
        elif line.keyword.startswith(("'", '"')):
            self.private[name] = line.number

    def _take_of_surface(self, line: LensLine) -> None:
        if not self.surfaces:
            line.refuse("is not known", ADVICE)
        surface = self.surfaces[-1]
        is_plain = not line.words or not line.words[0].upper().startswith("S")
        if line.keyword in SHAPES:
            surface.apertures.append(line)
        elif line.keyword in VALUES | MARKS and is_plain:
            if len(line.words) > 1 and line.keyword in VALUES:
                more = shortened(" ".join(line.words[1:]))
                line.refuse(f"at {surface.label} has {more} behind it", "put ; between commands")
            add_once(surface.values, line, f"at {surface.label} ")
        else:
            line.refuse(f"at {surface.label} is not known", ADVICE)

    def _unit_mm(self) -> float:
        line = self.system.get("DIM")
        if line is None:
            self.notes.append("it says no DIM: its lengths are taken as mm, CODE V's default")
            return 1.0
        unit = line.words[0].upper() if line.words else ""
        if unit not in MM_PER_UNIT:
            line.refuse(f"is {unit or 'empty'}", "write M (mm), C (cm) or I (inch)")
        return MM_PER_UNIT[unit]

    def _radius_mode(self) -> bool:
        """Whether surfaces have radii; without RDM they have curvatures, which is CODE V's rule."""
        line = self.system.get("RDM")
        if line is None:
            self.notes.append("it says no RDM: its surfaces have curvatures, CODE V's default")
            return False
        mode = line.words[0].upper() if line.words else "Y"
        if mode not in {"Y", "N", "YES", "NO"}:
            line.refuse(f"is {mode}", "write RDM Y for radii, RDM N for curvatures")
        return mode.startswith("Y")

    def _check_system(self) -> None:
        heat = self.system.get("TEM")
        if heat is not None and heat.value() != STANDARD_C:
            heat.refuse(
                f"puts the lens at {heat.value():g} C",
                "save it at 20 C, of which catalogues give their indices",
            )
        light = self.system.get("POL")
        if light is not None and light.words and light.words[0].upper().startswith("Y"):
            light.refuse("asks for polarised rays", "write POL N")

    def _check_ends(self) -> None:
        start = self.surfaces[0]
        if self._thickness(start) != np.inf:
            raise InputError(f"{start.label}: {NEAR_OBJECT}")
        if self.surfaces[-1].line.keyword != "SI":
            raise InputError(f"it has no image surface (SI); {CAN_WRITE}")

    def _pupil(self) -> tuple[PupilKind, float]:
        line = only_aperture(self.system, ("EPD", "FNO", "NA"), "NAO")
        if line.keyword == "EPD":
            return "diameter", line.value() * self.mm
        if line.value() <= 0:
            line.refuse(f"is {line.value():g}", "write a number above 0")
        # CODE V's NA is that of the image's side: 1 / (2 F) for a paraxial pupil in air.
        if line.keyword == "FNO":
            f_number = line.value()
        else:
            f_number = 1 / (2 * line.value())
        return "f_number", f_number

    def _wavelengths(self) -> tuple[tuple[float, ...], int]:
        line = self.system.get("WL")
        if line is None:
            raise InputError("it has no wavelengths (WL); write those of its light, nm")
        waves = tuple(number / NM_PER_UM for number in line.numbers())
        reference = self.system.get("REF")
        if reference is not None:
            number = int(reference.value()) - 1
        else:
            number = len(waves) // 2
        if not 0 <= number < len(waves):
            which = f"wavelength {number + 1} of {len(waves)}"
            raise InputError(f"REF names {which}; write one that there is")
        distinct = tuple(dict.fromkeys(waves))
        return distinct, distinct.index(waves[number])

    def _field_kind(self) -> FieldKind:
        kinds: list[FieldKind] = []
        for kind, names in FIELD_LISTS.items():
            if any(name in self.system for name in names):
                kinds.append(kind)
        if len(kinds) > 1:
            raise InputError("its field is in angles and in image heights; write one of them")
        return kinds[0] if kinds else "angle"

    def _numbers(self, name: str) -> tuple[float, ...]:
        """The numbers behind a name, none where it is not stated."""
        line = self.system.get(name)
        if line is None:
            return ()
        return tuple(line.numbers())

    def _fields(self) -> Iterator[FieldPoint]:
        kind = self._field_kind()
        scale = 1.0 if kind == "angle" else self.mm
        names = (*FIELD_LISTS[kind], "VUX", "VLX", "VUY", "VLY")
        lists = {name: self._numbers(name) for name in names}
        x_name, y_name = FIELD_LISTS[kind]
        for number in range(max(1, len(lists[x_name]), len(lists[y_name]))):
            at = {name: nth(values, number) for name, values in lists.items()}
            # VU and VL are the parts of the pupil that are cut off above and below.
            compression = (at["VUX"] + at["VLX"]) / 2, (at["VUY"] + at["VLY"]) / 2
            shift = (at["VLX"] - at["VUX"]) / 2, (at["VLY"] - at["VUY"]) / 2
            yield FieldPoint(at[x_name] * scale, at[y_name] * scale, compression, shift)

    def _thickness(self, surface: _Surface) -> float:
        if len(surface.line.words) > 1:
            return surface.line.length(1)
        return 0.0

    def _curvature_per_mm(self, surface: _Surface) -> float:
        line = surface.line
        number = line.value() if line.words else 0.0
        if not self.has_radii:
            self._refuse_radius(surface, number)
            return number / self.mm
        return 1 / (number * self.mm) if number else 0.0

    def _refuse_radius(self, surface: _Surface, curvature: float) -> None:
        """A radius of 50 mm where curvatures are due would be a lens of 0.02 mm."""
        is_stated = "RDM" in self.system
        smallest_radius = MIN_RADIUS_OF_THICKNESS * abs(self._finite_thickness(surface))
        if not is_stated and abs(curvature) * smallest_radius > 1:
            surface.line.refuse(
                f"at {surface.label} has {curvature:g}, which without RDM is a curvature (a radius"
                f" of {1 / curvature:.3g})",
                "write RDM Y where these numbers are radii, RDM N where they are curvatures",
            )

    def _placed(self) -> Iterator[LensSurface]:
        frame = Frame()
        for surface in self.surfaces[1:]:
            turn = self._turn(surface)
            shift = [surface.number_of(name) * self.mm for name in ("XDE", "YDE", "ZDE")]
            before = frame.turn, frame.origin_mm
            if "REV" in surface.values:
                surface.values["REV"].refuse(f"at {surface.label} is not known", ADVICE)
            frame.move(*shift)
            frame.rotate(turn)
            yield self._surface(surface, frame)
            if "DAR" in surface.values:
                frame.turn, frame.origin_mm = before
            elif "BEN" in surface.values:
                # The axis turns with the light: once for the mirror, once more behind it.
                frame.rotate(turn)
            if surface is not self.surfaces[-1]:
                frame.move(0.0, 0.0, self._finite_thickness(surface) * self.mm)

    def _finite_thickness(self, surface: _Surface) -> float:
        thickness = self._thickness(surface)
        if not np.isfinite(thickness):
            surface.line.refuse(f"at {surface.label} has no end", "write its distance to the next")
        return thickness

    def _turn(self, surface: _Surface) -> FloatArray:
        """ADE, BDE, CDE turn about x, the new y, the newer z; the first two are left-handed."""
        alpha, beta, gamma = (surface.number_of(name) for name in ("ADE", "BDE", "CDE"))
        turn = Rotation.from_euler("XYZ", [-alpha, -beta, gamma], degrees=True)
        return np.asarray(turn.as_matrix())

    def _surface(self, surface: _Surface, frame: Frame) -> LensSurface:
        return LensSurface(
            label=surface.label,
            curvature_per_mm=self._curvature_per_mm(surface),
            conic=surface.number_of("K"),
            polynomial=tuple(self._terms(surface)),
            glass=self._glass(surface),
            apertures=tuple(self._apertures(surface)),
            is_stop="STO" in surface.values,
            turn=frame.turn,
            origin_mm=frame.origin_mm,
        )

    def _terms(self, surface: _Surface) -> Iterator[float]:
        """Coefficients of r, r^2, ...: A is that of r^4, B of r^6, and so on."""
        if not any(term in surface.values for term in TERMS):
            return
        yield from (0.0, 0.0)
        for place, term in enumerate(TERMS):
            power = 4 + 2 * place
            yield 0.0
            yield surface.number_of(term) * self.mm ** (1 - power)

    def _glass(self, surface: _Surface) -> Glass:
        items = surface.line.words[2:]
        if len(items) > 1:
            more = shortened(" ".join(items[1:]))
            surface.line.refuse(f"at {surface.label} has {more} behind its glass", ADVICE)
        if not items or items[0].upper() == "AIR":
            return AIR
        if items[0].upper() in {"REFL", "REFR"}:
            return MIRROR if items[0].upper() == "REFL" else AIR
        name = items[0].strip("'\"")
        if name.upper() in self.private:
            line = self.private[name.upper()]
            surface.line.refuse(
                f"at {surface.label} has the private glass {name} (line {line})",
                "write a catalogue's glass, or its n and V",
            )
        index, colon, abbe = name.partition(":")
        if colon:
            return self._model(surface, index, abbe)
        by_code = glass_of_code(name)
        if by_code is not None:
            return by_code
        # NBK7_SCHOTT: the catalogue stands behind the last underline.
        short, _, catalogue = name.upper().rpartition("_")
        if short:
            return Glass(short, (catalogue,))
        return Glass(name.upper())

    def _model(self, surface: _Surface, index: str, abbe: str) -> Glass:
        try:
            index_d = float(index)
            abbe_d = float(abbe)
        except ValueError:
            surface.line.refuse(
                f"at {surface.label} has the glass {index}:{abbe}",
                "write n:V, such as 1.5168:64.17",
            )
        if not 1 <= index_d <= MAX_INDEX or abbe_d < 0:
            surface.line.refuse(
                f"at {surface.label} has the glass {index}:{abbe}",
                "write n:V, such as 1.5168:64.17",
            )
        return Glass(f"{index}:{abbe}", index_d=index_d, abbe=abbe_d)

    def _apertures(self, surface: _Surface) -> Iterator[Aperture]:
        centre = surface.number_of("ADX") * self.mm, surface.number_of("ADY") * self.mm
        if surface.number_of("ARO"):
            surface.values["ARO"].refuse(f"at {surface.label} turns the aperture", ADVICE)
        halves: Halves = {}
        for line in surface.apertures:
            kind, half_mm = self._edge(surface, line)
            halves[line.keyword, kind] = half_mm
        for (keyword, kind), half_mm in halves.items():
            other_mm = self._other_half(surface, keyword, kind, halves)
            is_second = keyword in {"REY", "ELY"}
            # The edge is where the glass ends, outside of what is clear.
            if kind != "EDG" and not is_second:
                half = half_mm, other_mm
                yield Aperture(SHAPES[keyword], half, kind == "CLR", centre_mm=centre)

    def _other_half(self, surface: _Surface, keyword: str, kind: str, halves: Halves) -> float:
        """The half-width across: a circle's own; the other command's, where there are two."""
        other = OTHER_COMMANDS.get(keyword, keyword)
        if (other, kind) not in halves:
            lacks = f"{keyword} has no {other} beside it"
            raise InputError(f"{surface.label}: {lacks}; write both half-widths")
        return halves[other, kind]

    def _edge(self, surface: _Surface, line: LensLine) -> tuple[str, float]:
        """What an aperture's command bounds (CLR: what is clear), and its half-width, mm."""
        kind = "CLR"
        for word in line.words[:-1]:
            if word.upper() in KINDS_OF_EDGE:
                kind = word.upper()
            elif not word.upper().startswith("L'"):
                line.refuse(f"at {surface.label} has {shortened(word)}", ADVICE)
        if line.words:
            half_mm = line.value(len(line.words) - 1) * self.mm
        else:
            half_mm = 0.0
        if half_mm <= 0:
            line.refuse(f"at {surface.label} has no size", "write its half-width")
        return kind, half_mm
