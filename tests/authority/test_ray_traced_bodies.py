"""The rays that the package's bodies are held to, themselves held to closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.ray_traced.bodies import (
    Body,
    columns,
    direct_columns,
    lambert,
    limb,
    lommel_seeliger,
    lunar_lambert,
    sunlit,
    traced,
)
from tests.support.ray_traced.image import edge_px, image, solid_angles, spread_image

RESOLUTION_PX, FOCAL_PX = (120, 100), 4e6
# Measured with 256 rays in each pixel that the limb or the terminator crosses, a disc 60 px wide.
FLUX, THIN_FLUX = 1e-3, 5e-3
# Measured: 0.021 of a limb spread by 0.85 px and a pixel; its curvature moves it by 0.013, sigma^2
# / 2R.
EDGE_PX = 0.03
COLUMN = 2e-5  # measured: 8e-6, of steps of 1 km
CLOSED_COLUMN = 4e-3  # measured: 3.4e-3, 30 km up: H / 2R a scale height
NORTH = np.array([0.2, -0.5, 0.8]) / np.linalg.norm([0.2, -0.5, 0.8])


def pinhole(x, y):
    """Rays (n, 3) of a camera whose axis is off the middle of the image."""
    return np.stack([(x - 50.0) / FOCAL_PX, (y - 47.0) / FOCAL_PX, np.ones_like(x)], axis=1)


def far_globe(law, phase_deg: float) -> Body:
    """A globe 60 px wide, 130 000 radii away, whose Sun is at a phase angle."""
    g = np.radians(phase_deg)
    away = np.array([0.3 / FOCAL_PX, -0.2 / FOCAL_PX, 1.0])
    side = np.cross(away, [0.3, 1.0, 0.1])
    sun = -np.cos(g) * away / np.linalg.norm(away) + np.sin(g) * side / np.linalg.norm(side)
    return Body(away * FOCAL_PX / 30, 1.0, 1.0, NORTH, sun, law)


def lambert_phase(g: float) -> float:
    return 2 / 3 * (np.sin(g) + (np.pi - g) * np.cos(g)) / np.pi


def lommel_seeliger_phase(g: float) -> float:
    return 1 - np.sin(g / 2) * np.tan(g / 2) * np.log(1 / np.tan(g / 4))


CLOSED = {
    lambert: lambert_phase,
    lommel_seeliger: lommel_seeliger_phase,
    sunlit: lambda g: (1 + np.cos(g)) / 2,
    lunar_lambert(0.6): lambda g: 0.6 * lommel_seeliger_phase(g) + 0.4 * lambert_phase(g),
}


@pytest.mark.parametrize("phase_deg", [1, 60, 135, 165])
def test_a_globe_has_the_phase_integral_of_its_law_and_the_area_of_its_crescent(phase_deg, rng):
    omega = np.pi * (30 / FOCAL_PX) ** 2
    for law, closed in CLOSED.items():
        flux = image(far_globe(law, phase_deg), pinhole, RESOLUTION_PX, rng, at_limb=16).sum()
        limit = FLUX if phase_deg < 150 else THIN_FLUX
        assert flux / omega == pytest.approx(closed(np.radians(phase_deg)), rel=limit)


def near_earth(height_km: float = 400.0) -> Body:
    """The Earth below, with air."""
    return Body(
        np.array([0, 0, 6378.137 + height_km]),
        6378.137,
        6356.752,
        NORTH,
        np.array([1.0, 0, 0]),
        lambert,
        1.0,
        (8.0, 0.1),
    )


def test_rays_touch_the_limb_and_nothing_beyond_it():
    earth = near_earth()
    touching, axis = limb(earth, 100), np.array([0, 0, 1.0])
    outward = touching - axis * (touching @ axis)[:, None]
    airless = replace(earth, air=None)
    assert not traced(airless, touching - 1e-9 * outward)[1].any()
    assert traced(airless, touching + 1e-9 * outward)[1].all()
    # the angle whose sine is the radius by the distance, between those of its axes
    angle = np.arctan2(np.hypot(*touching[:, :2].T), touching[:, 2])
    assert (
        np.arcsin(6356.752 / 6778.137) < angle.min() < angle.max() < np.arcsin(6378.137 / 6778.137)
    )


def test_the_air_along_a_ray_is_its_integral_and_that_of_the_closed_form():
    earth = near_earth()
    rays = limb(earth, 50) + np.linspace(0.0, 0.02, 50)[:, None] * [1, 0, 0]
    rays = rays[traced(replace(earth, air=None), rays)[1] > 0]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    height, _, tau = columns(earth, rays)
    assert tau == pytest.approx(direct_columns(earth, rays), rel=COLUMN)
    assert tau == pytest.approx(
        0.1 * np.sqrt(2 * np.pi * 6378.137 / 8.0) * np.exp(-height / 8.0), rel=2 * CLOSED_COLUMN
    )


def test_an_edge_is_found_where_the_disc_ends_and_a_blur_keeps_place_and_flux(rng):
    body = far_globe(lambda mu0, mu: np.ones_like(mu), 0.0)
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    places = np.array([50.3, 46.8]) + 30 * outward
    seen = spread_image(body, pinhole, RESOLUTION_PX, (0.85, 0.85), rng)
    assert seen.sum() == pytest.approx(np.pi * (30 / FOCAL_PX) ** 2, rel=FLUX)
    assert np.abs(edge_px(seen, places, outward)).max() < EDGE_PX
    assert edge_px(seen, places + 0.5 * outward, outward) == pytest.approx(-0.5, abs=EDGE_PX)


def test_solid_angles_are_those_of_a_pinhole():
    y, x = (part.ravel().astype(float) for part in np.mgrid[:5, :5] * 1000.0)

    def wide(a, b):
        return np.stack([a / 2000.0, b / 2000.0, np.ones_like(a)], axis=1)

    assert solid_angles(wide, x, y) == pytest.approx(
        (1 + (x / 2000) ** 2 + (y / 2000) ** 2) ** -1.5 / 2000**2, rel=1e-8
    )
