"""What the tracker reads of a response is as far off as its errors say: noise, ratios of ranges,
rounding and black.
"""

from __future__ import annotations

import math
from contextlib import closing

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.display.calibration import (
    CalibrationHead,
    NotesTable,
    add_uniformity,
    load_calibration,
    read_toml,
    write_calibration,
)
from hilstar.display.geometry import monitor_camera
from hilstar.display.response import gamma_response, srgb_response
from hilstar.instruments.calibrate.first_light.context import StepContext
from hilstar.instruments.calibrate.first_light.image_sources import VirtualBench
from hilstar.instruments.calibrate.first_light.photometer import monitor_area
from hilstar.instruments.calibrate.first_light.photometry import photometry
from hilstar.instruments.calibrate.measurements import read_measurements
from hilstar.instruments.calibrate.photometric import fit_channel
from hilstar.instruments.calibrate.plan import PlanSettings, plan_patches
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.tracker.rounding import (
    before_adc_dn,
    cut_light,
    mean_rounding_error,
    rounding_error,
    rounding_rms,
)
from tests.support.bench_files import filed_bench
from tests.support.benches import TWIN
from tests.support.refusals import refusal
from tests.support.tables import write_readings

pytestmark = pytest.mark.usefixtures("without_charts")
BITS, BLACK, POWER = 8, 1e-3, 2.35
DECADES = (1e-1, 1e-2, 1e-3)
BRIGHT_BLACK = 0.01  # its noise is about 0.1 % of it
EDGE_FALL = 0.4  # of light from the middle of the screen to its corners
EVEN_ERROR = 0.001  # of the map of it, relative
SURE = 4.0  # sigmas: one figure in 16 000 is further off
# of sums of 200 terms of order 1, and of sines of 8 x 40 turns, in double precision
ROUNDING_DN = 1e-12
# Root mean square of figures in their sigmas: 1 for honest errors. 3 figures give it to 0.41.
MAX_RMS = 1.6
NOISY = {
    "gain_e_per_dn": 8.0,
    "read_noise_e": 12.0,
    "full_well_e": 30_000.0,
    "offset_dn": 40.0,
    "prnu": 0.005,
}
# Nothing spreads a level over the ADC's steps: the defaults of a bench file.
SILENT = {"gain_e_per_dn": 24.0, "read_noise_e": 0.0, "dark_e_per_s": 0.0, "offset_dn": 40.0}


def power_law_bench(folder, detector, collimator_mm=120, black=BLACK):
    """A bench file that supposes sRGB, and its truth: a power law with a black level."""
    light = gamma_response(BITS, POWER).light + black
    head = CalibrationHead(
        "photometric", "planted", "2026-11-28", "none", "relative", BITS, "true-response.csv"
    )
    write_calibration(folder / "true-light.toml", head, {"w": light}, 0.0, NotesTable())
    tables = {
        "monitor": {"bits": BITS},
        "tracker.detector": detector,
        "collimator": {"focal_length_mm": collimator_mm},
    }
    filed_bench(folder, TWIN, tables)
    true = tables | {"monitor": {"bits": BITS, "calibration": "true-light.toml"}}
    filed_bench(folder, TWIN, true, name="truth.toml")


def measured_light(folder, seed, sets_exposure=True, black=BLACK):
    """What the step comes to on the planted bench, and its figures in sigmas: the response by
    decades, and black.
    """
    file, true = (read_bench_file(folder / name) for name in ("bench.toml", "truth.toml"))
    source = VirtualBench(file, true, seed)
    source.sets_exposure = sets_exposure
    with closing(source):
        context = StepContext(file, folder, folder / f"images-{seed}", source, {}, {}, 96)
        outcome = photometry(context)
    assert outcome.verdict == "done", outcome.line
    response = load_calibration(folder / "response.toml", BITS).response
    light = gamma_response(BITS, POWER).light
    off = []
    for decade in DECADES:
        code = int(np.argmin(np.abs(light - decade)))
        error = float(outcome.figures[f"error_at_1e-{round(-math.log10(decade))}_percent"]) / 100
        off.append((response.light[code] / light[code] - 1) / error)
    off_black = (response.black - black) / read_toml(folder / "response.toml").errors.black
    return outcome, np.array(off), off_black


@pytest.mark.parametrize("detector", [NOISY, SILENT], ids=["noisy", "silent"])
def test_a_response_and_its_black_level_are_as_far_off_as_their_errors_say(detector, tmp_path):
    """The ratios of lattices, read once each, put all codes beside white up to 8 sigmas off, and
    black was 20 off.
    """
    power_law_bench(tmp_path, detector)
    _, off, off_black = measured_light(tmp_path, 0)
    assert np.sqrt(np.mean(np.square(off))) < MAX_RMS
    assert np.abs(off).max() < SURE
    assert abs(off_black) < SURE


def test_the_glow_of_a_screen_that_is_darker_at_its_edges_is_counted_by_its_light(tmp_path):
    """A black screen glows beyond the dots' square, where less light comes from: black was 0.5 %
    too low, 7 of its errors.
    """
    power_law_bench(tmp_path, NOISY, black=BRIGHT_BLACK)
    y, x = ((np.arange(count) + 0.5) / count * 2 - 1 for count in (9, 16))
    grid = 1 - EDGE_FALL * (x[None] ** 2 + y[:, None] ** 2) / 2
    add_uniformity(tmp_path / "true-light.toml", grid)
    head = CalibrationHead(
        "photometric", "planted", "2026-11-28", "none", "relative", BITS, "known.csv"
    )
    write_calibration(
        tmp_path / "known.toml", head, {"w": srgb_response(BITS).light}, 0.0, NotesTable()
    )
    add_uniformity(tmp_path / "known.toml", grid, EVEN_ERROR)
    tables = {"monitor": {"bits": BITS, "calibration": "known.toml"}, "tracker.detector": NOISY}
    tables["collimator"] = {"focal_length_mm": 120}
    filed_bench(tmp_path, TWIN, tables)
    _, off, black = measured_light(tmp_path, 0, black=BRIGHT_BLACK)
    assert np.abs(off).max() < SURE
    assert abs(black) < SURE
    error = read_toml(tmp_path / "response.toml").errors.black
    assert error > EVEN_ERROR * BRIGHT_BLACK  # the map's error is part of it
    assert error < 2 * EVEN_ERROR * BRIGHT_BLACK


def test_a_black_screen_that_saturates_the_tracker_is_named(tmp_path):
    """It was told as squares that are not in the image, and to expose longer."""
    power_law_bench(tmp_path, NOISY)
    file, true = (read_bench_file(tmp_path / name) for name in ("bench.toml", "truth.toml"))
    with closing(VirtualBench(file, true, 0)) as source:
        context = StepContext(file, tmp_path, tmp_path / "images", source, {}, {}, 96)
        dark = context.dark()
        full = np.full_like(context.read(dark), context.full_dn)
        assert "black screen fills the tracker to 100%" in refusal(context.looked, dark, full)


def test_a_tracker_without_noise_before_wide_pixels_gives_one_smooth_response(tmp_path):
    """A monitor pixel is 3.7 tracker pixels: no lattice is brighter than a lone pixel, and codes
    were read as 0 or 1 DN.
    """
    power_law_bench(tmp_path, SILENT, collimator_mm=30)
    outcome, off, black = measured_light(tmp_path, 0)
    assert np.abs(off).max() < SURE
    assert abs(black) < SURE
    assert float(outcome.figures["error_at_1e-3_percent"]) < 1.0
    assert "exposed 16 times longer" in (tmp_path / "measured.csv").read_text()


def test_what_rounding_takes_of_codes_that_cannot_be_exposed_longer_is_in_their_errors(tmp_path):
    power_law_bench(tmp_path, SILENT, collimator_mm=30)
    outcome, off, black = measured_light(tmp_path, 0, sets_exposure=False)
    assert np.abs(off).max() < SURE
    assert abs(black) < SURE
    # Half a step of the ADC, of codes whose peak is a few steps.
    assert float(outcome.figures["error_at_1e-3_percent"]) > 1.0


def test_a_cause_that_readings_share_is_in_the_error_of_the_response(tmp_path):
    """Codes below half were read in a range whose ratio is known to 1 %; each reading repeats to
    0.1 %.
    """
    ratios = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        patches = plan_patches(PlanSettings(BITS, repeats=1), rng)
        codes = np.array([patch.code for patch in patches])
        light = gamma_response(BITS, POWER).light[codes]
        faint = (codes < 128) & (codes > 0)
        value = (
            light
            * (1 + 0.001 * rng.standard_normal(len(codes)))
            * np.where(faint, 1 + 0.01 * rng.standard_normal(), 1)
        )
        rows = [
            (code, "w", one, 0.001 * one + 1e-7, 0.01 * one * below)
            for code, one, below in zip(codes, value, faint, strict=True)
        ]
        path = write_readings(tmp_path / "m.csv", rows, "code,channel,value,sigma,common_range")
        fit = fit_channel(read_measurements(path), "w")
        code = 60
        ratios.append(
            (fit.light[code] / gamma_response(BITS, POWER).light[code] - 1) / fit.error[code]
        )
    # 40 draws give an rms to 11 %; the fit takes most of the step away, for a power law is smooth.
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_a_cause_that_readings_share_is_in_a_level_s_error_by_what_white_has_not_of_it(tmp_path):
    """Light is relative to white. Of a cause that scales all light no level has a share; of one
    that white does not have, a level has its own.
    """
    codes = np.arange(0, 256, 15)
    light = gamma_response(BITS, POWER).light[codes]
    level_errors = []
    dark = 1 - codes / 255
    for name, share in (("alone", 0 * dark), ("scaled", 0.01 + 0 * dark), ("dark", 0.01 * dark)):
        rows = list(
            zip(codes, ["w"] * len(codes), light, 1e-3 * light + 1e-9, share * light, strict=True)
        )
        path = write_readings(tmp_path / f"{name}.csv", rows, "code,channel,value,sigma,common_1")
        level_errors.append(fit_channel(read_measurements(path), "w").level_error)
    alone, scaled, darker = level_errors
    # a share of 0.01 beside the levels' 0.001 would make them ten times as large
    np.testing.assert_allclose(scaled, alone, rtol=0.05)
    # the levels' own smoothness tells a part of it
    left = np.sqrt(darker[:-1] ** 2 - alone[:-1] ** 2) / dark[1:-1]
    np.testing.assert_allclose(left, left[0], rtol=0.02)
    assert 0.001 < left[0] < 0.01
    assert darker[-1] == pytest.approx(alone[-1], rel=1e-3)


@pytest.mark.parametrize("black_sigma", [1e-9, 1e-4])
def test_a_level_s_errors_are_its_own_the_black_s_and_the_share_that_it_has_in_the_fit(
    tmp_path, black_sigma
):
    """Stated readings of a curve without scatter: the levels' shares in a linear fit sum to its
    parameters.
    """
    relative = 1e-3
    codes = np.arange(0, 256, 15)
    light = gamma_response(BITS, POWER).light[codes]
    sigma = np.where(codes > 0, relative * light, black_sigma)
    rows = list(zip(codes.tolist(), ["w"] * len(codes), light + BLACK, sigma, strict=True))
    path = write_readings(tmp_path / "m.csv", rows, "code,channel,value,sigma")
    fit = fit_channel(read_measurements(path), "w")
    np.testing.assert_allclose(
        fit.level_error, np.hypot(relative, black_sigma / light[1:]), rtol=1e-3
    )
    share = 1 - (relative / fit.residual_error) ** 2
    assert share.sum() == pytest.approx(fit.parameters, abs=1e-2)


def test_levels_that_no_smooth_curve_meets_have_larger_errors(tmp_path):
    """Stated errors of 0.01 % and a scatter of 0.5 %: the errors grow by what the levels are
    off.
    """
    rng = np.random.default_rng(1)
    codes = np.repeat(np.arange(0, 256, 15), 2)
    scatter = np.repeat(1 + 0.005 * rng.standard_normal(18), 2)
    light = gamma_response(BITS, POWER).light[codes] * scatter
    rows = [(code, "w", one, 1e-4 * one + 1e-9) for code, one in zip(codes, light, strict=True)]
    fit = fit_channel(
        read_measurements(write_readings(tmp_path / "m.csv", rows, "code,channel,value,sigma")), "w"
    )
    codes = np.arange(40, 255)
    off = fit.light[codes] / gamma_response(BITS, POWER).light[codes] - 1
    assert fit.lack_of_fit > 10
    # means of two readings of 0.01 %, as far as levels are off the fit
    alone = 1e-4 / math.sqrt(2)
    np.testing.assert_allclose(fit.level_error, fit.lack_of_fit * alone, rtol=0.05)
    assert np.abs(off / fit.error[codes]).max() < SURE


def test_rounding_is_that_of_levels_in_noise():
    rng = np.random.default_rng(2)
    level = np.linspace(0, 1, 9)
    for noise_dn in (0.15, 0.3, 0.5):
        read = np.rint(level + noise_dn * rng.standard_normal((200_000, 9)))
        assert rounding_error(level, np.array(noise_dn)) == pytest.approx(
            read.mean(axis=0) - level, abs=0.005
        )
    assert rounding_rms(0.0) == pytest.approx(1 / math.sqrt(12), rel=0.04)
    assert rounding_rms(0.6) < 1e-3


def test_a_mean_over_pixels_is_that_of_each_pixel_s_own_rounding(rng):
    """At each place of the dark level, with noise that the light of each pixel adds to."""
    light_dn = rng.uniform(0.0, 40.0, 200)
    noise_dn = np.sqrt(0.1**2 + 1e-3 * light_dn)
    places_dn = np.arange(5) / 5
    each_dn = rounding_error(places_dn[:, None] + light_dn, noise_dn)
    mean_dn = mean_rounding_error(places_dn, light_dn, noise_dn)
    assert mean_dn == pytest.approx(each_dn.mean(axis=1), abs=ROUNDING_DN)
    assert np.abs(mean_dn).max() > 1e3 * ROUNDING_DN


@pytest.mark.parametrize("noise_dn", [0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7])
def test_no_level_is_rounded_by_far_more_than_the_noise_of_its_readings_says(noise_dn):
    """A level half way between two codes scatters by half a DN with hardly any noise. Taken for
    noise that spreads it over the steps, it gave a black level that was 5 of its sigmas off.
    """
    # An error of rounding is at most sqrt 3 times its rms over the levels, a sawtooth's.
    largest_of_rms, codes = math.sqrt(3), np.arange(-8, 10)
    for level in np.linspace(0, 1, 41):
        below = ndtr((codes[:, None] + np.array([-0.5, 0.5]) - level) / noise_dn)
        share = np.diff(below, axis=1)[:, 0]
        mean = float(share @ codes)
        variance = float(share @ (codes - mean) ** 2)
        found_dn = before_adc_dn(variance, stated_dn=noise_dn)
        assert abs(mean - level) < 1.05 * largest_of_rms * rounding_rms(found_dn) + 1e-4
        assert before_adc_dn(variance, math.inf) == math.sqrt(max(variance - 1 / 12, 0))
    # Noise that spreads a level is found by its readings, whatever is stated.
    assert before_adc_dn(0.7**2 + 1 / 12, stated_dn=0.1) == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("dark_dn", "noise_dn", "light_dn"), [(0.0, 0.63, 2.0), (0.2, 0.63, 0.3), (-0.3, 1.5, 10.0)]
)
def test_the_cut_at_code_0_is_that_of_noise_that_an_adc_reads(dark_dn, noise_dn, light_dn):
    """Of two million pixels each, dark and lit, with shot noise of 24 e- a DN."""
    rng = np.random.default_rng(1)
    count = 2_000_000
    spread_dn = math.hypot(noise_dn, math.sqrt(light_dn / 24))
    dark = np.maximum(np.rint(dark_dn + noise_dn * rng.standard_normal(count)), 0)
    lit = np.maximum(np.rint(dark_dn + light_dn + spread_dn * rng.standard_normal(count)), 0)
    added_dn = float(lit.mean() - dark.mean()) - light_dn
    assert added_dn < -0.05
    assert cut_light(np.array([light_dn]), float(dark.mean()), noise_dn, 1 / 24) == pytest.approx(
        added_dn, rel=0.06
    )


def test_an_adc_with_an_offset_cuts_nothing():
    assert cut_light(np.array([2.0]), 64.0, 0.63, 1 / 24) == 0.0
    assert cut_light(np.array([2.0]), 0.0, 0.0, 1 / 24) == 0.0


def test_the_monitor_pixels_that_a_tilted_screen_shows_are_counted():
    """A detector over the screen's edge: what it sees of the screen, and no more."""
    q = np.array([math.cos(0.02), math.sin(0.02), 0.0, 0.0])
    monitor = monitor_camera((640, 480), 57.65, 120, np.array([1.0, 0, 0, 0]))
    geometry = BenchGeometry(monitor, monitor_camera((400, 400), 13, 25, q))
    area = monitor_area(geometry, slice(0, 400), slice(0, 400))
    y, x = np.mgrid[0:480, 0:640].astype(float)
    seen = np.stack(geometry.to_tracker(x.ravel(), y.ravel()))
    inside = ((seen > -0.5) & (seen < 399.5)).all(axis=0).sum()
    assert area == pytest.approx(inside, rel=3e-3)
