"""hilstar study faults: a chart of what each kind costs, and where stray light takes the stars
with it.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.rotation import angle_between_rad, propagate
from hilstar.cli.study import study_lines
from hilstar.display.quantise import shown_light
from hilstar.instruments.study import faults
from hilstar.instruments.study.faults import CASES, NOWHERE, QUANTISATIONS, Stray
from hilstar.instruments.study.sweep import Load
from hilstar.optics.layers.fault_kinds import KINDS

pytestmark = pytest.mark.study

UPPER, LOWER, LEFT, RIGHT = slice(540), slice(540, None), slice(960), slice(960, None)
# of 1920 x 1080 px: the upper left one, its neighbours, and the lower right one
QUARTERS = ((UPPER, LEFT), (LOWER, LEFT), (UPPER, RIGHT), (LOWER, RIGHT))


@pytest.fixture(scope="module")
def faults_study(whole_study):
    return whole_study.reported("faults", {"faults", "faults_cost"}, faults.measure(quick=True))


def test_every_kind_but_a_dropped_frame_has_its_cost(faults_study):
    kinds = {table["kind"] for tables in CASES.values() for table in tables}
    assert kinds == set(KINDS) - {"drop"}  # which draws nothing
    costs = faults_study.rows("faults-cost")
    assert [(row["quantisation"], row["case"]) for row in costs] == [
        (q, case) for q in QUANTISATIONS for case in CASES
    ]
    assert all(float(row["without_ms"]) > 0 for row in costs)
    assert NOWHERE in CASES and len(faults_study.findings) == 4


def test_stray_light_of_white_leaves_no_star_and_none_leaves_all(faults_study):
    strays = faults_study.rows("faults-stray")
    for quantisation in QUANTISATIONS:
        mine = {
            float(row["share_of_white"]): row
            for row in strays
            if row["quantisation"] == quantisation
        }
        assert float(mine[1.0]["lost"]) == 1.0
        assert float(mine[0.0]["lost"]) < 0.05
        assert int(mine[0.0]["stars"]) > 20


def test_the_cost_of_a_fault_is_its_frame_less_the_same_frame_without_it():
    cost = faults.fault_cost("exact", "blank", {"with": 7.0, "without": 5.0})
    assert cost == faults.FaultCost("exact", "blank", 7.0, 5.0, 2.0)


def test_stray_light_spoils_from_the_least_share_beyond_which_stars_are_off():
    off_mag = {0.0: 0.5, 0.01: 0.05, 0.03: 0.2, 0.1: 0.4}
    strays = [Stray("round", share, 30, 0.0, mag, 0.0) for share, mag in off_mag.items()]
    strays.append(Stray("exact", 0.01, 30, 0.0, 0.1, 0.0))
    assert faults.spoilt_from(strays, "round") == 0.03
    assert faults.spoilt_from(strays, "exact") is None


@pytest.fixture(scope="module")
def panel(tmp_path_factory):
    """The study's own bench with exact codes, and its folder."""
    folder = tmp_path_factory.mktemp("panel")
    with faults.bench_of(folder, "exact") as bench:
        yield bench, folder


def shown(panel, case, frame=0):
    """The light of a frame of a case with its faults, and without."""
    bench, folder = panel
    frames = faults.CaseFrames(bench, folder, case)
    without = shown_light(frames.without(frame), bench.panel).copy()
    return shown_light(frames.with_faults(frame), bench.panel).copy(), without


def test_each_fault_changes_the_frame_as_its_kind_says(panel):
    """What is added or lost, in electrons a second; codes are within a percent of what they show."""
    bench, _ = panel
    vega_e_per_s = {}
    for mag in (2.0, 4.0):
        near = np.argsort(np.abs(bench.stars.v_mag - mag))[:5]
        own = bench.stars.electrons_per_s[near] * 10 ** (0.4 * (bench.stars.v_mag[near] - mag))
        vega_e_per_s[mag] = np.median(own)
    for case in ("false star, on the sky", "false star, moving", "64 false stars"):
        faulty, without = shown(panel, case)
        added = (faulty - without).sum()
        count, mag = (64, 4.0) if case.startswith("64") else (1, 2.0)
        # of other colours up to a third more or less; white clips none of them here by half
        assert 0.4 < added / (count * vega_e_per_s[mag]) < 2.0, case
    faulty, without = shown(panel, "star gone")
    (row,) = np.flatnonzero(bench.stars.hip == 26311)
    lost = without - faulty
    # white clips it; nothing else goes, but for codes of its neighbours
    assert 0.01 < lost.sum() / bench.stars.electrons_per_s[row] < 1.01
    y_px, x_px = np.nonzero(lost)
    assert np.ptp(x_px) < 40 and np.ptp(y_px) < 40
    assert not shown(panel, "blank")[0].any()
    for case in ("40 tracks of 12 px", "400 tracks of 25 px", "flash at a star", "gradient"):
        faulty, without = shown(panel, case)
        assert (faulty - without).sum() > 0.01 * without.sum(), case
    # a map of nothing at the upper left corner, and of the most at the lower right one
    faulty, without = shown(panel, "measured map")
    added = faulty - without
    first, *sides, last = (added[rows, columns].mean() for rows, columns in QUARTERS)
    assert 0 < 1.5 * first < min(sides) <= max(sides) < last
    faulty, without = shown(panel, NOWHERE)
    np.testing.assert_array_equal(faulty, without)


def test_a_frozen_frame_is_the_one_before_and_a_wrong_attitude_is_half_a_degree_off(panel):
    bench, folder = panel
    frames = faults.CaseFrames(bench, folder, "frozen")
    first = frames.without(0).copy()
    np.testing.assert_array_equal(frames.with_faults(30), first)
    assert (frames.without(30) != first).any()
    # turned about y by half a degree: along x, or the one way or the other
    frames = faults.CaseFrames(bench, folder, "wrong attitude")
    turned = frames.with_faults(0).copy()
    same = []
    for half_deg in (-0.5, 0.5):
        q = propagate(faults.FIELD, np.radians([0.0, half_deg, 0.0]), 1.0)
        same.append(np.mean(bench.draw(q).levels == turned))
    assert max(same) > 0.9999 > min(same)


def test_the_slew_turns_by_its_rate_from_frame_to_frame():
    rate_rad_s = np.linalg.norm(faults.SLEW_RAD_S)
    off_rad = angle_between_rad(faults.attitude_of(0), faults.attitude_of(90))
    assert off_rad == pytest.approx(rate_rad_s * 90 / faults.REFRESH_HZ)


def test_stars_over_stray_light_are_measured_without_it(panel):
    """What a star adds to the codes is its own light, to the half steps of its pixels; over white
    nothing is to be added.
    """
    none, little, white = (faults.stray_light(panel[0], share) for share in (0.0, 0.01, 1.0))
    assert none.stars == little.stars == white.stars > 100
    assert none.median_mag < 0.01 and none.p95_mag < 0.05 and none.lost == 0.0
    assert little.median_mag < 0.02 and little.p95_mag < 0.1
    assert (white.median_mag, white.p95_mag, white.lost) == (99.0, 99.0, 1.0)
    assert (little.quantisation, little.share_of_white) == ("exact", 0.01)


def test_a_small_study_of_faults_draws_its_rows(small_run):
    cases = {case: CASES[case] for case in (NOWHERE, "false star, on the sky", "blank")}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (
            ("CASES", cases),
            ("QUICK_ROUNDS", 1),
            ("QUICK_SHARES", (0.0, 0.02, 1.0)),
        ):
            patch.setattr(faults, name, value)
        # as its command runs it
        run = small_run(lambda folder: study_lines("faults", folder, quick=True))
    costs, strays = run.rows("faults-cost"), run.rows("faults-stray")
    assert [(row["quantisation"], row["case"]) for row in costs] == [
        (name, case) for name in QUANTISATIONS for case in cases
    ]
    for row in costs:
        frame_ms, without_ms = float(row["frame_ms"]), float(row["without_ms"])
        assert float(row["cost_ms"]) == pytest.approx(frame_ms - without_ms)
    lines = run.lines("faults", 0)
    for name in QUANTISATIONS:
        own = [
            row for row in strays if row["quantisation"] == name and row["share_of_white"] != "0.0"
        ]
        for column in ("p95_mag", "median_mag"):
            # what shows nothing has no point
            wanted = [float(row[column]) for row in own if float(row[column]) < 99]
            drawn = [np.array(y)[np.isfinite(y)].tolist() for _, x, y in lines if len(x) == 2]
            assert any(
                np.isclose(y[: len(wanted)], wanted).all() for y in drawn if len(y) >= len(wanted)
            )
        spoilt = min(float(row["share_of_white"]) for row in own if float(row["p95_mag"]) > 0.1)
        assert f"from {spoilt:g} of white on with {name}" in run.title("faults")
    assert run.levels("faults", 0) == {"0.1 mag": 0.1}
    for panel, name in enumerate(QUANTISATIONS):
        own = [row for row in costs if row["quantisation"] == name]
        drawn = {label: x for label, x, _ in run.lines("faults_cost", panel)}
        np.testing.assert_allclose(drawn["without"], [float(row["without_ms"]) for row in own])
        np.testing.assert_allclose(drawn["with the fault"], [float(row["frame_ms"]) for row in own])
    first = run.charts["faults_cost"].axes[0]
    assert [text.get_text() for text in first.get_yticklabels()] == list(cases)
    assert len(run.told[0]) == 4


def test_even_light_of_white_leaves_no_star_and_none_leaves_all_of_a_small_bench(bench_with):
    bench = bench_with("[sky]\nfaintest_v_mag = 6.0\n")
    clear = faults.stray_light(bench, 0.0)
    assert (clear.quantisation, clear.share_of_white) == (bench.config.render.quantisation, 0.0)
    assert clear.stars > 3 and clear.lost < 0.5
    white = faults.stray_light(bench, 1.0)
    assert (white.stars, white.lost) == (clear.stars, 1.0)
    some = faults.stray_light(bench, 0.2)
    assert clear.median_mag <= some.median_mag < white.median_mag
    assert clear.p95_mag <= some.p95_mag


def test_a_case_s_faults_go_by_the_frame_s_time(panel, monkeypatch):
    """Of a star that moves by 60 px a second, and the schedule that is asked."""
    bench, folder = panel
    frames = faults.CaseFrames(bench, folder, "false star, moving")
    asked_ns = []
    monkeypatch.setattr(frames.schedule, "at", asked_ns.append)
    layers = []
    layer = faults.FaultLayer

    def kept(view, now):
        layers.append([each.since_ns for each in now])
        return layer(view, now)

    monkeypatch.setattr(faults, "FaultLayer", kept)
    for frame in (0, 90):
        frames.with_faults(frame)
    begin_ns, later_ns = 0, round(90 / faults.REFRESH_HZ * 1e9)
    assert asked_ns == [begin_ns, later_ns] and layers == [[begin_ns], [later_ns]]


def test_a_study_of_faults_is_told_by_its_dearest_and_its_slowest():
    def cost(case, frame_ms, without_ms, quantisation="round"):
        return faults.FaultCost(quantisation, case, frame_ms, without_ms, frame_ms - without_ms)

    costs = [
        cost(NOWHERE, 5.25, 5.0),
        cost("false star, on the sky", 5.5, 5.0),
        cost("64 false stars", 7.0, 5.0),
        cost("measured map", 14.0, 5.0),
        cost("blank", 2.0, 5.0),
        cost("blank", 99.0, 1.0, "exact"),
    ]
    assert faults.cost_line(costs, "round") == (
        "round: of a frame of 5.0 ms a scenario with nothing on takes +0.25 ms, a false star"
        " +0.50 ms; the dearest, measured map, +9.0 ms"
    )
    strays = [Stray("round", 0.03, 30, 0.0, 0.2, 0.0), Stray("exact", 0.03, 30, 0.0, 0.1, 0.0)]
    assert faults.stray_line(strays, "round").endswith("from stray light of 0.03 of white on")
    assert faults.stray_line(strays, "exact").endswith("from no stray light here on")


def test_the_charts_of_faults_say_their_slowest_frames(small_run):
    cases = [(NOWHERE, 5.0), ("false star, on the sky", 6.0), ("64 false stars", 7.0)]
    costs = []
    for quantisation in QUANTISATIONS:
        for case, frame_ms in (*cases, ("measured map", 14.0)):
            costs.append(faults.FaultCost(quantisation, case, frame_ms, 4.0, frame_ms - 4.0))
    run = small_run(lambda folder: faults.draw_costs(folder / "c", costs, Load()))
    assert run.title("c") == (
        "With false stars a frame takes at most 7.0 ms, with the dearest fault, measured map, 14 ms"
    )


def test_a_star_is_lost_that_is_a_magnitude_too_faint():
    stray = faults.stray_of("round", 0.0, [0.9, 1.1, 0.2, 0.6])
    assert (stray.lost, stray.median_mag, stray.stars) == (0.25, pytest.approx(0.75), 4)
