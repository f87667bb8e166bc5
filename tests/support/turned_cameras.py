"""Cameras whose frame is another than the image's: what is drawn does not depend on it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray
from hilstar.optics.camera import Camera


def turned_cameras(camera: Camera, rng: np.random.Generator) -> Iterator[tuple[Rotation, Camera]]:
    """A camera's frame turned in any way, and the camera with that frame, whose image stays."""
    for turn in Rotation.random(3, rng=rng):
        turned_back = camera.cam_to_image @ turn.inv().as_matrix()
        yield turn, replace(camera, cam_to_image=turned_back)


def turned_attitude(turn: Rotation, q_icrs_to_cam: FloatArray) -> FloatArray:
    """The attitude of a frame that is turned so."""
    turned = turn * Rotation.from_quat(q_icrs_to_cam, scalar_first=True)
    return np.asarray(turned.as_quat(scalar_first=True))
