"""A body's face: its light by rays of another's making, its sum by closed forms, and where a sky
has it.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.sky.bodies.disc import Air, Disc
from hilstar.sky.bodies.shapes import lunar_share
from tests.support.ray_traced.bodies import Body, lambert, lunar_lambert, traced
from tests.support.skies import moving_sky

UTC = "2026-11-21T00:00:00Z"
# radii: a closed form of a far sphere is off by the angle of one, which at 178 degrees is 3e-5 of a
# crescent
FAR = 1e6
CLOSED_LIMIT = 1e-4  # the quadrature itself: measured 3e-5
MEAN_LIMIT = 5e-3  # three sigma of the mean over RAYS random ones
RAYS = 100_000
# 20 arcsec between where the Moon is seen and where it is, in a law of 0.02 to a degree of phase
ABERRATION = 1.2e-4
# of the air's transmission: heights above a stretched sphere, not above the spheroid
AIR_LIMIT = 0.02


def unit_disc(
    phase_deg: float, distance: float, law="lambert", share=1.0, polar=1.0, air=None
) -> Disc:
    """A body of one unit's radius, off every axis, with the Sun to its side."""
    towards = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
    side = np.cross(towards, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    sun = -np.cos(np.radians(phase_deg)) * towards + np.sin(np.radians(phase_deg)) * side
    return Disc(
        "x", towards, distance, 1.0, polar, np.array([0.6, 0.0, 0.8]), sun, law, 1.0, share, air
    )


def rays_about(one: Disc, rng, count=RAYS) -> tuple[np.ndarray, float]:
    """Directions (n, 3) evenly over a cap that holds the disc, and its solid angle."""
    reach = min(1.1 * one.radius_rad, np.pi / 2)
    cosine, turn = 1 - rng.random(count) * (1 - np.cos(reach)), rng.random(count) * 2 * np.pi
    first = np.cross(one.direction, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    across = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * np.cross(one.direction, first)
    return cosine[:, None] * one.direction + np.sqrt(1 - cosine**2)[:, None] * across, 2 * np.pi * (
        1 - np.cos(reach)
    )


@pytest.mark.parametrize("phase_deg", [0.0, 40.0, 90.0, 140.0, 170.0, 178.0])
def test_a_far_sphere_s_whole_light_is_that_of_the_closed_forms(phase_deg):
    phase, whole_sr = np.radians(phase_deg), np.pi / FAR**2
    lambertian = 2 / 3 * (np.sin(phase) + (np.pi - phase) * np.cos(phase)) / np.pi
    half = phase / 2
    lunar = 1 - np.sin(half) * np.tan(half) * np.log(1 / np.tan(half / 2)) if phase else 1.0
    assert unit_disc(phase_deg, FAR).law_integral_sr() == pytest.approx(
        whole_sr * lambertian, rel=CLOSED_LIMIT
    )
    assert unit_disc(phase_deg, FAR, "lunar-lambert").law_integral_sr() == pytest.approx(
        whole_sr * lunar, rel=CLOSED_LIMIT
    )
    assert unit_disc(phase_deg, FAR, "uniform").law_integral_sr() == pytest.approx(
        whole_sr, rel=CLOSED_LIMIT
    )
    # 0.30 + 0.93 mu - 0.23 mu^2 over a disc: the mean of mu is 2/3 there, that of its square 1/2.
    limb = 0.30 + 0.93 * 2 / 3 - 0.23 / 2
    assert unit_disc(phase_deg, FAR, "limb-darkened").law_integral_sr() == pytest.approx(
        whole_sr * limb, rel=CLOSED_LIMIT
    )


@pytest.mark.parametrize(("distance", "polar"), [(1.08, 1.0), (3.0, 0.9), (200.0, 0.95)])
@pytest.mark.parametrize(("law", "share"), [("lambert", 1.0), ("lunar-lambert", 0.4)])
def test_each_ray_has_the_light_of_a_traced_one_and_all_have_the_integral(
    distance, polar, law, share, rng
):
    one = unit_disc(75.0, distance, law, share, polar)
    rays, whole_sr = rays_about(one, rng)
    body = Body(
        distance * one.direction,
        1.0,
        polar,
        one.pole,
        one.sun,
        lambert if law == "lambert" else lunar_lambert(share),
    )
    found = one.radiance(rays)
    truth, through = traced(body, rays)
    # A ray at the limb may be on either side.
    assert np.mean(np.abs(found - truth) > 1e-6) < 1e-4
    assert np.mean((one.transmission(rays) == 0) != (through == 0)) < 1e-4
    assert found.mean() * whole_sr == pytest.approx(one.law_integral_sr(), rel=MEAN_LIMIT * 2)
    assert one.of_rate(5e6).radiance(rays).mean() * whole_sr == pytest.approx(
        5e6, rel=MEAN_LIMIT * 2
    )


def test_air_dims_what_is_behind_it_as_traced_rays_say(rng):
    earth = Air(8.0 / 6378.0, 0.097)
    one = unit_disc(60.0, 1.1, polar=6356.75 / 6378.14, air=earth)
    body = Body(
        1.1 * one.direction * 6378.0,
        6378.0,
        6378.0 * one.polar_km,
        one.pole,
        one.sun,
        lambert,
        1.0,
        (8.0, 0.097),
    )
    rays, _ = rays_about(one, rng, 20_000)
    light, through = traced(body, rays)
    found = one.transmission(rays)
    beside = (through > 0) & (found > 0)
    shining, hidden = one.air_light(rays[beside])
    assert hidden == pytest.approx(1 - found[beside])
    assert np.abs(shining - light[beside]).max() < AIR_LIMIT and shining.max() > 0.3
    assert np.abs(found - through)[(through > 0) & (found > 0)].max() < AIR_LIMIT
    assert np.count_nonzero((found > 0.05) & (found < 0.9)) > 20  # the shell is among the rays
    # disc and air together: the traced rays' own light, down to where the air is dense
    both, covered = one.with_air(rays)
    assert covered == pytest.approx(1 - found)
    assert np.abs(both - light)[beside].max() < AIR_LIMIT
    assert np.count_nonzero(beside & (covered > 0.5)) > 5
    assert both[~beside] == pytest.approx(one.radiance(rays[~beside]))


@pytest.mark.parametrize("polar", [0.7, 0.9, 1.0, 1.1])
@pytest.mark.parametrize("distance", [2.0, 50.0])
def test_no_part_of_a_limb_is_farther_from_the_middle_than_the_radius(polar, distance):
    """Of a body seen across its axis the longer one reaches it."""
    towards = np.array([1.0, 0.0, 0.0])
    for pole in ([0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [1.0, 0.0, 0.0]):
        one = Disc("x", towards, distance, 1.0, polar, np.array(pole), towards, "lambert")
        limb_rad = np.arccos(np.clip(one.limb(360) @ towards, -1.0, 1.0))
        assert limb_rad.max() < one.radius_rad + 1e-9
        if pole[0] == 0.0 and distance == 50.0:
            # a far body's limb is its cross-section: its longer half axis over its distance
            assert limb_rad.max() == pytest.approx(max(1.0, polar) / distance, rel=1e-3)


def test_the_moon_s_law_is_of_its_phase_and_a_planet_s_is_lambert_s():
    """McEwen (1996, LPSC XXVII): L = 1 - 0.019 g + 2.42e-4 g^2 - 1.46e-6 g^3, g the phase, deg."""
    discs = {one.name: one for one in moving_sky(UTC).discs(np.array([1.0, 0.0, 0.0]), np.pi)}
    moon = discs["Moon"]
    g = np.degrees(np.arccos(-moon.direction @ moon.sun))
    mcewen = 1 - 0.019 * g + 2.42e-4 * g**2 - 1.46e-6 * g**3
    assert 0.1 < mcewen < 0.9
    assert moon.lunar_share == pytest.approx(mcewen, abs=ABERRATION)
    # beyond the angles to which it was fitted it is no less than nothing
    assert [lunar_share(phase_deg) for phase_deg in (0.0, 120.0, 175.0)] == [1.0, 0.0, 0.0]
    assert {discs[name].law for name in discs if name not in ("Sun", "Moon")} == {"lambert"}


def test_distances_are_from_the_observer_s_place():
    """40 000 km towards the Moon. An observer whose speed is not stated is at rest."""
    moving = moving_sky(UTC)
    at_centre = moving.distances_km(place_km=np.zeros(3))
    moon = moving.names.index("Moon")
    towards = next(one for one in moving.discs(np.array([1.0, 0, 0]), np.pi) if one.name == "Moon")
    nearer = moving.distances_km(place_km=4e4 * towards.direction)
    assert at_centre[moon] - nearer[moon] == pytest.approx(4e4, rel=1e-4)
    at_rest = moving.distances_km(None, np.zeros(3), 4e4 * towards.direction)
    assert np.array_equal(nearer, at_rest)


def test_a_sky_s_discs_are_those_in_reach_nearest_first_with_their_rate():
    moving = moving_sky(UTC)
    found = moving.discs(np.array([1.0, 0.0, 0.0]), np.pi)
    assert [one.name for one in found] == [
        "Moon",
        "Venus",
        "Sun",
        "Mercury",
        "Mars",
        "Jupiter",
        "Saturn",
        "Uranus",
        "Neptune",
    ]
    moon, sun = found[0], found[2]
    # 1942 arcsec at 0.988 au
    assert 2 * np.degrees(sun.radius_rad) == pytest.approx(0.5394, abs=1e-3)
    assert not moving.discs(-moon.direction, 0.1, 0.1)
    # 1.5 radii off its middle: it is there in a cone of 0.6 radii, and not of 0.4
    side = np.cross(moon.direction, sun.direction)
    beside = moon.direction + 1.5 * moon.radius_rad * side / np.linalg.norm(side)
    beside /= np.linalg.norm(beside)
    for reach, names in ((0.6, ["Moon"]), (0.4, [])):
        in_reach = moving.discs(beside, reach * moon.radius_rad, np.radians(0.1))
        assert [one.name for one in in_reach] == names
    assert [one.name for one in moving.discs(moon.direction, 1e-3, np.radians(0.1))] == ["Moon"]
    # Ten days before full: what is lit is the Sun's side.
    assert moon.radiance((moon.direction + 0.003 * (sun.direction - moon.direction))[None])[0] > 0
