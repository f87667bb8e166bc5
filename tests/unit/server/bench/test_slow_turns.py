"""Which turns a frame shows as motion, and where it shows the sky of a slower one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.rotation import from_rotation_vector
from hilstar.server.bench.frame import Bench

HOLD_S, LONGEST_S, PX_PER_RAD, LEAST_PX = 0.012, 0.016, 1000.0, 0.05
SLOWEST_RAD_S = LEAST_PX / (LONGEST_S * PX_PER_RAD)


@pytest.mark.parametrize(
    ("share", "moves"), [(0.0, True), (0.2, False), (0.99, False), (1.01, True)]
)
def test_a_turn_under_the_limit_stands_still_where_it_is_in_the_middle_of_its_light(share, moves):
    bench = SimpleNamespace(
        scan=SimpleNamespace(longest_s=LONGEST_S, hold_s=HOLD_S),
        config=SimpleNamespace(render=SimpleNamespace(motion_above_px=LEAST_PX)),
        _px_per_rad=PX_PER_RAD,
    )
    rate = np.array([0.0, share * SLOWEST_RAD_S, 0.0])
    view = Bench.view(bench, np.array([1.0, 0.0, 0.0, 0.0]), rate)
    turned_rad = np.zeros(3) if moves else -rate * HOLD_S / 2
    assert view.q_icrs_to_cam == pytest.approx(from_rotation_vector(turned_rad), abs=1e-12)
    assert view.rate_cam_rad_s.tolist() == (rate.tolist() if moves else [0.0, 0.0, 0.0])
