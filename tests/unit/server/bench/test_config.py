"""The bench file: what it must give, and the one line that says what is wrong."""

from __future__ import annotations

import re

import pytest

from hilstar.basics.errors import InputError
from hilstar.server.bench.config import read_config
from hilstar.server.bench.star_rates import bench_optics
from tests.support.benches import ROOT, SMALL_BENCH

# The bench file of the design's section 5, every key given (the values that choose between words:
# the first).
WHOLE = """
[tracker]
aperture_mm=30
focal_length_mm=70
pixel_pitch_um=13
resolution_px=[1024,1024]
exposure_s=0.1
psf_sigma_px=[0.55,0.55]
quantum_efficiency="ccd47-20"
transmission="n-bk7-10mm"
[tracker.detector]
gain_e_per_dn=24
full_well_e=70000
bits=12
offset_dn=100
read_noise_e=2
dark_e_per_s=250
dsnu_e_per_s=30
prnu=0.01
device_seed=1
fixed_pattern="ccd"
[sky]
catalogue="hipparcos"
epoch_jyear=2026.0
faintest_v_mag=7.5
brightness="dgs"
spectrum="blackbody"
temperature="ballesteros2012"
zero_point="vega"
passband_weighting="energy"
observer_velocity_km_s=[0,29.8,0]
[monitor]
resolution_px=[1920,1080]
pixel_pitch_um=57.65
refresh_hz=60
bits=8
calibration="srgb"
[collimator]
focal_length_mm=350
q_cam_to_mon=[1,0,0,0]
[attitude]
source="zmq"
endpoint="tcp://127.0.0.1:5560"
stale_after_ms=250
max_extrapolation_ms=100
on_stale="hold"
[render]
quantisation="round"
sprite_sigma_px=[0.85,0.85]
flux_at_white_e_per_s=1e7
[background]
electrons_per_px=0
[verify]
flux_mag=0.05
centroid_px=0.02
"""


def refusal(tmp_path, text: str) -> str:
    path = tmp_path / "bench.toml"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        read_config(path)
    line = str(error.value)
    assert line.startswith(f"{path}: ")
    assert "\n" not in line
    return line.removeprefix(f"{path}: ")


def test_every_key_of_the_design_is_read(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(WHOLE)
    config = read_config(path)
    assert config.tracker.aperture_mm == 30
    assert config.sky.observer_velocity_km_s == (0, 29.8, 0)
    assert config.render.flux_at_white_e_per_s == 1e7


def test_geometry_aperture_and_quantum_efficiency_are_all_that_a_bench_must_give(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH)
    config = read_config(path)
    assert (config.sky.faintest_v_mag, config.monitor.refresh_hz, config.attitude.on_stale) == (
        7.5,
        60,
        "hold",
    )


@pytest.mark.parametrize("name", sorted(path.name for path in (ROOT / "configs").glob("*.toml")))
def test_the_shipped_configs_are_right(name):
    read_config(ROOT / "configs" / name)


@pytest.mark.parametrize(
    ("key", "table"),
    [
        ("aperture_mm", "tracker"),
        ("focal_length_mm", "tracker"),
        ("pixel_pitch_um", "tracker"),
        ("resolution_px", "tracker"),
        ("quantum_efficiency", "tracker"),
    ],
)
def test_a_missing_key_is_named(tmp_path, key, table):
    line = refusal(tmp_path, re.sub(rf"(?m)^{key} .*\n", "", SMALL_BENCH, count=1))
    assert f"[{table}] the key {key} is missing" in line


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "aperture_mm = 30",
            "aperture = 30",
            "[tracker] unknown key aperture; did you mean aperture_mm?",
        ),
        (
            "aperture_mm = 30",
            "aperture_mm = -30",
            "[tracker] aperture_mm = -30; number >= 1e-06 is wanted",
        ),
        (
            "aperture_mm = 30",
            'aperture_mm = "30"',
            '[tracker] aperture_mm = "30"; number is wanted',
        ),
        (
            "aperture_mm = 30",
            "aperture_mm = 1e200",
            "[tracker] aperture_mm = 1e200; number <= 1000000000000.0 is wanted",
        ),
        (
            "aperture_mm = 30",
            "aperture_mm = true",
            "[tracker] aperture_mm = true; number is wanted",
        ),
        (
            "aperture_mm = 30",
            "aperture_mm = nan",
            "tracker.aperture_mm = nan; a finite number is wanted",
        ),
        ("[320, 240]", "[320]", "[monitor] resolution_px = [320]; array of length 2 is wanted"),
        (
            "[320, 240]",
            "[320, 240.5]",
            "[monitor] resolution_px = [320,240.5]; whole number is wanted",
        ),
        ("[320, 240]", "[320, inf]", "monitor.resolution_px = inf; a finite number is wanted"),
        ("[collimator]", "[colimator]", "unknown key colimator; did you mean collimator?"),
        ("[tracker]", "x = 1\n[tracker]", "unknown key x; known are tracker, monitor"),
        ("[tracker]", "[tracker", "not TOML"),
        (
            "focal_length_mm = 60",
            "focal_length_mm = 60\nq_cam_to_mon = [1,1,0,0]",
            "q_cam_to_mon: its norm is 1.41421",
        ),
    ],
)
def test_what_is_wrong_is_said_with_what_to_write(tmp_path, old, new, words):
    assert words in refusal(tmp_path, SMALL_BENCH.replace(old, new))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (
            '[sky]\ntemperature = "hot"\n',
            '[sky] temperature = "hot"; "ballesteros2012" or "wang2021" is wanted',
        ),
        ("[sky]\nobserver_velocity_km_s = [3e5, 0, 0]\n", "not slower than light"),
        ("[background]\nelectrons_per_px = 1\nzodiacal_v_mag_arcsec2 = 22\n", "write one of them"),
        (
            '[verify]\ncentroider = "centre"\n',
            '[verify] centroider = "centre"; "window" or "wide" or "moment" or "fit" or',
        ),
        ("[verify]\ncentroider = 3\n", '[verify] centroider = 3; "window" or "wide"'),
        ('[render]\nquantisation = "exactly"\n', '"exact" or "auto" is wanted'),
        ("[render]\ncycle_frames = 0\n", "cycle_frames"),
        ("[render]\ncycle_frames = 6.5\n", "cycle_frames"),
        ("[render]\ncycle_frames = 257\n", "cycle_frames"),
        ("[render]\nsprite_sigma_px = [0, 1]\n", "sprite_sigma_px = [0,1]"),
        ("[monitor.x]\n", "[monitor] unknown key x"),
    ],
)
def test_further_tables_are_checked_too(tmp_path, more, words):
    assert words in refusal(tmp_path, SMALL_BENCH + more)


@pytest.mark.parametrize(
    "text",
    ["x = " + "[" * 5000, "x = " + "[" * 900 + "]" * 900, "[" + ".".join(["a"] * 2000) + "]"],
)
def test_tables_without_end_are_refused(tmp_path, text):
    assert refusal(tmp_path, text)


def test_a_bench_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        read_config(tmp_path / "none.toml")


def test_the_fill_factor_takes_its_share_of_every_electron(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(WHOLE)
    plain = bench_optics(read_config(path).tracker, tmp_path).quantum_efficiency
    path.write_text(WHOLE.replace("[tracker.detector]", "[tracker.detector]\nfill_factor = 0.4"))
    open_part = bench_optics(read_config(path).tracker, tmp_path).quantum_efficiency
    assert (open_part.value == plain.value * 0.4).all()
