"""The threshold mask that dithering tiles over the monitor."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from hilstar.arrays import Float32Array

MASK_FILE = Path(__file__).parent / "data" / "blue-noise.npy"  # by data/make_blue_noise.py


@lru_cache(maxsize=1)
def blue_noise() -> Float32Array:
    """Thresholds strictly between 0 and 1, float32 (64, 64): the middles of 4096 equal parts, each once."""
    ranks = np.load(MASK_FILE)
    mask = ((ranks + 0.5) / ranks.size).astype(np.float32)
    mask.setflags(write=False)
    return np.asarray(mask)
