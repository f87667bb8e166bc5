"""A pinhole camera: directions in cam become pixels (thesis eq. 4.1, 4.2), in float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Camera:
    """What maps cam directions to pixels: (0, 0) is the centre of the top-left pixel, x right, y down.

    `cam_to_image` (3, 3) turns cam components into those of the image's own axes (z along its normal).
    """

    resolution_px: tuple[int, int]
    focal_length_px: float
    principal_point_px: tuple[float, float]
    cam_to_image: FloatArray

    def project(self, image_vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel x and y of directions (n, 3) in image axes; those not in front come out as NaN."""
        z = image_vectors[:, 2]
        scale = np.divide(self.focal_length_px, z, out=np.full_like(z, np.nan), where=z > 0)
        x = image_vectors[:, 0] * scale + self.principal_point_px[0]
        y = image_vectors[:, 1] * scale + self.principal_point_px[1]
        return x, y

    def field_radius_rad(self, margin_px: float) -> float:
        """The angle from the image's normal to its farthest corner, `margin_px` outside it."""
        width, height = self.resolution_px
        cx, cy = self.principal_point_px
        reach_x = max(cx, width - 1 - cx) + 0.5 + margin_px
        reach_y = max(cy, height - 1 - cy) + 0.5 + margin_px
        return float(np.arctan(np.hypot(reach_x, reach_y) / self.focal_length_px))
