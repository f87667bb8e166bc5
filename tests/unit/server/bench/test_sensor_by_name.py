"""A sensor by its name: the sheet's figures, what overrides them, and what is asked for."""

import tomllib

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.instruments.simulate.noise import noise_budget, sensitivity_line
from hilstar.server.bench.bench_file import changed_file, read_bench_file
from hilstar.server.bench.config.sensor import other_sensor, with_sensor
from hilstar.sky.spectrum import QUANTUM_EFFICIENCIES
from hilstar.tracker.centroids import CentroidSettings
from hilstar.tracker.sensors import sensors
from hilstar.tracker.settings import DetectorSettings
from tests.support.benches import ROOT, bench_text
from tests.support.commands import run_hilstar_here
from tools.make_sensors import table

NONE = {"pixel_pitch_um": None, "resolution_px": None, "quantum_efficiency": None}
DARK = {"dark_e_per_s": 10.0}


def read(folder, tracker, detector):
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
    named = read(tmp_path, NONE | {"sensor": "IMX250"}, DARK)
    sheet = sensors()["imx250"]
    spelled = read(tmp_path, sheet.tracker, sheet.detector | DARK)
    assert named.config.tracker.detector == spelled.config.tracker.detector
    assert named.config.tracker.resolution_px == (2448, 2048)
    assert named.sha256 == spelled.sha256


def test_keys_beside_a_name_override_it(tmp_path):
    beside = {"sensor": "cmv4000", "resolution_px": [512, 512], "pixel_pitch_um": None}
    tracker = read(tmp_path, beside, {"read_noise_e": 9.0}).config.tracker
    assert tracker.resolution_px == (512, 512)
    assert tracker.pixel_pitch_um == 5.5
    assert tracker.detector.read_noise_e == 9.0
    assert tracker.detector.full_well_e == 13_500.0
    assert tracker.detector.dark_reference_temperature_k == 298.15


def test_a_dark_current_beside_a_name_is_at_the_files_own_temperature(tmp_path):
    detector = read(tmp_path, {"sensor": "cmv4000"}, DARK).config.tracker.detector
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
    with pytest.raises(InputError) as refused:
        read(tmp_path, NONE | {"sensor": name}, {})
    assert asked in str(refused.value)
    assert "\n" not in str(refused.value)


def test_tables_without_a_name_are_as_they_were():
    tables = {"tracker": {"aperture_mm": 30}}
    assert with_sensor(tables) is tables


def test_another_sensor_takes_the_place_of_the_benchs(tmp_path):
    old = {"read_noise_e": 50.0, "prnu": 0.1, "dark_e_per_s": 7.0, "temperature_k": 270.0}
    file = read(tmp_path, {"principal_point_px": [500.0, 500.0]}, old)
    tables, kept = other_sensor(tomllib.loads(file.text), "imx252")
    tracker = changed_file(file, tables).config.tracker
    assert kept == ["detector.dark_e_per_s"]
    assert (tracker.detector.read_noise_e, tracker.detector.prnu) == (2.2, 0.0)
    assert (tracker.detector.dark_e_per_s, tracker.detector.temperature_k) == (7.0, 270.0)
    assert (tracker.quantum_efficiency, tracker.principal_point_px) == ("imx252", None)
    assert tracker.aperture_mm == 30


@pytest.mark.parametrize(("aperture_mm", "answer"), [(20, "sensitive enough"), (1, "not enough")])
def test_a_small_lens_makes_a_sensor_too_insensitive(tmp_path, aperture_mm, answer):
    file = read(tmp_path, NONE | {"sensor": "imx250", "aperture_mm": aperture_mm}, DARK)
    found = noise_budget(file, None, CentroidSettings(), np.random.default_rng(0))
    assert sensitivity_line(found).startswith(answer)
    detection = [row["detection"] for row in found.rows]
    v_mag = [row["v_mag"] for row in found.rows]
    # rows are half magnitudes; the limit lies between those about it
    step = np.searchsorted(v_mag, found.found_v_mag)
    assert detection[step - 1] >= 0.5 >= detection[step]


def test_budget_says_whose_figures_stand(tmp_path):
    read(tmp_path, {}, DARK)
    run = run_hilstar_here("budget", "bench.toml", "--sensor", "imx252", cwd=tmp_path)
    assert "enough: half of the stars of V =" in run.stdout
    assert "Moravian" in run.stderr
    assert "its sheet has no [tracker.detector] dark_e_per_s: the bench's stand" in run.stderr
