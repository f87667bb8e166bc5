"""Skies that move, for tests: the real kernel, from the Earth's centre unless an orbit is given."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
from skyfield.api import Loader
from skyfield.jpllib import SpiceKernel
from skyfield.timelib import Timescale

from hilstar.sky.bodies.kernel import Kernel
from hilstar.sky.bodies.moving import PLANETS, BodyLight, MovingSky
from hilstar.sky.bodies.orbit import Geocentre, Orbit

ALL_BODIES = ("Sun", "Moon", *PLANETS)
YEAR_NS = 31_557_600 * 10**9
# From 1950 to 2050: what Skyfield calls each body
SKYFIELD_NAMES = dict(zip(ALL_BODIES, ("sun", "moon", "mercury", "venus"), strict=False)) | {
    name: f"{name.lower()} barycenter" for name in PLANETS[2:]
}
# A satellite at 420 km: the station's elements of 2008-09-20, the example of the TLE format in its
# English Wikipedia article.
STATION_TLE = """\
ISS (ZARYA)
1 25544U 98067A   08264.51782528 -.00002182  00000-0 -11606-4 0  2927
2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391563537
"""
STATION_UTC = "2008-09-20T12:30:00Z"


def moving_sky(
    utc: str | int, names: tuple[str, ...] = ALL_BODIES, orbit: Orbit | None = None
) -> MovingSky:
    """Bodies of 1 electron/s at V = 0, at a UTC (text, or ns since 1970)."""
    ones = np.ones(len(names))
    return MovingSky(_kernel(), orbit or Geocentre(), utc_ns(utc), BodyLight(names, ones, ones))


@cache
def _kernel() -> Kernel:
    return Kernel()


def utc_ns(utc: str | int) -> int:
    """Nanoseconds since 1970 of a UTC."""
    return (
        utc if isinstance(utc, int) else int(np.datetime64(utc.rstrip("Z"), "ns").astype(np.int64))
    )


def random_utcs_ns(rng: np.random.Generator, count: int) -> list[int]:
    """UTCs from 1973, when a second of UTC had become one of TAI, to 2050."""
    return [int(t) for t in rng.integers(3 * YEAR_NS, 80 * YEAR_NS, size=count)]


def kernel_path() -> Path:
    """The ephemeris on this machine."""
    found = importlib.util.find_spec("skyfield_data")
    assert found is not None
    assert found.origin is not None
    return Path(found.origin).parent / "data" / "de421.bsp"


@contextmanager
def skyfield() -> Iterator[tuple[Timescale, SpiceKernel]]:
    """Skyfield's own time scale and the same kernel; nothing is downloaded."""
    load = Loader(kernel_path().parent, verbose=False)
    kernel = load(kernel_path().name)
    try:
        yield load.timescale(builtin=True), kernel
    finally:
        kernel.close()
