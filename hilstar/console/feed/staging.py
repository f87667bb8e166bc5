"""Makes the page's scene of a bench, in the run's own process."""

from __future__ import annotations

import numpy as np

from hilstar.bench.frame import Bench
from hilstar.console.feed.scene import Scene
from hilstar.console.overlay import overlay_of
from hilstar.run.operator import aid_levels_of

MAX_NAMES = 5000  # of stars without a HIP number, the brightest


def scene_of(bench: Bench, aids_in_levels: bool) -> Scene:
    """The scene of a bench; `aids_in_levels` where the levels have the operator's aids in them already."""
    stars, overlay = bench.shown_stars, overlay_of(bench)
    unnamed = np.flatnonzero(stars.hip == 0)
    unnamed = unnamed[np.argsort(stars.v_mag[unnamed], kind="stable")[:MAX_NAMES]]
    return Scene(
        marks=overlay.marks,
        hip=stars.hip.copy(),
        v_mag=stars.v_mag.astype(np.float32),
        names={star: name for star, name in zip(unnamed.tolist(), stars.names(unnamed), strict=True) if name},
        sky=overlay.sky(),
        aids=aid_levels_of(bench),
        aids_in_levels=aids_in_levels,
    )
