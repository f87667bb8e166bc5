"""`temporal` where it might fail: over exposures of six refreshes, and of six and a part, that
begin at any phase.
"""

from __future__ import annotations

import pytest

from hilstar.display.quantise import shown_light
from hilstar.display.temporal import TemporalQuantiser
from hilstar.optics.psf import GaussianPsf
from tests.support.exact_scenes import FRAMES, SCENES, SIDE, assert_right_over_frames


@pytest.mark.parametrize("name", SCENES)
def test_no_scene_is_near_rounded_and_a_part_of_a_refresh_costs_nothing(name):
    scene = SCENES[name]()
    quantiser = TemporalQuantiser(scene.panel, (SIDE, SIDE), GaussianPsf(scene.sigma_px))
    assert_right_over_frames(
        [shown_light(quantiser.levels(scene.sprites), scene.panel) for _ in range(FRAMES)], scene
    )
