"""The whole chain: its table's fronts, its errors against what they must be, its budgets, and
what the command refuses.
"""

from __future__ import annotations

import json
import math
import os
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest

from hilstar.basics import charts
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import ARCSEC_PER_RAD, MAG_PER_RELATIVE, NS_PER_S
from hilstar.display.quantise import shown_light
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.instruments.study import predictors
from hilstar.instruments.study.chain import answers, choices, measuring, run
from hilstar.instruments.study.chain import glass as chain_glass
from hilstar.instruments.study.chain import tracker as chain_tracker
from hilstar.instruments.study.chain.choices import (
    ChainCombination,
    ChainScene,
    Parts,
    five_scenes,
    lead_ns,
)
from hilstar.instruments.study.chain.glass import draw_glass, glass_rows
from hilstar.instruments.study.chain.measuring import Rounds, SceneMeasurement, error_budget
from hilstar.instruments.study.chain.run import NOT_JUDGED, front
from hilstar.instruments.study.chain.tracker import MATCH_PX, StudyTracker, off
from hilstar.optics.glass.psf_file import glass_of, write_glass
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.cameras import tracker_psf
from hilstar.tracker.centroiders import star_places
from tests.support.benches import ORION_Q
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.figures import assert_legible
from tests.support.glass import stack
from tests.support.pictures import assert_drawn
from tests.support.tables import csv_rows

SMALL = """
[tracker]
aperture_mm = 30
focal_length_mm = 70
pixel_pitch_um = 13
quantum_efficiency = "ccd47-20"
resolution_px = [320, 320]
[sky]
faintest_v_mag = 9
[monitor]
resolution_px = [400, 360]
pixel_pitch_um = 57.65
[collimator]
focal_length_mm = 350
[render]
brightest_v_mag = 4
tolerance_mag = 0.01  # sprites of 8 px: what edges of 6 cut, `exact` makes up for in part, and steps do not add up
tolerance_px = 0.05
"""
PLAN = Rounds(exposures=1, time_s=0.05)
# The centroider's own error for stars of sigma 1.05 px is 0.0012 px in the median (0.05 arcsec); a
# display's is ten times that.
FLOOR_PX = 0.005
# A long path's middle is its mean to the second order of the field: 1 deg/s over 0.1 s in a field
# of 3 degrees.
PATH_FLOOR_PX = 0.01
# Of an error by a late attitude, whatever the codes do: they add 1 arcsec rms to 140.
LATE_SHARE = 0.02
# Root sum square and whole differ by what the steps have in common.
RSS_SHARE = 0.25
ROUNDED = 1e-3  # four digits in the table


def small_file(folder: Path, text: str = SMALL):
    """The small bench's file."""
    return bench_file_of(folder / "bench.toml", text)


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    with Parts(small_file(tmp_path_factory.mktemp("parts"))) as found:
        tracker = StudyTracker(found.own)
        yield found, tracker
        tracker.close()


def scene_of(parts, number: int) -> SceneMeasurement:
    """One of the small bench's choices."""
    benches, tracker = parts
    return SceneMeasurement(benches, tracker, five_scenes(benches.own)[number], PLAN)


WHOLE = ("dense field", "10 deg/s")  # of the command's scenes; the others are the small chain's


@pytest.fixture(scope="module")
def chain_study(tmp_path_factory, whole_study):
    """What the command prints of the small bench, and the folder of its files."""

    def some(own):
        return [scene for scene in five_scenes(own) if scene.name in WHOLE]

    folder = tmp_path_factory.mktemp("chain")
    (folder / "bench.toml").write_text(SMALL)
    # two frames of each combination: no claim here is of a time
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measuring, "MIN_ROUNDS", 2)
        patch.setattr(measuring, "FRAMES_A_VISIT", 1)
        patch.setattr(run, "QUICK", Rounds(exposures=1, time_s=0.0))
        patch.setattr(run, "five_scenes", some)
        # the small chain has all of them, each on benches of its own
        patch.setattr(choices, "QUANTISATIONS", ("exact",))
        result = run_hilstar_here(
            "study", "chain", folder / "bench.toml", "-o", folder / "out", "--quick", "--json"
        )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout), folder / "out"


@pytest.fixture(scope="module")
def small_chain(long_run, tmp_path_factory):
    """The study of the small bench's average field and slow turn, one round of each combination."""
    file = small_file(tmp_path_factory.mktemp("bench"))

    def two(own):
        scenes = five_scenes(own)
        assert {scene.name for scene in scenes} == {
            "average field",
            "faint field",
            "1 deg/s",
            *WHOLE,
        }
        average, _, _, slow, _ = scenes
        return average, slow

    in_glass = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measuring, "MIN_ROUNDS", 1)
        patch.setattr(measuring, "FRAMES_A_VISIT", 1)
        patch.setattr(run, "Rounds", partial(Rounds, exposures=1, time_s=0.0))
        patch.setattr(run, "QUICK", None)  # which a whole study does not ask for
        patch.setattr(run, "five_scenes", two)
        patch.setattr(run, "glass_rows", lambda *asked: in_glass.append(asked) or [])
        done = []
        found = long_run(lambda folder: run.run(file, folder, False, done.append))
    assert done == [1, 2]
    # the second scene is the densest field
    ((_, scene, quick),) = in_glass
    assert (scene.name, quick) == ("1 deg/s", False)
    return found


def test_the_front_is_what_anyone_finds_in_the_table(small_chain):
    rows = small_chain.rows("chain")
    for scene in {row["scene"] for row in rows}:
        own = [row for row in rows if row["scene"] == scene]
        for error, column in (("error_arcsec", "on_front"), ("error_mag", "on_front_mag")):
            spots = [(float(row["time_ms"]), float(row[error])) for row in own]
            for spot, row in zip(spots, own, strict=True):
                beaten = any(
                    other != spot and other[0] <= spot[0] and other[1] <= spot[1] for other in spots
                )
                assert row[column] == ("false" if beaten else "true")
        assert 1 <= sum(row["on_front"] == "true" for row in own) < len(own)


def test_auto_and_default_are_each_one_point_of_each_scene(chain_study):
    told, out = chain_study
    rows = csv_rows(out / "chain.csv")
    names = list(dict.fromkeys(row["scene"] for row in rows))
    assert names == list(WHOLE)
    for name in names:
        for mark in ("auto", "default"):
            (row,) = [row for row in rows if row["scene"] == name and row["chosen"] == mark]
            assert row["sprite"] == ("cut" if mark == "auto" else "full")
            assert float(row["noise_ms"]) >= 0 and float(row["time_ms"]) > 0
        (line,) = (line for line in told["findings"] if line.startswith(f"{name}: auto"))
        assert "on the front" in line or NOT_JUDGED in line
    for name in ("chain", "chain_budget"):
        assert_drawn(out / f"{name}.png")


ORION = ChainScene("Orion", "", np.array(ORION_Q))
WHOLE_PX = 1e-3  # of the whole glass, star by star


@pytest.fixture(scope="module")
def glass_file(tmp_path_factory):
    """The small bench behind a glass, by its brighter stars."""
    folder = tmp_path_factory.mktemp("glass")
    write_glass(folder / "psf.fits", glass_of(stack(3)))
    tracker = "[tracker]\nfocal_length_mm = 12\nresolution_px = [256, 256]"
    text = re.sub(r"focal_length_mm = 70\n|resolution_px = \[320, 320\]\n", "", SMALL)
    text = text.replace("[tracker]", tracker, 1).replace("= 9", "= 6")
    text = text.replace("[sky]", '[tracker.optics]\npsf = "psf.fits"\n[sky]')
    return small_file(folder, text)


def test_a_glass_s_stars_are_held_against_its_whole_basis_where_they_stand(glass_file):
    tracker = glass_file.config.tracker
    whole = tracker_psf(msgspec.structs.replace(tracker, effort="full"), glass_file.folder)
    with Simulator(glass_file, psf=whole) as simulator:
        error = chain_glass.errors_in(simulator, whole, {"whole": whole}, ORION)["whole"]
    assert error.stars > 10 and error.error_percent < 0.02
    assert error.error_arcsec < WHOLE_PX * 13e-3 / 12 * ARCSEC_PER_RAD


def test_the_psf_of_a_glass_is_an_axis_of_the_chain(glass_file, monkeypatch, tmp_path):
    """Each PSF that may stand for it, the more components the nearer."""
    monkeypatch.setattr(chain_glass, "QUICK_TIME_S", 0.1)
    rows = glass_rows(glass_file, ORION, quick=True)
    names = [
        "a Gaussian",
        "one PSF for all stars",
        "Gaussians by field",
        "a basis of 3",
        "a basis of 6",
        "a basis of 12",
    ]
    assert [row.psf for row in rows] == [*names, "each star by its place and spectrum"]
    gaussian, *_, third, sixth, twelfth, whole = rows
    assert (
        gaussian.error_arcsec
        > third.error_arcsec
        > sixth.error_arcsec
        > twelfth.error_arcsec
        > whole.error_arcsec
        > 0
    )
    assert (
        whole.error_arcsec < WHOLE_PX * 13e-3 / 12 * ARCSEC_PER_RAD
        and whole.error_percent < 0.02 < gaussian.error_percent
    )
    assert (
        [row.chosen for row in rows].count("auto") == 1
        and gaussian.stars > 10
        and all(row.time_ms > 0 for row in rows)
    )
    assert [row.on_front == "true" for row in rows] == front(rows, "error_arcsec")
    with charts.panels_of("A finding", 2, share_x=False) as (place, light):
        draw_glass(place, light, rows)
    assert_legible(place.figure)
    bare = small_file(tmp_path)
    assert glass_rows(bare, ORION, quick=True) == []


def test_the_budget_adds_up_to_the_whole_error_of_auto(small_chain):
    rows, parts = small_chain.rows("chain"), small_chain.rows("chain_budget")
    for scene in {part["scene"] for part in parts}:
        (auto,) = [row for row in rows if row["scene"] == scene and row["chosen"] == "auto"]
        for error in ("error_arcsec", "error_mag"):
            by_step = {part["step"]: float(part[error]) for part in parts if part["scene"] == scene}
            whole, rss = by_step.pop("whole"), by_step.pop("rss")
            assert whole == pytest.approx(float(auto[error]), rel=ROUNDED)
            assert rss == pytest.approx(
                math.sqrt(sum(value**2 for value in by_step.values())), rel=ROUNDED
            )
            assert rss == pytest.approx(whole, rel=RSS_SHARE)
        assert by_step["codes"] > 0
    turning = {
        part["step"]: float(part["error_arcsec"]) for part in parts if part["scene"] == "1 deg/s"
    }
    assert turning["prediction"] > 0 and turning["refresh"] > 0
    stages = small_chain.rows("chain_time")
    assert {stage["stage"] for stage in stages} == {
        "prediction",
        "sprites",
        "drawing and codes",
        "read-back",
    }


def test_the_sky_itself_is_measured_where_the_stars_are(parts, monkeypatch):
    monkeypatch.setattr(predictors, "JITTER", ())
    for number, limit_px in ((1, FLOOR_PX), (3, PATH_FLOOR_PX)):
        (judge,) = scene_of(parts, number).judges
        true = judge.true[judge.judged]
        off_px = (
            np.linalg.norm(judge.sky.directions - true, axis=1)
            * ARCSEC_PER_RAD
            / parts[1].arcsec_per_px
        )
        assert len(judge) > 10
        assert np.median(off_px) < limit_px


def test_a_held_attitude_is_late_by_its_age_its_row_and_half_a_frame(parts, monkeypatch):
    monkeypatch.setattr(predictors, "JITTER", ())
    scene, bench = scene_of(parts, 3), parts[0].own
    (judge,) = scene.judges
    sample_ns, lead = NS_PER_S // judge.movement.packet_hz, lead_ns(bench.config)
    ages_ns = [light - (light - lead) // sample_ns * sample_ns for light in judge.seen.light_ns]
    age_s = np.average(ages_ns, weights=judge.seen.weights.mean(axis=(1, 2))) / NS_PER_S
    true = judge.true[judge.judged]
    row_s = bench.scan.late_s(
        *bench.camera.project(true @ bench.camera.cam_to_image.T), bench.camera.resolution_px
    )
    late_s = age_s + row_s + bench.scan.hold_s / 2
    expected = np.sqrt(
        np.mean((3600 * late_s * np.linalg.norm(np.cross(true, predictors.AXIS), axis=1)) ** 2)
    )
    held = ChainCombination("exact", False, parts[0].faintest_v_mag, "full", "point", "held")
    assert scene.error(held).error_arcsec == pytest.approx(expected, rel=LATE_SHARE)


def test_a_star_that_runs_with_the_scan_loses_no_light(parts, monkeypatch):
    monkeypatch.setattr(predictors, "JITTER", ())
    scene, bench = scene_of(parts, 4), parts[0].own
    (judge,) = scene.judges
    moved_px = math.radians(10.0) * predictors.AXIS[0] * bench.camera.focal_length_px
    share = moved_px * bench.scan.scanout_s / bench.camera.resolution_px[1]
    # A star of equal light in each frame would be too faint by that share; what is left is its part
    # of the ends' frames.
    ends = share * bench.scan.hold_s / judge.seen.length_s
    assert len(judge) > 2 and ends < share / 5
    assert error_budget(scene, scene.marks.auto)[0].error_mag < MAG_PER_RELATIVE * ends


def test_a_star_that_is_lost_is_no_nearer_than_one_that_is_found_late(parts):
    scene, bench = scene_of(parts, 4), parts[0]
    (judge,) = scene.judges
    held = ChainCombination("exact", False, bench.faintest_v_mag, "full", "point", "held")
    image_e = scene.tracker.image_e(scene.chain(held).exposed(judge.seen), judge.seen)
    late = off(judge.measure(image_e), judge.sky, judge.lost_arcsec)
    dark = off(judge.measure(np.zeros_like(image_e)), judge.sky, judge.lost_arcsec)
    assert dark.lost.all() and not late.lost.all()
    assert (
        dark.arcsec.min() > late.arcsec[~late.lost].max() > MATCH_PX * scene.tracker.arcsec_per_px
    )


def test_a_long_exposure_is_said_to_be_measured_in_part(small_chain, tmp_path):
    with Parts(
        small_file(tmp_path, SMALL.replace("aperture_mm", "exposure_s = 3.5\naperture_mm"))
    ) as long:
        said = choices.shortened_line(long.own)
        seen = choices.exposure(long.own, 20)
    assert said == "exposures of 16 refreshes, 0.267 s, in the place of [tracker] exposure_s = 3.5"
    assert seen.length_s == pytest.approx(16 / 60)
    assert not any("in the place of" in line for line in small_chain.told.lines)
    assert {row["exposure_s"] for row in small_chain.rows("chain")} == {"0.1"}


def test_what_cannot_be_studied_is_refused_in_one_line(tmp_path):
    (tmp_path / "dark.toml").write_text(SMALL.replace("aperture_mm", "exposure_s = 0\naperture_mm"))
    (tmp_path / "bare.toml").write_text("[tracker]\naperture_mm = 30\n")
    out = tmp_path / "out"
    assert_refused(
        run_hilstar_here("study", "chain", tmp_path / "dark.toml", "-o", out), 2, "exposure_s = 0"
    )
    assert_refused(
        run_hilstar_here("study", "chain", tmp_path / "bare.toml", "-o", out), 2, "bare.toml"
    )
    assert_refused(run_hilstar_here("study", "chain", "-o", out), 2, "BENCH.toml")
    assert_refused(
        run_hilstar_here("study", "timing", tmp_path / "dark.toml", "-o", out), 2, "dark.toml"
    )
    (tmp_path / "chain.csv").write_text(SMALL)
    assert_refused(
        run_hilstar_here("study", "chain", tmp_path / "chain.csv", "-o", tmp_path), 2, "chain.csv"
    )


def test_a_directory_without_the_right_to_write_is_refused_before_the_study(tmp_path, monkeypatch):
    (tmp_path / "bench.toml").write_text(SMALL)
    # root may write anywhere
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK | os.X_OK)
    monkeypatch.setattr(run, "run", lambda *given: pytest.fail("the study has begun"))
    refused = run_hilstar_here("study", "chain", tmp_path / "bench.toml", "-o", tmp_path / "out")
    assert_refused(refused, 2, "out: cannot be written (Permission denied)")


def test_a_bench_of_which_no_star_stays_in_view_is_refused(tmp_path):
    (tmp_path / "bench.toml").write_text(SMALL.replace("[320, 320]", "[12, 12]"))
    refused = run_hilstar_here(
        "study", "chain", tmp_path / "bench.toml", "-o", tmp_path / "out", "--quick"
    )
    assert_refused(refused, 2, "no star stands alone in view")


def test_the_study_ends_with_answers_from_its_own_rows(small_chain):
    rows, parts = small_chain.rows("chain"), small_chain.rows("chain_budget")
    lines = small_chain.told.answers
    assert len(lines) >= 4
    still = [row for row in rows if row["scene"] == "average field" and row["sprite"] == "cut"]
    by_codes = {
        (row["quantisation"], row["bit_stealing"]): row
        for row in still
        if float(row["faintest_v_mag"]) == 9
    }
    exact, stealing = (
        charts.two_digits(float(by_codes["exact", flag]["error_arcsec"]))
        for flag in ("false", "true")
    )
    assert lines[0].startswith(f'at rest on 8 bits: set quantisation = "exact", {exact} arcsec')
    assert f"takes {exact} arcsec to {stealing}" in lines[1]
    of_turn = {
        part["step"]: float(part["error_arcsec"]) for part in parts if part["scene"] == "1 deg/s"
    }
    whole = charts.two_digits(of_turn.pop("whole"))
    del of_turn["rss"]
    largest = max(of_turn, key=of_turn.get)
    words = answers.STEP_WORDS.get(largest, largest)
    assert lines[2].startswith(
        f"from 1 deg/s on {words} is the largest part ({charts.two_digits(of_turn[largest])}"
    )
    assert f"of {whole} arcsec)" in lines[2]
    assert lines[-1].startswith("depth: ")


def number_of(row, name):
    return float(row[name])


def test_a_scene_is_told_and_drawn_by_its_own_rows(small_chain):
    """Its line by the row of auto, its panel by all rows, its bars by the parts of auto's error."""
    rows, parts = small_chain.rows("chain"), small_chain.rows("chain_budget")
    stages = small_chain.rows("chain_time")
    lines = small_chain.told.lines
    for panel, scene in enumerate(("average field", "1 deg/s")):
        own = [row for row in rows if row["scene"] == scene]
        (auto,) = (row for row in own if "auto" in row["chosen"].split())
        assert {row["stars"] for row in own} == {auto["stars"]} and int(auto["stars"]) > 10
        error, mag = number_of(auto, "error_arcsec"), number_of(auto, "error_mag")
        steps = {part["step"]: part for part in parts if part["scene"] == scene}
        largest = max(
            (part for step, part in steps.items() if step not in ("rss", "whole")),
            key=lambda part: number_of(part, "error_arcsec"),
        )
        times = {
            stage["stage"]: number_of(stage, "time_ms")
            for stage in stages
            if stage["scene"] == scene
        }
        longest = max(times, key=times.get)
        line = lines[panel]
        assert line.startswith(f"{scene}: auto (exact, cut sprites")
        assert (
            f") is {error:.3g} arcsec and {mag:.2g} mag off over {auto['stars']} stars, in" in line
        )
        assert f"error: {largest['step']} {number_of(largest, 'error_arcsec'):.2g} arcsec" in line
        assert line.endswith(f"time: {longest} {times[longest] / sum(times.values()):.0%}")
        assert ("paths, rate" in line) == (scene == "1 deg/s")
        # every combination stands at its time and error
        places = set()
        for _, x, y in small_chain.lines("chain", panel):
            places.update(zip(x, y, strict=True))
        for row in own:
            assert (number_of(row, "time_ms"), number_of(row, "error_arcsec")) in places
        for column, name in enumerate(("error_arcsec", "error_mag")):
            axes = small_chain.charts["chain_budget"].axes[3 * panel + column]
            widths = [bar.get_width() for bar in axes.patches]
            shown = [number_of(part, name) for step, part in steps.items() if step != "rss"]
            assert set(widths) <= set(shown) and steps["whole"] and max(shown) in widths
        axes = small_chain.charts["chain_budget"].axes[3 * panel + 2]
        assert [bar.get_width() for bar in axes.patches] == list(times.values())
    assert small_chain.told.right in (True, False)
    assert lines[2].startswith("times on ")


def test_every_star_of_a_turning_field_has_the_turn_s_own_time(small_chain):
    """Columns that are the bench's and the scene's, and those that a choice alone can change."""
    rows = small_chain.rows("chain")
    assert {row["quantisation"] for row in rows} == set(choices.QUANTISATIONS)
    turning = {row["prediction"] for row in rows if row["scene"] == "1 deg/s"}
    assert turning == set(choices.PREDICTIONS)
    assert {row["bit_stealing"] for row in rows} == {"true", "false"}
    for row in rows:
        rate = 1.0 if row["scene"] == "1 deg/s" else 0.0
        assert number_of(row, "rate_deg_s") == rate and row["bits"] == "8"
        assert number_of(row, "exposure_s") == 0.1
        assert (row["frames"], row["noise_ms"]) == ("1", "0.0")
        sides = [int(side) for side in row["sprite_px"].split(" to ")]
        assert sides == sorted(sides)
        if row["sprite"] == "full":
            assert len(sides) == 1
        else:
            assert sides[-1] <= 10
        held = row["prediction"] == "held"
        assert not held or rate
        if held and row["faintest_v_mag"] == "9.0":
            # 1 deg/s for 15 ms and more of age and scan-out
            assert number_of(row, "error_arcsec") > 50
            # a pointing error across the boresight, of the turn's axis off it
            assert number_of(row, "attitude_arcsec") == pytest.approx(140, rel=0.2)
        elif not held and row["smear"] == "point" and rate:
            # half a frame at 1 deg/s
            assert number_of(row, "attitude_arcsec") == pytest.approx(30, rel=0.2)
        elif not held:
            assert number_of(row, "attitude_arcsec") < 5
    for scene in ("average field", "1 deg/s"):
        filed = [row for row in rows if row["scene"] == scene and row["as_filed"] == "true"]
        assert len(filed) == 1


def test_a_frame_s_light_is_that_of_its_codes_on_its_own_pixels(tmp_path):
    """Of a panel whose pixels differ, too."""
    text = SMALL.replace("[monitor]", '[monitor]\ncalibration = "lcd-example"')
    with Parts(small_file(tmp_path, text)) as uneven:
        combination = ChainCombination("exact", False, uneven.faintest_v_mag, "full")
        movement = predictors.Movement(five_scenes(uneven.own)[0].q_icrs_to_cam, 0.0)
        chain = measuring.DrawingChain(combination, uneven.bench(combination), movement)
        panel = chain.bench.panel
        assert panel.uniformity is not None and np.ptp(panel.uniformity) > 0.01
        light_ns = NS_PER_S
        place, light = chain.lit(7, light_ns)
        attitude = chain.attitude(light_ns)
        levels = chain.bench.draw(attitude.q_icrs_to_cam, 7).levels
        wanted = shown_light(levels, panel).ravel()
        assert len(place) > 100
        np.testing.assert_allclose(light, wanted[place], rtol=1e-6)
        assert wanted.sum() == pytest.approx(light.sum(), rel=1e-6)


def test_each_chain_is_timed_in_each_round_and_one_by_its_stages():
    """After a frame that does not count; the rounds end with the time, but not before two."""

    class Chain:
        last = None

        def __init__(self, ms):
            self.ms, self.staged = ms, 0

        def frame_ms(self):
            # the first after another chain's fills caches
            is_first, Chain.last = Chain.last is not self, self
            return (1e9 if is_first else self.ms), 2 * self.ms

        def stages_ms(self):
            self.staged += 1
            return (self.ms, 2.0, 3.0, 1e9 if self.staged == 1 else 4.0)

    chains = [Chain(1.0), Chain(5.0), Chain(9.0)]
    times, stages = measuring.timed(chains, 0.0, 1)
    assert stages == [5.0, 2.0, 3.0, 4.0]
    visits = measuring.MIN_ROUNDS * measuring.FRAMES_A_VISIT
    for chain, taken in zip(chains, times, strict=True):
        assert (taken.time_ms, taken.cpu_ms, taken.frames) == (chain.ms, 2 * chain.ms, visits)


def test_a_psf_that_is_a_pixel_off_and_three_percent_too_bright_is_told_so(monkeypatch):
    """Against the true one, here a Gaussian of 1.2 px, by the tracker's own centroider."""
    sigma_px, at = 1.2, np.arange(15) - 7
    x_px, y_px = np.array([0.0, 0.3, -0.4, 0.2, 0.1]), np.array([0.0, -0.2, 0.4, 0.1, 0.3])
    across = np.exp(-((at - x_px[:, None]) ** 2) / (2 * sigma_px**2))
    down = np.exp(-((at - y_px[:, None]) ** 2) / (2 * sigma_px**2))
    light = down[:, :, None] * across[:, None, :] / (2 * math.pi * sigma_px**2)
    light[0] = 0.0  # a star in a dark corner is not judged
    stamps = {
        "whole": light,
        "right": 1.03 * np.roll(light, 1, axis=2),
        "down": 0.98 * np.roll(light, 2, axis=1),
    }
    find = partial(star_places, kind="window", sigma_px=(sigma_px, sigma_px))
    errors = chain_glass.stamp_errors(light, stamps, find, 38.0)
    for name, off_px, percent in (("whole", 0, 0), ("right", 1, 3), ("down", 2, 2)):
        error = errors[name]
        assert error.stars == 4
        # a window's edge sees a rolled star's wings otherwise
        assert error.error_arcsec == pytest.approx(off_px * 38.0, rel=0.02, abs=1e-6)
        assert error.error_percent == pytest.approx(percent, rel=1e-3, abs=1e-6)
        assert error.worst_percent == pytest.approx(percent, rel=1e-3, abs=1e-6)
    monkeypatch.setattr(chain_glass, "MIN_STARS", 5)
    assert chain_glass.stamp_errors(light, stamps, find, 38.0) == {}


def test_exposures_begin_at_their_own_frames(parts):
    scene = SceneMeasurement(*parts, five_scenes(parts[0].own)[0], Rounds())
    begins_s = [judge.seen.begin_s for judge in scene.judges]
    assert begins_s == pytest.approx([number / 60 + 0.0037 for number in (20, 151, 325)])
    assert scene.star_count == sum(map(len, scene.judges)) > len(scene.judges[0])


def test_errors_without_times_are_those_of_every_choice(parts):
    scene = scene_of(parts, 0)
    chosen = [scene.marks.auto, scene.marks.default]
    scene.combinations = list(dict.fromkeys(chosen))
    rows = scene.untimed()
    assert len(rows) == len(scene.combinations)
    for row, combination in zip(rows, scene.combinations, strict=True):
        assert math.isnan(row.time_ms) and row.frames == 0
        assert row.error_arcsec == scene.error(combination).error_arcsec
        assert row.sprite == combination.sprite


def test_sprites_are_whole_cut_within_the_bench_s_tolerance_or_within_ten_times_that(parts):
    keys = {}
    for sprite in choices.SPRITES:
        chosen = ChainCombination("round", False, parts[0].faintest_v_mag, sprite)
        render = parts[0].bench(chosen).config.render
        keys[sprite] = (render.effort, render.tolerance_mag, render.tolerance_px)
    depth = parts[0].faintest_v_mag - 1
    for method in ("round", "exact"):
        shallow = parts[0].bench(ChainCombination(method, False, depth, "cut"))
        assert shallow.config.render.quantisation == method
        assert shallow.shown_stars.v_mag.max() <= depth
    assert keys["full"][0] == "full"
    assert keys["cut"] == ("auto", 0.01, 0.05)
    assert keys["coarse"] == ("auto", pytest.approx(0.1), pytest.approx(0.5))


@pytest.mark.parametrize(
    ("keys", "prediction", "default"),
    [
        ("[attitude]\nmax_extrapolation_ms = 0\n", "held", "path"),
        ('motion = "off"\n', "rate", "point"),
    ],
)
def test_a_bench_that_predicts_or_moves_nothing_draws_points(tmp_path, keys, prediction, default):
    """In a turn; hilstar's default predicts. A catalogue ends with its faintest star."""
    text = SMALL.replace("= 9\n", "= 6.007\n") + keys
    with Parts(small_file(tmp_path, text)) as held:
        assert held.faintest_v_mag == held.own.stars.v_mag.max().round(2) <= 6.0
        turning = held.marks(predictors.Movement(np.array(ORION_Q), 1.0))
        still = held.marks(predictors.Movement(np.array(ORION_Q), 0.0))
    ways = {(mark.prediction, mark.smear) for mark in (turning.auto, turning.as_filed)}
    assert ways == {(prediction, "point")}
    assert (turning.default.prediction, turning.default.smear) == ("rate", default)
    assert {still.auto.prediction, still.as_filed.prediction} == {"rate"}
    assert (turning.auto.sprite, turning.default.sprite) == ("cut", "full")


def test_a_star_on_a_path_is_found_with_a_tenth_of_its_light(parts):
    scene = scene_of(parts, 4)
    (judge,) = scene.judges
    tracker = scene.tracker
    seen_e = tracker.image_e(
        chain_tracker.sky_light(tracker.bench, judge.movement, judge.seen), judge.seen
    )
    assert not judge.measure(0.12 * seen_e).lost.any()
    assert judge.measure(0.08 * seen_e).lost.all()
    # its path over the exposure and the largest delay before and after it
    late_s = lead_ns(tracker.bench.config) / NS_PER_S + 1 / judge.movement.packet_hz
    path_arcsec = 10.0 * 3600 * (judge.seen.length_s + 2 * late_s)
    assert judge.lost_arcsec == pytest.approx(path_arcsec, rel=1e-6)


def test_no_star_is_judged_that_clips_or_shows_less_than_half_a_step_or_is_in_a_crowd(parts):
    """Alnilam (V = 1.7) is over white, and alone."""
    benches, tracker = parts
    scene = ChainScene("Alnilam", "", from_radec_roll_deg(84.05, -1.2, 0.0))
    movement = predictors.Movement(scene.q_icrs_to_cam, 0.0)
    judge = chain_tracker.StarJudge(tracker, movement, choices.exposure(benches.own, 20))
    white = benches.own.flux_at_white_e_per_s * benches.own.darkest
    rates = judge.sky.light_e / judge.seen.length_s
    peaks = rates * benches.own.psf.peak_share / white
    first_step = benches.own.calibration.response.light[1]
    assert len(judge) > 10 and peaks.max() < 1.05
    assert (rates / white).min() > 0.9 * first_step / 2
    # nor one that has another of a tenth of its light within its window of 5 px to each side
    x_px, y_px = tracker.camera.project(judge.true @ tracker.camera.cam_to_image.T)
    apart_px = np.maximum(np.abs(x_px[:, None] - x_px), np.abs(y_px[:, None] - y_px))
    is_near = (apart_px < tracker.finder.settings.radius_px) & ~np.eye(len(x_px), dtype=bool)
    is_bright = judge._e > 0.1 * judge._e[:, None]
    has_neighbour = (is_near & is_bright).any(axis=1)
    assert has_neighbour.sum() >= 3 and not has_neighbour[judge.judged].any()


def test_points_that_are_drawn_for_paths_are_charged_to_smear_alone(parts, monkeypatch):
    monkeypatch.setattr(predictors, "JITTER", ())
    scene = scene_of(parts, 4)
    drawn_as_points = replace(scene.marks.auto, smear="point", sprite="coarse")
    budget = error_budget(scene, drawn_as_points)
    by_step = {part.step: part.error_arcsec for part in budget}
    # against the sky itself, the panel's refresh included
    assert by_step["whole"] == pytest.approx(scene.error(drawn_as_points).error_arcsec, rel=ROUNDED)
    assert by_step["refresh"] > 0.01 * by_step["whole"]
    # what coarse sprites cut is charged last, and not to the codes
    assert by_step["sprites"] > 0
    whole, rss = by_step.pop("whole"), by_step.pop("rss")
    assert rss == pytest.approx(math.hypot(*by_step.values()), rel=ROUNDED) and whole > 0
    assert by_step["smear"] > 100 and by_step["depth"] < 0.01 * by_step["smear"]
    assert by_step["codes"] < 0.1 * by_step["smear"]
