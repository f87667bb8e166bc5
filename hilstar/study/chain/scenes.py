"""Five scenes in a bench's own sky, each for what it asks of the chain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.frame import Bench
from hilstar.errors import InputError
from hilstar.rotation import normalise

FIELDS = 200
SEED = 1
ENOUGH = 0.5  # of an average field's stars, for the faint field


@dataclass(frozen=True, slots=True)
class Scene:
    """A field and how fast it is crossed, and why it is one of the five."""

    name: str
    why: str
    q_icrs_to_cam: FloatArray
    rate_deg_s: float = 0.0


def five_scenes(bench: Bench) -> tuple[Scene, ...]:
    """The scenes for a bench, by FIELDS random fields of its sky. Raises InputError where it has no stars."""
    fields = normalise(np.random.default_rng(SEED).normal(size=(FIELDS, 4)))
    seen = [bench.sprites(q).data["electrons_per_s"] for q in fields]
    counts = np.array([len(rates) for rates in seen])
    if not counts.any():
        raise InputError(f"{bench.file.path}: [sky] leaves no star that the monitor shows; write a larger faintest_v_mag")
    typical = float(np.median(counts[counts > 0]))
    average = fields[np.argmin(np.abs(counts - typical))]
    brightest = np.array([rates.max() if len(rates) >= ENOUGH * typical else np.inf for rates in seen])
    faint, dense = fields[np.argmin(brightest)], fields[np.argmax(counts)]
    return (
        Scene("average field", "what most frames are", average),
        Scene("dense field", "the most stars: time", dense),
        Scene("faint field", "no bright star: codes have the fewest steps", faint),
        Scene("1 deg/s", "a slow turn: prediction and paths begin to matter", average, 1.0),
        Scene("10 deg/s", "a fast slew: each star is a long path", average, 10.0),
    )
