"""Where the monitor stands before the tracker: its pixels on the tracker's detector, and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hilstar.arrays import FloatArray
from hilstar.scene.camera import Camera

Mirror = Literal["none", "x", "y", "swap"]


@dataclass(frozen=True, slots=True)
class BenchGeometry:
    """Where the monitor stands before the tracker: `monitor` maps cam to its pixels, `tracker` maps cam to the detector's.

    `mirror` is what the screen does to its image, about the middle: columns reversed, rows reversed, or axes swapped.
    """

    monitor: Camera
    tracker: Camera
    mirror: Mirror = "none"

    def to_tracker(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Tracker pixels of monitor pixels, (n,) each; NaN behind the tracker."""
        return self.tracker.project(self.monitor.rays(*self._shown_at(x_px, y_px)) @ self.tracker.cam_to_image.T)

    def to_monitor(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Monitor pixels that tracker pixels see, (n,) each, without the mirror; NaN behind the monitor."""
        return self.monitor.project(self.tracker.rays(x_px, y_px) @ self.monitor.cam_to_image.T)

    def _shown_at(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        width, height = self.monitor.resolution_px
        middle_x, middle_y = (width - 1) / 2, (height - 1) / 2
        match self.mirror:
            case "x":
                return 2 * middle_x - x_px, y_px
            case "y":
                return x_px, 2 * middle_y - y_px
            case "swap":
                return middle_x + (y_px - middle_y), middle_y + (x_px - middle_x)
            case _:
                return x_px, y_px
