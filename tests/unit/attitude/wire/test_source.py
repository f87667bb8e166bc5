"""A body's attitude and rate become the camera's, and the self-check's attitude points where it
says.
"""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.source import (
    CHECK_RADEC_DEG,
    PACKETS,
    Convention,
    Conventions,
    Mounting,
    components,
    packet_conventions,
)
from hilstar.basics.rotation import to_radec_roll_deg

# Three products of float64 rotations.
ROUNDING = 1e-14
# The self-check's text has seven digits of each component, which is 1e-7 rad at most.
DIGITS_DEG = np.degrees(2e-7)
BODY = Conventions("a body", "", "", "", of_body=True, written=lambda q: f"q = {components(q)}")


def random_rotations(rng: np.random.Generator) -> tuple[Rotation, Rotation]:
    return Rotation.random(rng=rng), Rotation.random(rng=rng)


def scalar_first(rotation: Rotation) -> tuple[float, float, float, float]:
    w, x, y, z = rotation.as_quat(scalar_first=True).tolist()
    return w, x, y, z


@pytest.mark.parametrize("seed", range(20))
def test_the_camera_sees_what_a_vector_turned_twice_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    icrs_to_body, body_to_cam = random_rotations(rng)
    star, rate = rng.normal(size=3), rng.normal(size=3)
    body = AttitudeSample(5, np.array(scalar_first(icrs_to_body)), rate)
    cam = Mounting(scalar_first(body_to_cam)).sample(body)
    found = Rotation.from_quat(cam.q_icrs_to_cam, scalar_first=True).apply(star)
    assert found == pytest.approx(body_to_cam.apply(icrs_to_body.apply(star)), abs=ROUNDING * 10)
    assert cam.rate_cam_rad_s == pytest.approx(body_to_cam.apply(rate), abs=ROUNDING * 10)
    back = Rotation.from_quat(
        Mounting(scalar_first(body_to_cam)).q_icrs_to_body(cam.q_icrs_to_cam), scalar_first=True
    )
    assert (back * icrs_to_body.inv()).magnitude() < ROUNDING


def test_without_a_mounting_a_sample_passes_as_it_is() -> None:
    sample = AttitudeSample(5, np.array([0.5, 0.5, -0.5, 0.5]))
    assert Mounting().sample(sample) is sample
    assert Mounting().told, "nobody has said how the camera sits"
    assert not Mounting((1.0, 0.0, 0.0, 0.0)).told, (
        "the user has said that it sits along the body's axes"
    )


@pytest.mark.parametrize("conventions", [PACKETS, BODY], ids=["the camera's", "the body's"])
def test_the_self_check_points_where_it_says(conventions: Conventions) -> None:
    mounting = Mounting(scalar_first(Rotation.from_euler("xyz", [10, 20, 30], degrees=True)))
    line = conventions.lines(mounting)[-1]
    match = re.search(r"\(([-0-9., ]+)\)", line)
    assert match is not None
    q = np.array([float(number) for number in match[1].split(",")])
    cam = mounting.sample(AttitudeSample(0, q)).q_icrs_to_cam if conventions.of_body else q
    assert to_radec_roll_deg(cam)[:2] == pytest.approx(CHECK_RADEC_DEG, abs=DIGITS_DEG)


@pytest.mark.parametrize(
    ("stated", "turns", "order"),
    [
        ({}, "q_icrs_to_cam turns ICRS components into camera components", "first (w, x, y, z)"),
        (
            {"direction": "cam_to_icrs", "frame": "body", "scalar": "last"},
            "q_body_to_icrs turns body components into ICRS components",
            "last (x, y, z, w)",
        ),
    ],
)
def test_a_convention_is_said_as_what_turns_into_what(stated, turns, order) -> None:
    found = packet_conventions(Convention(**stated))
    assert (found.turns, found.of_body) == (turns, bool(stated))
    assert found.scalar == f"scalar {order}, Hamilton"
