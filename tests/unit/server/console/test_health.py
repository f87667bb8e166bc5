"""What is wrong with a run, for the page and for monitoring."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from hilstar.server.answers.judge import TrackerFigures
from hilstar.server.console.messages import RunState
from hilstar.server.console.protocol import LedgerState, NewestFrame, ShownAttitude, WrongCondition
from hilstar.server.console.server.reader import (
    Health,
    RecentFrames,
    SkyJudgement,
    judged,
    reasons,
)

S = 1_000_000_000
NOW = 1_000 * S
ATTITUDE = ShownAttitude(
    q=(1.0, 0.0, 0.0, 0.0), ra_deg=90.0, dec_deg=0.0, roll_deg=0.0, rate_deg_s=None, age_ms=1250.0
)
FRAME = NewestFrame(number=1, missing=False, blank=False)
STALE = replace(FRAME, stale=True)
WELL = RunState(host_ns=NOW - S // 20, alive_ns=NOW - S // 10, frame=FRAME, attitude=ATTITUDE)
LATELY = RecentFrames(NOW - S // 50)


def found(pace="clock", lately=LATELY, hz=60.0, **changes) -> list[str]:
    return reasons(replace(WELL, **changes), NOW, lately, hz, pace)


def test_a_run_that_goes_well_has_no_reason():
    assert found() == []
    assert found(pace="asked") == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frame": NewestFrame()}, "no attitude has come yet"),
        ({"frame": STALE}, "the attitude is stale: 1.2 s old"),
        (
            {"frame": STALE, "attitude": replace(ATTITUDE, age_ms=3_725e3)},
            "the attitude is stale: 1 h 02 min old",
        ),
        (
            {"frame": STALE, "attitude": replace(ATTITUDE, age_ms=725e3)},
            "the attitude is stale: 12 min 05 s old",
        ),
        ({"frame": STALE, "attitude": None}, "the attitude is stale"),
        ({"alive_ns": 0}, "being prepared"),
        ({"alive_ns": 0, "frame": NewestFrame()}, "being prepared"),
        ({"gamma": "another program changed the ramp"}, "another program changed the ramp"),
        ({"alive_ns": NOW - S}, "the frame loop has hung for 1.0 s"),
        ({"host_ns": NOW - S, "alive_ns": NOW - S}, "silent for 1.0 s"),
        ({"display_lost": "the window went away"}, "the display is lost: the window went away"),
        ({"hidden": "covered"}, "the window is covered"),
        (
            {"ledger": LedgerState("run.mcap", 1, "cannot be written")},
            "the ledger fails: cannot be written",
        ),
        ({"operator_text": "blank"}, "changed by the operator: blank"),
        ({"faults": ["flash"]}, "a fault is on: flash"),
        (
            {"tracker": TrackerFigures(silent="the tracker has not answered for 2.0 s")},
            "has not answered for 2.0 s",
        ),
        (
            {"wrong_sky": [WrongCondition("rates-wrong", "the packets' rates are wrong")]},
            "the packets' rates are wrong",
        ),
        ({"forced": "another monitor"}, "shown by --force: another monitor"),
    ],
)
def test_each_thing_that_is_wrong_is_a_reason(changes, words):
    told = found(**changes)
    assert len(told) == 1 and words in told[0]


def test_a_ledger_that_is_written_and_a_few_missed_frames_are_well():
    assert found(ledger=LedgerState("run.mcap", 1)) == []
    assert found(lately=RecentFrames(NOW, 0.5)) == []
    assert "60%" in found(lately=RecentFrames(NOW, 0.6))[0]


def test_a_slow_display_is_not_a_loop_that_hangs():
    """At 1 Hz a frame is due once a second."""
    assert found(hz=1.0, alive_ns=NOW - 2 * S) == []
    assert found(hz=1.0, alive_ns=NOW - 3 * S)


def test_a_loop_hangs_by_the_run_s_own_times_not_by_when_the_page_looks():
    """The limit is half a second; the state is 0.4 s old, and the loop lived 0.2 s before it."""
    assert found(host_ns=NOW - 4 * S // 10, alive_ns=NOW - 6 * S // 10) == []


def test_a_simulator_that_asks_for_nothing_is_a_reason_in_lockstep_alone():
    late = RecentFrames(NOW - 3 * S)
    assert "no frame for 3.0 s" in found(pace="asked", lately=late)[0]
    assert found(lately=late) == []


def test_a_session_is_as_well_as_its_steps():
    assert found(pace="session", frame=replace(STALE, missing=True)) == []
    assert found(pace="session", failed=["focus failed: too dark"]) == ["focus failed: too dark"]


def test_before_the_first_word_nothing_is_right_and_since_is_the_last_change():
    health = Health(5.0)
    health.update(judged(None, NOW, LATELY, 60.0, "clock"), 6.0)
    assert (health.ok, health.since_s) == (False, 5.0)
    assert health.found.reasons == ["the run has not begun"]
    well = SkyJudgement([], "Sky is right")
    health.update(well, 7.0)
    health.update(well, 8.0)
    assert (health.ok, health.since_s) == (True, 7.0)
    health.update(SkyJudgement(["stale"], "Sky is not right"), 9.0)
    health.update(SkyJudgement(["stale", "hung"], "Sky is not right"), 10.0)
    assert (health.ok, health.since_s) == (False, 9.0)


@pytest.mark.parametrize(
    ("changes", "pace", "headline", "late"),
    [
        ({}, "clock", "84 % of frames missed in the last second", True),
        ({"frame": STALE}, "clock", "Sky is not right", False),
        ({}, "session", "First light goes on", False),
        ({"failed": ["focus failed"]}, "session", "A step has failed", False),
    ],
)
def test_late_frames_alone_are_no_wrong_sky(changes, pace, headline, late):
    found = judged(replace(WELL, **changes), NOW, RecentFrames(NOW, 0.84), 60.0, pace)
    assert (found.headline, found.late) == (headline, late)


def test_a_run_that_goes_well_has_its_headline():
    found = judged(WELL, NOW, RecentFrames(NOW, 0.4), 60.0, "clock")
    assert (found.headline, found.late, found.reasons) == ("Sky is right", False, [])
