"""Charts that a study has written are not blank."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image


def assert_drawn(path: Path) -> None:
    """A picture with more than a frame in it."""
    pixels = np.array(Image.open(path).convert("L"))
    assert pixels.shape[0] > 300
    assert ((pixels < 200).mean() > 0.005) and ((pixels > 250).mean() > 0.1)
