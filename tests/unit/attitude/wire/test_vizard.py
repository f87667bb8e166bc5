"""Basilisk's messages: what SciPy makes of the same parameters, rates by differences, and bytes
that are none.
"""

from __future__ import annotations

import re
import time
from contextlib import closing

import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.wire.links import Arrival, TrackerCamera
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, Status
from hilstar.attitude.wire.roads import RawMessage
from hilstar.attitude.wire.source import CHECK_RADEC_DEG, Mounting
from hilstar.attitude.wire.vizard import (
    CONVENTIONS,
    MAX_HELD_NS,
    BroadcastDecoder,
    DifferenceRates,
    Follower,
    Opening,
    VizardLive,
    disagreement,
    q_body_to_cam,
    quaternion_of_mrp,
    update_of,
)
from hilstar.attitude.wire.vizard_message import MAX_PARTS, decode_update
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import to_radec_roll_deg
from hilstar.basics.units import NS_PER_S
from tests.support.sources.viz_message import craft, viz_message
from tests.support.waiting import PATIENCE_S

ROUNDING_RAD = 1e-14  # some products of float64 rotations
DIGITS_DEG = np.degrees(4e-7)  # seven digits of each MRP, and the angle is four times its change
STEP_NS = 20_000_000
QUICK_S = 1.0  # a refusal takes milliseconds; what reads on takes minutes


def follower(
    name: str | None = None, mounting: Mounting | None = None, max_rate_rad_s: float = 1.0
) -> Follower:
    return Follower(name, mounting or Mounting(), DifferenceRates(10 * STEP_NS, max_rate_rad_s))


def taken(message: bytes, by: Follower | None = None) -> AttitudeSample | Refusal:
    return (by or follower()).take(message)[0]


def rotation_of(sample: AttitudeSample | Refusal) -> Rotation:
    assert isinstance(sample, AttitudeSample), sample
    return Rotation.from_quat(sample.q_icrs_to_cam, scalar_first=True)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("shadow", [False, True])
def test_an_mrp_and_its_shadow_are_the_frame_s_turn_and_the_mounting_comes_after(
    seed: int, shadow: bool
) -> None:
    """SciPy's parameters turn a vector, Basilisk's a frame: [BN] is the inverse."""
    rng = np.random.default_rng(seed)
    body_from_n, pose = Rotation.random(rng=rng), Rotation.random(rng=rng)
    sigma = body_from_n.inv().as_mrp()
    if shadow:
        sigma = -sigma / (sigma @ sigma)
    mounting = Mounting(tuple(pose.as_quat(scalar_first=True).tolist()))
    sample = taken(viz_message(spacecraft=[craft(sigma=sigma)]), follower(mounting=mounting))
    star = rng.normal(size=3)
    assert rotation_of(sample).apply(star) == pytest.approx(
        pose.apply(body_from_n.apply(star)), abs=10 * ROUNDING_RAD
    )


def test_time_and_number_are_the_simulation_s() -> None:
    """The time, a float64, is told to the nearest ns."""
    for off_ns, t_ns in ((0.0, 123_456_789_012), (0.75, 123_456_789_013), (-0.75, 123_456_789_011)):
        sample = taken(viz_message(123_456_789_012.0 + off_ns, [craft()], frame=2**32 + 5))
        assert isinstance(sample, AttitudeSample)
        assert (sample.t_ns, sample.sequence, sample.rate_cam_rad_s) == (t_ns, 5, None)


def test_the_self_check_points_where_it_says() -> None:
    pose = Mounting((0.6, 0.48, 0.64, 0.0))
    match = re.search(r"sigma_BN = \(([-0-9., ]+)\)", CONVENTIONS.lines(pose)[-1])
    assert match is not None
    sigma = [float(number) for number in match[1].split(",")]
    sample = taken(viz_message(spacecraft=[craft(sigma=sigma)]), follower(mounting=pose))
    assert isinstance(sample, AttitudeSample)
    assert to_radec_roll_deg(sample.q_icrs_to_cam)[:2] == pytest.approx(
        CHECK_RADEC_DEG, abs=DIGITS_DEG
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_attitude_of_either_sign_is_written_as_the_shorter_set(
    rng: np.random.Generator, sign: float
) -> None:
    for turn in Rotation.random(5, rng=rng):
        q = sign * turn.as_quat(canonical=True, scalar_first=True)
        words = re.findall(r"-?[0-9.]+", CONVENTIONS.written(q))
        # SciPy's parameters turn a vector, Basilisk's a frame
        assert [float(word) for word in words] == pytest.approx(turn.inv().as_mrp(), abs=1e-7)


# Rates


def turn_at(t_s: float) -> Rotation:
    """Of a body about its z axis, through Basilisk's switch to the shadow."""
    return Rotation.from_rotvec([0, 0, 3.1 + 0.1 * t_s + 0.005 * t_s**2])


def rates_of_body(times_ns: list[int], max_rate_rad_s: float = 1.0) -> list[np.ndarray | None]:
    """The rates of that body."""
    by, rates = follower(max_rate_rad_s=max_rate_rad_s), []
    for t_ns in times_ns:
        sample = taken(viz_message(float(t_ns), [craft(sigma=turn_at(t_ns / 1e9).as_mrp())]), by)
        assert isinstance(sample, AttitudeSample)
        rates.append(sample.rate_cam_rad_s)
    return rates


def test_a_rate_is_that_of_its_own_moment_and_the_shadow_switch_is_no_turn() -> None:
    """A constant acceleration is followed exactly, which the last difference alone would miss by
    0.01 * h / 2; steps vary.
    """
    times_ns = [STEP_NS * k for k in (0, 1, 2, 4, 5, 9, 10, *range(11, 60))]
    rates = rates_of_body(times_ns)
    assert rates[:2] == [None, None]
    for t_ns, rate in list(zip(times_ns, rates, strict=True))[2:]:
        assert rate == pytest.approx([0, 0, 0.1 + 0.01 * t_ns / 1e9], abs=1e-11)


def test_an_acceleration_goes_with_the_rate_and_the_timeline_carries_both_on() -> None:
    """Held to the rate alone it would be 0.01 * 0.1^2 / 2 = 5e-5 rad off after 0.1 s."""
    timeline, by = (
        Timeline(Policy(NS_PER_S, NS_PER_S)),
        follower(mounting=Mounting((0.6, 0.48, 0.64, 0.0))),
    )
    for k in range(4):
        sample = taken(viz_message(k * 2e7, [craft(sigma=turn_at(k * 0.02).as_mrp())]), by)
        assert isinstance(sample, AttitudeSample)
        timeline.add(sample)
    later = timeline.at(160_000_000)
    assert later is not None
    true = Rotation.from_quat([0.6, 0.48, 0.64, 0.0], scalar_first=True) * turn_at(0.16).inv()
    assert (rotation_of(AttitudeSample(0, later.q_icrs_to_cam)) * true.inv()).magnitude() < 1e-11
    pose = Rotation.from_quat([0.6, 0.48, 0.64, 0.0], scalar_first=True)
    assert later.rate_cam_rad_s == pytest.approx(pose.apply([0, 0, 0.1016]), abs=1e-10)


def test_the_very_first_two_wait_for_the_third_and_no_others() -> None:
    by, opening, passed = follower(), Opening(), []
    now_ns = 0
    for t_s in (0.0, 0.02, 0.04, 0.06, 0.5, 0.52, 0.02, 0.04, 0.06, 0.08):
        now_ns += STEP_NS
        event = taken(viz_message(t_s * 1e9, [craft(sigma=turn_at(t_s).as_mrp())]), by)
        went = opening.passed(
            [Arrival(now_ns, Refusal("format", "")), Arrival(now_ns, event)], now_ns
        )
        passed.append(
            [each.event.t_ns / 1e9 for each in went if isinstance(each.event, AttitudeSample)]
        )
        assert sum(isinstance(each.event, Refusal) for each in went) == 1
    assert passed == [
        [],
        [],
        [0, 0.02, 0.04],
        [0.06],
        [0.5],
        [0.52],
        [0.02],
        [0.04],
        [0.06],
        [0.08],
    ]


def test_a_simulation_with_long_steps_is_not_held_for_long() -> None:
    opening = Opening()
    only = Arrival(5, taken(viz_message(spacecraft=[craft()])))
    assert opening.passed([only], 5) == []
    assert opening.passed([], 5 + MAX_HELD_NS) == []
    assert opening.passed([], 6 + MAX_HELD_NS) == [only]


def test_what_is_held_back_waits_by_the_first_one_s_arrival() -> None:
    """And what is no attitude passes at once."""
    opening = Opening()
    first, second = (
        Arrival(host_ns, taken(viz_message(spacecraft=[craft()]))) for host_ns in (5, MAX_HELD_NS)
    )
    refused = Arrival(7, Refusal("format", "none"))
    assert opening.passed([first, refused], 5) == [refused]
    assert opening.passed([second], MAX_HELD_NS) == []
    assert opening.passed([], 6 + MAX_HELD_NS) == [first, second]


def test_a_message_that_may_have_waited_says_for_how_long_whatever_it_holds() -> None:
    update = (b"SIM_UPDATE", viz_message(spacecraft=[craft()]))
    messages = [
        RawMessage(70, update, 50, timely=False),
        RawMessage(80, (b"another word",), 55, timely=False),
        RawMessage(90, update, 60),
    ]
    arrivals = BroadcastDecoder(follower()).arrivals(messages)
    waited_ns = {arrival.host_ns: arrival.waited_ns for arrival in arrivals}
    assert waited_ns == {70: 20, 80: 25, 90: 0}


def test_no_rate_across_a_silence_a_jump_or_a_restart() -> None:
    k = [0, 1, 2, 20, 21, 22, 5, 6, 7]
    known = [rate is not None for rate in rates_of_body([STEP_NS * each for each in k])]
    assert known == [False, False, True, False, False, True, False, False, True]
    assert rates_of_body([STEP_NS * each for each in range(4)], max_rate_rad_s=0.05) == [None] * 4


@pytest.mark.parametrize(("second_rad_s", "is_known"), [(0.85, True), (0.91, False)])
def test_a_rate_that_exceeds_the_limit_where_it_is_carried_on_is_none(
    second_rad_s: float, is_known: bool
) -> None:
    """From means of 0.7 and of the second: 0.925 and 1.015 rad/s at the end, of 1 that may be."""
    turns_rad = np.cumsum([0.0, 0.7, second_rad_s]) * STEP_NS / NS_PER_S
    rates = DifferenceRates(STEP_NS, 1.0)
    for k, turn_rad in enumerate(turns_rad):
        q = Rotation.from_rotvec([0, 0, -turn_rad]).as_quat(scalar_first=True)
        sample = rates.moving(AttitudeSample(k * STEP_NS, q))
    assert (sample.rate_cam_rad_s is not None) == is_known
    if is_known:
        step_s = STEP_NS / NS_PER_S
        assert sample.rate_cam_rad_s == pytest.approx([0, 0, 0.925], abs=1e-10)
        assert sample.acceleration_cam_rad_s2 == pytest.approx([0, 0, 0.15 / step_s], abs=1e-8)


# Which spacecraft


def test_the_named_spacecraft_is_followed_and_without_a_name_the_only_one() -> None:
    pair = [
        craft("a", (0.1, 0, 0)),
        craft("b", (0, 0.1, 0)),
        craft("panel", (0, 0, 0.1), parentSpacecraftName="a"),
    ]
    assert rotation_of(taken(viz_message(spacecraft=pair), follower("b"))).as_mrp()[
        1
    ] == pytest.approx(-0.1)
    assert rotation_of(taken(viz_message(spacecraft=pair), follower("panel"))).as_mrp()[
        2
    ] == pytest.approx(-0.1)
    assert rotation_of(taken(viz_message(spacecraft=pair[::2]))).as_mrp()[0] == pytest.approx(-0.1)


@pytest.mark.parametrize(
    ("names", "wanted", "words"),
    [
        (
            ["a", "b"],
            None,
            'spacecraft: a, b; write the one that is meant, [attitude] spacecraft = "NAME"',
        ),
        ([], None, "spacecraft: none; write"),
        (["a"], "c", "spacecraft = c: 0 have that name; there: a"),
        (["a", "a"], "a", "spacecraft = a: 2 have that name"),
        (["", "\x1b[2J"], None, "spacecraft: one without a name, \\x1b[2J; write"),
    ],
)
def test_any_other_choice_is_refused_by_the_names_that_are_there(names, wanted, words) -> None:
    refusal = taken(viz_message(spacecraft=[craft(name) for name in names]), follower(wanted))
    assert isinstance(refusal, Refusal)
    assert refusal.reason == "format"
    assert words in refusal.detail


# Bytes that are none


@pytest.mark.parametrize(
    ("message", "reason", "words"),
    [
        (b"", "format", "no currentTime"),
        (viz_message(None, [craft()]), "format", "no currentTime"),
        (viz_message(float("nan"), [craft()]), "format", "simTimeElapsed nan"),
        (viz_message(1e30, [craft()]), "format", "simTimeElapsed 1e+30"),
        (viz_message(spacecraft=[craft(sigma=())]), "format", "0 components of its rotation"),
        (viz_message(spacecraft=[craft(sigma=(1, 2))]), "format", "2 components of its rotation"),
        (
            viz_message(spacecraft=[craft(sigma=(1, 2, 3, 4))]),
            "format",
            "4 components of its rotation",
        ),
        (viz_message(spacecraft=[craft(sigma=(float("nan"), 0, 0))]), "nan", "not finite"),
        (viz_message(spacecraft=[craft(sigma=(float("inf"), 0, 0))]), "nan", "not finite"),
        (b"\x0a\xff\xff\xff\xff\x0f", "format", "cut short"),
        (b"\x08" + b"\xff" * 11, "format", "no protobuf message"),
        (b"\x00\x01", "format", "no protobuf message"),
        (b"\x0b", "format", "no protobuf message"),
        (b"\x08\x05", "format", "no currentTime"),
        (b"\x0a\x02\x10\x05", "format", "spacecraft: none"),
        (b"\x1a\x03\x22\x01\x00", "format", "no protobuf message"),
        (b"\x28\x01" * 500_000, "format", "no currentTime"),
        ((b"\x1a\x7e" + b"\x28\x01" * 63) * 30_000, "format", f"over {MAX_PARTS} spacecraft"),
        (b"\x1a\x00" * 2**21, "format", f"over {MAX_PARTS} spacecraft"),
        (
            b"\x0a\x00\x1a\x80\x80\x80\x01" + b"\x22\xfc\xff\x7f" + bytes(2**21 - 4),
            "format",
            "no protobuf message",
        ),
    ],
)
def test_what_is_no_message_is_refused_with_what_is_wrong(
    message: bytes, reason: str, words: str
) -> None:
    begun_s = time.thread_time()
    refusal = taken(message)
    assert isinstance(refusal, Refusal)
    assert refusal.reason == reason
    assert words in refusal.detail
    assert time.thread_time() - begun_s < QUICK_S


def test_a_message_that_is_cut_short_anywhere_gives_no_other_attitude() -> None:
    """Where it is cut between fields it may still be whole: then what is left is unchanged."""
    message = viz_message(
        spacecraft=[craft()],
        cameras=[{"cameraID": 1, "resolution": [8, 9], "cameraDir_B": [0, 0, 0]}],
    )
    whole = rotation_of(taken(message))
    for end in range(len(message)):
        event = taken(message[:end])
        assert (
            isinstance(event, Refusal)
            or (rotation_of(event) * whole.inv()).magnitude() < ROUNDING_RAD
        )


@given(st.binary(max_size=200))
def test_any_bytes_give_one_event(noise: bytes) -> None:
    for message in (
        noise,
        viz_message(spacecraft=[craft()]) + noise,
        b"\x1a" + bytes([len(noise) % 128]) + noise,
    ):
        assert isinstance(taken(message), AttitudeSample | Refusal)


def test_an_mrp_of_any_length_is_a_unit_quaternion(rng: np.random.Generator) -> None:
    for length in (0.0, 1e-300, 1e-8, 1.0, 1e8, 1e160, 1e300):
        sigma = rng.normal(size=3)
        sigma *= length / np.linalg.norm(sigma)
        assert np.linalg.norm(quaternion_of_mrp(tuple(sigma.tolist()))) == pytest.approx(
            1, abs=1e-15
        )


def test_old_encoders_that_do_not_pack_are_read_too() -> None:
    sigma = b"".join(b"\x21" + np.array([c], "<f8").tobytes() for c in (0.1, 0.2, 0.3))
    unpacked = viz_message() + b"\x1a" + bytes([len(sigma) + 3]) + b"\x0a\x01a" + sigma
    packed = viz_message(spacecraft=[craft("a")])
    assert (
        rotation_of(taken(unpacked)) * rotation_of(taken(packed)).inv()
    ).magnitude() < ROUNDING_RAD


# Links and cameras


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([b"SIM_UPDATE", b"x"], b"x"),
        ([b"SIM_UPDATE", b"", b"", b"x"], b"x"),
        ([b"SIM_UPDATE"], None),
        ([b"SIM_UPDATE", b"y", b"x"], None),
        ([b"SIM_UPDATES", b"x"], None),
        ([b"SYNC_SETTINGS", b"x"], None),
    ],
)
def test_a_message_is_the_last_part_after_the_word(parts, message) -> None:
    assert update_of(parts) == message


def test_a_camera_that_is_not_the_bench_s_tracker_is_told_by_what_differs() -> None:
    """Its mounting goes out as Unity's; here it comes back, by SciPy."""
    pose = Rotation.from_quat([0.6, 0.48, 0.64, 0.0], scalar_first=True)
    to_unity = Rotation.from_mrp([1 / 3, 1 / 3, -1 / 3]).inv()
    sent = {
        "cameraID": 4,
        "fieldOfView": 10.0,
        "resolution": [1024, 512],
        "cameraDir_B": (to_unity * pose).inv().as_mrp(),
    }
    (camera,) = decode_update(viz_message(spacecraft=[craft()], cameras=[sent])).cameras
    mounted = q_body_to_cam(camera)
    assert mounted is not None
    assert (Rotation.from_quat(mounted, scalar_first=True) * pose.inv()).magnitude() < ROUNDING_RAD
    assert disagreement(camera, TrackerCamera(mounted, (1024, 512), 10.05)) is None
    turned = (Rotation.from_rotvec([0, 0, np.radians(0.1)]) * pose).as_quat(scalar_first=True)
    told = disagreement(camera, TrackerCamera(turned, (1024, 1024), 20.0))
    assert told is not None
    for words in (
        "camera 4",
        "0.1 deg from the bench's",
        "1024 x 512 px, not 1024 x 1024",
        "10 deg, not 20",
    ):
        assert words in told


# Velocity


def test_a_velocity_goes_with_the_attitude_in_km_s_where_it_is_wanted() -> None:
    message = viz_message(spacecraft=[craft(velocity=[1000.0, -7500.0, 0.0])])
    rates = DifferenceRates(STEP_NS, 1.0)
    with_it = taken(message, Follower(None, Mounting((0.0, 1.0, 0.0, 0.0)), rates, "velocity"))
    assert isinstance(with_it, AttitudeSample)
    assert with_it.velocity_km_s is not None
    assert with_it.velocity_km_s.tolist() == [1.0, -7.5, 0.0], "ICRS, which no mounting turns"
    assert decode_update(message).spacecraft[0].position_m == (7e6, 0, 0)
    without = taken(message)
    assert isinstance(without, AttitudeSample)
    assert without.velocity_km_s is None


@pytest.mark.parametrize(
    ("velocity", "words"),
    [
        ([], "is nothing"),
        ([1.0, 2.0], "is 2.24 m/s"),
        ([3e8, 0, 0], "is 3e+08 m/s"),
        ([0, 0, 1.01e7], "is 1.01e+07 m/s"),
        ([float("nan"), 0, 0], "is nan m/s"),
    ],
)
def test_a_velocity_that_is_none_is_refused_with_the_key_that_leaves_it_out(
    velocity, words
) -> None:
    by = Follower(None, Mounting(), DifferenceRates(STEP_NS, 1.0), "velocity")
    refusal = taken(viz_message(spacecraft=[craft(velocity=velocity)]), by)
    assert isinstance(refusal, Refusal)
    assert words in refusal.detail
    assert "[attitude] use_velocity = false" in refusal.detail


# Place


RATES = DifferenceRates(STEP_NS, 1.0)
SUN_CENTRED = {
    "bodyName": "earth",
    "position": [1.4e11, 2e10, 0.0],
    "velocity": [-4e3, 29e3, 0.0],
    "rotation": [1.0] * 9,
}


@pytest.mark.parametrize(
    "bodies", [[], [SUN_CENTRED], [{"bodyName": "sun", "position": [1.0, 2.0, 3.0]}, SUN_CENTRED]]
)
def test_a_place_is_about_the_earth_wherever_the_message_has_it(bodies) -> None:
    origin = SUN_CENTRED if bodies else {"position": [0.0] * 3, "velocity": [0.0] * 3}
    here = craft(
        position=[7e6 + origin["position"][0], origin["position"][1], -1e3],
        velocity=[origin["velocity"][0], 7500.0 + origin["velocity"][1], 0.0],
    )
    by = Follower(None, Mounting((0.0, 1.0, 0.0, 0.0)), DifferenceRates(STEP_NS, 1.0), "state")
    sample = taken(viz_message(spacecraft=[here], bodies=bodies), by)
    assert isinstance(sample, AttitudeSample)
    assert sample.place_km == pytest.approx([7000.0, 0.0, -1.0])
    assert sample.velocity_km_s == pytest.approx([0.0, 7.5, 0.0])
    assert "observer" in by.conventions.turns


@pytest.mark.parametrize(
    ("position", "words"),
    [
        ([], "is nowhere"),
        ([7e6, 0.0], "is 7000 km from"),
        ([7e3, 0, 0], "is 7 km from"),
        ([1.5e11, 0, 0], "is 1.5e+08 km from"),
        ([float("nan"), 0, 0], "is nan km"),
        ([float("inf"), 0, 0], "is inf km"),
    ],
)
def test_a_place_that_is_none_is_refused_with_what_is_taken(position, words) -> None:
    refusal = taken(
        viz_message(spacecraft=[craft(position=position)]),
        Follower(None, Mounting(), RATES, "state"),
    )
    assert isinstance(refusal, Refusal)
    assert words in refusal.detail
    assert '[spacecraft] orbit = "source" takes 6000 to 1e+07 km' in refusal.detail


# In Vizard's place

NO_STATUS = Status(0, 0, 0, 0, 0, 0, 0)


def test_each_request_has_one_answer_whatever_it_asks() -> None:
    """Basilisk's words over a real socket, and some that are none; an image without an attitude
    is an empty one.
    """
    notices = Notices()
    with (
        VizardLive("tcp://127.0.0.1:*", follower(), notices=notices) as link,
        zmq.Context() as context,
        closing(context.socket(zmq.REQ)) as basilisk,
    ):
        basilisk.connect(link.endpoint)
        link.show_camera(
            TrackerCamera(np.array([1.0, 0.0, 0.0, 0.0]), (100, 100), 10.0), lambda sample: b"png"
        )
        camera = {"cameraID": 7, "fieldOfView": 20.0, "resolution": [100, 100]}
        update = viz_message(spacecraft=[craft()], cameras=[camera])
        for request, answer in (
            ([b"PING"], [b"PONG"]),
            ([b"REQUEST_IMAGE_7"], [b"\0\0\0\0", b""]),
            ([b"SIM_UPDATE", b"", b"", update], [b"OK"]),
            ([b"REQUEST_IMAGE_7"], [b"\0\0\0\3", b"png"]),
            ([b"REQUEST_IMAGE_7"], [b"\0\0\0\3", b"png"]),
            ([b"SIM_UPDATE", b"", b"", update[:-3]], [b"ERROR"]),
            ([b"REQUEST_INPUT"], [b"VIZARD_INPUT", b""]),
            ([b"REQUEST_IMAGE_7"], [b"\0\0\0\0", b""]),
            ([b"SIM_UPDATE", b"", b"", update], [b"OK"]),
            ([b"SIM_UPDATE"], [b"ERROR"]),
            ([b"REQUEST_IMAGE_7"], [b"\0\0\0\0", b""]),
            ([b"REQUEST_IMAGE_seven"], [b"ERROR"]),
            ([b"anything", b"else"], [b"ERROR"]),
            ([b""], [b"ERROR"]),
        ):
            basilisk.send_multipart(request)
            asked = link.receive(PATIENCE_S * 1000)
            if asked is not None:
                link.answer(
                    NO_STATUS,
                    asked.host_ns,
                    asked.event if isinstance(asked.event, Refusal) else None,
                )
            assert basilisk.poll(PATIENCE_S * 1000), request
            assert basilisk.recv_multipart() == answer
    assert notices.counts() == {"unknown-request": 3, "other-camera": 1}
