"""The study of the chain in parts: exposures before a panel, errors of stars, and times."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import (
    angle_between_rad,
    from_rotation_vector,
    propagate,
    random_attitudes,
    to_matrix,
)
from hilstar.instruments.study.chain import choices, measuring
from hilstar.instruments.study.chain.tracker import (
    LOST_MAG,
    MeasuredStars,
    Off,
    StudyTracker,
    attitude_off_arcsec,
    off,
    within,
)
from hilstar.instruments.study.predictors import Movement, attitude_at
from hilstar.instruments.study.sweep import Spent
from hilstar.optics.scan import Scan
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.config import AttitudeSettings, parse_config
from tests.support.benches import SMALL_BENCH, bench_text

PERIOD_S = 1 / 50
SIZE_PX = (6, 4)
ROUNDING = 1e-9


def turn_ahead_deg(prediction: choices.Prediction, ahead_ms: float) -> float:
    """The turn since the newest of two samples, 10 ms and 20 ms later, whose rates are thrice that
    of their attitudes: 1 deg/s about z.
    """
    samples = []
    for t_ns in (0, 10_000_000):
        q = propagate(np.array([1.0, 0, 0, 0]), np.array([0, 0, math.radians(1.0)]), t_ns * 1e-9)
        samples.append(AttitudeSample(t_ns, q, np.array([0, 0, math.radians(3.0)])))
    settings = AttitudeSettings(max_extrapolation_ms=ahead_ms)
    timeline = choices.filled_timeline(samples, prediction, settings)
    shown = attitude_at(timeline, 30_000_000).q_icrs_to_cam
    return math.degrees(angle_between_rad(shown, samples[-1].q_icrs_to_cam))


@pytest.mark.parametrize("ahead_ms", [0.0, 500.0])
def test_an_attitude_is_held_carried_on_by_its_rate_or_by_the_last_two(ahead_ms):
    """Also for a bench that predicts nothing itself: the study tries each way."""
    turns_deg = {way: turn_ahead_deg(way, ahead_ms) for way in choices.PREDICTIONS}
    wanted = {"rate": 0.06, "two samples": 0.02, "held": 0.0}
    assert turns_deg == pytest.approx(wanted, rel=1e-3, abs=1e-6)


def test_an_exposure_before_a_fast_panel_begins_within_a_refresh():
    """Of 2 ms: 3.7 ms are 1.7 ms of the second one."""
    seen = choices.panel_exposure(10, 1 / 500, 0.1, Scan((0, 1), 0.0, 0.0), SIZE_PX)
    assert seen.begin_s == pytest.approx(10 / 500 + 0.0017)


def test_the_scenes_are_the_median_the_densest_and_the_faintest_of_the_fields():
    """Three fields of a median of five stars, empty ones apart; the faintest of those with three
    or more.
    """
    five = [90.0, 2.0, 2.0, 2.0, 2.0]
    by_field = {3: five, 40: [70.0] * 20, 60: [9.0, 2.0], 90: [20.0, 1.0, 1.0], 91: five}
    rates = [np.array(by_field.get(number, [])) for number in range(choices.FIELDS)]
    assert choices.chosen_fields(rates) == (3, 40, 90)
    assert choices.chosen_fields([np.array([])] * 3) is None


def test_the_scenes_of_a_bench_stand_still_but_for_two_slews(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH)
    with open_bench(read_bench_file(path)) as bench:
        scenes = choices.five_scenes(bench)
        fields = random_attitudes(choices.FIELDS, np.random.default_rng(choices.SEED))
        chosen = choices.chosen_fields([bench.sprites(q).data["electrons_per_s"] for q in fields])
    assert [scene.rate_deg_s for scene in scenes] == [0, 0, 0, 1, 10]
    average, dense, faint = fields[list(chosen)]
    for scene, q in zip(scenes, (average, dense, faint, average, average), strict=True):
        np.testing.assert_array_equal(scene.q_icrs_to_cam, q)
    # Sirius alone, in none of the fields of two degrees
    narrow = {"sky": {"faintest_v_mag": -1.0}, "monitor": {"resolution_px": [32, 24]}}
    path.write_text(bench_text(narrow))
    with (
        open_bench(read_bench_file(path)) as bench,
        pytest.raises(InputError, match=r"bench\.toml: \[sky\] leaves no star"),
    ):
        choices.five_scenes(bench)


@pytest.mark.parametrize("hold_s", [0.0, 0.004, PERIOD_S], ids=["flash", "short", "whole"])
@pytest.mark.parametrize(("down", "axis"), [((0, 1), 0), ((0, -1), 0), ((1, 0), 1), ((-1, 0), 1)])
def test_each_row_gives_one_light_over_whole_refreshes(hold_s, down, axis):
    """Rows light over 12 ms, the middle of the panel at a frame's time; the exposure begins 3.7 ms
    after that of frame 10, and is three refreshes long.
    """
    scan = Scan(down, 0.012, hold_s)
    seen = choices.panel_exposure(10, PERIOD_S, 3 * PERIOD_S, scan, SIZE_PX)
    assert (seen.begin_s, seen.length_s) == pytest.approx((10 * PERIOD_S + 0.0037, 3 * PERIOD_S))
    assert seen.middle_ns() == pytest.approx(1e9 * (11.5 * PERIOD_S + 0.0037), abs=1)
    rows = SIZE_PX[0] if axis else SIZE_PX[1]
    assert seen.weights.shape[1:] == ((1, rows) if axis else (rows, 1))
    weights = seen.weights.reshape(-1, rows)
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, rtol=1e-9)
    assert [ns * 1e-9 for ns in seen.light_ns] == pytest.approx(
        [number * PERIOD_S for number in seen.numbers]
    )
    # by each row's own time, in steps of a microsecond
    order = np.arange(rows) if sum(down) > 0 else np.arange(rows)[::-1]
    late_s = 0.012 * (order - (rows - 1) / 2) / rows
    for number, of_frame in zip(seen.numbers, weights, strict=True):
        lit_s = number * PERIOD_S + late_s
        if hold_s:
            ends = np.minimum(lit_s + hold_s, seen.begin_s + seen.length_s)
            share = np.maximum(ends - np.maximum(lit_s, seen.begin_s), 0) / hold_s
        else:
            share = (lit_s >= seen.begin_s) & (lit_s < seen.begin_s + seen.length_s)
        np.testing.assert_allclose(of_frame, share / 3, atol=ROUNDING)


def test_the_light_of_an_exposure_is_each_row_s_share_of_each_frame():
    weights = np.array([[[0.5], [0.25], [0.0], [1.0]], [[0.5], [0.75], [1.0], [0.0]]])
    seen = choices.PanelExposure(0.0, 1.0, (7, 8), (70, 80), weights)

    def light_of(number: int, light_ns: int) -> choices.Lit:
        """Frame 7 lights a pixel of rows 0 and 3, frame 8 another one of row 1."""
        assert light_ns == 10 * number
        if number == 7:
            return np.array([1, 3 * 6 + 5]), np.array([4.0, 2.0])
        return np.array([6 + 2]), np.array([8.0])

    light = seen.mean(light_of, SIZE_PX)
    assert light.shape == SIZE_PX[::-1]
    assert (light[0, 1], light[3, 5], light[1, 2], light.sum()) == (2.0, 2.0, 6.0, 10.0)
    # at rest the first frame stands for all, whole
    still = seen.at_rest(light_of, SIZE_PX)
    assert (still[0, 1], still[3, 5], still.sum()) == (4.0, 2.0, 6.0)
    columns = replace(seen, weights=np.arange(12.0).reshape(2, 1, 6))
    assert columns.mean(light_of, SIZE_PX)[3, 5] == 5 * 2.0


def test_a_frame_s_light_is_a_refresh_its_delay_and_half_its_scan_late():
    monitor = {"refresh_hz": 62.5, "panel_delay_ms": 5.0, "scanout_ms": 8.0}
    config = parse_config(Path("bench.toml"), bench_text({"monitor": monitor}))
    assert choices.lead_ns(config) == 25_000_000


@pytest.mark.parametrize(
    ("turns", "can_steal", "count"), [(False, False, 14), (False, True, 28), (True, True, 54)]
)
def test_each_combination_is_measured_once(turns, can_steal, count):
    found = choices.combinations(turns, can_steal, 7.5)
    assert len(found) == len(set(found)) == count
    assert {row.faintest_v_mag for row in found} == {7.5, 6.5}
    shallow = [row for row in found if row.faintest_v_mag == 6.5]
    assert {row.sprite for row in shallow} == {"cut"}
    # the bench's own depth is drawn by all codes, the shallower one by the two that are answers
    assert {row.quantisation for row in shallow} == {"round", "exact"}
    crude = [row for row in found if row.smear == "point" or row.prediction != "rate"]
    assert all(row.sprite == "cut" for row in crude)
    assert bool(crude) == turns


def test_stars_are_off_by_their_angle_and_light_and_lost_ones_by_all():
    """An angle of 30 arcsec, and one of two stars that is lost in either measurement."""
    turn = 30 / 206264.806
    wanted = MeasuredStars(
        np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]), np.array([10.0, 20.0, 5.0])
    )
    moved = [math.sin(turn), 0.0, math.cos(turn)]
    shown = MeasuredStars(
        np.array([moved, [0.0, 1.0, 0.0], [np.nan] * 3]), np.array([9.0, 20.0, 0.0])
    )
    found = off(shown, wanted, 77.0)
    assert found.arcsec == pytest.approx([30.0, 0.0, 77.0], abs=1e-6)
    assert found.mag == pytest.approx([-2.5 * math.log10(0.9), 0.0, LOST_MAG])
    assert found.lost.tolist() == [False, False, True]
    # a star that is lost in the sky itself, and shown
    unseen = off(wanted, shown, 77.0)
    assert unseen.lost.tolist() == [False, False, True]
    assert (unseen.arcsec[2], unseen.mag[2]) == (77.0, LOST_MAG)


def test_an_attitude_is_off_by_the_turn_of_its_stars_and_two_are_enough():
    turn_arcsec = np.array([3.0, -4.0, 60.0])
    turn = to_matrix(from_rotation_vector(turn_arcsec / 206264.806))
    stars = np.array([[0.03, 0.01, 1.0], [-0.02, 0.03, 1.0], [0.01, -0.04, 1.0]])
    stars /= np.linalg.norm(stars, axis=1, keepdims=True)
    light = np.ones(3)
    wanted = MeasuredStars(stars, light)
    for lost in ((), (1,)):
        shown = stars @ turn.T
        shown[list(lost)] = np.nan
        found = attitude_off_arcsec(MeasuredStars(shown, light), wanted)
        assert found == pytest.approx((5.0, 60.0), rel=1e-3)
    shown[0] = np.nan
    assert all(
        math.isnan(turn) for turn in attitude_off_arcsec(MeasuredStars(shown, light), wanted)
    )


CUT = choices.ChainCombination("exact", False, 7.5, "cut")


def test_the_exposures_of_a_field_at_rest_have_their_stars_at_other_places():
    """3.37 and 4.71 px of the tracker further, by its own focal length."""
    for rate_deg_s, step_px in ((0.0, math.hypot(3.37, 4.71)), (1.0, 0.0)):
        movement = Movement(np.array([1.0, 0, 0, 0]), rate_deg_s)
        turned_px = []
        for number in range(3):
            moved = measuring.moved_on(movement, number, 5000.0)
            assert moved.rate_deg_s == rate_deg_s
            turn_rad = angle_between_rad(movement.q_icrs_to_cam, moved.q_icrs_to_cam)
            turned_px.append(5000 * turn_rad)
        assert turned_px == pytest.approx([0.0, step_px, 2 * step_px], abs=1e-6)


def test_an_error_is_of_the_stars_of_all_exposures_and_their_attitudes_that_are_known():
    nan = math.nan
    offs = [
        Off(np.array([3.0, 77.0]), np.array([0.2, 1.0]), np.array([False, True])),
        Off(np.array([4.0, 0.0]), np.array([0.3, 0.1]), np.array([False, False])),
        Off(np.array([77.0, 77.0]), np.array([1.0, 1.0]), np.array([True, True])),
    ]
    error = measuring.error_of(offs, [(3.0, 1.0), (4.0, nan), (nan, 7.0)])
    assert (error.stars, error.lost) == (6, 3)
    arcsec = math.sqrt((9 + 16 + 3 * 77**2) / 6)
    assert error.error_arcsec == pytest.approx(arcsec, rel=1e-3)
    assert error.error_mag == pytest.approx(math.sqrt((0.04 + 0.09 + 0.01 + 3) / 6), rel=1e-3)
    assert error.attitude_arcsec == pytest.approx(math.sqrt(12.5), rel=1e-3)
    assert error.roll_arcsec == pytest.approx(5.0)


def test_a_combination_is_called_by_what_chooses_it():
    marks = choices.Marks(replace(CUT, sprite="full"), CUT, replace(CUT, quantisation="round"))
    named = (marks.default, marks.auto, marks.as_filed)
    words = [measuring.chosen_words(combination, marks) for combination in named]
    assert words == ["default", "auto", ""]
    assert measuring.chosen_words(CUT, replace(marks, default=CUT)) == "default auto"


def test_a_still_frame_stands_for_all_unless_its_codes_change():
    alike = set()
    for rate_deg_s in (0.0, 1.0):
        movement = Movement(np.array([1.0, 0, 0, 0]), rate_deg_s)
        for method in choices.QUANTISATIONS:
            if measuring.is_alike(movement, replace(CUT, quantisation=method)):
                alike.add((rate_deg_s, method))
    assert alike == {(0.0, "round"), (0.0, "dither"), (0.0, "exact")}


def test_sizes_are_told_from_the_smallest_to_the_largest():
    assert [measuring.range_words(sizes) for sizes in ((8, 6, 10), (8, 8), (11,))] == [
        *("6 to 10", "8", "11")
    ]


def test_each_lap_has_its_own_time_and_what_the_one_before_gave(monkeypatch):
    now_ms = [0.0]
    monkeypatch.setattr(measuring.time, "perf_counter", lambda: now_ms[0] * 1e-3)
    given = []

    def lap(ms):
        def work(before):
            given.append(before)
            now_ms[0] += ms
            return ms

        return work

    assert measuring.laps_ms([lap(1), lap(2), lap(8)]) == pytest.approx((1.0, 2.0, 8.0))
    assert given == [None, 1, 2]


def test_each_frame_that_is_timed_has_another_attitude_and_its_own_moment(bench_with):
    movement = Movement(np.array([1.0, 0, 0, 0]), 0.0)
    turns_rad = []
    for frame in range(1, 4):
        moved = measuring.nudged(movement, frame)
        turns_rad.append(angle_between_rad(movement.q_icrs_to_cam, moved.q_icrs_to_cam))
    # 1e-7 rad about two axes, a frame; an angle of 1e-7 rad is known to a few per cent
    wanted_rad = math.sqrt(2) * 1e-7 * np.arange(1, 4)
    np.testing.assert_allclose(turns_rad, wanted_rad, rtol=0.1)
    bench = bench_with()
    chain = measuring.DrawingChain(CUT, bench, movement)
    light_ns, off_rad = [], []
    for frame in range(1, 4):
        timeline, at_ns = chain.next_frame()
        light_ns.append(at_ns)
        wanted = measuring.nudged(movement, frame)
        drawn = attitude_at(timeline, at_ns).q_icrs_to_cam
        off_rad.append(angle_between_rad(drawn, wanted.at(at_ns)))
    assert np.diff(light_ns).tolist() == 2 * [round(1e9 / bench.config.monitor.refresh_hz)]
    # the study's jitter is predicted by its rate
    assert max(off_rad) < 1e-6


def test_the_wait_for_the_gpu_is_of_drawing_and_not_of_reading_back(bench_with, monkeypatch):
    """A wait of 100 ms, by a clock that stands still otherwise."""
    bench = bench_with()
    now_s, finish = [0.0], bench.renderer.finish

    def waits():
        now_s[0] += 0.1
        finish()

    monkeypatch.setattr(measuring.time, "perf_counter", lambda: now_s[0])
    monkeypatch.setattr(bench.renderer, "finish", waits)
    chain = measuring.DrawingChain(CUT, bench, Movement(np.array([1.0, 0, 0, 0]), 0.0))
    stages_ms = dict(zip(measuring.STAGES, chain.stages_ms(), strict=True))
    assert {stage for stage, ms in stages_ms.items() if ms} == {"drawing and codes"}
    assert chain.timed_frames == 1


def test_places_are_within_a_margin_of_an_image_s_last_pixels():
    x = np.array([10.0, 9.9, 188.9, 189.0, 50.0, 50.0])
    y = np.array([10.0, 50.0, 50.0, 50.0, 88.9, 89.0])
    assert within(x, y, (200, 100), 10.0).tolist() == [True, False, True, False, True, False]


def test_a_star_is_seen_whole_by_its_margin_on_detector_and_monitor(tmp_path):
    """A monitor with three pixels to one of the tracker's: 10 px there are 30 here, and half a
    sprite. Both middles are on the boresight.
    """
    path = tmp_path / "bench.toml"
    tables = {
        "tracker": {"focal_length_mm": 70, "pixel_pitch_um": 15.0, "resolution_px": [121, 121]},
        "monitor": {"resolution_px": [301, 241], "pixel_pitch_um": 25.0},
        "collimator": {"focal_length_mm": 350},
    }
    path.write_text(bench_text(tables))
    with open_bench(read_bench_file(path)) as bench, StudyTracker(bench) as tracker:
        assert tracker.monitor_px_per_px == pytest.approx(3.0)
        # to the end of the monitor's last pixel but its margin
        reach_px = 150 - 10 * 3 - bench.psf.footprint_px / 2
        beyond_px = np.array([-0.2, 0.2, -0.2, 0.2, 0])
        x_px = 60 + np.array([-1, -1, 1, 1, 0]) * (reach_px + beyond_px) / 3
        y_px = np.array([60.0, 60.0, 60.0, 60.0, 9.0])
        seen = tracker.sees_around(x_px, y_px, 10.0)
    assert seen.tolist() == [True, False, True, False, False]


def test_times_are_a_median_its_quartiles_and_its_noise():
    walls = [4.0, 1.0, 2.0, 3.0, 10.0]
    taken = measuring.times_of(np.array([Spent(wall, 10 * wall) for wall in walls]))
    assert (taken.time_ms, taken.iqr_ms, taken.cpu_ms, taken.frames) == (3.0, 2.0, 30.0, 5)
    # the standard error of a median is 1.2533 sigma over the root of its number
    sigma_ms = 2.0 / 1.349
    assert taken.noise_ms == pytest.approx(1.2533 * sigma_ms / math.sqrt(5), abs=1e-4)
    assert measuring.noise_ends_ms(4.0, 1.0) == (3.0, 5.0)
    assert measuring.noise_ends_ms(4.0, 3.0) == (2.0, 7.0)
    assert measuring.rounded(0.123456) == 0.1235 and math.isnan(measuring.rounded(math.nan))
    assert measuring.rms_of_known([3.0, math.nan, 4.0]) == pytest.approx(math.sqrt(12.5))
    assert math.isnan(measuring.rms_of_known([math.nan]))
