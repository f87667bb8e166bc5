"""What of a log, or of an earlier run, is replayed: which frames, at which times, with which
attitudes.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from hilstar.attitude.clock.resolution import COARSE
from hilstar.attitude.wire.packet import AttitudeSample, encode
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.wrong_sky import CLOCK, ENDS, RATES, WrongSky
from hilstar.display.quantisers import QUANTISERS
from hilstar.server.bench.config import parse_config
from hilstar.server.record import ledger_records
from hilstar.server.record.ledger import Ledger
from hilstar.server.record.ledger_records import FrameRecord
from hilstar.server.replay import (
    OTHER_CODES_BY_NUMPY,
    DrawnBy,
    Wanted,
    _recall_conditions,
    plan_play,
    replay,
)
from hilstar.server.serve import Outlet
from tests.support.benches import SMALL_BENCH
from tests.support.refusals import refusal

MAX = math.inf


@pytest.fixture
def config(tmp_path):
    return parse_config(tmp_path / "bench.toml", SMALL_BENCH)


@pytest.fixture
def roll_log(tmp_path):
    """Two seconds of a turn about the boresight at 0.1 rad/s, a sample each 0.1 s, which begins
    at 100 s of its clock.
    """
    lines = [f"{100 + k / 10},{math.cos(0.005 * k)},0,0,{math.sin(0.005 * k)}" for k in range(21)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["t_s,qw,qx,qy,qz", *lines]) + "\n")
    return path


@pytest.fixture
def log_in_ms(roll_log):
    """The same with its times in ms, and rates that say so."""
    rows = [line.split(",") for line in roll_log.read_text().splitlines()[1:]]
    lines = [",".join([str(1e3 * float(t)), *q, "0", "0", "-0.1"]) for t, *q in rows]
    path = roll_log.with_name("ms.csv")
    path.write_text("\n".join(["t_s,qw,qx,qy,qz,rx,ry,rz", *lines]) + "\n")
    return path


@pytest.fixture
def first_run(tmp_path, small_bench):
    return earlier_run(tmp_path / "run.mcap", small_bench)


def earlier_run(path, bench, speed_km_s=0.0, away_km=0.0):
    """Ten frames, one each 20 ms, of seven packets; the fourth of them blank, the last four
    aberrated, the last two on paths.
    """
    with Ledger(path, bench) as kept:
        for k in range(10):
            sample = AttitudeSample(k, np.array([1.0, 0.0, 0.0, 0.0]), None, k)
            if k < 7:
                kept.packet(1000 + k, encode(sample), sample, None)
            q, rate = None if k == 3 else (1.0, 0.0, 0.0, 0.0), (0.0, 0.1, 0.0) if k >= 8 else None
            at_ns = 20_000_000 * k
            frame = FrameRecord(
                frame=2 * k, t_ns=500 + k, light_ns=0, draw_ns=at_ns, swap_ns=at_ns, q=q, rate=rate
            )
            frame.velocity_km_s = (0.0, 7.5, speed_km_s) if k >= 6 else None
            frame.place_km = (7000.0 + away_km, 0.0, 1.0) if k >= 6 else None
            kept.frame(frame)
    return path


def test_a_log_has_a_frame_each_refresh_period_from_its_first_sample_to_its_last(roll_log, config):
    play = plan_play(roll_log, Wanted(), config)
    assert play.paced and play.frame_count == 121 and play.packet_count == 21
    number, t_ns, attitude, _ = play.frame(60)
    assert (number, t_ns) == (60, 101_000_000_000)
    assert attitude.q_icrs_to_cam == pytest.approx([math.cos(0.05), 0, 0, math.sin(0.05)], abs=1e-9)


@pytest.mark.parametrize(("speed", "frames"), [(2.0, 61), (0.5, 241), (MAX, 121)])
def test_the_speed_stretches_the_log_and_max_draws_it_all_unpaced(roll_log, config, speed, frames):
    play = plan_play(roll_log, Wanted(speed), config)
    assert play.frame_count == frames
    assert play.paced == (speed != MAX)


def test_a_span_and_a_step_choose_the_frames(roll_log, config):
    play = plan_play(roll_log, Wanted(MAX, start_s=0.5, stop_s=1.5, step_s=0.25), config)
    assert [play.frame(k)[1] / 1e9 for k in range(play.frame_count)] == [
        100.5,
        100.75,
        101.0,
        101.25,
        101.5,
    ]


def test_a_part_has_its_own_first_frame_and_the_log_s_own_zero(roll_log, config):
    """A scenario counts from the log's first sample, whichever part of it is shown."""
    play = plan_play(roll_log, Wanted(start_s=0.5), config)
    assert (play.first_ns, play.zero_ns) == (100_500_000_000, 100_000_000_000)


@pytest.mark.parametrize("steps", range(1, 20))
def test_a_span_of_whole_steps_has_a_frame_at_its_end(roll_log, config, steps):
    """In binary 0.3 / 0.1 is less than 3."""
    play = plan_play(roll_log, Wanted(MAX, 0.0, steps / 10, 0.1), config)
    assert play.frame_count == steps + 1


def test_a_stop_ends_a_replay_as_fast_as_possible(roll_log, bench_with):
    bench = bench_with()
    play = plan_play(roll_log, Wanted(MAX), bench.config)
    runs, frames = [], []

    def sink(shown):
        frames.append(shown.number)
        if shown.number == 3:
            runs[0].loop.stop.set()

    replay(bench, play, sink, Outlet(follower=runs.append))
    assert frames == [0, 1, 2, 3]


def test_each_gap_of_a_log_that_is_too_long_is_one_event_of_a_stale_attitude(roll_log, bench_with):
    """Of half a second, twice: 0.25 s is what an attitude may be old."""
    head, *rows = roll_log.read_text().splitlines()
    roll_log.write_text("\n".join([head, *rows[:4], *rows[9:12], *rows[17:]]) + "\n")
    bench = bench_with()
    stale = []
    play = plan_play(roll_log, Wanted(MAX, step_s=0.1), bench.config)
    summary = replay(bench, play, lambda shown: stale.append(shown.stale))
    assert summary.stale_events == 2
    assert 0 < sum(stale) < len(stale)


def test_a_wrong_sky_of_the_run_is_wrong_again_in_the_frames_that_had_it():
    """Rates from 20 ms to 60 ms, a clock from 40 ms to 80 ms; an event is seen after it began."""
    past = WrongSky()
    past.see(RATES, "rates in deg/s", 30_000_000, since_ns=20_000_000)
    past.see(CLOCK, "a clock ahead", 40_000_000)
    past.see(ENDS[RATES], "", 60_000_000)
    past.see(ENDS[CLOCK], "", 80_000_000)
    notices, wrong = Notices(), []
    for number in range(6):
        at_ns = 20_000_000 * number
        frame = FrameRecord(frame=number, t_ns=0, light_ns=0, draw_ns=at_ns, swap_ns=at_ns, q=None)
        _recall_conditions(past, frame, notices)
        wrong.append({condition.kind for condition in notices.wrong_sky.now()})
    assert wrong == [set(), {RATES}, {RATES, CLOCK}, {CLOCK}, set(), set()]


@pytest.mark.parametrize(
    ("wanted", "word"),
    [
        (Wanted(start_s=3.0), "--start"),
        (Wanted(stop_s=2.5), "--stop"),
        (Wanted(start_s=1.5, stop_s=1.0), "--start"),
        (Wanted(step_s=0.0), "--step"),
        (Wanted(2.0, step_s=0.1), "--step"),
        (Wanted(step_s=1e-12), "frames"),
    ],
)
def test_a_replay_of_no_or_too_many_frames_is_refused(roll_log, config, wanted, word):
    with pytest.raises(InputError, match=word):
        plan_play(roll_log, wanted, config)


def test_a_log_of_three_decimals_is_told_to_be_one_before_it_begins(tmp_path, config):
    angle = 0.37 + 0.02 * np.arange(30)
    q = np.stack([0.6 * np.cos(angle), 0.8 * np.cos(angle), *np.sin(angle) * [[0.28], [0.96]]])
    lines = [f"{k / 10}," + ",".join(f"{part:.3f}" for part in row) for k, row in enumerate(q.T)]
    path = tmp_path / "coarse.csv"
    path.write_text("\n".join(["t_s,qw,qx,qy,qz", *lines]) + "\n")
    told = dict(plan_play(path, Wanted(MAX), config).told)
    assert told[COARSE].startswith("the quaternions come in steps of 0.001:")


def test_a_log_that_turns_faster_than_the_bench_file_allows_is_refused_by_its_attitude(
    tmp_path, config
):
    path = tmp_path / "fast.csv"
    path.write_text("t_s,qw,qx,qy,qz,rx,ry,rz\n0,1,0,0,0,0,0,0\n1,1,0,0,0,0,0,57.3\n")
    with pytest.raises(InputError, match=r"attitude 2.*max_rate_deg_s"):
        plan_play(path, Wanted(), config)


def test_an_earlier_run_is_replayed_frame_by_frame_with_its_own_numbers_and_attitudes(
    first_run, config
):
    play = plan_play(first_run, Wanted(MAX), config)
    assert (play.frame_count, play.packet_count, play.paced, play.moving) == (10, 7, False, True)
    frames = [play.frame(k) for k in range(10)]
    assert [(frame.number, frame.t_ns) for frame in frames] == [(2 * k, 500 + k) for k in range(10)]
    assert [frame.attitude is None for frame in frames] == [k == 3 for k in range(10)]
    assert frames[7][2].rate_cam_rad_s is None
    assert frames[8][2].rate_cam_rad_s.tolist() == [0.0, 0.1, 0.0]


def test_before_its_first_frame_a_ledger_s_frames_are_decoded_once(first_run, config, monkeypatch):
    decoded = Counter()
    read = ledger_records.read_messages

    def counted(path, topic, *, tell=True):
        for message in read(path, topic, tell=tell):
            decoded[topic] += 1
            yield message

    monkeypatch.setattr(ledger_records, "read_messages", counted)
    play = plan_play(first_run, Wanted(speed=MAX), config)
    assert play.frame_count == 10
    # all ten are looked through, and the first is read again where they are played
    assert decoded[ledger_records.FRAME_TOPIC] == 10 + 1


def test_a_part_of_an_earlier_run_is_chosen_by_when_its_frames_were_swapped(first_run, config):
    play = plan_play(first_run, Wanted(start_s=0.04, stop_s=0.08), config)
    assert [play.frame(k)[0] for k in range(play.frame_count)] == [4, 6, 8]
    with pytest.raises(InputError, match="has no frame from"):
        plan_play(first_run, Wanted(start_s=0.041, stop_s=0.042), config)
    assert "frame by frame" in refusal(plan_play, first_run, Wanted(2.0), config)


@pytest.mark.parametrize(
    ("name", "kept", "planted", "words"),
    [
        ("place_km", [7000.0, 0.0, 1.0], {"away_km": 1e8}, "a place beyond 6000 to"),
        ("velocity_km_s", [0.0, 7.5, 0.0], {"speed_km_s": 3e5}, "a velocity over 10000 km/s"),
    ],
)
def test_a_path_is_there_again_and_no_other_than_a_spacecraft_s(
    first_run, config, tmp_path, small_bench, name, kept, planted, words
):
    play = plan_play(first_run, Wanted(speed=MAX), config)
    before, after = (getattr(play.frame(number)[2], name) for number in (5, 6))
    assert before is None and after.tolist() == kept
    wrong = earlier_run(tmp_path / "wrong.mcap", small_bench, **planted)
    with pytest.raises(InputError, match=f"message 7 of /frame: {words}"):
        plan_play(wrong, Wanted(speed=MAX), config)


def test_a_ledger_says_who_drew_it_and_a_log_does_not(first_run, roll_log, config, small_bench):
    own = small_bench.renderer
    drawn_by = DrawnBy(own.gl_renderer, own.gl_version, own.path)
    assert plan_play(first_run, Wanted(MAX), config).drawn_by == drawn_by
    assert plan_play(roll_log, Wanted(MAX), config).drawn_by is None


def test_another_renderer_s_codes_may_be_others_and_the_same_one_s_may_not():
    here = DrawnBy("llvmpipe", "4.5", "CPU, then compute shaders")
    assert here.other_codes(DrawnBy("llvmpipe", "4.5", "CPU, then compute shaders"), "exact") == 0
    for other in (
        replace(here, gl_renderer="zink"),
        replace(here, gl_version="4.6"),
        replace(here, path="points"),
    ):
        assert here.other_codes(other, "round") == QUANTISERS["round"].other_codes
        assert here.other_codes(other, "exact") == QUANTISERS["exact"].other_codes
    assert here.other_codes(replace(here, path="NumPy"), "exact") == OTHER_CODES_BY_NUMPY


@pytest.mark.parametrize("wanted", [Wanted(MAX, stop_s=5000.0), Wanted(MAX, step_s=1e-6)])
def test_a_span_that_is_refused_names_the_unit_of_the_log_s_times(config, log_in_ms, wanted):
    assert "probably the times are in ms" in refusal(plan_play, log_in_ms, wanted, config)
