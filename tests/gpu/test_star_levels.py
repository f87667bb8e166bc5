"""Frames drawn in whole units of light: the levels of the light within the stars' reach, in
whatever order and after whatever frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.display.quantise import round_levels
from hilstar.display.render.light_units import MAX_UNIT, WINGS
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import SpriteSide, Target
from hilstar.display.response import gamma_response, srgb_response
from hilstar.optics.extended import LightMap
from hilstar.optics.psf import GaussianPsf, pixel_shares
from tests.support.stars import random_sprites, sprites_at

SIZE, SIGMA, WHITE = (256, 192), (0.85, 0.85), 1e6
FOOTPRINT = GaussianPsf(SIGMA).footprint_px
PANELS = {
    "srgb6": srgb_response(6),
    "srgb8": srgb_response(8),
    "srgb10": srgb_response(10),
    "gamma8": gamma_response(8),
}
# Light is summed in float32 by the linear image, in whole units here: both round by that of what they sum,
# at most.
FLOAT32 = 1e-6
CUT = 1e-4  # of a star: what lies past a sprite two pixels smaller


def covering(sprites, size):
    """How many stars' footprints hold each pixel (height, width)."""
    count, side = np.zeros(size[::-1]), sprites.footprint_px
    for x, y in sprites.data["pixel"] - (side - 1) // 2:
        count[max(y, 0) : max(y + side, 0), max(x, 0) : max(x + side, 0)] += 1
    return count


@pytest.mark.parametrize("name", PANELS)
@pytest.mark.parametrize("uneven", [False, True], ids=["even", "uneven"])
@pytest.mark.parametrize("count", [0, 1, 150, 4000])
def test_levels_are_those_of_the_light_but_for_what_lies_beyond_reach(name, uneven, count, rng):
    response = PANELS[name]
    map_ = rng.uniform(0.8, 1.2, SIZE[::-1]).astype(np.float32) if uneven else None
    with Renderer(Target(SIZE, GaussianPsf(SIGMA), response, WHITE, uniformity=map_)) as gl:
        sprites = random_sprites(count, rng, SIZE, FOOTPRINT, (1, 6))
        gl.draw(sprites)
        found, whole, panel = gl.levels().copy(), gl.linear().astype(np.float64), gl.target.panel()
        assert gl.gl_error() == "GL_NO_ERROR"
    lit = response.threshold[0] * WHITE
    over = covering(sprites, SIZE)
    rounding = over * lit * MAX_UNIT + FLOAT32 * whole
    least = whole - over * lit / WINGS - rounding
    assert (found <= round_levels((whole + rounding).astype(np.float32), panel)).all()
    assert (found >= round_levels(np.maximum(least, 0).astype(np.float32), panel)).all()
    # Few pixels are near a threshold: the bounds above are wide, and most levels are the very same.
    assert np.count_nonzero(
        found != round_levels(whole.astype(np.float32), panel)
    ) <= 0.01 * np.count_nonzero(found)


def test_the_order_of_stars_changes_nothing(rng):
    with Renderer(Target(SIZE, GaussianPsf(SIGMA), PANELS["srgb10"], WHITE)) as gl:
        sprites = random_sprites(3000, rng, SIZE, FOOTPRINT, (1, 6))
        gl.draw(sprites)
        first = gl.levels().copy()
        for _ in range(3):
            order = rng.permutation(len(sprites))
            gl.draw(replace(sprites, data=sprites.data[order], star=sprites.star[order]))
            assert np.array_equal(gl.levels(), first)


@pytest.mark.parametrize("count", [1, 100, 20_000])
def test_no_sum_is_too_large_for_its_pixel(count):
    """Any number of stars far brighter than white, on one pixel."""
    with Renderer(Target(SIZE, GaussianPsf(SIGMA), PANELS["srgb8"], WHITE)) as gl:
        gl.draw(sprites_at(np.full((count, 2), 100.0), np.full(count, 1e12), gl.footprint_px))
        found = gl.levels()
        assert (found[97:104, 97:104] == 255).all()
        assert np.count_nonzero(found) <= gl.footprint_px**2


def test_where_units_are_too_coarse_the_light_is_as_fine(rng):
    """A panel of 16 bits, and on 8 bits so many stars of white that a unit would be much of a
    step: points are blended as they are, and on the CPU sums are of finer units.
    """
    bright = random_sprites(20_000, rng, SIZE, FOOTPRINT, (6, 7))
    for response, sprites in (
        (srgb_response(16), random_sprites(300, rng, SIZE, FOOTPRINT, (5, 7))),
        (gamma_response(8, 3.0), bright),
    ):
        target = Target(SIZE, GaussianPsf(SIGMA), response, WHITE)
        with Renderer(target) as gl:
            assert gl._units.unit_for(sprites) is None
            gl.draw(sprites)
            found, light = gl.levels().copy(), gl.linear()
            wanted = round_levels(light, target.panel())
            if gl.path == "points":
                assert np.array_equal(found, wanted)
                continue
            # wings and float32 aside; of 16 bits a level is finer than both
            assert np.abs(found.astype(int) - wanted).max() <= 1
            assert np.count_nonzero(found != wanted) <= 0.01 * np.count_nonzero(wanted)


@pytest.mark.parametrize("quantisation", ["round", "exact", "temporal"])
def test_frames_of_all_kinds_follow_each_other(quantisation, rng):
    """Stars, none, few and many, too many for units, and extended light: each frame is as if it
    were the first.
    """
    target = Target(SIZE, GaussianPsf(SIGMA), gamma_response(8), WHITE, quantisation)
    with Renderer(target) as gl:
        has_units = gl.path != "NumPy"  # without compute shaders, `exact` and `temporal`
    glow = LightMap(np.full((40, 50), 3e4, dtype=np.float32), (30, 20))
    few, many, bright = (
        random_sprites(9, rng, SIZE, FOOTPRINT, (1, 6)),
        random_sprites(600, rng, SIZE, FOOTPRINT, (1, 6)),
        # NumPy has no units for which there are too many, and takes a second for these
        random_sprites(20_000 if has_units else 1000, rng, SIZE, FOOTPRINT, (6, 7)),
    )
    lit = replace(few, extended=(glow,))
    frames = [
        few,
        many,
        few,
        bright,
        few,
        None,
        bright,
        many,
        lit,
        few,
        lit,
        bright,
        lit,
        None,
        few,
    ]
    with Renderer(target) as gl:
        if has_units:
            assert gl._units.unit_for(bright) is None
            assert gl._units.unit_for(many) is not None
        for place, sprites in enumerate(frames):
            gl.draw(sprites)
            found = gl.levels().copy()
            if place % 2:
                gl.linear()
            with Renderer(target) as fresh:
                fresh.draw(sprites)
                assert np.array_equal(found, fresh.levels()), place
        assert gl.gl_error() == "GL_NO_ERROR"


@pytest.mark.parametrize("sigma", [(0.3, 0.3), (0.4, 0.4), (0.85, 0.85), (1.3, 0.7), (3.0, 1.0)])
def test_no_pixel_outside_the_ellipse_has_more_than_its_share(sigma):
    size = GaussianPsf(sigma).footprint_px
    axes, factor = GaussianPsf(sigma).reach
    places = np.linspace(-size / 2, size / 2, 301)
    share = np.outer(pixel_shares(places, sigma[1]), pixel_shares(places, sigma[0]))
    reach = places[None, :] ** 2 / axes[0] + places[:, None] ** 2 / axes[1]
    for least in (1e-2, 1e-4, 1e-6):
        outside = reach > np.log(factor / least)
        assert share[outside].max() <= least
        # Nor is it much too large: what lies just inside has a good part of it.
        assert share[~outside].min() > 0.02 * least


def test_smaller_sprites_leave_out_no_more_than_they_say(rng):
    """Sides as `effort = "auto"` chooses them: a quarter of what lights a pixel, and nothing
    past the largest side.
    """
    response = PANELS["srgb8"]
    lit, size = response.threshold[0] * WHITE, GaussianPsf(SIGMA).footprint_px
    sides = (
        SpriteSide(3e38, size - 2),
        *(
            SpriteSide(0.25 * lit / GaussianPsf(SIGMA).outside_share(k), k)
            for k in range(size - 4, 1, -2)
        ),
    )
    with (
        Renderer(Target(SIZE, GaussianPsf(SIGMA), response, WHITE, sides=sides)) as gl,
        Renderer(Target(SIZE, GaussianPsf(SIGMA), response, WHITE)) as all_,
    ):
        sprites = random_sprites(400, rng, SIZE, FOOTPRINT, (1, 6))
        gl.draw(sprites)
        all_.draw(sprites)
        found, whole, panel = (
            gl.levels().copy(),
            all_.linear().astype(np.float64),
            gl.target.panel(),
        )
        assert np.count_nonzero(found) <= np.count_nonzero(all_.levels())
        alone = sprites_at(np.array([[100.0, 90.0]]), np.array([1e12]), size)
        gl.draw(alone)
        assert np.count_nonzero(gl.levels()) == (size - 2) ** 2
    wings = covering(sprites, SIZE) * 0.25 * lit + CUT * whole
    assert (found <= round_levels((whole * (1 + FLOAT32)).astype(np.float32), panel)).all()
    assert (
        found
        >= round_levels(np.maximum(whole * (1 - FLOAT32) - wings, 0).astype(np.float32), panel)
    ).all()


def test_the_largest_sprites_are_whole():
    target = Target((400, 300), GaussianPsf((25.0, 25.0)), PANELS["srgb8"], WHITE)
    with Renderer(target) as gl:
        gl.draw(sprites_at(np.array([[200.2, 150.3]]), np.array([1e9]), gl.footprint_px))
        found, light, panel = gl.levels().copy(), gl.linear(), gl.target.panel()
    assert np.count_nonzero(found != round_levels(light, panel)) <= 3
    assert np.count_nonzero(found) > 1000


@pytest.mark.parametrize("quantisation", ["round", "exact"])
def test_the_texture_that_a_window_shows_has_the_levels_in_memory(quantisation, rng):
    """Whatever context is current, and where an image's bytes fill no whole words."""
    size = (37, 29)
    with Renderer(
        Target(size, GaussianPsf(SIGMA), PANELS["srgb8"], WHITE, quantisation=quantisation)
    ) as gl:
        for count in (40, 400, 30):
            gl.draw(random_sprites(count, rng, size, FOOTPRINT, (4, 6)))
            levels, texture = gl.levels().copy(), gl.codes_texture
            with gl.context:
                shown = np.frombuffer(texture.read(alignment=1), dtype=np.uint8).reshape(size[::-1])
            assert (
                levels.any()
                and np.array_equal(shown, levels)
                and np.array_equal(gl.levels(), levels)
            )
