"""The study of the chain in parts: exposures before a panel, times, and what is said of planted
rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics import charts
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import (
    angle_between_rad,
    from_rotation_vector,
    propagate,
    random_attitudes,
    to_matrix,
)
from hilstar.instruments.study.chain import answers, choices, measuring, run
from hilstar.instruments.study.chain.measuring import CombinationRow, ErrorPart, StageTime
from hilstar.instruments.study.chain.tracker import (
    LOST_MAG,
    MeasuredStars,
    Off,
    StarJudge,
    attitude_off_arcsec,
    off,
    within,
)
from hilstar.instruments.study.predictors import Movement, attitude_at
from hilstar.instruments.study.sweep import Load, Spent
from hilstar.optics.scan import Scan
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.config import AttitudeSettings, parse_config
from tests.support.benches import SMALL_BENCH, bench_text
from tests.support.tables import csv_rows

PERIOD_S = 1 / 50
SIZE_PX = (6, 4)
ROUNDING = 1e-9


def bench_of(scan: Scan, exposure_s: float) -> SimpleNamespace:
    """A bench of 50 Hz whose panel lights up so."""
    monitor = SimpleNamespace(refresh_hz=1 / PERIOD_S)
    config = SimpleNamespace(monitor=monitor, tracker=SimpleNamespace(exposure_s=exposure_s))
    return SimpleNamespace(config=config, scan=scan, camera=SimpleNamespace(resolution_px=SIZE_PX))


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


@pytest.fixture
def planted_scene(monkeypatch):
    """A scene of three exposures whose stars are off by planted errors, whatever is drawn; with
    the movement and the exposure that each judge was made of.
    """
    made = []

    class Judge:
        def __init__(self, tracker, movement, seen):
            self.movement, self.seen, self.sky = movement, seen, "sky"
            self.lost_arcsec = 77.0
            made.append(self)

        def __len__(self):
            return 2

        def measure(self, image_e):
            return made.index(self)

    nan = math.nan
    offs = [
        Off(np.array([3.0, 77.0]), np.array([0.2, 1.0]), np.array([False, True])),
        Off(np.array([4.0, 0.0]), np.array([0.3, 0.1]), np.array([False, False])),
        Off(np.array([77.0, 77.0]), np.array([1.0, 1.0]), np.array([True, True])),
    ]
    turns = [(3.0, 1.0), (4.0, nan), (nan, 7.0)]
    monkeypatch.setattr(measuring, "StarJudge", Judge)
    monkeypatch.setattr(measuring, "off", lambda shown, sky, lost_arcsec: offs[shown])
    monkeypatch.setattr(measuring, "attitude_off_arcsec", lambda shown, sky: turns[shown])
    monkeypatch.setattr(measuring.DrawingChain, "exposed", lambda chain, seen: seen)
    monkeypatch.setattr(measuring.DrawingChain, "sprite_px", lambda chain: "9")
    bench = bench_of(Scan((0, 1), 0.0, 0.0), 0.1)
    bench.config.monitor.bits = 10

    def marks(movement):
        other = replace(CUT, quantisation="round")
        return choices.Marks(replace(CUT, sprite="full"), CUT, other)

    parts = SimpleNamespace(
        own=bench, can_steal_bits=False, faintest_v_mag=7.5, marks=marks, bench=lambda chosen: bench
    )
    camera = SimpleNamespace(focal_length_px=5000.0)
    tracker = SimpleNamespace(camera=camera, image_e=lambda light, seen: light)

    def scene(rate_deg_s):
        of = choices.ChainScene("s", "why", np.array([1.0, 0, 0, 0]), rate_deg_s)
        return measuring.SceneMeasurement(parts, tracker, of, measuring.Rounds()), list(made)

    return scene


CUT = choices.ChainCombination("exact", False, 7.5, "cut")


def test_exposures_begin_at_their_own_frames_and_at_rest_at_other_places(planted_scene):
    """3.37 and 4.71 px of the tracker further, by its own focal length."""
    for rate_deg_s, step_px in ((0.0, math.hypot(3.37, 4.71)), (1.0, 0.0)):
        scene, judges = planted_scene(rate_deg_s)
        begins_s = [judge.seen.begin_s for judge in judges[-3:]]
        wanted_s = [number * PERIOD_S + 0.0037 for number in (20, 151, 325)]
        assert begins_s == pytest.approx(wanted_s)
        turned_px = []
        for judge in judges[-3:]:
            turn_rad = angle_between_rad(
                judges[-3].movement.q_icrs_to_cam, judge.movement.q_icrs_to_cam
            )
            turned_px.append(5000 * turn_rad)
        assert turned_px == pytest.approx([0.0, step_px, 2 * step_px], abs=1e-6)
        assert scene.star_count == 6


def test_a_row_is_of_all_exposures_and_has_its_own_marks(planted_scene):
    scene, _ = planted_scene(0.0)
    error = scene.error(CUT)
    assert (error.stars, error.lost) == (6, 3)
    arcsec = math.sqrt((9 + 16 + 3 * 77**2) / 6)
    assert error.error_arcsec == pytest.approx(arcsec, rel=1e-3)
    assert error.error_mag == pytest.approx(math.sqrt((0.04 + 0.09 + 0.01 + 3) / 6), rel=1e-3)
    assert error.attitude_arcsec == pytest.approx(math.sqrt(12.5), rel=1e-3)
    assert error.roll_arcsec == pytest.approx(5.0)
    rows = {
        (row.quantisation, row.sprite): row for row in scene.untimed() if row.faintest_v_mag == 7.5
    }
    marks = {
        key: (row.chosen, row.as_filed)
        for key, row in rows.items()
        if row.chosen or row.as_filed == "true"
    }
    assert marks == {
        ("exact", "full"): ("default", "false"),
        ("exact", "cut"): ("auto", "false"),
        ("round", "cut"): ("", "true"),
    }
    first = rows["exact", "cut"]
    assert (first.exposure_s, first.bits, first.bit_stealing, first.scene) == (
        0.1,
        10,
        "false",
        "s",
    )


def test_a_still_frame_stands_for_all_unless_its_codes_change():
    seen = SimpleNamespace(at_rest=lambda *_: "first", mean=lambda *_: "all")
    bench = SimpleNamespace(camera=SimpleNamespace(resolution_px=SIZE_PX))
    exposed = {}
    for rate_deg_s in (0.0, 1.0):
        movement = Movement(np.array([1.0, 0, 0, 0]), rate_deg_s)
        for method in choices.QUANTISATIONS:
            chain = measuring.DrawingChain(replace(CUT, quantisation=method), bench, movement)
            exposed[rate_deg_s, method] = chain.exposed(seen)
    assert {key for key, of in exposed.items() if of == "first"} == {
        (0.0, "round"),
        (0.0, "dither"),
        (0.0, "exact"),
    }


def test_the_sides_of_sprites_are_from_the_smallest_to_the_largest():
    def sides(*sides_px):
        target = SimpleNamespace(sides=[SimpleNamespace(side_px=side) for side in sides_px])
        renderer, psf = SimpleNamespace(target=target), SimpleNamespace(footprint_px=11)
        bench = SimpleNamespace(renderer=renderer, psf=psf)
        return measuring.DrawingChain(CUT, bench, None).sprite_px()

    assert [sides(8, 6, 10), sides(8, 8), sides()] == ["6 to 10", "8", "11"]


def test_the_stages_of_a_frame_are_its_own_and_each_frame_has_another_attitude(monkeypatch):
    """Prediction takes 1 ms, sprites 2, codes 4 with the wait for the GPU, reading back 8."""
    now_ms = [0.0]
    monkeypatch.setattr(measuring.time, "perf_counter", lambda: now_ms[0] * 1e-3)
    attitudes = []

    def takes(ms, result=None):
        now_ms[0] += ms
        return result

    def predicted(timeline, light_ns):
        attitudes.append((timeline, light_ns))
        return takes(1, SimpleNamespace(q_icrs_to_cam=None, rate_cam_rad_s=None))

    class Drawn:
        levels = property(lambda drawn: takes(8))

    bench = bench_of(Scan((0, 1), 0.0, 0.0), 0.1)
    bench.view = lambda q, rate: None
    bench.light = lambda view: takes(2)
    bench.draw_sprites = lambda sprites, number: takes(3, Drawn())
    bench.renderer = SimpleNamespace(finish=lambda: takes(1))
    monkeypatch.setattr(measuring, "attitude_at", predicted)
    monkeypatch.setattr(measuring.DrawingChain, "timeline", lambda chain, movement, ns: movement)
    chain = measuring.DrawingChain(CUT, bench, Movement(np.array([1.0, 0, 0, 0]), 0.0))
    for _ in range(3):
        assert chain.stages_ms() == pytest.approx((1.0, 2.0, 4.0, 8.0))
    light_ns = [ns for _, ns in attitudes]
    assert np.diff(light_ns).tolist() == [20_000_000] * 2
    turns_rad = []
    for movement, _ in attitudes:
        turns_rad.append(angle_between_rad(np.array([1.0, 0, 0, 0]), movement.q_icrs_to_cam))
    # 1e-7 rad about two axes, a frame; an angle of 1e-7 rad is known to a few per cent
    wanted_rad = math.sqrt(2) * 1e-7 * np.arange(1, 4)
    np.testing.assert_allclose(turns_rad, wanted_rad, rtol=0.1)


def test_places_are_within_a_margin_of_an_image_s_last_pixels():
    x = np.array([10.0, 9.9, 188.9, 189.0, 50.0, 50.0])
    y = np.array([10.0, 50.0, 50.0, 50.0, 88.9, 89.0])
    assert within(x, y, (200, 100), 10.0).tolist() == [True, False, True, False, True, False]


def test_a_star_is_judged_by_its_margin_on_detector_and_monitor():
    """A monitor with three pixels to one of the tracker's: 10 px there are 30 here, and half a
    sprite of 9 px.
    """
    size_px = (400, 300)
    tracker = SimpleNamespace(
        camera=SimpleNamespace(resolution_px=(1000, 1000)),
        geometry=SimpleNamespace(to_monitor=lambda x, y: (3 * x, 3 * y)),
        bench=SimpleNamespace(
            psf=SimpleNamespace(footprint_px=9), camera=SimpleNamespace(resolution_px=size_px)
        ),
        monitor_px_per_px=3.0,
    )
    judge = object.__new__(StarJudge)
    judge.tracker = tracker
    x = np.array([11.6, 11.4, 121.4, 121.6])
    y = np.full(4, 40.0)
    assert judge._inside(x, y, 10.0).tolist() == [True, False, True, False]


def test_times_are_a_median_its_quartiles_and_its_noise():
    walls = [1.0, 2.0, 3.0, 4.0, 10.0]
    taken = measuring.times_of(np.array([Spent(wall, 10 * wall) for wall in walls]))
    assert (taken.time_ms, taken.iqr_ms, taken.cpu_ms, taken.frames) == (3.0, 2.0, 30.0, 5)
    # the standard error of a median is 1.2533 sigma over the root of its number
    sigma_ms = 2.0 / 1.349
    assert taken.noise_ms == pytest.approx(1.2533 * sigma_ms / math.sqrt(5), abs=1e-4)
    assert measuring.noise_ends_ms(4.0, 1.0) == (3.0, 5.0)
    assert measuring.noise_ends_ms(4.0, 3.0) == (2.0, 7.0)
    assert measuring.rounded(0.123456) == 0.1235
    assert measuring.rms_of_known([3.0, math.nan, 4.0]) == pytest.approx(math.sqrt(12.5))
    assert math.isnan(measuring.rms_of_known([math.nan]))


ROW = CombinationRow(
    scene="average field",
    rate_deg_s=0.0,
    exposure_s=0.1,
    bits=8,
    bit_stealing="false",
    faintest_v_mag=7.5,
    sprite="cut",
    sprite_px="9",
    smear="path",
    prediction="rate",
    quantisation="exact",
    stars=30,
    lost=0,
    error_arcsec=1.0,
    error_mag=0.01,
    attitude_arcsec=0.3,
    roll_arcsec=4.0,
    time_ms=5.0,
    iqr_ms=0.2,
    noise_ms=0.01,
    cpu_ms=5.0,
    frames=20,
)
AUTO = replace(ROW, chosen="auto")


def row(**changes: object) -> CombinationRow:
    return replace(ROW, **changes)


def test_rows_are_the_fastest_first_with_three_fronts():
    rows = run.rows_of(
        [
            AUTO,
            row(quantisation="round", time_ms=2.0, error_arcsec=3.0, error_mag=0.009),
            row(quantisation="dither", time_ms=6.0, error_arcsec=1.5),
            row(bit_stealing="true", time_ms=4.0, error_arcsec=0.9, error_mag=0.02),
        ]
    )
    assert [each.time_ms for each in rows] == [2.0, 4.0, 5.0, 6.0]
    assert [each.on_front for each in rows] == ["true", "true", "false", "false"]
    # by light the first is the best of all
    assert [each.on_front_mag for each in rows] == ["true", "false", "false", "false"]
    # bit stealing is not effort's choice: without it auto is on its front
    assert [each.on_front_as_filed for each in rows] == ["true", "false", "true", "false"]
    bare = run.without_fronts(rows[0])
    assert (bare.on_front, bare.on_front_mag, bare.on_front_as_filed) == ("", "", "")


@pytest.mark.parametrize(
    ("rival", "words"),
    [
        ({"time_ms": 9.0, "error_arcsec": 0.5}, "on the front"),
        (
            {"time_ms": 4.98, "noise_ms": 0.0},
            "on the front within the noise: exact, cut sprites is 1 arcsec off and 0.02 ms faster"
            " (noise 0.01 ms)",
        ),
        (
            {"time_ms": 3.0, "quantisation": "round"},
            "not on the front: round, cut sprites is 1 arcsec off and 2 ms faster (noise 0.014 ms):"
            " effort compares exact and round by their worst star at any sub-pixel phase, not by a"
            " field's rms",
        ),
        (
            {"time_ms": 3.0, "bit_stealing": "true"},
            "not on the front: exact with bit stealing, cut sprites is 1 arcsec off and 2 ms faster"
            " (noise 0.014 ms): bit stealing is the bench file's choice, for a panel whose"
            " primaries are known as the tracker sees them; on the front of what effort may choose",
        ),
    ],
)
def test_where_auto_stands_is_said_with_what_beats_it(rival, words):
    assert run.standing([AUTO, row(**rival)]) == words


def test_why_auto_does_not_take_a_row_is_each_choice_that_differs():
    own = replace(AUTO, rate_deg_s=1.0)
    assert run.words(own) == "exact, cut sprites, paths, rate"
    for changes, words in (
        ({"quantisation": "temporal"}, "temporal is right over an exposure"),
        ({"sprite": "coarse"}, "coarse sprites are beyond the tolerance"),
        ({"sprite": "full"}, "cut sprites save nothing here"),
        ({"smear": "point"}, "points instead of paths"),
        ({"prediction": "two samples"}, "prediction by two samples is the sender's choice"),
        ({"faintest_v_mag": 6.5}, "the catalogue's depth is the bench file's choice"),
    ):
        reason = run.why_not(own, replace(own, **changes))
        assert reason.startswith(words) and ";" not in reason
    held = replace(own, prediction="held")
    assert (
        run.why_not(held, own) == "[attitude] max_extrapolation_ms = 0 is the bench file's choice"
    )
    both = run.why_not(own, replace(own, smear="point", sprite="coarse"))
    assert both == "coarse sprites are beyond the tolerance; points instead of paths"


BUDGET = [
    ErrorPart("average field", "auto", "refresh", 0.2, 0.03),
    ErrorPart("average field", "auto", "codes", 0.7, 0.01),
    ErrorPart("average field", "auto", "rss", 0.73, 0.032),
    ErrorPart("average field", "auto", "whole", 0.75, 0.033),
    ErrorPart("1 deg/s", "auto", "refresh", math.nan, 0.03),
    ErrorPart("1 deg/s", "auto", "codes", 0.7, 0.01),
    ErrorPart("1 deg/s", "auto", "whole", 9.0, 0.01),
]
STAGES = [
    StageTime("average field", "auto", "prediction", 1.0),
    StageTime("average field", "auto", "drawing and codes", 3.0),
]


def test_a_scene_s_line_has_its_figures_and_the_largest_part_of_each():
    line = run.scene_line([replace(AUTO, lost=2)], BUDGET[:4], STAGES, Load())
    assert line == (
        "average field: auto (exact, cut sprites) is 1 arcsec and 0.01 mag off over 30 stars, 2 of"
        " them lost, in 5 ms; on the front; error: codes 0.7 arcsec; time: drawing and codes 75%"
    )
    finding = run.budget_finding(["average field", "1 deg/s"], BUDGET, STAGES, Load())
    # what is not known counts as the largest
    assert finding == (
        "Of auto's error most is quantisation in the average field, panel's refresh at 1 deg/s; of"
        " its time most is drawing and codes"
    )


def test_tables_and_charts_of_scenes_are_of_their_rows(tmp_path, figures):
    scene = run.rows_of(
        [
            AUTO,
            row(quantisation="round", time_ms=2.0, error_arcsec=3.0, chosen="default"),
            row(quantisation="exact", faintest_v_mag=6.5, time_ms=4.0, error_arcsec=9.0, lost=3),
        ]
    )
    result = run.SceneResult(scene, BUDGET[:4], STAGES)
    lines = run.write_chain(tmp_path, [result], [], ["of nothing"], Load())
    chain, budget = figures
    (axes,) = chain.axes
    assert axes.get_title(loc="left") == "Average field, 30 stars"
    points = {tuple(line.get_xydata()[0]) for line in axes.get_lines() if line.get_marker() == "o"}
    assert points == {(2.0, 3.0), (4.0, 9.0), (5.0, 1.0)}
    rings = {}
    for line in axes.get_lines():
        if line.get_marker() == "o" and line.get_markerfacecolor() == "none":
            rings[line.get_markeredgecolor()] = tuple(line.get_xydata()[0])
    assert rings == {charts.RED: (5.0, 1.0), charts.INK: (2.0, 3.0)}
    place, light, times = budget.axes
    bars = [[bar.get_width() for bar in of.patches] for of in (place, light, times)]
    assert bars == [[0.2, 0.7, 0.75], [0.03, 0.01, 0.033], [1.0, 3.0]]
    colours = [bar.get_facecolor() for bar in place.patches]
    assert colours[0] == colours[1] != colours[2]  # the whole of it
    assert lines[0].startswith('at rest on 8 bits: set quantisation = "exact", 1 arcsec')
    assert lines[1].startswith("bit stealing: not on this panel")
    assert lines[-1] == (
        "depth: keep faintest_v_mag = 7.5; with 6.5 the tracker loses 3 of 30 stars"
    )


def test_a_shallower_catalogue_is_judged_by_its_best_row():
    rows = [ROW, row(faintest_v_mag=6.5, error_arcsec=2.0, lost=4)]
    rows.append(row(faintest_v_mag=6.5, error_arcsec=1.5))
    assert answers.depth_line(rows) == (
        "depth: faintest_v_mag = 6.5 is enough; it loses none of 30 stars"
    )
    assert answers.depth_line([ROW]) == "depth: faintest_v_mag = 7.5 was measured alone"


def test_bit_stealing_is_worth_what_it_takes_off_the_error():
    plain = row(quantisation="round", error_arcsec=1.0, time_ms=4.0)
    stealing = row(bit_stealing="true", error_arcsec=0.5, time_ms=6.0)
    worse = row(bit_stealing="true", error_arcsec=0.95, error_mag=0.001, time_ms=6.0)
    assert answers.stealing_line([plain, stealing, worse], plain, Load()) == (
        "bit stealing, if the primaries are known in the tracker's colours: takes"
        f" {charts.two_digits(1.0)} arcsec to {charts.two_digits(0.5)} in 1.50 of the time, with"
        " exact"
    )
    assert "brings nothing at rest" in answers.stealing_line([plain, worse], plain, Load())
    busy = Load(1e3)
    assert "of the time" not in answers.stealing_line([plain, stealing], plain, busy)
    assert answers.rest_lines([plain, row(error_arcsec=0.2)], Load())[0].startswith(
        'at rest on 8 bits: set quantisation = "exact", 0.2 arcsec (round: 1 in 0.80 of the time)'
    )


def test_answers_are_whole_choices_of_what_the_sender_gives():
    """Neither coarse nor full sprites, nor points; rates are used where they come, and only there."""
    turning = row(rate_deg_s=1.0)
    rows = [
        turning,
        replace(turning, prediction="two samples"),
        replace(turning, prediction="held"),
    ]
    rows += [replace(turning, sprite="coarse"), replace(turning, sprite="full")]
    rows += [replace(turning, smear="point"), replace(turning, faintest_v_mag=6.5)]
    rows.append(replace(turning, quantisation="temporal"))
    by_given = {}
    for rates in (True, False):
        chosen = answers.allowed(rows, answers.Given(primaries=True, rates=rates))
        assert {(each.sprite, each.smear, each.quantisation) for each in chosen} == {
            ("cut", "path", "exact")
        }
        by_given[rates] = [each.prediction for each in chosen]
    assert by_given == {True: ["rate"], False: ["two samples", "held"]}


def test_an_answer_s_light_is_held_against_rows_that_are_as_near():
    """A row far off in place is no measure of light."""
    near = row(quantisation="round", error_arcsec=1.0, error_mag=0.02)
    far = row(error_arcsec=9.0, error_mag=0.001)
    assert answers.simplest([near, far]) is near


def test_a_prediction_s_error_is_that_of_its_best_codes():
    rows = []
    for prediction, quantisation, arcsec in (
        *(("rate", "round", 3.0), ("rate", "exact", 2.0), ("rate", "temporal", 0.1)),
        *(("two samples", "exact", 1.0), ("two samples", "round", 1.5), ("held", "exact", 70.0)),
    ):
        changes = {"prediction": prediction, "quantisation": quantisation}
        rows.append(row(rate_deg_s=1.0, error_arcsec=arcsec, **changes))
    rows.append(row(prediction="held", faintest_v_mag=6.5, error_arcsec=0.1))
    rows.append(row(prediction="held", bit_stealing="true", error_arcsec=0.1))
    assert answers.prediction_words(rows) == (
        "send no rates, which carry such a vibration on (by the packets' rates 2, by two samples 1,"
        " the newest attitude held 70 arcsec)"
    )


def test_the_title_says_in_how_many_scenes_auto_is_on_the_front():
    beaten = row(scene="1 deg/s", time_ms=1.0, error_arcsec=0.1)
    rows = [AUTO, replace(AUTO, scene="dense field"), replace(AUTO, scene="1 deg/s"), beaten]
    title = run.headline(rows, Load())
    assert title.endswith("or within its noise, in 2 of 3 scenes, not in 1 deg/s")
    assert run.headline(rows[:3], Load()).endswith("in 3 of 3 scenes")
    assert "2 of 3" not in run.headline(rows, Load(1e3))


def test_points_are_named_on_the_front_where_they_are_a_tenth_better_and_once_a_code_beside_it():
    rows = [
        row(quantisation="round", error_arcsec=9.0, on_front="true"),
        row(quantisation="round", error_arcsec=8.2, on_front="true", faintest_v_mag=6.5),
        row(quantisation="exact", error_arcsec=8.0, on_front="true", bit_stealing="true"),
        row(quantisation="dither", error_arcsec=30.0, rate_deg_s=1.0, smear="point"),
        row(quantisation="dither", error_arcsec=20.0, rate_deg_s=1.0, prediction="held"),
        replace(AUTO, error_arcsec=1.0, time_ms=12.0, on_front="true"),
        row(quantisation="temporal", error_arcsec=40.0, chosen="default"),
    ]
    at = [(each.time_ms, each.error_arcsec) for each in rows]
    assert [(name, place[1], colour) for name, place, colour in run.side_names(rows, at)] == [
        ("round", 9.0, charts.PURPLE),
        ("exact + bit stealing", 8.0, charts.BLUE),
        ("auto: 1 arcsec, 12 ms", 1.0, charts.RED),
        ("default: 40 arcsec, 5 ms", 40.0, charts.INK),
        ("dither, paths held", 20.0, charts.ORANGE),
        ("temporal", 40.0, charts.GREEN),
    ]
    assert run.short_words(rows[3], AUTO) == "dither, points by rate"
    assert run.short_words(rows[1], AUTO) == "round, fewer stars"


def test_an_error_of_nothing_stands_far_below_the_smallest(tmp_path, figures):
    """On a logarithmic axis: a thousandth of it."""
    rows = [AUTO, row(error_arcsec=0.0, time_ms=9.0)]
    run.draw(tmp_path / "c", rows, "A finding", "a machine", [])
    drawn = set()
    for line in figures[0].axes[0].get_lines():
        drawn.update(line.get_ydata())
    assert min(drawn) == pytest.approx(1e-3) and max(drawn) == 1.0


@dataclass(frozen=True)
class SimpleGlass:
    """A row of a glass."""

    psf: str
    error_arcsec: float


def test_a_busy_machine_s_tables_have_no_front_and_no_verdict(tmp_path, monkeypatch):
    for name in ("draw", "draw_budget"):
        monkeypatch.setattr(run, name, lambda *drawn: None)
    beaten = [AUTO, row(time_ms=1.0, error_arcsec=0.1)]
    result = run.SceneResult(run.rows_of(beaten), BUDGET[:4], STAGES)
    assert run.verdict([result], Load()) is False
    assert run.verdict([result], Load(1e3)) is None
    run.write_chain(tmp_path, [result], [], ["of nothing"], Load(1e3))
    fronts = {
        (row["on_front"], row["on_front_mag"], row["on_front_as_filed"])
        for row in csv_rows(tmp_path / "chain.csv")
    }
    assert fronts == {("", "", "")}
    glass = [SimpleGlass("a Gaussian", 2.0), SimpleGlass("a basis of 6", 0.5)]
    run.write_chain(tmp_path, [result], glass, ["of nothing"], Load())
    psfs = [(row["psf"], row["error_arcsec"]) for row in csv_rows(tmp_path / "chain_psf.csv")]
    assert psfs == [("a Gaussian", "2.0"), ("a basis of 6", "0.5")]
    assert {row["on_front"] for row in csv_rows(tmp_path / "chain.csv")} == {"true", "false"}


def test_steps_that_change_nothing_are_named_and_not_drawn(tmp_path, figures):
    """One that changes light alone is drawn."""
    scene = "average field"
    budget = [
        ErrorPart(scene, "auto", "depth", 0.0, 0.03),
        ErrorPart(scene, "auto", "smear", 0.0, 0.0),
        ErrorPart(scene, "auto", "codes", 0.7, 0.01),
        ErrorPart(scene, "auto", "prediction", 0.0, 0.0),
        ErrorPart(scene, "auto", "whole", 0.75, 0.033),
    ]
    turning = replace(AUTO, scene="1 deg/s", rate_deg_s=1.0)
    more = [replace(part, scene="1 deg/s", error_arcsec=2 * part.error_arcsec) for part in budget]
    stages = [*STAGES, StageTime("1 deg/s", "auto", "sprites", 7.0)]
    run.draw_budget(tmp_path / "b", [AUTO, turning], [*budget, *more], stages, Load())
    place, light, times, turning_place, _, turning_times = figures[0].axes
    # each scene's own parts and stages
    assert [bar.get_width() for bar in turning_place.patches] == [0.0, 1.4, 1.5]
    assert [bar.get_width() for bar in times.patches] == [1.0, 3.0]
    assert [bar.get_width() for bar in turning_times.patches] == [7.0]
    assert [bar.get_width() for bar in place.patches] == [0.0, 0.7, 0.75]
    assert [bar.get_width() for bar in light.patches] == [0.03, 0.01, 0.033]
    note = " ".join(figures[0].get_supxlabel().split())
    assert note.endswith("; smear and prediction change nothing here.")
