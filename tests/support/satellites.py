"""Element sets that tests write, and skies with them."""

from __future__ import annotations

import numpy as np

from hilstar.sky.bodies.moving import MovingSky
from hilstar.sky.bodies.orbit import Orbit, TleOrbit
from hilstar.sky.bodies.passes import Cone, Pass, Satellites
from hilstar.sky.bodies.satellites import brightness_of, read_satellites, read_table
from tests.support.skies import STATION_TLE, STATION_UTC, moving_sky, utc_ns

EPOCH = "08264.51782528"  # the station's
V0_E_PER_S = 1e7
DEFAULT_MAG = 6.0
NORTH = np.array([0.0, 0.0, 1.0])


def with_checksum(line: str) -> str:
    """A line's 68 characters and the digit that they add up to."""
    return f"{line}{sum(int(c) if c.isdigit() else c == '-' for c in line) % 10}"


def element_set(
    number: int,
    angles_deg: tuple[float, float, float, float],
    eccentricity: float,
    turns_a_day: float,
) -> str:
    """Two lines by inclination, right ascension of the node, argument of perigee, mean anomaly;
    the station's date.
    """
    inclination, node, perigee, anomaly = angles_deg
    first = f"1 {number:05d}U 98067A   {EPOCH} -.00002182  00000-0 -11606-4 0  292"
    second = (
        f"2 {number:05d} {inclination:8.4f} {node:8.4f} {round(eccentricity * 1e7):07d}"
        f" {perigee:8.4f} {anomaly:8.4f} {turns_a_day:11.8f}56353"
    )
    return f"{with_checksum(first)}\n{with_checksum(second)}\n"


def some_orbits(rng: np.random.Generator, count: int) -> str:
    """A list of satellites in low, middle, eccentric (12 h) and geostationary orbits, by turns,
    called S0, S1 and so on.
    """
    kinds = ((15.4, 0.001), (14.2, 0.002), (2.0056, 0.01), (2.0056, 0.7), (1.0027, 0.0003))
    sets = []
    for k in range(count):
        turns, eccentricity = kinds[k % len(kinds)]
        angles = (rng.uniform(0, 100), *rng.uniform(0, 360, size=3))
        sets.append(f"S{k}\n" + element_set(10_000 + k, angles, eccentricity, turns))
    return "".join(sets)


def satellite_sky(
    text: str, orbit: Orbit | None = None, table: str = "norad\n", utc: str = STATION_UTC
) -> MovingSky:
    """A sky with a list of satellites alone, by default seen from the station; V = 0 is
    V0_E_PER_S.
    """
    orbit = orbit or TleOrbit(STATION_TLE, "station.tle")
    start = utc_ns(utc)
    found = read_satellites(text, "tles.txt", start)
    brightness = brightness_of(found, read_table(table, "table.csv"), DEFAULT_MAG, V0_E_PER_S)
    sky = moving_sky(utc, (), orbit=orbit)
    sky.satellites = Satellites(found, brightness, V0_E_PER_S, orbit, start)
    return sky


def looking_at(direction: np.ndarray) -> np.ndarray:
    """The quaternion of a camera with its axis there."""
    half = np.array([0.0, 0.0, 1.0]) + direction
    half /= np.linalg.norm(half)
    # Half a turn about the middle of both takes one to the other.
    return np.array([0.0, *half])


def lit_moment(text: str, table: str = "norad\n") -> tuple[MovingSky, int]:
    """A sky, and a moment at which its satellite is lit and within 2000 km."""
    sky = satellite_sky(text, table=table)
    for seconds in range(0, 86_400, 20):
        seen = sky.passing(Cone(NORTH, np.pi, 0.0), seconds * 10**9)
        if seen is not None and np.linalg.norm(seen.seen_km[0, 0]) < 2000 and rate_now(seen) > 0:
            return sky, seconds * 10**9
    raise AssertionError("it never is")


def rate_now(seen: Pass) -> float:
    """The electron rate of a pass's first satellite at its moment."""
    zero = np.zeros(1)
    return float(seen.rates_e_per_s(np.array([0]), zero, zero)[0])
