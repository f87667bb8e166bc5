"""The monitor's light from the command line: what it can show, what was measured of it, what
white is worth.
"""

from __future__ import annotations

import csv
import json
import math
import re

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image
from scipy.spatial.transform import Rotation

import hilstar
from hilstar.display.calibration import load_calibration
from hilstar.instruments.simulate.budget import budget, zero_point_mag
from hilstar.optics.psf import GaussianPsf, pixel_share
from hilstar.server.bench.config import read_config
from hilstar.server.bench.frame import clipping_hip
from tests.support.benches import ROOT, SMALL_BENCH, bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.tables import csv_rows

EXACT = '[render]\nquantisation = "exact"\n'
# 1 % noise on one reading: the response of the example comes back within 1 % at nearly every code,
# 3 % at any.
RESPONSE_ERROR = 0.03


def of_json(*arguments: object) -> dict:
    result = run_hilstar_here(*arguments, "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_where_a_star_clips_and_where_it_shows_nothing_is_where_frames_say_so(bench_with):
    """A bench whose stars are all of the Sun's colour: at the magnitude where a star clips its
    peak is white.
    """
    bench = bench_with('[render]\nquantisation = "round"\nflux_at_white_e_per_s = 1e8\n')
    found = budget(bench)
    zero_mag = zero_point_mag(bench.stars)
    white_rate, dark_rate = (
        10 ** (0.4 * (zero_mag - v)) for v in (found.clips_v_mag, found.nothing_v_mag)
    )
    assert white_rate * GaussianPsf((0.85, 0.85)).peak_share == pytest.approx(1e8, rel=1e-12)
    half_code = 0.5 / 255 / 12.92
    assert dark_rate * GaussianPsf((0.85, 0.85)).peak_share == pytest.approx(
        1e8 * half_code, rel=1e-12
    )
    corner = 10 ** (0.4 * (zero_mag - found.clips_v_mag_at_best)) * pixel_share(0.5, 0.85) ** 2
    assert corner == pytest.approx(1e8, rel=1e-9)
    clipped = bench.stars.hip[
        bench.stars.electrons_per_s * GaussianPsf((0.85, 0.85)).peak_share > 1e8
    ]
    assert sorted(found.clipped_hip) == sorted(clipped.tolist())
    assert found.range_mag == pytest.approx(-2.5 * math.log10(half_code))
    rates = bench.stars.electrons_per_s
    assert found.left_out.stars == int((rates < dark_rate * (1 - 1e-12)).sum())
    assert 0 < found.left_out.flux_share < 0.5


def test_the_error_of_round_is_that_of_brute_force(bench_with):
    """Five magnitudes under white, at 16 x 16 phases, pixel by pixel in plain Python."""
    bench = bench_with('[render]\nquantisation = "round"\n')
    row = next(row for row in budget(bench).rows if row.below_white_mag == 5.0)
    peak = GaussianPsf((0.85, 0.85)).peak_share
    total = 10 ** (-0.4 * 5) / peak
    errors = []
    for fx in (np.arange(16) + 0.5) / 16 - 0.5:
        for fy in (np.arange(16) + 0.5) / 16 - 0.5:
            x, y = (np.array([pixel_share(k - f, 0.85) for k in range(-7, 8)]) for f in (fx, fy))
            light = total * np.outer(y, x)
            signal = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
            codes = np.rint(signal * 255) / 255
            shown = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
            errors.append(2.5 * np.log10(shown.sum() / total))
    assert row.flux_rms_mag == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=2e-3)
    assert row.flux_max_mag == pytest.approx(np.abs(errors).max(), rel=2e-3)


def test_budget_writes_its_chart_and_table(tmp_path, small_bench_file):
    small_bench_file.write_text(SMALL_BENCH + EXACT)
    found = of_json("budget", small_bench_file, "-o", tmp_path / "out")
    assert found["method"] == "exact"
    assert found["within"]["0.05_mag"] >= 6
    assert len(csv_rows(tmp_path / "out" / "budget.csv")) == len(found["rows"])
    with Image.open(tmp_path / "out" / "budget.png") as picture:
        assert min(picture.size) > 500
    spoken = run_hilstar_here("budget", small_bench_file)
    assert "shows nothing" in spoken.stdout


def test_a_formula_s_shares_of_white_are_said_to_be_assumed(tmp_path):
    path = tmp_path / "bench.toml"
    for calibration, assumed in (("srgb", True), ("lcd-example", False)):
        path.write_text(
            bench_text({"monitor": {"calibration": calibration}, "render": {"bit_stealing": True}})
        )
        told = run_hilstar_here("budget", path)
        assert told.returncode == 0, told.stderr
        assert ("as 0.2126, 0.7152, 0.0722 of red, green and blue" in told.stderr) is assumed
        lines = [line for line in told.stderr.splitlines() if "star_sigma_ratio" not in line]
        assert len(lines) == assumed


@pytest.mark.usefixtures("without_charts")
def test_budget_has_every_centroider_and_takes_the_bench_s_own(tmp_path, small_bench_file):
    fit = of_json("budget", small_bench_file, "-o", tmp_path / "out")
    assert fit["centroider"] == "fit"
    row = fit["rows"][12]
    assert set(row["axis_rms_px"]) == {"moment", "window", "wide", "fit", "box3", "box5"}
    assert (
        row["axis_rms_px"] == fit["centroid_rms_px"] and len(set(row["axis_rms_px"].values())) == 6
    )
    assert row["centroid_rms_px"] == pytest.approx(math.sqrt(2) * row["axis_rms_px"]["fit"])
    written = csv_rows(tmp_path / "out" / "budget.csv")[12]
    assert float(written["axis_rms_px_box5"]) == pytest.approx(row["axis_rms_px"]["box5"])
    small_bench_file.write_text(small_bench_file.read_text() + '[verify]\ncentroider = "box5"\n')
    own, every = (
        of_json("budget", small_bench_file),
        of_json("budget", small_bench_file, "--centroider", "all"),
    )
    assert own["centroider"] == "box5"
    assert own["rows"][12]["centroid_rms_px"] == pytest.approx(
        math.sqrt(2) * own["rows"][12]["axis_rms_px"]["box5"]
    )
    pairs = zip(every["rows"][:-1], own["rows"][:-1], strict=True)
    assert all(worst["centroid_max_px"] >= one["centroid_max_px"] for worst, one in pairs)
    said = run_hilstar_here("budget", small_bench_file, "--centroider", "all").stdout
    assert "   moment   window     wide      fit     box3     box5   max px" in said
    assert_refused(
        run_hilstar_here("budget", small_bench_file, "--centroider", "psf"), 2, "box5, all"
    )


@pytest.mark.parametrize("method", ["dither", "temporal"])
def test_every_method_has_a_budget(small_bench_file, method):
    small_bench_file.write_text(SMALL_BENCH + f'[render]\nquantisation = "{method}"\n')
    assert of_json("budget", small_bench_file)["left_out"]["stars"] == 0


def test_white_is_the_brightest_star_wanted(bench_with):
    bench = bench_with("[render]\nbrightest_v_mag = 1.0\n")
    stars = bench.stars
    wanted = stars.electrons_per_s[stars.v_mag >= 1.0].max()
    assert bench.flux_at_white_e_per_s == pytest.approx(
        wanted * GaussianPsf((0.85, 0.85)).peak_share, rel=1e-15
    )
    assert 32349 in budget(bench).clipped_hip  # Sirius


def test_the_white_of_a_file_that_gives_none_leaves_codes_for_most_fields(tmp_path):
    """The shortest bench file: with Sirius for white the brightest of 255 codes is 38 in the
    median field.
    """
    bench_file = tmp_path / "wide.toml"
    bench_file.write_text(
        SMALL_BENCH.replace("[320, 240]", "[1920, 1080]").replace("= 60", "= 350")
    )
    fields = Rotation.random(30, random_state=1).as_quat(scalar_first=True)
    with hilstar.load(bench_file) as bench:
        brightest, clipped = [], 0
        for q in fields:
            drawn = bench.draw(q)
            brightest.append(int(drawn.levels.max()))
            clipped += bool(drawn.clipped_hip)
        assert np.median(brightest) > 80
        assert clipped <= len(fields) / 5
        assert 1 <= len(clipping_hip(bench)) <= 21


def test_a_run_names_the_stars_that_clip_and_a_bench_without_such_stars_says_nothing(
    small_bench_file,
):
    small_bench_file.write_text(SMALL_BENCH + '[attitude]\nendpoint = "tcp://127.0.0.1:5599"\n')
    spoken = run_hilstar_here("serve", small_bench_file, "--headless", "--frames", "1")
    assert (
        "13 stars" in spoken.stderr
        and "HIP 32349, 30438" in spoken.stderr
        and "brightest_v_mag = 1.5" in spoken.stderr
    )
    small_bench_file.write_text(small_bench_file.read_text() + "[render]\nbrightest_v_mag = -2\n")
    assert (
        "HIP"
        not in run_hilstar_here("serve", small_bench_file, "--headless", "--frames", "1").stderr
    )


def test_a_sky_of_the_brightest_stars_alone_has_a_white(bench_with):
    """Of the stars to V = 1 none is as faint as the default white."""
    bench = bench_with("[sky]\nfaintest_v_mag = 1.0\n")
    assert (
        bench.flux_at_white_e_per_s
        == bench.stars.electrons_per_s.max() * GaussianPsf((0.85, 0.85)).peak_share
    )
    assert clipping_hip(bench) == []


def test_two_whites_or_none_get_one_line(small_bench_file):
    for render, said in (
        ("brightest_v_mag = 1\nflux_at_white_e_per_s = 1e6", "write one of them"),
        ("brightest_v_mag = 20", "brightest_v_mag leaves no star"),
    ):
        small_bench_file.write_text(f"{SMALL_BENCH}\n[render]\n{render}\n")
        assert_refused(run_hilstar_here("budget", small_bench_file), 2, said)


def test_a_monitor_that_is_30_percent_too_bright_is_found_by_the_tracker(
    tmp_path, small_bench_file
):
    """Readings of three stars as a tracker would give them, and a copy of the bench file,
    comments kept.
    """
    small_bench_file.write_text(
        SMALL_BENCH + "[render]  # how light becomes codes\nsprite_sigma_px = [0.9, 0.9]  # wide\n"
    )
    with hilstar.load(small_bench_file) as bench:
        white = bench.flux_at_white_e_per_s
        rates = {
            hip: float(bench.stars.electrons_per_s[bench.stars.hip == hip][0])
            for hip in (26311, 26727, 25930)
        }
    readings = [f"--reading={hip},{1.3 * rate * 0.1 / 24:.3f}" for hip, rate in rates.items()]
    found = of_json(
        "calibrate", "scale", small_bench_file, *readings, "-o", tmp_path / "scaled.toml"
    )
    assert found["flux_at_white_e_per_s"] == pytest.approx(1.3 * white, rel=1e-3)
    assert found["scatter_mag"] < 1e-3
    text = (tmp_path / "scaled.toml").read_text()
    assert "# how light becomes codes" in text
    assert "# wide" in text
    with hilstar.load(tmp_path / "scaled.toml") as bench:
        assert bench.flux_at_white_e_per_s == found["flux_at_white_e_per_s"]
        assert bench.config.render.sprite_sigma_px == (0.9, 0.9)
    again = of_json(
        f"calibrate scale {tmp_path}/scaled.toml --reading 26311,1000 -o {tmp_path}/third.toml"
    )
    assert (tmp_path / "third.toml").read_text().count("flux_at_white_e_per_s") == 1
    assert again["assumed_e_per_s"] == found["flux_at_white_e_per_s"]


def test_readings_that_disagree_are_said_to(small_bench_file):
    words = ("--reading", "26311,1000", "--reading", "26727,3000", "--reading", "25930,900")
    scaled = small_bench_file.with_name("scaled.toml")
    result = run_hilstar_here("calibrate", "scale", small_bench_file, *words, "-o", scaled)
    assert result.returncode == 0
    assert "disagree" in result.stderr
    # three readings leave two degrees of freedom, as they are printed and as they are written
    assert "flux_at_white_dof = 2\n" in result.stdout
    assert read_config(scaled).certify.flux_at_white_dof == 2


def test_plan_measure_fit_and_show_go_round(tmp_path, small_bench_file, rng):
    """The example monitor, measured by its own plan with 1 % of noise, comes back; frames record
    its file's hash.
    """
    plan = tmp_path / "plan.csv"
    planned = of_json(
        "calibrate", "plan", "-o", plan, "--headless", tmp_path / "patches", "--resolution", "64,48"
    )
    true = load_calibration("lcd-example", 8).response
    rows = csv_rows(plan)
    assert len(rows) == planned["patches"]
    assert (
        len(list((tmp_path / "patches").glob("*.png"))) == len({row["code"] for row in rows}) >= 32
    )
    for row in rows:
        light = 250 * (true.black + true.light[int(row["code"])]) / (1 + true.black)
        row["value"] = f"{light * (1 + 0.01 * rng.normal()):.6g}"
    with (tmp_path / "measured.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    fitted = of_json(
        f"calibrate photometric {tmp_path}/measured.csv -o {tmp_path}/monitor.toml --plot "
        f"{tmp_path}/fit.png"
    )
    assert fitted["noise_relative"] == pytest.approx(0.01, rel=0.2)
    response = load_calibration(tmp_path / "monitor.toml", 8).response
    bright = true.light >= 1e-3
    assert np.abs(response.light[bright] / true.light[bright] - 1).max() < RESPONSE_ERROR
    assert response.black == pytest.approx(true.black, rel=0.03)
    small_bench_file.write_text(
        SMALL_BENCH.replace("[collimator]", 'calibration = "monitor.toml"\n[collimator]')
    )
    shot = run_hilstar_here(
        "frame", small_bench_file, "--radec", "84,-1,0", "-o", tmp_path / "out.fits"
    )
    assert shot.returncode == 0, shot.stderr
    assert fits.getheader(tmp_path / "out.fits")["CALSHA"] == fitted["sha256"]


def test_the_commands_and_the_figures_of_the_calibration_page_are_true(tmp_path):
    """Its two commands as they stand, in turn; the plan is filled in as the page says."""
    page = (ROOT / "configs" / "CALIBRATION.md").read_text()
    plan, fit = (line.split("  ")[0] for line in re.findall(r"(?m)^    hilstar (.*)", page))
    planned = run_hilstar_here(*plan.split(), cwd=tmp_path)
    assert planned.returncode == 0, planned.stderr
    codes, patches = re.search(r"(\d+) codes, in (\d+) patches", page).groups()
    assert planned.stdout.startswith(f"{patches} patches of {codes} codes in PLAN.csv")
    assert len(list((tmp_path / "PATCHES").glob("*.png"))) == int(codes)
    true = load_calibration("lcd-example", 8).response
    rows = csv_rows(tmp_path / "PLAN.csv")
    lines = [
        f"{row['order']},{row['code']},w,{float(true.black + true.light[int(row['code'])])!r}"
        for row in rows
    ]
    (tmp_path / "MEASURED.csv").write_text("\n".join(["order,code,channel,value", *lines]))
    fitted = run_hilstar_here(*fit.split(), cwd=tmp_path)
    assert fitted.returncode == 0, fitted.stderr


def test_the_words_of_a_calibration_say_what_to_write(tmp_path):
    light = load_calibration("gamma2.2", 8).response.light
    codes = [0, *range(5, 256, 10)]
    lines = [
        "code,channel,value",
        *(f"{code},w,{light[code] * 100 + 0.1:.5f}" for code in codes for _ in range(2)),
    ]
    (tmp_path / "m.csv").write_text("\n".join(lines))
    result = run_hilstar_here(
        "calibrate", "photometric", tmp_path / "m.csv", "-o", tmp_path / "mon.toml"
    )
    assert result.returncode == 0, result.stderr
    assert 'calibration = "mon.toml"' in result.stdout
    assert "contrast 1 : " in result.stdout
