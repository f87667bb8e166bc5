"""Stars that first light has seen on the screen."""

from __future__ import annotations

from typing import Any

import numpy as np

from hilstar.instruments.calibrate.first_light.seen_stars import StarsSeen


def stars_seen(**columns: Any) -> StarsSeen:
    """Stars in the middle of the screen, read to 0.01 mag and 0.01 px in one image, where no column
    says otherwise; as many as `residual_px` (n, 2) has.
    """
    count = len(columns["residual_px"])
    made: dict[str, Any] = {
        "hip": np.arange(count, dtype=np.int32),
        "place_px": np.zeros((count, 2)),
        "place_noise_px": np.full(count, 0.01),
        "dn": np.ones(count),
        "e_per_s": np.ones(count),
        "noise_mag": np.full(count, 0.01),
        "rounding_mag": np.zeros((count, 1)),
        "screen": np.zeros((count, 2)),
        "codes_mag": np.zeros(count),
        "lost": 0,
        "frames": 1,
        "images": (),
    }
    return StarsSeen(**made | columns)
