"""Apparent places of bodies against JPL Horizons, Skyfield and Astropy."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import astropy.units as u
import erfa
import numpy as np
import pytest
from astropy.config import set_temp_cache
from astropy.coordinates import (
    GCRS,
    Distance,
    EarthLocation,
    SkyCoord,
    get_body,
    solar_system_ephemeris,
)
from astropy.time import Time
from skyfield.api import EarthSatellite
from skyfield.jpllib import SpiceKernel
from skyfield.timelib import Timescale

from hilstar.basics.units import KM_PER_AU
from hilstar.sky.bodies.kernel import tdb_of_utc
from hilstar.sky.bodies.orbit import TleOrbit
from hilstar.sky.bodies.shapes import POLAR_RADII_KM, RADII_KM
from tests.support.claims import holds
from tests.support.skies import (
    ALL_BODIES,
    SKYFIELD_NAMES,
    STATION_TLE,
    STATION_UTC,
    kernel_path,
    moving_sky,
    random_utcs_ns,
    skyfield,
    utc_ns,
)

ARCSEC = np.pi / (180 * 3600)
HORIZONS_LIMIT_ARCSEC = 0.1  # its values have 0.01 s of right ascension, 0.15 arcsec
# Measured: 0.5 mas: Skyfield bends light by the Earth too, which is that much.
ORBIT_LIMIT_ARCSEC = 0.002


def apart_arcsec(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return 2 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2) / ARCSEC


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def seen_at(utc: str | int, **more) -> np.ndarray:
    """Unit vectors of ALL_BODIES, ICRS."""
    return moving_sky(utc, **more).sight(0).directions


@pytest.fixture(scope="module")
def theirs() -> Iterator[tuple[Timescale, SpiceKernel]]:
    with skyfield() as both:
        yield both


def in_skyfield(
    theirs: tuple[Timescale, SpiceKernel],
    utcs_ns: list[int],
    satellite: EarthSatellite | None = None,
) -> np.ndarray:
    """Apparent unit vectors of ALL_BODIES at UTCs (n,), shape (n, 9, 3)."""
    scale, kernel = theirs
    days, rest_ns = np.divmod(np.array(utcs_ns), 86_400 * 10**9)
    observer = kernel["earth"] if satellite is None else kernel["earth"] + satellite
    now = observer.at(scale.utc(1970, 1, 1 + days, 0, 0, rest_ns / 1e9))
    return unit(
        np.stack(
            [now.observe(kernel[SKYFIELD_NAMES[name]]).apparent().xyz.au.T for name in ALL_BODIES],
            axis=1,
        )
    )


def test_200_random_dates_agree_with_skyfield(rng, theirs):
    utcs = random_utcs_ns(rng, 200)
    ours = np.array([seen_at(utc) for utc in utcs])
    # largest for Uranus: in Skyfield Jupiter and Saturn bend light too
    off_arcsec = apart_arcsec(ours, in_skyfield(theirs, utcs))
    holds("body-places", 1000 * off_arcsec.max())


def test_the_moon_moves_so_far_while_the_scale_of_time_is_29_seconds_off(rng, theirs):
    """UTC is 37 s behind TAI since 2017, and was 8 s behind at the beginning of 1970."""
    utcs = random_utcs_ns(rng, 200)
    moon = ALL_BODIES.index("Moon")
    there = in_skyfield(theirs, utcs)[:, moon]
    later = in_skyfield(theirs, [utc + 29 * 10**9 for utc in utcs])[:, moon]
    holds("moon-in-29-s", apart_arcsec(there, later).mean())


# Astropy asks ERFA for leap seconds years after the last known one
@pytest.mark.filterwarnings("ignore:ERFA function:erfa.ErfaWarning")
def test_astropys_route_through_erfa_agrees(rng, tmp_path):
    kernel = kernel_path().as_uri()
    off_arcsec = []
    names = ("sun", "moon", "mercury", "venus", "mars", "jupiter", "saturn", "uranus", "neptune")
    for utc in random_utcs_ns(rng, 10):
        time = Time(utc / 1e9, format="unix", scale="utc")
        ours = seen_at(utc)
        for k, name in enumerate(names):
            if apart_arcsec(ours[k], ours[0]) < 10 * 3600:
                continue  # beside or before the Sun, where Skyfield's test is
            # Its frames use the kernel for the Earth too; it keeps a copy, which is no user's.
            with set_temp_cache(tmp_path), solar_system_ephemeris.set(kernel):
                theirs = get_body(name, time).cartesian.xyz.to_value(u.km)
            off_arcsec.append(apart_arcsec(ours[k], unit(theirs)))
    holds("body-places-astropy", 1000 * np.max(off_arcsec))


# Right ascension and declination of date, degrees, from 67.787260 W, 22.959748 S, 5186 m, on
# 2020-04-06 each hour from 0:00: JPL Horizons, as Astropy's own tests quote it
# (test_solar_system.py), whose equinox is 51.02 mas off in right ascension.
SITE_DEG_M = (-67.787260, -22.959748, 5186.0)
HORIZONS_EQUINOX_ARCSEC = 0.05102376467
MOON_RA_DEG = (
    *(
        170.167332531,
        170.560688674,
        170.923834838,
        171.271663481,
        171.620188972,
        171.985340827,
        172.381766539,
        172.821772139,
    ),
    *(
        173.314502650,
        173.865422398,
        174.476108551,
        175.144332386,
        175.864375310,
        176.627519827,
        177.422655853,
        178.236955730,
    ),
    *(
        179.056584831,
        179.867427392,
        180.655815385,
        181.409252074,
        182.117113814,
        182.771311578,
        183.366872837,
        183.902395443,
    ),
)
MOON_DEC_DEG = (
    *(
        10.269112037,
        10.058820647,
        9.837152044,
        9.603724551,
        9.358956528,
        9.104012390,
        8.840674927,
        8.571162442,
    ),
    *(
        8.297917326,
        8.023394488,
        7.749873882,
        7.479312991,
        7.213246666,
        6.952732614,
        6.698336823,
        6.450150213,
    ),
    *(
        6.207828142,
        5.970645962,
        5.737565957,
        5.507313851,
        5.278462034,
        5.049521497,
        4.819038911,
        4.585696512,
    ),
)


class Site:
    """An observatory, turning with the Earth, by Astropy."""

    step_s = 1.0

    @cache  # noqa: B019 - it lives as long as the test; Astropy takes 0.1 s
    def state(self, utc_ns: int) -> tuple[np.ndarray, np.ndarray]:
        lon, lat, height = SITE_DEG_M
        place, velocity = EarthLocation.from_geodetic(
            lon * u.deg, lat * u.deg, height * u.m
        ).get_gcrs_posvel(Time(utc_ns / 1e9, format="unix", scale="utc"))
        return place.xyz.to_value(u.km), velocity.xyz.to_value(u.km / u.s)


def test_the_moon_over_a_turning_earth_is_where_horizons_has_it():
    start, off_arcsec = utc_ns("2020-04-06T00:00:00Z"), []
    for hour, (ra_deg, dec_deg) in enumerate(zip(MOON_RA_DEG, MOON_DEC_DEG, strict=True)):
        utc = start + hour * 3600 * 10**9
        tdb = tdb_of_utc(utc)
        seen = erfa.pnm06a(tdb.whole, tdb.part) @ seen_at(utc, orbit=Site())[1]
        theirs = erfa.s2c(
            np.radians(ra_deg) + HORIZONS_EQUINOX_ARCSEC * ARCSEC, np.radians(dec_deg)
        )
        off_arcsec.append(apart_arcsec(seen, theirs))
    # 1.5 m of DE441's Moon against DE421's
    holds("moon-horizons", 1000 * np.max(off_arcsec))


def test_bodies_of_1980_are_where_horizons_has_them():
    """Apparent, of date, from the Earth's centre, 1980-03-25 0:00 UTC: JPL Horizons by Astropy's
    tests.
    """
    horizons = {
        "Sun": "00h16m31.00s +01d47m16.9s",
        "Moon": "07h32m02.62s +18d34m05.0s",
        "Mercury": "22h41m47.78s -08d29m32.0s",
        "Jupiter": "10h17m12.82s +12d02m57.0s",
    }
    utc = "1980-03-25T00:00:00Z"
    tdb = tdb_of_utc(utc_ns(utc))
    seen = seen_at(utc) @ erfa.pnm06a(tdb.whole, tdb.part).T
    for name, text in horizons.items():
        place = SkyCoord(text)
        theirs = erfa.s2c(place.ra.rad, place.dec.rad)
        assert apart_arcsec(seen[ALL_BODIES.index(name)], theirs) < HORIZONS_LIMIT_ARCSEC, name


@pytest.mark.filterwarnings("ignore:ERFA function:erfa.ErfaWarning")
def test_stars_near_and_far_are_seen_where_astropy_has_them(rng):
    off_arcsec = []
    for utc in random_utcs_ns(rng, 5):
        vectors = unit(rng.normal(size=(200, 3)))
        sun = seen_at(utc)[0]
        # nearer, Astropy's Earth (ERFA's epv00) bends otherwise
        vectors = vectors[vectors @ sun < np.cos(np.radians(1.0))]
        frame = GCRS(obstime=Time(utc / 1e9, format="unix", scale="utc"))
        ra, dec = erfa.c2s(vectors)
        parallax_mas = rng.uniform(1.0, 800.0, size=len(vectors))
        parallax_mas[0] = np.nan
        far = Distance(np.where(np.isnan(parallax_mas), 1e12, 1000 / parallax_mas), u.pc)
        theirs = (
            SkyCoord(ra * u.rad, dec * u.rad, distance=far)
            .transform_to(frame)
            .cartesian.xyz.value.T
        )
        seen = moving_sky(utc).stars_seen(vectors, parallax_mas)
        off_arcsec.append(apart_arcsec(seen, unit(theirs)).max())
    holds("near-star-places", 1000 * np.max(off_arcsec))


def test_from_a_low_orbit_bodies_are_where_skyfield_has_them_and_the_moon_by_a_degree_elsewhere(
    theirs,
):
    satellite = EarthSatellite(
        *STATION_TLE.splitlines()[1:], STATION_TLE.splitlines()[0], theirs[0]
    )
    utcs = [utc_ns(STATION_UTC) + minute * 60 * 10**9 for minute in range(0, 93, 7)]
    ours = np.array([seen_at(utc, orbit=TleOrbit(STATION_TLE, "station.tle")) for utc in utcs])
    assert apart_arcsec(ours, in_skyfield(theirs, utcs, satellite)).max() < ORBIT_LIMIT_ARCSEC
    parallax_deg = [
        apart_arcsec(seen[1], seen_at(utc)[1]) / 3600 for seen, utc in zip(ours, utcs, strict=True)
    ]
    # 6720 km at right angles to the way to the Moon, 369 000 km that day, is 1.04 deg
    assert 1.0 < max(parallax_deg) < 1.05


# Semidiameters at 1 au, arcsec (Astronomical Almanac, section E; the Sun's section C), and
# flattenings (NASA's planetary fact sheets).
SEMIDIAMETERS_ARCSEC = {
    "Sun": 959.23,
    "Mercury": 3.36,
    "Venus": 8.34,
    "Mars": 4.68,
    "Jupiter": 98.57,
    "Saturn": 83.10,
    "Uranus": 35.24,
    "Neptune": 34.14,
}
FLATTENINGS = {"Jupiter": 0.06487, "Saturn": 0.09796, "Uranus": 0.02293, "Neptune": 0.01708}


@pytest.mark.parametrize("name", SEMIDIAMETERS_ARCSEC)
def test_bodies_have_the_almanac_s_sizes_and_the_fact_sheets_flattening(name):
    radius_km = RADII_KM[name]
    assert radius_km / KM_PER_AU / ARCSEC == pytest.approx(SEMIDIAMETERS_ARCSEC[name], abs=0.006)
    polar_km = POLAR_RADII_KM.get(name, radius_km)
    assert 1 - polar_km / radius_km == pytest.approx(FLATTENINGS.get(name, 0.0), abs=1e-5)
