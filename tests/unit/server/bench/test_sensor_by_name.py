"""A sensor by its name: the sheet's figures, what overrides them, and what is asked for."""

import tomllib

import numpy as np
import pytest

from hilstar.cli.budget import with_its_figures
from hilstar.instruments.simulate.noise import noise_budget, sensitivity_line
from hilstar.server.bench.bench_file import changed_file, read_bench_file
from hilstar.server.bench.config.sensor import other_sensor, with_sensor
from hilstar.sky.spectrum import QUANTUM_EFFICIENCIES
from hilstar.tracker.centroids import CentroidSettings
from hilstar.tracker.sensors import sensors
from hilstar.tracker.settings import DetectorSettings
from tests.support.benches import ROOT, bench_text
from tests.support.commands import run_hilstar_here
from tests.support.refusals import refusal
from tools.make_sensors import table

NONE = {"pixel_pitch_um": None, "resolution_px": None, "quantum_efficiency": None}
DARK = {"dark_e_per_s": 10.0}
ADC = {"gain_e_per_dn": 20.0, "bits": 12, "full_well_e": 60_000.0}  # of a bench's own sensor


def tracker_of(folder, tracker, detector):
    path = folder / "bench.toml"
    path.write_text(bench_text({"tracker": tracker, "tracker.detector": detector}))
    return read_bench_file(path)


@pytest.mark.parametrize("name", sensors())
def test_sheets_have_a_source_and_figures_that_a_detector_can_have(name):
    sensor = sensors()[name]
    assert sensor.source
    assert DetectorSettings(**sensor.detector)
    assert sensor.tracker.get("quantum_efficiency", name) == name
    assert ("quantum_efficiency" in sensor.tracker) == (name in QUANTUM_EFFICIENCIES)


def test_the_page_has_the_table():
    assert table() in (ROOT / "docs/twin.md").read_text(encoding="utf-8")


def test_a_name_is_its_figures_spelled_out(tmp_path):
    named = tracker_of(tmp_path, NONE | {"sensor": "IMX250"}, DARK)
    sheet = sensors()["imx250"]
    spelled = tracker_of(tmp_path, sheet.tracker, sheet.detector | DARK)
    assert named.config.tracker.detector == spelled.config.tracker.detector
    assert named.config.tracker.resolution_px == (2448, 2048)
    assert named.sha256 == spelled.sha256


def test_keys_beside_a_name_override_it(tmp_path):
    beside = {"sensor": "cmv4000", "resolution_px": [512, 512], "pixel_pitch_um": None}
    tracker = tracker_of(tmp_path, beside, {"read_noise_e": 9.0}).config.tracker
    assert tracker.resolution_px == (512, 512)
    assert tracker.pixel_pitch_um == 5.5
    assert tracker.detector.read_noise_e == 9.0
    assert tracker.detector.full_well_e == 13_500.0
    assert tracker.detector.dark_reference_temperature_k == 298.15


def test_a_dark_current_beside_a_name_is_at_the_files_own_temperature(tmp_path):
    detector = tracker_of(tmp_path, {"sensor": "cmv4000"}, DARK).config.tracker.detector
    assert detector.dark_reference_temperature_k == DetectorSettings().dark_reference_temperature_k
    assert detector.dsnu_e_per_s == 0.0


@pytest.mark.parametrize(
    ("name", "asked"),
    [
        ("imx250", "no [tracker.detector] dark_e_per_s; write it"),
        ("cmv4000", "no quantum_efficiency (quantum_efficiency is known as 0.6 at 550 nm alone)"),
        ("imx265", "no quantum_efficiency and [tracker.detector] dark_e_per_s; write them"),
        ("imx29", "did you mean imx290? write one of"),
    ],
)
def test_what_a_sheet_lacks_is_asked_for_by_name(tmp_path, name, asked):
    assert asked in refusal(tracker_of, tmp_path, NONE | {"sensor": name}, {})


def test_tables_without_a_name_are_as_they_were():
    tables = {"tracker": {"aperture_mm": 30}}
    assert with_sensor(tables) is tables


def changed(file, name):
    """The tracker of a bench with another sensor, and what is told of its keys."""
    other = other_sensor(tomllib.loads(file.text), name)
    return changed_file(file, other.tables).config.tracker, other


def test_another_sensor_takes_the_place_of_the_benchs(tmp_path):
    old = {"read_noise_e": 50.0, "prnu": 0.1, "dark_e_per_s": 7.0, "temperature_k": 270.0}
    file = tracker_of(tmp_path, {"principal_point_px": [500.0, 500.0]}, old)
    tracker, other = changed(file, "imx252")
    assert other.kept == ["detector.dark_e_per_s"]
    assert other.dropped == ["principal_point_px", "detector.prnu"]
    assert (tracker.detector.read_noise_e, tracker.detector.prnu) == (2.2, 0.0)
    assert (tracker.detector.dark_e_per_s, tracker.detector.temperature_k) == (7.0, 270.0)
    assert (tracker.quantum_efficiency, tracker.principal_point_px) == ("imx252", None)
    assert tracker.aperture_mm == 30


def test_a_dark_current_that_stays_has_its_own_temperature_and_law(tmp_path):
    law = {"dark_law": "e2v-nimo", "dark_reference_temperature_k": 253.0, "dsnu_e_per_s": 3.0}
    file = tracker_of(tmp_path, {}, {"dark_e_per_s": 7.0, "temperature_k": 270.0} | law)
    before = file.config.tracker.detector
    tracker, other = changed(file, "imx265")
    after = tracker.detector
    rates = [d.dark_e_per_s * d.dark_factor for d in (before, after)]
    assert rates[0] == rates[1] != 7.0
    assert after.dsnu_e_per_s == 3.0
    assert set(other.beside) == {f"detector.{key}" for key in law}


def test_a_dark_current_that_stays_is_not_under_the_law_of_the_new_ones_sheet(tmp_path):
    # the sheet of the CCD47-20 has a law and no figure; the bench's figure is at 320 K by Arrhenius
    dark = {"dark_e_per_s": 7.0, "dark_reference_temperature_k": 320.0, "read_noise_e": 8.0}
    file = tracker_of(tmp_path, {}, ADC | dark)
    tracker, other = changed(file, "ccd47-20")
    assert tracker.detector.dark_factor == file.config.tracker.detector.dark_factor
    assert set(other.beside) == {"detector.dark_reference_temperature_k", "detector.dark_law"}


def test_a_dark_current_of_the_sheet_has_nothing_of_the_benchs_law(tmp_path):
    law = {"dark_law": "e2v-nimo", "dark_reference_temperature_k": 253.0, "dark_e_per_s": 7.0}
    tracker, other = changed(tracker_of(tmp_path, {}, law), "cmv4000")
    sheet = DetectorSettings(**sensors()["cmv4000"].detector)
    assert tracker.detector.dark_factor == sheet.dark_factor
    assert other.dropped == ["detector.dark_law"]


def test_read_noise_goes_with_the_frequency_at_which_it_holds(tmp_path):
    noise = {
        "read_noise_e": 8.0,
        "readout_hz": 4e6,
        "read_noise_reference_hz": 1e6,
        "read_noise_corner_hz": 5e4,
    }
    file = tracker_of(tmp_path, {}, ADC | noise | {"dark_e_per_s": 7.0})
    stays, other = changed(file, "ccd47-20")
    assert stays.detector.read_noise_now_e == file.config.tracker.detector.read_noise_now_e
    assert "detector.readout_hz" in other.beside
    replaced, other = changed(file, "imx250")
    assert replaced.detector.read_noise_now_e == 2.2
    assert {"detector.readout_hz", "detector.read_noise_corner_hz"} <= set(other.dropped)


def test_an_efficiency_that_stays_is_that_of_the_open_part_of_a_pixel(tmp_path):
    file = tracker_of(tmp_path, {}, {"fill_factor": 0.5, "dark_e_per_s": 7.0})
    assert changed(file, "imx265")[0].detector.fill_factor == 0.5
    assert changed(file, "imx250")[0].detector.fill_factor == 1.0


@pytest.mark.parametrize(("aperture_mm", "answer"), [(20, "sensitive enough"), (1, "not enough")])
def test_a_small_lens_makes_a_sensor_too_insensitive(tmp_path, aperture_mm, answer):
    file = tracker_of(tmp_path, NONE | {"sensor": "imx250", "aperture_mm": aperture_mm}, DARK)
    found = noise_budget(file, None, CentroidSettings(), np.random.default_rng(0))
    assert sensitivity_line(found).startswith(answer)
    detection = [row["detection"] for row in found.rows]
    v_mag = [row["v_mag"] for row in found.rows]
    # rows are half magnitudes; the limit lies between those about it
    step = np.searchsorted(v_mag, found.found_v_mag)
    assert detection[step - 1] >= 0.5 >= detection[step]


def test_budget_says_whose_figures_stand(tmp_path):
    tracker_of(tmp_path, {}, DARK | {"dark_reference_temperature_k": 300.0, "prnu": 0.01})
    run = run_hilstar_here("budget", "bench.toml", "--sensor", "imx252", cwd=tmp_path)
    assert "enough: half of the stars of V =" in run.stdout.splitlines()[0]
    assert "Moravian" in run.stderr
    assert "its sheet has no [tracker.detector] dark_e_per_s: the bench's stand, with" in run.stderr
    assert "left out, as they are the old sensor's: [tracker.detector] " in run.stderr
    assert "dark_reference_temperature_k" in run.stderr and "prnu" in run.stderr


def test_a_figure_that_stays_is_said_where_nothing_belongs_to_it(tmp_path, capsys):
    file = tracker_of(tmp_path, {}, DARK)
    assert with_its_figures(file, "imx252").config.tracker.sensor == "imx252"
    source, *said = capsys.readouterr().err.splitlines()
    assert source.startswith("imx252: ")
    assert said[0] == "its sheet has no [tracker.detector] dark_e_per_s: the bench's stand"
