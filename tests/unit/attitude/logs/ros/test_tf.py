"""tf: chains of transforms that move or do not, and what a tree leaves open."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log
from hilstar.basics.errors import InputError
from tests.support.sources import ros_bags
from tests.support.sources.ros_bags import START_NS, Make, write_bag1, write_bag2, write_mcap

MAKE = Make("jazzy")
# A chain of four products of unit quaternions in float64.
ROUNDING = 1e-14


def rotations(count, seed=2):
    return Rotation.random(count, rng=np.random.default_rng(seed))


def first(rotation):
    return rotation.as_quat(scalar_first=True)


def attitudes(log):
    return Rotation.from_quat([sample.q_icrs_to_cam for sample in log.samples], scalar_first=True)


@pytest.fixture
def bag(tmp_path):
    return lambda sent: write_mcap(tmp_path / "a.mcap", sent, "jazzy")


def tree(dynamic, fixed=(), release="jazzy"):
    """tf messages: (parent, child, rotation for each time), and fixed ones on the static topic."""
    make = Make(release)
    for parent, child, turn in fixed:
        yield (
            "/tf_static",
            ros_bags.TF,
            START_NS,
            make.tf(make.transform_stamped(START_NS, parent, child, first(turn))),
        )
    for i in range(len(dynamic[0][2])):
        t_ns = START_NS + 10**8 * i
        moved = [
            make.transform_stamped(t_ns, parent, child, first(turns[i]))
            for parent, child, turns in dynamic
        ]
        yield "/tf", ros_bags.TF, t_ns, make.tf(*moved)


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
    assert (attitudes(log) * above * moving * below).magnitude() == pytest.approx(0, abs=ROUNDING)
    assert "turns components of 'cam' into those of 'icrs'" in log.conventions.turns
    from_stand = open_log(path, Stated(body="base", reference="stand=icrs"))
    assert (attitudes(from_stand) * moving).magnitude() == pytest.approx(0, abs=ROUNDING)


def test_where_one_transform_moves_the_body_need_not_be_named(bag):
    moving = rotations(4)
    log = open_log(bag(tree([("icrs", "base", moving), ("base", "arm", [rotations(1)[0]] * 4)])))
    assert (attitudes(log) * moving).magnitude() == pytest.approx(0, abs=ROUNDING)


def test_where_several_transforms_move_they_are_interpolated_as_tf2_does(bag):
    slow, fast = Rotation.from_rotvec([[0.1 * k, 0.02 * k**2, 0] for k in range(4)]), rotations(12)
    sent = [
        *(
            ("/tf", ros_bags.TF, t, MAKE.tf(MAKE.transform_stamped(t, "map", "odom", first(turn))))
            for t, turn in at(slow, 300)
        ),
        *(
            ("/tf", ros_bags.TF, t, MAKE.tf(MAKE.transform_stamped(t, "odom", "base", first(turn))))
            for t, turn in at(fast, 100)
        ),
    ]
    log = open_log(bag(sent), Stated(reference="icrs", body="base"))
    seconds = np.array([sample.t_ns - START_NS for sample in log.samples]) / 1e9
    assert seconds == pytest.approx(np.arange(10) / 10, abs=1e-12)  # the slow one ends at 0.9 s
    truth = Slerp([0, 0.3, 0.6, 0.9], slow)(np.clip(seconds, 0, 0.9)) * fast[:10]
    assert (attitudes(log) * truth).magnitude() == pytest.approx(0, abs=ROUNDING)
    assert [line for kind, line in log.told if kind == "log-tf"] == [
        "map -> odom interpolated (SLERP) to the times of odom -> base",
        "2 attitudes at times that not all of these transforms have are left out",
    ]


def at(turns, step_ms):
    return [(START_NS + k * step_ms * 10**6, turn) for k, turn in enumerate(turns)]


def test_the_first_tfs_type_is_read(tmp_path):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import get_types_from_msg

    types, kind, make = ros_bags.store("noetic"), "tf/msg/tfMessage", Make("noetic")
    types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    with Writer(tmp_path / "a.bag") as writer:
        topic = writer.add_connection("/tf", kind, typestore=types)
        for t_ns, turn in at(rotations(3), 100):
            message = make.tf(make.transform_stamped(t_ns, "/icrs", "/cam", first(turn)))
            writer.write(
                topic,
                t_ns,
                types.serialize_ros1(types.types[kind](transforms=message.transforms), kind),
            )
    assert (attitudes(open_log(tmp_path / "a.bag")) * rotations(3)).magnitude() == pytest.approx(
        0, abs=ROUNDING
    )


def test_a_transform_of_a_chain_that_is_no_rotation_is_refused(bag):
    bad = (
        "/tf_static",
        ros_bags.TF,
        START_NS,
        MAKE.tf(MAKE.transform_stamped(START_NS, "base", "cam", (2, 0, 0, 0))),
    )
    with pytest.raises(
        InputError, match="the transform base -> cam has a quaternion whose norm is off by 1"
    ):
        open_log(bag([bad, *tree([("icrs", "base", rotations(3))])]), Stated(body="cam"))


def test_what_tf_leaves_open_is_refused_by_name(bag):
    two = bag(tree([("map", "odom", rotations(3)), ("odom", "base", rotations(3, seed=7))]))
    with pytest.raises(
        InputError,
        match=(
            "several transforms of tf could be meant: map -> odom, odom -> base; choose with --body"
        ),
    ):
        open_log(two, Stated(reference="icrs"))
    assert len(open_log(two, Stated(reference="odom=icrs", body="base")).samples) == 3
    with pytest.raises(
        InputError, match="tf has no transform of 'nose'; it has map -> odom, odom -> base"
    ):
        open_log(two, Stated(reference="icrs", body="nose"))
    with pytest.raises(InputError, match="tf has no transform from 'base' up to 'moon'"):
        open_log(two, Stated(reference="moon=icrs", body="base"))
    with pytest.raises(InputError, match="refer to the frame 'map'; state its axes"):
        open_log(two, Stated(body="odom"))


def test_a_tf_that_is_no_tree_is_refused(bag):
    circle = bag(tree([("a", "b", rotations(2)), ("b", "a", [rotations(1)[0]] * 2)]))
    with pytest.raises(InputError, match="tf goes in a circle at"):
        open_log(circle, Stated(reference="icrs", body="b"))
    parents = bag(tree([("a", "b", rotations(2)), ("c", "b", rotations(2))]))
    with pytest.raises(InputError, match="'b' has several parents: a -> b, c -> b"):
        open_log(parents, Stated(reference="icrs", body="b"))
