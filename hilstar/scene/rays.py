"""Each pixel's direction for the renderer: a pinhole's in closed form, and what a lens adds to it on a coarse grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hilstar.arrays import Float32Array
from hilstar.scene.camera import Camera

# Between nodes the shift is linear. A lens that shifts the corner of 1920 x 1080 px by 50 px, growing with the cube of the
# radius, bends by 3e-4 px per px squared there: 8^2 / 8 of that is 0.002 px.
NODE_STEP_PX = 8


def ray_shifts(camera: Camera) -> Float32Array:
    """What a lens adds to a pinhole's tangents (u, v), float32 (rows, columns, 2), at nodes over the whole image.

    The first and the last node of a row lie on the image's edges, -0.5 and width - 0.5; a column's likewise. Where the lens
    has no direction the shift is 0.
    """
    places = [np.linspace(-0.5, size - 0.5, -(-size // NODE_STEP_PX) + 1) for size in camera.resolution_px]
    x_px, y_px = (part.ravel() for part in np.meshgrid(*places))
    seen = camera.tangents(x_px, y_px)
    plain = replace(camera, lens=None).tangents(x_px, y_px)
    shifts = np.stack([a - b for a, b in zip(seen, plain, strict=True)], axis=-1).reshape(len(places[1]), len(places[0]), 2)
    return np.nan_to_num(shifts).astype(np.float32)
