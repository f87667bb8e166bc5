"""`temporal` where it might fail: over exposures of six refreshes, and of six and a part, that begin at any phase."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.monitor.quantise import round_levels, shown_light
from hilstar.monitor.temporal import TemporalQuantiser
from tests.support.exact_scenes import SCENES, SIDE, errors_of, errors_of_light

FRAMES = 9
PHASES = (0.0, 0.3, 0.8, 1.5, 2.6)
# Of one frame of `round`, rms over phases and stars; measured 0.02 to 0.15 and 0.06 to 0.46, the most by stars of 0.3 px that
# the edge cuts in half.
OF_ROUND_MAG, OF_ROUND_PX = 0.2, 0.55
# An exposure of 6.3 refreshes has what two frames leave at each end and no more: measured 0.9 to 1.3 of one of six.
NO_BEAT = 1.4
ROUNDING = 2e-6  # mag and px, of float32


def over(refreshes, frames, scene):
    """Errors in light and place, rms over exposures of so many refreshes at each phase."""
    squares = []
    for begin in PHASES:
        number = np.arange(FRAMES)
        weights = np.maximum(np.minimum(number + 1, begin + refreshes) - np.maximum(number, begin), 0.0)
        assert weights.sum() == pytest.approx(refreshes)
        squares.append(np.square(errors_of_light(np.tensordot(weights, frames, 1) / refreshes, scene).rms()))
    return np.sqrt(np.mean(squares, axis=0))


@pytest.mark.parametrize("name", SCENES)
def test_no_scene_is_near_rounded_and_a_part_of_a_refresh_costs_nothing(name):
    scene = SCENES[name]()
    quantiser = TemporalQuantiser(scene.panel, (SIDE, SIDE), scene.sigma_px)
    frames = np.stack([shown_light(quantiser.levels(scene.sprites), scene.panel) for _ in range(FRAMES)])
    rounded = np.array(errors_of(round_levels(scene.linear.astype(np.float32), scene.panel), scene).rms())
    whole, more = over(6.0, frames, scene), over(6.3, frames, scene)
    assert np.isfinite(whole).all() and np.isfinite(more).all()
    assert (whole <= np.array([OF_ROUND_MAG, OF_ROUND_PX]) * rounded + ROUNDING).all()
    assert (more <= NO_BEAT * whole + ROUNDING).all()
