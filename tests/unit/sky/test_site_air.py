"""Air over a place, of stated extinction and without refraction: what it does to each channel of a
tracker, and to a body on the horizon.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.sky.air import (
    AIR_MASSES,
    SiteAir,
    air_mass,
    glow_e_per_s_arcsec2,
    standard_pressure_hpa,
    through_air,
    with_knots,
)
from hilstar.sky.bodies.orbit import Geocentre
from hilstar.sky.bodies.passes import Cone
from hilstar.sky.electrons import Optics, Photometry, Weighting
from hilstar.sky.spectrum import Curve, constant_curve, load_curve
from hilstar.sky.stars import AirAbove
from hilstar.sky.synthetic import vega, vega_electrons_per_s
from tests.support.satellites import satellite_sky, some_orbits
from tests.support.skies import moving_sky
from tests.support.stars import stars_at

# Kasten and Young 1989, at 90 and at 30 degrees of altitude
ZENITH_MASSES, LOW_MASSES = 0.99971, 1.99429
WEIGHTINGS: tuple[Weighting, Weighting] = ("energy", "photon")
UTC = "2026-11-21T00:00:00Z"


def plain_air(up: np.ndarray, mag_a_mass: tuple[float, ...], stars: int = 0) -> SiteAir:
    """Air that dims every spectrum by so many magnitudes an air mass, one for each channel."""
    dimming = np.array(mag_a_mass)[:, None, None] * AIR_MASSES[:, None]
    return SiteAir(
        up_at=lambda utc_ns: up,
        refraction_rad=(0.0, 0.0),
        height_m=0.0,
        aperture_mm=30.0,
        dimming_mag=np.broadcast_to(dimming, (len(mag_a_mass), len(AIR_MASSES), stars + 1)),
    )


def test_air_dims_each_channel_of_a_star_by_its_own_extinction():
    """Pogson's law by channel: the blue one loses most, and a low star is redder."""
    up = np.array([0.0, 0.0, 1.0])
    directions = np.array([up, [np.sqrt(0.75), 0.0, 0.5]])
    shares = np.array([[0.2, 0.5, 0.3], [0.1, 0.3, 0.6]])
    mag_a_mass = (0.1, 0.2, 0.4)
    stars = stars_at(directions, np.array([1000.0, 500.0]))
    order = stars.row
    stars = replace(stars, colours=shares[order])
    seen = plain_air(up, mag_a_mass, len(stars)).over(stars, 0)
    masses = np.array([ZENITH_MASSES, LOW_MASSES])[order]
    through = 10 ** (-0.4 * np.outer(masses, mag_a_mass))
    wanted = np.array([1000.0, 500.0])[order, None] * shares[order] * through
    found = seen.electrons_per_s[:, None] * seen.colours
    np.testing.assert_allclose(found, wanted, rtol=1e-5)  # the air masses' five digits
    np.testing.assert_allclose(seen.colours.sum(axis=1), 1.0)


def test_below_the_horizon_air_is_that_of_the_horizon():
    """Kasten and Young 1989: 1 / (0.50572 * 6.07995^-1.6364), 37.92."""
    low = np.radians([0.0, -0.5, -30.0])
    assert air_mass(low) == pytest.approx(1 / (0.50572 * 6.07995**-1.6364), rel=1e-12)


def test_between_tabled_air_masses_extinction_is_straight_to_the_last_of_them():
    """One of sunlight that is not in proportion to the air: at 26.3 masses, a degree up, it lies
    between those of 15 and of 40.
    """
    up = np.array([0.0, 0.0, 1.0])
    air = plain_air(up, (1.0,))
    bent = np.array([0.0, 0.5, 0.7, 0.9, 1.2, 1.5, 2.0, 2.3, 4.8])
    air = replace(air, dimming_mag=bent[None, :, None])
    altitudes = np.radians([90.0, 30.0, 5.0, 1.0])
    masses = air_mass(altitudes)
    (shares,) = air.shares(np.full(4, -1), altitudes)
    mag = -2.5 * np.log10(shares)
    assert mag == pytest.approx(np.interp(masses, [0, 1, 1.5, 2, 3, 5, 8, 15, 40], bent), abs=1e-9)
    assert 15 < masses[3] < 40


def test_beyond_a_table_of_extinction_its_ends_hold():
    optics = Optics(
        30.0, Curve(np.array([300.0, 1100.0]), np.array([0.6, 0.6])), constant_curve(0.8)
    )
    extinction = Curve(np.array([400.0, 700.0]), np.array([0.5, 0.2]))
    through = through_air(optics, extinction, 2.0).transmission
    nm = np.array([310.0, 400.0, 550.0, 700.0, 1090.0])
    mag = np.array([0.5, 0.5, 0.35, 0.2, 0.2])
    # straight between knots 5 nm apart
    assert through(nm) == pytest.approx(0.8 * 10 ** (-0.4 * 2.0 * mag), rel=1e-4)
    grey = through_air(optics, constant_curve(0.3), 2.0).transmission
    assert grey(nm) == pytest.approx(0.8 * 10 ** (-0.4 * 2.0 * 0.3), rel=1e-12)


@pytest.mark.parametrize("is_vega", [False, True], ids=["glow", "vega"])
def test_light_of_a_v_magnitude_has_its_mean_through_v_by_energy_or_by_photons(is_vega):
    """The electrons are as the inverse of the mean: of light that rises by a half from 470 to 700
    nm, and of Vega's own, which falls.
    """
    optics = Optics(30.0, constant_curve(0.5), constant_curve(0.8))
    spectrum = Curve(np.array([300.0, 470.0, 700.0, 1100.0]), np.array([1.0, 1.0, 1.5, 1.5]))
    if is_vega:
        spectrum = vega()
        rates = [vega_electrons_per_s(optics, Photometry("vega", way)) for way in WEIGHTINGS]
    else:
        rates = [
            glow_e_per_s_arcsec2(spectrum, 21.0, optics, Photometry("vega", way))
            for way in WEIGHTINGS
        ]
    passband = load_curve("johnson-v", "johnson-v")
    nm = np.linspace(470.0, 700.0, 200_001)
    means = []
    for photons in (np.ones(len(nm)), nm):
        response = passband(nm) * photons
        means.append((spectrum(nm) * response).sum() / response.sum())
    assert rates[1] / rates[0] == pytest.approx(means[0] / means[1], rel=1e-5)
    assert abs(means[0] / means[1] - 1) > 1e-3


def test_the_night_sky_glows_more_towards_the_horizon_and_not_from_the_ground():
    """Krisciunas and Schaefer 1991, PASP 103, 1033, equations 2 and 3."""
    altitude = np.radians([90.0, 30.0, 5.0, -0.01, -30.0])
    directions = np.stack([np.cos(altitude), np.zeros(5), np.sin(altitude)], axis=1)
    zenith_e_per_s_sr = np.array([8.0, 2.0])
    air = replace(
        plain_air(np.array([0.0, 0.0, 1.0]), (0.1, 0.2)),
        v_extinction_mag=0.17,
        glow_e_per_s_sr=zenith_e_per_s_sr,
    )
    masses = (1 - 0.96 * np.cos(altitude) ** 2) ** -0.5
    wanted = masses * 10 ** (-0.4 * 0.17 * (masses - 1))
    wanted[3:] = 0.0
    assert air.glow_at(directions, 0) == pytest.approx(np.outer(zenith_e_per_s_sr, wanted))


def test_a_curve_with_another_s_knots_is_the_same_curve_to_both_ends_of_a_range():
    """The ends are knots, too: outside of its knots a curve is nothing."""
    curve = Curve(np.array([300.0, 500.0, 900.0]), np.array([0.1, 0.9, 0.5]))
    other = Curve(np.array([350.0, 450.0, 650.0, 800.0]), np.ones(4))
    both = with_knots(curve, other, (400.0, 700.0))
    assert both.wavelength_nm.tolist() == [400.0, 450.0, 500.0, 650.0, 700.0]
    assert both.value == pytest.approx([0.5, 0.7, 0.9, 0.75, 0.7])


def test_a_zenith_is_that_of_each_second():
    """Which the Earth turns by 15 arcsec."""
    asked = []

    def up_at(utc_ns: int) -> np.ndarray:
        asked.append(utc_ns)
        return np.array([0.0, 0.0, 1.0])

    air = replace(plain_air(np.array([0.0, 0.0, 1.0]), (0.2,)), up_at=up_at)
    for utc_ns in (7_000_000_000, 7_999_999_999, 8_000_000_000, 8_400_000_000):
        air.above(utc_ns)
    assert asked == [7_000_000_000, 8_000_000_000]


# of one step of Newton's, in this air, down to 20 degrees of altitude: 3.9e-9 rad measured
BENT_RAD = 1e-8


@pytest.mark.parametrize("velocity_km_s", [None, (20.0, -21.0, 7.0)], ids=["at rest", "moving"])
def test_the_air_bends_what_the_observer_sees_by_a_tan_z_and_b_tan_3_z(velocity_km_s):
    """Aberration first, which turns stars by up to 20 arcsec, then refraction: z the zenith distance
    as it is seen.
    """
    up = np.array([2.0, -1.0, 2.0]) / 3
    level = np.array([1.0, 2.0, 0.0]) / np.sqrt(5)
    z_rad = np.radians([0.0, 20.0, 45.0, 60.0, 70.0])[:, None]
    stars = stars_at(np.cos(z_rad) * up + np.sin(z_rad) * level, np.ones(len(z_rad)))
    if velocity_km_s is not None:
        stars = replace(stars, velocity_km_s=np.array(velocity_km_s))
    every = np.arange(len(stars))
    outside = stars.directions(every)
    a_rad, b_rad = 2.9e-4, -3.3e-7
    seen = replace(stars, air=AirAbove(up, (a_rad, b_rad))).directions(every)
    outside_z_rad, seen_z_rad = (np.arctan2(*_across_and_up(v, up)) for v in (outside, seen))
    tangent = np.tan(seen_z_rad)
    bent_rad = a_rad * tangent + b_rad * tangent**3
    assert outside_z_rad - seen_z_rad == pytest.approx(bent_rad, abs=BENT_RAD)
    assert np.linalg.norm(seen, axis=1) == pytest.approx(1, abs=1e-12)
    # towards the zenith, and not to a side
    sideways = np.cross(outside, up)
    assert np.einsum("ij,ij->i", sideways, seen) == pytest.approx(0, abs=1e-12)


def _across_and_up(vectors: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.linalg.norm(np.cross(vectors, up), axis=1), vectors @ up


@pytest.mark.parametrize(
    ("centre_deg", "is_seen"), [(0.5, True), (0.1, True), (-0.1, True), (-0.2, True), (-0.4, False)]
)
def test_a_moon_that_sets_is_seen_until_its_upper_limb_is_down(centre_deg, is_seen):
    """Of half a degree: without refraction its limb sets when its centre is 0.26 degrees down."""
    moving = moving_sky(UTC, ("Moon",))
    (moon,) = moving.discs(np.array([1.0, 0.0, 0.0]), np.pi)
    assert 0.24 < np.degrees(moon.radius_rad) < 0.28
    level = np.cross(moon.direction, [0.0, 0.0, 1.0])
    level /= np.linalg.norm(level)
    altitude = np.radians(centre_deg)
    moving.air = plain_air(np.sin(altitude) * moon.direction + np.cos(altitude) * level, (0.2,))
    found = moving.discs(moon.direction, 0.1)
    assert [disc.name for disc in found] == (["Moon"] if is_seen else [])


def test_the_sun_that_brightens_a_sky_is_that_of_the_moment(caplog):
    """At the pole its altitude is its declination: -14.5 and -8.2 degrees by Astropy's get_sun."""
    moving = moving_sky("2026-02-10T00:00:00Z", ())
    moving.air = plain_air(np.array([0.0, 0.0, 1.0]), (0.2,))
    stars = stars_at(np.array([[0.0, 0.0, 1.0]]), np.ones(1))
    moving.seen(stars, 0)
    assert not caplog.records
    moving.seen(stars, 18 * 86_400 * 10**9)
    assert "the Sun stands at -8.2 degrees" in caplog.text


@pytest.mark.parametrize("altitude_deg", [90.0, 30.0, 0.5, -0.5, -60.0])
def test_a_satellite_is_seen_through_the_air_and_not_through_the_ground(altitude_deg):
    """Two that are lit, of a list of 30: each at its own altitude over a horizon that is put there."""
    sky = satellite_sky(some_orbits(np.random.default_rng(3), 30), Geocentre())
    seen = sky.passing(Cone(np.array([0.0, 0.0, 1.0]), np.pi, 0.0), 0)
    now = np.zeros(len(seen))
    every = np.arange(len(seen))
    bare = seen.rates_e_per_s(every, now, now)
    brightest = int(np.argmax(bare))
    towards = seen.directions(every, now)[brightest]
    level = np.cross(towards, [0.0, 0.0, 1.0])
    level /= np.linalg.norm(level)
    altitude = np.radians(altitude_deg)
    air = plain_air(np.sin(altitude) * towards + np.cos(altitude) * level, (0.2,))
    through = seen.through(air, 0).rates_e_per_s(every, now, now)[brightest]
    if altitude_deg < 0:
        assert through == 0.0
    else:
        # Pickering 2002, whose air masses are Kasten and Young's within 1 % from the horizon up
        masses = 1 / np.sin(np.radians(altitude_deg + 244 / (165 + 47 * altitude_deg**1.1)))
        wanted_mag = 0.2 * masses
        assert -2.5 * np.log10(through / bare[brightest]) == pytest.approx(wanted_mag, rel=0.02)


# U.S. Standard Atmosphere 1976, table IV: geopotential height, m, and pressure, hPa.
STANDARD = (
    *((0.0, 1013.25), (1000.0, 898.745), (3000.0, 701.085), (5000.0, 540.199)),
    *((11_000.0, 226.321), (15_000.0, 120.446), (20_000.0, 54.7489)),
)


@pytest.mark.parametrize(("height_m", "pressure_hpa"), STANDARD)
def test_the_pressure_of_a_height_is_the_standard_atmosphere_s(height_m, pressure_hpa):
    assert standard_pressure_hpa(height_m) == pytest.approx(pressure_hpa, rel=1e-4)


def test_the_pressure_falls_with_height_and_never_to_nothing():
    """The law of the lowest 11 km, which balloons leave, would end at 44 km."""
    pressures_hpa = [standard_pressure_hpa(height_m) for height_m in range(-400, 43_000, 600)]
    assert (np.diff(pressures_hpa) < 0).all()
    assert 0 < standard_pressure_hpa(1e5) < pressures_hpa[-1]
