"""Where the monitor stands before the tracker, and which pixels see which."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.optics.camera import Camera

Mirror = Literal["none", "x", "y", "swap"]
# of a glow or of places, whose dozen arrays would take 2 GB of a detector of 4096 x 4096 px
PIXELS_AT_ONCE = 500_000


@dataclass(frozen=True, slots=True)
class BenchGeometry:
    """Where the monitor stands before the tracker: `monitor` maps cam to its pixels, `tracker` maps
    cam to the detector's.

    `mirror` is what the screen does to its image, about the middle: columns reversed, rows
    reversed, or axes swapped.
    """

    monitor: Camera
    tracker: Camera
    mirror: Mirror = "none"

    def to_tracker(
        self, x_px: FloatArray, y_px: FloatArray, place_px: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[FloatArray, FloatArray]:
        """Tracker pixels of light at `place_px` from the middles of monitor pixels, (n,) each;
        NaN behind the tracker.
        """
        x_px, y_px = self.shown_at(x_px, y_px)
        rays = self.monitor.rays(x_px + place_px[0], y_px + place_px[1])
        return self.tracker.project(rays @ self.tracker.cam_to_image.T)

    def to_monitor(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Monitor pixels that tracker pixels see, (n,) each, without the mirror; NaN behind the
        monitor.
        """
        if np.size(x_px) <= PIXELS_AT_ONCE:
            return self._to_monitor(x_px, y_px)
        # A whole detector of 2048 x 2048 pixels at once takes 1 GB, mostly of intermediate values.
        seen_px = np.empty((2, len(x_px)))
        for begin in range(0, len(x_px), PIXELS_AT_ONCE):
            part = slice(begin, begin + PIXELS_AT_ONCE)
            seen_px[:, part] = self._to_monitor(x_px[part], y_px[part])
        return seen_px[0], seen_px[1]

    def _to_monitor(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `to_monitor`, of all pixels at once."""
        rays = self.tracker.rays(x_px, y_px)
        return self.monitor.project(rays @ self.monitor.cam_to_image.T)

    def shown_at(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The places at which the mirrored display shows pixels (n,) of the image."""
        width, height = self.monitor.resolution_px
        middle_x = (width - 1) / 2
        middle_y = (height - 1) / 2
        match self.mirror:
            case "x":
                return 2 * middle_x - x_px, y_px
            case "y":
                return x_px, 2 * middle_y - y_px
            case "swap":
                return middle_x + (y_px - middle_y), middle_y + (x_px - middle_x)
            case _:
                return x_px, y_px
