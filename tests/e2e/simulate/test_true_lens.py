"""From a traced bench through its dots and its geometry file to the twin's verdict; and a
tracker with a flight model.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from astropy.io import fits

from hilstar.basics.errors import InputError
from hilstar.basics.files import check_outputs, files_named_in
from hilstar.display.geometry import monitor_camera
from hilstar.instruments.calibrate.geometric.dots import plan_dots
from hilstar.instruments.calibrate.geometric.fit import Nominal
from hilstar.instruments.calibrate.geometric.geometry_fit import (
    calibrate_geometry,
    write_calibrated,
)
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.benches import bench_text
from tests.support.commands import run_hilstar_here
from tests.support.traced_bench import TracedBench, observed_dots

ALIGNED = np.array([1.0, 0.0, 0.0, 0.0])
# A collimator of 350 mm before a monitor of 960 x 720: 9 degrees, which the tracker's 10 cover.
TRACED = TracedBench(
    resolution_px=(960, 720),
    screen_tilt_deg=(1.0, 0.3, 0.05),
    screen_shift_mm=(0.05, 0.03),
    lens_shift_mm=(0.8, -0.5),
)
TRACKER_MM, TRACKER_PX, PITCH_UM = 70.0, 1000, 13.0
BENCH = bench_text(
    {
        "tracker": {
            "focal_length_mm": TRACKER_MM,
            "resolution_px": [TRACKER_PX, TRACKER_PX],
            "transmission": None,
            "distortion": "flight.toml",
        },
        "sky": {"faintest_v_mag": 6.5},
        "monitor": {
            "resolution_px": list(TRACED.resolution_px),
            "pixel_pitch_um": TRACED.pitch_mm * 1e3,
            "bits": 10,
        },
        "collimator": {"focal_length_mm": TRACED.focal_mm},
        "render": {"quantisation": "exact"},
    }
)
# frames, dots, noise in px: as good as the truth, and of an afternoon
TRUTH, MEASURED = (24, 60, 1e-3), (10, 25, 0.05)


def calibrated(path, case, rng):
    """A geometry file of the traced bench, by what a tracker sees of its dots."""
    frames, dots, noise_px = case
    tracker = monitor_camera((TRACKER_PX, TRACKER_PX), PITCH_UM, TRACKER_MM, ALIGNED)
    nominal = Nominal(
        monitor_camera(TRACED.resolution_px, TRACED.pitch_mm * 1e3, TRACED.focal_mm, ALIGNED),
        ALIGNED,
        tracker,
    )
    plan = plan_dots(TRACED.resolution_px, frames, dots, np.random.default_rng(0))
    seen = observed_dots(TRACED, plan, tracker, rng, noise_px)
    write_calibrated(path, calibrate_geometry(plan, nominal, seen, rng, tracker_known=True), None)


def verify_verdict(path):
    result = run_hilstar_here("verify", path, "--fields", "6", "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_a_traced_bench_fails_as_assumed_and_passes_once_its_dots_are_measured(tmp_path, rng):
    calibrated(tmp_path / "truth.toml", TRUTH, rng)
    calibrated(tmp_path / "geometry.toml", MEASURED, rng)
    (tmp_path / "flight.toml").write_text("k1 = 0.0\n")
    path = tmp_path / "bench.toml"
    path.write_text(BENCH + '[verify]\ntrue_geometry = "truth.toml"\n')
    before = verify_verdict(path)
    assert not before["passed"]
    assert any(
        "tilted by" in reason and "calibrate geometric" in reason for reason in before["reasons"]
    ), before["reasons"]
    path.write_text(
        path.read_text().replace("[collimator]", '[collimator]\ngeometry = "geometry.toml"')
    )
    after = verify_verdict(path)
    assert after["centroid_error_px"]["p95"] < 0.1, after["reasons"]
    assert not any(
        "calibrate geometric" in r or "centroids" in r or "not where" in r for r in after["reasons"]
    )
    assert before["stars"] + before["lost"] > 30


def test_a_virtual_tracker_has_its_flight_model_in_truth_pixels_and_header(tmp_path):
    (tmp_path / "flight.toml").write_text("k1 = -0.3\nk2 = 0.1\np1 = 2e-3\np2 = -1e-3\n")
    path = tmp_path / "bench.toml"
    path.write_text(BENCH.replace("[tracker]", "[tracker]\nprincipal_point_px = [510.5, 488.0]"))
    result = run_hilstar_here(
        "simulate", path, "--radec", "84.057,-1.2,0", "--noise", "none", "-o", tmp_path / "dn.fits"
    )
    assert result.returncode == 0, result.stderr
    with fits.open(tmp_path / "dn.fits") as hdus:
        header, dn, truth = hdus[0].header, hdus[0].data.astype(float), hdus[1].data
    assert header["LENS"] is True
    assert (header["CRPIX1"], header["CRPIX2"]) == (511.5, 489.0)
    # Undo the TAN plane: the same bench with an ideal tracker gives the tangents.
    (tmp_path / "ideal").mkdir()
    (tmp_path / "ideal" / "flight.toml").write_text("k1 = 0.0\n")
    ideal = tmp_path / "ideal" / "bench.toml"
    ideal.write_text(path.read_text())
    run_hilstar_here(
        f"simulate {ideal} --radec 84.057,-1.2,0 --noise none -o {tmp_path}/ideal.fits"
    )
    plain = {row["hip"]: row for row in fits.getdata(tmp_path / "ideal.fits", 1)}
    focal_px = TRACKER_MM * 1e3 / PITCH_UM
    off_px = []
    for row in truth:
        if row["hip"] not in plain:
            continue
        u, v = (
            (plain[row["hip"]][name] - centre) / focal_px
            for name, centre in (("x_px", 510.5), ("y_px", 488.0))
        )
        r2 = u * u + v * v
        gain = 1 - 0.3 * r2 + 0.1 * r2**2
        x = focal_px * (u * gain + 2 * 2e-3 * u * v - 1e-3 * (r2 + 2 * u * u)) + 510.5
        y = focal_px * (v * gain + 2e-3 * (r2 + 2 * v * v) - 2 * 1e-3 * u * v) + 488.0
        assert (row["x_px"], row["y_px"]) == pytest.approx((x, y), abs=1e-6)
        c, r = round(x), round(y)
        if (
            4 < c < TRACKER_PX - 5
            and 4 < r < TRACKER_PX - 5
            and row["v_mag"] < 5.5
            and not row["clipped"]
        ):
            window = dn[r - 3 : r + 4, c - 3 : c + 4] - np.median(dn)
            off_px.append((window * np.arange(-3, 4)).sum() / window.sum() + c - x)
    assert len(off_px) > 5
    assert np.median(np.abs(off_px)) < 0.1  # moments of whole DN; the lens bends by up to 1 px


def test_the_bench_s_hash_covers_its_lenses_and_they_are_protected_as_inputs(tmp_path):
    path = tmp_path / "bench.toml"
    names = {
        "[collimator]": ("geometry", "geometry.toml"),
        "[verify]": ("true_geometry", "true.toml"),
    }
    text = BENCH + "[verify]\n"
    for table, (key, name) in names.items():
        text = text.replace(table, f'{table}\n{key} = "{name}"')
    path.write_text(text)
    seen = set()
    for content in ("k1 = 0.1\n", "k1 = 0.2\n"):
        for name in ("flight.toml", "geometry.toml", "true.toml"):
            (tmp_path / name).write_text(content)
            seen.add(read_bench_file(path).sha256)
    assert len(seen) == 6
    named = files_named_in(path)
    for name in ("flight.toml", "geometry.toml", "true.toml"):
        assert tmp_path / name in named
        with pytest.raises(InputError, match=name):
            check_outputs(named, [tmp_path / name])
