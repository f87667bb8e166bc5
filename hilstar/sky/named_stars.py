"""Stars by what a person calls them: a proper name, a designation, a Hipparcos number.

Names and designations are those of `star_names`: 3300 stars, whose letters are Greek ("α Ori").
A person may spell the letter out ("alpha Ori"), and write capitals or not.
"""

import math
import re
import unicodedata
from functools import cache

import numpy as np

from hilstar.basics.errors import InputError, did_you_mean, shortened
from hilstar.basics.rotation import to_radec_deg
from hilstar.sky.catalog import load_catalog, star_names
from hilstar.sky.stars import unit_vectors_icrs

NUMBER = re.compile(r"(?:HIP\s*)?(\d{1,9})", re.IGNORECASE)
STAR_FORM = "write a name such as Vega or alpha Lyr, or a Hipparcos number"


def hip_named(text: str) -> int | None:
    """The Hipparcos number of a star by its name or designation; None where no star has it.

    >>> hip_named("vega"), hip_named("α Lyr"), hip_named("alpha lyr"), hip_named("nobody")
    (91262, 91262, 91262, None)
    """
    return _numbers().get(_plain(text))


def is_star(text: str) -> bool:
    """Whether a text is a star's name or designation, or has the form of a Hipparcos number."""
    return NUMBER.fullmatch(text.strip()) is not None or hip_named(text) is not None


def hip_of(text: str) -> int:
    """The Hipparcos number that a text is or names: "91262", "HIP 91262", "Vega". Raises
    InputError for a name that no star has.
    """
    number = NUMBER.fullmatch(text.strip())
    if number is not None:
        return int(number[1])
    hip = hip_named(text)
    if hip is None:
        known = [name for star in star_names().values() for name in star if name]
        raise InputError(
            f"{shortened(text)}: no star has this name; {did_you_mean(text, known)}{STAR_FORM}"
        )
    return hip


def star_place_deg(text: str, epoch_jyear: float) -> tuple[float, float]:
    """Right ascension and declination, degrees, ICRS, of a star of Hipparcos at a Julian year.

    `text` is as for `hip_of`. Raises InputError.
    """
    hip = hip_of(text)
    catalog = load_catalog()
    row = np.flatnonzero(catalog.hip == hip)
    if not len(row):
        raise InputError(
            f"HIP {hip}: the packaged catalogue has no place, V and B-V of this star; {STAR_FORM}"
        )
    places = to_radec_deg(unit_vectors_icrs(catalog, epoch_jyear)[row])
    return float(places.ra_deg[0]), float(places.dec_deg[0])


@cache
def _numbers() -> dict[str, int]:
    """Hipparcos numbers by plain name. Two stars may have one designation, as those of a double
    have: the brighter is meant.
    """
    names, catalog = star_names(), load_catalog()
    rows = np.isin(catalog.hip, list(names))
    v_mag = dict(zip(catalog.hip[rows].tolist(), catalog.v_mag[rows].tolist(), strict=True))
    numbers: dict[str, int] = {}
    for hip in sorted(names, key=lambda hip: v_mag.get(hip, math.inf)):
        for name in names[hip]:
            if name:
                numbers.setdefault(_plain(name), hip)
    return numbers


def _plain(text: str) -> str:
    """A name in small letters, Greek spelled out, with one space between its words: "alpha1 cen"
    of "α¹ Cen".
    """
    letters: list[str] = []
    for letter in unicodedata.normalize("NFKC", text):
        name = unicodedata.name(letter, "")
        is_greek = name.startswith("GREEK SMALL LETTER ")
        # Unicode calls lambda "lamda"
        letters.append(name.split()[3].replace("LAMDA", "LAMBDA") if is_greek else letter)
    return " ".join("".join(letters).casefold().split())
