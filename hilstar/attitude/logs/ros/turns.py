"""What the messages of ROS say of an orientation.

In all of them the quaternion (x, y, z, w) turns components of a body's (child's) frame into those of the frame that it refers
to (REP 103, REP 105). The header names that frame, but for an Imu: there it names the body, and the frame that the orientation
refers to is unnamed (REP 145).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from hilstar.attitude.logs.ros.definitions import OLD_TF, TF

Numbers = tuple[float, ...]


class Turn(NamedTuple):
    """One orientation: `q` (w, x, y, z) turns components of the body into those of the reference.

    `stamp_ns` is the header's time, None where it has none; frames are None where the message does not name them. `rate` is in
    components of the body, rad/s, with respect to the reference, or to the stars where `gyro` says so. `fault` is why it is no
    orientation.
    """

    stamp_ns: int | None
    reference: str | None
    body: str | None
    q: Numbers
    rate: Numbers | None = None
    gyro: bool = False
    fault: str | None = None


def turns(type_name: str, message: Any) -> Iterator[Turn]:
    """The orientations in a message of one of TYPES; several in a TFMessage."""
    if type_name in TF_TYPES:
        yield from map(_transform_stamped, message.transforms)
    else:
        yield _TURN[type_name](message)


def frame(text: str) -> str:
    """A frame's name without the slash that the first tf had before it."""
    return text.lstrip("/")


def _plain(q: Any) -> Turn:
    return Turn(None, None, None, _q(q))


def _stamped(message: Any, q: Any) -> Turn:
    return Turn(_stamp_ns(message), frame(message.header.frame_id), None, _q(q))


def _transform_stamped(message: Any) -> Turn:
    q = _q(message.transform.rotation)
    return Turn(_stamp_ns(message), frame(message.header.frame_id), frame(message.child_frame_id), q)


def _imu(message: Any) -> Turn:
    unknown = (
        "orientation_covariance[0] is -1: the IMU gives no orientation" if message.orientation_covariance[0] == -1 else None
    )
    rate = None if message.angular_velocity_covariance[0] == -1 else _vector(message.angular_velocity)
    body = frame(message.header.frame_id)
    return Turn(_stamp_ns(message), None, body, _q(message.orientation), rate, gyro=True, fault=unknown)


def _odometry(message: Any) -> Turn:
    body, rate = frame(message.child_frame_id), _vector(message.twist.twist.angular)
    return Turn(_stamp_ns(message), frame(message.header.frame_id), body, _q(message.pose.pose.orientation), rate)


def _q(q: Any) -> Numbers:
    return (q.w, q.x, q.y, q.z)


def _vector(vector: Any) -> Numbers:
    return (vector.x, vector.y, vector.z)


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


TF_TYPES = frozenset({TF, OLD_TF})
_TURN: dict[str, Callable[[Any], Turn]] = {
    "geometry_msgs/msg/Quaternion": _plain,
    "geometry_msgs/msg/QuaternionStamped": lambda m: _stamped(m, m.quaternion),
    "geometry_msgs/msg/Pose": lambda m: _plain(m.orientation),
    "geometry_msgs/msg/PoseStamped": lambda m: _stamped(m, m.pose.orientation),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _stamped(m, m.pose.pose.orientation),
    "geometry_msgs/msg/Transform": lambda m: _plain(m.rotation),
    "geometry_msgs/msg/TransformStamped": _transform_stamped,
    "sensor_msgs/msg/Imu": _imu,
    "nav_msgs/msg/Odometry": _odometry,
}
TYPES = frozenset(_TURN) | TF_TYPES
