"""Element sets as CCSDS Orbit Mean-Elements Messages (502.0-B) in JSON, XML, CSV or KVN.

CelesTrak and Space-Track give them; sgp4's own `omm` makes a satellite of each.

What SGP4 would turn into another orbit is refused by name: another theory (SGP4-XP's ephemeris type
4, too), frame, centre or time scale, and elements out of their range.
"""

import io
import json
import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from hilstar.basics.errors import InputError, shortened

if TYPE_CHECKING:
    from sgp4.api import Satrec

KVN_KEY = "CCSDS_OMM_VERS"
# What sgp4 and the parsers below it raise; LookupError: an encoding that nobody knows.
NOT_OMM = (ValueError, SyntaxError, TypeError, AttributeError, LookupError, RecursionError)
FORM = "give two-line element sets, or OMM in JSON, XML or CSV"
# What each key has to be where it is there.
FIXED = {
    "CENTER_NAME": ("EARTH",),
    "REF_FRAME": ("TEME",),
    "TIME_SYSTEM": ("UTC",),
    "MEAN_ELEMENT_THEORY": ("SGP4", "SGP/SGP4", "SGP"),
    "EPHEMERIS_TYPE": ("0", "2", "3"),  # SGP4 itself, and its part for deep space
}
# The limits of each element, in the message's units (degrees, revolutions a day, 1/Earth radii).
LIMITS = {
    "MEAN_MOTION": (1e-3, 20.0),
    "ECCENTRICITY": (0.0, 0.999999),
    "INCLINATION": (0.0, 180.0),
    "RA_OF_ASC_NODE": (-360.0, 360.0),
    "ARG_OF_PERICENTER": (-360.0, 360.0),
    "MEAN_ANOMALY": (-360.0, 360.0),
    "BSTAR": (-100.0, 100.0),
}
NEEDED = ("EPOCH", "NORAD_CAT_ID", *LIMITS)
# What SGP4 does not use, and some writers leave out.
UNUSED = {
    "CLASSIFICATION_TYPE": "U",
    "OBJECT_ID": "",
    "EPHEMERIS_TYPE": "0",
    "ELEMENT_SET_NO": "999",
    "REV_AT_EPOCH": "0",
    "MEAN_MOTION_DOT": "0",
    "MEAN_MOTION_DDOT": "0",
}
MAX_NUMBER = 999_999_999
# sgp4 keeps a number of five characters; the whole one is in the message.
MAX_SGP4_NUMBER = 339_999


class OmmSet(NamedTuple):
    """One element set: its name ("" without one), catalogue number, and what SGP4 makes of it."""

    name: str
    number: int
    satrec: "Satrec"


def is_omm(text: str) -> bool:
    """Whether a text is OMM in one of its forms, and not two-line element sets."""
    begin = text.lstrip()
    if begin.startswith("<"):
        return "<omm" in begin
    if begin.startswith(("[", "{", KVN_KEY)):
        return True
    header = begin.split("\n", 1)[0].upper().split(",")
    return {"EPOCH", "MEAN_MOTION"} <= {name.strip().strip('"') for name in header}


def read_omm(text: str, file: str) -> Iterator[OmmSet]:
    """The element sets of a text. Raises InputError with the number of the set that is wrong."""
    from sgp4 import omm
    from sgp4.api import Satrec

    for count, raw in enumerate(_fields(text, file), start=1):
        where = f"{file}: element set {count}"
        fields = {name: _text(value) for name, value in raw.items() if name and value is not None}
        name = fields.get("OBJECT_NAME", "")
        _check(fields, f"{where} ({shortened(name)})" if name else where)
        satrec = Satrec()
        number = int(fields["NORAD_CAT_ID"])
        known = UNUSED | fields
        known["EPOCH"] = _epoch(fields["EPOCH"])
        known["NORAD_CAT_ID"] = str(min(number, MAX_SGP4_NUMBER))
        try:
            omm.initialize(satrec, known)
        except (ValueError, ArithmeticError, LookupError, TypeError) as error:
            raise InputError(f"{where}: {shortened(error)}; {FORM}") from error
        yield OmmSet(name, number, satrec)


def _fields(text: str, file: str) -> Iterator[Mapping[str, Any]]:
    """The keys and values of each set. Raises InputError."""
    from sgp4 import omm

    begin = text.lstrip()
    try:
        if begin.startswith(("[", "{")):
            parsed = json.loads(text)
            yield from _dictionaries(parsed if isinstance(parsed, list) else [parsed], file)
        elif begin.startswith("<"):
            if "<!DOCTYPE" in text:
                raise InputError(f"{file}: has a DOCTYPE, which no OMM has; {FORM}")
            yield from omm.parse_xml(io.StringIO(text))
        elif begin.startswith(KVN_KEY):
            yield from _of_kvn(text)
        else:
            yield from omm.parse_csv(io.StringIO(begin))
    except NOT_OMM as error:
        refusal = f"{file}: is no OMM that can be read ({shortened(error)})"
        raise InputError(f"{refusal}; {FORM}") from error


def _dictionaries(sets: list[Any], file: str) -> Iterator[Mapping[str, Any]]:
    for count, element_set in enumerate(sets, start=1):
        if not isinstance(element_set, dict):
            raise InputError(f"{file}: element set {count} is no JSON object; {FORM}")
        yield element_set


def _of_kvn(text: str) -> Iterator[Mapping[str, Any]]:
    """The sets of KVN messages, one after another."""
    fields: dict[str, str] = {}
    for line in text.splitlines():
        key, equals, value = line.partition("=")
        if not equals or line.startswith("COMMENT"):
            continue
        if key.strip() == KVN_KEY and fields:
            yield fields
            fields = {}
        fields[key.strip()] = value.split("[", 1)[0].strip()
    yield fields


def _text(value: Any) -> str:
    if isinstance(value, float):
        return repr(value)
    return str(value).strip()


def _check(fields: Mapping[str, str], where: str) -> None:
    """Refuse (InputError) a set without an element, or with one that SGP4 takes otherwise."""
    for name in NEEDED:
        if not fields.get(name):
            raise InputError(f"{where}: {name} is missing; {FORM}")
    for name, allowed in FIXED.items():
        given = fields.get(name, allowed[0])
        if given.upper() not in allowed:
            other = f"{where}: {name} is {shortened(given)}"
            raise InputError(f"{other}, and only {allowed[0]} is read; {FORM}")
    for name, (low, high) in LIMITS.items():
        try:
            value = float(fields[name])
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            given = f"{where}: {name} is {shortened(fields[name])}"
            raise InputError(f"{given}; it must be from {low:g} to {high:g}")
    number = fields["NORAD_CAT_ID"]
    if not number.isdecimal() or int(number) > MAX_NUMBER:
        given = f"{where}: NORAD_CAT_ID is {shortened(number)}"
        raise InputError(f"{given}; write a catalogue number, such as 25544")


def _epoch(text: str) -> str:
    """An epoch as sgp4 has it: with a fraction of a second, and no Z."""
    plain = text.strip().removesuffix("Z").replace(" ", "T")
    return plain if "." in plain else f"{plain}.0"
