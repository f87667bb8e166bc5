"""What auto effort saves: each scene within its tolerance, at full effort and at what it needs."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from hilstar.instruments.study import economy
from hilstar.instruments.study.economy import BITS, SCENES, TOLERANCES
from hilstar.instruments.study.study_benches import LoneErrors, StarError
from hilstar.instruments.study.sweep import Spent
from hilstar.tracker.centroiders import FAMILY
from tests.support.recorded import assert_recorded
from tests.support.studies import times_are_watched

# One that is at rest and one that turns, on the shallowest panel and the deepest; a scene without
# many stars is the small one's below.
CASES = tuple(product((8, 12), (SCENES[2], SCENES[4])))


def measured(cases):
    """The study's figures of these scenes, in one round: no claim here is of a time."""
    with pytest.MonkeyPatch.context() as patch, times_are_watched():
        patch.setattr(economy, "QUICK_ROUNDS", 1)
        return economy.measure(True, cases)


@pytest.fixture(scope="module")
def economy_study(whole_study):
    found = whole_study.reported("economy", {"economy"}, measured(CASES))
    return found.folder, found.findings, found.rows("economy")


def test_the_page_s_errors_are_of_what_is_measured_now(economy_study):
    figures = ("flux_max_mag", "claimed_mag", "claimed_px", *(f"max_px_{kind}" for kind in FAMILY))
    keys = ("scene", "bits", "tolerance")
    assert_recorded(economy_study[0] / "economy.csv", keys, figures)


def test_a_scene_that_needs_less_gets_it_and_stays_within_its_tolerance(economy_study):
    full, *autos = [
        row for row in economy_study[2] if (row["scene"], row["bits"]) == (SCENES[2].name, "12")
    ]
    assert full["tolerance"] == "full" and full["quantisation"] == "exact"
    assert [row["tolerance"] for row in autos] == ["default", "0.1"]
    for row in autos:
        assert (
            row["quantisation"] == "round"
            and int(row["measured_stars"]) == int(full["measured_stars"]) > 100
        )
        places_px = [float(row[f"max_px_{kind}"]) for kind in FAMILY]
        assert float(row["max_px_fit"]) < float(row["max_px_moment"])
        assert max(float(row["centroid_max_px"]), *places_px) <= float(row["tolerance_px"])
        assert (
            float(full["flux_max_mag"]) < float(row["flux_max_mag"]) <= float(row["tolerance_mag"])
        )


def test_what_is_within_by_the_plan_is_within_by_its_stars(economy_study):
    claimed = [row for row in economy_study[2] if row["claimed_within"].lower() == "true"]
    assert len(claimed) > len(CASES)
    for row in claimed:
        assert float(row["flux_max_mag"]) <= float(row["tolerance_mag"])
        assert float(row["flux_max_mag"]) <= float(row["claimed_mag"])
        assert float(row["claimed_mag"]) <= float(row["tolerance_mag"])


def test_each_scene_of_each_depth_is_told_at_two_tolerances(economy_study):
    _, lines, rows = economy_study
    assert len(rows) == len(CASES) * (1 + len(TOLERANCES)) == 12
    assert len([line for line in lines if " bits, " in line and "instead of" in line]) == 8
    assert len(economy.CASES) == len(SCENES) * len(BITS) == 15 and set(CASES) < set(economy.CASES)


def test_a_small_scene_has_the_recorded_errors_and_its_chart(small_run):
    """At rest and at 8 bits."""
    scene = SCENES[0]
    run = small_run(lambda folder: economy.report(folder, measured([(8, scene)])))
    figures = ("stars", "flux_max_mag", "centroid_max_px", "claimed_mag", "claimed_px")
    figures += ("tolerance_mag", "tolerance_px", "measured_stars", "quantisation")
    figures += ("claimed_within", *(f"max_px_{kind}" for kind in FAMILY))
    assert_recorded(run.folder / "economy.csv", ("scene", "bits", "tolerance"), figures)
    rows = run.rows("economy")
    assert [row["scene"] for row in rows] == 3 * [scene.name]
    # bars of both tolerances: full over auto, and the error over its limit
    for panel, heights in enumerate(("speed", "error")):
        containers = run.charts["economy"].axes[panel].containers
        for tolerance, bars in zip(TOLERANCES, containers, strict=True):
            full, *autos = rows
            (auto,) = (row for row in autos if row["tolerance"] == tolerance.name)
            if heights == "speed":
                wanted = float(full["frame_ms"]) / float(auto["frame_ms"])
            else:
                worst_px = max(float(auto[f"max_px_{kind}"]) for kind in FAMILY)
                mag = float(auto["flux_max_mag"])
                wanted = max(mag / tolerance.mag, worst_px / tolerance.px)
            np.testing.assert_allclose([bar.get_height() for bar in bars], [wanted])
    tolerances = "default, 0.05 mag and 0.1 px; 0.1, 0.1 mag and 0.1 px."
    assert run.note("economy").endswith(f"Tolerances: {tolerances}")
    assert run.levels("economy", 0) == {"as fast as full effort": 1.0}
    assert run.levels("economy", 1) == {"tolerance": 1.0}
    lines = run.told[0]
    assert len(lines) == 2 + 1
    for line, row in zip(lines, rows[1:], strict=False):
        assert line.startswith(f"{row['scene']}, 8 bits, {float(row['tolerance_mag']):g} mag and")
        assert (
            f"errors of {row['measured_stars']} stars {float(row['flux_max_mag']):.4f} mag" in line
        )
        assert f"({float(row['max_px_fit']):.4f} by a PSF fit), within the tolerance" in line


def test_an_outcome_has_the_worst_star_of_either_sign_and_the_median_time(bench_with):
    stars = (StarError(-0.03, 0.2), StarError(0.01, 0.5), StarError(0.02, 0.1))
    off_px = {}
    for number, kind in enumerate(FAMILY):
        off_px[kind] = np.array([[3.0, 0.0, 1.0], [-4.0, 2.0, 1.0]]) * (number + 1) / 100
    errors = economy.FrameErrors(77, LoneErrors(stars, off_px))
    bench = bench_with('[render]\nquantisation = "exact"\n')
    times = [Spent(9.0, 2.0), Spent(1.0, 8.0), Spent(4.0, 3.0)]
    found = economy.outcome(SCENES[4], "0.1", bench, errors, times)
    assert (found.frame_ms, found.cpu_ms) == (4.0, 3.0)
    assert (found.flux_max_mag, found.centroid_max_px) == (0.03, 0.5)
    claimed = bench.effort
    assert found.claimed_mag == claimed.error_mag and found.claimed_px == claimed.error_px
    assert found.claimed_within == claimed.within and claimed.error_mag != claimed.error_px
    assert (found.stars, found.measured_stars, found.bits) == (77, 3, bench.config.monitor.bits)
    assert (found.scene, found.quantisation) == (SCENES[4].name, "exact")
    assert (found.tolerance, found.tolerance_mag, found.tolerance_px) == ("0.1", 0.1, 0.1)
    for number, kind in enumerate(FAMILY):
        assert getattr(found, f"max_px_{kind}") == pytest.approx(0.05 * (number + 1))
    assert found.worst_px == pytest.approx(0.05 * len(FAMILY))
    assert found.share == pytest.approx(0.5 * len(FAMILY)) and not found.within
    # full effort has the default's tolerance
    full = economy.outcome(SCENES[4], "full", bench, errors, times)
    assert full.tolerance_mag == economy.DEFAULT.mag


def test_a_scene_that_turns_is_drawn_along_its_paths_at_each_effort(bench_with):
    """And each bench has its scene's lens, stars and depth."""
    for scene, motion in ((SCENES[0], "auto"), (SCENES[4], "on")):
        tables_of = economy.bench_tables(scene, 12)
        assert list(tables_of) == ["full", "default", "0.1"]
        for name, tables in tables_of.items():
            assert tables["render"]["motion"] == motion
            assert tables["monitor"]["bits"] == 12
            assert tables["sky"] == {"faintest_v_mag": scene.faintest_v_mag}
            assert tables["collimator"] == {"focal_length_mm": scene.focal_length_mm}
            assert tables["render"]["quantisation"] == ("exact" if name == "full" else "auto")
            assert ("effort" in tables["render"]) == (name != "full")
        assert tables_of["0.1"]["render"]["tolerance_mag"] == 0.1
    bench, turn = bench_with('[render]\nmotion = "on"\nquantisation = "temporal"\n'), SCENES[4].turn
    drawn = [economy.frame_of(bench, turn, number).levels.copy() for number in range(2)]
    bench.renderer.begin_anew()
    for number, levels in enumerate(drawn):
        again = bench.draw(turn.q_icrs_to_cam, number, np.radians([0.6, 0.8, 0.0]))
        np.testing.assert_array_equal(levels, again.levels)
    assert (drawn[0] != drawn[1]).any()
    bench.renderer.begin_anew()
    assert (drawn[0] != bench.draw(turn.q_icrs_to_cam).levels).any()


def test_each_effort_is_timed_by_its_own_bench(bench_with):
    benches = {name: bench_with(f"[sky]\nfaintest_v_mag = {name}\n") for name in ("6", "4")}
    works = economy.frame_works(benches, SCENES[0].turn)
    for name, bench in benches.items():
        drawn = works[name](0)
        again = bench.draw(SCENES[0].turn.q_icrs_to_cam)
        np.testing.assert_array_equal(drawn.levels, again.levels)
    assert works["6"](0).star_count > works["4"](0).star_count


def test_bars_have_room_over_the_highest_and_over_a_limit_of_one():
    assert economy.bar_limits([0.2, 0.4]) == pytest.approx((0, 1.45))
    assert economy.bar_limits([0.2, 3.0]) == pytest.approx((0, 4.35))
