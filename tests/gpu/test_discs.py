"""Discs of bodies on the GPU against rays in float64: light, limb and air, through a lens, near
and far, small and vast.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.optics.camera import Camera, Lens
from hilstar.optics.extended import DiscView, LightMap, Pose, disc_lights
from hilstar.optics.psf import GaussianPsf
from hilstar.sky.bodies.disc import Air, Disc
from tests.support.claims import holds
from tests.support.ray_traced.bodies import Body, lambert, limb, lunar_lambert
from tests.support.ray_traced.image import edge_px, spread_image
from tests.support.stars import sprites_at

SIZE, SIGMA, FOCAL_PX = (64, 60), (0.85, 0.85), 3000.0
LENS = Lens(radial=(0.2, 0.05, 0.0), tangential=(1e-3, -2e-3))
SHARE = 0.6  # of Lommel-Seeliger
# The issue's: 1 % of the light and 0.1 px of the limb. Where light varies over less than a pixel, a
# crescent's horns, single pixels are within 3 % of the brightest; the truth's own rays scatter by 1
# % there.
FLUX_LIMIT, PLACE_LIMIT_PX, PIXEL_LIMIT = 0.01, 0.1, 0.04
SUM_LIMIT = 0.004  # of the face's integral: measured 0.26 % at 140 degrees
EARTH_KM, AIR = 6378.137, (8.0, 0.097)


def drawn_discs(gl, *lights) -> np.ndarray:
    none = sprites_at(np.empty((0, 2)), np.empty(0), gl.footprint_px)
    gl.draw(replace(none, extended=tuple(lights)))
    return gl.linear().astype(float)


def lights(disc: Disc, cam: Camera, covers: bool = False):
    return disc_lights(disc, DiscView(cam, GaussianPsf(SIGMA), (Pose(np.eye(3)),)), covers)


def long_camera(focal_px: float = FOCAL_PX, lens: Lens | None = None) -> Camera:
    return Camera(SIZE, focal_px, (31.5, 29.5), np.eye(3), lens)


def towards(x_px: float, y_px: float, cam: Camera) -> np.ndarray:
    seen = cam.rays(np.array([x_px]), np.array([y_px]))[0]
    return seen / np.linalg.norm(seen)


def sun_from(direction: np.ndarray, phase_deg: float) -> np.ndarray:
    side = np.cross(direction, [0.3, 1.0, 0.2])
    side /= np.linalg.norm(side)
    return -np.cos(np.radians(phase_deg)) * direction + np.sin(np.radians(phase_deg)) * side


def moon_disc(radius_px: float, phase_deg: float, cam: Camera, polar: float = 1.0) -> Disc:
    direction = towards(30.3, 31.9, cam)
    pole, sun = np.array([0.6, 0.8, 0.0]), sun_from(direction, phase_deg)
    distance = 1 / np.sin(radius_px / cam.focal_length_px)
    return Disc("Moon", direction, distance, 1.0, polar, pole, sun, "lunar-lambert", 1e9, SHARE)


def body_of(disc: Disc) -> Body:
    law = lunar_lambert(disc.lunar_share) if disc.law == "lunar-lambert" else lambert
    air = None if disc.air is None else (disc.air.scale_km, disc.air.depth)
    centre = disc.distance_km * disc.direction
    return Body(
        centre,
        disc.equator_km,
        disc.polar_km,
        disc.pole,
        disc.sun,
        law,
        disc.normal_e_per_s_sr,
        air,
    )


def limb_off_px(
    disc: Disc, cam: Camera, got: np.ndarray, truth: np.ndarray, lit_above: float = 0.3
) -> np.ndarray:
    """How far outward of the truth's an image has the limb, all round where the Sun shines on
    it.
    """
    on = limb(body_of(disc), 72)
    across = on - (on @ disc.direction)[:, None] * disc.direction
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    x, y = cam.project(on)
    beyond_x, beyond_y = cam.project(on + 1e-4 * across)
    outward = np.stack([beyond_x - x, beyond_y - y], axis=1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    inside = (
        np.isfinite(x)
        & (np.abs(x - 31.5) < 25)
        & (np.abs(y - 29.5) < 23)
        & (across @ disc.sun > lit_above)
    )
    places = np.stack([x, y], axis=1)[inside]
    return edge_px(got, places, outward[inside]) - edge_px(truth, places, outward[inside])


def centroid_px(picture: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]]
    return np.array([(picture * x).sum(), (picture * y).sum()]) / picture.sum()


@pytest.mark.parametrize("radius_px", [14.0, 4.0])
@pytest.mark.parametrize("phase_deg", [0.0, 30.0, 60.0, 90.0, 120.0, 150.0])
def test_the_moon_s_light_and_limb_at_six_phases_are_those_of_rays(gl, rng, radius_px, phase_deg):
    cam = long_camera()
    disc = moon_disc(radius_px, phase_deg, cam)
    got = drawn_discs(gl, *lights(disc, cam))
    truth = spread_image(body_of(disc), cam.rays, SIZE, SIGMA, rng, finer=5)
    holds("disc-light", 100 * abs(got.sum() / truth.sum() - 1))
    assert got.sum() == pytest.approx(disc.law_integral_sr() * 1e9, rel=SUM_LIMIT)
    holds("disc-horns", 100 * np.abs(got - truth).max() / truth.max())
    assert np.abs(centroid_px(got) - centroid_px(truth)).max() < PLACE_LIMIT_PX
    if phase_deg <= 90 and radius_px > 10:  # a crescent has no middle that its limb falls from
        off_px = limb_off_px(disc, cam, got, truth, 0.3 if phase_deg else -2.0)
        assert len(off_px) > 15
        holds("disc-limb", np.abs(off_px).max())


@pytest.mark.parametrize("polar", [1.0, 0.9], ids=["sphere", "Saturn's flattening"])
def test_a_disc_through_a_lens_is_where_the_lens_has_it(gl, rng, polar):
    cam = long_camera(100.0, LENS)  # the corner is 0.4 of tangent off: the lens moves it by 1 px
    disc = moon_disc(14.0, 50.0, cam, polar)
    got = drawn_discs(gl, *lights(disc, cam))
    truth = spread_image(body_of(disc), cam.rays, SIZE, SIGMA, rng)
    assert got.sum() == pytest.approx(truth.sum(), rel=FLUX_LIMIT)
    off_px = limb_off_px(disc, cam, got, truth)
    assert len(off_px) > 15 and np.abs(off_px).max() < PLACE_LIMIT_PX
    plain = spread_image(body_of(disc), long_camera(100.0).rays, SIZE, SIGMA, rng)
    assert np.abs(limb_off_px(disc, cam, plain, truth)).max() > PLACE_LIMIT_PX  # the lens is seen


@pytest.mark.parametrize(
    ("altitude_km", "focal_px", "aim_deg", "lens"),
    [
        (400.0, 400.0, 2.0, None),
        (400.0, 200.0, 3.0, LENS),
        (400.0, 200.0, -40.0, None),
        (35_786.0, 250.0, -8.7, None),
    ],
    ids=["low orbit's limb", "through a lens", "fills the screen", "geostationary"],
)
def test_the_earth_and_its_air_are_those_of_rays(gl, rng, altitude_km, focal_px, aim_deg, lens):
    cam = long_camera(focal_px, lens)
    distance_km = EARTH_KM + altitude_km
    # of the centre below the boresight
    angle = np.arcsin(EARTH_KM / distance_km) + np.radians(aim_deg)
    direction = np.array([0.05, np.sin(angle), np.cos(angle)])
    direction /= np.linalg.norm(direction)
    sun = sun_from(direction, 30.0)
    pole = np.array([0.6, 0.0, 0.8])
    disc = Disc(
        "Earth",
        direction,
        distance_km,
        EARTH_KM,
        6356.752,
        pole,
        sun,
        "lambert",
        1e6,
        1.0,
        Air(*AIR),
    )
    (light,) = lights(disc, cam, covers=True)
    got = drawn_discs(gl, light)
    truth = spread_image(body_of(disc), cam.rays, SIZE, SIGMA, rng, finer=2)
    assert got.sum() == pytest.approx(truth.sum(), rel=FLUX_LIMIT)
    assert np.abs(got - truth).max() < FLUX_LIMIT * truth.max()
    # What the sky behind lets through: a map of 1 drawn before the disc.
    behind = LightMap(np.full(SIZE[::-1], 1e6 * truth.max(), dtype=np.float32))
    through = (drawn_discs(gl, behind, light) - got) / behind.image
    y, x = (part.ravel().astype(float) for part in np.mgrid[: SIZE[1], : SIZE[0]])
    wanted = disc.transmission(cam.rays(x, y)).reshape(SIZE[::-1])
    smooth = maximum_filter(wanted, 9) - minimum_filter(wanted, 9) < FLUX_LIMIT
    assert np.abs(through - wanted)[smooth].max() < FLUX_LIMIT and smooth.mean() > 0.1


@pytest.mark.parametrize("sigma_px", [(0.3, 3.5), (0.2, 0.2), (3.0, 3.0)])
def test_any_gaussian_keeps_a_disc_s_light_and_its_place(sigma_px):
    cam = long_camera()
    disc = moon_disc(4.8, 40.0, cam)
    view = DiscView(cam, GaussianPsf(sigma_px), (Pose(np.eye(3)),))
    with Renderer(Target(SIZE, GaussianPsf(sigma_px))) as gl:
        got = drawn_discs(gl, *disc_lights(disc, view, covers=True))
    # of the same middle
    truth = spread_image(
        body_of(disc), cam.rays, SIZE, (1.0, 1.0), np.random.default_rng(1), finer=5
    )
    assert got.sum() == pytest.approx(disc.law_integral_sr() * 1e9, rel=SUM_LIMIT)
    assert np.abs(centroid_px(got) - centroid_px(truth)).max() < PLACE_LIMIT_PX


def test_the_middle_of_a_small_disc_hides_all_that_is_behind_it():
    """The Sun behind a Moon is 1e9 times white: what is left of it would be bright."""
    (light,) = lights(moon_disc(6.0, 60.0, long_camera()), long_camera(), covers=True)
    y, x = np.indices(light.cover.shape)
    off_px = np.hypot(x + light.corner_px[0] - 30.3, y + light.corner_px[1] - 31.9)
    assert (light.cover[off_px < 2.5] == 1).all() and (off_px < 2.5).sum() > 15
    assert (light.cover[off_px > 10] < 1e-3).all()
    assert light.cover.sum() == pytest.approx(np.pi * 6.0**2, rel=0.01)
