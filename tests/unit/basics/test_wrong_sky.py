"""The conditions of a wrong sky: when they hold, since when, and for how long in all."""

from __future__ import annotations

from hilstar.basics.notices import MAX_RECORDED, Notice, Notices
from hilstar.basics.units import NS_PER_S
from hilstar.basics.wrong_sky import CLOCK, CONVENTION, ENDS, RATES, WrongSky

S = NS_PER_S


def test_a_condition_holds_from_when_it_began_until_it_ends():
    sky = WrongSky()
    assert not sky.any and sky.now() == []
    sky.see(RATES, "by a factor", 12 * S, since_ns=10 * S)
    assert [(one.kind, one.text, one.since_ns) for one in sky.now()] == [
        (RATES, "by a factor", 10 * S)
    ]
    sky.see(ENDS[RATES], "", 15 * S)
    assert sky.now() == [] and sky.at(14 * S) == [(RATES, "by a factor")] and sky.at(15 * S) == []
    assert sky.spans_ns() == [(10 * S, 15 * S)]
    # none begins after it was found
    sky.see(CLOCK, "", 20 * S, since_ns=21 * S)
    assert sky.now()[0].since_ns == 20 * S


def test_conditions_that_overlap_count_once_and_each_for_itself():
    sky = WrongSky()
    sky.see(RATES, "", 10 * S)
    sky.see(CONVENTION, "", 12 * S)
    sky.see(ENDS[RATES], "", 14 * S)
    sky.see(RATES, "", 30 * S)
    total = sky.total(11 * S, 32 * S)
    assert total.seconds == 21.0
    assert [(one.kind, one.count, one.seconds) for one in total.conditions] == [
        (RATES, 2, 5.0),
        (CONVENTION, 1, 20.0),
    ]


def test_a_condition_within_another_neither_adds_to_it_nor_ends_it():
    sky = WrongSky()
    sky.see(RATES, "", 10 * S)
    sky.see(CONVENTION, "", 12 * S)
    sky.see(ENDS[CONVENTION], "", 14 * S)
    sky.see(ENDS[RATES], "", 20 * S)
    assert sky.spans_ns() == [(10 * S, 20 * S)]
    assert sky.total(0, 40 * S).seconds == 10.0


def test_a_condition_is_told_by_its_first_line_and_the_oldest_comes_first():
    sky = WrongSky()
    sky.see(RATES, "by a factor", 10 * S)
    sky.see(RATES, "by another", 11 * S)
    sky.see(CONVENTION, "turned", 12 * S, since_ns=9 * S)
    assert [(one.kind, one.text) for one in sky.now()] == [
        (CONVENTION, "turned"),
        (RATES, "by a factor"),
    ]
    sky.see(ENDS[RATES], "", 13 * S)
    sky.see(RATES, "by a third", 20 * S)
    assert (RATES, "by a factor") in sky.at(21 * S)
    assert [one.text for one in sky.total(0, 30 * S).conditions] == ["by a factor", "turned"]


def test_other_events_and_ends_of_nothing_change_nothing():
    sky = WrongSky()
    sky.see("stale", "", S)
    sky.see(ENDS[CLOCK], "", 2 * S)
    assert not sky.any and sky.total(0, 10 * S).seconds == 0.0


def test_each_begin_and_end_is_recorded_however_often_they_come():
    notices, recorded = Notices(), []

    def record(notice: Notice) -> None:
        recorded.append(notice.kind)

    notices.listen(record)
    for _ in range(2 * MAX_RECORDED):
        notices.begin(RATES, "", since_ns=1)
        notices.end(RATES, ENDS[RATES], "")
    assert recorded == [RATES, ENDS[RATES]] * 2 * MAX_RECORDED
