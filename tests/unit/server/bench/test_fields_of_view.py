"""What a bench's lengths mean together, and the warning where one of them has another unit."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest

from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.cameras import fields_of_view
from tests.support.benches import ROOT, bench_text
from tests.support.commands import run_hilstar_here

BENCH = (ROOT / "examples" / "bench.toml").read_text()
SHIPPED = sorted([*(ROOT / "configs").glob("*.toml"), *(ROOT / "examples").glob("*bench.toml")])
STAR = (
    "star 1.0 px sigma, of the sky 0.55; brightest pixel 1.1 mag fainter; 13.6 px share it, of the"
    " sky 4.5"
)
LINE = "screen 18.0 x 10.2 deg, tracker 10.9 deg, 0.89 tracker px a monitor px"
FIGURE_DEG = 1e-9  # of angles that are one arctangent each


def fields(folder: Path, *changes: tuple[str, str]):
    text = BENCH
    for old, new in changes:
        assert text.count(old) == 1
        text = text.replace(old, new)
    path = folder / "bench.toml"
    path.write_text(text)
    file = read_bench_file(path)
    return fields_of_view(file.config, file.folder)


def test_the_angles_are_those_of_the_lenses(tmp_path):
    found = fields(tmp_path)
    assert found.line() == LINE
    width_deg, height_deg = (
        2 * math.degrees(math.atan(n * 57.65e-3 / 2 / 350)) for n in (1920, 1080)
    )
    assert found.screen_deg == pytest.approx((width_deg, height_deg), abs=FIGURE_DEG)
    tracker_deg = 2 * math.degrees(math.atan(1024 * 13e-3 / 2 / 70))
    assert found.tracker_deg == pytest.approx((tracker_deg, tracker_deg), abs=FIGURE_DEG)
    assert found.tracker_px_a_monitor_px == pytest.approx(57.65 / 350 / (13 / 70))
    # The field is as high as the screen and more; of the screen's width it has the tracker's.
    assert found.field_on_screen == pytest.approx(1080 * 57.65 / 350 / (1024 * 13 / 70), abs=1 / 64)
    assert found.screen_seen == pytest.approx(1024 * 13 / 70 / (1920 * 57.65 / 350), abs=1 / 64)
    assert found.warning is None


def test_a_detector_that_is_not_square_has_two_angles(tmp_path):
    assert "tracker 10.9 x 5.4 deg" in fields(tmp_path, ("[1024, 1024]", "[1024, 512]")).line()


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_no_bench_that_ships_is_warned_of(path):
    file = read_bench_file(path)
    assert fields_of_view(file.config, file.folder).warning is None


@pytest.mark.parametrize(
    ("key", "value", "unit", "meant"),
    [
        ("pixel_pitch_um = 57.65", "0.05765", "mm", "57.65"),
        ("pixel_pitch_um = 57.65", "5.765e-5", "m", "57.65"),
        ("pixel_pitch_um = 57.65", "57650", "nm", "57.65"),
        ("focal_length_mm = 350", "35", "cm", "350"),
        ("focal_length_mm = 350", "0.35", "m", "350"),
        ("focal_length_mm = 350", "350000", "um", "350"),
        ("focal_length_mm = 350", "13.78", "inches", "350.012"),
        ("focal_length_mm = 70", "7", "cm", "70"),
        ("focal_length_mm = 70", "0.07", "m", "70"),
        ("focal_length_mm = 70", "70000", "um", "70"),
        ("aperture_mm = 30", "3", "cm", "30"),
        ("aperture_mm = 30", "0.03", "m", "30"),
        ("aperture_mm = 30", "30000", "um", "30"),
    ],
)
def test_a_length_in_another_unit_is_named_with_what_was_meant(tmp_path, key, value, unit, meant):
    name = key.partition(" =")[0]
    warning = fields(tmp_path, (key + "\n", f"{name} = {value}\n")).warning
    assert warning is not None
    assert f"{name} = {float(value):.6g} in {unit}, which is {meant}" in warning


def test_an_f_number_in_place_of_an_aperture_is_named_with_the_aperture(tmp_path):
    warning = fields(tmp_path, ("aperture_mm = 30\n", "aperture_mm = 2.8\n")).warning
    assert warning is not None
    assert "[tracker] aperture_mm = 2.8 the f-number, which is 25" in warning  # 70 mm over 2.8


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            [("= 30\n", "= 3\n"), ("= 70\n", "= 7\n"), ("= 350\n", "= 35\n")],
            "115.4 deg is wider than a lens sees",
        ),
        ([("= 70\n", "= 7\n"), ("= 350\n", "= 35\n")], "f/0.23"),  # both focal lengths in cm
        (
            [("= 13\n", "= 1000\n"), ("= 57.65\n", "= 4434\n")],
            r"\[tracker\] pixel_pitch_um is 1000",
        ),
        (
            [("= 13\n", "= 0.13\n"), ("= 57.65\n", "= 0.5765\n")],
            r"\[tracker\] pixel_pitch_um is 0.13",
        ),
        ([("[1024, 1024]", "[150, 150]")], "the tracker sees .* % of the screen"),
        ([("[1920, 1080]", "[320, 240]")], "the tracker sees past the screen"),
        (
            [("[background]\n", "[verify]\ntrue_focal_length_mm = 35\n[background]\n")],
            r"\[verify\] true_focal_length_mm is 35",
        ),
    ],
)
def test_what_cannot_be_is_said(tmp_path, changes, words):
    warning = fields(tmp_path, *changes).warning
    assert warning is not None
    assert re.search(words, warning), warning


# A 27-inch monitor behind 500 mm before a narrow tracker, which sees 6 % of it: odd, and no length
# is in another unit.
NEWCOMER = [
    ("= 57.65\n", "= 233.1\n"),
    ("[1920, 1080]", "[2560, 1440]"),
    ("= 350\n", "= 500\n"),
    ("= 70\n", "= 50\n"),
    ("= 13\n", "= 5.5\n"),
    ("[1024, 1024]", "[2048, 2048]"),
]


def test_a_small_part_of_the_screen_and_a_fine_tracker_are_no_units(tmp_path):
    found = fields(tmp_path, *NEWCOMER)
    assert found.screen_seen == pytest.approx(0.064, abs=0.002)
    assert found.warning is None


@pytest.mark.parametrize(
    ("change", "meant"),
    [
        (("= 233.1\n", "= 0.2331\n"), "pixel_pitch_um = 0.2331 in mm, which is 233.1"),
        (("= 500\n", "= 50\n"), "[collimator] focal_length_mm = 50 in cm, which is 500"),
        (("= 500\n", "= 0.5\n"), "[collimator] focal_length_mm = 0.5 in m, which is 500"),
        (("= 50\n", "= 0.05\n"), "[tracker] focal_length_mm = 0.05 in m, which is 50"),
    ],
)
@pytest.mark.parametrize(
    "odd", [None, ("= 30\n", "= 1.9\n"), ("[2560, 1440]", "[160, 120]")], ids=["", "f/26", "past"]
)
def test_a_unit_is_named_on_a_bench_that_is_odd_in_other_ways(tmp_path, change, meant, odd):
    text = BENCH
    for old, new in [*NEWCOMER, change, *([] if odd is None else [odd])]:
        text = text.replace(old, new)
    (tmp_path / "bench.toml").write_text(text)
    file = read_bench_file(tmp_path / "bench.toml")
    warning = fields_of_view(file.config, file.folder).warning
    assert warning is not None
    assert meant in warning, warning


@pytest.mark.parametrize("f_number", [0.7, 1.4, 8.0, 20.0])
@pytest.mark.parametrize("share", [0.02, 0.3, 3.0, 10.0])
def test_a_bench_that_a_lab_may_have_is_not_warned_of(tmp_path, f_number, share):
    side_mm = 1024 * 0.013
    focal_mm = 70.0
    collimator_mm = math.sqrt(share * 1920 * 1080 * 0.05765**2) * focal_mm / side_mm
    changes = [("= 30\n", f"= {focal_mm / f_number}\n"), ("= 350\n", f"= {collimator_mm}\n")]
    assert fields(tmp_path, *changes).warning is None


def test_frame_and_doctor_print_the_line_and_warn_on_stderr(tmp_path):
    (tmp_path / "bench.toml").write_text(BENCH)
    (tmp_path / "wrong.toml").write_text(BENCH.replace("57.65", "0.05765"))
    at = ("--radec", "84.057,-1.2,0", "-o", "o.fits")
    drawn = run_hilstar_here("frame", "bench.toml", *at, cwd=tmp_path)
    assert (drawn.returncode, drawn.stdout.splitlines()[1:], drawn.stderr) == (0, [LINE, STAR], "")
    wrong = run_hilstar_here("frame", "wrong.toml", *at, cwd=tmp_path)
    assert wrong.returncode == 0
    assert (
        wrong.stdout.splitlines()[1]
        == "screen 0.018 x 0.01 deg, tracker 10.9 deg, 0.00089 tracker px a monitor px"
    )
    assert len(wrong.stderr.splitlines()) == 1
    assert "pixel_pitch_um = 0.05765 in mm, which is 57.65?" in wrong.stderr
    told = run_hilstar_here("frame", "bench.toml", *at, "--json", cwd=tmp_path)
    assert json.loads(told.stdout)["fields_of_view"]["screen_deg"] == pytest.approx(
        [17.97, 10.16], abs=0.01
    )
    examined = run_hilstar_here("doctor", "bench.toml", cwd=tmp_path)
    assert examined.stdout.splitlines()[-2:] == [
        f"ok      bench.toml  {LINE}",
        f"ok      star        {STAR}",
    ]
    told = run_hilstar_here("doctor", "wrong.toml", "--json", cwd=tmp_path)
    assert "which is 57.65?" in json.loads(told.stdout)["benches"]["wrong.toml"]["warning"]
    assert len(told.stderr.splitlines()) == 1


def test_doctor_refuses_a_bench_file_that_names_what_is_not_there(tmp_path):
    (tmp_path / "bench.toml").write_text(BENCH.replace('"ccd47-20"', '"my-ccd.csv"'))
    refused = run_hilstar_here("doctor", "bench.toml", cwd=tmp_path)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert "my-ccd.csv" in refused.stderr


def test_what_is_simulated_and_verified_is_warned_of_too(tmp_path):
    aperture_in_cm = {"tracker": {"aperture_mm": 3, "resolution_px": [256, 192]}}
    quick = {"sky": {"faintest_v_mag": 4.0}, "render": {"quantisation": "round"}}
    (tmp_path / "wrong.toml").write_text(bench_text(aperture_in_cm, quick))
    for words in (
        "simulate wrong.toml --radec 84.057,-1.2,0 -o o.fits",
        "verify wrong.toml --fields 1",
    ):
        told = run_hilstar_here(words, cwd=tmp_path)
        assert told.returncode == 0, told.stderr
        assert (
            told.stderr.count("check the units: ")
            == told.stderr.count("= 3 in cm, which is 30")
            == 1
        )
