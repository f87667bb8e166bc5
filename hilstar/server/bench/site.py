"""The air over the place of `[site]`, and that place as an observer of bodies."""

from functools import lru_cache
from pathlib import Path

import erfa
import numpy as np

from hilstar.attitude.logs.earth import EARTH_RATE_RAD_S, q_icrs_to_itrs
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, did_you_mean
from hilstar.basics.reading import exists
from hilstar.basics.rotation import conjugate, rotate
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.server.bench.config import BenchConfig
from hilstar.server.bench.config.sky import SiteSettings
from hilstar.sky.air import (
    NIGHT_SKY,
    extinction_curve,
    extinction_names,
    glow_e_per_s_arcsec2,
    standard_pressure_hpa,
)
from hilstar.sky.electrons import Optics, Photometry, electron_response
from hilstar.sky.spectrum import Curve, constant_curve, read_curve_csv

MAX_EXTINCTION = 10.0


class Ground:
    """A place on the turning Earth, WGS84. UT1 and the pole are those of Astropy's table."""

    # The Moon's parallax moves with 0.46 km/s: 1e-8 rad/s^2, 0.1 mas in the middle of it.
    step_s = 10.0

    def __init__(self, site: SiteSettings) -> None:
        self.longitude, self.latitude = np.radians((site.longitude_deg, site.latitude_deg))
        self._place_km = (
            np.asarray(erfa.gd2gc(1, self.longitude, self.latitude, site.height_m)) * 1e-3
        )
        flat = np.cos(self.latitude)
        self._up = np.array(
            [flat * np.cos(self.longitude), flat * np.sin(self.longitude), np.sin(self.latitude)]
        )

    def state(self, utc_ns: int) -> tuple[FloatArray, FloatArray]:
        """Place and velocity about the Earth's centre, ICRS axes."""
        x, y, z = self._place_km
        turned = EARTH_RATE_RAD_S * np.array([-y, x, 0.0])
        place, velocity = rotate(_itrs_to_icrs(utc_ns), np.array([[x, y, z], turned]))
        return place, velocity

    def up(self, utc_ns: int) -> FloatArray:
        """The zenith (3,), ICRS: normal to the ellipsoid."""
        return np.asarray(rotate(_itrs_to_icrs(utc_ns), self._up[None])[0])


@lru_cache(maxsize=64)
def _itrs_to_icrs(utc_ns: int) -> FloatArray:
    return np.asarray(conjugate(q_icrs_to_itrs(np.array([utc_ns]))[0]))


def site_extinction(site: SiteSettings, folder: Path) -> Curve:
    """Extinction by wavelength, mag an air mass. Raises InputError."""
    if isinstance(site.extinction, int | float):
        if not 0 <= site.extinction <= MAX_EXTINCTION:
            raise InputError(
                f"[site] extinction = {site.extinction:g}: write magnitudes an air mass, 0 to"
                f" {MAX_EXTINCTION:g}"
            )
        return constant_curve(float(site.extinction))
    curve = extinction_curve(site.extinction)
    if curve is None:
        path = folder / site.extinction
        names = extinction_names()
        if not exists(path):
            near = did_you_mean(site.extinction, names)
            raise InputError(
                f"[site] extinction = {site.extinction!r}: no such place or file {path};"
                f" {near}write one of {', '.join(names)}, a CSV path or a number"
            )
        curve = read_curve_csv(path, MAX_EXTINCTION)
    return curve


def site_refraction(site: SiteSettings, optics: Optics) -> tuple[float, float]:
    """The constants of refraction for the colour in which a tracker sees sunlight."""
    nm, response = electron_response(optics)
    mean_nm = float(nm @ response / response.sum())
    if site.pressure_hpa is None:
        pressure = standard_pressure_hpa(site.height_m)
    else:
        pressure = site.pressure_hpa
    a, b = erfa.refco(pressure, site.temperature_c, site.humidity, mean_nm * 1e-3)
    return float(a), float(b)


def site_glow_e_per_s_sr(config: BenchConfig, folder: Path, optics: Optics) -> float:
    """The sky's glow at the zenith of `[site]`, electrons per second and steradian. Raises
    InputError.
    """
    site = config.site
    if site is None or site.sky_v_mag_arcsec2 is None:
        return 0.0
    if site.sky_spectrum == "paranal":
        source = NIGHT_SKY
    else:
        source = folder / site.sky_spectrum
    photometry = Photometry(config.sky.zero_point, config.sky.passband_weighting)
    rate = glow_e_per_s_arcsec2(
        read_curve_csv(source, 1e30), site.sky_v_mag_arcsec2, optics, photometry
    )
    return rate * ARCSEC_PER_RAD**2
