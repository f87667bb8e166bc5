"""The Earth from an orbit: its limb by rays that are aberrated one by one, its light from afar
and near, and nobody's place.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.units import KM_PER_AU, LIGHT_KM_S
from hilstar.sky.bodies.disc import Disc
from hilstar.sky.bodies.earth_disc import DARK_V_MAG, apparent_cone, earth_disc, earth_light
from hilstar.sky.bodies.light import body_v_mag
from hilstar.sky.bodies.orbit import TleOrbit
from hilstar.sky.stars import aberrate
from tests.support.ray_traced.bodies import Body, lambert, limb
from tests.support.skies import ALL_BODIES, STATION_TLE, STATION_UTC, moving_sky, utc_ns
from tests.support.stars import stars_at

ARCSEC = np.pi / (180 * 3600)
# The spheroid's limb is aberrated as a circle: its flattening, 1/298, of a low orbit's 5.3 arcsec;
# measured 0.01.
LIMB_ARCSEC = 0.02
# a spheroid's face seen from the equator against the closed form of a sphere of the same outline
AFAR_MAG = 0.004
# of a disc's light: its law is integrated with 5 arcsec of aberration or without, four times of a
# crescent's
SMALL_TURN = 1e-4
EARTH_KM_S = np.array([-12.0, 24.0, 10.4])  # about the barycentre, some date's
SUN_KM = KM_PER_AU * np.array([0.6, 0.8, 0.0])
NAMES = (*ALL_BODIES, "Earth")
SECOND_NS = 10**9


def outline(disc: Disc, directions: np.ndarray) -> np.ndarray:
    """How far directions (n, 3) are outside of a disc, arcsec."""
    seen = directions @ disc.to_sphere.T
    angle = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
    return (angle - np.arcsin(1 / disc.distance_radii)) / ARCSEC


@pytest.mark.parametrize(
    ("radius_km", "speed_km_s"), [(6728.0, 7.7), (6728.0, 10.5), (42_164.0, 3.07), (380_000.0, 1.0)]
)
def test_each_ray_of_the_limb_is_where_its_own_light_time_and_aberration_have_it(
    radius_km, speed_km_s, rng
):
    towards, ahead = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    seen_km = radius_km * towards
    velocity = speed_km_s * (
        ahead if speed_km_s < 8 else (ahead + 0.4 * towards) / np.hypot(1, 0.4)
    )
    disc = earth_disc(seen_km, SUN_KM, velocity, 1.0)
    # WGS 84
    assert (disc.equator_km, disc.polar_km) == pytest.approx((6378.137, 6356.752), abs=1e-3)
    body = Body(seen_km, disc.equator_km, disc.polar_km, disc.pole, disc.sun, lambert)
    rays = limb(body, 36)
    # Where each ray touches: the point nearest to the centre, in the spheroid's axes
    squash = np.diag([1, 1, disc.equator_km / disc.polar_km])
    near = np.einsum("ij,ij->i", rays @ squash, np.broadcast_to(seen_km @ squash, rays.shape))
    touch_km = (near / (np.linalg.norm(rays @ squash, axis=1) ** 2))[:, None] * rays
    left_km = touch_km - EARTH_KM_S * (np.linalg.norm(touch_km, axis=1) / LIGHT_KM_S)[:, None]
    seen = aberrate(left_km / np.linalg.norm(left_km, axis=1, keepdims=True), EARTH_KM_S + velocity)
    assert np.abs(outline(disc, seen)).max() < LIMB_ARCSEC
    # the middle alone, moved by its own aberration, would be off by arcseconds
    if radius_km < 7000:
        middle = aberrate(towards[None], velocity)[0]
        assert np.degrees(np.arccos(middle @ disc.direction)) * 3600 > 3.0


@pytest.mark.parametrize("phase_deg", [0.5, 45.0, 90.0, 135.0, 169.0])
def test_from_afar_the_ground_s_light_is_the_whole_globe_s_magnitude(phase_deg):
    phase = np.radians(phase_deg)
    side = np.array([-0.8, 0.6, 0.0])
    seen_km = 4e7 * (np.cos(phase) * SUN_KM / KM_PER_AU + np.sin(phase) * side)
    v_mag, rate = earth_light(earth_disc(seen_km, SUN_KM, np.zeros(3), 5e6), 5e6)
    assert v_mag == pytest.approx(body_v_mag("Earth", SUN_KM, seen_km, 2026.0), abs=AFAR_MAG)
    assert rate == pytest.approx(5e6 * 10 ** (-0.4 * v_mag))


def test_its_night_side_is_dark_and_its_day_side_near_is_brighter_than_all_of_it_from_afar():
    towards = SUN_KM / KM_PER_AU
    v_mag, rate = earth_light(earth_disc(-6778.0 * towards, SUN_KM, np.zeros(3), 1.0), 1.0)
    assert (v_mag, rate) == (pytest.approx(DARK_V_MAG), 0.0)
    day, _ = earth_light(earth_disc(6778.0 * towards, SUN_KM, np.zeros(3), 1.0), 1.0)
    # Ground of normal albedo 0.65 under the Sun at the zenith, which fills half the sky: 0.65 of
    # sunlight, and less at the rim
    assert -27.0 < day < -25.5


@pytest.mark.parametrize("radius_km", [6000.0, 6378.0, 6379.5])
def test_a_place_in_the_ground_is_seen_from_just_above_it(radius_km):
    disc = earth_disc(np.array([0.0, 0.0, radius_km]), SUN_KM, np.zeros(3), 1.0)
    assert 80 < np.degrees(disc.radius_rad) < 90
    assert np.isfinite(earth_light(disc, 1.0)).all()


def test_from_its_centre_the_earth_is_nowhere():
    moving = moving_sky(STATION_UTC, NAMES)
    stars = moving.among(stars_at(np.eye(3), np.ones(3)))
    assert np.isnan(stars.vectors[-1]).all()
    assert stars.electrons_per_s[-1] == pytest.approx(0.0, abs=1e-12)
    everywhere = np.concatenate([stars.near(axis, 1.0) for axis in (*np.eye(3), *-np.eye(3))])
    assert len(stars) - 1 not in everywhere
    assert "Earth" not in {disc.name for disc in moving.discs(np.array([1.0, 0.0, 0.0]), np.pi)}
    assert "Earth" not in moving.diameters_arcsec()


@pytest.mark.parametrize("t_ns", [0, 2000 * SECOND_NS])
def test_a_source_s_place_and_velocity_give_the_sky_of_the_same_orbit(t_ns):
    """Each frame by itself, where an orbit's file has steps: nothing of the one that was before."""
    orbit = TleOrbit(STATION_TLE, "station.tle")
    by_file, by_source = moving_sky(STATION_UTC, NAMES, orbit), moving_sky(STATION_UTC, NAMES)
    eye = stars_at(np.eye(3), np.ones(3))
    place, velocity = orbit.state(utc_ns(STATION_UTC) + t_ns)
    first = by_source.among(eye)
    by_source.seen(first, 77 * SECOND_NS, velocity[::-1].copy(), place[::-1].copy())
    there = by_source.seen(first, t_ns, velocity, place)
    here = by_file.seen(by_file.among(eye), t_ns)
    both = np.arange(3, len(here))
    off = np.linalg.norm(here.directions(both) - there.directions(both), axis=1)
    # aberrated in two steps, the orbit's own first; second orders of 8 km/s
    assert off.max() / ARCSEC < 1e-3
    assert here.v_mag[both] == pytest.approx(there.v_mag[both], abs=1e-9)
    axis = np.array([0.0, 0.0, 1.0])
    mine = by_source.discs(axis, np.pi, 0.0, t_ns, velocity, place)
    theirs = by_file.discs(axis, np.pi, 0.0, t_ns)
    assert [disc.name for disc in mine] == [disc.name for disc in theirs]
    for ours, other in zip(mine, theirs, strict=True):
        assert np.linalg.norm(ours.direction - other.direction) / ARCSEC < 1e-3
        assert ours.normal_e_per_s_sr == pytest.approx(other.normal_e_per_s_sr, rel=SMALL_TURN)
        assert ours.distance_km == pytest.approx(other.distance_km, rel=1e-9)


def test_the_earth_as_a_disc_and_as_a_point_is_at_one_place_though_stars_are_aberrated():
    """Stars turn by 10 arcsec in half an orbit; what is beside the Earth's limb does, the
    Earth's own middle by its cosine.
    """
    orbit = TleOrbit(STATION_TLE, "station.tle")
    moving = moving_sky(STATION_UTC, ("Earth",), orbit)
    stars = moving.among(stars_at(np.eye(3), np.ones(3)))
    t_ns = 2760 * SECOND_NS
    seen = moving.seen(stars, t_ns)
    assert seen.velocity_km_s is not None
    (earth,) = moving.discs(np.array([1.0, 0.0, 0.0]), np.pi, 0.0, t_ns)
    assert np.linalg.norm(seen.directions(np.array([3]))[0] - earth.direction) / ARCSEC < 1e-3
    place, velocity = orbit.state(utc_ns(STATION_UTC) + t_ns)
    exact = earth_disc(-place, SUN_KM, velocity, 1.0)
    assert np.linalg.norm(exact.direction - earth.direction) / ARCSEC < 1e-3


def test_from_below_the_ground_it_is_as_wide_as_from_a_kilometre_above_the_equator():
    direction, distance_km = apparent_cone(np.array([0.0, 0.0, 6000.0]), np.zeros(3))
    assert direction.tolist() == [0.0, 0.0, 1.0]
    assert distance_km == pytest.approx(6378.1366 + 1.0, abs=1e-6)  # IERS 2010
