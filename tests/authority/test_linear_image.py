"""The linear image of a field beside GalSim's, star by star drawn by Fourier transforms."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.optics.psf import GaussianPsf
from tests.support.claims import holds
from tests.support.stars import sprites_at

SIZE_PX, SIGMA_PX, STARS, STAMP_PX = (640, 480), 0.85, 300, 17


def by_galsim(galsim, places, rates):
    """The image (height, width) with GalSim's usual parameters, added up in float64."""
    width, height = SIZE_PX
    image = galsim.ImageD(np.zeros((height, width)), xmin=0, ymin=0)
    star = galsim.Gaussian(sigma=SIGMA_PX)
    for (x_px, y_px), rate in zip(places, rates, strict=True):
        left, top = round(x_px) - STAMP_PX // 2, round(y_px) - STAMP_PX // 2
        stamp = galsim.BoundsI(left, left + STAMP_PX - 1, top, top + STAMP_PX - 1) & image.bounds
        place = galsim.PositionD(x_px, y_px)
        star.withFlux(rate).drawImage(
            image=image[stamp], scale=1.0, center=place, add_to_image=True
        )
    return image.array


def test_galsim_draws_the_same_stars(rng):
    galsim = pytest.importorskip("galsim")
    places = rng.uniform(STAMP_PX, np.array(SIZE_PX) - STAMP_PX, (STARS, 2))
    rates = 10.0 ** rng.uniform(2, 6, STARS)
    with Renderer(Target(SIZE_PX, GaussianPsf((SIGMA_PX, SIGMA_PX)))) as renderer:
        renderer.draw(sprites_at(places, rates, renderer.footprint_px))
        ours = renderer.linear().astype(np.float64)
    theirs = by_galsim(galsim, places, rates)
    holds("linear-galsim", np.abs(ours - theirs).max() / theirs.max())
