"""Reads .zmx of Zemax OpticStudio, by a list of keywords that are used and one of those ignored.

A keyword on neither list is refused by its line: what it does to light is not known. The file's own
solves and pickups are passed over, as it has the values that they gave.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

from scipy.spatial.transform import Rotation

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
    add_once,
    lens_text,
    nth,
    only_aperture,
)

AIR, MIRROR = Glass(), Glass("MIRROR")
MM_PER_UNIT = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "INCH": 25.4, "METER": 1000.0, "M": 1000.0}
FIELD_KINDS: dict[int, FieldKind] = {0: "angle", 2: "paraxial_image_height", 3: "real_image_height"}
UNNAMED_GLASS = "___BLANK"
FIELD_LISTS = ("XFL", "YFL", "VCX", "VCY", "VDX", "VDY")  # with N behind, and D in older files
MODEL_GLASS, OFFSET_GLASS = 1, 4  # kinds of GLAS's solve; the others write the glass's own name
# Kinds of surfaces, and how many parameters each has: coefficients of r^2n and of r^n; a focal
# length and how its path counts.
SURFACE_KINDS = {"STANDARD": 0, "EVENASPH": 8, "ODDASPHE": 8, "PARAXIAL": 2}
BREAK_STEPS = 6
STANDARD_C, STANDARD_ATM = 20.0, 1.0  # at which catalogues give their indices

USED_SYSTEM = frozenset(
    {
        *("MODE", "UNIT", "ENVD", "GFAC", "RAIM", "GCAT", "FTYP", "PWAV", "WAVL"),
        *("ENPD", "FNUM", "FLOA", "OBNA"),
        *("XFLN", "YFLN", "VCXN", "VCYN", "VDXN", "VDYN", "VANN"),
        *("XFLD", "YFLD", "VCXD", "VCYD", "VDXD", "VDYD", "VAND"),  # as older versions wrote them
    }
)
USED_SURFACE = frozenset({"STOP", "TYPE", "CURV", "CONI", "DISZ", "GLAS", "DIAM", "OBDC"})
APERTURES = frozenset({"CLAP", "OBSC", "SQAP", "SQOB", "ELAP", "ELOB", "SPID", "FLAP"})
REFUSED_SURFACE = {
    "USAP": "is an aperture of a shape of its own (a .UDA file)",
    "UOBS": "is an obstruction of a shape of its own (a .UDA file)",
    "PKUP": "takes its aperture from another surface",
    "SCBD": "tilts or moves the surface",
}
# A line of these that is all 0 changes nothing; any other is refused.
REFUSED_UNLESS_ZERO = frozenset({"ZVCX", "ZVCY", "ZVDX", "ZVDY"})
# What no star's light shows. Each group has its reason.
IGNORED_SYSTEM = frozenset(
    {
        *("VERS", "DBDT", "NAME", "NOTE", "AUTH", "LANG", "FILE", "TITL"),  # words for people
        *(
            "COFN",
            "GLRS",
            "SDMA",
            "PICB",
            "PFIL",
            "NSCD",
            "GSTD",
            "ROPD",
            "PUSH",
            "POLS",
            "HYPR",
        ),  # of other analyses
        *(
            "FWGN",
            "MOFF",
            "VDSZ",
            "OMMA",
            "STUD",
            "RCMF",
            "IWDP",
            "SSID",
            "LUID",
            "EERA",
        ),  # of optimisation and editors
    }
)
IGNORED_SURFACE = frozenset(
    {
        *(
            "COMM",
            "HIDE",
            "SLAB",
            "MIRR",
            "POPS",
            "FIMP",
            "NOTE",
            "CHZN",
        ),  # names, drawings, and physical optics
        *(
            "MEMA",
            "OEMA",
            "MAZH",
            "CHIP",
            "VDSZ",
        ),  # the mechanical edge, which is outside the clear aperture
        *(
            "VPAR",
            "PPAR",
            "VCON",
            "PCON",
            "VXDA",
            "PXDA",
            "VCUR",
            "VDIS",
            "PZUP",
        ),  # variables and pickups, whose values are here
        *(
            "COAT",
            "TCED",
            "TCE",
            "IGNM",
        ),  # a coating's loss, and expansion: the bench file's transmission has the light
    }
)
# Behind the last surface: editors' lists, of tolerances and of the merit function, whose operands
# have a word of four capitals, and numbers. They stand at the line's beginning, where a surface's
# own lines are indented.
EDITOR_LISTS = frozenset({"TOL", "TCMM", "MNUM", "MOFF", "BLNK", "DMFS"})
OPERAND = re.compile(r"[A-Z][A-Z0-9_]{2,3}( +[-+0-9.eE]+){6,} *")
ADVICE = "save the lens without it"
BEAM_NOTE = "GFAC weights the pupil of a laser's beam; a star's light fills it evenly"
AIMING_NOTE = "RAIM aims at the stop's edge; rays are aimed at the paraxial entrance pupil's"
CAN_WRITE = "save it from OpticStudio as a sequential lens (.zmx)"


@dataclass(slots=True)
class _Surface:
    """The lines of a surface, and where it starts."""

    number: int
    line: int
    values: dict[str, LensLine] = field(default_factory=dict)
    parameters: dict[int, LensLine] = field(default_factory=dict)
    extra: list[LensLine] = field(default_factory=list)
    apertures: list[LensLine] = field(default_factory=list)

    @property
    def label(self) -> str:
        return f"surface {self.number} (line {self.line})"

    @property
    def kind(self) -> str:
        line = self.values.get("TYPE")
        if line is None:
            return "STANDARD"
        return " ".join(line.words).upper()

    def number_of(self, keyword: str) -> float:
        line = self.values.get(keyword)
        return 0.0 if line is None else line.value()

    def parameter(self, number: int) -> float:
        line = self.parameters.get(number)
        return 0.0 if line is None else line.value(1)


def read_zemax(data: bytes) -> LensPrescription:
    """The lens of a file's bytes. Raises InputError that names the line."""
    return _Reader(list(_lines(data))).lens()


def _lines(data: bytes) -> Iterator[LensLine]:
    for number, line in enumerate(lens_text(data).splitlines(), 1):
        items = line.split()
        if items:
            yield LensLine(number, items[0].upper(), items[1:], line)


class _Reader(LensFileReader):
    """Goes through a file's lines once, into a head and surfaces, and makes the lens of them."""

    def __init__(self, lines: list[LensLine]) -> None:
        self.head: dict[str, LensLine] = {}
        self.waves: list[LensLine] = []
        self.surfaces: list[_Surface] = []
        self.notes: list[str] = []
        self._operand: LensLine | None = None
        for line in lines:
            self._take(line)
        if not self.surfaces:
            raise InputError(f"it has no SURF; {CAN_WRITE}")
        self.mm = self._unit_mm()
        self._check_system()

    def _take(self, line: LensLine) -> None:
        if line.keyword == "SURF":
            self._refuse_operand()
            self.surfaces.append(_Surface(int(line.value()), line.number))
        elif not self.surfaces:
            self._take_head(line)
        elif line.keyword in EDITOR_LISTS:
            self._take_list(line)
        elif not self._take_surface(line):
            self._take_operand(line)

    def _take_head(self, line: LensLine) -> None:
        if line.keyword == "WAVM":
            self.waves.append(line)
        elif line.keyword in USED_SYSTEM:
            add_once(self.head, line)
        elif line.keyword in REFUSED_UNLESS_ZERO and line.is_zero():
            return
        elif line.keyword not in IGNORED_SYSTEM:
            line.refuse("is not known", ADVICE)

    def _take_list(self, line: LensLine) -> None:
        is_several = line.keyword == "MNUM" and line.words and line.value() > 1
        if is_several:
            line.refuse(
                f"says {line.words[0]} configurations",
                "save the one that is used as a lens of its own",
            )

    def _take_surface(self, line: LensLine) -> bool:
        """Whether a line belongs to the last surface."""
        surface = self.surfaces[-1]
        if line.keyword == "PARM":
            surface.parameters[int(line.value())] = line
        elif line.keyword == "XDAT":
            surface.extra.append(line)
        elif line.keyword in APERTURES:
            surface.apertures.append(line)
        elif line.keyword in USED_SURFACE:
            add_once(surface.values, line, f"at surface {surface.number} ")
        elif line.keyword in REFUSED_SURFACE:
            self._refuse_surface(line)
        elif line.keyword not in IGNORED_SURFACE:
            return False
        self._refuse_operand()
        return True

    def _refuse_surface(self, line: LensLine) -> None:
        # A tilt and a decentre of 0 change nothing.
        if line.keyword == "SCBD" and not any(_numbers_of(line.words[1:])):
            return
        why = REFUSED_SURFACE[line.keyword]
        line.refuse(f"at surface {self.surfaces[-1].number} {why}", ADVICE)

    def _take_operand(self, line: LensLine) -> None:
        if line.keyword in IGNORED_SYSTEM:
            return
        if self._operand is None:
            self._operand = line
        if OPERAND.fullmatch(line.text) is None:
            self._refuse_operand(line)

    def _refuse_operand(self, line: LensLine | None = None) -> None:
        """What stands between surfaces' lines is no operand, but a keyword that is not known."""
        unknown = line or self._operand
        if unknown is not None:
            unknown.refuse(f"at surface {self.surfaces[-1].number} is not known", ADVICE)

    def _unit_mm(self) -> float:
        line = self.head.get("UNIT")
        if line is None:
            self.notes.append("it says no UNIT: its lengths are taken as mm")
            return 1.0
        unit = line.words[0].upper() if line.words else ""
        if unit not in MM_PER_UNIT:
            line.refuse(f"is {unit or 'empty'}", "write MM, CM, IN or METER")
        return MM_PER_UNIT[unit]

    def _check_system(self) -> None:
        mode = self.head.get("MODE")
        if mode is not None and (not mode.words or mode.words[0].upper() != "SEQ"):
            mode.refuse(f"is {' '.join(mode.words) or 'empty'}: no sequential lens", CAN_WRITE)
        air = self.head.get("ENVD")
        if air is not None and len(air.words) > 2 and air.value(2):
            at_c = air.value(0)
            at_atm = air.value(1)
            if (at_c, at_atm) != (STANDARD_C, STANDARD_ATM):
                air.refuse(
                    f"adjusts indices to {at_c:g} C and {at_atm:g} atm",
                    "write those of 20 C and 1 atm",
                )
        angle = self.head.get("VANN") or self.head.get("VAND")
        if angle is not None and not angle.is_zero():
            angle.refuse("turns the vignetted pupil", "write surfaces' apertures (CLAP)")
        beam = self.head.get("GFAC")
        if beam is not None and len(beam.words) > 1 and beam.value(0) and beam.value(1):
            self.notes.append(f"line {beam.number}: {BEAM_NOTE}")
        aiming = self.head.get("RAIM")
        if aiming is not None and len(aiming.words) > 1 and aiming.value(1):
            self.notes.append(f"line {aiming.number}: {AIMING_NOTE}")

    def _check_ends(self) -> None:
        start = self.surfaces[0]
        far = start.values.get("DISZ")
        if far is None or far.length() != float("inf"):
            raise InputError(f"{start.label}: {NEAR_OBJECT}")
        image = self.surfaces[-1]
        has_glass = "GLAS" in image.values
        if has_glass or "DISZ" not in image.values or image.number_of("DISZ"):
            told = "has a glass, a distance behind it, or no DISZ: an image has none"
            raise InputError(f"{image.label} is the last, and {told}; is the file cut off?")

    def _pupil(self) -> tuple[PupilKind, float]:
        line = only_aperture(self.head, ("ENPD", "FNUM", "FLOA"), "OBNA")
        if line.keyword == "FNUM":
            return "f_number", line.value()
        if line.keyword == "ENPD":
            return "diameter", line.value() * self.mm
        return "stop", 2 * self._stop_semi_diameter() * self.mm

    def _stop_semi_diameter(self) -> float:
        """Of the surface with STOP, in lens units: DIAM is a semi-diameter, whatever its name."""
        for surface in self.surfaces:
            if "STOP" in surface.values:
                semi_diameter = surface.number_of("DIAM")
                if semi_diameter > 0:
                    return semi_diameter
                no_size = "FLOA takes the aperture from its DIAM, which is 0"
                raise InputError(f"{surface.label}: {no_size}; write ENPD or FNUM")
        no_stop = "FLOA takes the aperture from the stop, and no surface says STOP"
        raise InputError(f"{no_stop}; write ENPD or FNUM")

    def _field_type(self) -> LensLine | None:
        return self.head.get("FTYP")

    def _field_kind(self) -> FieldKind:
        line = self._field_type()
        if line is None:
            return "angle"
        kind = int(line.value())
        if kind not in FIELD_KINDS:
            line.refuse(
                f"has fields of kind {kind} (object heights are 1)",
                "write angles (0) or image heights (2, 3)",
            )
        if len(line.words) > 1 and line.value(1):
            line.refuse(
                "says that the object's side is telecentric",
                "write a lens for an object at infinity",
            )
        return FIELD_KINDS[kind]

    def _count(self, place: int, known: int) -> int:
        """How many of a list count, by FTYP; the list may have room for more."""
        line = self._field_type()
        if line is not None and len(line.words) > place:
            stated = int(line.value(place))
        else:
            stated = 0
        return min(stated, known) if stated > 0 else known

    def _list(self, new_name: str, old_name: str) -> tuple[float, ...]:
        line = self.head.get(new_name) or self.head.get(old_name)
        return () if line is None else line.numbers()

    def _fields(self) -> Iterator[FieldPoint]:
        lists = {name: self._list(f"{name}N", f"{name}D") for name in FIELD_LISTS}
        longest = max(1, len(lists["XFL"]), len(lists["YFL"]))
        # Angles are degrees, image heights lengths.
        scale = 1.0 if self._field_kind() == "angle" else self.mm
        for number in range(self._count(2, longest)):
            x, y, *vignetting = (nth(values, number) for values in lists.values())
            compression_x, compression_y, shift_x, shift_y = vignetting
            compression = (compression_x, compression_y)
            shift = (shift_x, shift_y)
            yield FieldPoint(x * scale, y * scale, compression, shift)

    def _wavelengths(self) -> tuple[tuple[float, ...], int]:
        every = tuple(line.value(1) for line in self.waves)
        every = every or self._list("WAVL", "WAVL")
        count = self._count(3, len(every))
        primary = self.head.get("PWAV")
        if primary is not None:
            number = int(primary.value()) - 1
        else:
            number = 0
        if not 0 <= number < max(count, 1):
            which = f"wavelength {number + 1} of {count}"
            raise InputError(f"PWAV names {which}; write one that there is")
        # Wavelengths that are listed twice are one; the primary keeps its value.
        distinct = tuple(dict.fromkeys(every[:count]))
        return distinct, distinct.index(every[number]) if every else 0

    def _placed(self) -> Iterator[LensSurface]:
        frame = Frame()
        glass = AIR
        last = self.surfaces[-1]
        for surface in self.surfaces[1:]:
            is_break = surface.kind == "COORDBRK"
            if is_break:
                self._break(surface, frame)
            else:
                glass = self._glass(surface)
                yield self._surface(surface, frame, glass)
            gap = surface.values.get("DISZ")
            if surface is not last and gap is not None:
                frame.move(0.0, 0.0, gap.value() * self.mm)

    def _break(self, surface: _Surface, frame: Frame) -> None:
        """Shift, then turns about x, the new y and the newer z; with PARM 6 all of it backwards."""
        _refuse_parameters(surface, BREAK_STEPS)
        if "STOP" in surface.values:
            surface.values["STOP"].refuse("is at a COORDBRK", "put it on the surface beside it")
        x_mm = surface.parameter(1) * self.mm
        y_mm = surface.parameter(2) * self.mm
        turns_deg = [surface.parameter(number) for number in (3, 4, 5)]
        if surface.parameter(6):
            frame.rotate(Rotation.from_euler("ZYX", turns_deg[::-1], degrees=True).as_matrix())
            frame.move(x_mm, y_mm, 0.0)
        else:
            frame.move(x_mm, y_mm, 0.0)
            frame.rotate(Rotation.from_euler("XYZ", turns_deg, degrees=True).as_matrix())

    def _surface(self, surface: _Surface, frame: Frame, glass: Glass) -> LensSurface:
        if surface.kind not in SURFACE_KINDS:
            known = ", ".join(SURFACE_KINDS)
            surface.values["TYPE"].refuse(
                f"at surface {surface.number} is {shortened(surface.kind)}",
                f"write one of {known} or COORDBRK",
            )
        coefficients = [word for line in surface.extra for word in line.words[1:2]]
        if any(_numbers_of(coefficients)):
            more = f"at surface {surface.number} gives further coefficients"
            surface.extra[0].refuse(more, ADVICE)
        return LensSurface(
            label=surface.label,
            curvature_per_mm=surface.number_of("CURV") / self.mm,
            conic=surface.number_of("CONI"),
            polynomial=tuple(_terms(surface, self.mm)),
            glass=glass,
            apertures=tuple(self._apertures(surface)),
            is_stop="STOP" in surface.values,
            turn=frame.turn,
            origin_mm=frame.origin_mm,
            paraxial_focal_mm=self._paraxial_focal_mm(surface),
        )

    def _paraxial_focal_mm(self, surface: _Surface) -> float | None:
        if surface.kind == "PARAXIAL":
            return surface.parameter(1) * self.mm
        return None

    def _glass(self, surface: _Surface) -> Glass:
        line = surface.values.get("GLAS")
        if line is None or not line.words:
            return AIR
        name = line.words[0].upper()
        if name == "MIRROR":
            return MIRROR
        kind = int(line.value(1)) if len(line.words) > 1 else 0
        if kind == OFFSET_GLASS:
            line.refuse(
                f"at surface {surface.number} offsets the index of {name}",
                "write the glass's own, or a model glass",
            )
        # A pickup of a model glass has its numbers, too.
        if kind == MODEL_GLASS or name == UNNAMED_GLASS:
            numbers = [line.value(place) if place < len(line.words) else 0.0 for place in (3, 4, 5)]
            index_d, abbe, anomaly = numbers
            if not 1 <= index_d <= MAX_INDEX or abbe < 0:
                line.refuse(
                    f"at surface {surface.number} is a model of n = {index_d:g}, V = {abbe:g}",
                    "write its own numbers",
                )
            return Glass(name, index_d=index_d, abbe=abbe, anomaly=anomaly)
        listed = self.head.get("GCAT")
        catalogues = () if listed is None else tuple(word.upper() for word in listed.words)
        return Glass(name, catalogues)

    def _apertures(self, surface: _Surface) -> Iterator[Aperture]:
        moved = surface.values.get("OBDC")
        centre = 0.0, 0.0
        if moved is not None:
            centre = moved.value(0) * self.mm, moved.value(1) * self.mm
        for line in surface.apertures:
            first = line.value(0) * self.mm
            second = line.value(1) * self.mm
            is_clear = line.keyword in {"CLAP", "FLAP", "SQAP", "ELAP"}
            if line.keyword == "SPID":
                arms = int(line.value(1))
                yield Aperture("spider", (first / 2, 0.0), False, centre_mm=centre, arms=arms)
                continue
            # A circle's first number is its inner radius, which may be 0.
            is_circle = line.keyword in {"CLAP", "FLAP", "OBSC"}
            if second <= 0 or first < 0 or (first == 0 and not is_circle):
                line.refuse(f"at surface {surface.number} has no size", "write its half-width")
            if is_circle:
                # A floating aperture is the surface's own edge, so it is not moved.
                place = (0.0, 0.0) if line.keyword == "FLAP" else centre
                yield Aperture("circle", (second, second), is_clear, first, place)
            else:
                is_square = line.keyword.startswith("SQ")
                whole = Aperture("rectangle", (first, second), is_clear, centre_mm=centre)
                yield whole if is_square else replace(whole, shape="ellipse")


def _numbers_of(words: Iterable[str]) -> Iterator[float]:
    for word in words:
        try:
            yield float(word)
        except ValueError:
            yield 1.0


def _terms(surface: _Surface, mm: float) -> Iterator[float]:
    """Coefficients of r, r^2, ... in mm. A parameter that is not of the kind, and not 0, is
    refused.
    """
    count = SURFACE_KINDS[surface.kind]
    _refuse_parameters(surface, count)
    for number in range(1, count + 1):
        if surface.kind == "EVENASPH":
            # PARM n is the coefficient of r^2n.
            yield 0.0
            yield surface.parameter(number) * mm ** (1 - 2 * number)
        elif surface.kind == "ODDASPHE":
            yield surface.parameter(number) * mm ** (1 - number)


def _refuse_parameters(surface: _Surface, count: int) -> None:
    for number, line in surface.parameters.items():
        is_own = 1 <= number <= count
        if not is_own and line.value(1):
            where = f"surface {surface.number} ({surface.kind})"
            line.refuse(f"{number} of {where} is not known", ADVICE)
