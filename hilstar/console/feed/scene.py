"""What the page's process needs to draw over the picture: the bench's cameras, the stars, the whole sky."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.console.overlay import Marks
from hilstar.render.aids import AidLevels
from hilstar.sky.catalog import label_of


@dataclass(frozen=True, eq=False)
class Scene:
    """Plain arrays and small objects, which can be pickled.

    `hip` and `v_mag` (n,) are those of the bench's shown stars, `names` what those without a HIP number are called, by place,
    and `sky` is the answer of `GET /sky`. `aids_in_levels` says that levels have the operator's aids in them already.
    """

    marks: Marks
    hip: npt.NDArray[np.int32]
    v_mag: npt.NDArray[np.float32]
    names: dict[int, str]
    sky: dict[str, Any]
    aids: AidLevels
    aids_in_levels: bool

    def label(self, star: int) -> str:
        """What is written beside a star."""
        return self.names.get(star) or label_of(int(self.hip[star]))
