"""The monitor behind its collimator, as the camera that the tracker looks into."""

from __future__ import annotations

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.rotation import normalise, to_matrix
from hilstar.scene.camera import Camera


def monitor_camera(
    resolution_px: tuple[int, int],
    pixel_pitch_um: float,
    focal_length_mm: float,
    q_cam_to_mon: FloatArray,
    principal_point_px: tuple[float, float] | None = None,
) -> Camera:
    """The camera that maps cam directions to monitor pixels.

    `mon` has the axes of cam (x right, y down, as the tracker sees it); `q_cam_to_mon` is the alignment of the
    tracker on the bench. The collimator's axis meets the monitor at `principal_point_px`, by default its middle.
    """
    width, height = resolution_px
    middle = ((width - 1) / 2, (height - 1) / 2)
    return Camera(
        resolution_px=resolution_px,
        focal_length_px=focal_length_mm * 1000.0 / pixel_pitch_um,
        principal_point_px=principal_point_px or middle,
        cam_to_image=to_matrix(normalise(np.asarray(q_cam_to_mon, dtype=np.float64))),
    )
