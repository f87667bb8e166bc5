"""A disc in tiles is the disc drawn whole, ray by ray: near the limb, the terminator, through a
lens, and while it turns.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hilstar.display.render.extended_drawing as layer
from hilstar.basics.units import KM_PER_AU
from hilstar.display.quantise import dither_levels, round_levels
from hilstar.display.render.disc_tiles import (
    MIN_TILED_PX,
    SMOOTH,
    TILE_PX,
    _nodes_px,
    _rays,
    _runs,
    disc_tiles,
)
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import srgb_response
from hilstar.optics.camera import Camera, Lens
from hilstar.optics.extended import DiscLight, Shear
from hilstar.optics.psf import GaussianPsf
from hilstar.sky.bodies.disc import Disc
from hilstar.sky.bodies.earth_disc import earth_disc
from hilstar.sky.bodies.shapes import EQUATOR_KM
from tests.support.stars import sprites_at

SIZE, SIGMA = (300, 260), (0.85, 0.85)
MIDDLE_PX = (149.5, 129.5)
LENS = Lens(radial=(0.2, 0.05, 0.0), tangential=(1e-3, -2e-3))
TILE_LIMIT = 2 * SMOOTH  # straight lines in place of the face's light, along both axes
SLOPES = 1e-9  # of differences of places, px, over steps of 1e-5: rounding
assert SIZE[0] * SIZE[1] > MIN_TILED_PX


def looking(
    distance_km: float,
    focal_px: float,
    from_limb_deg: float,
    phase_deg: float,
    lens: Lens | None = None,
) -> DiscLight:
    aim = np.arcsin(EQUATOR_KM / distance_km) + np.radians(from_limb_deg)
    towards = np.array([0.3 * np.sin(aim), np.sqrt(1 - 0.09) * np.sin(aim), np.cos(aim)])
    side = np.array([0.5, -0.1, 1.0])
    side -= (side @ towards) * towards
    side /= np.linalg.norm(side)
    sun = -np.cos(np.radians(phase_deg)) * towards + np.sin(np.radians(phase_deg)) * side
    disc = earth_disc(distance_km * towards, -KM_PER_AU * sun, np.zeros(3), 1e5)
    return DiscLight(
        disc, np.eye(3), Camera(SIZE, focal_px, MIDDLE_PX, np.eye(3), lens), GaussianPsf(SIGMA)
    )


def moon_tiles(light: DiscLight, radius_px: float) -> DiscLight:
    """A Moon of that radius off the middle, three quarters of it lit."""
    ahead, sun = np.array([0.02, -0.01, 1.0]), np.array([0.8, 0.3, -0.5])
    far = 1 / np.sin(radius_px / light.camera.focal_length_px)
    face = Disc(
        "Moon",
        ahead / np.linalg.norm(ahead),
        far,
        1.0,
        1.0,
        np.array([0.0, 1.0, 0.0]),
        sun,
        "lunar-lambert",
        1e6,
        0.5,
    )
    return replace(light, disc=replace(face, sun=sun / np.linalg.norm(sun)))


TURN = Shear(np.array([0.02, 0.05, 0.1]), (0.0, 1e-4), MIDDLE_PX)
SCENES = {
    "low orbit, limb": looking(EQUATOR_KM + 400, 1500.0, -1.0, 60.0),
    "low orbit, full field": looking(EQUATOR_KM + 400, 1500.0, -30.0, 60.0),
    "low orbit, terminator": looking(EQUATOR_KM + 400, 400.0, -20.0, 105.0),
    "wide field": looking(EQUATOR_KM + 400, 150.0, -10.0, 60.0),
    "geostationary": looking(42_164.0, 800.0, -8.0, 50.0),
    "through a lens": looking(EQUATOR_KM + 400, 300.0, -5.0, 60.0, LENS),
    "turning": replace(looking(EQUATOR_KM + 400, 1500.0, -1.0, 60.0), shear=TURN),
    "a Moon of 110 px": moon_tiles(looking(42_164.0, 3000.0, -8.0, 50.0), 110.0),
    "a Moon of 3000 px": moon_tiles(looking(42_164.0, 60_000.0, -8.0, 50.0), 3000.0),
}


@pytest.mark.parametrize("name", SCENES)
def test_light_and_cover_are_those_of_the_disc_drawn_whole(gl, name, monkeypatch):
    light = SCENES[name]
    behind = replace(SCENES["low orbit, full field"], times=3.0)  # what is hidden
    none = sprites_at(np.empty((0, 2)), np.empty(0), gl.footprint_px)
    pictures = []
    for tiles in (disc_tiles, lambda *_: None):
        monkeypatch.setattr(layer, "disc_tiles", tiles)
        for lights in ((light,), (behind, light)):
            gl.draw(replace(none, extended=lights))
            pictures.append(gl.linear().astype(float))
    assert pictures[2].max() > 0
    for mine, whole in ((pictures[0], pictures[2]), (pictures[1], pictures[3])):
        assert np.abs(mine - whole).max() < TILE_LIMIT * whole.max()


@pytest.mark.parametrize("method", ["round", "dither", "exact"])
def test_tiles_without_a_linear_image_have_its_levels(method, rng):
    """Black, white and between, about sprites, the limb and the terminator; exact's stars are
    added to dither's levels.
    """
    with Renderer(Target(SIZE, GaussianPsf(SIGMA))) as whole:
        stars = sprites_at(
            rng.uniform(0, SIZE, (12, 2)), 10.0 ** rng.uniform(4, 6, 12), whole.footprint_px
        )
        for name, white_share in (
            ("low orbit, limb", 2e-3),
            ("low orbit, limb", 2.0),
            ("low orbit, terminator", 1e-2),
        ):
            light = SCENES[name]
            whole.draw(replace(stars, extended=(light,)))
            linear = whole.linear().copy()
            target = Target(
                SIZE,
                GaussianPsf(SIGMA),
                srgb_response(12),
                white_share * float(linear.max()),
                method,
            )
            with Renderer(target) as gl:
                for sprites in (stars, replace(stars, data=stars.data[:0], star=stars.star[:0])):
                    gl.draw(replace(sprites, extended=(light,)))
                    levels = gl.levels().copy()
                    wanted = (round_levels if method == "round" else dither_levels)(
                        gl.linear(), target.panel()
                    )
                    if method != "exact" or not len(sprites):
                        assert np.mean(levels != wanted) < 2e-4  # ties alone
                    assert np.abs(gl.linear() - linear).max() <= (
                        1e-6 * linear.max() if len(sprites) else stars.data["electrons_per_s"].max()
                    )
                gl.draw(stars)
                assert not (gl.levels() >= target.response.white).all()
                black = gl.levels().copy()
                gl.forget_images()
                gl.draw(stars)
                assert (gl.levels() == black).all()


def test_levels_are_sure_by_the_pixels_that_need_the_least_and_the_most_light():
    """Of an uneven panel black is sure below what lights the brightest one's first level, white above
    what the dimmest one's needs.
    """
    uniformity = np.ones(SIZE[::-1], dtype=np.float32)
    uniformity[3, 4], uniformity[5, 6] = 0.5, 1.25
    sure = []
    for each in (None, uniformity):
        target = Target(SIZE, GaussianPsf(SIGMA), srgb_response(8), 1000.0, "round", each)
        with Renderer(target) as gl:
            sure.append(gl._sure(gl._by_pixel, None))
    even, uneven = sure
    assert even.white_e_per_s == 1000.0
    assert uneven.dark_e_per_s == pytest.approx(0.5 * even.dark_e_per_s)
    assert uneven.white_e_per_s == pytest.approx(1.25 * even.white_e_per_s)


def test_most_of_a_full_field_is_linear_and_what_lies_beside_a_limb_is_not_drawn():
    whole = (0, 0, *SIZE)
    full = disc_tiles(SCENES["low orbit, full field"], whole)
    assert full is not None
    assert len(full.face) > 10 * len(full.edges)
    beside = disc_tiles(looking(EQUATOR_KM + 400, 1500.0, 30.0, 60.0), whole)
    assert beside is not None
    assert beside.region[2:] == (0, 0)
    assert disc_tiles(SCENES["low orbit, full field"], (0, 0, 100, 100)) is None


@pytest.mark.parametrize("size_px", [1, TILE_PX, TILE_PX + 1, 1920])
def test_nodes_are_a_tile_apart_with_a_tile_beyond_both_ends(size_px):
    nodes = _nodes_px(size_px)
    assert (np.diff(nodes) == TILE_PX).all()
    assert nodes[0] == -TILE_PX
    assert size_px + TILE_PX <= nodes[-1] < size_px + 2 * TILE_PX


def test_a_place_in_pixels_edges_is_half_a_pixel_from_the_pixel_s_middle():
    """The first pixel's own edge is 0. A pixel at 45 degrees has cos^3 of the solid angle of
    one ahead.
    """
    focal_px = 100.0
    light = looking(20_000.0, focal_px, 0.0, 0.0)
    x_px, y_px = np.array(MIDDLE_PX) + 0.5
    rays, pixel_sr = _rays(light, np.array([[x_px, y_px], [x_px + focal_px, y_px]]))
    assert rays == pytest.approx(np.array([[0, 0, 1], [1, 0, 1]]), abs=1e-12)
    assert pixel_sr * focal_px**2 == pytest.approx([1, np.sqrt(0.5) ** 3], rel=SLOPES)


def test_runs_cover_each_tile_once_and_nothing_else(rng):
    """Rows that differ, that are equal and next to each other, and equal ones with another row
    between them.
    """
    tiles = rng.random((12, 7)) < 0.5
    tiles[3:6] = tiles[2]
    tiles[8] = False
    tiles[9] = tiles[7] = [False, True, True, True, False, True, False]
    x, y = 10 * np.arange(8), 100 * np.arange(13)
    covered = np.zeros_like(tiles, dtype=int)
    rectangles = _runs(x, y, tiles).reshape(-1, 6, 6)[..., :2]  # two triangles' corners each
    for corners in rectangles:
        left, top = corners.min(axis=0) // (10, 100)
        right, bottom = corners.max(axis=0) // (10, 100)
        covered[int(top) : int(bottom), int(left) : int(right)] += 1
    assert (covered == tiles).all()
    whole = _runs(x, y, np.ones_like(tiles))
    assert len(whole) == 6
    assert whole.max(axis=0)[:2].tolist() == [70, 1200]
