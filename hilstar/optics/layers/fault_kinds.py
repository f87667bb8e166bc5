"""The kinds of fault, one class each: the keys of a `[[fault]]` table, which are those of a message
of the stream too.

Light is in electrons per second, or in electrons of one exposure of the tracker; places are in the
frame that suits: `icrs` or `radec_deg` on the sky, `tracker_px` on the tracker's detector,
`screen_px` on the monitor.
"""

import itertools
import math
import re
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta

from hilstar.basics.errors import InputError, did_you_mean, shortened
from hilstar.basics.toml_tables import Kind, Table, explained

REFERENCE = "docs/faults.md"
TYPE_WORDS = {
    "float": "number",
    "int": "whole number",
    "str": "text",
    "object": "table",
    "bool": "true or false",
}
MAX_TIME_S, MAX_LIGHT_E, MAX_PLACE_PX = 1e7, 1e12, 1e6
MAX_TRACK_PX = 20_000  # a burst's tracks together: bounds a frame's work
UNIT_TOLERANCE = 1e-3

Seconds = Annotated[float, Meta(ge=-MAX_TIME_S, le=MAX_TIME_S)]
Duration = Annotated[float, Meta(gt=0, le=MAX_TIME_S)]
Electrons = Annotated[float, Meta(gt=0, le=MAX_LIGHT_E)]
Pixel = Annotated[float, Meta(ge=-MAX_PLACE_PX, le=MAX_PLACE_PX)]
Component = Annotated[float, Meta(ge=-1.001, le=1.001)]
PixelPair = tuple[Pixel, Pixel]
SUN_BV_MAG = 0.65
Bv = Annotated[float, Meta(ge=-1, le=6)]
Hip = Annotated[int, Meta(ge=1, le=2**31 - 1)]
Name = Annotated[str, Meta(min_length=1, max_length=32)]  # as long as a name in the truth table
Share = Annotated[float, Meta(gt=0, le=1)]
PLACES = ("radec_deg", "icrs", "tracker_px", "screen_px")
LIGHT = ("electrons_per_s", "electrons")
KeyGroups = tuple[tuple[str, ...], ...]


class Fault(Table, frozen=True, kw_only=True):
    """The keys of every fault: a name, its beginning (seconds of the run; None: on request), and
    how long it lasts.

    Without `for_s` it lasts until it is stopped.
    """

    KIND: ClassVar[str] = ""
    OF_LIGHT: ClassVar[bool] = False  # drawn in proportion to the part of a frame that it lasts
    ONE_OF: ClassVar[KeyGroups] = ()  # groups of keys, of each of which a fault has one

    name: Name
    at_s: Seconds | None = None
    for_s: Duration | None = None

    def check(self) -> None:
        """Refuse (InputError) keys that contradict each other."""
        for names in self.ONE_OF:
            given = [name for name in names if getattr(self, name) is not None]
            if len(given) > 1:
                raise InputError(f"has {given[0]} and {given[1]}; write one of them")
            if not given:
                raise InputError(
                    f"lacks one of {', '.join(names)}; write one of them (see {REFERENCE})"
                )


class PlacedFault(Fault, frozen=True, kw_only=True):
    """A place: on the sky, or on the detector or the screen, where it may move."""

    radec_deg: tuple[float, Annotated[float, Meta(ge=-90, le=90)]] | None = None
    icrs: tuple[Component, Component, Component] | None = None
    tracker_px: PixelPair | None = None
    screen_px: PixelPair | None = None
    rate_px_s: PixelPair = (0.0, 0.0)

    ONE_OF: ClassVar[KeyGroups] = (PLACES,)

    def check(self) -> None:
        """Refuse (InputError) also a vector that is no direction, and a rate without a pixel."""
        super().check()
        if self.icrs is not None and abs(math.hypot(*self.icrs) - 1) > UNIT_TOLERANCE:
            raise InputError(
                f"icrs = {list(self.icrs)}: its norm is {math.hypot(*self.icrs):.6g}; write a unit"
                " vector x, y, z"
            )
        if any(self.rate_px_s) and self.tracker_px is None and self.screen_px is None:
            places = itertools.chain(*self.ONE_OF)
            given = next(name for name in places if getattr(self, name) is not None)
            raise InputError(
                f"rate_px_s moves a tracker_px or a screen_px, not {given}; leave one of them out"
            )


class PointLight(PlacedFault, frozen=True, kw_only=True):
    """Light at a point."""

    OF_LIGHT: ClassVar[bool] = True
    ONE_OF: ClassVar[KeyGroups] = (PLACES, (*LIGHT, "v_mag"))

    electrons_per_s: Electrons | None = None
    electrons: Electrons | None = None
    v_mag: Annotated[float, Meta(ge=-30, le=30)] | None = None
    bv_mag: Bv = SUN_BV_MAG


class FalseStar(PointLight, frozen=True, kw_only=True):
    """A star that is in no catalogue, fixed on the sky or moving on the detector."""

    KIND: ClassVar[str] = "false-star"


class Flash(PointLight, frozen=True, kw_only=True):
    """Light at a star (`hip`, or `star`: a name of the truth table), or at a place, for a time."""

    KIND: ClassVar[str] = "flash"
    ONE_OF: ClassVar[KeyGroups] = (("hip", "star", *PLACES), (*LIGHT, "v_mag"))

    hip: Hip | None = None
    star: Name | None = None

    def check(self) -> None:
        """Refuse (InputError) also a flash without an end."""
        super().check()
        if self.for_s is None:
            raise InputError(
                "the key for_s is missing; a flash has a length: write for_s = 0.1 or the like"
            )


class StarGone(Fault, frozen=True, kw_only=True):
    """A star (`hip`) or a body (`star`, its name in the truth table) that is not there."""

    KIND: ClassVar[str] = "star-gone"
    OF_LIGHT: ClassVar[bool] = True
    ONE_OF: ClassVar[KeyGroups] = (("hip", "star"),)

    hip: Hip | None = None
    star: Name | None = None


class CosmicRays(Fault, frozen=True, kw_only=True):
    """A burst of `number` straight tracks in each exposure that it lasts, at random places and in
    random directions.

    Each leaves `electrons` in an exposure, along `length_px` of the detector. Without `for_s` the
    burst is one exposure.
    """

    KIND: ClassVar[str] = "cosmic-rays"
    OF_LIGHT: ClassVar[bool] = True

    number: Annotated[int, Meta(ge=1, le=5_000)]
    electrons: Electrons
    length_px: Annotated[float, Meta(ge=0, le=10_000)] = 10.0

    def check(self) -> None:
        """Refuse (InputError) more tracks than a frame has time for."""
        together_px = math.ceil(self.number * self.length_px)
        if together_px > MAX_TRACK_PX:
            given = f"number = {self.number} and length_px = {self.length_px:g}"
            raise InputError(
                f"{given} are {together_px} px of tracks; write at most {MAX_TRACK_PX} px together"
            )


class Gradient(Fault, frozen=True, kw_only=True):
    """Stray light that grows evenly across the detector: from nothing to its light, electrons in a
    tracker pixel.

    `towards_deg` is where it is brightest: 0 at the right edge of the tracker's image, 90 at the
    bottom.
    """

    KIND: ClassVar[str] = "gradient"
    OF_LIGHT: ClassVar[bool] = True
    ONE_OF: ClassVar[KeyGroups] = (LIGHT,)

    electrons_per_s: Electrons | None = None
    electrons: Electrons | None = None
    towards_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    bv_mag: Bv = SUN_BV_MAG


class Glow(PlacedFault, frozen=True, kw_only=True):
    """Stray light about a direction, also one off the field: peak (1 + (angle /
    scale)^2)^(-exponent / 2).

    The peak is in a tracker pixel.
    """

    KIND: ClassVar[str] = "glow"
    OF_LIGHT: ClassVar[bool] = True
    ONE_OF: ClassVar[KeyGroups] = (PLACES, LIGHT)

    electrons_per_s: Electrons | None = None
    electrons: Electrons | None = None
    scale_deg: Annotated[float, Meta(ge=1e-3, le=180)] = 1.0
    exponent: Annotated[float, Meta(gt=0, le=20)] = 2.0
    bv_mag: Bv = SUN_BV_MAG


class MeasuredMap(Fault, frozen=True, kw_only=True):
    """Stray light as it was measured: an image (FITS, PNG or npy) over the whole detector, or the
    whole screen.

    Its values are electrons per second in a pixel of the tracker (of the monitor with `frame =
    "screen"`), unless `electrons_per_s` or `electrons` says what its brightest pixel is.
    """

    KIND: ClassVar[str] = "light-map"
    OF_LIGHT: ClassVar[bool] = True

    file: Annotated[str, Meta(min_length=1, max_length=4096)]
    frame: Literal["tracker", "screen"] = "tracker"
    electrons_per_s: Electrons | None = None
    electrons: Electrons | None = None
    bv_mag: Bv = SUN_BV_MAG

    def check(self) -> None:
        """Refuse (InputError) light said twice."""
        if self.electrons_per_s is not None and self.electrons is not None:
            raise InputError("has electrons_per_s and electrons; write one of them")


class Blank(Fault, frozen=True, kw_only=True):
    """No light at all: neither stars nor stray light."""

    KIND: ClassVar[str] = "blank"


class Freeze(Fault, frozen=True, kw_only=True):
    """Every frame shows the codes of the last one before it."""

    KIND: ClassVar[str] = "freeze"


class Drop(Fault, frozen=True, kw_only=True):
    """Frames that are never shown: the display keeps the one before. A `share` of them, chosen
    by the seed.
    """

    KIND: ClassVar[str] = "drop"

    share: Share = 1.0


class AttitudeStep(Fault, frozen=True, kw_only=True):
    """The sky of a wrong attitude: the camera turned by a rotation vector in its own axes, as a
    rate of that size for 1 s.
    """

    KIND: ClassVar[str] = "attitude-step"
    ONE_OF: ClassVar[KeyGroups] = (("turn_arcsec", "turn_deg"),)

    turn_arcsec: tuple[float, float, float] | None = None
    turn_deg: tuple[float, float, float] | None = None

    def check(self) -> None:
        """Refuse (InputError) also more than half a turn."""
        super().check()
        size_rad = math.hypot(*self.turn_rad)
        if size_rad > math.pi:
            raise InputError(
                f"turns by {math.degrees(size_rad):.6g} deg; write a turn of 180 deg at most"
            )

    @property
    def turn_rad(self) -> tuple[float, float, float]:
        """The rotation vector, cam axes."""
        unit_rad = math.radians(1 / 3600 if self.turn_deg is None else 1.0)
        x, y, z = self.turn_deg or self.turn_arcsec or (0.0, 0.0, 0.0)
        return x * unit_rad, y * unit_rad, z * unit_rad


@dataclass(frozen=True, slots=True)
class Now:
    """A fault that is on in a frame: its number in the run, and how long it has been on when the
    frame's light begins, ns.

    `share` is the part of the frame that it lasts: less than 1 only in its first frame and its
    last.
    """

    number: int
    fault: Fault
    since_ns: int
    share: float = 1.0


KINDS: dict[str, type[Fault]] = {
    kind.KIND: kind
    for kind in (
        FalseStar,
        StarGone,
        Flash,
        CosmicRays,
        Gradient,
        Glow,
        MeasuredMap,
        Blank,
        Freeze,
        Drop,
        AttitudeStep,
    )
}


def fault_of(table: Any) -> Fault:
    """The fault of a table, as TOML or JSON has it. Raises InputError: key, what is wrong and
    what to write.
    """
    if not isinstance(table, dict):
        raise InputError(
            f"{shortened(table)} is no table; write keys, such as kind and name (see {REFERENCE})"
        )
    keys = {key: value for key, value in table.items() if key != "kind"}
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        if kind is None:
            kind_text = "the key kind is missing"
        else:
            kind_text = f"kind = {shortened(repr(kind))}"
        raise InputError(f"{kind_text}; {did_you_mean(kind, KINDS)}write one of {', '.join(KINDS)}")
    made = KINDS[kind]
    try:
        _check_finite(keys)
        fault = msgspec.convert(keys, made)
    except RecursionError as error:
        raise InputError(f"its values are nested too deep; see {REFERENCE}") from error
    except msgspec.ValidationError as error:
        missing = re.search(r"missing required field `(.*)`", str(error))
        if missing:
            raise InputError(
                f"the key {missing[1]} is missing; add it (see {REFERENCE})"
            ) from error
        message = str(error).replace(" | null", "")
        raise InputError(explained(message, keys, Kind(made, REFERENCE, TYPE_WORDS))) from error
    if not (fault.name.isprintable() and fault.name.strip() == fault.name):
        raise InputError(
            f"name = {shortened(repr(fault.name))}; write a name of printable letters, without a"
            " space at its ends"
        )
    fault.check()
    return fault


def table_of(fault: Fault) -> dict[str, Any]:
    """The table that makes the same fault again."""
    table = {key: value for key, value in msgspec.to_builtins(fault).items() if value is not None}
    return {"kind": fault.KIND, **table}


def _check_finite(value: Any, key: str = "") -> None:
    if isinstance(value, dict):
        for name, inner in value.items():
            _check_finite(inner, str(name))
    elif isinstance(value, list | tuple):
        for inner in value:
            _check_finite(inner, key)
    elif isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{shortened(key)} = {value}; a finite number is wanted")
