"""Places of Sun, Moon and planets by JPL's ephemeris DE421 (Folkner et al. 2009), part of the extra
`hilstar[bodies]`.

Where the sky is seen from near the Earth: parallax, light bent by the Sun, aberration.
"""

import importlib.util
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import erfa
import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import MachineError
from hilstar.basics.units import KM_PER_AU, LIGHT_KM_S
from hilstar.sky.stars import aberrate

DAY_S = 86_400.0
UNIX_JD = 2_440_587.5
TT_FROM_TAI_S = 32.184
NS_PER_DAY = 86_400 * 10**9
INSTALL = "pip install 'hilstar[bodies]'"

# The kernel's chains of segments (centre, target). A planet is the centre of mass of its system,
# within 0.08 arcsec of the planet's own: Jupiter's moons move Jupiter by 230 km, Saturn's Saturn by
# 300 km.
EARTH = ((0, 3), (3, 399))
CHAINS: dict[str, tuple[tuple[int, int], ...]] = {
    "Earth": EARTH,  # from its own centre: no way at all
    "Sun": ((0, 10),),
    "Moon": ((0, 3), (3, 301)),
    "Mercury": ((0, 1),),
    "Venus": ((0, 2),),
    "Mars": ((0, 4),),
    "Jupiter": ((0, 5),),
    "Saturn": ((0, 6),),
    "Uranus": ((0, 7),),
    "Neptune": ((0, 8),),
}
# each fixed-point round gains a factor of 1e4 (light's speed over the body's)
LIGHT_TIME_ROUNDS = 3
SUN_MASSES = 1.0
MAS_PER_DEG = 3_600_000.0
# ERFA's own at 1 au (`ldsun`), 4 arcmin from the Sun's centre: within its disc the formula has no
# meaning.
DEFLECTION_LIMIT = 1e-6


@dataclass(frozen=True, slots=True)
class Tdb:
    """A moment of barycentric dynamical time as a Julian date in two parts: the date is their
    sum.
    """

    whole: float
    part: float

    def after(self, seconds: float) -> "Tdb":
        """The moment some seconds later."""
        return Tdb(self.whole, self.part + seconds / DAY_S)


def tdb_of_utc(utc_ns: int) -> Tdb:
    """The moment of a UTC, ns since 1970 where every day has 86400 s, within 2 microseconds
    (ERFA's `dat` and `dtdb`).
    """
    days, rest_ns = divmod(utc_ns, NS_PER_DAY)
    whole = UNIX_JD + days
    part = rest_ns / NS_PER_DAY
    with warnings.catch_warnings():
        # before 1960, and years after the last known leap second
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        # Not `utctai`, whose day that ends with a leap second is stretched over 86401 s.
        year, month, day, day_part = erfa.jd2cal(whole, part)
        tai_less_utc_s = float(erfa.dat(year, month, day, day_part))
        tt_part = part + (tai_less_utc_s + TT_FROM_TAI_S) / DAY_S
    tdb_less_tt_s = float(erfa.dtdb(whole, tt_part, part, 0.0, 0.0, 0.0))
    return Tdb(whole, tt_part + tdb_less_tt_s / DAY_S)


class Kernel:
    """The ephemeris on this machine. Raises MachineError where the extra is not installed;
    nothing is downloaded.
    """

    def __init__(self) -> None:
        package_spec = importlib.util.find_spec("skyfield_data")
        reader_spec = importlib.util.find_spec("jplephem")
        if package_spec is None or package_spec.origin is None or reader_spec is None:
            raise MachineError(
                f"[sky.bodies] and [spacecraft] need an ephemeris of the Solar System; {INSTALL}"
            )
        from jplephem.spk import SPK

        kernel_file = Path(package_spec.origin).parent / "data" / "de421.bsp"
        spk = SPK.open(str(kernel_file))
        self._segments: dict[tuple[int, int], Any] = {}
        for chain in CHAINS.values():
            for link in chain:
                segment = spk[link]
                # maps its numbers into memory, where they stay when the file is closed
                segment.compute(segment.start_jd)
                self._segments[link] = segment
        spk.daf.file.close()
        sun = self._segments[CHAINS["Sun"][0]]
        self.first_jd = float(sun.start_jd)
        self.last_jd = float(sun.end_jd)

    def places_km(
        self, chain: tuple[tuple[int, int], ...], whole: float, part: FloatArray
    ) -> FloatArray:
        """Barycentric places (k, 3), ICRS axes, at the Julian dates (TDB) `whole` + `part` (k,)."""
        steps_km = [self._segments[link].compute(whole, part) for link in chain]
        return np.asarray(sum(steps_km).T)

    def earth(self, whole: float, part: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Barycentric places, km, and velocities, km/s, of the Earth's centre, (k, 3) each."""
        place_km = np.zeros((3, len(part)))
        velocity_km_day = np.zeros((3, len(part)))
        for link in EARTH:
            step_km, step_km_day = self._segments[link].compute_and_differentiate(whole, part)
            place_km += step_km
            velocity_km_day += step_km_day
        return place_km.T, velocity_km_day.T / DAY_S

    def seen_km(
        self, name: str, whole: float, part: FloatArray, earth_km: FloatArray
    ) -> FloatArray:
        """Vectors (k, 3) from the Earth's centre to where a body was when the light that arrives
        now left it.
        """
        chain = CHAINS[name]
        light_days = np.zeros_like(part)
        for _ in range(LIGHT_TIME_ROUNDS):
            place_km = self.places_km(chain, whole, part - light_days)
            from_earth_km = place_km - earth_km
            distance_km = np.linalg.norm(from_earth_km, axis=1)
            light_days = distance_km / LIGHT_KM_S / DAY_S
        return from_earth_km


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """An observer: place and velocity about the barycentre, km and km/s, and the vector from the
    Sun to it, km; ICRS axes.
    """

    place_km: FloatArray
    velocity_km_s: FloatArray
    from_sun_km: FloatArray


def apparent_bodies(seen_km: FloatArray, view: Viewpoint) -> FloatArray:
    """Unit vectors (n, 3) of the Sun and other bodies at vectors `seen_km` (n, 3) from the
    observer, light time included.

    The Sun bends the light of the others: Klioner 2003, AJ 125, 1580, by ERFA's `ld`. The bending
    by planets, 0.02 arcsec beside Jupiter's limb, is left out.
    """
    directions = _unit(seen_km)
    distance_km = float(np.linalg.norm(view.from_sun_km))
    outward = view.from_sun_km / distance_km
    distance_au = distance_km / KM_PER_AU
    others = directions[1:]
    from_sun = _unit(seen_km[1:] + view.from_sun_km)
    directions[1:] = erfa.ld(SUN_MASSES, others, from_sun, outward, distance_au, DEFLECTION_LIMIT)
    return aberrate(directions, view.velocity_km_s)


def apparent_stars(directions: FloatArray, parallax_mas: FloatArray, view: Viewpoint) -> FloatArray:
    """Unit vectors (n, 3) of stars in directions (n, 3) from the barycentre; a parallax of NaN
    or below 0 counts as 0.
    """
    known_mas = np.fmax(parallax_mas, 0.0)
    shift_rad = np.radians(known_mas / MAS_PER_DEG)
    place_au = view.place_km / KM_PER_AU
    directions = _unit(directions - shift_rad[:, None] * place_au)
    distance_km = float(np.linalg.norm(view.from_sun_km))
    outward = view.from_sun_km / distance_km
    bent = erfa.ldsun(directions, outward, distance_km / KM_PER_AU)
    return aberrate(_unit(bent), view.velocity_km_s)


def _unit(vectors: FloatArray) -> FloatArray:
    """The unit vectors (..., 3) along vectors (..., 3)."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / lengths)
