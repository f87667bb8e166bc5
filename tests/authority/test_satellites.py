"""Satellites against Skyfield: where they are seen, and when the Earth's shadow takes their
light.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.optimize import brentq
from skyfield.api import EarthSatellite
from skyfield.jpllib import SpiceKernel
from skyfield.timelib import Time, Timescale

from hilstar.sky.bodies.orbit import Geocentre, TleOrbit
from hilstar.sky.bodies.passes import Cone
from hilstar.sky.bodies.satellites import sunlit_share
from hilstar.sky.stars import aberrate
from tests.support.claims import holds
from tests.support.satellites import element_set, satellite_sky, some_orbits
from tests.support.skies import STATION_TLE, STATION_UTC, moving_sky, skyfield, utc_ns

ARCSEC = np.pi / (180 * 3600)
DAY_NS = 86_400 * 10**9
NORTH = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def theirs() -> Iterator[tuple[Timescale, SpiceKernel]]:
    with skyfield() as both:
        yield both


def date(scale: Timescale, utc: int) -> Time:
    days, rest_ns = divmod(utc, DAY_NS)
    return scale.utc(1970, 1, 1 + days, 0, 0, rest_ns / 1e9)


def in_skyfield(text: str, scale: Timescale) -> list[EarthSatellite]:
    lines = text.splitlines()
    return [
        EarthSatellite(lines[k + 1], lines[k + 2], lines[k], scale) for k in range(0, len(lines), 3)
    ]


@pytest.mark.parametrize("observer", ["station", "geocentre"])
def test_places_of_a_week_agree_with_skyfield(observer, rng, theirs):
    scale, kernel = theirs
    text = some_orbits(rng, 15)
    orbit = Geocentre() if observer == "geocentre" else TleOrbit(STATION_TLE, "station.tle")
    sky, start = satellite_sky(text, orbit), utc_ns(STATION_UTC)
    satellites, station = in_skyfield(text, scale), in_skyfield(STATION_TLE, scale)[0]
    seen_by = kernel["earth"] + station if observer == "station" else kernel["earth"]
    off_arcsec = []
    for t_ns in rng.integers(-3 * DAY_NS, 4 * DAY_NS, size=8).tolist():
        seen = sky.passing(Cone(NORTH, np.pi, 0.0), t_ns)
        now = seen_by.at(date(scale, start + t_ns))
        change = sky.sight(t_ns).view.velocity_km_s - sky.sight(0).view.velocity_km_s
        ours = aberrate(seen.directions(slice(None), np.zeros(len(seen))), change)
        assert len(seen) >= 1
        for place, direction in zip(seen.index, ours, strict=True):
            apparent = now.observe(kernel["earth"] + satellites[place]).apparent().xyz.km
            off = np.linalg.norm(apparent / np.linalg.norm(apparent) - direction)
            off_arcsec.append(off / ARCSEC)
    # The axes of an hour (0.006), the Earth's bending of light (Skyfield's), and 20 s of a cubic.
    # 0.01 arcsec is 5 m at 100 km.
    holds("satellite-places", np.max(off_arcsec))


# Skyfield's shadow is that of a sphere for the Sun's centre; half of the light is gone there within
# the bend of the limb. A change is looked for within this of a second of Skyfield's.
SHADOW_WITHIN_S = 2.0


def test_the_shadow_of_a_sphere_begins_and_ends_when_skyfield_says(theirs, monkeypatch):
    """Each change of a low orbit in five turns, at half of the sunlight. Rays say what the
    flattening does (unit tests).
    """
    monkeypatch.setattr("hilstar.sky.bodies.satellites.EARTH_FLATTENING", 0.0)
    scale, kernel = theirs
    text = element_set(7, (51.6416, 247.4627, 130.5360, 325.0288), 0.0006703, 15.5)
    start, low = utc_ns(STATION_UTC), in_skyfield(f"LOW\n{text}", scale)[0]
    # neither light nor shadow lasts less than half an hour
    seconds = np.arange(0.0, 28_000.0, 20.0)
    sunlit = low.at(scale.tt_jd(date(scale, start).tt + seconds / 86_400)).is_sunlit(kernel)
    changes = np.flatnonzero(np.diff(sunlit.astype(int)))
    assert len(changes) >= 9
    orbit, sky, off_s = TleOrbit(text, "low.tle"), moving_sky(start, ()), []
    for k in changes.tolist():
        sun_km = -sky.sight(round(seconds[k] * 1e9)).view.from_sun_km

        def share(second: float, sun_km: np.ndarray = sun_km) -> float:
            return float(sunlit_share(orbit.state(start + round(second * 1e9))[0][None], sun_km)[0])

        def is_lit(second: float) -> float:
            when = scale.tt_jd(date(scale, start).tt + second / 86_400)
            return float(low.at(when).is_sunlit(kernel)) - 0.5

        ours_s = brentq(
            lambda second: share(second) - 0.5,
            seconds[k] - SHADOW_WITHIN_S,
            seconds[k + 1] + SHADOW_WITHIN_S,
        )
        theirs_s = brentq(is_lit, seconds[k], seconds[k + 1], xtol=1e-3)
        off_s.append(abs(ours_s - theirs_s))
        assert (share(ours_s + SHADOW_WITHIN_S) > 0.5) == bool(sunlit[k + 1])
    holds("shadow-time", max(off_s))
