"""Frames whose levels have been read back, as a frame is once it is unpickled."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hilstar.display.response import Levels
from hilstar.optics.sprites import SPRITE_DTYPE, FrameLight
from hilstar.server.bench.drawn import Drawn

FOOTPRINT_PX = 5


def drawn(
    levels: Levels, sprites: FrameLight | None = None, clipped_hip: tuple[int | str, ...] = ()
) -> Drawn:
    """A frame of these levels, stars and clipped ones."""
    frame = Drawn(None, sprites, clipped_hip)  # type: ignore[arg-type]
    frame.levels = levels
    return frame


def stars_at(
    x_px: npt.ArrayLike,
    y_px: npt.ArrayLike,
    star: npt.ArrayLike | None = None,
    rate_cam_rad_s: npt.NDArray[np.float64] | None = None,
) -> FrameLight:
    """Stars at places, each brighter than the one before; `star` are their places in `Stars`."""
    places_px = np.asarray(x_px, dtype=float), np.asarray(y_px, dtype=float)
    count = len(places_px[0])
    data = np.zeros(count, SPRITE_DTYPE)
    data["electrons_per_s"] = 5.0 + np.arange(count)
    rows = np.arange(count) if star is None else np.asarray(star)
    return FrameLight(data, FOOTPRINT_PX, rows, *places_px, rate_cam_rad_s=rate_cam_rad_s)
