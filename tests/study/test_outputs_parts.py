"""The thesis's outputs and RAPP of a small bench of one's own, and what the study of effort says:
tables, words and places by closed forms, without a study.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.instruments.simulate.simulator import Exposure
from hilstar.instruments.study import economy, outputs, rapp
from hilstar.instruments.study.economy import EffortComparison, EffortOutcome
from hilstar.instruments.study.fields import FIELDS, fields_of
from hilstar.instruments.study.outputs import (
    OutputScene,
    _field_deg,
    _scene_words,
    _zoom,
    heat_words,
    thesis_total_e,
)
from hilstar.instruments.study.sweep import NOT_JUDGED, Load
from hilstar.optics.camera import Camera
from hilstar.optics.layers.truth import TRUTH_DTYPE
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.tracker.settings import DetectorSettings
from tests.support.benches import bench_text
from tests.support.tables import csv_rows

SIZE_PX = (120, 90)
FOCAL_PX = 20e3 / 13
OWN = (84.0, -1.0, 30.0)
BENCH = {
    "tracker": {
        "focal_length_mm": 20,
        "resolution_px": list(SIZE_PX),
        "exposure_s": 0.2,
        "transmission": None,
    },
    "tracker.detector": {"bits": 12, "gain_e_per_dn": 5.0, "offset_dn": 20.0, "read_noise_e": 8.0},
    "sky": {"faintest_v_mag": 5.5},
}


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    path = tmp_path_factory.mktemp("bench") / "bench.toml"
    path.write_text(bench_text(BENCH))
    return read_bench_file(path)


def test_rapp_of_a_bench_s_stars_is_of_those_on_its_image(bench, small_run):
    run = small_run(rapp.bench_rapp, bench, OWN)
    findings, folder = run.told, run.folder
    assert [finding.figure for finding in findings] == ["rapp_bench", *["rapp_stars"] * 4]
    table = np.genfromtxt(folder / "rapp_bench.csv", delimiter=",", names=True)
    at_3000 = table["rapp3_energy"][table["temperature_k"] == 3000][0]
    assert f"3000 K gives {at_3000:.2f} times" in findings[0].text
    rows = csv_rows(folder / "rapp_stars.csv")
    stars = rapp.bench_stars(bench.config, bench.folder)
    for field in fields_of(OWN):
        to_cam = to_matrix(from_radec_roll_deg(*field.radec_roll_deg))
        x, y, z = to_cam @ stars.vectors.T
        column = (SIZE_PX[0] - 1) / 2 + FOCAL_PX * x / z
        row = (SIZE_PX[1] - 1) / 2 + FOCAL_PX * y / z
        inside = (z > 0) & (column > -0.5) & (column < 119.5) & (row > -0.5) & (row < 89.5)
        own = [each for each in rows if each["field"] == field.stem]
        assert {int(each["hip"]) for each in own} == set(stars.hip[inside].tolist())
        ratios = [float(each["rapp3"]) for each in own]
        assert all(0.5 < ratio < 5 for ratio in ratios)
    named = zip(fields_of(OWN), findings[1:], strict=True)
    for field, finding in named:
        own = [float(each["rapp3"]) for each in rows if each["field"] == field.stem]
        low, middle, high = np.percentile(own, (5, 50, 95))
        assert finding.text == (
            f"RAPP3 of the stars of {field.name}: {len(own)} stars, median {middle:.2f}, 90 % from"
            f" {low:.2f} to {high:.2f}"
        )
    # red stars have more light in a sensor that sees to 1050 nm
    bv = np.array([float(each["bv_mag"]) for each in rows])
    ratio = np.array([float(each["rapp3"]) for each in rows])
    assert np.median(ratio[bv > 1.0]) > np.median(ratio[bv < 0.2])


def test_a_bench_s_ratios_are_by_its_own_weighting(tmp_path, small_run):
    path = tmp_path / "photons.toml"
    tables = {**BENCH, "sky": {"faintest_v_mag": 3.0, "passband_weighting": "photon"}}
    path.write_text(bench_text(tables))
    run = small_run(rapp.bench_rapp, read_bench_file(path))
    table = np.genfromtxt(run.folder / "rapp_bench.csv", delimiter=",", names=True)
    at = dict(zip(table["temperature_k"].tolist(), table["rapp3_photon"].tolist(), strict=True))
    assert run.told[0].text == (
        f"By photons.toml a black body of 3000 K gives {at[3000]:.2f} times the electrons of the"
        f" average model, one of 5000 K {at[5000]:.2f}, 9000 K {at[9000]:.2f}, 50000 K"
        f" {at[50_000]:.2f}"
    )
    by_energy = table["rapp3_energy"][table["temperature_k"] == 3000][0]
    assert abs(by_energy / at[3000] - 1) > 0.01
    (electrons,) = (y for label, _, y in run.lines("rapp_bench", 0) if label == "electrons")
    np.testing.assert_array_equal(electrons, table["rapp3_photon"])
    assert run.note("rapp_bench").endswith("Solid: photon weighting; dotted: energy.")


def truth_of(*stars: tuple[int, str, float, float, float, bool]) -> np.ndarray:
    """Stars of a truth table: HIP, name, V, temperature, light, saturated."""
    truth = np.zeros(len(stars), dtype=TRUTH_DTYPE)
    for row, (hip, name, v_mag, kelvin, e_per_s, clipped) in zip(truth, stars, strict=True):
        row["hip"], row["name"], row["v_mag"], row["temperature_k"] = hip, name, v_mag, kelvin
        row["electrons_per_s"], row["clipped"] = e_per_s, clipped
    truth["x_px"], truth["y_px"] = 10.0 * np.arange(len(stars)), 5.0 * np.arange(len(stars))
    return truth


TRUTH = truth_of(
    (11, "", 1.0, 9000.0, 9e5, True),
    (12, "", 2.0, np.nan, 5e5, False),
    (0, "Mars", 3.5, 4000.0, 3e5, False),
)


def scene_outputs(truth=TRUTH, inside=(True, True, False)) -> outputs.Outputs:
    noisy = Exposure(None, np.full((90, 120), 33), np.full((90, 120), 33.4), truth)
    return outputs.Outputs(noisy, noisy, np.array(inside), 40.0, 12.3, 5.0, "a camera")


def test_a_scene_is_told_by_its_stars_on_and_beyond_the_image():
    assert _scene_words(scene_outputs()) == (
        "2 stars, 1 more whose light reaches the image, V 1.00 to 3.50, mean 2.17; hottest 9000 K,"
        " mean 6500 K (9000 K on the image); 1 stars saturated; sky 33 DN; n_TOT of a pixel of sky"
        " 12 e-"
    )
    assert _scene_words(scene_outputs(TRUTH[:0], ())).startswith("no star; sky 33 DN")
    assert heat_words(np.array([np.nan])) == ""


def test_a_zoom_is_about_its_star_the_brightest_on_the_image_or_the_middle():
    scene = OutputScene("s", "s", FIELDS[0], zoom_hip=12)
    name, place = _zoom(scene, scene_outputs())
    assert ("12" in name, tuple(place)) == (True, (10.0, 5.0))
    assert _zoom(scene, scene_outputs(inside=(True, False, True)))[0] == "the middle"
    brightest = OutputScene("s", "s", FIELDS[0])
    assert tuple(_zoom(brightest, scene_outputs())[1]) == (0.0, 0.0)
    beyond = _zoom(brightest, scene_outputs(inside=(False, False, True)))
    assert "Mars" in beyond[0] and tuple(beyond[1]) == (20.0, 10.0)
    assert _zoom(brightest, scene_outputs(inside=(False,) * 3)) == ("the middle", (59.5, 44.5))


def test_a_field_s_angles_are_from_outer_edge_to_outer_edge():
    camera = Camera((200, 100), 500.0, (120.0, 30.0), np.eye(3))
    across, down = _field_deg(camera)
    middle_row = math.hypot(1.0, (49.5 - 30) / 500)
    left, right = -120.5 / 500, (199.5 - 120) / 500
    wanted = math.atan(right / middle_row) - math.atan(left / middle_row)
    assert across == pytest.approx(math.degrees(wanted))
    middle_column = math.hypot(1.0, (99.5 - 120) / 500)
    top, bottom = -30.5 / 500, (99.5 - 30) / 500
    wanted = math.atan(bottom / middle_column) - math.atan(top / middle_column)
    assert down == pytest.approx(math.degrees(wanted))


def test_the_thesis_s_noise_is_printed_as_its_sum():
    detector = DetectorSettings(
        prnu=0.02, dsnu_e_per_s=7.0, dark_e_per_s=203.0, gain_e_per_dn=6.0, read_noise_e=9.0
    )
    total = thesis_total_e(detector, 1000.0, 0.5)
    # of the ADC a twelfth of its step's square, by the full well over its codes
    step_e = detector.full_well_e / 2**detector.bits
    assert total == pytest.approx(math.sqrt(1000 + 101.5 + 20 + 3.5 + step_e**2 / 12 + 81))


def outcome(**changes: object) -> EffortOutcome:
    figures = {
        "scene": "wide, sparse",
        "bits": 8,
        "tolerance": "default",
        "tolerance_mag": 0.05,
        "tolerance_px": 0.1,
        "quantisation": "round",
        "stars": 90,
        "frame_ms": 4.0,
        "cpu_ms": 4.0,
        "flux_max_mag": 0.02,
        "centroid_max_px": 0.3,
        "claimed_mag": 0.02,
        "claimed_px": 0.05,
        "claimed_within": True,
        "measured_stars": 40,
    }
    kinds = ("moment", "window", "wide", "fit", "box3", "box5")
    places = {f"max_px_{kind}": 0.01 * place for place, kind in enumerate(kinds, start=1)}
    return EffortOutcome(**(figures | places | changes))


def test_effort_is_within_where_light_and_each_centroider_are():
    within = outcome()
    assert (within.worst_px, within.share, within.within) == (0.06, pytest.approx(0.6), True)
    assert outcome(flux_max_mag=0.04).share == pytest.approx(0.8)
    assert not outcome(max_px_wide=0.11).within
    # at the tolerance it is within
    assert outcome(max_px_wide=0.1).share == 1.0 and outcome(max_px_wide=0.1).within
    assert not outcome(flux_max_mag=0.051).within


def test_each_panel_of_effort_s_chart_ends_over_its_own_highest_bar(tmp_path, figures):
    """A speed-up of 9 beside errors of 2.4 limits, and errors within them: the line at 1 is seen."""
    full = outcome(tolerance="full", frame_ms=36.0)
    for worst_px in (0.24, 0.03):
        errors = {"flux_max_mag": 0.001, "max_px_fit": worst_px, "max_px_box5": 0.03}
        economy.draw(tmp_path / "a.png", [EffortComparison(full, outcome(**errors))], Load())
    room = 1.45  # for the legend
    limits = [axes.get_ylim() for figure in figures for axes in figure.axes]
    assert limits == [pytest.approx((0, room * height)) for height in (9.0, 2.4, 9.0, 1.0)]


def test_effort_s_gain_is_told_by_depth_over_the_default_tolerance_alone():
    full = outcome(tolerance="full", frame_ms=12.0, quantisation="exact")
    pairs = [
        EffortComparison(full, outcome()),
        EffortComparison(full, outcome(frame_ms=6.0)),
        EffortComparison(full, outcome(bits=12, frame_ms=8.0)),
        EffortComparison(full, outcome(tolerance="fine", frame_ms=24.0, max_px_fit=0.2)),
    ]
    assert [pair.speed_up for pair in pairs] == [3.0, 2.0, 1.5, 0.5]
    finding = economy.economy_finding(pairs)
    assert finding == (
        "At 8, 12 bits auto effort is 2.5, 1.5 times as fast as full effort (0.5 to 3.0 over all"
        " scenes and both tolerances), 1 of 4 OVER tolerance"
    )
    assert economy.line_of(pairs[0], Load()) == (
        "wide, sparse, 8 bits, 0.05 mag and 0.1 px: 4.00 ms (round) instead of 12.00 ms, 3.0 times"
        " as fast; largest errors of 40 stars 0.0200 mag and 0.0600 px by the worst of six"
        " centroiders (0.0400 by a PSF fit), within the tolerance"
    )
    assert economy.economy_finding(pairs[:2]).endswith("within tolerance")
    slow = economy.line_of(pairs[3], Load())
    assert "2.0 times as SLOW" in slow and slow.endswith("OVER the tolerance")
    assert NOT_JUDGED in economy.line_of(pairs[0], Load(1e3))
