"""What a run's faults do to its frames, one by one: what is dropped, frozen, held and shown."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.rotation import conjugate, from_rotation_vectors, multiply, to_matrix
from hilstar.basics.units import NS_PER_MS
from hilstar.optics.layers.fault_kinds import Now, fault_of
from hilstar.optics.layers.faults import FaultLayer
from hilstar.server.loop import FaultyFrames
from tests.support.drawn import drawn

Q = np.array([0.5, 0.5, -0.5, 0.5])
RATE = np.array([0.01, -0.02, 0.03])
STEP_DEG = (0.4, -0.3, 1.0)
# places and rates after a turn: rounding
ROUNDING = 1e-12
DRAWN = drawn(np.zeros((3, 4), np.uint8), clipped_hip=(26311, "Moon"))
KINDS: dict[str, dict[str, Any]] = {
    "freeze": {},
    "drop": {},
    "blank": {},
    "attitude-step": {"turn_deg": list(STEP_DEG)},
}


def on(*kinds: str) -> FaultLayer:
    """Faults of these kinds, which need no camera."""
    now = []
    for number, kind in enumerate(kinds, 1):
        fault = fault_of({"kind": kind, "name": f"{kind} {number}", **KINDS[kind]})
        now.append(Now(number, fault, 0, 1.0))
    view: Any = None
    return FaultLayer(view, tuple(now))


def attitude_at(t_ns: int) -> Attitude:
    return Attitude(Q, 2 * NS_PER_MS, False, t_ns, rate_cam_rad_s=RATE)


@pytest.fixture
def frames() -> FaultyFrames:
    view: Any = None
    return FaultyFrames(lambda t_ns: (), view)


def test_only_a_frame_after_another_is_dropped_or_frozen_and_each_is_counted(frames, small_bench):
    assert (frames.dropped, frames.frozen, frames.has_dropped) == (0, 0, False)
    assert not frames.drops(on("drop"), 1)
    assert frames.frozen_frame(on("freeze"), small_bench) is None
    assert (frames.dropped, frames.frozen) == (0, 0)
    frames.shown(None, DRAWN, attitude_at(0), 0, stays=False)
    assert not frames.drops(None, 2)
    assert frames.drops(on("drop"), 2) and frames.drops(on("drop"), 3)
    assert frames.frozen_frame(on("drop"), small_bench) is None
    stays = frames.frozen_frame(on("freeze"), small_bench)
    assert stays is not None and stays.clipped_hip == DRAWN.clipped_hip
    assert (frames.dropped, frames.frozen, frames.has_dropped) == (2, 1, True)
    frames.shown(None, DRAWN, attitude_at(4), 4, stays=False)
    assert not frames.has_dropped


def test_a_frame_has_its_own_attitude_where_no_fault_changes_it(frames):
    own = attitude_at(7)
    for effects in (None, on("drop"), on("freeze")):  # nothing is held yet
        assert frames.attitude(effects, 7, None) is None
        shown = frames.attitude(effects, 7, own)
        assert shown.q_icrs_to_cam is Q and shown.age_ns == own.age_ns


def test_a_frozen_frame_has_the_attitude_that_is_held_and_its_age_goes_on(frames):
    frames.shown(None, DRAWN, attitude_at(1), 10 * NS_PER_MS, stays=False)
    shown = frames.attitude(on("freeze"), 50 * NS_PER_MS, attitude_at(2))
    assert (shown.sequence, shown.age_ns) == (1, 42 * NS_PER_MS)
    frames.shown(None, DRAWN, None, 60 * NS_PER_MS, stays=False)
    assert frames.attitude(on("freeze"), 70 * NS_PER_MS, attitude_at(3)) is None
    assert frames.attitude(on("blank"), 70 * NS_PER_MS, attitude_at(3)) is None


def test_a_step_turns_the_attitude_and_the_rate_s_axes(frames):
    """The camera is turned about its own axes; its rate stays the same vector of the sky."""
    shown = frames.attitude(on("attitude-step"), 0, attitude_at(1))
    step = multiply(shown.q_icrs_to_cam, conjugate(Q))
    # what a camera sees turns the other way
    turn = from_rotation_vectors(-np.radians([STEP_DEG]))[0]
    assert abs(step @ turn) == pytest.approx(1, abs=ROUNDING)
    before_icrs = to_matrix(Q).T @ RATE
    after_icrs = to_matrix(shown.q_icrs_to_cam).T @ shown.rate_cam_rad_s
    assert after_icrs == pytest.approx(before_icrs, abs=ROUNDING)


def test_a_frame_that_stays_has_the_faults_it_was_drawn_with_and_what_freezes_it_now(frames):
    def names(effects: FaultLayer, *, stays: bool) -> list[str]:
        return [now.fault.name for now in frames.shown(effects, DRAWN, None, 0, stays)]

    assert names(on("freeze", "attitude-step"), stays=False) == ["freeze 1", "attitude-step 2"]
    # a fault of light that begins meanwhile changes nothing of what is on the display
    for effects in (on("freeze"), on("blank", "drop", "freeze")):
        freeze = f"freeze {len(effects.now)}"
        assert names(effects, stays=True) == ["attitude-step 2", freeze]
    assert names(on("blank"), stays=False) == ["blank 1"]
    assert names(on("freeze"), stays=True) == ["blank 1", "freeze 1"]
