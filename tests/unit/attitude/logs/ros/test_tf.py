"""tf: chains of transforms that move or do not, and what a tree leaves open."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log
from tests.support.sources import ros_bags
from tests.support.sources.ros_bags import START_NS, Make, write_bag1, write_bag2
from tests.support.sources.ros_poses import (
    MAKE,
    attitudes_of,
    fixed_transform,
    rotations,
    tree,
    wxyz,
)

# A chain of four products of unit quaternions in float64.
ROUNDING = 1e-14


@pytest.mark.parametrize("write", ["ROS 1", "ROS 2"])
def test_tf_gives_a_chain_through_parts_that_do_not_move(tmp_path, write):
    moving, above, below = rotations(6), *rotations(2, seed=3)
    release = "noetic" if write == "ROS 1" else "jazzy"
    sent = tree(
        [("/base", "/wheel", rotations(6, seed=4)), ("/stand", "/base", moving)],
        [("icrs", "/stand", above), ("base", "cam", below)],
        release,
    )
    path = (
        write_bag1(tmp_path / "a.bag", sent)
        if write == "ROS 1"
        else write_bag2(tmp_path / "a", sent)
    )
    log = open_log(path, Stated(body="cam"))
    assert (attitudes_of(log) * above * moving * below).magnitude() == pytest.approx(
        0, abs=ROUNDING
    )
    assert "turns components of 'cam' into those of 'icrs'" in log.conventions.turns
    from_stand = open_log(path, Stated(body="base", reference="stand=icrs"))
    assert (attitudes_of(from_stand) * moving).magnitude() == pytest.approx(0, abs=ROUNDING)


def test_where_one_transform_moves_the_body_need_not_be_named(bag):
    moving = rotations(4)
    log = open_log(bag(tree([("icrs", "base", moving), ("base", "arm", [rotations(1)[0]] * 4)])))
    assert (attitudes_of(log) * moving).magnitude() == pytest.approx(0, abs=ROUNDING)


def test_a_mount_alone_is_read_where_no_transform_of_the_bag_moves(bag):
    turn = rotations(1)
    log = open_log(bag([fixed_transform("icrs", "cam", wxyz(turn[0]))]))
    assert (attitudes_of(log) * turn).magnitude() == pytest.approx(0, abs=ROUNDING)


def test_a_frame_and_a_body_choose_one_of_several_transforms(bag):
    two = bag(tree([("map", "odom", rotations(3)), ("odom", "base", rotations(3, seed=7))]))
    assert len(open_log(two, Stated(reference="odom=icrs", body="base")).samples) == 3


def test_where_several_transforms_move_they_are_interpolated_as_tf2_does(bag):
    # its last rotation is its first again, and it moves all the same
    slow = Rotation.from_rotvec([[0.1 * k, 0.02 * k**2, 0] for k in (0, 1, 3, 0)])
    fast = rotations(12)
    sent = [
        *(
            ("/tf", ros_bags.TF, t, MAKE.tf(MAKE.transform_stamped(t, "map", "odom", wxyz(turn))))
            for t, turn in turns_in_time(slow, 300)
        ),
        *(
            ("/tf", ros_bags.TF, t, MAKE.tf(MAKE.transform_stamped(t, "odom", "base", wxyz(turn))))
            for t, turn in turns_in_time(fast, 100)
        ),
    ]
    log = open_log(bag(sent), Stated(reference="icrs", body="base"))
    seconds = np.array([sample.t_ns - START_NS for sample in log.samples]) / 1e9
    assert seconds == pytest.approx(np.arange(10) / 10, abs=1e-12)  # the slow one ends at 0.9 s
    truth = Slerp([0, 0.3, 0.6, 0.9], slow)(np.clip(seconds, 0, 0.9)) * fast[:10]
    assert (attitudes_of(log) * truth).magnitude() == pytest.approx(0, abs=ROUNDING)
    assert [line for kind, line in log.told if kind == "log-tf"] == [
        "map -> odom interpolated (SLERP) to the times of odom -> base",
        "2 attitudes at times that not all of these transforms have are left out",
    ]


def turns_in_time(turns, step_ms, start_ns=START_NS):
    return [(start_ns + k * step_ms * 10**6, turn) for k, turn in enumerate(turns)]


def test_a_simulated_clock_that_begins_at_zero_joins_transforms_by_its_stamps(bag):
    """The recorder was late by 40 ms with every message of the slow transform."""
    slow, fast = Rotation.from_rotvec([[0.1 * k, 0, 0] for k in range(3)]), rotations(5)
    sent = []
    for parent, child, turns, step_ms, late_ms in (
        ("map", "odom", slow, 200, 40),
        ("odom", "base", fast, 100, 0),
    ):
        for t_ns, turn in turns_in_time(turns, step_ms, start_ns=0):
            message = MAKE.tf(MAKE.transform_stamped(t_ns, parent, child, wxyz(turn)))
            sent.append(("/tf", ros_bags.TF, START_NS + t_ns + late_ms * 10**6, message))
    log = open_log(bag(sent), Stated(reference="icrs", body="base"))
    assert [sample.t_ns for sample in log.samples] == [k * 10**8 for k in range(5)]
    truth = Slerp([0, 0.2, 0.4], slow)(np.arange(5) / 10) * fast
    assert (attitudes_of(log) * truth).magnitude() == pytest.approx(0, abs=ROUNDING)


def test_a_robots_tf_takes_the_static_transforms_of_its_own_namespace(bag):
    moving, own, anothers = rotations(3), *rotations(2, seed=3)
    sent = []
    for topic, _, t_ns, message in tree([("icrs", "base", moving)], [("base", "cam", own)]):
        sent.append((f"/robot{topic}", ros_bags.TF, t_ns, message))
    sent.insert(0, fixed_transform("base", "cam", wxyz(anothers)))
    log = open_log(bag(sent), Stated(topic="/robot/tf", body="cam"))
    assert (attitudes_of(log) * moving * own).magnitude() == pytest.approx(0, abs=ROUNDING)


def test_the_first_tfs_type_is_read(tmp_path):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import get_types_from_msg

    types, kind, make = ros_bags.store("noetic"), "tf/msg/tfMessage", Make("noetic")
    types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    with Writer(tmp_path / "a.bag") as writer:
        topic = writer.add_connection("/tf", kind, typestore=types)
        for t_ns, turn in turns_in_time(rotations(3), 100):
            message = make.tf(make.transform_stamped(t_ns, "/icrs", "/cam", wxyz(turn)))
            writer.write(
                topic,
                t_ns,
                types.serialize_ros1(types.types[kind](transforms=message.transforms), kind),
            )
    assert (attitudes_of(open_log(tmp_path / "a.bag")) * rotations(3)).magnitude() == pytest.approx(
        0, abs=ROUNDING
    )
