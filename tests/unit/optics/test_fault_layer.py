"""What faults do to a view and to frames, whatever else is on beside them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.optics.layers.fault_kinds import AttitudeStep, Blank, Drop, Freeze, Now
from hilstar.optics.layers.faults import FaultLayer
from hilstar.optics.layers.view import View

Q = from_radec_roll_deg(84.0, -1.2, 30.0)
RATE = np.radians([0.3, -0.7, 1.9])


def layer(*faults) -> FaultLayer:
    """The faults that are on; each frame's chance is by the fault's name and the frame's number."""

    def rng(name: str, seed: int, frame: int) -> np.random.Generator:
        return np.random.default_rng([*name.encode(), seed, frame])

    on = tuple(Now(number, fault, 0) for number, fault in enumerate(faults))
    return FaultLayer(SimpleNamespace(rng=rng), on)


@pytest.mark.parametrize("rate", [None, RATE])
def test_attitude_steps_turn_one_after_the_other_and_with_them_the_rate(rate):
    """A turn of the camera by a vector in its own axes takes what it sees the other way. The sky's
    rate about the camera stays: only its components are those of other axes.
    """
    turns_deg = [(0.0, 2.0, 0.0), (0.0, 0.0, 40.0)]
    steps = [AttitudeStep(name=f"s{k}", turn_deg=turn) for k, turn in enumerate(turns_deg)]
    small = AttitudeStep(name="small", turn_arcsec=(3600.0, 0.0, 0.0))
    found = layer(steps[0], Freeze(name="f"), steps[1], small).turned(View(Q, rate))
    turned = Rotation.identity()
    for turn in (*turns_deg, (1.0, 0.0, 0.0)):
        turned = Rotation.from_rotvec(-np.array(turn), degrees=True) * turned
    assert to_matrix(found.q_icrs_to_cam) == pytest.approx(
        turned.as_matrix() @ to_matrix(Q), abs=1e-12
    )
    if rate is None:
        assert found.rate_cam_rad_s is None
    else:
        assert found.rate_cam_rad_s == pytest.approx(turned.apply(rate), abs=1e-12)
    assert layer(Blank(name="b")).turned(found) is found


def test_frames_are_dropped_by_their_own_number_and_in_their_share():
    """Of 2000 frames of a quarter the count is within five sigmas."""
    assert not any(layer(Blank(name="b")).drops(frame) for frame in range(9))
    assert all(layer(Drop(name="all", share=1.0)).drops(frame) for frame in range(9))
    quarter = layer(Drop(name="some", share=0.25))
    dropped = [quarter.drops(frame) for frame in range(2000)]
    assert abs(sum(dropped) - 500) < 5 * np.sqrt(2000 * 0.25 * 0.75)
    assert [quarter.drops(frame) for frame in range(2000)] == dropped
    other = layer(Drop(name="others", share=0.25))
    assert [other.drops(frame) for frame in range(2000)] != dropped
    both = layer(Drop(name="some", share=0.25), Drop(name="others", share=0.25))
    wanted = [a or other.drops(frame) for frame, a in enumerate(dropped)]
    assert [both.drops(frame) for frame in range(2000)] == wanted


def test_a_fault_of_a_kind_is_on_where_it_is_among_those_that_are():
    for kind, is_blank, is_frozen in (
        (Blank, True, False),
        (Freeze, False, True),
        (Drop, False, False),
    ):
        one = layer(Drop(name="d"), kind(name="k"))
        assert (one.blank, one.frozen) == (is_blank, is_frozen)
