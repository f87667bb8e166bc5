"""The virtual tracker before frames of random attitudes, each lost in space: tetra3rs finds them."""

from __future__ import annotations

import numpy as np
import pytest

import hilstar
from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import NS_PER_S
from hilstar.cli.tracker import solver_of
from hilstar.instruments.simulate.live_exposure import LOST, LiveTracker
from tests.support.claims import holds
from tests.support.offline_loop import exposed_and_solved, off_arcsec, shown_frame

ATTITUDES = 50
APART_NS = 10 * NS_PER_S  # the attitude before is too old to predict by


def test_random_attitudes_of_the_demo_are_found(rng):
    pytest.importorskip("tetra3rs")
    path = resource_path("configs", "demo.toml")
    with hilstar.load(path) as bench, LiveTracker(bench.file, rng) as live:
        live.lost_in_space = solver_of("tetra3", live)
        found = 0
        for number in range(ATTITUDES):
            dec_deg = np.degrees(np.arcsin(rng.uniform(-1, 1)))
            q = from_radec_roll_deg(rng.uniform(0, 360), dec_deg, rng.uniform(0, 360))
            live.take(shown_frame(bench, number, number * APART_NS, q, np.zeros(3)))
            solved = exposed_and_solved(live, number * APART_NS)
            assert solved.mode == LOST
            if solved.identified is not None:
                found += 1
                x, y, z = off_arcsec(solved)
                holds("lost-across", np.hypot(x, y))
                holds("lost-about", abs(z))
        assert found == ATTITUDES
