"""In which order stars go through the pass of `exact`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from hilstar.display.footprints import REACH_SIGMA
from hilstar.display.render.exact_pass import OVERRATED, overrated, stretches_of, turns_of

STARS = 1000  # in three runs
STEP_E_PER_S = 3.0


def test_stars_go_in_runs_of_neighbours_and_within_a_run_by_light(rng):
    light = (STEP_E_PER_S * 2.0 ** rng.uniform(0.1, 15.0, STARS)).astype(np.float32)
    turns = turns_of(light, STEP_E_PER_S)
    run = turns * 3 // STARS
    assert np.array_equal(np.sort(turns), np.arange(STARS))
    assert (np.diff(run) >= 0).all()
    # to half an octave, whose stars keep their order
    half_octave = np.log2(light[turns] / STEP_E_PER_S) * 2
    assert (np.diff(half_octave)[np.diff(run) == 0] > -1.5).all()


def test_stars_far_over_and_far_under_a_step_stay_in_their_own_run():
    """A hundred magnitudes of light: beyond 16 octaves all are alike, and go as they came."""
    light = np.ones(STARS, dtype=np.float32)
    light[[10, 400, 900]] = 1e20
    light[[20, 500, 800]] = 1e-20
    turns = turns_of(light, 1.0)
    assert (np.diff(turns * 3 // STARS) >= 0).all()
    assert turns[[0, 333, 334]].tolist() == [0, 10, 334]
    assert len(turns_of(light[:0], 1.0)) == 0
    assert turns_of(light[:3], 1.0).tolist() == [0, 1, 2]


def test_a_path_s_stretches_are_of_32_sprites_and_end_where_it_ends():
    star = np.repeat([5, 2, 9, 5], [70, 32, 1, 33])
    assert stretches_of(star).tolist() == [
        [0, 32, 0, 70],
        [32, 64, 0, 70],
        [64, 70, 0, 70],
        [70, 102, 70, 102],
        [102, 103, 102, 103],
        [103, 135, 103, 136],
        [135, 136, 103, 136],
    ]


@pytest.mark.parametrize("width_px", [(0.8, 1.0), (1.3, 0.76), (0.9, 0.9)])
def test_no_pixel_within_reach_of_a_path_is_taken_for_brighter_than_is_allowed_for(width_px):
    """A Gaussian of sigma and pixel together over the light in the pixel, at places of a grid; of
    narrow stars the light itself is taken.
    """
    wide = np.hypot(width_px, 12**-0.5)
    away = np.linspace(0, REACH_SIGMA, 300)
    ratios = []
    for sigma, both in zip(width_px, wide, strict=True):
        at = away * both
        light = (erf((at + 0.5) / sigma / 2**0.5) - erf((at - 0.5) / sigma / 2**0.5)) / 2
        ratios.append(np.exp(-(away**2) / 2) / (np.sqrt(2 * np.pi) * both * light))
    both_axes = np.outer(*ratios)
    is_near = np.hypot.outer(away, away) <= REACH_SIGMA
    largest = both_axes[is_near].max()
    assert largest <= overrated(width_px) <= 1.01 * largest
    assert overrated((0.7, 2.0)) == OVERRATED
