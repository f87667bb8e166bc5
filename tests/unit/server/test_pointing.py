"""The brightest star in view, which a person compares with the simulator: of five stars."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from msgspec.structs import replace

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.server.bench.config import parse_config
from hilstar.server.pointing import pointing_text
from tests.support.benches import SMALL_BENCH
from tests.support.stars import stars_at

Q = from_radec_roll_deg(84.057, -1.2, 30.0)
# field of 8 by 4 degrees: half of it is 0.07 and 0.035 of the focal length
TRACKER = replace(
    parse_config(Path("bench.toml"), SMALL_BENCH).tracker,
    pixel_pitch_um=10.0,
    focal_length_mm=100.0,
    resolution_px=(1400, 700),
)


def told(places: dict[int, tuple[float, float, float]], v_mag: list[float]) -> str:
    """What is said of stars at places of the camera by their HIP numbers."""
    vectors = np.array(list(places.values())) @ to_matrix(Q)
    stars = stars_at(vectors, np.ones(len(places)), v_mag, list(places))
    return pointing_text(TRACKER, stars, Q)


# of no star of the catalogue, so that no name of one is told
OF_NO_CATALOGUE = 900_000


def test_the_brightest_star_is_one_before_the_tracker_and_within_its_field():
    near, wide, high, behind, unknown = (OF_NO_CATALOGUE + k for k in range(5))
    places = {
        near: (0.069, -0.034, 1.0),
        wide: (0.071, 0.0, 1.0),
        high: (0.0, -0.036, 1.0),
        behind: (0.01, 0.01, -1.0),
        unknown: (0.0, 0.0, 1.0),
    }
    text = told(places, [5.25, 1.0, 1.0, 1.0, np.nan])
    assert "points at RA 84.057, Dec -1.200, roll 30.000 deg" in text
    assert f"the brightest star in view is HIP {near}, V 5.25, in Orion" in text
    del places[near]
    assert told(places, [1.0, 1.0, 1.0, np.nan]).endswith(
        "in Orion, where the catalogue has no star in view"
    )
