"""The schedule: which faults are on in which frame, by the file's times and by whoever asks."""

from __future__ import annotations

import pytest

from hilstar.basics.errors import InputError
from hilstar.optics.layers.fault_kinds import fault_of
from hilstar.server.bench.scenario import MAX_ON, FaultSchedule, Scenario, Timetable
from tests.support.refusals import refusal

FRAME_NS = 10_000_000  # 100 Hz
EXPOSURE_S = 0.1


def blank(name, **keys):
    return fault_of({"kind": "blank", "name": name, **keys})


def false_star(name, **keys):
    return fault_of(
        {"kind": "false-star", "name": name, "tracker_px": [5, 5], "electrons": 100, **keys}
    )


def schedule_of(*faults):
    heard = []
    scenario = Scenario("faults.toml", "", 0, faults)
    return FaultSchedule(scenario, FRAME_NS / 1e9, listen=heard.append), heard


def faults_by_frame(schedule, count, first=0):
    """What is on in frames in a row: names and shares."""
    return [
        [(now.fault.name, now.share) for now in schedule.at(k * FRAME_NS)]
        for k in range(first, first + count)
    ]


def test_a_fault_of_the_file_is_on_at_its_time_for_its_time():
    schedule, heard = schedule_of(blank("cover", at_s=0.02, for_s=0.03))
    assert [bool(on) for on in faults_by_frame(schedule, 7)] == [
        False,
        False,
        True,
        True,
        True,
        False,
        False,
    ]
    assert [(c.what, c.number, c.t_ns, c.who) for c in heard] == [
        ("start", 1, 2 * FRAME_NS, "file"),
        ("end", 1, 5 * FRAME_NS, "file"),
    ]


def test_light_between_two_frames_is_divided_among_them_in_proportion():
    schedule, _ = schedule_of(false_star("flash", at_s=0.014, for_s=0.02))
    on = faults_by_frame(schedule, 5)
    assert on == [[], [("flash", 0.6)], [("flash", 1.0)], [("flash", 0.4)], []]
    assert sum(share for row in on for _, share in row) * FRAME_NS == 0.02e9


def test_what_is_shorter_than_a_frame_is_on_for_one():
    schedule, _ = schedule_of(blank("short", at_s=0.021, for_s=0.001))
    assert [bool(on) for on in faults_by_frame(schedule, 5)] == [False, False, True, False, False]


def test_the_first_frame_is_the_zero_unless_it_is_said():
    schedule, _ = schedule_of(blank("cover", at_s=0.02))
    assert not schedule.at(7_000_000_000)
    assert schedule.at(7_020_000_000)
    said, _ = schedule_of(blank("cover", at_s=0.02))
    said.begin(6_980_000_000)
    assert said.at(7_000_000_000)


def test_a_fault_that_was_stopped_stays_on_once_it_is_started_again():
    schedule, heard = schedule_of(false_star("ghost"))
    for first in (0, 4):
        schedule.start("ghost", "console")
        assert faults_by_frame(schedule, 3, first) == [[("ghost", 1.0)]] * 3
        schedule.stop("ghost", "console")
        assert faults_by_frame(schedule, 1, first + 3) == [[]]
    assert [(c.what, c.number) for c in heard] == [
        ("start", 1),
        ("end", 1),
        ("start", 2),
        ("end", 2),
    ]
    # while it is on once more, it cannot be started twice
    schedule.start("ghost", "console")
    faults_by_frame(schedule, 1, 8)
    assert "is on already" in refusal(schedule.start, "ghost", "console")


def test_the_console_starts_and_stops_a_fault_of_the_scenario_by_name():
    schedule, heard = schedule_of(blank("cover"), false_star("ghost"))
    assert schedule.names() == ["cover", "ghost"]
    assert faults_by_frame(schedule, 2) == [[], []]
    schedule.start("ghost", "console")
    assert schedule.on() == ["ghost"]
    assert faults_by_frame(schedule, 2, 2) == [[("ghost", 1.0)]] * 2
    schedule.stop("ghost", "console")
    assert faults_by_frame(schedule, 1, 4) == [[]]
    assert [(c.what, c.fault.name, c.who, c.t_ns) for c in heard] == [
        ("start", "ghost", "console", 2 * FRAME_NS),
        ("end", "ghost", "console", 4 * FRAME_NS),
    ]
    schedule.start("ghost", "console")
    assert faults_by_frame(schedule, 1, 5) == [[("ghost", 1.0)]]
    assert heard[-1].number == 2  # the second start of the run


def test_a_fault_is_stopped_while_it_waits_and_begun_anew_with_the_frame_that_ends_it():
    schedule, heard = schedule_of(false_star("ghost"), blank("cover"))
    schedule.at(0)
    schedule.start("ghost", "console")
    schedule.ask(blank("later", at_s=0.02), "stream")
    for name in ("ghost", "later"):
        schedule.stop(name, "console")
    assert faults_by_frame(schedule, 3, 1) == [[], [], []] and heard == []
    schedule.start("ghost", "console")
    schedule.at(4 * FRAME_NS)
    schedule.stop("ghost", "console")
    schedule.start("ghost", "stream")
    assert faults_by_frame(schedule, 1, 5) == [[("ghost", 1.0)]]
    assert [(c.what, c.number) for c in heard] == [("start", 1), ("end", 1), ("start", 2)]


def test_what_cannot_be_started_or_stopped_is_refused_in_a_line():
    schedule, _ = schedule_of(blank("cover"))
    with pytest.raises(
        InputError, match=r"no fault is called 'covre'; did you mean cover\? known are cover"
    ):
        schedule.start("covre", "console")
    assert "'cover' is not on; none is" in refusal(schedule.stop, "cover")
    schedule.start("cover", "console")
    assert "on already" in refusal(schedule.start, "cover", "stream")


def test_the_stream_asks_for_faults_of_its_own_now_or_later():
    schedule, _ = schedule_of()
    schedule.at(0)
    schedule.ask(false_star("now", for_s=0.02), "stream")
    schedule.ask(blank("later", at_s=0.04, for_s=0.01), "stream")
    # a time that has passed means now
    schedule.ask(blank("past", at_s=0.001, for_s=0.01), "stream")
    assert faults_by_frame(schedule, 5, 1) == [
        [("now", 1.0), ("past", 1.0)],
        [("now", 1.0)],
        [],
        [("later", 1.0)],
        [],
    ]


def test_memory_is_bounded_whoever_asks():
    schedule, _ = schedule_of()
    refused = 0
    for number in range(5000):
        try:
            schedule.ask(blank(f"fault {number}"), "stream")
        except InputError:
            refused += 1
        if number % 50 == 0:
            schedule.at(number * FRAME_NS)
    assert refused > 4000
    assert len(schedule.at(10**12)) <= MAX_ON


def test_only_some_stray_light_is_on_at_once_whoever_asks():
    schedule, _ = schedule_of()
    for number in range(8):
        schedule.ask(fault_of({"kind": "gradient", "name": f"{number}", "electrons": 5}), "stream")
    with pytest.raises(InputError, match="8 gradients, glows and maps are on or wait"):
        schedule.ask(
            fault_of({"kind": "glow", "name": "sun", "tracker_px": [0, 0], "electrons": 5}),
            "stream",
        )
    schedule.ask(blank("cover"), "stream")


def test_a_fault_between_two_frames_of_a_slow_run_is_reported_as_missed():
    schedule, heard = schedule_of(blank("short", at_s=1.0, for_s=0.1))
    schedule.at(0)
    assert schedule.at(2_000_000_000) == ()
    assert [change.what for change in heard] == ["missed"]


def timetable(*faults):
    return Timetable(Scenario("faults.toml", "", 0, faults), lambda fault: fault, EXPOSURE_S)


def test_an_exposure_is_cut_where_a_fault_begins_ends_or_is_renewed():
    """A burst of cosmic rays is another one in each exposure's time from its own beginning on."""
    cut = timetable(blank("cover", at_s=0.03, for_s=0.04), blank("on", at_s=0.25))
    assert cut.edges_ns(0, 10**8) == [0, 30_000_000, 70_000_000, 10**8]
    assert cut.edges_ns(30_000_000, 70_000_000) == [30_000_000, 70_000_000]
    assert cut.edges_ns(2 * 10**8, 3 * 10**8) == [2 * 10**8, 250_000_000, 3 * 10**8]
    rays = fault_of({"kind": "cosmic-rays", "name": "r", "number": 2, "electrons": 9, "at_s": 0.01})
    for first in (0, 7):
        begin_ns = first * 10**8 + 5_000_000
        wanted_ns = [begin_ns, begin_ns + 5_000_000, begin_ns + 105_000_000, begin_ns + 15 * 10**7]
        assert timetable(rays).edges_ns(begin_ns, begin_ns + 15 * 10**7) == wanted_ns


def test_a_fault_s_number_at_a_moment_is_its_place_in_the_scenario():
    faults = blank("waits"), blank("first", at_s=0.0), blank("second", at_s=0.0)
    numbers = {now.fault.name: now.number for now in timetable(*faults).on(0)}
    assert numbers == {"first": 2, "second": 3}


def freeze(name, **keys):
    return fault_of({"kind": "freeze", "name": name, **keys})


def test_a_display_stands_from_the_first_of_faults_that_overlap():
    stuck = timetable(
        freeze("a", at_s=0.02, for_s=0.05),
        freeze("b", at_s=0.05, for_s=0.06),
        blank("cover", at_s=0.0),
        freeze("c", at_s=0.3, for_s=0.1),
    )
    for t_s, since_s in ((0.01, None), (0.03, 0.02), (0.06, 0.02), (0.1, 0.02), (0.2, None)):
        since_ns = stuck.stands_since_ns(round(t_s * 1e9))
        assert since_ns == (None if since_s is None else round(since_s * 1e9))
    assert stuck.stands_since_ns(3 * 10**8) == 3 * 10**8
    assert stuck.stands_since_ns(4 * 10**8) is None
