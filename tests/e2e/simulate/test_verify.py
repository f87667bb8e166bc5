"""The digital twin: a right bench passes, and each wrong one is caught for what is wrong with
it.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilstar.display.panel import Panel
from hilstar.display.response import gamma_response, srgb_response, table_response
from hilstar.instruments.simulate.twin import Twin
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.benches import TWIN, bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.tables import csv_rows

BENCH = bench_text(TWIN)
FIELDS = "6"
# Of a perfect monitor: a square pixel as nine points, the window's cut, and float32 sums. Measured
# 0.0013 px, 2e-5 mag.
FLOOR_PX = 0.004
FLOOR_MAG = 1e-4
# Each of a pixel's nine sprites is cut at 1e-6 of its light, as far as 4 px out and more on one
# side.
CUT_PX = 1e-4


def verified(
    tmp_path: Path, verify: str = "", *options: str, replace: tuple[str, str] = ("", "")
) -> tuple[int, dict]:
    path = tmp_path / "bench.toml"
    path.write_text(BENCH.replace(*replace) + f"[verify]\n{verify}\n")
    result = run_hilstar_here("verify", path, "--fields", FIELDS, "--json", "--strict", *options)
    assert result.stdout, result.stderr
    return result.returncode, json.loads(result.stdout)


def test_a_right_bench_passes_within_the_aims(tmp_path):
    code, summary = verified(tmp_path)
    assert (code, summary["passed"], summary["reasons"], summary["lost"]) == (0, True, [], 0)
    assert summary["stars"] > 30
    assert summary["fields"] == 6
    # Seven magnitudes on 10 bits; a tracker pixel is 1.08 monitor pixels.
    assert summary["flux_error_mag"]["max"] < 0.02
    assert summary["centroid_error_px"]["p95"] < 0.02
    arcsec_per_px = 13e-3 / 25 * 180 * 3600 / np.pi
    assert summary["centroid_error_arcsec"]["rms"] == pytest.approx(
        arcsec_per_px * summary["centroid_error_px"]["rms"]
    )
    assert summary["estimator_floor"]["flux_mag"]["p95"] < FLOOR_MAG  # the worst is a blend
    assert summary["estimator_floor"]["centroid_px"]["p95"] < FLOOR_PX
    assert summary["noisy"]["flux_mag"]["rms"] > summary["flux_error_mag"]["rms"]
    assert sum(row["stars"] for row in summary["by_magnitude"]) == summary["stars"]
    assert summary["codes_alone"]["flux_mag"] == summary["flux_error_mag"]
    assert summary["at_edge"] > 0
    by_each = summary["centroid_error_px_by"]
    assert list(by_each) == ["moment", "window", "wide", "fit", "box3", "box5"]
    assert by_each[summary["centroider"]]["rms"] == pytest.approx(
        summary["centroid_error_px"]["rms"]
    )
    assert 0 < max(errors["p95"] for errors in by_each.values()) < 0.05


def write_geometry_file(path: Path, lines: str) -> None:
    """A geometry file of the bench's monitor: its ideal lens, and what `lines` say otherwise."""
    values = {
        "focal_length_px": 120e3 / 57.65,
        "principal_point_px": [319.5, 239.5],
        "q_cam_to_mon": [1, 0, 0, 0],
    }
    table = "".join(f"{name} = {value}\n" for name, value in values.items() if name not in lines)
    path.write_text(f'kind = "hilstar geometry 1"\nresolution_px = [640, 480]\n{table}{lines}\n')


# What is planted, and the reasons that name it with its size: these and no others, but the
# centroids' own.
PLANTED = {
    "distortion": ("k1 = 0.6", [r"the lens distorts by 2\.\d+ px \(k1 \+0\.6\)"]),
    "strong distortion": ("k1 = -2.5\nk2 = 20", [r"the lens distorts by 1\d\.\d+ px \(k1 -2\.5\)"]),
    "decentring": ("p1 = 0.01\np2 = -0.01", [r"the lens distorts by 1\.\d+ px"]),
    "tilt": (
        "tilt_deg = [1.0, -0.7]",
        [r"the screen is tilted by \(\+1\.0\d, -0\.7\d\) deg about its x and y axes"],
    ),
    "centre": (
        "principal_point_px = [321.0, 238.5]",
        [r"the field is shifted by \(-1\.39, \+0\.92\) px"],
    ),
    "centre and distortion": (
        "principal_point_px = [334.5, 230]\nk1 = 0.6",
        [
            r"the field is shifted by \(-13\.86, \+8\.78\) px",
            r"the lens distorts by [23]\.\d+ px \(k1 \+0\.(59|6)",
        ],
    ),
    "all": (
        (
            "k1 = 0.6\ntilt_deg = [1.0, -0.7]\nprincipal_point_px = [330, 245]\nfocal_length_px ="
            " 2102.36"
        ),
        [
            "the plate scale is -(0.9|1.0)",
            r"the field is shifted by \(-9\.6\d, -5\.0\d\) px",
            r"the screen is tilted by \(\+1\.0\d, -0\.[67]\d\)",
            r"the lens distorts by 2\.\d+ px \(k1 \+0\.(59|6)",
        ],
    ),
}


@pytest.mark.parametrize("kind", PLANTED)
def test_a_planted_lens_is_caught_and_the_part_that_is_wrong_is_named(tmp_path, kind):
    lines, wanted = PLANTED[kind]
    write_geometry_file(tmp_path / "true.toml", lines)
    code, summary = verified(tmp_path, 'true_geometry = "true.toml"')
    assert (code, summary["passed"]) == (1, False)
    causes = [
        line
        for line in summary["reasons"]
        if not line.startswith("centroids are") and "not where the sky" not in line
    ]
    assert all(re.match(pattern, line) for line, pattern in zip(causes, wanted, strict=True)), (
        causes
    )


def test_the_planted_sizes_are_in_the_json(tmp_path):
    write_geometry_file(tmp_path / "true.toml", "k1 = 0.6\ntilt_deg = [1.0, -0.7]")
    _, summary = verified(tmp_path, 'true_geometry = "true.toml"')
    assert summary["k1"] == pytest.approx(0.6, rel=0.01)
    assert summary["tilt_deg"] == pytest.approx([1.0, -0.7], rel=0.05)  # to first order in the tilt
    assert summary["scale_error"] == pytest.approx(0, abs=2e-4)


def test_a_mirror_is_named_behind_a_real_lens_too(tmp_path):
    write_geometry_file(tmp_path / "true.toml", "k1 = 0.6\nprincipal_point_px = [330, 245]")
    for mirror, word in (("x", "columns reversed"), ("swap", "axes swapped")):
        _, summary = verified(tmp_path, f'true_geometry = "true.toml"\ntrue_mirror = "{mirror}"')
        assert word in summary["reasons"][0]


def test_a_bench_that_knows_its_true_lens_passes(tmp_path):
    write_geometry_file(
        tmp_path / "true.toml", "k1 = 0.6\ntilt_deg = [1.0, -0.7]\nprincipal_point_px = [330, 245]"
    )
    known = ("[collimator]", '[collimator]\ngeometry = "true.toml"')
    code, summary = verified(tmp_path, 'true_geometry = "true.toml"', replace=known)
    assert (code, summary["reasons"], summary["lost"]) == (0, [], 0)
    assert summary["centroid_error_px"]["p95"] < 0.02


@pytest.mark.parametrize(
    ("verify", "word"),
    [
        ('true_calibration = "gamma2.2"', "response"),
        ('true_mirror = "swap"', "swapped"),
        ('true_mirror = "x"', "columns reversed"),
        ('true_mirror = "y"', "rows reversed"),
        ("true_focal_length_mm = 121.2", "plate scale is -0.9"),
        ("true_pixel_pitch_um = 58.2265", "plate scale is +1"),
        ("true_q_cam_to_mon = [0.99999, 0, 0, 0.00447]", "turned by"),
        ("true_q_cam_to_mon = [0.99999999, 0.0001, 0, 0]", "shifted by"),
        ("true_flux_at_white_e_per_s = 3e7", "flux_at_white"),
    ],
)
def test_a_wrong_bench_is_caught_and_the_cause_is_named(tmp_path, verify, word):
    code, summary = verified(tmp_path, verify)
    assert (code, summary["passed"]) == (1, False)
    assert word in " ".join(summary["reasons"])


def test_a_missing_black_level_is_caught(tmp_path):
    """The assumed file has the same response as the true one, and black without light."""
    light = srgb_response(10).light
    for name, black in (("true", 1e-3), ("assumed", 0.0)):
        rows = "\n".join(f"{code},{black + value!r}" for code, value in enumerate(light.tolist()))
        (tmp_path / f"{name}.csv").write_text(f"code,w\n{rows}\n")
        (tmp_path / f"{name}.toml").write_text(
            '[calibration]\nkind = "photometric"\nwho = "a test"\nwhen = "2026-11-21"\ninstrument'
            f' = "none"\nunit = "relative"\nbits = 10\nresponse = "{name}.csv"\n'
        )
    assumed = ("bits = 10", 'bits = 10\ncalibration = "assumed.toml"')
    code, summary = verified(tmp_path, 'true_calibration = "true.toml"', replace=assumed)
    assert (code, summary["passed"]) == (1, False)
    assert any("black" in reason for reason in summary["reasons"])
    assert summary["flux_error_mag"]["max"] < 0.02
    known = ("bits = 10", 'bits = 10\ncalibration = "true.toml"')
    code, summary = verified(tmp_path, replace=known)
    assert (code, summary["passed"]) == (0, True)
    assert summary["black_e_per_s_px"]["seen"] == summary["black_e_per_s_px"]["assumed"] > 1000


def test_a_bench_that_does_not_pass_is_still_a_command_that_is_done(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(BENCH + "[verify]\ncentroid_px = 1e-4\n")
    result = run_hilstar_here("verify", path, "--fields", "1")
    assert result.returncode == 0
    assert "NOT passed" in result.stdout


def test_limits_of_the_bench_file_are_obeyed(tmp_path):
    code, summary = verified(tmp_path, "centroid_px = 1e-4")
    assert code == 1
    assert "centroids" in summary["reasons"][0]


def test_exact_is_the_best_of_the_methods_in_a_frame_and_temporal_over_an_exposure(tmp_path):
    methods = ("dither", "round", "exact", "temporal")
    found = [verified(tmp_path, replace=('"exact"', f'"{method}"'))[1] for method in methods]
    rms_mag = [summary["flux_error_mag"]["rms"] for summary in found]
    assert max(rms_mag[:2]) > min(rms_mag[:2]) > rms_mag[2] > rms_mag[3]


def test_bit_stealing_with_another_monitor_s_primaries_is_still_measured(tmp_path):
    stolen = ('"exact"', '"exact"\nbit_stealing = true')
    code, summary = verified(tmp_path, 'true_calibration = "srgb"', replace=stolen)
    assert (code, summary["passed"]) == (0, True)


def test_charts_and_a_table_are_written(tmp_path):
    _, summary = verified(tmp_path, "", "-o", str(tmp_path / "out"))
    assert len(csv_rows(tmp_path / "out" / "stars.csv")) == summary["stars"]
    for name in ("errors.png", "field.png"):
        with Image.open(tmp_path / "out" / name) as picture:
            assert min(picture.size) > 500


def test_what_cannot_be_verified_gets_one_line(tmp_path):
    path = tmp_path / "bench.toml"
    for verify, said in (
        ('true_calibration = "nothing.toml"', "nothing.toml"),
        ('true_calibration = "lcd-example"', "bits"),
        ('true_mirror = "z"', "true_mirror"),
        ('true_geometry = "nothing.toml"', "nothing.toml"),
        ('true_geometry = "bench.toml"', "calibrate geometric"),
        (
            'true_geometry = "t.toml"\ntrue_focal_length_mm = 121',
            "true_geometry takes the place of true_focal_length_mm",
        ),
        ('true_geometry = "t.toml"\ntrue_pixel_pitch_um = 58', "true_pixel_pitch_um"),
        ('true_geometry = "t.toml"\ntrue_q_cam_to_mon = [1, 0, 0, 0]', "true_q_cam_to_mon"),
        ("true_focal_length_mm = -1", "true_focal_length_mm"),
        ("true_q_cam_to_mon = [2, 0, 0, 0]", "unit quaternion"),
    ):
        path.write_text(f"{BENCH}[verify]\n{verify}\n")
        assert_refused(run_hilstar_here("verify", path, "--fields", "1"), 2, said)


@pytest.mark.parametrize("option", ["--propose", "--write"])
def test_what_would_do_is_asked_of_frame_and_no_file_is_changed(tmp_path, option):
    path = tmp_path / "bench.toml"
    path.write_text(BENCH)
    refused = run_hilstar_here("verify", path, option)
    assert_refused(refused, 2, f"verify {option}: was removed; hilstar frame {path} --radec")
    assert "--explain" in refused.stderr
    assert "would_do" in refused.stderr
    assert path.read_text() == BENCH


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    path = tmp_path_factory.mktemp("twin") / "bench.toml"
    path.write_text(BENCH)
    twin = Twin(read_bench_file(path))
    yield twin
    twin.close()


def test_a_monitor_pixel_s_light_arrives_whole_and_where_it_belongs(twin):
    """Against the tangent-plane scale: 57.65 um / 120 mm over 13 um / 25 mm is 0.9239 tracker
    pixels a monitor pixel.
    """
    light = np.zeros((480, 640))
    light[300, 200] = 1e6
    image = twin.sky_optics.image_e_per_s(light)
    assert image.sum() == pytest.approx(1e6, rel=2e-6)
    y, x = np.mgrid[0:400, 0:400]
    scale = (57.65e-3 / 120) / (13e-3 / 25)
    assert (image * x).sum() / image.sum() == pytest.approx(
        199.5 + (200 - 319.5) * scale, abs=CUT_PX
    )
    assert (image * y).sum() / image.sum() == pytest.approx(
        199.5 + (300 - 239.5) * scale, abs=CUT_PX
    )
    # Its variance is the PSF's, a detector pixel's 1/12, and that of the square that a monitor
    # pixel is.
    wanted = 0.55**2 + 1 / 12 + scale**2 / 12
    assert (
        image * (x - (image * x).sum() / image.sum()) ** 2
    ).sum() / image.sum() == pytest.approx(wanted, rel=2e-3)


def test_the_black_level_s_glow_is_the_light_of_all_pixels(twin):
    grey = table_response(8, gamma_response(8).light, black=1e-3)
    glow = twin.sky_optics.glow_e_per_s(Panel(grey, 1e6))
    scale = (57.65e-3 / 120) / (13e-3 / 25)
    assert glow[200, 200] == pytest.approx(1e3 / scale**2, rel=1e-6)
    # The screen is 591 x 443 tracker pixels: wider than the detector, and higher.
    assert (glow > 0).all()
