"""What an operator's keys leave of the attitude, what is told of them, and how long they lasted."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.notices import Notices
from hilstar.run.screen.overrides import Overrides
from hilstar.run.shown import OnScreen

MS = 1_000_000
RATE = np.array([0.0, 0.1, 0.0])


def attitude(angle: float, age_ns: int = 5 * MS) -> Attitude:
    return Attitude(np.array([np.cos(angle), 0.0, 0.0, np.sin(angle)]), age_ns, False, rate_cam_rad_s=RATE)


@pytest.fixture
def screen():
    return SimpleNamespace(operator="", shows_sky=True, paused=False, window=SimpleNamespace(hidden=""))


def test_without_keys_the_attitude_is_the_one_that_came(screen):
    wanted = attitude(0.1)
    assert Overrides(screen, Notices()).attitude(0, wanted) is wanted


def test_a_pause_keeps_the_attitude_which_grows_old_and_does_not_move(screen):
    overrides = Overrides(screen, Notices())
    before = attitude(0.1)
    overrides.attitude(100 * MS, before)
    screen.paused = True
    held = overrides.attitude(350 * MS, attitude(0.2))
    assert held is not None and held.q_icrs_to_cam is before.q_icrs_to_cam
    assert held.age_ns == 255 * MS
    assert held.rate_cam_rad_s is None
    screen.paused = False
    assert overrides.attitude(400 * MS, before) is before


def test_a_pause_before_any_attitude_shows_none(screen):
    overrides = Overrides(screen, Notices())
    screen.paused = True
    assert overrides.attitude(0, attitude(0.1)) is None


def test_under_a_blank_or_a_patch_there_is_no_sky(screen):
    overrides = Overrides(screen, Notices())
    screen.shows_sky = False
    assert overrides.attitude(0, attitude(0.1)) is None


def test_each_change_of_keys_and_window_is_told_once(screen):
    notices, told = Notices(), []
    notices.listen(lambda notice: told.append((notice.kind, notice.detail)))
    overrides = Overrides(screen, notices)
    for operator, hidden in (("", ""), ("grid", ""), ("grid", ""), ("", ""), ("", "minimised"), ("", "minimised"), ("", "")):
        screen.operator, screen.window.hidden = operator, hidden
        assert overrides.look() == OnScreen(operator, hidden, True)
    assert [kind for kind, _ in told] == ["operator", "operator", "hidden", "visible"]
    assert "grid" in told[0][1] and "minimised" in told[2][1]


def test_changed_and_hidden_frames_are_counted_with_their_time(screen):
    overrides = Overrides(screen, Notices())
    for k, on_screen in enumerate([OnScreen(), OnScreen("grid"), OnScreen("grid", "covered"), OnScreen()]):
        overrides.count(on_screen, 20 * MS * k)
    assert overrides.summary() == {
        "operator": {"frames": 2, "s": pytest.approx(0.04)},
        "hidden": {"frames": 1, "s": pytest.approx(0.02)},
    }
