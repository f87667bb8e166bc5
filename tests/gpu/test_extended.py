"""Light that is no star's: added, encoded and erased by every quantisation, and free where there
is none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.display.exact import ExactQuantiser
from hilstar.display.quantise import dither_levels, mask_turn, round_levels, shown_light
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import srgb_response
from hilstar.optics.camera import Camera, Lens
from hilstar.optics.extended import GlowLight, LightMap
from hilstar.optics.psf import GaussianPsf
from tests.support.stars import random_sprites, sprites_at

SIZE, SIGMA, WHITE = (256, 192), (0.85, 0.85), 1e6
CORNER, SHAPE = (70, 40), (60, 90)
LENS = Lens(radial=(0.2, 0.05, 0.0), tangential=(1e-3, -2e-3))
# One rounding of float32 for the product with `times`, one for the sum with a star's light.
FLOAT32 = 2 * np.finfo(np.float32).eps
# llvmpipe's pow is good to 2e-5.
GLOW_LIMIT = 1e-4
# Between nodes this strong lens is 0.01 px off; the glow falls by at most 3 of itself over its
# scale of 40 px.
GLOW_LENS_LIMIT = 0.01 * 3 / 40
# of a star's pixels: of two choices that are as good GL may take the other
# (tests/gpu/test_exact_scenes.py)
OTHER = 0.08


def short_camera(lens: Lens | None = None) -> Camera:
    return Camera(SIZE, 400.0, (127.5, 95.5), np.eye(3), lens)


def srgb_target(method, uniformity=None) -> Target:
    return Target(SIZE, GaussianPsf(SIGMA), srgb_response(10), WHITE, method, uniformity)


def map_of(rng, low=0.0, high=3e-3) -> LightMap:
    return LightMap((WHITE * rng.uniform(low, high, SHAPE)).astype(np.float32), CORNER, 2.0)


@pytest.mark.parametrize("method", ["round", "dither"])
def test_a_map_is_added_to_the_stars_encoded_whole_and_gone_in_the_next_frame(method, rng):
    target = srgb_target(method, rng.uniform(0.8, 1.2, SIZE[::-1]).astype(np.float32))
    panel = target.panel()
    oracle = {"round": round_levels, "dither": dither_levels}[method]
    with Renderer(target) as gl:
        plain, light = random_sprites(40, rng, SIZE, gl.footprint_px, (4, 6), -5), map_of(rng)
        gl.draw(plain, 3)
        alone, alone_levels = gl.linear().copy(), gl.levels().copy()
        gl.draw(replace(plain, extended=(light,)), 3)
        both = gl.linear().copy()
        wanted = alone.copy()
        wanted[40:100, 70:160] += 2 * light.image
        assert np.abs(both - wanted).max() <= FLOAT32 * wanted.max()
        assert np.mean(gl.levels() != oracle(both, panel)) < 1e-4  # ties alone
        gl.draw(plain, 3)
        assert (gl.linear() == alone).all() and (gl.levels() == alone_levels).all()
        gl.draw(replace(plain, extended=(LightMap(light.image, (400, 400)),)), 3)
        assert (gl.linear() == alone).all() and (gl.levels() == alone_levels).all()
        assert gl.gl_error() == "GL_NO_ERROR"


@pytest.mark.parametrize("uneven", [False, True])
def test_exact_adds_each_star_in_light_to_the_dithered_floor(rng, uneven):
    """A star's light is the difference to the floor's; without light of its own a floor is that
    of `dither`.
    """
    step_e = srgb_response(10).light[1] * WHITE
    target = srgb_target(
        "exact", rng.uniform(0.8, 1.2, SIZE[::-1]).astype(np.float32) if uneven else None
    )
    panel = target.panel()
    x, y = np.meshgrid(np.arange(20.0, 250, 30), np.arange(20.0, 180, 30))
    places = np.column_stack((x.ravel(), y.ravel())) + rng.uniform(-0.5, 0.5, (x.size, 2))
    light = LightMap(np.full(SIZE[::-1], 0.3 * step_e, dtype=np.float32))
    with Renderer(target) as gl:
        some = sprites_at(places, np.full(x.size, 200 * step_e), gl.footprint_px)
        gl.draw(some)
        plain = gl.levels().copy()
        gl.draw(replace(some, extended=(light,)))
        levels = gl.levels().astype(int)
        both = shown_light(gl.levels(), panel)
        assert np.allclose(
            gl.linear().sum(), 0.3 * step_e * light.image.size + 200 * step_e * x.size, rtol=1e-4
        )
        gl.draw(replace(some, data=some.data[:0], star=some.star[:0], extended=(light,)))
        floor = gl.levels().copy()
        assert (floor == dither_levels(light.image, panel)).mean() > 1 - 1e-4
        off = levels - ExactQuantiser(panel, SIZE, target.psf).levels(some, floor)
        assert np.abs(off).max() <= 1 and np.count_nonzero(off) <= OTHER * np.count_nonzero(plain)
        difference = both - shown_light(floor, panel)
        for px, py in np.rint(places).astype(int):
            # Half a step of light: the method's own limit where steps are equal, as all are on an
            # even panel.
            assert (
                abs(difference[py - 9 : py + 10, px - 9 : px + 10].sum() - 200 * step_e)
                < (1.2 if uneven else 0.6) * step_e
            )
        gl.draw(some)
        assert (gl.levels() == plain).all()


def test_a_floor_is_that_of_its_own_light(rng):
    """Of two lights in turn, `exact` shows each as if it were the first."""
    target = srgb_target("exact")
    panel = target.panel()
    with Renderer(target) as gl:
        none = sprites_at(np.empty((0, 2)), np.empty(0), gl.footprint_px)
        elsewhere = replace(map_of(rng, 3e-3, 6e-3), corner_px=(10, 110))
        for light in (map_of(rng), elsewhere):
            gl.draw(replace(none, extended=(light,)))
            # ties alone
            assert np.mean(gl.levels() != dither_levels(gl.linear(), panel)) < 1e-4


def test_temporal_s_floor_is_dithered_with_a_mask_that_turns(rng):
    target = srgb_target("temporal")
    panel, light = target.panel(), map_of(rng)
    with Renderer(target) as gl:
        few = random_sprites(40, rng, SIZE, gl.footprint_px, (4, 6), -5)
        none = replace(few, data=few.data[:0], star=few.star[:0], extended=(light,))
        shown = []
        for frame in range(4):
            gl.draw(none, frame)
            # ties alone
            assert (
                np.mean(gl.levels() != dither_levels(gl.linear(), panel, mask_turn(frame))) < 1e-4
            )
            shown.append(shown_light(gl.levels(), panel))
            gl.draw(replace(few, extended=(light,)), frame)
            assert (
                shown_light(gl.levels(), panel).sum()
                > shown[-1].sum() + 0.9 * few.data["electrons_per_s"].sum()
            )
        gl.draw(none, 9)
        error = [np.abs(image - gl.linear()).mean() for image in (shown[0], np.mean(shown, axis=0))]
        assert error[1] < error[0] / 3


@pytest.mark.parametrize("lens", [None, LENS], ids=["pinhole", "lens"])
def test_a_glow_has_its_profile_about_a_direction_on_and_off_the_image(lens):
    cam = short_camera(lens)
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    seen = cam.rays(x.ravel().astype(float), y.ravel().astype(float))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    with Renderer(Target(SIZE, GaussianPsf(SIGMA))) as gl:
        none = sprites_at(np.empty((0, 2)), np.empty(0), gl.footprint_px)
        for direction in ([0.1, -0.05, 0.99], [1.0, 0.2, -0.3]):
            towards = np.array(direction) / np.linalg.norm(direction)
            gl.draw(replace(none, extended=(GlowLight(towards, 5e4, 0.1, 3.0, cam),)))
            angle = np.arctan2(np.linalg.norm(np.cross(seen, towards), axis=1), seen @ towards)
            wanted = 5e4 * (1 + (angle / 0.1) ** 2) ** -1.5
            assert np.abs(gl.linear().ravel() / wanted - 1).max() < (
                GLOW_LIMIT if lens is None else GLOW_LENS_LIMIT
            )
