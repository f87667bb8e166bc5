"""What a bag means: topics, frames, tf, rates, times; what it does not say is stated or refused,
never guessed.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.earth import (
    earth_rate_ned_rad_s,
    q_icrs_to_enu,
    q_icrs_to_ned,
    utc_ns_of,
)
from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log
from hilstar.attitude.logs.ros import named
from hilstar.attitude.wire.source import CHECK_RADEC_DEG, Mounting
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import to_radec_roll_deg
from tests.support.refusals import refusal
from tests.support.sources import ros_bags
from tests.support.sources.ros_bags import START_NS
from tests.support.sources.ros_poses import (
    MAKE,
    attitudes_of,
    pose,
    poses,
    recorded_in_turn,
    rotations,
    wxyz,
)

PLACE = (48.1, 11.6, 500.0)
# A chain of four products of unit quaternions in float64.
ROUNDING = 1e-14
# The motion of one step of 10 ms is a rotation about one axis; a rate of 0.4 rad/s is then exact
# but for rounding over 10 ms.
RATE_ROUNDING = 1e-9


# Frames


@pytest.mark.parametrize("frame", ["icrs", "GCRF", "/j2000", "eme2000"])
def test_a_frame_whose_name_is_the_icrs_needs_nothing_stated(bag, frame):
    log = open_log(bag(poses(frame, rotations(3))))
    assert (attitudes_of(log) * rotations(3)).magnitude() == pytest.approx(0, abs=ROUNDING)
    assert all(kind != "reference" for kind, _ in log.told)


def test_an_inertial_frame_of_no_date_is_taken_and_said(bag):
    log = open_log(bag(poses("eci", rotations(3))))
    assert any("'eci' is taken as the ICRS" in line for _, line in log.told)


@pytest.mark.parametrize("frame", ["map", "odom", "world", "base_link", ""])
def test_any_other_frame_is_what_is_stated(bag, frame):
    path = bag(poses(frame, rotations(3)))
    log = open_log(path, Stated(reference="icrs"))
    assert (attitudes_of(log) * rotations(3)).magnitude() == pytest.approx(0, abs=ROUNDING)
    assert any("is taken as the ICRS, as stated" in line for _, line in log.told)


@pytest.mark.parametrize(("stated", "turn"), [("enu", q_icrs_to_enu), ("ned", q_icrs_to_ned)])
def test_a_level_frame_turns_with_the_earth(bag, stated, turn):
    """The truth is a body in the ICRS; the bag has its orientation in the level frame of each
    moment.
    """
    truth, times = rotations(5), START_NS + 10**8 * np.arange(5)
    level = Rotation.from_quat(turn(times, PLACE[0], PLACE[1]), scalar_first=True)
    log = open_log(bag(poses("map", level * truth.inv())), Stated(reference=stated, place=PLACE))
    assert (attitudes_of(log) * truth.inv()).magnitude() == pytest.approx(0, abs=ROUNDING)


def test_a_simulated_clock_gets_its_date_from_the_user(bag):
    turned = rotations(3)
    simulated = open_log(
        bag(poses("map", turned, start_ns=5 * 10**9)),
        Stated(reference="enu", place=PLACE, epoch_utc="2025-11-22T08:26:35"),
    )
    dated = open_log(bag(poses("map", turned)), Stated(reference="enu", place=PLACE))
    assert utc_ns_of("2025-11-22T08:26:35", "") == START_NS - 5 * 10**9
    assert (attitudes_of(simulated) * attitudes_of(dated).inv()).magnitude() == pytest.approx(
        0, abs=ROUNDING
    )
    assert simulated.samples[0].t_ns == 5 * 10**9


@pytest.mark.parametrize("reference", ["icrs", "enu", "ned"])
def test_the_self_check_of_a_bag_points_where_it_says(bag, reference):
    """The orientation that --explain shows, recorded, looks at the star that it names."""
    place = None if reference == "icrs" else PLACE
    stated = Stated(Mounting((0.5, -0.5, 0.5, -0.5)), reference=reference, place=place)
    line = open_log(bag(poses("map", rotations(1))), stated).conventions.lines(stated.mounting)[-1]
    x, y, z, w = map(float, re.search(r"x y z w = \((.*?)\)", line)[1].split(","))
    shown = open_log(bag(poses("map", [Rotation.from_quat([x, y, z, w])])), stated)
    digits_deg = np.degrees(2e-7)  # the line has seven digits
    assert to_radec_roll_deg(shown.samples[0].q_icrs_to_cam)[:2] == pytest.approx(
        CHECK_RADEC_DEG, abs=digits_deg
    )


# Rates


def spinning(kind, frame, rate, earths, count=4):
    """A body that turns at a constant rate (body components) in the stars' frame, as recorded in
    a frame that turns too.
    """
    times = START_NS + 10**7 * np.arange(count)
    begin = rotations(1)[0]
    for i, t_ns in enumerate(times.tolist()):
        body_from_icrs = Rotation.from_rotvec(-np.asarray(rate) * 0.01 * i) * begin
        level = Rotation.from_quat(
            earths(np.array([t_ns]), PLACE[0], PLACE[1])[0], scalar_first=True
        )
        frame_from_body = level * body_from_icrs.inv()
        told = rate
        if kind == ros_bags.ODOMETRY:  # its twist is with respect to the frame that it refers to
            north, east, down = earth_rate_ned_rad_s(PLACE[0])
            own = (east, north, -down) if earths is q_icrs_to_enu else (north, east, down)
            told = rate - frame_from_body.inv().apply(own)
        yield "/a", kind, t_ns, MAKE.of(kind, t_ns, frame, "imu_link", wxyz(frame_from_body), told)


@pytest.mark.parametrize("kind", [ros_bags.IMU, ros_bags.ODOMETRY])
@pytest.mark.parametrize(("stated", "earths"), [("enu", q_icrs_to_enu), ("ned", q_icrs_to_ned)])
def test_a_rate_is_with_respect_to_the_stars_in_the_bodys_components(bag, kind, stated, earths):
    rate = np.array([0.2, -0.3, 0.1])
    log = open_log(bag(spinning(kind, "map", rate, earths)), Stated(reference=stated, place=PLACE))
    turns = attitudes_of(log)
    for before, after, sample in zip(turns[:-1], turns[1:], log.samples, strict=False):
        assert -(after * before.inv()).as_rotvec() / 0.01 == pytest.approx(rate, abs=RATE_ROUNDING)
        assert sample.rate_cam_rad_s == pytest.approx(rate, abs=RATE_ROUNDING)


def test_a_mounting_turns_attitude_and_rate_of_the_body(bag):
    mounted = Mounting(tuple(wxyz(rotations(1, seed=5)[0]).tolist()))
    sent = list(spinning(ros_bags.IMU, "", np.array([0.2, -0.3, 0.1]), q_icrs_to_enu))
    plain = open_log(bag(sent), Stated(reference="icrs"))
    turned = open_log(bag(sent), Stated(mounted, reference="icrs"))
    body_to_cam = Rotation.from_quat(mounted.q_body_to_cam, scalar_first=True)
    assert (
        attitudes_of(turned) * attitudes_of(plain).inv() * body_to_cam.inv()
    ).magnitude() == pytest.approx(0, abs=ROUNDING)
    assert turned.samples[0].rate_cam_rad_s == pytest.approx(
        body_to_cam.apply([0.2, -0.3, 0.1]), abs=ROUNDING
    )


def test_an_imu_without_rate_gives_its_orientation(bag):
    still = [
        ("/imu", ros_bags.IMU, t, MAKE.imu(t, "imu", (1, 0, 0, 0), (9, 9, 9), rate0=-1))
        for t in (START_NS, START_NS + 10**7)
    ]
    assert [
        sample.rate_cam_rad_s for sample in open_log(bag(still), Stated(reference="icrs")).samples
    ] == [None, None]


def test_an_optical_frame_with_a_mounting_is_said(bag):
    sent = [
        (
            "/imu",
            ros_bags.IMU,
            START_NS,
            MAKE.imu(START_NS, "star_camera_optical_frame", (1, 0, 0, 0), (0, 0, 0)),
        )
    ]
    turned = Stated(Mounting((0.5, 0.5, 0.5, 0.5)), reference="icrs")
    assert any(
        "has the axes of a camera by its name" in line
        for _, line in open_log(bag(sent), turned).told
    )
    assert not any(
        "axes of a camera" in line for _, line in open_log(bag(sent), Stated(reference="icrs")).told
    )


# Topics and bodies


def test_of_several_topics_one_is_chosen_by_name(bag):
    names = ("/0/a/pose", "/a/pose", "/b/pose", "/z/a/pose")
    sent = []
    for count, name in enumerate(names, start=1):
        sent += poses("icrs", rotations(count), name)
    path = bag(sent)
    assert len(open_log(path, Stated(topic="/b/pose")).samples) == 3
    assert len(open_log(path, Stated(topic="a/pose")).samples) == 2


def test_of_several_bodies_on_one_topic_one_is_chosen(bag):
    kind = ros_bags.TRANSFORM_STAMPED
    sent = [
        (
            "/vicon",
            kind,
            START_NS + i,
            MAKE.transform_stamped(START_NS + 10**7 * i, "icrs", child, wxyz(turn)),
        )
        for i, turn in enumerate(rotations(4))
        for child in ("one", "two")
    ]
    assert len(open_log(bag(sent), Stated(body="two")).samples) == 4


NUMBERS = "float64 w\nfloat64 x\nfloat64 y\nfloat64 z\n"
OTHER_FIELDS = f"std_msgs/Header header\n{NUMBERS}"
PART = "=" * 80 + "\nMSG: "
OTHER_INNER = (
    "std_msgs/Header header\ngeometry_msgs/Quaternion quaternion\n"
    f"{PART}geometry_msgs/Quaternion\n{NUMBERS}"
    f"{PART}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{PART}builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)


@pytest.mark.parametrize("text", [OTHER_FIELDS, OTHER_INNER], ids=["its own", "its inner type's"])
def test_a_type_that_only_has_the_name_of_ross_own_is_refused(tmp_path, text):
    from mcap.writer import Writer

    kind = "geometry_msgs/msg/QuaternionStamped"
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema(kind, "ros2msg", text.encode())
        writer.add_message(writer.register_channel("/q", "cdr", schema), 0, b"\0\1\0\0", 0)
        writer.finish()
    with pytest.raises(InputError, match=f"/q: its {kind} is not ROS's own"):
        open_log(tmp_path / "a.mcap")


# Times


def test_messages_out_of_order_and_doubled_are_put_right_and_said(bag):
    sent = list(poses("icrs", rotations(6)))
    shuffled = [sent[0], sent[2], sent[1], sent[1], *sent[3:], sent[5]]
    log = open_log(bag(recorded_in_turn(shuffled)))
    assert (attitudes_of(log) * rotations(6)).magnitude() == pytest.approx(0, abs=ROUNDING)
    told = dict(log.told)
    assert told["log-order"] == "2 attitudes came out of order, by up to 0.1 s, and are sorted"
    assert told["log-repeats"] == "2 attitudes are exact repeats of the one before, and are dropped"


def test_messages_without_a_stamp_take_the_recorders_clock_and_say_so(bag):
    sent = [pose("icrs", (1, 0, 0, 0), 0, at_ns=t_ns) for t_ns in (5, 9)]
    log = open_log(bag(sent))
    assert [sample.t_ns for sample in log.samples] == [5, 9]
    assert (
        "have no time of their own; when they were recorded is taken" in dict(log.told)["log-stamp"]
    )


def test_a_simulated_clock_may_begin_at_zero(bag):
    """Recorded on a day, which is not the time of its attitudes."""
    sent = [
        (topic, kind, START_NS + i, message)
        for i, (topic, kind, _, message) in enumerate(poses("icrs", rotations(3), start_ns=0))
    ]
    log = open_log(bag(sent))
    assert [sample.t_ns for sample in log.samples] == [0, 10**8, 2 * 10**8]
    assert log.conventions.time == "header.stamp: seconds of a simulated clock"


@pytest.mark.parametrize(
    ("reference", "frame", "kind"),
    [
        (None, None, None),
        ("map", "map", None),
        ("icrs", None, "icrs"),
        ("ICRS", None, "icrs"),
        ("map=ICRS", "map", "icrs"),
        ("map=icrs", "map", "icrs"),
        ("a=b=Icrs", "a=b", "icrs"),
        ("=icrs", None, "icrs"),
    ],
)
def test_a_reference_names_a_frame_its_axes_or_both_in_any_case(reference, frame, kind):
    assert named(reference) == (frame, kind)


@pytest.mark.parametrize("reference", ["map=", "map=north", "icrs=map"])
def test_axes_that_are_none_are_refused(reference):
    line = refusal(named, reference)
    assert line.startswith(f"--reference {reference}: the axes of ")
