"""Where the observer is: at the Earth's centre, or on a satellite's orbit, given by an element set
(two lines, or an OMM).

The orbit is computed by SGP4 as Vallado et al. give it (2006, AIAA 2006-6753).
"""

import importlib.util
import logging
from functools import lru_cache
from typing import Protocol

import erfa
import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, MachineError
from hilstar.sky.bodies.kernel import INSTALL, NS_PER_DAY, UNIX_JD, Tdb, tdb_of_utc
from hilstar.sky.bodies.omm import is_omm, read_omm

LINE_LENGTH = 69  # characters of an element line, its checksum included
# What each ASCII character adds to its line's checksum. It is a table for speed: lists of elements
# have tens of thousands of lines.
DIGIT_VALUE = dict.fromkeys(range(128), 0) | {ord("-"): 1} | {ord(str(n)): n for n in range(10)}
TLE_ADVICE = "give a file with one two-line element set, or one OMM in JSON, XML or CSV"
# How long one rotation from TEME to ICRS serves: the equator's axes move by 0.006 arcsec an hour,
# which is 0.2 m in a low orbit.
TURN_NS = 3600 * 10**9
log = logging.getLogger(__name__)


class Orbit(Protocol):
    """An observer's position and velocity with respect to the Earth's centre."""

    @property
    def step_s(self) -> float:
        """The time between two exact positions, s: straight lines between them give the apparent
        places of bodies within 5 mas.
        """

    def state(self, utc_ns: int) -> tuple[FloatArray, FloatArray]:
        """The position (3,), km, and velocity (3,), km/s, in ICRS axes, at a UTC, ns since 1970.
        Raises InputError for a time for which there is no orbit.
        """


class Geocentre:
    """The Earth's centre itself."""

    # The Moon, the fastest body, is 0.06 mas off midway between two exact positions, by 1e-7
    # arcsec/s^2 and its own path's bend.
    step_s = 60.0

    def state(self, utc_ns: int) -> tuple[FloatArray, FloatArray]:
        """Position and velocity 0: the observer is the Earth's centre."""
        return np.zeros(3), np.zeros(3)


class TleOrbit:
    """A satellite's orbit from the elements in `text`, the contents of the file `name`. Raises
    InputError for wrong elements, MachineError where SGP4 is not installed.
    """

    # Seen from an orbit at 400 km, parallax bends the Moon's path by 5e-3 arcsec/s^2: it is 2.5 mas
    # off midway between two exact positions.
    step_s = 2.0

    def __init__(self, text: str, name: str) -> None:
        if importlib.util.find_spec("sgp4") is None:
            raise MachineError(f"[spacecraft] orbit = a file of elements needs SGP4; {INSTALL}")
        from sgp4.api import SGP4_ERRORS, Satrec

        self._name = name
        self._errors = SGP4_ERRORS
        if is_omm(text):
            sets = list(read_omm(text, name))
            if len(sets) != 1:
                raise InputError(
                    f"{name}: has {len(sets)} element sets, and an orbit is one; {TLE_ADVICE}"
                )
            element_set = sets[0]
            self._satellite = element_set.satrec
            self.number = element_set.number
        else:
            first, second = _checked(name, text)
            self._satellite = Satrec.twoline2rv(first, second)
            self.number = int(self._satellite.satnum)

    def age_days(self, utc_ns: int) -> float:
        """How many days a UTC, ns since 1970, is after the elements' epoch; below 0 before it."""
        epoch_jd = float(self._satellite.jdsatepoch)
        epoch_part = float(self._satellite.jdsatepochF)
        return utc_ns / NS_PER_DAY + UNIX_JD - epoch_jd - epoch_part

    def state(self, utc_ns: int) -> tuple[FloatArray, FloatArray]:
        """Position and velocity by SGP4, which gives them in TEME (true equator, mean equinox),
        turned into ICRS axes; see `Orbit.state`.
        """
        days, rest_ns = divmod(utc_ns, NS_PER_DAY)
        jd = UNIX_JD + days
        jd_part = rest_ns / NS_PER_DAY
        error, place_km, velocity_km_s = self._satellite.sgp4(jd, jd_part)
        if error:
            date = np.datetime64(utc_ns, "ns").astype("datetime64[s]")
            raise InputError(
                f"{self._name}: no orbit at {date}: {self._errors[error]}; give newer elements"
            )
        turn = icrs_from_teme(utc_ns // TURN_NS)
        return turn @ place_km, turn @ velocity_km_s


def _checked(name: str, text: str) -> tuple[str, str]:
    """The two element lines of a text, without its other lines. Raises InputError where there is
    not exactly one pair, or a checksum is wrong.
    """
    tle_lines = []
    numbers = ""
    for line in text.splitlines():
        line = line.rstrip()
        if line.startswith(("1 ", "2 ")) and len(line) == LINE_LENGTH and line.isascii():
            tle_lines.append(line)
            numbers += line[0]
    if numbers != "12":
        raise InputError(
            f"{name}: not one set of two lines of {LINE_LENGTH} characters that begin with 1 and 2;"
            f" {TLE_ADVICE}"
        )
    for number, line in enumerate(tle_lines, start=1):
        total = digit_sum(line)
        stated = line[-1]
        if str(total) != stated:
            raise InputError(
                f"{name}: element line {number}: its digits add up to {total}, not {stated};"
                f" {TLE_ADVICE}"
            )
    first, second = tle_lines
    return first, second


def digit_sum(line: str) -> int:
    """The checksum of an element line (ASCII): the sum of its digits, with a minus sign as 1,
    modulo 10. The last character is left out, as it states the checksum.
    """
    values = map(DIGIT_VALUE.__getitem__, line[:-1].encode())
    return sum(values) % 10


@lru_cache(maxsize=8)
def icrs_from_teme(hour: int) -> FloatArray:
    """The matrix (3, 3) that turns TEME components into ICRS components at `hour`, hours since 1970
    (UTC): first the equation of the equinoxes, then nutation and precession (IAU 2006).
    """
    date: Tdb = tdb_of_utc(hour * TURN_NS)
    equinoxes_rad = erfa.ee06a(date.whole, date.part)
    cosine = np.cos(equinoxes_rad)
    sine = np.sin(equinoxes_rad)
    teme_to_true = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    true_from_icrs = erfa.pnm06a(date.whole, date.part)
    return np.asarray(true_from_icrs.T @ teme_to_true)
