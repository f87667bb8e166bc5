"""What the display itself costs an attitude: a screen that is turned from where it is taken to
be.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg, from_rotation_vector
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.assess.bench_effects import display_errors
from hilstar.server.bench.bench_file import bench_file_of
from tests.support.benches import TWIN, bench_text

TURN_ARCSEC = np.array([60.0, -40.0, 200.0])
# Codes of 10 bits move each of some ten stars, 107 arcsec to a pixel, by 0.02 px: a third of that
# is left of all together.
WITHIN_ARCSEC = np.array([2.0, 2.0, 40.0])


@pytest.mark.gpu
def test_a_turned_screen_turns_the_attitude_that_is_seen_on_it() -> None:
    """The screen at Q' shows the star at v where Q v is: a tracker sees it at Q'* Q v, and so
    reports that turn.
    """
    q_mon = from_rotation_vector(-TURN_ARCSEC / ARCSEC_PER_RAD)  # Q'* Q is the turn where Q is none
    text = bench_text(TWIN, {"verify": {"true_q_cam_to_mon": q_mon.tolist()}})
    attitudes = np.array(
        [from_radec_roll_deg(84.057, -1.2, 0.0), from_radec_roll_deg(82.0, 1.0, 40.0)]
    )
    found = display_errors(bench_file_of(Path("bench.toml"), text), attitudes)
    assert found.shape == (2, 3)
    assert (np.abs(found - TURN_ARCSEC) < WITHIN_ARCSEC).all()
