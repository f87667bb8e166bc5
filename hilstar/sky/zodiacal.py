"""Zodiacal light by direction from the Sun (Leinert et al. 1998, A&AS 127, 1): table 17's
brightness, table 19's spectrum.

Table 17 is for 500 nm, seen from the Earth's orbit, and symmetric in longitude and latitude.
Between its directions the logarithm is bilinear. With every second direction left out it finds them
within 4.0 % (rms) and 9 % (95 %), so that between all of them it is off by about a quarter of that;
the light itself changes by some 10 % over the year, which no table has. The spectrum is sunlight
times the ratio of table 19 to it, straight in logarithms between the tabled wavelengths. It is that
of 90 degrees from the Sun, and redder nearer to it by the paper's equation 22.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.sky.electrons import SUN_TEMPERATURE_K, Optics, electron_response
from hilstar.sky.spectrum import DATA_DIR, blackbody_exitance_w_m2_m, read_curve_csv

BRIGHTNESS, SPECTRUM = (DATA_DIR / f"leinert1998_table{number}.csv" for number in (17, 19))
TABLE_NM = 500.0
W_M2_SR_M = 1e-8 * 1e6  # table 17's unit, 1e-8 W m-2 sr-1 um-1
# Equation 22: 1 + slope log10(wavelength / 500 nm) over sunlight at 30 and 90 degrees from the Sun:
# below 500 nm, and above.
NEAR_DEG, FAR_DEG = 30.0, 90.0
NEAR_SLOPES, FAR_SLOPES = (1.2, 0.8), (0.9, 0.6)
J2000_JD = 2_451_545.0
ROUNDING = 1e-9  # of corners' shares: a blank corner with less has no part in a direction


class Sunward(NamedTuple):
    """Directions about the Sun, degrees (n,): ecliptic longitude from it, and ecliptic latitude,
    neither with a sign.
    """

    dlon_deg: FloatArray
    lat_deg: FloatArray

    @property
    def elongation_deg(self) -> FloatArray:
        """Angles from the Sun (n,)."""
        dlon = np.radians(self.dlon_deg)
        lat = np.radians(self.lat_deg)
        cosine = np.cos(dlon) * np.cos(lat)
        return np.asarray(np.degrees(np.arccos(cosine)))


def sunward(vectors_icrs: FloatArray, tdb_jd: float) -> Sunward:
    """Where unit vectors (n, 3), ICRS, are from the Sun as the Earth sees it, by the ecliptic of
    J2000.
    """
    import erfa

    to_ecliptic = erfa.ecm06(J2000_JD, 0.0)
    # arcsec in 1900 to 2100; it does not warn of other years
    earth = erfa.ufunc.epv00(tdb_jd, 0.0)[0]
    sun_x, sun_y, _ = -to_ecliptic @ earth["p"]
    x, y, z = to_ecliptic @ vectors_icrs.T
    beside_sun = y * sun_x - x * sun_y
    towards_sun = x * sun_x + y * sun_y
    dlon = np.abs(np.arctan2(beside_sun, towards_sun))
    lat = np.arcsin(np.clip(np.abs(z), 0.0, 1.0))
    return Sunward(np.degrees(dlon), np.degrees(lat))


class TabledLight(NamedTuple):
    """Radiance at 500 nm (n,), 1e-8 W m-2 sr-1 um-1, and whether it is tabled; where not, it is
    the nearest tabled.
    """

    radiance: FloatArray
    tabled: BoolArray


def tabled_light(seen: Sunward) -> TabledLight:
    """Table 17 in directions (n,)."""
    dlon_deg, lat_deg, log_radiance, blank = _table_17()
    i = _interval_of(dlon_deg, seen.dlon_deg)
    j = _interval_of(lat_deg, seen.lat_deg)
    cell_deg = dlon_deg[i + 1] - dlon_deg[i]
    cell_lat_deg = lat_deg[j + 1] - lat_deg[j]
    u = (seen.dlon_deg - dlon_deg[i]) / cell_deg
    v = (seen.lat_deg - lat_deg[j]) / cell_lat_deg
    corners = (
        (i, j, (1 - u) * (1 - v)),
        (i + 1, j, u * (1 - v)),
        (i, j + 1, (1 - u) * v),
        (i + 1, j + 1, u * v),
    )
    value = np.zeros_like(u)
    missing = np.zeros_like(u)
    for row, column, share in corners:
        value += share * log_radiance[row, column]
        missing += share * blank[row, column]
    return TabledLight(np.exp(value), missing < ROUNDING)


def _interval_of(axis: FloatArray, places: FloatArray) -> IntArray:
    """The interval of an axis in which each place lies; beyond the axis its first or last one."""
    interval = np.searchsorted(axis, places, side="right") - 1
    return np.clip(interval, 0, len(axis) - 2)


@cache
def _table_17() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Longitudes, latitudes, the logarithm with blanks filled from the nearest direction, and 1
    where there was a blank.
    """
    lines = BRIGHTNESS.read_text().splitlines()
    names = lines[1].split(",")[1:]  # such as lat_15_deg
    latitudes = []
    for name in names:
        _, degrees, _ = name.split("_")
        latitudes.append(float(degrees))
    lat_deg = np.array(latitudes)
    rows = np.genfromtxt(lines[2:], delimiter=",")  # an empty cell is NaN
    dlon_deg = rows[:, 0]
    log_radiance = np.log(rows[:, 1:])
    blank = np.isnan(log_radiance)
    lon, lat = np.radians(np.broadcast_arrays(dlon_deg[:, None], lat_deg))
    x = np.cos(lon) * np.cos(lat)
    y = np.sin(lon) * np.cos(lat)
    vectors = np.stack([x, y, np.sin(lat)], axis=-1)
    nearest = np.argmax(vectors[blank] @ vectors[~blank].T, axis=1)
    log_radiance[blank] = log_radiance[~blank][nearest]
    return dlon_deg, lat_deg, log_radiance, blank.astype(np.float64)


def relative_spectrum(
    wavelength_nm: FloatArray, slopes: tuple[float, float] = FAR_SLOPES
) -> FloatArray:
    """Zodiacal light over its value at 500 nm, per wavelength: table 19's, or with the other
    `slopes` of equation 22.
    """
    table = read_curve_csv(SPECTRUM)
    nodes = table.wavelength_nm
    sun_k = np.array(SUN_TEMPERATURE_K)
    over_sun = np.log(table.value / blackbody_exitance_w_m2_m(nodes, sun_k))
    log_over_sun = np.interp(np.log(wavelength_nm), np.log(nodes), over_sun)
    exitance = blackbody_exitance_w_m2_m(wavelength_nm, sun_k) * np.exp(log_over_sun)
    # Equation 22 with these slopes over that of 90 degrees.
    redder = _reddening(wavelength_nm, slopes)
    far = _reddening(wavelength_nm, FAR_SLOPES)
    at_table_nm = table(np.array([TABLE_NM]))
    return np.asarray(exitance / at_table_nm * (redder / far))


def _reddening(wavelength_nm: FloatArray, slopes: tuple[float, float]) -> FloatArray:
    """Zodiacal light over sunlight relative to TABLE_NM, by Leinert's equation 22."""
    decades = np.log10(wavelength_nm / TABLE_NM)
    return 1 + np.where(decades < 0, *slopes) * decades


@dataclass(frozen=True, slots=True)
class ZodiacalLight:
    """Zodiacal light through a tracker's optics: electrons/s/sr for a unit of table 17, 30 and
    90 degrees from the Sun.
    """

    near_e_per_s_sr: float
    far_e_per_s_sr: float

    @classmethod
    def through(cls, optics: Optics) -> "ZodiacalLight":
        """The light that a tracker detects (thesis eq. 4.9 to 4.11, for another spectrum)."""
        wavelength_nm, response = electron_response(optics)
        rates = []
        for slopes in (NEAR_SLOPES, FAR_SLOPES):
            detected = relative_spectrum(wavelength_nm, slopes) @ response
            rates.append(float(optics.area_m2 * W_M2_SR_M * detected))
        near_e_per_s_sr, far_e_per_s_sr = rates
        return cls(near_e_per_s_sr, far_e_per_s_sr)

    def electrons_per_s_sr(self, seen: Sunward, light: TabledLight) -> FloatArray:
        """Electron rates per steradian of sky (n,); the colour is linear in the elongation
        between 30 and 90 degrees.
        """
        from_near_deg = seen.elongation_deg - NEAR_DEG
        far = np.clip(from_near_deg / (FAR_DEG - NEAR_DEG), 0.0, 1.0)
        more_e_per_s_sr = far * (self.far_e_per_s_sr - self.near_e_per_s_sr)
        return light.radiance * (self.near_e_per_s_sr + more_e_per_s_sr)
