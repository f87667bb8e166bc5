"""Orientations as messages of ROS: poses in a frame, and trees of tf."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.entries import AttitudeLog
from tests.support.sources import ros_bags
from tests.support.sources.ros_bags import START_NS, Make, Sent

MAKE = Make("jazzy")


def rotations(count: int, seed: int = 2) -> Rotation:
    return Rotation.random(count, rng=np.random.default_rng(seed))


def wxyz(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True)


def attitudes_of(log: AttitudeLog) -> Rotation:
    """The attitudes of a log, each from ICRS to cam."""
    return Rotation.from_quat([sample.q_icrs_to_cam for sample in log.samples], scalar_first=True)


def pose(
    frame: str, q: Sequence[float], stamp_ns: int, topic: str = "/pose", at_ns: int | None = None
) -> Sent:
    """A pose with its stamp, recorded then or at another time."""
    message = MAKE.of(ros_bags.POSE_STAMPED, stamp_ns, frame, "", q, ())
    return topic, ros_bags.POSE_STAMPED, stamp_ns if at_ns is None else at_ns, message


def poses(
    frame: str,
    turns: Rotation,
    topic: str = "/pose",
    step_ns: int = 10**8,
    start_ns: int = START_NS,
) -> list[Sent]:
    """Poses in a row."""
    return [pose(frame, wxyz(turn), start_ns + i * step_ns, topic) for i, turn in enumerate(turns)]


def fixed_transform(parent: str, child: str, q: Sequence[float], release: str = "jazzy") -> Sent:
    """A transform that does not move."""
    make = Make(release)
    message = make.tf(make.transform_stamped(START_NS, parent, child, q))
    return "/tf_static", ros_bags.TF, START_NS, message


def moved_transform(parent: str, child: str, q: Sequence[float]) -> Sent:
    """A transform of a frame that moves, 10 s after the start."""
    make = Make("jazzy")
    t_ns = START_NS + 10**10
    return "/tf", ros_bags.TF, t_ns, make.tf(make.transform_stamped(t_ns, parent, child, q))


def tree(
    dynamic: Sequence[tuple[str, str, Sequence[Rotation]]],
    fixed: Sequence[tuple[str, str, Rotation]] = (),
    release: str = "jazzy",
) -> Iterator[Sent]:
    """tf messages: (parent, child, rotation for each time), and fixed ones on the static topic."""
    make = Make(release)
    for parent, child, turn in fixed:
        yield fixed_transform(parent, child, wxyz(turn), release)
    for i in range(len(dynamic[0][2])):
        t_ns = START_NS + 10**8 * i
        moved = [
            make.transform_stamped(t_ns, parent, child, wxyz(turns[i]))
            for parent, child, turns in dynamic
        ]
        yield "/tf", ros_bags.TF, t_ns, make.tf(*moved)


def recorded_in_turn(sent: Sequence[Sent]) -> list[Sent]:
    """Messages whose recorder's clock is right, whatever their stamps say: rosbags gives them in
    its order.
    """
    return [
        (topic, kind, START_NS + k * 10**8, message)
        for k, (topic, kind, _, message) in enumerate(sent)
    ]
