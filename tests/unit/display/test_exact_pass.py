"""In which order stars go through the pass of `exact`."""

from __future__ import annotations

import numpy as np

from hilstar.display.render.exact_pass import turns_of

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
