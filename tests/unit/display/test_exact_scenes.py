"""`exact` where it might fail, in NumPy: at edges, among neighbours, narrow, on uneven, coarse
and fine panels, over white.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.display.exact import ExactQuantiser
from hilstar.display.quantise import round_levels
from hilstar.display.response import srgb_response
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import pack_sprites
from tests.support.exact_scenes import (
    SCENES,
    SIDE,
    USUAL,
    WHITE,
    assert_no_worse,
    family_of,
    single,
    uneven,
)

# Of `round`'s error, by the worst of seven centroiders; measured 0.27 to 0.92, and of a fit of the
# sprite's own PSF to stars narrower than a pixel, which then hangs on single pixels, 1.53.
FAMILY = {
    "sigma 0.3 px": 0.8,
    "sigma 0.3 px, faint": 1.7,
    "uneven": 0.35,
    "uneven, faint": 0.5,
    "2 bits": 0.6,
    "16 bits": 0.75,
}


@pytest.mark.parametrize("name", SCENES)
def test_no_scene_is_worse_than_rounded(name):
    scene = SCENES[name]()
    levels = ExactQuantiser(scene.panel, (SIDE, SIDE), GaussianPsf(scene.sigma_px)).levels(
        scene.sprites
    )
    assert levels.max() <= scene.response.white and levels.shape == (SIDE, SIDE)
    assert_no_worse(levels, name, scene)


@pytest.mark.parametrize("name", FAMILY)
def test_nor_by_any_centroider_but_one_that_fits_less_than_a_pixel(name):
    scene = SCENES[name]()
    levels = ExactQuantiser(scene.panel, (SIDE, SIDE), GaussianPsf(scene.sigma_px)).levels(
        scene.sprites
    )
    rounded = family_of(round_levels(scene.linear.astype(np.float32), scene.panel), scene)
    found = family_of(levels, scene)
    share = {who: found[who] / rounded[who] for who in found}
    worst = max(share, key=share.__getitem__)
    assert share[worst] <= FAMILY[name]
    assert share[worst] < 1 or worst == "PSF fit"


def test_all_over_white_is_white_where_it_is_and_no_more_beside():
    scene = SCENES["all clipped"]()
    levels = ExactQuantiser(scene.panel, (SIDE, SIDE), GaussianPsf(scene.sigma_px)).levels(
        scene.sprites
    )
    over = scene.linear >= WHITE
    assert over.sum() > 9 * len(scene.windows)
    assert (levels[over] == scene.response.white).all()
    assert (
        np.abs(levels - round_levels(scene.linear.astype(np.float32), scene.panel).astype(int)) <= 1
    ).all()


@pytest.mark.parametrize("uniformity", [None, uneven()], ids=["even", "uneven"])
def test_no_stars_are_black_also_after_some(uniformity):
    scene = single(3, srgb_response(8), uniformity=uniformity)
    quantiser = ExactQuantiser(scene.panel, (SIDE, SIDE), GaussianPsf(USUAL))
    none = pack_sprites(
        *np.zeros((3, 0)), np.zeros(0, dtype=np.intp), (SIDE, SIDE), GaussianPsf(USUAL).footprint_px
    )
    assert quantiser.levels(none).max() == 0
    assert quantiser.levels(scene.sprites).max() > 0
    assert quantiser.levels(none).max() == quantiser.levels(None).max() == 0
