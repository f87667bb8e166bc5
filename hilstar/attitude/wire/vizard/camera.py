"""A camera as Basilisk describes it to Vizard, beside the bench's tracker, whose pictures it gets."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.wire.vizard.attitude import quaternion_of_mrp
from hilstar.attitude.wire.vizard.message import VizCamera
from hilstar.rotation import angle_between_rad, conjugate, multiply
from hilstar.units import ARCSEC_PER_RAD

# Basilisk turns its camera (+z boresight, x right, y down, as `cam`) into Unity's before it sends it: sigma_CuC.
SIGMA_CAM_TO_UNITY = (1 / 3, 1 / 3, -1 / 3)
MAX_TURN_ARCSEC = 1.0
MAX_FIELD_SHARE = 0.01  # of the field of view: Basilisk's camera has no distortion


@dataclass(frozen=True, slots=True)
class TrackerCamera:
    """The bench's tracker: its mounting, its size, and its field of view along y, degrees."""

    q_body_to_cam: FloatArray
    resolution_px: tuple[int, int]
    field_of_view_deg: float


def q_body_to_cam(camera: VizCamera) -> FloatArray | None:
    """How Basilisk has mounted a camera: its sigma_CB as a quaternion from body to camera; None where it is not said."""
    if len(camera.sigma) != 3 or not all(map(math.isfinite, camera.sigma)):
        return None
    cam_to_unity, body_to_unity = (np.array(quaternion_of_mrp(s)) for s in (SIGMA_CAM_TO_UNITY, camera.sigma))
    return multiply(conjugate(cam_to_unity), body_to_unity)


def disagreement(camera: VizCamera, tracker: TrackerCamera) -> str | None:
    """A line about where Basilisk's camera is not the bench's tracker; None where they are the same."""
    differences = []
    mounted = q_body_to_cam(camera)
    if mounted is not None:
        turn_arcsec = angle_between_rad(mounted, tracker.q_body_to_cam) * ARCSEC_PER_RAD
        if turn_arcsec > MAX_TURN_ARCSEC:
            q = ", ".join(f"{c:.7f}" for c in mounted)
            differences.append(f"its sigma_CB is q_body_to_cam = ({q}), {turn_arcsec / 3600:.4g} deg from the bench's")
    if camera.resolution_px and camera.resolution_px != tracker.resolution_px:
        differences.append("it has {} x {} px, not {} x {}".format(*(*camera.resolution_px, 0)[:2], *tracker.resolution_px))
    field_deg = camera.field_of_view_deg
    if abs(field_deg - tracker.field_of_view_deg) > MAX_FIELD_SHARE * tracker.field_of_view_deg:
        differences.append(f"its field along y is {field_deg:.4g} deg, not {tracker.field_of_view_deg:.4g}")
    if not differences:
        return None
    return f"Basilisk's camera {camera.identity} is not the bench's [tracker], whose pictures it gets: {'; '.join(differences)}"
