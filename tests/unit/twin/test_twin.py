"""The digital twin's parts: its optics against NumPy, which stars it judges, and what it says of what it finds."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.bench.bench_file import read_bench_file
from hilstar.bench.config import read_config
from hilstar.errors import InputError
from hilstar.monitor.geometry import monitor_camera
from hilstar.monitor.quantise import Panel
from hilstar.monitor.response import bit_stealing as stolen
from hilstar.monitor.response import gamma_response, srgb_response, table_response
from hilstar.rotation import to_matrix
from hilstar.tracker.centroids import Centroids
from hilstar.twin import verify as twin
from hilstar.twin.optics import Mounting, TwinOptics
from hilstar.twin.verdict import Star, fit_geometry, judge, median, spread
from hilstar.twin.verify import Field, Tally, Twin, crowded, levels_of, nearest, on_screen_median, shared, verify
from tests.support.benches import TWIN, bench_text

TRACKER_PX = (60, 50)
PSF_PX = (0.55, 0.6)
SIDE = 24  # squares along a monitor pixel in the oracle
# Each of a pixel's nine sprites is cut at 1e-6 of its light, and summed in float32, 6e-8 a sum.
CUT = 2e-6
# Nine Gaussians for a square have its variance and not its fourth moment: measured 1.3e-4 of the brightest pixel.
NINE_FOR_A_SQUARE = 2e-4


def bench_file(directory: Path, verify_lines: str = "", **changes: object) -> Path:
    """A bench of the twin with other exposure, monitor, bits, calibration or quantisation."""
    values = {"exposure_s": 0.1, "monitor_px": [480, 400], "bits": 10, "calibration": "srgb", "method": "exact", **changes}
    tables = {
        "tracker": {"resolution_px": [300, 300], "exposure_s": values["exposure_s"]},
        "monitor": {"resolution_px": values["monitor_px"], "bits": values["bits"], "calibration": values["calibration"]},
        "render": {"quantisation": values["method"]},
    }
    path = directory / "bench.toml"
    path.write_text(f"{bench_text(TWIN, tables)}[verify]\n{verify_lines}")
    return path


@pytest.fixture
def mounting():
    """A monitor of 0.9 tracker pixels a pixel, turned by 7 degrees and tilted by 0.2 and 0.1."""
    tracker = monitor_camera(TRACKER_PX, 13.0, 25.0, np.array([1.0, 0.0, 0.0, 0.0]))
    angles = np.radians([0.2, -0.1, 7.0]) / 2
    monitor = monitor_camera((64, 48), 57.65, 120.0, np.array([1.0, *angles]) / math.hypot(1.0, *angles), (30.0, 25.0))
    return Mounting(monitor, tracker)


def oracle(mounting: Mounting, light: np.ndarray) -> np.ndarray:
    """The tracker's image by NumPy alone: SIDE^2 points a lit pixel, each a Gaussian integrated over every tracker pixel."""
    image = np.zeros(TRACKER_PX[::-1])
    steps = (np.arange(SIDE) + 0.5) / SIDE - 0.5
    turn = to_matrix_of(mounting)
    for row, column in zip(*np.nonzero(light), strict=True):
        x, y = (part.ravel() for part in np.meshgrid(column + steps, row + steps))
        cx, cy = mounting.monitor.principal_point_px
        f_mon, f_trk = 120e3 / 57.65, 25e3 / 13.0
        ray = np.stack([(x - cx) / f_mon, (y - cy) / f_mon, np.ones_like(x)]).T @ turn
        at_x, at_y = (f_trk * ray[:, k] / ray[:, 2] + (TRACKER_PX[k] - 1) / 2 for k in (0, 1))
        shares = []
        for place, size, sigma in ((at_x, TRACKER_PX[0], PSF_PX[0]), (at_y, TRACKER_PX[1], PSF_PX[1])):
            edges = np.arange(size + 1) - 0.5 - place[:, None]
            shares.append(np.diff(ndtr(edges / sigma), axis=1))
        image += light[row, column] / SIDE**2 * shares[1].T @ shares[0]
    return image


def to_matrix_of(mounting: Mounting) -> np.ndarray:
    angles = np.radians([0.2, -0.1, 7.0]) / 2
    matrix = to_matrix(np.array([1.0, *angles]) / math.hypot(1.0, *angles))
    assert np.allclose(matrix, mounting.monitor.cam_to_image)
    return matrix


def test_the_monitor_s_light_is_an_independent_sum_of_squares_through_both_lenses(mounting, rng):
    light = np.zeros((48, 64))
    light[14:34, 20:44] = rng.uniform(0, 1e6, (20, 24)) * (rng.random((20, 24)) < 0.1)
    with TwinOptics(mounting, PSF_PX) as optics:
        image = optics.image_e_per_s(light)
    wanted = oracle(mounting, light)
    assert wanted.sum() == pytest.approx(light.sum(), rel=1e-9)
    assert image.sum() == pytest.approx(light.sum(), rel=CUT)
    assert np.abs(image - wanted).max() < NINE_FOR_A_SQUARE * wanted.max()


@pytest.mark.parametrize("mirror", ["none", "x", "y", "swap"])
def test_a_mirror_is_about_the_middle_of_the_screen_and_its_own_inverse(mounting, mirror):
    bent = replace(mounting, mirror=mirror)
    middle = np.array([31.5]), np.array([23.5])
    assert np.allclose(bent.to_tracker(*middle), mounting.to_tracker(*middle))
    right = bent.to_tracker(middle[0] + 5, middle[1])
    steps = {"none": (5, 0), "x": (-5, 0), "y": (5, 0), "swap": (0, 5)}
    dx, dy = steps[mirror]
    assert np.allclose(right, mounting.to_tracker(middle[0] + dx, middle[1] + dy))


def test_the_glow_of_a_small_screen_is_not_diluted_by_the_detector_around_it(mounting):
    small = replace(mounting, monitor=monitor_camera((16, 12), 57.65, 120.0, np.array([1.0, 0.0, 0.0, 0.0])))
    black = table_response(8, gamma_response(8).light, black=1e-3)
    with TwinOptics(small, PSF_PX) as optics:
        glow = optics.glow_e_per_s(Panel(black, 1e6))
    scale = (57.65e-3 / 120) / (13e-3 / 25)
    assert np.median(glow) == 0
    assert on_screen_median(glow) == pytest.approx(1e3 / scale**2, rel=1e-4)
    # Its edge is cut at whole pixels: at most one along each of four sides.
    wide, high = 16 * scale, 12 * scale
    assert glow.sum() == pytest.approx(16 * 12 * 1e3, rel=1 / wide + 1 / high)
    assert on_screen_median(np.zeros((3, 3))) == 0


def field_of(x_px, y_px, flux) -> Field:
    truth = np.zeros(len(x_px), dtype=[("electrons_per_s", "f8")])
    truth["electrons_per_s"] = flux
    nothing = np.zeros((1, 1))
    return Field(nothing, nothing, nothing, truth, np.array(x_px, dtype=float), np.array(y_px, dtype=float))


def test_a_star_is_crowded_by_the_light_that_others_bring_into_its_window():
    """Window of 9 px, sigma 1: a neighbour at the window's edge brings half of its light, one 3 px past it a thousandth."""
    place = [100.0, 104.5, 200.0, 207.5, 300.0, 307.5, np.nan]
    flux = [1.0, 1.0, 1.0, 1.0, 1.0, 1000.0, 1.0]
    assert crowded(field_of(place, [50.0] * 7, flux), 4, (1.0, 1.0)).tolist() == [True, True, False, False, True, False, False]


def test_two_stars_that_are_found_as_one_are_no_two():
    assert shared(np.array([-1, 0, 1, 1, -1])).tolist() == [False, False, True, True, False]
    nothing = np.empty(0)
    found = Centroids(nothing, nothing, nothing, nothing, np.empty(0, dtype=np.intp), np.empty(0, dtype=np.bool_))
    assert nearest(found, np.array([1.0, np.nan]), np.array([2.0, 2.0])).tolist() == [-1, -1]


def test_levels_of_another_monitor_s_primaries_stand_where_the_assumed_ones_do():
    grey = srgb_response(8)
    assumed, true = (stolen((grey,) * 3, weights) for weights in ((0.2126, 0.7152, 0.0722), (0.4, 0.35, 0.25)))
    seen = levels_of(assumed, true)
    light = grey.light[assumed.rgb] @ np.array([0.4, 0.35, 0.25])
    known = {tuple(triple) for triple in true.rgb.tolist()}
    common = np.array([tuple(triple) in known for triple in assumed.rgb.tolist()])
    assert common.mean() > 0.9
    assert seen.light[common] == pytest.approx(light[common], rel=1e-9)


def star(x_px: float, y_px: float, dx_px: float, dy_px: float) -> Star:
    return Star(1, 5.0, x_px, y_px, 0.0, dx_px, dy_px, 0.0, 0.0, 0.0, 0.0)


def test_scale_rotation_and_shift_are_told_apart(rng):
    x, y = rng.uniform(0, 100, (2, 30))
    dx, dy = 0.01 * (x - 50) - 0.002 * (y - 50) + 0.3, 0.01 * (y - 50) + 0.002 * (x - 50) - 0.1
    fit = fit_geometry([star(*row) for row in zip(x, y, dx, dy, strict=True)], (50.0, 50.0))
    assert (fit.scale_error, fit.rotation_rad, *fit.offset_px) == pytest.approx((0.01, 0.002, 0.3, -0.1))
    assert fit.left < 1e-20
    chance = fit_geometry([star(*row) for row in zip(x, y, *rng.normal(size=(2, 30)), strict=True)], (50.0, 50.0))
    assert 0.7 < chance.left < 1.3  # 60 residuals, 4 unknowns: chi^2 of 56 over 56, sigma 0.19
    assert fit_geometry([star(1, 2, 0, 0)] * 5, (0.0, 0.0)) is None


def test_nothing_measured_has_no_spread_and_no_zero_point():
    assert spread(np.array([np.nan])) == {"rms": None, "p95": None, "max": None}
    assert spread(np.array([3.0, 4.0, np.inf]))["rms"] == pytest.approx(math.sqrt(12.5))
    assert median([math.nan, 2.0, math.inf, 4.0]) == 3.0
    assert median([]) == 0.0


def test_all_methods_see_the_same_fields_whatever_noise_they_draw(tmp_path):
    places = []
    for method in ("round", "exact"):
        verdict, _ = verify(read_bench_file(bench_file(tmp_path, method=method)), 2, np.random.default_rng(5))
        places.append({(s.hip, s.x_px) for s in verdict.stars + verdict.lost})
    assert len(places[0] & places[1]) > 0.8 * len(places[1]) > 0


def test_a_whole_cycle_of_temporal_is_better_than_one_frame_of_it(tmp_path):
    """Eight frames bring the step of light, so the errors of faint stars, down to an eighth; a half is asked for."""
    errors = []
    for frames in (1, 8):
        path = bench_file(tmp_path, method="temporal", exposure_s=frames / 60)
        _, summary = verify(read_bench_file(path), 4, np.random.default_rng(3))
        errors.append((summary["flux_error_mag"]["rms"], summary["centroid_error_px"]["rms"]))
    assert errors[1][0] < errors[0][0] / 2
    assert errors[1][1] < errors[0][1] / 2


def test_a_black_level_is_caught_on_a_screen_that_covers_a_fifth_of_the_detector(tmp_path):
    path = bench_file(tmp_path, 'true_calibration = "lcd-example"\n', monitor_px=[160, 130], bits=8)
    _, summary = verify(read_bench_file(path), 1, np.random.default_rng(1))
    assert summary["black_e_per_s_px"]["seen"] > 1e3
    assert any("black" in reason for reason in summary["reasons"])


def test_coarse_codes_are_blamed_on_the_codes_and_not_on_the_response(tmp_path):
    path = bench_file(tmp_path, bits=8, method="round")
    path.write_text(path.read_text().replace("[verify]", "brightest_v_mag = -2\n[verify]"))
    verdict, summary = verify(read_bench_file(path), 3, np.random.default_rng(1))
    assert not verdict.passed
    assert any("the codes alone" in reason and "exact" in reason for reason in verdict.reasons)
    assert not any("response and uniformity" in reason for reason in verdict.reasons)
    assert summary["codes_alone"]["flux_mag"] == summary["flux_error_mag"]


def test_the_codes_alone_do_not_depend_on_what_the_monitor_really_is(tmp_path):
    """Wherever the same stars are measured, the codes on the assumed monitor cost them the same."""
    right, _ = verify(read_bench_file(bench_file(tmp_path)), 4, np.random.default_rng(4))
    wrong, _ = verify(read_bench_file(bench_file(tmp_path, 'true_calibration = "gamma2.2"\n')), 4, np.random.default_rng(4))
    assert not wrong.passed
    alone = {(s.hip, s.x_px): s.codes_px for s in right.stars}
    assert len(wrong.stars) > 5
    assert all(s.codes_px == pytest.approx(alone[s.hip, s.x_px], abs=1e-9) for s in wrong.stars)


def test_a_field_without_stars_passes_nothing(tmp_path):
    built = Twin(read_bench_file(bench_file(tmp_path)))
    try:
        verdict = judge(built, Tally())
    finally:
        built.close()
    assert not verdict.passed
    assert "no star could be measured" in verdict.reasons[0]


def test_a_true_rotation_that_is_none_is_refused_with_the_file_s_name(tmp_path):
    path = bench_file(tmp_path, "true_q_cam_to_mon = [0, 0, 0, 0]\n")
    assert read_config(path).verify.true_q_cam_to_mon == (0.0, 0.0, 0.0, 0.0)
    with pytest.raises(InputError, match=r"bench\.toml: \[verify\] true_q_cam_to_mon.*unit"):
        Twin(read_bench_file(path))


def test_only_what_is_said_to_be_true_makes_a_twin_differ(tmp_path):
    assert twin.changed(read_config(bench_file(tmp_path, "flux_mag = 0.2\n")).verify) == ["flux_mag"]
    assert twin.changed(read_config(bench_file(tmp_path, 'true_mirror = "x"\n')).verify) == ["true_mirror"]


@pytest.mark.parametrize(("columns", "stealing"), [("w", False), ("r,g,b", True)])
def test_what_is_proposed_for_coarse_codes_is_what_the_calibration_takes(tmp_path, columns, stealing):
    """Grey alone does not say how the tracker sees the primaries: its file refuses bit stealing."""
    light = gamma_response(8).light
    share = 1 / (columns.count(",") + 1)
    rows = [
        ",".join([str(code), *[repr(share * float(value) + 1e-9)] * (columns.count(",") + 1)])
        for code, value in enumerate(light)
    ]
    (tmp_path / "monitor.csv").write_text("\n".join([f"code,{columns}", *rows]))
    head = 'kind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\nbits = 8\nresponse = "monitor.csv"\n'
    (tmp_path / "monitor.toml").write_text(f"[calibration]\n{head}")
    path = bench_file(tmp_path, "centroid_px = 1e-4\n", bits=8, method="round", calibration="monitor.toml")
    verdict, _ = verify(read_bench_file(path), 2, np.random.default_rng(1))
    (proposal,) = [reason for reason in verdict.reasons if reason.startswith("the codes alone")]
    assert ("bit_stealing" in proposal) == stealing
    assert "a monitor calibrated on more bits" in proposal
    path.write_text(path.read_text().replace("[verify]", "bit_stealing = true\n[verify]"))
    if stealing:
        assert verify(read_bench_file(path), 1, np.random.default_rng(1))[1]["stars"] > 0
    else:
        with pytest.raises(InputError, match="bit stealing wants the primaries"):
            verify(read_bench_file(path), 1, np.random.default_rng(1))


def test_a_true_monitor_that_is_known_in_grey_alone_refuses_bit_stealing_too(tmp_path):
    light = gamma_response(8).light
    rows = [f"{code},{float(value) + 1e-9!r}" for code, value in enumerate(light)]
    (tmp_path / "monitor.csv").write_text("\n".join(["code,w", *rows]))
    head = 'kind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\nbits = 8\nresponse = "monitor.csv"\n'
    (tmp_path / "monitor.toml").write_text(f"[calibration]\n{head}")
    lines = 'centroid_px = 1e-4\ntrue_calibration = "monitor.toml"\n'
    path = bench_file(tmp_path, lines, bits=8, method="round", calibration="gamma2.2")
    verdict, _ = verify(read_bench_file(path), 2, np.random.default_rng(1))
    assert not any("bit_stealing" in reason for reason in verdict.reasons)
    assert any(reason.startswith("the codes alone") for reason in verdict.reasons)
