"""The catalogue's sky on the day of a photograph, brightest stars first; the planets on that
day.
"""

import warnings
from dataclasses import dataclass
from functools import lru_cache

import erfa
import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.units import NS_PER_S
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.config.bench_config import UNIX_JD, jyear
from hilstar.server.bench.site import Ground, site_refraction
from hilstar.server.bench.star_light import catalogue_choice
from hilstar.server.bench.star_rates import bench_optics
from hilstar.sky.air import air_mass
from hilstar.sky.catalog import Catalog
from hilstar.sky.facts import errors_of, sigma_v_mag
from hilstar.sky.star_table import choose_catalog
from hilstar.sky.stars import AirAbove, aberrate, unit_vectors_icrs

AU_KM, DAY_S = 149_597_870.7, 86_400.0
# ERFA's numbers from 1; 3 is the Earth
PLANETS = ("Mercury", "Venus", "", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune")
# flags of CDS I/239's H59 and H52
DOUBLES, VARIABLES = (b"C", b"G", b"O", b"V", b"X"), (b"P", b"U")
DAY_NS = 86_400 * NS_PER_S


@dataclass(frozen=True, slots=True)
class DatedSky:
    """Stars (n,) as seen from the Earth on a day, brightest first: unit vectors (n, 3), ICRS, by
    row of the catalogue.

    `velocity_km_s` is the observer's; None where no date is known, and then stars are those of the
    bench's epoch without aberration.
    """

    catalog: Catalog
    epoch_jyear: float
    velocity_km_s: FloatArray | None
    vectors: FloatArray
    order: IntArray
    air: AirAbove | None = None  # over `[site]` on that day

    def masses(self, direction: FloatArray) -> float | None:
        """Air masses before a direction outside the air (3,); None without a site or a date."""
        if self.air is None:
            return None
        return float(air_mass(self.air.altitude_rad(direction[None]))[0])

    @property
    def v_mag(self) -> FloatArray:
        """V."""
        return self.catalog.v_mag[self.order]

    @property
    def bv_mag(self) -> FloatArray:
        """B-V."""
        return self.catalog.bv_mag[self.order]

    @property
    def hip(self) -> npt.NDArray[np.int32]:
        """HIP numbers."""
        return self.catalog.hip[self.order]

    def columns(self, row: IntArray) -> FloatArray:
        """V, B-V and V-I (3, k) of rows of the catalogue."""
        return np.stack(
            [self.catalog.v_mag[row], self.catalog.bv_mag[row], self.catalog.vi_mag[row]]
        )

    def within(self, star: IntArray) -> tuple[FloatArray, BoolArray, BoolArray]:
        """Of some stars (k,): the error of V, mag, and whether they are known doubles or
        variables.
        """
        stars = self.catalog.taken(self.order[star])
        sigma_mag = np.nan_to_num(sigma_v_mag(errors_of(stars), stars.bv_mag), nan=0.05)
        is_double = np.isin(stars.multiple, DOUBLES)
        is_variable = np.isin(stars.variable, VARIABLES)
        return sigma_mag, is_double, is_variable

    def name(self, star: int) -> str:
        """What a star is called in the catalogue."""
        row = int(self.order[star])
        if self.catalog.hip[row]:
            return f"HIP {self.catalog.hip[row]}"
        return self.catalog.name(row)


def dated_sky(file: BenchFile, t_ns: int | None) -> DatedSky:
    """The sky of a UTC, of a bench's catalogue. Raises InputError for a catalogue that cannot be
    read.
    """
    sky = file.config.sky
    catalog = choose_catalog(catalogue_choice(file.config, file.folder))
    order = np.argsort(catalog.v_mag, kind="stable")
    if t_ns is None:
        vectors = unit_vectors_icrs(catalog, sky.epoch_jyear)[order]
        return DatedSky(catalog, sky.epoch_jyear, None, vectors, order)
    epoch_jyear = jyear(t_ns)
    velocity_km_s = earth_velocity_km_s(t_ns)
    air = None
    site = file.config.site
    if site is not None:
        ground = Ground(site)
        _, ground_km_s = ground.state(t_ns)
        velocity_km_s = velocity_km_s + ground_km_s
        optics = bench_optics(file.config.tracker, file.folder)
        air = AirAbove(ground.up(t_ns), site_refraction(site, optics))
    vectors = unit_vectors_icrs(catalog, epoch_jyear)[order]
    seen_vectors = aberrate(vectors, velocity_km_s)
    return DatedSky(catalog, epoch_jyear, velocity_km_s, seen_vectors, order, air)


@lru_cache(maxsize=64)
def _earth(t_ns: int) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """The Earth's place from the Sun and the barycentre, au, and its velocity, au a day (ERFA's
    epv00).
    """
    with warnings.catch_warnings():
        # years beyond 1900 to 2100: 0.01 arcsec of aberration
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        about_sun, about_centre = erfa.epv00(UNIX_JD, t_ns / DAY_NS)
    return tuple(about_sun["p"]), tuple(about_centre["p"]), tuple(about_centre["v"])


def earth_velocity_km_s(t_ns: int) -> FloatArray:
    """The Earth's velocity about the barycentre (3,), ICRS; 0.5 km/s of its turning are left
    out: 0.3 arcsec.
    """
    return np.array(_earth(t_ns)[2]) * AU_KM / DAY_S


def planets_seen(t_ns: int) -> dict[str, FloatArray]:
    """Unit vectors (3,) to the planets and the Moon from the Earth's centre, ICRS: within 1
    arcmin, the Moon 1 deg.
    """
    earth = np.array(_earth(t_ns)[0])
    planets = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        for number, name in enumerate(PLANETS, start=1):
            if name:
                planets[name] = erfa.plan94(UNIX_JD, t_ns / DAY_NS, number)["p"] - earth
        planets["the Moon"] = erfa.moon98(UNIX_JD, t_ns / DAY_NS)["p"]
    velocity_km_s = earth_velocity_km_s(t_ns)
    directions = {}
    for name, place_au in planets.items():
        unit = place_au / np.linalg.norm(place_au)
        directions[name] = np.asarray(aberrate(unit[None], velocity_km_s)[0])
    return directions
