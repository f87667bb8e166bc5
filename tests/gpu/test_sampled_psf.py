"""A sampled PSF on a real OpenGL against NumPy: in light and in levels, by every way that a
frame is drawn.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.display.render.numpy_backend import NumpyBackend
from hilstar.display.render.reference import linear_image
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import srgb_response
from hilstar.optics.psf import SampledPsf
from hilstar.optics.sprites import FrameLight
from tests.support.psfs import airy, coma, sampled
from tests.support.stars import random_sprites

SIZE = (160, 120)
# float32 of a table's interpolation, in a pixel where a few stars meet, over the brightest star's
# flux. Measured: 2.1e-7.
PIXEL_LIMIT = 6e-7
COMA, AIRY = SampledPsf(sampled(coma(), 5, 7), 5), SampledPsf(sampled(airy(1.5), 4, 12), 4)


def sixty_stars(psf: SampledPsf) -> FrameLight:
    rng = np.random.default_rng(3)
    return random_sprites(60, rng, SIZE, psf.footprint_px, (3, 6.5), 8)


@pytest.mark.parametrize("psf", [COMA, AIRY], ids=["coma", "airy"])
@pytest.mark.parametrize("method", [None, "round", "dither", "exact", "temporal"])
def test_both_backends_draw_the_same_light_and_the_same_levels(psf, method):
    target = Target(SIZE, psf, None if method is None else srgb_response(8), 1e6, method or "round")
    oracle, sprites = NumpyBackend(target), sixty_stars(psf)
    with Renderer(target) as gl:
        for frame in range(2):
            gl.draw(sprites, frame)
            oracle.draw(sprites, frame)
        away = np.abs(gl.linear() - linear_image(sprites, SIZE, psf)).max()
        assert away < PIXEL_LIMIT * sprites.data["electrons_per_s"].max()
        if method is not None:
            assert np.array_equal(gl.levels(), oracle.levels())
            assert oracle.levels().any()
        assert gl.gl_error() == "GL_NO_ERROR"


def test_a_psf_that_is_no_gaussian_is_chosen_star_by_star_in_numpy():
    with Renderer(Target(SIZE, COMA, srgb_response(8), 1e6, "exact")) as gl:
        assert gl.path == "NumPy"


@pytest.mark.parametrize("bits", [8, None], ids=["beside codes", "alone"])
def test_renderers_of_one_context_keep_their_own_tables(bits):
    response = None if bits is None else srgb_response(bits)
    with Renderer(Target(SIZE, COMA, response, 1e6)) as first:
        other = Renderer(Target(SIZE, AIRY, response, 1e6), first.context)
        first.draw(sixty_stars(COMA))
        alone = first.linear().copy()
        first.draw(None)
        other.draw(sixty_stars(AIRY))
        other.linear()
        first.draw(sixty_stars(COMA))
        assert np.array_equal(first.linear(), alone)
