"""The bench file: what it must give (what is refused: test_refusals.py)."""

from __future__ import annotations

import pytest
from astropy.time import Time
from msgspec.structs import replace

from hilstar.server.bench.config import AttitudeSettings, parse_config, read_config
from hilstar.server.bench.config.bench_config import sky_jd
from hilstar.server.bench.star_rates import bench_optics
from tests.support.benches import ROOT, SMALL_BENCH, bench_text
from tests.support.refusals import refusal

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


def test_the_fill_factor_takes_its_share_of_every_electron(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(WHOLE)
    plain = bench_optics(read_config(path).tracker, tmp_path).quantum_efficiency
    path.write_text(WHOLE.replace("[tracker.detector]", "[tracker.detector]\nfill_factor = 0.4"))
    open_part = bench_optics(read_config(path).tracker, tmp_path).quantum_efficiency
    assert (open_part.value == plain.value * 0.4).all()


@pytest.mark.parametrize("table", ["tracker", "monitor"])
def test_the_largest_image_is_the_one_that_a_refusal_advises(tmp_path, table):
    path = tmp_path / "bench.toml"
    path.write_text(bench_text({table: {"resolution_px": [8192, 8193]}}))
    line = refusal(read_config, path)
    assert f"[{table}] resolution_px = [8192, 8193]" in line
    assert "such as [8192, 8192]" in line
    path.write_text(bench_text({table: {"resolution_px": [8192, 8192]}}))
    assert getattr(read_config(path), table).resolution_px == (8192, 8192)


@pytest.mark.parametrize(
    ("exposure_s", "render", "frames"),
    [
        (0.041, {}, 2),
        (0.043, {}, 3),  # to the nearest
        (0.002, {}, 1),
        (1.0, {}, 16),  # no more are judged
        (1.0, {"quantisation": "temporal", "cycle_frames": 5}, 5),
    ],
)
def test_an_exposure_is_judged_by_its_frames(tmp_path, exposure_s, render, frames):
    changes = {"tracker": {"exposure_s": exposure_s}, "render": render}
    config = parse_config(tmp_path / "bench.toml", bench_text(changes))
    assert config.exposure_frames == frames


@pytest.mark.parametrize(
    ("sky", "t_s", "utc"),
    [
        ({"epoch_utc": "2026-11-21T18:00:00Z"}, 3600.0, "2026-11-21T19:00:00"),
        ({"epoch_utc": "2026-11-21T18:00:00Z"}, -86_400.0, "2026-11-20T18:00:00"),
        ({"epoch_utc": "unix"}, 1e9, "2001-09-09T01:46:40"),
        ({"epoch_jyear": 2000.0}, None, "2000-01-01T12:00:00"),
        ({"epoch_jyear": 2008.0}, None, "2008-01-01T12:00:00"),
    ],
)
def test_a_moment_s_julian_date_counts_from_the_bench_s_own(tmp_path, sky, t_s, utc):
    config = parse_config(tmp_path / "bench.toml", bench_text({"sky": sky}))
    t_ns = None if t_s is None else round(t_s * 1e9)
    # a Julian date in a float is right to 40 us
    assert sky_jd(config, t_ns) == pytest.approx(Time(utc, scale="utc").jd, abs=1e-9)


@pytest.mark.parametrize(
    ("source", "lockstep", "port"),
    [
        ("zmq", False, 5560),
        ("zmq", True, 5560),
        ("vizard", False, 5570),  # Basilisk's vizInterface: its broadcast, and its live stream
        ("vizard", True, 5556),
        ("42", False, 10001),  # 42's Inp_IPC.txt
        ("42", True, 10001),
        ("udp", False, None),
        ("serial", False, None),
    ],
)
def test_a_source_without_an_endpoint_is_where_its_simulator_usually_is(source, lockstep, port):
    settings = AttitudeSettings(source=source, lockstep=lockstep)
    assert settings.address == ("" if port is None else f"tcp://127.0.0.1:{port}")
    assert replace(settings, endpoint="ipc:///a").address == "ipc:///a"
