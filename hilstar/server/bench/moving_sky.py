"""The moving part of a bench's sky, from its file: bodies, satellites, the observer, and bodies
wider than a point.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.basics.reading import named_text
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.optics.camera import Camera
from hilstar.optics.layers.view import POINT_PX
from hilstar.server.bench.config import GEOCENTRE, SOURCE, BenchConfig
from hilstar.server.bench.config.bench_config import DAY_NS, UNIX, epoch_utc_ns, from_source, jyear
from hilstar.server.bench.config.sky import Bodies, SkySettings
from hilstar.server.bench.site import Ground
from hilstar.sky.bodies.kernel import Kernel
from hilstar.sky.bodies.light import bodies_bv_mag, bodies_electrons_per_s
from hilstar.sky.bodies.moving import PLANETS, YEAR_NS, BodyLight, MovingSky
from hilstar.sky.bodies.oem import VERSION_KEY, OemOrbit
from hilstar.sky.bodies.orbit import TLE_ADVICE, Geocentre, Orbit, TleOrbit
from hilstar.sky.bodies.shapes import EARTH
from hilstar.sky.electrons import Optics, Photometry
from hilstar.sky.stars import total_and_colours

if TYPE_CHECKING:
    from hilstar.sky.bodies.passes import Satellites

log = logging.getLogger(__name__)

MAX_ORBIT_BYTES = 20_000_000  # states for each minute of a year
# 120 000 sets: several times as many as there are in orbit
MAX_LIST_BYTES, MAX_TABLE_BYTES = 20_000_000, 5_000_000
MAX_TLE_AGE_DAYS = 7.0
# wider bodies are given in degrees, and without a count of pixels
MAX_ARCSEC, MANY_PX = 7200.0, 1000.0


def moving_sky(config: BenchConfig, folder: Path, channels: Sequence[Optics]) -> MovingSky:
    """The bodies and satellites of a bench file that has a date, and its observer.

    Raises InputError for an orbit, a list or a date that cannot be used, MachineError where the
    extra is not installed.
    """
    utc_ns = epoch_utc_ns(config)
    if utc_ns is None:
        raise AssertionError("a file with an observer has a date")
    # A source's own dates count from 1970, and its stars are those of its day.
    start_ns = round((config.sky.epoch_jyear - jyear(utc_ns)) * YEAR_NS)
    unix = config.sky.epoch_utc == UNIX
    if unix:
        start_ns = round(start_ns / DAY_NS) * DAY_NS  # a Julian year is right to a millisecond
    orbit = config.spacecraft.orbit or GEOCENTRE
    observer: Orbit = Geocentre()
    if config.site is not None:
        observer = Ground(config.site)
    elif orbit not in {GEOCENTRE, SOURCE}:
        observer = orbit_file(folder / orbit, utc_ns + start_ns, start_ns != 0)
    bodies, v0_e_per_s = _body_light(config.sky, channels)
    moving = MovingSky(Kernel(), observer, utc_ns, bodies, start_ns, unix)
    if config.sky.bodies.satellites is not None:
        moving.satellites = _satellites(
            config.sky.bodies, folder, observer, (utc_ns, start_ns), v0_e_per_s
        )
    return moving


def _body_light(sky: SkySettings, channels: Sequence[Optics]) -> tuple[BodyLight, float]:
    """The light of the bodies that a bench file shows, and the electrons per second of V = 0 in the
    Sun's colour, which is that of whatever sunlight falls on.
    """
    shown = sky.bodies
    asked = (
        ("Sun", shown.sun),
        (EARTH, shown.earth),
        ("Moon", shown.moon),
        *((planet, shown.planets) for planet in PLANETS),
    )
    names = tuple(name for name, wanted in asked if wanted)
    photometry = Photometry(sky.zero_point, sky.passband_weighting)
    lit = (*names, "Sun")
    rates_by_channel = []
    for optics in channels:
        rates_by_channel.append(bodies_electrons_per_s(lit, sky.brightness, optics, photometry))
    rates, colours = total_and_colours(np.stack(rates_by_channel, axis=1))
    shares = (None, None) if colours is None else (colours[:-1], colours[-1])
    bodies = BodyLight(names, bodies_bv_mag(names), rates[:-1], *shares)
    return bodies, float(rates[-1])


def _satellites(
    shown: Bodies, folder: Path, observer: Orbit, dates_ns: tuple[int, int], v0_e_per_s: float
) -> "Satellites":
    """The satellites of a bench file's list, placed where they are at the start. Raises InputError
    for a list or a table that cannot be used, MachineError where the extra is not installed.

    `dates_ns` are the bench's UTC and how much later the start is.
    """
    from hilstar.sky.bodies.passes import Satellites
    from hilstar.sky.bodies.satellites import (
        LIST_FORM,
        TABLE_FORM,
        brightness_of,
        read_satellites,
        read_table,
    )

    assert shown.satellites is not None
    path = folder / shown.satellites
    utc_ns, later_ns = dates_ns
    start_utc_ns = utc_ns + later_ns
    listed = read_satellites(named_text(path, LIST_FORM, MAX_LIST_BYTES), str(path), start_utc_ns)
    rows = {}
    if shown.satellite_magnitudes is not None:
        table = folder / shown.satellite_magnitudes
        rows = read_table(named_text(table, TABLE_FORM, MAX_TABLE_BYTES), str(table))
    brightness = brightness_of(listed, rows, shown.satellite_standard_mag, v0_e_per_s)
    satellites = Satellites(listed, brightness, v0_e_per_s, observer, utc_ns)
    satellites.listed = sum(satellite.number in rows for satellite in listed)
    satellites.file = str(path)
    satellites.place(start_utc_ns)
    return satellites


def orbit_file(path: Path, utc_ns: int, day: bool) -> Orbit:
    """The orbit in a file, which is an OEM that covers that UTC, or elements: with a warning where
    they are of another week.

    The UTC may be the beginning of the `day` of what is shown.

    Raises InputError, and MachineError without SGP4 for elements.
    """
    text = named_text(path, f"{TLE_ADVICE}, or a CCSDS OEM", MAX_ORBIT_BYTES)
    if text.lstrip().startswith(VERSION_KEY):
        return OemOrbit(text, str(path), utc_ns, day)
    orbit = TleOrbit(text, str(path))
    age_days = orbit.age_days(utc_ns)
    if abs(age_days) > MAX_TLE_AGE_DAYS:
        # Vallado et al. 2006: SGP4 is 1 to 3 km off a day in a low orbit, the Moon 0.5 to 1.6
        # arcsec a day.
        log.warning(
            "%s: its elements are %.0f days from [sky] epoch_utc; a low orbit is then off by %.0f"
            " km or more",
            path,
            abs(age_days),
            abs(age_days),
        )
    return orbit


def observer_lines(config: BenchConfig) -> list[str]:
    """A line where it is the source of the attitudes that says from where the sky is seen."""
    if not from_source(config):
        return []
    where = "the sky is seen from the Earth's centre, without the Earth"
    return [
        f'[spacecraft] orbit = "{SOURCE}": until a message has said where the spacecraft is,'
        f" {where}"
    ]


def wide_bodies(moving: MovingSky | None, camera: Camera, t_ns: int | None = None) -> list[str]:
    """One line for each body whose disc is wider than POINT_PX of a camera's pixels, the widest
    first.
    """
    if moving is None:
        diameters_arcsec = {}
    else:
        diameters_arcsec = moving.diameters_arcsec(t_ns)
    px_per_arcsec = camera.scales_px_rad()[1] / ARCSEC_PER_RAD
    widths = sorted(
        ((d * px_per_arcsec, name, d) for name, d in diameters_arcsec.items()), reverse=True
    )
    lines = []
    for px, name, arcsec in widths:
        if px > POINT_PX:
            if arcsec < MAX_ARCSEC:
                angle = f"{arcsec:.1f} arcsec"
            else:
                angle = f"{arcsec / 3600:.1f} deg"
            if px < MANY_PX:
                pixels = f"{px:.2f} px"
            else:
                pixels = f"more than {MANY_PX:.0f} px"
            lines.append(f"{name}: {angle} wide, {pixels} of the screen; drawn as a disc")
    return lines


def satellite_lines(sky: MovingSky | None, t_ns: int | None) -> list[str]:
    """One line about a bench's satellites at a moment; none without satellites."""
    if sky is None or sky.satellites is None:
        return []
    placed = sky.satellites_placed(t_ns)
    known = sky.satellites.listed
    every = len(sky.satellites)
    return [
        f"satellites: {placed} of {every} have a place by their elements; {known} are in"
        " [sky.bodies] satellite_magnitudes"
    ]
