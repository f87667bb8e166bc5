"""A satellite's light: phase, shadow, what is behind the Earth, and flashes, each against a sum
over many places or times.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.units import KM_PER_AU
from hilstar.sky.bodies.satellites import (
    EARTH_FLATTENING,
    EARTH_KM,
    SUN_KM,
    Brightness,
    in_front,
    phase_factor,
    reflected_share,
    sunlit_share,
)

SUN = np.array([0.6, -0.72, -0.35]) * KM_PER_AU
# a sunflower of points: the share of a disc that an edge cuts off is right to 2e-3 or so
SUN_POINTS = 4000
SHARE_LIMIT = 4e-3
INTEGRAL_LIMIT = 1e-4  # of 200 000 steps over flashes of 1/40 of the time


def ray_traced_share(place: np.ndarray) -> float:
    """The share of the Sun's points that a place sees past the ellipsoid."""
    k = np.arange(SUN_POINTS)
    radius, turn = SUN_KM * np.sqrt((k + 0.5) / SUN_POINTS), k * np.pi * (3 - np.sqrt(5))
    way = SUN - place
    across = np.cross(way, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    other = np.cross(across, way / np.linalg.norm(way))
    to_point = (
        way + (radius * np.cos(turn))[:, None] * across + (radius * np.sin(turn))[:, None] * other
    )
    axes = np.array([EARTH_KM, EARTH_KM, EARTH_KM * (1 - EARTH_FLATTENING)])
    begin, ray = place / axes, to_point / axes
    a, b, c = (ray * ray).sum(axis=1), 2 * ray @ begin, begin @ begin - 1
    hits = (b * b - 4 * a * c > 0) & (b < 0)  # ahead
    return 1 - hits.mean()


@pytest.mark.parametrize("distance_km", [6800.0, 20_000.0, 42_164.0, 2e6])
def test_the_shadow_dims_as_rays_to_points_of_the_sun_do(distance_km):
    """From full light through the penumbra into the umbra, over the equator's side and over a
    pole; far off, a ring is left.
    """
    down = -SUN / np.linalg.norm(SUN)
    for side in (np.cross(down, [0.0, 0.0, 1.0]), np.cross(np.cross(down, [0.0, 0.0, 1.0]), down)):
        side = side / np.linalg.norm(side)
        for off_km in np.linspace(0.0, 1.5 * EARTH_KM + 0.0062 * distance_km, 25):
            along = np.sqrt(max(distance_km**2 - off_km**2, 0.0))
            place = along * down + min(off_km, distance_km) * side
            assert abs(sunlit_share(place[None], SUN)[0] - ray_traced_share(place)) < SHARE_LIMIT


def test_a_penumbra_has_light_and_an_umbra_none():
    down = -SUN / np.linalg.norm(SUN)
    side = np.cross(down, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    places = np.array([2000.0, 6340.0, 6378.0, 6410.0, 7000.0])[:, None] * side + 6000.0 * down
    shares = sunlit_share(places, SUN)
    assert shares[0] == 0
    assert shares[-1] == 1
    assert (np.diff(shares[1:4]) > 0.1).all()


def test_the_phase_law_is_that_of_a_diffuse_sphere():
    """The light of all its places that the Sun lights and the observer sees, over that at 90
    degrees.
    """
    rng = np.random.default_rng(7)
    normal = rng.normal(size=(400_000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    angles = np.radians([0.0, 30.0, 60.0, 90.0, 120.0, 150.0])
    light = [
        (np.maximum(0, normal[:, 2]) * np.maximum(0, normal @ [np.sin(a), 0.0, np.cos(a)])).mean()
        for a in angles.tolist()
    ]
    # 400 000 places: 0.4 % where all of it is lit, 2 % of the thinnest crescent
    assert np.allclose(
        phase_factor(np.cos(angles)), np.array(light) / light[3], rtol=0.02, atol=0.005
    )
    assert phase_factor(np.array([1.0, -1.0])).tolist() == pytest.approx([np.pi, 0.0], abs=1e-12)


def test_the_standard_magnitude_is_at_1000_km_and_90_degrees_and_goes_with_the_distance_squared():
    to_sun = SUN / np.linalg.norm(SUN)
    seen = np.cross(to_sun, [0.0, 0.0, 1.0])
    seen *= 1000.0 / np.linalg.norm(seen)
    place, sun = 9000.0 * to_sun[None], to_sun * KM_PER_AU
    assert reflected_share(seen[None], place, sun) == pytest.approx(1.0, rel=1e-12)
    assert reflected_share(2 * seen[None], place, sun) == pytest.approx(0.25, rel=1e-12)
    assert reflected_share(seen[None], place, 0.983 * sun) == pytest.approx(1 / 0.983**2, rel=1e-12)


def test_the_earth_hides_what_is_behind_it():
    observer = np.array([[7000.0, 0.0, 0.0]])
    places = np.array(
        [
            [-7000.0, 0, 0],
            [-7000.0, 31_100, 0],
            [9000.0, 0, 0],
            [0, 15_450.0, 0],
            [0, 0, 15_450.0],
            [0, 0, 15_400.0],
        ]
    )
    # From 7000 km tangents to the equator are 15 477 km from the centre at a right angle, those
    # over the poles 15 425 km.
    assert in_front(np.repeat(observer, 6, axis=0), places).tolist() == [0, 1, 1, 0, 1, 0]
    assert in_front(np.zeros((6, 3)), places).tolist() == [1] * 6


def brightness(**known: float) -> Brightness:
    values = {"standard_e_per_s": 1.0, "flash_s": np.nan, "flash_at_s": 0.0, "size_m": 0.0} | known
    return Brightness(**{k: np.array([v]) for k, v in values.items()})


def varied(begin_s: float, end_s: float, **known: float) -> float:
    times = np.array([begin_s]), np.array([end_s])
    return float(brightness(**known).variation(np.array([0]), *times)[0])


@pytest.mark.parametrize("known", [
    {"period_s": 2.0, "amplitude_mag": 3.0, "flash_s": 0.05, "flash_at_s": 0.7},
    {"period_s": 0.3, "amplitude_mag": 1.5, "flash_at_s": -4.1},
    {"period_s": np.nan, "amplitude_mag": 0.0},
])  # fmt: skip
def test_the_bound_of_light_that_varies_is_its_brightest_moment(known):
    """Over a period, in 4001 moments: 1e-5 of a wave, 1e-4 of the flash of 0.05 s."""
    period_s = known["period_s"]
    moments = np.linspace(0.0, period_s if period_s > 0 else 1.0, 4001)
    light = brightness(**known)
    same = np.zeros(len(moments), dtype=np.intp)
    seen = light.variation(same, moments, moments)
    assert light.most(np.array([0]))[0] == pytest.approx(seen.max(), rel=2e-4)


@pytest.mark.parametrize("known", [
    {"period_s": 2.0, "amplitude_mag": 3.0, "flash_s": 0.05, "flash_at_s": 0.7},
    {"period_s": 2.0, "amplitude_mag": 1.0, "flash_s": 1.0},
    {"period_s": 0.3, "amplitude_mag": 1.5, "flash_at_s": -4.1},
])  # fmt: skip
def test_the_mean_of_light_that_varies_is_its_integral(known):
    for begin_s, end_s in ((0.0, 2.0), (0.65, 0.75), (-3.1, 4.4), (1e6, 1e6 + 0.9)):
        edges = np.linspace(begin_s, end_s, 200_001)
        moments = (edges[1:] + edges[:-1]) / 2
        ratio = 10 ** (0.4 * known["amplitude_mag"])
        turns = (moments - known.get("flash_at_s", 0.0)) / known["period_s"]
        if "flash_s" in known:
            near = (turns - np.round(turns))[:, None] + np.arange(-2, 3)
            gauss = np.exp(-4 * np.log(2) * (near * known["period_s"] / known["flash_s"]) ** 2).sum(
                axis=1
            )
            flux = 1 + (ratio - 1) * gauss
        else:
            flux = 1 + (ratio - 1) / (ratio + 1) * np.cos(2 * np.pi * turns)
        assert varied(begin_s, end_s, **known) == pytest.approx(flux.mean(), rel=INTEGRAL_LIMIT)


def test_a_flash_is_at_its_time_and_as_bright_as_it_says():
    known = {"period_s": 5.0, "amplitude_mag": 2.5, "flash_s": 0.2, "flash_at_s": 1.0}
    for top_s in (1.0, 6.0, 1001.0, -4.0):
        assert varied(top_s, top_s, **known) == pytest.approx(10.0, rel=1e-6)
        assert varied(top_s + 0.1, top_s + 0.1, **known) == pytest.approx(5.5, rel=1e-4)
        assert varied(top_s + 2.5, top_s + 2.5, **known) == pytest.approx(1.0, rel=1e-6)
    wave = {"period_s": 5.0, "amplitude_mag": 2.5, "flash_at_s": 1.0}
    assert varied(1.0, 1.0, **wave) / varied(3.5, 3.5, **wave) == pytest.approx(10.0, rel=1e-6)
