"""Faults of a run: in its frames, in its ledger, and again from that, code for code."""

from __future__ import annotations

import numpy as np
import pytest

import hilstar
from hilstar.basics.notices import Notices
from hilstar.server.bench.scenario import parse_scenario
from hilstar.server.faults import RunFaults, read_recording
from hilstar.server.record.ledger import Ledger, LedgerSwitch
from hilstar.server.record.ledger_records import fault_records, frame_records
from hilstar.server.replay import Wanted, plan_play, replay
from hilstar.server.serve import Outlet
from tests.support.benches import ATTITUDE, bench_text
from tests.support.refusals import refusal

SCENARIO = """
seed = 1
[[fault]]
kind = "false-star"
name = "ghost"
at_s = 0.05
for_s = 0.26
tracker_px = [520, 500]
rate_px_s = [90, 30]
electrons = 2e5
[[fault]]
kind = "cosmic-rays"
name = "rays"
at_s = 0.1
for_s = 0.25
number = 10
electrons = 1e5
[[fault]]
kind = "light-map"
name = "measured"
at_s = 0.2
for_s = 0.1
file = "stray.npy"
[[fault]]
kind = "star-gone"
name = "dark"
at_s = 0.1
for_s = 0.2
hip = 26727
[[fault]]
kind = "freeze"
name = "stuck"
at_s = 0.4
for_s = 0.1
[[fault]]
kind = "blank"
name = "cover"
at_s = 0.55
for_s = 0.05
[[fault]]
kind = "drop"
name = "loss"
at_s = 0.65
for_s = 0.1
share = 0.5
[[fault]]
kind = "attitude-step"
name = "step"
at_s = 0.8
for_s = 0.1
turn_deg = [0, 0.5, 0]
"""


@pytest.fixture(scope="module")
def replays(tmp_path_factory):
    path = tmp_path_factory.mktemp("faults") / "bench.toml"
    path.write_text(
        bench_text(
            {"monitor": {"refresh_hz": 50}, "render": {"quantisation": "temporal", "motion": "on"}}
        )
    )
    with hilstar.load(path) as opened:
        yield opened


@pytest.fixture
def slow_log(tmp_path):
    """A slow turn, so that a frame that stays is told from the next."""
    path = tmp_path / "log.csv"
    path.write_text(f"t_s,qw,qx,qy,qz\n5,{ATTITUDE}\n6,0.69872,0.71351,-0.03604,0.03729\n")
    np.save(tmp_path / "stray.npy", np.linspace(0, 3000, 100).reshape(10, 10))
    return path


def played(replays, slow_log, ledger=None, scenario=None, notices=None):
    """The frames of a replay as fast as possible: codes by number, and the summary."""
    notices = notices or Notices()
    frames, codes = [], {}
    kept = LedgerSwitch(None if ledger is None else Ledger(ledger, replays, notices))
    faults = None if scenario is None else RunFaults(replays, scenario, notices, kept)

    def sink(shown):
        frames.append(shown)
        codes[shown.number] = shown.drawn.levels.copy()

    play = plan_play(slow_log, Wanted(speed=float("inf")), replays.config)
    summary = replay(replays, play, sink, Outlet(ledger=kept, notices=notices, faults=faults))
    kept.end()
    return frames, codes, summary


def test_a_scenario_is_replayed_from_its_ledger_code_for_code(replays, slow_log, tmp_path):
    scenario = parse_scenario(tmp_path / "faults.toml", SCENARIO)
    frames, codes, summary = played(replays, slow_log, tmp_path / "run.mcap", scenario)
    assert summary.faults["started"] == dict.fromkeys([f.name for f in scenario.faults], 1)
    assert summary.faults["dropped_frames"] + len(frames) == 51
    assert 0 < summary.faults["dropped_frames"] < 5
    _again, same, _ = played(replays, tmp_path / "run.mcap", tmp_path / "again.mcap")
    assert codes.keys() == same.keys()
    assert all(np.array_equal(codes[number], same[number]) for number in codes)
    # the ledger of a replay has the faults too
    _third, last, told = played(replays, tmp_path / "again.mcap")
    assert all(np.array_equal(codes[number], last[number]) for number in codes)
    assert told.faults["recorded"] == summary.faults["started"]


def test_the_same_scenario_twice_is_the_same_light_and_another_seed_is_not(
    replays, slow_log, tmp_path
):
    runs = [
        played(
            replays,
            slow_log,
            scenario=parse_scenario(
                tmp_path / "f.toml", SCENARIO.replace("seed = 1", f"seed = {seed}")
            ),
        )[1]
        for seed in (1, 1, 2)
    ]
    assert all(np.array_equal(runs[0][k], runs[1][k]) for k in runs[0])
    assert any(not np.array_equal(runs[0][k], runs[2][k]) for k in runs[0].keys() & runs[2].keys())


def test_a_frame_without_faults_is_that_of_a_run_without_a_scenario(slow_log, tmp_path):
    """Not with `temporal`, whose stars make up for what the frames with faults left."""
    path = tmp_path / "bench.toml"
    path.write_text(
        bench_text(
            {"monitor": {"refresh_hz": 50}, "render": {"quantisation": "exact", "motion": "on"}}
        )
    )
    with hilstar.load(path) as replays:
        frames, codes, _ = played(
            replays, slow_log, scenario=parse_scenario(tmp_path / "f.toml", SCENARIO)
        )
        _, plain, _ = played(replays, slow_log)
    free = [shown.number for shown in frames if not shown.faults]
    assert len(free) >= 3
    assert all(np.array_equal(codes[k], plain[k]) for k in free)


def test_frames_freeze_and_blank_and_the_ledger_says_by_what(replays, slow_log, tmp_path):
    scenario = parse_scenario(tmp_path / "faults.toml", SCENARIO)
    frames, codes, _ = played(replays, slow_log, tmp_path / "run.mcap", scenario)
    # what stands on the display grows older
    of = {shown.number: shown for shown in frames}
    for k in range(20, 25):
        older_ns = of[k].attitude.age_ns - of[19].attitude.age_ns
        assert older_ns == of[k].t_ns - of[19].t_ns > 0
    assert all(np.array_equal(codes[19], codes[k]) for k in range(20, 25)) and not np.array_equal(
        codes[19], codes[25]
    )
    assert not codes[28].any() and codes[31].any()
    records = list(fault_records(tmp_path / "run.mcap"))
    assert records[0].event == "scenario" and records[0].table == SCENARIO
    ends = {record.name: record.t_ns / 1e9 for record in records if record.event == "end"}
    assert ends["ghost"] == pytest.approx(0.32) and ends["stuck"] == pytest.approx(0.5)
    assert {record.who for record in records[1:]} == {"file"}
    on = {record.frame: record.faults for record in frame_records(tmp_path / "run.mcap")}
    ghost = next(record.number for record in records if record.name == "ghost")
    assert [number for number, faults in on.items() if ghost in faults] == list(range(2, 16))


def test_a_map_that_has_changed_is_not_replayed_as_if_it_were_the_run_s(
    replays, slow_log, tmp_path
):
    played(
        replays, slow_log, tmp_path / "run.mcap", parse_scenario(tmp_path / "faults.toml", SCENARIO)
    )
    np.save(tmp_path / "stray.npy", np.ones((10, 10)))
    assert "is not the map that the run had" in refusal(read_recording, tmp_path / "run.mcap")


def test_a_scenario_counts_from_the_log_s_first_sample_whichever_part_of_it_is_shown(
    replays, slow_log, tmp_path
):
    """At 50 Hz from 0.5 s on, frames 5 to 9 are those from 0.6 s to 0.7 s."""
    text = '[[fault]]\nkind = "blank"\nname = "cover"\nat_s = 0.6\nfor_s = 0.1'
    faults = RunFaults(replays, parse_scenario(tmp_path / "f.toml", text), Notices())
    dark = []

    def sink(shown):
        if not shown.drawn.levels.any():
            dark.append(shown.number)

    play = plan_play(slow_log, Wanted(speed=float("inf"), start_s=0.5), replays.config)
    replay(replays, play, sink, Outlet(faults=faults))
    assert dark == [5, 6, 7, 8, 9]


def test_the_console_starts_a_fault_of_the_scenario_while_it_runs(replays, slow_log, tmp_path):
    scenario = parse_scenario(tmp_path / "f.toml", '[[fault]]\nkind = "blank"\nname = "cover"')
    notices, heard = Notices(), []
    notices.listen(heard.append)
    faults = RunFaults(replays, scenario, notices)
    codes = {}

    def sink(shown):
        codes[shown.number] = shown.drawn.levels.copy()
        if shown.number == 10:
            faults.schedule.start("cover", "Ada")
        if shown.number == 20:
            faults.schedule.stop("cover", "Ada")

    replay(
        replays,
        plan_play(slow_log, Wanted(speed=float("inf")), replays.config),
        sink,
        Outlet(notices=notices, faults=faults),
    )
    assert [number for number in codes if not codes[number].any()] == list(range(11, 21))
    said = [(notice.detail, notice.who) for notice in heard if notice.kind == "fault"]
    assert said == [
        ("fault cover (blank) begins, by Ada", "Ada"),
        ("fault cover (blank) ends, by Ada", "Ada"),
    ]
