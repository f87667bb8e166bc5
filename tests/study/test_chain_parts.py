"""The study of the chain in parts: exposures before a panel, times, and what is said of planted
rows.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics import charts
from hilstar.instruments.study.chain import answers, choices, measuring, run
from hilstar.instruments.study.chain.measuring import CombinationRow, ErrorPart, StageTime
from hilstar.instruments.study.chain.tracker import LOST_MAG, MeasuredStars, StarJudge, off, within
from hilstar.instruments.study.sweep import Load, Spent
from hilstar.optics.scan import Scan

PERIOD_S = 1 / 50
SIZE_PX = (6, 4)
ROUNDING = 1e-9


def bench_of(scan: Scan, exposure_s: float) -> SimpleNamespace:
    """A bench of 50 Hz whose panel lights up so."""
    monitor = SimpleNamespace(refresh_hz=1 / PERIOD_S)
    config = SimpleNamespace(monitor=monitor, tracker=SimpleNamespace(exposure_s=exposure_s))
    return SimpleNamespace(config=config, scan=scan, camera=SimpleNamespace(resolution_px=SIZE_PX))


@pytest.mark.parametrize("hold_s", [0.0, 0.004, PERIOD_S], ids=["flash", "short", "whole"])
@pytest.mark.parametrize(("down", "axis"), [((0, 1), 0), ((0, -1), 0), ((1, 0), 1), ((-1, 0), 1)])
def test_each_row_gives_one_light_over_whole_refreshes(hold_s, down, axis):
    """Rows light over 12 ms, the middle of the panel at a frame's time; the exposure begins 3.7 ms
    after that of frame 10, and is three refreshes long.
    """
    scan = Scan(down, 0.012, hold_s)
    seen = choices.exposure(bench_of(scan, 3 * PERIOD_S), 10)
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
    monitor = SimpleNamespace(period_ms=16.0, panel_delay_ms=5.0, panel_scanout_ms=8.0)
    assert choices.lead_ns(SimpleNamespace(monitor=monitor)) == 25_000_000


@pytest.mark.parametrize(
    ("turns", "can_steal", "count"), [(False, False, 14), (False, True, 28), (True, True, 54)]
)
def test_each_combination_is_measured_once(turns, can_steal, count):
    found = choices.combinations(turns, can_steal, 7.5)
    assert len(found) == len(set(found)) == count
    assert {row.faintest_v_mag for row in found} == {7.5, 6.5}
    shallow = [row for row in found if row.faintest_v_mag == 6.5]
    assert {row.sprite for row in shallow} == {"cut"}
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
    judge = SimpleNamespace(lost_arcsec=77.0)
    found = off(judge, shown, wanted)
    assert found.arcsec == pytest.approx([30.0, 0.0, 77.0], abs=1e-6)
    assert found.mag == pytest.approx([-2.5 * math.log10(0.9), 0.0, LOST_MAG])
    assert found.lost.tolist() == [False, False, True]


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
    worse = row(bit_stealing="true", error_arcsec=0.95, time_ms=6.0)
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
