"""The brightest star in view, which a person compares with the simulator: of five stars."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.server.pointing import pointing_text

Q = from_radec_roll_deg(84.057, -1.2, 30.0)
# field of 8 by 4 degrees: half of it is 0.07 and 0.035 of the focal length
TRACKER = SimpleNamespace(pixel_pitch_um=10.0, focal_length_mm=100.0, resolution_px=(1400, 700))
CONFIG = SimpleNamespace(config=SimpleNamespace(tracker=TRACKER))


class Stars:
    """Stars at places of the camera, with the number of each for its name."""

    def __init__(self, places: dict[int, tuple[float, float, float]], v_mag: list[float]) -> None:
        vectors = np.array(list(places.values()), dtype=float)
        self.vectors = (vectors / np.linalg.norm(vectors, axis=1)[:, None]) @ to_matrix(Q)
        self.hip = np.array(list(places))
        self.v_mag = np.array(v_mag)
        self.bodies: tuple[object, ...] = ()

    def __len__(self) -> int:
        return len(self.hip)

    def designations(self, rows: np.ndarray) -> list[str]:
        return [f"star {self.hip[row]}" for row in rows]


def told(stars: Stars) -> str:
    return pointing_text(SimpleNamespace(config=CONFIG.config, stars=stars), Q)


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
    text = told(Stars(places, [5.25, 1.0, 1.0, 1.0, np.nan]))
    assert "points at RA 84.057, Dec -1.200, roll 30.000 deg" in text
    assert f"the brightest star in view is star {near}, V 5.25, in Orion" in text
    del places[near]
    assert told(Stars(places, [1.0, 1.0, 1.0, np.nan])).endswith(
        "in Orion, where the catalogue has no star in view"
    )
