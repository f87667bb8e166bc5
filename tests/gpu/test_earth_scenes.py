"""What an observer above the Earth sees set: stars, the Moon and the Sun, through the air and
behind the ground.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.server.bench.build import load
from hilstar.server.bench.frame import Bench
from hilstar.sky.bodies.earth_disc import AIR
from hilstar.sky.bodies.shapes import EQUATOR_KM, POLAR_KM
from tests.support.benches import bench_text
from tests.support.ray_traced.bodies import Body, lambert, traced

ALTITUDE_KM = 500.0
ALNILAM = 26311
# Of the air's share: heights above a stretched sphere, not above the spheroid
# (tests/unit/sky/bodies/test_disc.py)
AIR_LIMIT = 0.02
FLUX_LIMIT = 0.01
T_NS = 0


@pytest.fixture(scope="module")
def leo_bench(tmp_path_factory) -> Iterator[Bench]:
    """Places come with the frame, so that each test can stand where its scene wants it."""
    file = tmp_path_factory.mktemp("earth") / "bench.toml"
    tables = {
        "monitor": {"bits": 12},
        "attitude": {"source": "vizard"},
        "spacecraft": {"orbit": "source"},
        "sky": {"epoch_utc": "2026-11-21T00:00:00Z", "faintest_v_mag": 3.0},
        "sky.bodies": {"earth": True, "moon": True, "sun": True},
        "render": {"quantisation": "round", "motion": "off"},
    }
    file.write_text(bench_text(tables))
    with load(file) as opened:
        yield opened
        assert opened.renderer.gl_error() == "GL_NO_ERROR"


def above(direction: np.ndarray, height_rad: float, side: np.ndarray) -> np.ndarray:
    """A place (3,), km, from which a direction is seen so far above the limb of a round Earth;
    the zenith is towards `side`.
    """
    side = side - (side @ direction) * direction
    side /= np.linalg.norm(side)
    from_nadir = np.arcsin(EQUATOR_KM / (EQUATOR_KM + ALTITUDE_KM)) + height_rad
    return (EQUATOR_KM + ALTITUDE_KM) * (np.sin(from_nadir) * side - np.cos(from_nadir) * direction)


def towards(direction: np.ndarray) -> np.ndarray:
    x, y, z = direction
    return from_radec_roll_deg(np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(z)), 0.0)


def body_direction(leo_bench: Bench, name: str, place_km: np.ndarray) -> np.ndarray:
    assert leo_bench.moving is not None
    found = leo_bench.moving.discs(
        np.array([0.0, 0.0, 1.0]), np.pi, 0.0, T_NS, np.zeros(3), place_km
    )
    return next(disc.direction for disc in found if disc.name == name)


def light_from(leo_bench: Bench, direction: np.ndarray, place_km: np.ndarray) -> np.ndarray:
    """The linear image about a direction from a place."""
    sprites = leo_bench.light(leo_bench.view(towards(direction), None, T_NS, np.zeros(3), place_km))
    levels = leo_bench.draw_sprites(sprites).levels
    linear = leo_bench.renderer.linear().astype(float)
    assert np.isfinite(linear).all()
    assert (
        levels[linear > leo_bench.flux_at_white_e_per_s] == leo_bench.calibration.response.white
    ).all()
    return linear


def test_a_star_fades_in_the_air_as_rays_do_and_is_gone_behind_the_ground(leo_bench):
    stars = leo_bench.shown_stars
    star = int(np.flatnonzero(stars.hip == ALNILAM)[0])
    direction, whole = stars.vectors[star], stars.electrons_per_s[star]
    shares = []
    for height_rad in np.linspace(-0.02, 0.03, 40):
        place = above(direction, height_rad, np.array([0.0, 0.3, 1.0]))
        sprites = leo_bench.light(
            leo_bench.view(towards(direction), None, T_NS, np.zeros(3), place)
        )
        mine = sprites.data["electrons_per_s"][sprites.star == star].sum() / whole
        earth = Body(
            -place,
            EQUATOR_KM,
            POLAR_KM,
            np.array([0.0, 0.0, 1.0]),
            direction,
            lambert,
            1.0,
            (AIR.scale_km, AIR.depth),
        )
        _, through = traced(earth, direction[None])
        assert mine == pytest.approx(through[0], abs=AIR_LIMIT)
        shares.append(mine)
    assert shares[0] == 0.0
    assert shares[-1] > 0.995
    assert np.count_nonzero((np.array(shares) > 0.05) & (np.array(shares) < 0.95)) >= 5
    assert (np.diff(shares) >= 0).all()


def test_the_moon_sets_behind_the_earth(leo_bench):
    """Over the night side, so that nothing else has light there."""
    side = -body_direction(leo_bench, "Sun", np.array([0.0, 0.0, 7000.0]))
    first = body_direction(leo_bench, "Moon", np.array([0.0, 0.0, 7000.0]))
    shares = []
    for height_deg in (-2.0, 0.2, 3.0):
        place = above(first, np.radians(height_deg), side)
        moon = body_direction(leo_bench, "Moon", place)  # parallax, up to a degree
        place = above(moon, np.radians(height_deg), side)
        moon = body_direction(leo_bench, "Moon", place)
        picture = light_from(leo_bench, moon, place)
        listed = [
            disc.name
            for disc in leo_bench.discs(
                leo_bench.view(towards(moon), None, T_NS, np.zeros(3), place)
            )
        ]
        assert ("Moon" in listed) == (height_deg > 0)
        faces = {
            disc.name: disc
            for disc in leo_bench.moving.discs(moon, 0.0, 0.0, T_NS, np.zeros(3), place)
        }
        whole = faces["Moon"].normal_e_per_s_sr * faces["Moon"].law_integral_sr()
        y, x = np.mgrid[:240, :320]
        near = np.hypot(x - 159.5, y - 119.5) < 9  # the Moon is 9.5 px wide here
        shares.append(picture[near].sum() / whole)
    assert shares[0] < 1e-4
    assert 0.1 < shares[1] < 0.9
    assert shares[2] == pytest.approx(1.0, abs=FLUX_LIMIT)


def test_the_sun_at_the_limb_is_cut_by_it_and_all_stays_finite(leo_bench):
    sun = body_direction(leo_bench, "Sun", np.array([0.0, 0.0, 7000.0]))
    sums = [
        light_from(leo_bench, sun, above(sun, np.radians(h), np.array([0.3, 0.2, 1.0]))).sum()
        for h in (-3.0, -0.1, 0.1, 3.0)
    ]
    assert (np.diff(sums) > 0).all()
    assert sums[0] < 1e-6 * sums[-1]
    assert 0 < sums[1] < 0.6 * sums[-1]


def test_from_low_above_the_day_side_the_earth_fills_the_field(leo_bench):
    sun = body_direction(leo_bench, "Sun", np.array([0.0, 0.0, 7000.0]))
    place = (EQUATOR_KM + ALTITUDE_KM) * sun
    picture = light_from(leo_bench, -sun, place)
    assert (picture > leo_bench.flux_at_white_e_per_s).all()
    drawn = leo_bench.draw_sprites(
        leo_bench.light(leo_bench.view(towards(-sun), None, T_NS, np.zeros(3), place))
    )
    assert drawn.star_count == 0
    assert drawn.clipped_hip == ("Earth",)
