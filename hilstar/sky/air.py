"""The air over a place on the Earth: it bends light, dims it, glows, and makes stars twinkle.

Refraction is that of `stars.AirAbove`. The air mass is Kasten and Young's (1989, Appl. Opt. 28,
4735). Extinction is that of each star's own spectrum, tabulated at AIR_MASSES and straight between
them. The glow of the sky goes with the zenith distance by van Rhijn's layer and with extinction
(Krisciunas and Schaefer 1991, PASP 103, 1033, eq. 2 and 3). Stars twinkle by Young's law (1967, AJ
72, 747).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.units import NS_PER_S, flux_ratio
from hilstar.sky.electrons import Optics, Photometry, electron_response, reference_mean_w_m2_m
from hilstar.sky.spectrum import DATA_DIR, Curve, integration_nodes, load_curve
from hilstar.sky.stars import AirAbove, Stars, tell

# at which rates are tabulated; magnitudes are linear between them
AIR_MASSES = np.array([0.0, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 15.0, 40.0])
EXTINCTION, NIGHT_SKY = DATA_DIR / "extinction.csv", DATA_DIR / "night_sky.csv"
VAN_RHIJN = 0.96  # an emitting layer at 130 km
STEP_NS = NS_PER_S  # the zenith of a second: 15 arcsec, 0.4 mmag at an air mass of 5
# of the Sun's altitude: above it the sky is brighter than a night's table says
TWILIGHT_DEG = -12.0
TROPOPAUSE_M = 11_000.0  # of the standard atmosphere: from here to 20 km it is as warm everywhere
MAX_TWINKLE = 1.0  # beyond it, near the horizon, the law of weak scintillation ends


def air_mass(altitude_rad: FloatArray) -> FloatArray:
    """Air masses (n,) at apparent altitudes; that of the horizon below it."""
    h = np.maximum(altitude_rad, 0.0)
    # Kasten and Young 1989, of the altitude in degrees
    beyond_sine = 0.50572 * (np.degrees(h) + 6.07995) ** -1.6364
    return np.asarray(1 / (np.sin(h) + beyond_sine))


def scintillation(
    aperture_mm: float, masses: FloatArray, height_m: float, exposure_s: float
) -> FloatArray:
    """One sigma of a star's light relative to its mean, (n,) (Young 1967): 0.09 D^(-2/3) X^1.75
    exp(-h / 8 km) / sqrt(2 t).

    D is in cm. The law is of exposures that are long against the time of a shadow's passage, some
    10 ms; without one it is 1.
    """
    if not exposure_s:
        return np.full_like(masses, MAX_TWINKLE)
    across = (aperture_mm / 10) ** (-2 / 3)
    down = np.exp(-height_m / 8000)
    sigma = 0.09 * across * masses**1.75 * down / np.sqrt(2 * exposure_s)
    return np.asarray(np.minimum(sigma, MAX_TWINKLE))


def standard_pressure_hpa(height_m: float) -> float:
    """The pressure of the International Standard Atmosphere (ISO 2533) at heights up to 20 km, hPa.

    The ellipsoid's height is taken as the standard's geopotential one: 0.3 % of it at 20 km.
    """
    above_tropopause_m = max(height_m - TROPOPAUSE_M, 0.0)
    temperature_ratio = 1 - 2.25577e-5 * (height_m - above_tropopause_m)
    return float(1013.25 * temperature_ratio**5.25588 * math.exp(-above_tropopause_m / 6341.62))


def extinction_curve(name: str) -> Curve | None:
    """The extinction of a built-in place, mag an air mass; None for no such name."""
    header, *rows = [line.split(",") for line in EXTINCTION.read_text().splitlines()[1:]]
    if name not in header[1:]:
        return None
    column = header.index(name)
    wavelength_nm = np.array([float(row[0]) for row in rows])
    extinction_mag = np.array([float(row[column]) for row in rows])
    return Curve(wavelength_nm, extinction_mag)


def extinction_names() -> tuple[str, ...]:
    """The built-in places."""
    header = EXTINCTION.read_text().splitlines()[1]
    return tuple(header.split(",")[1:])


def through_air(optics: Optics, extinction: Curve, masses: float) -> Optics:
    """A tracker's optics behind so many air masses. Beyond a table of extinction its end values
    hold.
    """
    low, high = optics.range_nm
    knots = [c.wavelength_nm for c in (optics.transmission, extinction) if len(c.wavelength_nm)]
    nm = np.unique(np.concatenate([*knots, np.linspace(low, high, 161)]))
    nm = nm[(nm >= low) & (nm <= high)]
    if not len(extinction.wavelength_nm):
        mag = np.full(len(nm), extinction.value[0])
    else:
        mag = np.interp(nm, extinction.wavelength_nm, extinction.value)
    through = optics.transmission(nm) * 10 ** (-0.4 * mag * masses)
    return replace(optics, transmission=Curve(nm, through))


def dimmed_mag(
    rates: Callable[[Optics], FloatArray], optics: Optics, extinction: Curve
) -> FloatArray:
    """How much fainter spectra are behind AIR_MASSES, mag (masses, n); `rates` gives their
    electrons (n,) through optics.
    """
    by_masses = []
    for masses in AIR_MASSES.tolist():
        by_masses.append(rates(through_air(optics, extinction, masses)))
    detected = np.maximum(np.stack(by_masses), 1e-300)
    return np.asarray(-2.5 * np.log10(detected / detected[0]))


def glow_e_per_s_arcsec2(
    spectrum: Curve, v_mag_arcsec2: float, optics: Optics, photometry: Photometry
) -> float:
    """Electrons per second and square arcsecond of a night sky of this V surface brightness, with
    the shape of a spectrum.
    """
    passband = load_curve("johnson-v", "johnson-v")
    nm, weight_m = integration_nodes(passband, spectrum)
    response = passband(nm) * weight_m
    if photometry.weighting == "photon":
        response = response * nm
    mean = float(spectrum(nm) @ response / response.sum())
    transmission = with_knots(optics.transmission, spectrum, optics.range_nm)
    nm, response = electron_response(replace(optics, transmission=transmission))
    share = float(spectrum(nm) @ response) / mean * reference_mean_w_m2_m(photometry)
    return float(flux_ratio(v_mag_arcsec2)) * optics.area_m2 * share


def with_knots(curve: Curve, other: Curve, range_nm: tuple[float, float]) -> Curve:
    """A curve with the knots of another within a range added, so that the product of both is
    integrated exactly.
    """
    low, high = range_nm
    nm = np.unique(np.concatenate([curve.wavelength_nm, other.wavelength_nm, range_nm]))
    nm = nm[(nm >= low) & (nm <= high)]
    return Curve(nm, curve(nm))


@dataclass(frozen=True, slots=True, eq=False)
class SiteAir:
    """The air over a place: the zenith (`up_at` a UTC, ns), the constants of refraction, rad, and
    how it dims stars, glows and makes them twinkle.

    `dimming_mag` (channels, masses, n + 1) is that of each star of the catalogue by row, and last
    of sunlight. `glow_e_per_s_sr` (channels,) is the glow at the zenith, `v_extinction_mag` the
    extinction of V for an air mass.
    """

    up_at: Callable[[int], FloatArray]
    refraction_rad: tuple[float, float]
    height_m: float
    aperture_mm: float
    dimming_mag: FloatArray
    v_extinction_mag: float = 0.0
    glow_e_per_s_sr: FloatArray = field(default_factory=lambda: np.zeros(1))
    told: set[str] = field(default_factory=set)

    def above(self, utc_ns: int) -> AirAbove:
        """The air at a UTC."""
        return _above(self, utc_ns // STEP_NS)

    def over(self, stars: Stars, utc_ns: int) -> Stars:
        """Stars and bodies as they are seen from here: bent, dimmed, and only above the horizon."""
        air = self.above(utc_ns)
        share = self.shares(stars.row, air.altitude_rad(stars.vectors))
        if stars.colours is None or len(share) == 1:
            return replace(stars, air=air, electrons_per_s=stars.electrons_per_s * share[0])
        channel_shares = stars.colours * share.T
        total = np.maximum(channel_shares.sum(axis=1), 1e-300)
        return replace(
            stars,
            air=air,
            electrons_per_s=stars.electrons_per_s * total,
            colours=channel_shares / total[:, None],
        )

    def shares(self, row: IntArray, altitude_rad: FloatArray) -> FloatArray:
        """What comes through (channels, n) of stars by row of the catalogue, -1 for sunlight, at
        apparent altitudes (n,).
        """
        masses = air_mass(np.nan_to_num(altitude_rad))
        interval = np.searchsorted(AIR_MASSES, masses, side="right") - 1
        k = np.clip(interval, 0, len(AIR_MASSES) - 2)
        part = (masses - AIR_MASSES[k]) / (AIR_MASSES[k + 1] - AIR_MASSES[k])
        below_mag = self.dimming_mag[:, k, row]
        above_mag = self.dimming_mag[:, k + 1, row]
        mag = below_mag * (1 - part) + above_mag * part
        return np.asarray(flux_ratio(mag))

    def twinkling(
        self, stars: Stars, utc_ns: int, exposure_s: float, rng: "np.random.Generator"
    ) -> Stars:
        """Stars as they twinkle in an exposure, each by itself about its mean; bodies do not."""
        altitude_rad = self.above(utc_ns).altitude_rad(stars.vectors)
        masses = air_mass(altitude_rad)
        sigma = scintillation(self.aperture_mm, masses, self.height_m, exposure_s)
        width = np.sqrt(np.log1p(sigma**2))
        factor = np.exp(width * rng.standard_normal(len(stars)) - width**2 / 2)
        factor[len(stars) - len(stars.bodies) :] = 1.0
        return replace(stars, electrons_per_s=stars.electrons_per_s * factor)

    def glow_at(self, directions: FloatArray, utc_ns: int) -> FloatArray:
        """The sky's glow (channels, n) in apparent directions (n, 3), electrons per second and
        steradian; none below ground.
        """
        sine = directions @ self.above(utc_ns).up
        masses = 1 / np.sqrt(1 - VAN_RHIJN * (1 - sine**2))
        # relative to the zenith, whose light is dimmed by one air mass
        dimming = flux_ratio(self.v_extinction_mag * (masses - 1))
        relative = masses * dimming * (sine > 0)
        return np.asarray(self.glow_e_per_s_sr[:, None] * relative)

    def check_sun(self, sun: FloatArray, utc_ns: int) -> None:
        """Warn, once, of a Sun above -12 degrees in a direction (3,)."""
        sine = self.above(utc_ns).up @ sun / np.linalg.norm(sun)
        altitude_deg = float(np.degrees(np.arcsin(sine)))
        if altitude_deg > TWILIGHT_DEG:
            tell(
                self.told,
                "sun",
                "[site]: the Sun stands at %.1f degrees there and then; above -12 the sky is"
                " brighter than [site] says",
                altitude_deg,
            )


@lru_cache(maxsize=16)
def _above(air: SiteAir, second: int) -> AirAbove:
    """The air of a second, kept: a frame asks for the same several times."""
    return AirAbove(air.up_at(second * STEP_NS), air.refraction_rad, air.told)
