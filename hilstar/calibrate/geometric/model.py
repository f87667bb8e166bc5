"""The parameters of a bench's geometry, and the cameras that they make."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.rotation import conjugate, from_rotation_vector, multiply, to_matrix
from hilstar.scene.camera import Camera
from hilstar.scene.lens import Lens

# A parameter is its step times a number of order 1, so that one damping suits all of them.
STEPS = {
    "rotation_x": 0.01,
    "rotation_y": 0.01,
    "rotation_z": 0.01,
    "log_focal": 0.01,
    "centre_x": 100.0,
    "centre_y": 100.0,
    "tilt_x": 0.1,
    "tilt_y": 0.1,
    "k1": 1.0,
    "k2": 10.0,
    "k3": 100.0,
    "p1": 0.1,
    "p2": 0.1,
}
# A turn about the boresight leaves a round lens as it is: what no pose tells apart is taken as the collimator's.
TRACKER_STEPS = {"tracker_k1": 0.1, "tracker_k2": 1.0, "tracker_p1": 0.1, "tracker_p2": 0.1}
TRACKER_ROUND = ("tracker_k1", "tracker_k2")
POSE_STEP_RAD = 0.01
PINHOLE = ("rotation_x", "rotation_y", "rotation_z", "log_focal")
RADIAL = (*PINHOLE, "k1")
BROWN_CONRADY = tuple(STEPS)


@dataclass(frozen=True, slots=True)
class Nominal:
    """What the bench file says: the ideal camera of the monitor, its rotation, and the tracker's own camera."""

    monitor: Camera
    q_cam_to_mon: FloatArray
    tracker: Camera


@dataclass(frozen=True, slots=True)
class Model:
    """Which parameters are free, in how many poses of the tracker; poses beyond the first have a rotation each."""

    names: tuple[str, ...]
    tracker_names: tuple[str, ...] = ()
    poses: int = 1

    @property
    def size(self) -> int:
        """How many numbers the model has."""
        return len(self.names) + len(self.tracker_names) + 3 * (self.poses - 1)


@dataclass(frozen=True, slots=True)
class Geometry:
    """One set of parameters made into cameras: the monitor's, its rotation, the tracker's, and the tracker's poses.

    `q_poses` (poses, 4) turns components in the tracker's axes of the first pose (cam) into those of each pose.
    """

    monitor: Camera
    q_cam_to_mon: FloatArray
    tracker: Camera
    q_poses: FloatArray


def geometry_of(model: Model, nominal: Nominal, q_poses: FloatArray, numbers: FloatArray) -> Geometry:
    """The cameras of parameters (size,); `q_poses` (poses, 4) are those that the poses' rotations are added to."""
    values = dict.fromkeys(STEPS, 0.0)
    values |= {name: STEPS[name] * float(number) for name, number in zip(model.names, numbers, strict=False)}
    # The foot of the axis moves along with a turn, so that the middle of the image stays: else the two are one long valley.
    follow = np.array([values["centre_y"], -values["centre_x"], 0.0]) / nominal.monitor.focal_length_px
    turn = np.array([values["rotation_x"], values["rotation_y"], values["rotation_z"]]) + follow
    q = multiply(from_rotation_vector(turn), nominal.q_cam_to_mon)
    cx, cy = nominal.monitor.principal_point_px
    monitor = Camera(
        nominal.monitor.resolution_px,
        nominal.monitor.focal_length_px * float(np.exp(values["log_focal"])),
        (cx + values["centre_x"], cy + values["centre_y"]),
        to_matrix(q),
        _lens_of(values) if "k1" in model.names else None,
    )
    rest = numbers[len(model.names) :]
    tracker = _tracker_of(model, nominal.tracker, rest)
    steps = POSE_STEP_RAD * rest[len(model.tracker_names) :].reshape(-1, 3)
    turned = [multiply(from_rotation_vector(step), pose) for step, pose in zip(steps, q_poses[1:], strict=True)]
    return Geometry(monitor, q, tracker, np.array([q_poses[0], *turned]))


def _lens_of(values: dict[str, float]) -> Lens:
    return Lens((values["k1"], values["k2"], values["k3"]), (values["p1"], values["p2"]), (values["tilt_x"], values["tilt_y"]))


def _tracker_of(model: Model, tracker: Camera, numbers: FloatArray) -> Camera:
    if not model.tracker_names:
        return tracker
    values = {name: TRACKER_STEPS[name] * float(n) for name, n in zip(model.tracker_names, numbers, strict=False)}
    lens = Lens((values["tracker_k1"], values["tracker_k2"], 0.0), (values["tracker_p1"], values["tracker_p2"]))
    return replace(tracker, lens=lens)


def directions_in_cam(geometry: Geometry, pose: IntArray, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """Directions (n, 3), cam, of places in the tracker's image, each in its own pose."""
    u, v = geometry.tracker.tangents(x_px, y_px)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    back = np.stack([to_matrix(conjugate(q)) for q in geometry.q_poses])
    return np.asarray(np.einsum("nij,nj->ni", back[pose], rays))
