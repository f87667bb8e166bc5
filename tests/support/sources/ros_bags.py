"""Bags as ROS programs write them: rosbags's own writers, and for MCAP the mcap library with
ROS's schemas.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

Q = "geometry_msgs/msg/Quaternion"
QUATERNION_STAMPED = "geometry_msgs/msg/QuaternionStamped"
POSE = "geometry_msgs/msg/Pose"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM = "geometry_msgs/msg/Transform"
TRANSFORM_STAMPED = "geometry_msgs/msg/TransformStamped"
TF = "tf2_msgs/msg/TFMessage"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
START_NS = 1_763_800_000 * 10**9  # 2025-11-22T08:26:40
Numbers = Sequence[float]
# One message: topic, type, time of recording (ns), and the message.
Sent = tuple[str, str, int, Any]


@functools.lru_cache
def store(name: str) -> Typestore:
    """ROS's types of a release: noetic, humble, jazzy."""
    stores = {
        "noetic": Stores.ROS1_NOETIC,
        "humble": Stores.ROS2_HUMBLE,
        "jazzy": Stores.ROS2_JAZZY,
    }
    types = get_typestore(stores[name])
    if name == "noetic":
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
    return types


class Make:
    """Messages of a release of ROS."""

    def __init__(self, release: str) -> None:
        self.types = store(release).types
        self.release = release

    def _new(self, name: str, **fields: Any) -> Any:
        return self.types[name](**fields)

    def header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self._new(
            "builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        counter = {"seq": 0} if self.release == "noetic" else {}
        return self._new("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **counter)

    def quaternion(self, q_wxyz: Numbers) -> Any:
        w, x, y, z = map(float, q_wxyz)
        return self._new(Q, x=x, y=y, z=z, w=w)

    def vector(self, xyz: Numbers) -> Any:
        x, y, z = map(float, xyz)
        return self._new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def pose(self, q: Numbers) -> Any:
        return self._new(
            POSE,
            position=self._new("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0),
            orientation=self.quaternion(q),
        )

    def transform(self, q: Numbers) -> Any:
        return self._new(TRANSFORM, translation=self.vector((1, 2, 3)), rotation=self.quaternion(q))

    def transform_stamped(self, stamp_ns: int, parent: str, child: str, q: Numbers) -> Any:
        head = self.header(stamp_ns, parent)
        return self._new(
            TRANSFORM_STAMPED, header=head, child_frame_id=child, transform=self.transform(q)
        )

    def tf(self, *transforms: Any) -> Any:
        return self._new(TF, transforms=list(transforms))

    def imu(
        self,
        stamp_ns: int,
        frame: str,
        q: Numbers,
        rate: Numbers,
        covariance0: float = 0.01,
        rate0: float = 0.01,
    ) -> Any:
        return self._new(
            IMU,
            header=self.header(stamp_ns, frame),
            orientation=self.quaternion(q),
            orientation_covariance=np.array([covariance0, *[0.0] * 8]),
            angular_velocity=self.vector(rate),
            angular_velocity_covariance=np.array([rate0, *[0.0] * 8]),
            linear_acceleration=self.vector((0, 0, 9.81)),
            linear_acceleration_covariance=np.zeros(9),
        )

    def odometry(self, stamp_ns: int, frame: str, child: str, q: Numbers, rate: Numbers) -> Any:
        pose = self._new(
            "geometry_msgs/msg/PoseWithCovariance", pose=self.pose(q), covariance=np.zeros(36)
        )
        twist = self._new(
            "geometry_msgs/msg/Twist", linear=self.vector((1, 0, 0)), angular=self.vector(rate)
        )
        twists = self._new(
            "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
        )
        return self._new(
            ODOMETRY,
            header=self.header(stamp_ns, frame),
            child_frame_id=child,
            pose=pose,
            twist=twists,
        )

    def of(
        self, kind: str, stamp_ns: int, frame: str, child: str, q: Numbers, rate: Numbers
    ) -> Any:
        """A message of any of the types, with the same orientation of `child` in `frame`."""
        with_covariance = "geometry_msgs/msg/PoseWithCovariance"
        makers: dict[str, Callable[[], Any]] = {
            Q: lambda: self.quaternion(q),
            QUATERNION_STAMPED: lambda: self._new(
                kind, header=self.header(stamp_ns, frame), quaternion=self.quaternion(q)
            ),
            POSE: lambda: self.pose(q),
            POSE_STAMPED: lambda: self._new(
                kind, header=self.header(stamp_ns, frame), pose=self.pose(q)
            ),
            POSE_COVARIANCE: lambda: self._new(
                kind,
                header=self.header(stamp_ns, frame),
                pose=self._new(with_covariance, pose=self.pose(q), covariance=np.zeros(36)),
            ),
            TRANSFORM: lambda: self.transform(q),
            TRANSFORM_STAMPED: lambda: self.transform_stamped(stamp_ns, frame, child, q),
            TF: lambda: self.tf(self.transform_stamped(stamp_ns, frame, child, q)),
            IMU: lambda: self.imu(stamp_ns, child, q, rate),
            ODOMETRY: lambda: self.odometry(stamp_ns, frame, child, q, rate),
        }
        return makers[kind]()


def write_bag1(
    path: Path,
    sent: Iterable[Sent],
    compression: Literal["none", "bz2", "lz4"] = "none",
    chunk: int = 1 << 16,
) -> Path:
    """A bag of ROS 1."""
    types = store("noetic")
    writer = Writer1(path)
    if compression != "none":
        writer.set_compression(writer.CompressionFormat[compression.upper()])
    writer.chunk_threshold = chunk
    connections: dict[tuple[str, str], Any] = {}
    with writer:
        for topic, kind, time_ns, message in sent:
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=types)
            writer.write(connections[topic, kind], time_ns, types.serialize_ros1(message, kind))
    return path


def write_bag2(
    path: Path,
    sent: Iterable[Sent],
    release: str = "jazzy",
    mcap: bool = False,
    compression: Literal["none", "file", "message", "storage"] = "none",
) -> Path:
    """The directory of a bag of ROS 2."""
    types = store(release)
    writer = Writer2(
        path, version=9, storage_plugin=StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    )
    writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    connections: dict[tuple[str, str], Any] = {}
    with writer:
        for topic, kind, time_ns, message in sent:
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=types)
            writer.write(connections[topic, kind], time_ns, types.serialize_cdr(message, kind))
    return path


def write_mcap(
    path: Path,
    sent: Iterable[Sent],
    release: str = "humble",
    profile: str = "ros2",
    compression: CompressionType = CompressionType.LZ4,
    others: Iterable[tuple[str, str, bytes]] = (),
) -> Path:
    """An MCAP as other programs write it: the mcap library, and ROS's schemas as text.

    `others` are channels of other encodings before them: topic, encoding, content.
    """
    types, version = store(release), 1 if release == "noetic" else 2
    encodings = ("ros1msg", "ros1") if version == 1 else ("ros2msg", "cdr")
    with path.open("wb") as file:
        writer = McapWriter(file, compression=compression, chunk_size=4096)
        writer.start(profile=profile, library="another program")
        for topic, encoding, content in others:
            writer.add_message(writer.register_channel(topic, encoding, 0), 0, content, 0)
        channels: dict[tuple[str, str], int] = {}
        for topic, kind, time_ns, message in sent:
            if (topic, kind) not in channels:
                text, _ = types.generate_msgdef(kind, ros_version=version)
                name = kind if version == 2 else kind.replace("/msg/", "/")
                schema = writer.register_schema(name, encodings[0], text.encode())
                channels[topic, kind] = writer.register_channel(topic, encodings[1], schema)
            data = (
                types.serialize_cdr(message, kind)
                if version == 2
                else types.serialize_ros1(message, kind)
            )
            writer.add_message(channels[topic, kind], time_ns, bytes(data), time_ns)
        writer.finish()
    return path
