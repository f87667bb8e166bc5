"""A frame on the GPU, whose levels are read back when they are asked for."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

from hilstar.basics.arrays import FloatArray
from hilstar.display.render.backend import Backend
from hilstar.display.response import Levels
from hilstar.optics.sprites import (
    FrameLight,
)


class Drawn:
    """A frame on the GPU: its sprites (None: blank), and what is too bright for the monitor, by
    HIP number or a body's name.

    Pickled, it has a copy of its levels: pickle it before the next draw.

    >>> with hilstar.load("bench.toml") as bench:
    ...     drawn = bench.draw([0.6987226, 0.7135120, -0.0370377, 0.0362700])
    >>> drawn.levels.shape, drawn.clipped_hip
    ((1080, 1920), ())
    """

    def __init__(
        self, renderer: Backend, sprites: FrameLight | None, clipped_hip: tuple[int | str, ...] = ()
    ) -> None:
        self.sprites = sprites
        self.clipped_hip = clipped_hip
        self.star_count = 0 if sprites is None else sprites.star_count
        self._renderer: Backend | None = renderer

    @property
    def capped(self) -> int:
        """How many stars' paths are coarser than they should be (see `scene.frame_motion`)."""
        return 0 if self.sprites is None else self.sprites.capped

    @property
    def rate_cam_rad_s(self) -> FloatArray | None:
        """The turn along which the stars' paths were drawn (3,), cam components; None where they
        are points.
        """
        if self.sprites is None:
            return None
        return self.sprites.rate_cam_rad_s

    @cached_property
    def levels(self) -> Levels:
        """The levels (see `Bench.code_values`), read back when they are first asked for; the
        next draw overwrites them.
        """
        if self._renderer is None:
            raise AssertionError("a pickled frame has its levels")
        return self._renderer.levels()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"levels": self.levels.copy(), "_renderer": None}

    def __repr__(self) -> str:
        if self.sprites is None:
            return "<hilstar drawn frame: blank>"
        text = f"<hilstar drawn frame: {self.star_count} stars, {len(self.clipped_hip)} clipped"
        if self.rate_cam_rad_s is not None:
            turn_deg_s = math.degrees(math.hypot(*self.rate_cam_rad_s))
            text += f", drawn along a turn of {turn_deg_s:.3g} deg/s"
        return f"{text}>"
