"""`exact` by the compute pass where it might fail: within the same limits as its NumPy oracle,
and nearly its codes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.display.exact import ExactQuantiser
from hilstar.display.quantise import shown_light
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import srgb_response
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import pack_sprites
from tests.support.exact_scenes import (
    FRAMES,
    NARROW,
    SCENES,
    SIDE,
    STREAKS,
    TILE,
    USUAL,
    WHITE,
    assert_no_worse,
    assert_right_over_frames,
    assert_streaks_are_right,
    flux_of,
    single,
    uneven,
)

# Pixels that differ from the oracle's: of two choices that are as good it may take the other, and
# on 2 bits many are. Where stars lie over each other a pixel that is nobody's by half stays
# rounded, which in NumPy the brighter one chooses.
OTHER, OTHER_AMONG_NEIGHBOURS = 0.08, 0.35


def scene_target(scene, quantisation="exact"):
    return Target(
        (SIDE, SIDE),
        GaussianPsf(scene.sigma_px),
        scene.response,
        WHITE,
        quantisation,
        scene.uniformity,
    )


@pytest.mark.parametrize("name", SCENES)
def test_no_scene_is_worse_than_rounded_nor_other_than_the_oracle_s(name):
    scene = SCENES[name]()
    with Renderer(scene_target(scene)) as gl:
        gl.draw(scene.sprites)
        levels = gl.levels().copy()
        assert gl.gl_error() == "GL_NO_ERROR"
    assert levels.max() <= scene.response.white
    assert_no_worse(levels, name, scene)
    oracle = ExactQuantiser(scene.panel, (SIDE, SIDE), GaussianPsf(scene.sigma_px)).levels(
        scene.sprites
    )
    beside = "neighbour" in name or "apart" in name
    assert (levels != oracle).sum() <= (OTHER_AMONG_NEIGHBOURS if beside else OTHER) * (
        oracle > 0
    ).sum()
    assert np.abs(levels.astype(int) - oracle).max() <= 1


@pytest.mark.parametrize("name", STREAKS)
def test_streaks_are_as_right_where_they_might_fail(name):
    scene = STREAKS[name]()
    with Renderer(scene_target(scene)) as gl:
        gl.draw(scene.sprites)
        levels = gl.levels().copy()
        assert gl.gl_error() == "GL_NO_ERROR"
    assert_streaks_are_right(levels, scene)
    assert_streaks_are_right(
        ExactQuantiser(scene.panel, (SIDE, SIDE), GaussianPsf(scene.sigma_px)).levels(
            scene.sprites
        ),
        scene,
    )


HARDEST = (
    "half off, faint",
    "1 px apart",
    "sigma 0.3 px, half off",
    "uneven, half off",
    "clipped neighbour, near",
    "2 bits, linear",
)


@pytest.mark.parametrize("name", HARDEST)
def test_over_frames_no_scene_is_near_rounded_and_a_part_of_a_refresh_costs_nothing(name):
    scene, frames = SCENES[name](), []
    with Renderer(scene_target(scene, "temporal")) as gl:
        for number in range(FRAMES):
            gl.draw(scene.sprites, number)
            frames.append(shown_light(gl.levels(), scene.panel))
        assert gl.gl_error() == "GL_NO_ERROR"
    assert_right_over_frames(frames, scene)


@pytest.mark.parametrize("uniformity", [None, uneven()], ids=["even", "uneven"])
def test_no_stars_are_black_also_after_some(uniformity):
    scene = single(3, srgb_response(8), USUAL, uniformity)
    with Renderer(scene_target(scene)) as gl:
        for sprites, lit in ((None, False), (scene.sprites, True), (None, False)):
            gl.draw(sprites)
            assert (gl.levels().max() > 0) == lit
        assert gl.gl_error() == "GL_NO_ERROR"


PAIRS = 400


@pytest.mark.parametrize("sigma_px", [USUAL, NARROW])
def test_codes_of_moving_neighbours_do_not_depend_on_the_order_of_stars(sigma_px):
    """No pixel is two stars' own: threads that reach it in another order would choose another
    level.
    """
    rng, size = np.random.default_rng(7), 20 * TILE
    middle = rng.uniform(10, size - 10, (2, PAIRS))
    apart = rng.uniform(2, 7, PAIRS) * np.exp(1j * rng.uniform(0, 2 * np.pi, PAIRS)) / 2
    x, y = (
        np.stack([at - half, at + half], axis=1).ravel()
        for at, half in zip(middle, (apart.real, apart.imag), strict=True)
    )
    along = np.array([-0.15, 0.15])
    rates = np.repeat(flux_of(rng.uniform(2, 5, PAIRS), sigma_px), 2) * rng.uniform(
        0.97, 1.03, 2 * PAIRS
    )

    def paths(order):
        star = np.repeat(np.arange(len(order)), len(along))
        places = ((at[order][:, None] + along).ravel() for at in (x, y))
        sprites = pack_sprites(
            *places,
            np.repeat(rates[order] / 2, 2),
            star,
            (size, size),
            GaussianPsf(sigma_px).footprint_px,
        )
        return replace(sprites, per_star=len(along))

    found = []
    with Renderer(
        Target((size, size), GaussianPsf(sigma_px), srgb_response(8), WHITE, "exact")
    ) as gl:
        for order in (np.arange(2 * PAIRS), np.arange(2 * PAIRS)[::-1], rng.permutation(2 * PAIRS)):
            gl.draw(paths(order))
            found.append(gl.levels().copy())
    assert all(np.array_equal(found[0], other) for other in found[1:])
