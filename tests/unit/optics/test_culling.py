"""Only the stars near the image are turned and projected, and none that is on it is lost; who
clips is asked near by.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.rotation import normalise, to_matrix
from hilstar.display.geometry import monitor_camera
from hilstar.optics import sprites as sprites_module
from hilstar.optics.camera import Camera
from hilstar.optics.psf import GaussianPsf, pixel_shares
from hilstar.optics.sprites import CLIP_TOLERANCE, clipped_sprites, make_sprites, pack_sprites
from hilstar.sky.stars import cell_grid
from tests.support.stars import stars_at

IDENTITY = np.array([1.0, 0, 0, 0])
SIGMA = (0.85, 0.85)
FOOTPRINT = GaussianPsf(SIGMA).footprint_px
SIZE = (1920, 1080)
STARS = 30_000
# a twentieth of light: stars are seen up to 3 degrees away
FAST_KM_S = np.array([12_000.0, -9_000.0, 4_000.0])
COLUMNS = ("hip", "v_mag", "bv_mag", "temperature_k", "electrons_per_s", "row")


@pytest.fixture(scope="module")
def flat_sky():
    return stars_at(np.random.default_rng(3).normal(size=(STARS, 3)), np.ones(STARS))


def seen_by_all(stars, icrs_to_image: np.ndarray, camera: Camera) -> np.ndarray:
    """Every star whose footprint touches the image, by projecting all of them."""
    x_px, y_px = camera.project(stars.directions(np.arange(len(stars))) @ icrs_to_image.T)
    return pack_sprites(
        x_px, y_px, stars.electrons_per_s, np.arange(len(stars)), SIZE, FOOTPRINT
    ).star


def in_cells_of(stars, cell_deg: float):
    grid = cell_grid(stars.vectors, cell_deg)
    columns = {name: getattr(stars, name)[grid.order] for name in COLUMNS}
    return replace(stars, vectors=stars.vectors[grid.order], grid=grid, **columns)


@pytest.mark.parametrize("focal_mm", [2000.0, 350.0, 60.0, 12.0, 3.0])  # fields of 3 to 174 degrees
@pytest.mark.parametrize("cell_deg", [4.0, 45.0, 170.0])
def test_no_star_on_the_image_is_lost(flat_sky, focal_mm, cell_deg, rng):
    camera = monitor_camera(SIZE, 57.65, focal_mm, IDENTITY)
    stars = in_cells_of(flat_sky, cell_deg)
    for q in normalise(rng.normal(size=(6, 4))):
        for velocity in (None, FAST_KM_S):
            seen = stars.seen_at(velocity)
            found = make_sprites(seen, to_matrix(q), camera, FOOTPRINT).star
            assert np.array_equal(found, seen_by_all(seen, to_matrix(q), camera))


def test_the_sides_of_a_wide_image_are_left_out_of_its_circle(flat_sky, rng):
    """A circle around 16:9 has 1.85 times the image's area; with cells of 4 degrees about it,
    two thirds remain.
    """
    camera = monitor_camera(SIZE, 57.65, 200.0, IDENTITY)
    turn = to_matrix(normalise(rng.normal(size=4)))
    edges, radius_rad = camera.edges(6.0) @ turn, camera.field_radius_rad(6.0)
    circle, image = flat_sky.near(turn[2], radius_rad), flat_sky.near(turn[2], radius_rad, edges)
    assert np.isin(image, circle).all()
    assert len(image) < 0.75 * len(circle)


@pytest.mark.parametrize("middle_px", [(959.5, 539.5), (1200.0, 300.0), (-50.0, 700.0)])
@pytest.mark.parametrize("margin_px", [0.0, 6.0])
def test_the_field_s_radius_is_the_angle_to_the_farthest_corner(middle_px, margin_px):
    """Pixels' middles have whole numbers: the image ends half a pixel beyond them."""
    camera = Camera(SIZE, 2000.0, middle_px, np.eye(3))
    left = -0.5 - margin_px
    right, bottom = np.array(SIZE) - 0.5 + margin_px
    x_px, y_px = np.meshgrid([left, right], [left, bottom])
    corners = camera.rays(x_px.ravel(), y_px.ravel())
    cosines = corners[:, 2] / np.linalg.norm(corners, axis=1)
    assert camera.field_radius_rad(margin_px) == pytest.approx(np.arccos(cosines).max(), rel=1e-12)


def test_bodies_that_have_no_place_yet_are_not_found(flat_sky):
    nowhere = replace(flat_sky.grid, centre=np.full_like(flat_sky.grid.centre, np.nan))
    assert len(nowhere.near(np.array([0.0, 0.0, 1.0]), 1.0, np.eye(3))) == 0


def test_of_more_doubtful_stars_than_are_asked_the_brightest_are(monkeypatch):
    """Three pairs, each of which is over white together alone."""
    monkeypatch.setattr(sprites_module, "MAX_DOUBTFUL", 2)
    x = np.array([20.0, 20.0, 60.0, 60.0, 100.0, 100.0])
    light = np.array([0.6, 0.6, 0.9, 0.9, 0.7, 0.7]) / GaussianPsf(SIGMA).peak_share
    sprites = pack_sprites(x, np.full(6, 40.0), light, np.arange(6), (200, 120), FOOTPRINT)
    assert clipped_sprites(sprites, GaussianPsf(SIGMA), 1.0, (200, 120)).tolist() == [2, 3]


@pytest.mark.parametrize("count", [3, 450])
def test_a_crowd_clips_where_the_light_of_all_is_over_white(count, rng):
    """Asked of every star together, without looking for neighbours."""
    size = (200, 120)
    x, y = rng.uniform(-8, 207, count), rng.uniform(-8, 127, count)
    light = rng.uniform(0.3, 1.2, count) / GaussianPsf(SIGMA).peak_share
    sprites = pack_sprites(x, y, light, np.arange(count), size, FOOTPRINT)
    column, row = np.rint(sprites.x_px), np.rint(sprites.y_px)
    shares = [
        pixel_shares(place - own[:, None], SIGMA[0])
        for place, own in ((column, sprites.x_px), (row, sprites.y_px))
    ]
    total = sprites.data["electrons_per_s"] @ (shares[0] * shares[1])
    on_image = (column >= 0) & (column < size[0]) & (row >= 0) & (row < size[1])
    bright = sprites.data["electrons_per_s"] > 0.5 / GaussianPsf(SIGMA).peak_share
    over = total > 1 + CLIP_TOLERANCE
    sure = np.abs(total - 1) > 1e-5  # of white: footprints cut 1e-6 of a star
    clipped = np.isin(
        np.arange(len(sprites)), clipped_sprites(sprites, GaussianPsf(SIGMA), 1.0, size)
    )
    assert np.array_equal(clipped[sure], (over & on_image & bright)[sure])
