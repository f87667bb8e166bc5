"""Bags that are refused: the messages, what is stated, and the words that matter."""

from __future__ import annotations

import re

import numpy as np
import pytest

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log
from hilstar.attitude.logs.ros import _listed
from tests.support.refusals import refusal
from tests.support.sources import ros_bags
from tests.support.sources.ros_bags import START_NS
from tests.support.sources.ros_poses import (
    MAKE,
    fixed_transform,
    moved_transform,
    pose,
    poses,
    recorded_in_turn,
    rotations,
    tree,
    wxyz,
)

PLACE = (48.1, 11.6, 500.0)
UPRIGHT = (1, 0, 0, 0)
ENU = {"reference": "enu", "place": PLACE}
ICRS = {"reference": "icrs"}
NAMED = poses("icrs", rotations(3))
UNDATED = poses("map", rotations(3), start_ns=0)
LATER = START_NS + 10**9
TWO_TOPICS = [
    *poses("icrs", rotations(2), "/a/pose"),
    *poses("icrs", rotations(3, seed=9), "/b/pose"),
]
POINT = ("/p", "geometry_msgs/msg/Vector3", START_NS, MAKE.vector((1, 2, 3)))
TWO_BODIES = [
    (
        "/vicon",
        ros_bags.TRANSFORM_STAMPED,
        START_NS + i,
        MAKE.transform_stamped(START_NS + 10**7 * i, "icrs", child, wxyz(turn)),
    )
    for i, turn in enumerate(rotations(4))
    for child in ("one", "two")
]
CHAIN = list(tree([("map", "odom", rotations(3)), ("odom", "base", rotations(3, seed=7))]))


def imu(frame: str, covariance0: float = 0.01) -> list[ros_bags.Sent]:
    message = MAKE.imu(START_NS, frame, UPRIGHT, (0, 0, 0), covariance0)
    return [("/imu", ros_bags.IMU, START_NS, message)]


STATE_ITS_AXES = "state its axes with --reference icrs, or"
# messages, what is stated, words
FRAMES = [
    *((poses(frame, rotations(3)), {}, STATE_ITS_AXES) for frame in ("map", "odom", "world")),
    *((poses(frame, rotations(3)), {}, STATE_ITS_AXES) for frame in ("base_link", "")),
    (NAMED, ENU, "'icrs', which is not east, north, up; leave out --reference"),
    (NAMED, {"reference": "map=icrs"}, "refer to the frame 'icrs', not to 'map'"),
    (
        NAMED,
        {"reference": "map=sideways"},
        "the axes of map are icrs, enu or ned; write --reference map=icrs",
    ),
    (
        UNDATED,
        {"reference": "enu"},
        "refer to east, north, up; give the place with --place LAT,LON,HEIGHT",
    ),
    (UNDATED, ENU, "begin at 0 s, no date; give --epoch-utc TIME"),
    (
        poses("map", rotations(3), start_ns=10**6 * 10**9),
        ENU | {"epoch_utc": "2262-04-11T00:00:00"},
        "--epoch-utc 2262-04-11T00:00:00: UTC goes from 1677-09-22 to 2262-04-11",
    ),
    (
        poses("map", rotations(3)),
        ENU | {"epoch_utc": "2025-11-22T08:26:35"},
        "dates already .* leave out --epoch-utc",
    ),
    (
        [*NAMED, *poses("map", rotations(2), start_ns=LATER)],
        {},
        "message 4 of /pose: refers to the frame 'map', the first to 'icrs'",
    ),
    (
        imu("imu", -1),
        ICRS,
        r"message 1 of /imu: orientation_covariance\[0\] is -1: the IMU gives no orientation",
    ),
    (imu("icrs"), {}, "do not say which frame their orientation refers to .*REP 145"),
]
TOPICS_AND_BODIES = [
    (
        TWO_TOPICS,
        {},
        r"several topics with attitudes: /a/pose \(geometry_msgs/PoseStamped\), /b/pose .*; choose"
        r" one with --topic NAME",
    ),
    (
        TWO_TOPICS,
        {"topic": "/c"},
        r"has no topic /c; it has /a/pose \(geometry_msgs/PoseStamped\), /b/pose",
    ),
    ([POINT], {}, r"has no topic with attitudes; it has /p \(geometry_msgs/Vector3\)"),
    (
        [POINT, *NAMED],
        {"topic": "/p"},
        "/p is of geometry_msgs/msg/Vector3, which says no attitude; read are Imu, Odometry, Pose",
    ),
    (TWO_BODIES, {}, "is of the frame 'two', the first of 'one'; choose one with --body"),
    (TWO_BODIES, {"body": "three"}, "has no attitude of three"),
    (NAMED, {"body": "one"}, "name no body; leave out --body one"),
]
TIMES = [
    (
        [*NAMED, *poses("icrs", rotations(3, seed=8))],
        {},
        "time does not increase .*; the bag has two attitudes of one time",
    ),
    (
        recorded_in_turn(
            [
                *poses("icrs", rotations(30)),
                *poses("icrs", rotations(3, seed=8), start_ns=START_NS + 1),
            ]
        ),
        {},
        "time does not increase .* or its clock was set back",
    ),
    (
        [*(pose("icrs", UPRIGHT, 0, at_ns=t_ns) for t_ns in (5, 9)), *NAMED],
        {},
        "message 3 of /pose: some messages have a stamp and some have none",
    ),
]
QUATERNIONS = [
    ([*NAMED, pose("icrs", q, LATER)], {}, f"message 4 of /pose: .*{words}")
    for q, words in (
        ((0, 0, 0, 0), "norm is 0;"),
        ((1, 1, 0, 0), "norm is 1.41421"),
        ((np.nan, 0, 0, 1), "not finite"),
    )
]
TREES = [
    (
        [fixed_transform("base", "cam", (2, 0, 0, 0)), *tree([("icrs", "base", rotations(3))])],
        {"body": "cam"},
        "the transform base -> cam has a quaternion whose norm is off by 1",
    ),
    (
        [fixed_transform("base", "cam", (0.5, 0, 0, 0)), *tree([("icrs", "base", rotations(3))])],
        {"body": "cam"},
        "the transform base -> cam has a quaternion whose norm is off by 0.5",
    ),
    (
        [*tree([("icrs", "base", rotations(3))]), moved_transform("icrs", "base", (2, 0, 0, 0))],
        {"body": "base"},
        "transform 4 of icrs -> base: .*norm is 2;",
    ),
    (
        CHAIN,
        ICRS,
        "several transforms of tf could be meant: map -> odom, odom -> base; choose with --body",
    ),
    (
        CHAIN,
        ICRS | {"body": "nose"},
        "tf has no transform of 'nose'; it has map -> odom, odom -> base",
    ),
    (
        CHAIN,
        {"reference": "moon=icrs", "body": "base"},
        "tf has no transform from 'base' up to 'moon'",
    ),
    (CHAIN, {"body": "odom"}, "refer to the frame 'map'; state its axes"),
    (
        list(tree([("a", "b", rotations(2)), ("b", "a", [rotations(1)[0]] * 2)])),
        ICRS | {"body": "b"},
        "tf goes in a circle at",
    ),
    (
        list(tree([("a", "b", rotations(2)), ("c", "b", rotations(2))])),
        ICRS | {"body": "b"},
        "'b' has several parents: a -> b, c -> b",
    ),
]
REFUSED = [*FRAMES, *TOPICS_AND_BODIES, *TIMES, *QUATERNIONS, *TREES]


@pytest.mark.parametrize(
    ("sent", "stated", "words"), REFUSED, ids=[words[:40] for _, _, words in REFUSED]
)
def test_a_bag_is_refused_in_one_line(bag, sent, stated, words):
    line = refusal(open_log, bag(sent), Stated(**stated))
    assert re.search(words, line), line


@pytest.mark.parametrize(
    ("names", "text"), [([], ""), (["a", "b"], "a, b"), (["a", "b", "c"], "a, b, ...")]
)
def test_what_a_bag_has_is_listed_up_to_a_count(names, text):
    assert _listed(names, 2, 400) == text
