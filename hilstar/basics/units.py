"""Units: the constants and conversions that the rooms share, and units as people spell them.

Spelled units stand in headers, in lines of units and on data sheets; `factor` turns each into
another.
"""

import math
import re
from decimal import Decimal
from functools import cache
from typing import TYPE_CHECKING, overload

if TYPE_CHECKING:
    from hilstar.basics.arrays import FloatArray

NS_PER_US = 1_000
NS_PER_MS = 1_000_000
NS_PER_S = 1_000_000_000
ARCSEC_PER_RAD = math.degrees(1.0) * 3600.0
# from the median absolute deviation of a normal distribution: 1 / its upper quartile
MAD_TO_SIGMA = 1.482602218505602
ERROR_OF_MEDIAN = math.sqrt(math.pi / 2)  # in those of the mean, for normal errors
LIGHT_M_S = 299_792_458.0  # SI, exact
LIGHT_KM_S = LIGHT_M_S / 1000.0
KM_PER_AU = 149_597_870.7  # IAU 2012 Resolution B2, exact
MAX_SPEED_KM_S = 10_000.0  # of an observer: a thirtieth of that of light
MAG_PER_RELATIVE = 2.5 / math.log(10)  # a small relative error of a flux, in magnitudes

DEG_PER_RAD = math.degrees(1.0)
# Spellings in small ASCII letters without blanks, and how large each unit is beside the first of
# its table.
TIME = {
    "s sec secs second seconds": "1",
    "ms msec msecs millisecond milliseconds millis": "1e-3",
    "us usec usecs microsecond microseconds micros": "1e-6",
    "ns nsec nsecs nanosecond nanoseconds nanos": "1e-9",
    "min minute minutes": "60",
    "h hr hrs hour hours": "3600",
    "d day days": "86400",
}
LENGTH = {
    "nm nanometer nanometers nanometre nanometres": "1",
    "a aa ang angs angstr angstrom angstroms angstroem angstroems": "0.1",
    "um mum micron microns micrometer micrometers micrometre micrometres": "1e3",
    "mm millimeter millimeters millimetre millimetres": "1e6",
    "cm": "1e7",
    "m meter metre": "1e9",
}
ANGLE = {
    "deg degree degrees": "1",
    "h hr hrs hour hours hourangle": "15",
    "rad radian radians": repr(DEG_PER_RAD),
    "arcmin arcminute arcminutes amin": repr(1 / 60),
    "arcsec arcsecond arcseconds asec as": repr(1 / 3600),
    "mas milliarcsec milliarcsecond milliarcseconds": repr(1 / 3.6e6),
    "uas microarcsec microarcsecond": repr(1 / 3.6e9),
}
RATE = {
    "rad/s rad/sec rads-1 rad.s-1": "1",
    "mrad/s": "1e-3",
    "urad/s": "1e-6",
    "rad/ms": "1e3",
    "deg/s deg/sec degs-1 deg.s-1 dps": repr(1 / DEG_PER_RAD),
    "mdeg/s": repr(1e-3 / DEG_PER_RAD),
    "deg/min": repr(1 / DEG_PER_RAD / 60),
    "deg/h deg/hr": repr(1 / DEG_PER_RAD / 3600),
    "arcmin/s": repr(1 / DEG_PER_RAD / 60),
    "arcsec/s as/s": repr(1 / DEG_PER_RAD / 3600),
    "rpm rev/min": repr(6 / DEG_PER_RAD),
}
MOTION = {
    "mas/yr mas/y mas/a mas/year masyr-1 mas.yr-1": "1",
    "uas/yr uas/y uas/a uas/year uasyr-1": "1e-3",
    "arcsec/yr arcsec/y arcsec/a arcsec/year arcsecyr-1 arcsec.yr-1 as/yr as/y as/a": "1e3",
    "arcmin/yr": "6e4",
    "deg/yr deg/y deg/a deg/year degyr-1": "3.6e6",
}
SHARE = {
    "1 fraction frac ratio unitless none -": "1",
    "% percent pct perc": "1e-2",
    "permille": "1e-3",
}
PIXELS = {"px pix pixel pixels": "1"}
MAGNITUDE = {"mag mags magnitude": "1", "mmag": "1e-3"}
DIMENSIONS = (TIME, LENGTH, ANGLE, RATE, MOTION, SHARE, PIXELS, MAGNITUDE)
# Other words of a line of units or of brackets. They are never converted.
OTHER = (
    "dn adu counts count e- electrons electron e-/s e-/dn dn/e- dn/s adu/s v w cd/m2 lx lux k degc"
    " mag/arcsec2 w/m2 w/m2/nm yr jyr year date jd mjd string str float int bool h:m:s d:m:s"
    ' "h:m:s" "d:m:s"'
)
# What is not ASCII in a unit, in ASCII.
ASCII_OF = {
    "µ": "u",
    "μ": "u",
    "Å": "A",
    "\u212b": "A",
    "°": "deg",
    "℃": "degC",
    "⁻": "-",
    "−": "-",
    "–": "-",
    "‰": "permille",
    "¹": "1",
    "²": "2",
    "³": "3",
    "·": ".",
    "″": '"',
    "′": "'",
    "\u00a0": " ",
    "\u2009": " ",
    "\u202f": " ",
}
# OpenGL versions to ask for, newest first: NVIDIA's driver gives the version that is asked for, and
# no newer one.
GL_VERSIONS = ((4, 6), (4, 5), (4, 3), (3, 3))
COMPUTE_VERSION = 430  # the OpenGL that has compute shaders


@overload
def flux_ratio(mag: float) -> float: ...
@overload
def flux_ratio(mag: "FloatArray") -> "FloatArray": ...
def flux_ratio(mag: "float | FloatArray") -> "float | FloatArray":
    """The flux of a star of magnitude `mag` relative to one of magnitude 0 (Pogson 1856)."""
    return 10 ** (-0.4 * mag)


@overload
def magnitude(ratio: float) -> float: ...
@overload
def magnitude(ratio: "FloatArray") -> "FloatArray": ...
def magnitude(ratio: "float | FloatArray") -> "float | FloatArray":
    """The magnitude of a flux relative to that of magnitude 0; infinite for no flux."""
    if hasattr(ratio, "shape"):
        import numpy as np  # 0.1 s, which Tab and --help do not need

        with np.errstate(divide="ignore"):
            return np.asarray(-2.5 * np.log10(ratio))
    if ratio > 0:
        return -2.5 * math.log10(ratio)
    return math.inf


@cache
def _sizes() -> tuple[dict[str, Decimal], ...]:
    """The size of each spelling, a table for each dimension."""
    tables = []
    for dimension in DIMENSIONS:
        sizes: dict[str, Decimal] = {}
        for spellings, size in dimension.items():
            sizes |= dict.fromkeys(spellings.split(), Decimal(size))
        tables.append(sizes)
    return tuple(tables)


@cache
def _known() -> frozenset[str]:
    return frozenset(OTHER.split()).union(*_sizes())


def ascii_text(text: str) -> str:
    """A unit's or a number's characters in ASCII where they have such a form: "e⁻" is e-, "µm"
    um.
    """
    if text.isascii():
        return text
    for character, plain in ASCII_OF.items():
        text = text.replace(character, plain)
    return text


def plain_unit(text: str) -> str:
    """A unit in small ASCII letters without blanks: "°/s" is deg/s, "Å" a, '"/yr' arcsec/yr."""
    plain = ascii_text(text).strip()
    if plain.startswith('"'):
        plain = re.sub(r'^"(?=$|/|\s)', "arcsec", plain)
    plain = re.sub(r"(?<![a-z])per(?![a-z])", "/", plain.strip("\"'").lower())
    return re.sub(r"[\s_]*/[\s_]*", "/", plain).replace(" ", "")


def suffix_unit(suffix: str) -> str:
    """A unit as it ends a name: "arcsec_yr" is arcsec/yr, "deg_s" deg/s."""
    plain = plain_unit(suffix)
    if is_unit(plain):
        return plain
    return plain.replace("_", "/")


def is_unit(plain: str) -> bool:
    """Whether a word, as of `plain_unit`, is a unit."""
    return plain in _known()


def factor(unit: str, wanted: str) -> Decimal | None:
    """By what figures in `unit` are multiplied to be in `wanted`; None where the two are of
    different kinds.
    """
    plain = plain_unit(unit)
    target = plain_unit(wanted)
    if plain == target:
        return Decimal(1)
    for sizes in _sizes():
        if plain in sizes and target in sizes:
            return sizes[plain] / sizes[target]
    return None
