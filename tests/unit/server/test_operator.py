"""What an operator's keys leave of the attitude, what is told of them, and how long they lasted."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.basics.notices import Notices
from hilstar.server.operator import Aids, OnScreen, Operator, SwitchRequest, SwitchRequests

MS = 1_000_000
RATE = np.array([0.0, 0.1, 0.0])


def aged_attitude(angle: float, age_ns: int = 5 * MS) -> Attitude:
    return Attitude(
        np.array([np.cos(angle), 0.0, 0.0, np.sin(angle)]), age_ns, False, rate_cam_rad_s=RATE
    )


@pytest.fixture
def aids():
    return Aids()


def test_without_keys_the_attitude_is_the_one_that_came(aids):
    wanted = aged_attitude(0.1)
    assert Operator(aids, Notices()).attitude(0, wanted) is wanted


def test_a_pause_keeps_the_attitude_which_grows_old_and_does_not_move(aids):
    operator = Operator(aids, Notices())
    before = aged_attitude(0.1)
    operator.attitude(100 * MS, before)
    aids.set("pause", True)
    held = operator.attitude(350 * MS, aged_attitude(0.2))
    assert held is not None and held.q_icrs_to_cam is before.q_icrs_to_cam
    assert held.age_ns == 255 * MS
    assert held.rate_cam_rad_s is None
    aids.set("pause", False)
    assert operator.attitude(400 * MS, before) is before


def test_a_pause_before_any_attitude_shows_none(aids):
    operator = Operator(aids, Notices())
    aids.set("pause", True)
    assert operator.attitude(0, aged_attitude(0.1)) is None


def test_under_a_blank_or_a_patch_there_is_no_sky(aids):
    operator = Operator(aids, Notices())
    for name in ("blank", "patch"):
        aids.set(name, True)
        assert operator.attitude(0, aged_attitude(0.1)) is None
        aids.set(name, False)
    wanted = aged_attitude(0.1)
    assert operator.attitude(0, wanted) is wanted


def test_each_change_of_keys_and_window_is_told_once(aids):
    notices, told = Notices(), []
    notices.listen(lambda notice: told.append((notice.kind, notice.detail)))
    window = SimpleNamespace(hidden="")
    operator = Operator(aids, notices, lambda: window.hidden)
    for keys, hidden in (
        ("", ""),
        ("grid", ""),
        ("grid", ""),
        ("", ""),
        ("", "minimised"),
        ("", "minimised"),
        ("", ""),
    ):
        aids.set("grid", keys == "grid")
        window.hidden = hidden
        assert operator.look() == OnScreen(keys, hidden, True)
    assert [kind for kind, _ in told] == ["operator", "operator", "hidden", "visible"]
    assert "grid" in told[0][1] and "minimised" in told[2][1]


def test_changed_and_hidden_frames_are_counted_with_their_time(aids):
    operator = Operator(aids, Notices())
    for swap_ms, on_screen in (
        (500, OnScreen("blank")),  # the run's first
        (520, OnScreen()),
        (530, OnScreen("grid")),
        (570, OnScreen("grid", "covered")),
        (690, OnScreen()),
    ):
        operator.count(on_screen, swap_ms * MS)
    assert operator.summary() == {
        "operator": {"frames": 3, "s": pytest.approx(0.05)},
        "hidden": {"frames": 1, "s": pytest.approx(0.04)},
    }


def test_a_wish_is_acted_on_by_the_next_look_and_told_with_who_wished_it(aids):
    notices, told = Notices(), []
    notices.listen(lambda notice: told.append((notice.kind, notice.detail, notice.who)))
    requests = SwitchRequests()
    operator = Operator(aids, notices, requests=requests)
    wish, late = SwitchRequest("blank", True, "Ada"), SwitchRequest("grid", True, "Ada")
    requests.append(wish)
    requests.append(late)
    late.called_off = True
    assert not wish.done
    assert operator.look() == OnScreen("blank", "", False)
    assert wish.done and not late.done
    assert told == [("operator", "blank on, by Ada: blank", "Ada")]
    assert operator.look() == OnScreen("blank", "", False)
    assert len(told) == 1
