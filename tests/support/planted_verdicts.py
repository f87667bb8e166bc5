"""What `hilstar verify` would have measured, with stars that are planted: for tests of its verdict,
its summary and its charts by closed forms.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.display.calibration import load_calibration
from hilstar.instruments.verify.measure import GlowFit, MatchTally, Measured, Star
from hilstar.instruments.verify.verdict import DisplayErrors
from hilstar.optics.camera import Camera
from hilstar.server.bench.config import parse_config
from hilstar.server.bench.star_size import StarSize
from tests.support.benches import Tables, bench_text

FOCAL_PX = 2000.0
# 50 px from the middle to a corner
CAMERA = Camera((80, 60), FOCAL_PX, (39.5, 29.5), np.eye(3))
NARROW = StarSize(
    sigma_px=1.0,
    sky_sigma_px=0.55,
    sigma_ratio=1.6,
    limit=2.0,
    peak_loss_mag=1.1,
    shared_px=13.6,
    sky_shared_px=4.5,
    would_do=None,
)


def measured(tables: Tables | None = None, **changes: Any) -> Measured:
    """A measurement of the small bench with other keys; nothing is off, and no star was looked
    for. `changes` are fields of Measured.
    """
    base = Measured(
        field_count=2,
        tally=MatchTally(),
        config=parse_config(Path("bench.toml"), bench_text(tables or {})),
        camera=CAMERA,
        glow=GlowFit(5.0, 5.0, 1.0),
        calibration=load_calibration("srgb", 8),
        true_calibration=None,
        gl_renderer="CPU",
        wide_bodies=[],
        star=NARROW,
        stars_a_field=3.0,
    )
    return replace(base, **changes)


def star(**errors: float) -> Star:
    """A star of V = 4 at (10, 20) px without an error but those that are given."""
    exact: dict[str, Any] = {
        "hip": 1, "v_mag": 4.0, "x_px": 10.0, "y_px": 20.0, "flux_mag": 0.0, "dx_px": 0.0,
        "dy_px": 0.0, "codes_mag": 0.0, "codes_px": 0.0, "floor_mag": 0.0, "floor_px": 0.0,
    }  # fmt: skip
    return Star(**(exact | errors))


def lost_star() -> Star:
    """One that the codes alone lose, too."""
    return star(codes_mag=math.nan, codes_px=math.nan)


def display_errors(stars: list[Star], **changes: Any) -> DisplayErrors:
    """Errors of stars from which their common zero point is taken already; none is lost."""
    return replace(DisplayErrors(stars, [], 0.0, 0.0, None), **changes)
