"""The linear image that a processor draws: that of rasterised sprites, the same bits each time,
safe to keep.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilstar.display.render import cpu_stars
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.render.variants import SplatVariant, VariantRenderer
from hilstar.optics.extended import LightMap
from hilstar.optics.psf import GaussianPsf
from tests.support.stars import random_sprites, sprites_at

SIZE, SIGMA = (256, 192), (0.85, 0.85)
DECADES = (1, 7)  # of light, electrons per second
# float32 shares of both ways are at most 1e-7 of a star's light off (scene/psf.py), and the sum of
# a few stars rounds.
WAYS_LIMIT = 1e-6
ROUNDING = 6e-8  # of float32, at each of the stars that meet in a pixel


pytestmark = pytest.mark.usefixtures("by_cpu")


class Rasterised(Renderer):
    MAY_USE_CPU = False


@pytest.fixture
def gl():
    with Renderer(Target(SIZE, GaussianPsf(SIGMA))) as renderer:
        assert renderer._cpu_image is not None
        yield renderer
        assert renderer.gl_error() == "GL_NO_ERROR"


@pytest.mark.parametrize("size", [SIZE, (255, 33), (7, 5), (640, 2)])
def test_frames_of_any_number_of_stars_follow_each_other(size, rng):
    """Few are made black one by one, more by a clear; few are one chunk, more several."""
    with (
        Renderer(Target(size, GaussianPsf(SIGMA))) as gl,
        Rasterised(Target(size, GaussianPsf(SIGMA))) as raster,
    ):
        assert raster._cpu_image is None
        for count in (3, 40, 2, 9000, 1, 300, 128, 129, 0, 40, 300, 131, 2, 0, 3):
            sprites = random_sprites(count, rng, size, gl.footprint_px, DECADES)
            gl.draw(sprites)
            raster.draw(sprites)
            meeting = count * gl.footprint_px**2 / (size[0] * size[1])
            limit = (WAYS_LIMIT + ROUNDING * meeting) * max(raster.linear().max(), 1.0)
            assert np.abs(gl.linear() - raster.linear()).max() <= limit
            assert np.array_equal(gl.linear() > 0, raster.linear() > 0)
        gl.draw(None)
        assert gl.linear().max() == 0
        assert gl.gl_error() == "GL_NO_ERROR"


def test_few_stars_on_a_large_image_are_made_black_without_a_clear(rng, monkeypatch):
    with (
        Renderer(Target((1024, 768), GaussianPsf(SIGMA))) as gl,
        Renderer(Target((1024, 768), GaussianPsf(SIGMA))) as fresh,
    ):
        monkeypatch.setattr(cpu_stars, "MAX_LISTED", 100.0)
        for count in (200, 150, 3, 2000, 100, 1, 400, 0):
            sprites = random_sprites(count, rng, (1024, 768), gl.footprint_px, DECADES)
            gl.draw(sprites)
            fresh.draw(None)
            fresh.draw(sprites)
            assert np.array_equal(gl.linear(), fresh.linear())


def test_the_same_stars_give_the_same_bits(gl, rng):
    """Thousands meet in each pixel, so that another order would round otherwise."""
    pixels = rng.uniform([100, 80], [110, 90], size=(9000, 2))
    sprites = sprites_at(pixels, 10.0 ** rng.uniform(1, 5, 9000), gl.footprint_px)
    gl.draw(sprites)
    once = gl.linear().copy()
    for _ in range(5):
        gl.draw(sprites)
        assert np.array_equal(gl.linear(), once)
    gl.draw(replace(sprites, data=sprites.data[::-1]))
    assert not np.array_equal(gl.linear(), once)  # or the test could not fail


@pytest.mark.parametrize("sigma", [SIGMA, (12.0, 12.0)])
def test_no_star_is_lost_where_many_stand_in_few_rows(sigma, rng):
    count = 30_000 if sigma == SIGMA else 700
    with Renderer(Target((512, 256), GaussianPsf(sigma))) as gl:
        pixels = rng.uniform([100, 122], [400, 124], size=(count, 2))
        gl.draw(sprites_at(pixels, np.ones(count), gl.footprint_px))
        assert gl.linear().sum(dtype=np.float64) == pytest.approx(count, rel=1e-5)


def test_extended_light_and_stars_alone_take_turns(gl, rng):
    light = LightMap(np.full((8, 9), 5.0, dtype=np.float32), (20, 30))
    some, other = (random_sprites(count, rng, SIZE, gl.footprint_px, DECADES) for count in (50, 60))
    with Rasterised(Target(SIZE, GaussianPsf(SIGMA))) as raster:
        for sprites in (
            some,
            replace(other, extended=(light,)),
            other,
            replace(some, extended=(light,)),
            some,
        ):
            gl.draw(sprites)
            raster.draw(sprites)
            assert np.abs(gl.linear() - raster.linear()).max() <= WAYS_LIMIT * raster.linear().max()


def test_the_image_outlives_its_renderer_and_cannot_be_written_to(rng):
    with Renderer(Target((1024, 768), GaussianPsf(SIGMA))) as gl:
        gl.draw(sprites_at(np.array([[500.0, 400.0]]), np.array([1e6]), gl.footprint_px))
        image = gl.linear()
    del gl
    with Renderer(Target((1024, 768), GaussianPsf(SIGMA))) as other:
        other.draw(random_sprites(100, rng, (1024, 768), other.footprint_px, DECADES))
    assert image.sum(dtype=np.float64) == pytest.approx(1e6, rel=1e-5)
    with pytest.raises(ValueError, match="read-only"):
        image[0, 0] = 1.0


def test_renderers_that_come_and_go_leave_no_memory_behind(rng):
    """Each has 8 MB that it writes to."""
    resident_mb = []
    for _ in range(16):
        with Renderer(Target((1920, 1080), GaussianPsf(SIGMA))) as gl:
            gl.draw(random_sprites(5000, rng, (1920, 1080), gl.footprint_px, DECADES))
            gl.draw(None)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        resident_mb.append(pages * 4096 / 1e6)
    assert resident_mb[-1] - resident_mb[5] < 40


def test_the_study_of_trade_offs_measures_the_rasterised_sprites():
    with VariantRenderer(Target(SIZE, GaussianPsf(SIGMA)), SplatVariant()) as gl:
        assert gl._cpu_image is None
