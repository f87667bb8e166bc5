"""The Earth from low orbits to the Moon on the GPU against rays in float64: its limb, its light
and its night.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.units import KM_PER_AU
from hilstar.optics.camera import Camera
from hilstar.optics.extended import DiscView, Pose, disc_lights
from hilstar.optics.psf import GaussianPsf
from hilstar.sky.bodies.disc import Disc
from hilstar.sky.bodies.earth_disc import AIR, earth_disc
from hilstar.sky.bodies.shapes import EQUATOR_KM
from tests.support.claims import holds
from tests.support.ray_traced.bodies import Body, lambert, limb
from tests.support.ray_traced.image import edge_px, spread_image
from tests.support.stars import sprites_at

SIZE, SIGMA = (48, 44), (0.85, 0.85)
MIDDLE_PX = (23.5, 21.5)
PIXEL_LIMIT = 0.01  # of the brightest


def drawn_earth(gl, disc: Disc, cam: Camera) -> np.ndarray:
    none = sprites_at(np.empty((0, 2)), np.empty(0), gl.footprint_px)
    gl.draw(
        replace(
            none,
            extended=tuple(
                disc_lights(disc, DiscView(cam, GaussianPsf(SIGMA), (Pose(np.eye(3)),)), True)
            ),
        )
    )
    return gl.linear().astype(float)


def scene(
    distance_km: float, focal_px: float, aim_rad: float, phase_deg: float
) -> tuple[Disc, Body, Camera]:
    """The Earth with its centre so far below the boresight, the Sun on the side of the limb in
    view.
    """
    cam = Camera(SIZE, focal_px, MIDDLE_PX, np.eye(3))
    towards = np.array(
        [0.3 * np.sin(aim_rad), np.sqrt(1 - 0.09) * np.sin(aim_rad), np.cos(aim_rad)]
    )
    side = np.array([0.2, -0.1, 1.0]) if aim_rad else np.array([1.0, 0.5, 0.0])
    side -= (side @ towards) * towards
    side /= np.linalg.norm(side)
    phase = np.radians(phase_deg)
    sun = -np.cos(phase) * towards + np.sin(phase) * side
    disc = earth_disc(distance_km * towards, -KM_PER_AU * sun, np.zeros(3), 1e5)
    body = Body(
        distance_km * towards,
        disc.equator_km,
        disc.polar_km,
        disc.pole,
        disc.sun,
        lambert,
        disc.normal_e_per_s_sr,
        (AIR.scale_km, AIR.depth),
    )
    return disc, body, cam


# Names, distances, focal lengths, aims from the limb (None: at the centre), phases
SCENES = {
    "400 km, its air in 8 px": (EQUATOR_KM + 400, 1000.0, 0.2, 40.0),
    "400 km, wide": (EQUATOR_KM + 400, 250.0, 2.0, 40.0),
    "1500 km": (EQUATOR_KM + 1500, 1200.0, 0.4, 70.0),
    "geostationary": (42_164.0, 80.0, None, 60.0),
    "geostationary limb": (42_164.0, 4000.0, 0.1, 60.0),
    "Moon": (384_400.0, 800.0, None, 45.0),
}


@pytest.mark.parametrize("name", SCENES)
def test_the_limb_and_the_light_are_those_of_rays(gl, rng, name):
    distance_km, focal_px, from_limb_deg, phase_deg = SCENES[name]
    aim = (
        0.0
        if from_limb_deg is None
        else np.arcsin(EQUATOR_KM / distance_km) + np.radians(from_limb_deg)
    )
    disc, body, cam = scene(distance_km, focal_px, aim, phase_deg)
    got, truth = drawn_earth(gl, disc, cam), spread_image(body, cam.rays, SIZE, SIGMA, rng, finer=2)
    holds("earth-light", 100 * abs(got.sum() / truth.sum() - 1))
    assert np.abs(got - truth).max() < PIXEL_LIMIT * truth.max()
    on = limb(body, 7200)
    across = on - (on @ disc.direction)[:, None] * disc.direction
    x_px, y_px = cam.project(on)
    there = cam.project(on + 1e-3 * across)
    outward = np.stack([there[0] - x_px, there[1] - y_px], axis=1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    inside = (
        np.isfinite(x_px) & (np.abs(x_px - MIDDLE_PX[0]) < 17) & (np.abs(y_px - MIDDLE_PX[1]) < 15)
    )
    inside &= across @ disc.sun > 0.3 * np.linalg.norm(across, axis=1)
    places = np.stack([x_px, y_px], axis=1)[inside]
    assert len(places) >= 15
    reach_px = 12.0 if "air" in name else 5.0
    off_px = edge_px(got, places, outward[inside], reach_px) - edge_px(
        truth, places, outward[inside], reach_px
    )
    holds("earth-limb", np.abs(off_px).max())


def test_from_within_its_shadow_the_night_side_fills_the_field_and_gives_no_light(gl):
    disc, _, cam = scene(EQUATOR_KM + 400, 100.0, 0.0, 175.0)
    assert not drawn_earth(gl, disc, cam).any()


@pytest.mark.parametrize("distance_km", [6000.0, EQUATOR_KM + 1.0, EQUATOR_KM + 400])
@pytest.mark.parametrize("focal_px", [20.0, 5000.0])
def test_an_earth_that_fills_the_field_is_smooth_and_finite(gl, distance_km, focal_px):
    disc, _, cam = scene(distance_km, focal_px, 0.0, 20.0)
    got = drawn_earth(gl, disc, cam)
    inner = got[8:-8, 8:-8]
    assert np.isfinite(got).all() and (inner > 0).all()
    assert np.abs(np.diff(inner)).max() < 0.1 * inner.max()
