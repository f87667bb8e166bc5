"""The verdict on a run: what it counts, what it says, and whether --strict passes."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from hilstar.attitude.receiver import PacketCounts
from hilstar.basics.wrong_sky import ConditionTotal, WrongSkyTotal
from hilstar.server.replay import DrawnBy
from hilstar.server.summary import RunSummary, RunTally, verdict_of

RENDERER = DrawnBy("llvmpipe", "4.5", "points")


@pytest.fixture
def summary() -> RunSummary:
    return replace(RunTally().summary(10.0, PacketCounts(received=600), RENDERER), frames=600)


def test_a_run_on_time_is_right(summary):
    found = verdict_of(summary)
    assert found.ok and found.strict and found.line == "the sky was right in all 600 frames"


@pytest.mark.parametrize(
    ("changes", "strict", "words"),
    [
        ({"missed_frames": 6}, True, "6 of 606 frames missed"),
        ({"missed_frames": 7}, False, "7 of 607 frames missed"),
        # one percent itself, of those that were due
        ({"frames": 594, "missed_frames": 6}, True, "6 of 600 frames missed"),
        ({"frames": 13, "missed_frames": 167}, False, "167 of 180 frames missed"),
        ({"stale_frames": 6}, True, "6 of 600 frames with a stale attitude"),
        ({"stale_frames": 7}, False, "7 of 600 frames with a stale attitude"),
        (
            {"stale_frames": 90, "blank_frames": 90},
            True,
            "90 of 600 frames before the first attitude",
        ),
        ({"stale_frames": 600, "blank_frames": 600}, False, "no frame had an attitude"),
    ],
)
def test_frames_missed_and_stale_fail_beyond_one_percent(summary, changes, strict, words):
    found = verdict_of(replace(summary, **changes))
    assert found.strict is strict and words in found.line


def test_missed_frames_alone_are_late_and_no_wrong_sky(summary):
    late = verdict_of(replace(summary, missed_frames=6))
    assert late.late_share == 0.0099
    assert not late.ok and late.line == "the sky was right, but late; 6 of 606 frames missed"
    stale = verdict_of(replace(summary, missed_frames=6, stale_frames=1))
    assert stale.line.startswith("the sky was not right throughout; 6 of 606")


def test_any_time_of_a_wrong_sky_fails(summary):
    ended = ConditionTotal("source-frozen", 1, 0.0, "at once")
    lasted = ConditionTotal("rates-wrong", 1, 0.4, "by a factor")
    wrong = WrongSkyTotal(0.4, [ended, lasted])
    found = verdict_of(replace(summary, wrong_sky=wrong))
    assert not found.ok and not found.strict and "0.4 s of a wrong sky (rates-wrong)" in found.line
