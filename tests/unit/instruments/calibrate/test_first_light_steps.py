"""Whole steps of first light before a camera in closed form (`ClosedCamera`): what each of them
measures, writes and sets in the bench file is what was planted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from hilstar.display.calibration import load_calibration, read_toml, with_uniformity
from hilstar.display.response import srgb_response
from hilstar.instruments.calibrate.first_light import stars
from hilstar.instruments.calibrate.first_light.context import StepOutcome, rewrite, with_changes
from hilstar.instruments.calibrate.first_light.focus import first_dots, focus
from hilstar.instruments.calibrate.first_light.geometry import geometry, orientation
from hilstar.instruments.calibrate.first_light.image_sources import DiodeRecording
from hilstar.instruments.calibrate.first_light.photometer import Assumed, Photometer, Readings
from hilstar.instruments.calibrate.first_light.photometry import photometry
from hilstar.instruments.calibrate.first_light.session import display, latency
from hilstar.instruments.calibrate.first_light.stars import scale, verify
from hilstar.instruments.calibrate.first_light.uniformity import (
    _White,
    dot_noise_mag,
    see_dots,
    spacing_for,
    uniformity,
    warm_up,
)
from hilstar.instruments.calibrate.geometric.dots import write_plan
from hilstar.instruments.calibrate.grabbed_dots import grab_dots
from hilstar.instruments.calibrate.latency import edges_of
from hilstar.instruments.calibrate.measurements import read_measurements
from hilstar.instruments.calibrate.plan import Patch
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.cameras import bench_camera
from hilstar.server.screen.gate import Timing
from hilstar.server.screen.screen import marker_light
from hilstar.tracker.centroids import noisiest_background
from hilstar.tracker.rounding import rounding_rms
from hilstar.tracker.settings import DetectorSettings
from tests.support.card_texts import drawn_figures
from tests.support.closed_camera import (
    AXIS_PX,
    BITS,
    CLOSED,
    DETECTOR_PX,
    EXPOSURE_S,
    FULL_DN,
    GAIN_E_PER_DN,
    OFFSET_DN,
    PRIMARY_SHARES,
    RATIO,
    SCREEN_AXIS_PX,
    SCREEN_PX,
    SIGMA_PX,
    ClosedCamera,
    closed_context,
    power_of,
)
from tests.support.refusals import refusal

pytestmark = pytest.mark.usefixtures("without_charts")
SURE = 4.0  # sigmas: one figure in 16 000 is further off
MAG_A_RELATIVE = 2.5 / math.log(10)
ARCSEC_PER_RAD = 206264.806
WHITE = 2**BITS - 1
BLACK = 1e-3
# light of white at which the bench file's exposure is too long for one pixel
DAZZLING_DN_PER_S = 200_000.0
FOCUSED = {"focus.dot_code": WHITE}
# Light over the screen: 0.85 to 1.15 from left to right, a tenth more above and below.
DOWN, ACROSS = np.mgrid[-1 : 1 : SCREEN_PX[1] * 1j, -1 : 1 : SCREEN_PX[0] * 1j]
FALLING = 1 - 0.15 * ACROSS + 0.1 * DOWN**2


def readings_of(folder, camera: ClosedCamera, assumed: Assumed, patches: list[Patch]) -> Readings:
    """What the tracker reads of patches, with two pairs of images a link."""
    context = closed_context(folder, camera)
    return Photometer(context, SIGMA_PX, assumed, pairs=2, longest_s=10.0).read(patches)


def errors_of(readings: Readings) -> np.ndarray:
    """The standard error of each reading, with what several have in common."""
    return np.hypot(readings.sigma, np.linalg.norm(readings.common, axis=1))


def test_light_is_read_over_three_decades_as_it_is(tmp_path):
    """White saturates the bench file's exposure, faint codes are exposed longer on dense lattices,
    and black is read in the bench file's own exposure.
    """
    codes = (0, 20, 60, 140, 400, WHITE, 0, 300, 0)
    camera = ClosedCamera(power_of(2.4), DAZZLING_DN_PER_S, BLACK)
    assumed = Assumed({"w": power_of(2.2)}, 0.0)
    readings = readings_of(tmp_path, camera, assumed, [Patch(code, "w") for code in codes])
    true = DAZZLING_DN_PER_S * (camera.response[list(codes)] + BLACK)
    error = errors_of(readings)
    assert (np.abs(readings.light - true) < SURE * error).all()
    assert (error < 0.007 * true).all()
    above = DAZZLING_DN_PER_S * camera.response[list(codes)]
    assert (np.abs(readings.above_black - above) < SURE * error).all()
    assert readings.black_known
    # white on the sparsest lattice, half of the range in its brightest pixel
    whites = [path for path in camera.images if path.stem == "patch_005_8"]
    assert camera.images[whites[0]].max() / FULL_DN == pytest.approx(0.5, abs=0.03)
    taken = dict(camera.taken)
    assert taken["patch_005_8"] == pytest.approx(readings.exposure_s)
    assert taken["black_screen_1"] == EXPOSURE_S
    assert max(taken.values()) > 50 * readings.exposure_s
    assert {*readings.images} == {*camera.images}
    assert readings.period.tolist() == [8, 1, 1, 1, 1, 8, 8, 1, 8]
    for link in readings.links:
        assert link.ratio == pytest.approx(1.0, abs=SURE * link.error)
        assert link.error < 0.01


def test_readings_are_in_their_file_as_they_are(tmp_path):
    camera = ClosedCamera(power_of(2.4), 20_000.0, BLACK)
    patches = [Patch(code, "w") for code in (0, 300, WHITE, 700, 0)]
    readings = readings_of(tmp_path, camera, Assumed({"w": power_of(2.2)}, 0.0), patches)
    readings.write(tmp_path / "measured.csv")
    measured = read_measurements(tmp_path / "measured.csv", BITS)
    np.testing.assert_array_equal(measured.value, readings.light)
    np.testing.assert_allclose(measured.sigma, readings.sigma, rtol=1e-4)
    np.testing.assert_allclose(measured.common, readings.common, rtol=1e-4)
    assert measured.code.tolist() == [0, 300, WHITE, 700, 0]
    lines = (tmp_path / "measured.csv").read_text().splitlines()
    table = [line.split(",") for line in lines if not line.startswith("#")]
    causes = readings.common.shape[1]
    assert table[0][3:] == ["value", "sigma", *(f"common_{k}" for k in range(1, causes + 1))]
    rows = [row[:3] for row in table]
    codes = ["0", "300", str(WHITE), "700", "0"]
    assert rows[0] == ["order", "code", "channel"]
    assert rows[1:] == [[str(order), code, "w"] for order, code in enumerate(codes, start=1)]


def test_primaries_are_read_apart_and_black_is_of_all_of_them(tmp_path):
    """Without an image of a dark screen black is the bench file's, relative to white."""
    camera = ClosedCamera(power_of(2.0), 20_000.0, has_unlit=False)
    patches = [Patch(0, "w")]
    for name in "rgb":
        patches += [Patch(WHITE, name), Patch(500, name)]
    patches.append(Patch(0, "w"))
    light = dict(zip("rgb", np.outer(PRIMARY_SHARES, power_of(2.1)), strict=True))
    readings = readings_of(tmp_path, camera, Assumed(light, 0.02), patches)
    assert not readings.black_known
    lit = np.array([[1.0, (500 / WHITE) ** 2]]) * PRIMARY_SHARES[:, None]
    above = 20_000 * np.concatenate([[0.0], lit.ravel(), [0.0]])
    error = errors_of(readings)
    assert (np.abs(readings.above_black - above) < SURE * error).all()
    # of the white of all three: 0.02 of 20 000 DN/s
    np.testing.assert_allclose(readings.light - readings.above_black, 400.0, rtol=0.01)
    assert (error[1:-1] < 0.02 * above[1:-1]).all()


def test_black_is_as_sure_as_two_images_a_dark_one_and_the_map(tmp_path):
    """The screen's light falls to one side, by a map that is known to a tenth: the black that is
    read is of the pixels that are seen, each by its light.
    """
    falling = FALLING / FALLING.mean()
    with_uniformity("srgb", BITS, tmp_path / "even.toml", falling, relative=0.1)
    camera = ClosedCamera(srgb_response(BITS).light, 20_000.0, 0.02, even=falling)
    context = closed_context(tmp_path, camera, {"monitor": {"calibration": "even.toml"}})
    assumed = Assumed({"w": srgb_response(BITS).light}, 0.0)
    photometer = Photometer(context, SIGMA_PX, assumed)
    field = photometer.field
    square = falling[field.top : field.top + field.side, field.left : field.left + field.side]
    readings = photometer.read([Patch(code, "w") for code in (0, 500, WHITE, 0)])
    # relative to the mean light of the dots' square
    white_dn_per_s = 20_000 * square.mean()
    black_dn_per_s = 0.02 * white_dn_per_s
    assert readings.light[0] == pytest.approx(black_dn_per_s, rel=0.01)
    assert readings.light[2] == pytest.approx(white_dn_per_s * 1.02, rel=0.01)
    black_error = readings.common[:, -1]
    assert np.ptp(black_error) == 0
    # of a black screen's image, the noise of its light and of the detector in each pixel
    glow_dn = black_dn_per_s * EXPOSURE_S * field.monitor_px
    pixels = field.tracker_px
    dark_dn2 = pixels * (1.5**2 + 1 / 12)
    glow_dn2 = dark_dn2 + glow_dn / GAIN_E_PER_DN
    by_map = 0.1 * glow_dn
    rounding = pixels * rounding_rms(1.5)
    error_dn = math.sqrt(glow_dn2 / 2 + dark_dn2 + by_map**2 + 2 * rounding**2)
    seconds = field.monitor_px * EXPOSURE_S
    assert black_error[0] == pytest.approx(error_dn / seconds, rel=0.02)


def test_a_response_that_is_measured_is_named_in_the_bench_file_with_its_figures(tmp_path):
    camera = ClosedCamera(power_of(2.4), DAZZLING_DN_PER_S, BLACK)
    context = closed_context(tmp_path, camera, patches=24)
    outcome = photometry(context)
    assert outcome.verdict == "done", outcome.line
    figures = outcome.figures
    assert figures["gamma"] == pytest.approx(2.4, abs=0.01)
    srgb = srgb_response(BITS)
    three_decades = srgb.light[1:] >= 1e-3
    codes = np.arange(1, WHITE + 1)
    slope = np.polyfit(np.log(codes[three_decades]), np.log(srgb.light[1:][three_decades]), 1)[0]
    assert figures["gamma_in_bench_file"] == pytest.approx(slope, rel=1e-6)
    true = camera.response[1:]
    off_mag = -2.5 * np.log10(true[true >= 1e-3] / srgb.light[1:][true >= 1e-3])
    assert figures["bench_file_off_rms_mag"] == pytest.approx(np.std(off_mag), rel=0.3)
    assert figures["bench_file_off_max_mag"] == pytest.approx(np.abs(off_mag).max(), rel=0.02)
    assert figures["black_level_measured"] == "yes"
    error = figures["black_level_error"]
    assert error < 0.02 * BLACK
    assert figures["black_level"] == pytest.approx(BLACK, abs=SURE * error)
    response = load_calibration(tmp_path / "response.toml", BITS).response
    np.testing.assert_allclose(response.light[100:], camera.response[100:], rtol=0.02)
    assert response.black == figures["black_level"]
    assert read_toml(tmp_path / "response.toml").errors.black == pytest.approx(error, rel=1e-4)
    (change,) = outcome.changes
    assert (change.table, change.key, change.after) == ("monitor", "calibration", "response.toml")
    named = {path.name for path in outcome.files}
    assert named >= {"response.toml", "response.csv", "measured.csv", "black_screen_0.png"}
    assert figures["patches"] == len(read_measurements(tmp_path / "measured.csv", BITS).code)


def test_no_response_is_measured_unless_it_is_asked_for(tmp_path):
    camera = ClosedCamera()
    outcome = photometry(closed_context(tmp_path, camera))
    assert (outcome.verdict, camera.taken, outcome.changes) == ("skipped", [], ())
    assert "--patches" in outcome.line


def uniformity_of(folder, seen: np.ndarray | float, filed: np.ndarray | None) -> StepOutcome:
    """What the step makes of a screen's light, by a bench file that has a map of it or none."""
    with_uniformity("srgb", BITS, folder / "filed.toml", filed, relative=0.05)
    name = "srgb" if filed is None else "filed.toml"
    camera = ClosedCamera(srgb_response(BITS).light, even=seen)
    context = closed_context(
        folder, camera, {"monitor": {"calibration": name}}, known=dict(FOCUSED)
    )
    return uniformity(context)


def of_field(light: np.ndarray) -> np.ndarray:
    """Light over the part of the screen that the detector sees, without dots' reach of its edge."""
    return light[21:92, 0:99]


@pytest.mark.parametrize("filed", [None, 2 - FALLING], ids=["none", "another"])
def test_a_screen_whose_light_falls_is_mapped_as_it_is(tmp_path, filed):
    outcome = uniformity_of(tmp_path, FALLING, filed)
    assert outcome.verdict == "done", outcome.line
    figures = outcome.figures
    field = of_field(FALLING)
    darkest = field.min() / field.max()
    error = figures["map_error_mag"] / MAG_A_RELATIVE
    assert figures["darkest_of_brightest"] == pytest.approx(darkest, abs=SURE * error)
    assert error < 0.01
    assert figures["change_rms_mag"] == pytest.approx(np.std(2.5 * np.log10(field)), rel=0.15)
    off = figures["change_rms_mag"]
    if filed is not None:
        off = np.std(2.5 * np.log10(field / of_field(filed)))
    assert figures["off_bench_file_rms_mag"] == pytest.approx(off, rel=0.15)
    assert figures["dots"] > 60
    (change,) = outcome.changes
    assert (change.table, change.key, change.after) == ("monitor", "calibration", "light.toml")
    written = load_calibration(tmp_path / "light.toml", BITS)
    np.testing.assert_array_equal(written.response.light, srgb_response(BITS).light)
    ratio = of_field(written.uniformity_map(SCREEN_PX)) / field
    # a map of 3 x 4 fields is flat beyond their middles
    assert np.std(ratio) / ratio.mean() < 0.02
    assert written.uniformity_relative == pytest.approx(error, rel=1e-3)
    number = outcome.number
    assert (number.unit, number.value) == ("%", 100 * figures["darkest_of_brightest"])
    assert number.error == pytest.approx(number.value * math.sqrt(2) * error)


def test_a_map_that_is_as_the_screen_is_stays(tmp_path):
    outcome = uniformity_of(tmp_path, FALLING, FALLING)
    assert (outcome.verdict, outcome.changes) == ("done", ()), outcome.line
    assert outcome.line.endswith("the bench file has it so")
    assert outcome.figures["off_bench_file_rms_mag"] < 0.002
    assert outcome.figures["change_rms_mag"] > 0.05
    assert not (tmp_path / "light.toml").exists()


def test_an_even_screen_takes_a_map_away_and_is_left_alone_without_one(tmp_path):
    outcome = uniformity_of(tmp_path, 1.0, FALLING)
    assert outcome.verdict == "done"
    assert "where the bench file has it uneven" in outcome.line
    assert outcome.figures["grid"] == "1 x 1"
    assert load_calibration(tmp_path / "light.toml", BITS).uniformity is None
    assert [change.after for change in outcome.changes] == ["light.toml"]
    alone = uniformity_of(tmp_path, 1.0, None)
    assert (alone.verdict, alone.changes) == ("done", ())
    assert alone.line.endswith("nothing was written")


@pytest.mark.parametrize("share", [-0.03, 0.05])
def test_a_warm_up_is_watched_until_white_is_stable(tmp_path, share):
    """White comes from below or above by an exponential of 200 s."""
    camera = ClosedCamera(
        srgb_response(BITS).light, at_time=lambda t_s: 1 + share * math.exp(-t_s / 200)
    )
    outcome = warm_up(closed_context(tmp_path, camera, known=dict(FOCUSED), watched_s=3000.0))
    assert outcome.verdict == "done", outcome.line
    figures = outcome.figures
    # to 0.2 % of white, after which ten minutes take all of what is left but a twentieth
    stable_s = 200 * math.log(abs(share) * -math.expm1(-600 / 200) / 0.002)
    error_s = figures["stable_after_error_s"]
    assert figures["stable_after_s"] == pytest.approx(stable_s, abs=SURE * error_s)
    assert error_s < 40
    assert figures["tau_s"] == pytest.approx(200, rel=0.15)
    # the screen does nothing but wait: readings are 10 s apart, the last one at the end
    last_s = 10.0 * (figures["readings"] - 1)
    assert camera.now_s == pytest.approx(last_s)
    rest = share * math.exp(-last_s / 200)
    drift = -100 * 3600 * rest / 200 / (1 + rest)
    drift_error = figures["drift_error_percent_per_h"]
    assert figures["drift_percent_per_h"] == pytest.approx(drift, abs=SURE * drift_error)
    assert np.sign(figures["drift_percent_per_h"]) == -np.sign(share)
    assert (outcome.number.value, outcome.number.unit) == (figures["drift_percent_per_h"], "%/h")
    (change,) = outcome.changes
    assert (change.table, change.key) == ("certify", "warm_up_percent")
    # what ten minutes more do not exceed, at 95 % from both sides
    sure = stats.t.ppf(0.975, figures["dof"])
    bound = abs(figures["ahead"]) + sure * figures["ahead_error"]
    assert change.after == pytest.approx(100 * bound, rel=5e-3)
    assert change.after < 0.2
    rows = np.loadtxt(tmp_path / "warm-up.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows[:, 0], 10.0 * np.arange(figures["readings"]))
    # the dots' light without the glow of what is not lit
    np.testing.assert_allclose(
        rows[:, 1] / rows[-1, 1], (1 + share * np.exp(-rows[:, 0] / 200)) / (1 + rest), rtol=0.006
    )


def test_a_screen_that_drifts_on_is_not_warm_and_one_that_is_not_watched_is_skipped(tmp_path):
    camera = ClosedCamera(srgb_response(BITS).light, at_time=lambda t_s: 1 - 1e-4 * t_s)
    outcome = warm_up(closed_context(tmp_path, camera, known=dict(FOCUSED), watched_s=200.0))
    assert (outcome.verdict, outcome.changes) == ("failed", ())
    assert outcome.figures["stable"] == "no"
    assert "watch it for longer" in outcome.line
    assert camera.now_s <= 200
    blind = ClosedCamera()
    skipped = warm_up(closed_context(tmp_path, blind))
    assert (skipped.verdict, blind.taken) == ("skipped", [])


# The centroids of squares of 500 DN and more are right to 0.05 px, over sides of 50 px.
FIGURE_SHARE = 0.001
WAYS = [(turns, is_mirrored) for turns in range(4) for is_mirrored in (False, True)]


@pytest.mark.parametrize(("turns", "is_mirrored"), WAYS)
def test_however_a_screen_is_mounted_its_image_is_upright_afterwards(tmp_path, turns, is_mirrored):
    def mounted(screen: np.ndarray) -> np.ndarray:
        turned = np.rot90(screen, turns)
        return turned[:, ::-1] if is_mirrored else turned

    camera = ClosedCamera(srgb_response(BITS).light, mounted=mounted)
    native_px = SCREEN_PX[::-1] if turns % 2 else SCREEN_PX
    changes = {"monitor": {"resolution_px": list(native_px)}, "collimator": {}}
    changes["collimator"]["principal_point_px"] = None
    context = closed_context(tmp_path, camera, changes)
    outcome = orientation(context)
    assert outcome.verdict == "done"
    file = with_changes(context.file, outcome.changes)
    assert file.config.monitor.resolution_px == SCREEN_PX
    codes = np.arange(math.prod(SCREEN_PX)).reshape(SCREEN_PX[::-1]) % WHITE
    np.testing.assert_array_equal(camera.seen(file, codes.astype(np.uint16)), codes)
    assert bool(outcome.changes) == ((turns, is_mirrored) != (0, False))
    figures = outcome.figures
    assert figures["scale"] == pytest.approx(1.0, abs=FIGURE_SHARE)
    assert figures["turn_deg"] == pytest.approx(0.0, abs=math.degrees(FIGURE_SHARE))
    assert figures["turn_error_deg"] < 0.2
    # the next step sees the screen where the tracker has it: its axis on the screen's own
    again = closed_context(
        tmp_path,
        camera,
        changes | {"monitor": {"resolution_px": list(SCREEN_PX)}},
        known={f"orientation.{name}": value for name, value in figures.items()},
    )
    seen = again.seen_screen
    rays = seen.monitor.rays(np.array([SCREEN_AXIS_PX[0]]), np.array([SCREEN_AXIS_PX[1]]))
    x_px, y_px = seen.tracker.project(rays)
    assert (x_px[0], y_px[0]) == pytest.approx(AXIS_PX, abs=0.1)


def test_the_focus_is_the_gaussian_before_the_detector_and_a_pixel_its_square(tmp_path):
    camera = ClosedCamera(srgb_response(BITS).light, 40_000.0)
    outcome = focus(closed_context(tmp_path, camera))
    assert outcome.verdict == "done", outcome.line
    figures = outcome.figures
    error_px = figures["psf_sigma_error_px"]
    assert error_px < 0.02
    assert figures["psf_sigma_px"] == pytest.approx(SIGMA_PX, abs=3 * error_px)
    pixel_error_px = figures["monitor_pixel_error_px"]
    assert pixel_error_px < 0.01
    assert figures["monitor_pixel_px"] == pytest.approx(RATIO, abs=SURE * pixel_error_px)
    # a dot of white fills 4000 DN: a darker code does not saturate
    brightest = max(float(image.max()) for image in camera.images.values())
    assert figures["dot_code"] < WHITE
    assert brightest < 0.9 * FULL_DN
    stated = closed_context(tmp_path, camera, {"tracker": {"psf_sigma_px": [0.4, 0.4]}})
    blurred = focus(stated)
    assert blurred.verdict == "failed"
    assert "turn the focus" in blurred.line


# A star's light is read to 0.006 mag, a dozen's median to 0.003.
STARS = {
    "monitor": {"calibration": "gamma2.2"},
    "sky": {"faintest_v_mag": 6.5},
    "tracker": {"exposure_s": 0.5},
}
E_PER_S_A_DN = GAIN_E_PER_DN
FILED_WHITE_E_PER_S = float(CLOSED["render"]["flux_at_white_e_per_s"])


def test_white_is_not_measured_where_stars_say_that_light_changes_over_the_screen(tmp_path):
    """By a tenth from the middle to either side, which their noise of half a percent does not
    hide.
    """
    even = np.broadcast_to(1 + 0.1 * np.linspace(-1, 1, SCREEN_PX[0]), SCREEN_PX[::-1])
    white_dn_per_s = FILED_WHITE_E_PER_S / E_PER_S_A_DN
    camera = ClosedCamera(power_of(2.2), white_dn_per_s, even=even)
    with drawn_figures():
        outcome = scale(closed_context(tmp_path, camera, STARS))
    assert outcome.verdict == "failed"
    assert "of it follows the place on the screen: measure that (--again" in outcome.line
    assert "nothing was changed" not in outcome.line


@pytest.mark.parametrize("share", [1.0, 1.07, 0.9])
def test_stars_say_what_white_is_worth(tmp_path, monkeypatch, share):
    camera = ClosedCamera(power_of(2.2), share * FILED_WHITE_E_PER_S / E_PER_S_A_DN)
    context = closed_context(tmp_path, camera, STARS)
    noises_mag = []

    def draw(path, e_per_s, off_mag, noise_mag, finding):
        noises_mag.append(noise_mag)

    monkeypatch.setattr(stars, "draw_light", draw)
    outcome = scale(context)
    assert outcome.verdict == "done", outcome.line
    figures = outcome.figures
    off_mag = -2.5 * math.log10(share)
    error_mag = figures["error_mag"]
    assert error_mag < 0.005
    assert figures["off_mag"] == pytest.approx(off_mag, abs=SURE * error_mag)
    white = figures["flux_at_white_e_per_s"]
    assert white == pytest.approx(FILED_WHITE_E_PER_S * 10 ** (-0.4 * figures["off_mag"]))
    assert outcome.number.error == pytest.approx(white * error_mag / MAG_A_RELATIVE)
    set_keys = {(change.table, change.key): change.after for change in outcome.changes}
    if share == 1.0:
        assert set_keys == {}
    else:
        relative = set_keys.pop(("certify", "flux_at_white_relative"))
        assert relative == pytest.approx(error_mag / MAG_A_RELATIVE, rel=0.01)
        assert set_keys == {("render", "flux_at_white_e_per_s"): pytest.approx(white, rel=1e-5)}
    word = "brighter" if figures["off_mag"] < 0 else "fainter"
    off = f"{abs(figures['off_mag']):.3f} +- {error_mag:.3f} mag {word} than the bench file has it"
    assert off in outcome.line
    rows = np.loadtxt(tmp_path / "readings.csv", delimiter=",", skiprows=1)
    assert len(rows) == figures["stars"]
    (noise_mag,) = noises_mag
    np.testing.assert_allclose(rows[:, 2], noise_mag / MAG_A_RELATIVE * rows[:, 1])
    # the same stars by their catalogue's light, each in the noise that its row states
    with open_bench(context.file) as bench:
        place = {hip: k for k, hip in enumerate(bench.stars.hip.tolist())}
        rates = bench.stars.electrons_per_s[[place[hip] for hip in rows[:, 0].astype(int)]]
    seen_e_per_s = rows[:, 1] * GAIN_E_PER_DN / 0.5
    off = seen_e_per_s / rates / share - 1
    assert (np.abs(off) < SURE * np.hypot(rows[:, 2] / rows[:, 1], 0.01)).all()
    assert (rows[:, 2] < 0.1 * rows[:, 1]).all()


def test_stars_that_stand_where_the_sky_has_them_pass_and_dim_ones_do_not(tmp_path):
    camera = ClosedCamera(power_of(2.2), FILED_WHITE_E_PER_S / E_PER_S_A_DN)
    passed = verify(closed_context(tmp_path, camera, STARS))
    assert passed.verdict == "done", passed.line
    assert passed.figures["lost"] == 0
    assert passed.figures["star_rms_px"] < 2 * passed.figures["star_noise_px"]
    arcsec_a_px = 13 / 10e3 * ARCSEC_PER_RAD
    assert passed.number.value == pytest.approx(passed.figures["star_rms_px"] * arcsec_a_px)
    assert passed.number.error == pytest.approx(
        passed.number.value / math.sqrt(4 * passed.figures["stars"])
    )
    dim = ClosedCamera(power_of(2.2), 0.9 * camera.white_dn_per_s)
    failed = verify(closed_context(tmp_path, dim, STARS))
    assert failed.verdict == "failed"
    assert "measure what white is worth" in failed.line
    assert failed.figures["flux_zero_point_mag"] == pytest.approx(-2.5 * math.log10(0.9), abs=0.02)
    # what they have in common is no scatter
    for name in ("flux_rms_mag", "flux_p95_mag", "flux_max_mag"):
        assert failed.figures[name] < 2 * passed.figures[name]


def test_stars_beside_their_places_ask_for_the_geometry(tmp_path):
    """The bench file has the lens's axis a third of a pixel further left on the screen."""
    camera = ClosedCamera(power_of(2.2), FILED_WHITE_E_PER_S / E_PER_S_A_DN)
    beside = {"collimator": {"principal_point_px": [SCREEN_AXIS_PX[0] - 0.3, SCREEN_AXIS_PX[1]]}}
    outcome = verify(closed_context(tmp_path, camera, STARS, beside))
    assert outcome.verdict == "failed"
    assert "run the geometry again" in outcome.line
    assert outcome.figures["star_rms_px"] == pytest.approx(0.3 * RATIO, abs=0.02)


def test_what_the_twin_finds_fails_stars_that_stand_where_the_sky_has_them(tmp_path, monkeypatch):
    """The twin's own comparison says nothing of these stars, and both are said."""
    camera = ClosedCamera(power_of(2.2), FILED_WHITE_E_PER_S / E_PER_S_A_DN)
    twin = {"twin_passed": "false"}, ["the twin: the codes alone cost 0.2 mag"]
    monkeypatch.setattr(stars, "_twin_figures", lambda context: twin)
    outcome = verify(closed_context(tmp_path, camera, STARS))
    assert outcome.verdict == "failed"
    assert outcome.line.endswith(": the twin: the codes alone cost 0.2 mag")
    assert outcome.figures["twin_passed"] == "false"


def test_the_detector_of_the_closed_camera_is_as_its_bench_file_says(tmp_path):
    """What the tests above rest on: offset, noise and gain of its images."""
    camera = ClosedCamera(white_dn_per_s=10_000.0)
    context = closed_context(tmp_path, camera)
    dark = context.read(context.dark())
    assert dark.shape == DETECTOR_PX[::-1]
    assert dark.mean() == pytest.approx(OFFSET_DN, abs=0.1)
    assert dark.std() == pytest.approx(math.hypot(1.5, 1 / math.sqrt(12)), rel=0.05)
    assert context.detector.electronics_e == pytest.approx(1.5 * GAIN_E_PER_DN, rel=0.05)


def test_the_geometry_is_where_the_camera_has_the_screen(tmp_path):
    """The bench file has the lens's axis a pixel and more beside, and its focal length 0.75 % too
    long; dots say where each pixel of the screen is seen.
    """
    camera = ClosedCamera(srgb_response(BITS).light, 25_000.0, saves=True)
    filed = {"collimator": {"principal_point_px": [51.2, 54.0], "focal_length_mm": 40.3}}
    context = closed_context(tmp_path, camera, filed, known={"focus.dot_code": 1000})
    outcome = geometry(context)
    assert outcome.verdict == "done", outcome.line
    (change,) = outcome.changes
    assert (change.table, change.key, change.after) == ("collimator", "geometry", "geometry.toml")
    file = rewrite(context.file, outcome.changes)
    found = bench_camera(file.config, file.folder)
    x, y = np.meshgrid(np.linspace(2, 98, 9), np.linspace(22, 92, 7))
    rays = found.rays(x.ravel(), y.ravel())
    tangents = (rays[:, :2] / rays[:, 2:]).T
    focal_px = 40e3 / 57.65
    true = np.stack([x.ravel() - SCREEN_AXIS_PX[0], y.ravel() - SCREEN_AXIS_PX[1]]) / focal_px
    off_arcsec = np.hypot(*(tangents - true)) * ARCSEC_PER_RAD
    figures = outcome.figures
    # a pixel of the screen has 297 arcsec
    assert np.sqrt((off_arcsec**2).mean()) < 2 * figures["error_rms_arcsec"] < 3.0
    assert off_arcsec.max() < 3.0
    # of 0.005 px of noise in a centroid, the error of one that was held out
    noise_arcsec = figures["noise_px"] * 13 / 10e3 * ARCSEC_PER_RAD
    assert 0.5 * noise_arcsec < figures["held_out_rms_arcsec"] < 3 * noise_arcsec
    assert figures["centroids_lost"] == figures["centroids_false"] == 0
    assert 0.8 * figures["dots_planned"] < figures["dots_recognised"] <= figures["dots_planned"]
    assert (tmp_path / "images" / "plan.csv") in outcome.files
    frames = [name for name, _ in camera.taken if name.startswith("frame_")]
    assert frames == [f"frame_{number:03}" for number in range(8 + 16)]


@dataclass
class Watched(ClosedCamera):
    """A camera beside a photodiode, whose square lights so long after its swap."""

    delay_ms: float = 0.0
    jitter_ms: float = 0.1

    def diode(self, file, seconds):
        """300 swaps at the file's rate; the square changes every third frame."""
        rng = np.random.default_rng(7)
        period_ns = 1e9 / file.config.monitor.refresh_hz
        level = np.array([marker_light(frame, "code") for frame in range(300)])
        swap_ns = 10**9 + np.round(np.arange(300) * period_ns).astype(np.int64)
        shown = edges_of(swap_ns, level)
        late_ns = np.round(1e6 * (self.delay_ms + rng.normal(0, self.jitter_ms, len(level))))
        seen = edges_of(swap_ns + late_ns.astype(np.int64), level)
        return DiodeRecording(shown, seen)


@pytest.mark.parametrize(("filed_ms", "is_changed"), [(2.0, True), (6.5, False)])
def test_a_panel_s_delay_is_what_the_scan_out_leaves_of_the_diode_s(tmp_path, filed_ms, is_changed):
    """The square of 24 px stands at the foot of 120 columns of a screen on its side, whose scan
    takes 10 ms: its middle lights 9 ms after the first.
    """
    monitor = {
        "resolution_px": [120, 96],
        "rotate_deg": 90,
        "photodiode_px": 24,
        "refresh_hz": 60.0,
        "scanout_ms": 10.0,
        "panel_delay_ms": filed_ms,
    }
    context = closed_context(tmp_path, Watched(delay_ms=15.5), {"monitor": monitor})
    outcome = latency(context)
    assert outcome.verdict == "done", outcome.line
    figures = outcome.figures
    assert figures["swap_to_square_ms"] == pytest.approx(9.0)
    error_ms = figures["error_ms"]
    # of a median of 0.1 ms over so many edges
    assert error_ms == pytest.approx(1.2533 * 0.1 / math.sqrt(figures["edges"]), rel=0.3)
    assert figures["panel_delay_ms"] == pytest.approx(6.5, abs=SURE * error_ms)
    assert figures["swap_to_light_p50_ms"] == pytest.approx(15.5, abs=SURE * error_ms)
    assert figures["jitter_ms"] == pytest.approx(0.1, rel=0.2)
    assert figures["rise_ms"] == pytest.approx(15.5, abs=0.1)
    assert figures["edges_without_a_frame"] == 0
    changes = {(change.table, change.key): change.after for change in outcome.changes}
    if is_changed:
        assert changes == {
            ("monitor", "panel_delay_ms"): figures["panel_delay_ms"],
            ("certify", "panel_delay_u_ms"): pytest.approx(error_ms, rel=0.01),
        }
    else:
        assert changes == {}
    early = closed_context(tmp_path, Watched(delay_ms=7.0), {"monitor": monitor})
    assert "before the scan-out could reach it" in refusal(latency, early)
    bare = closed_context(tmp_path, ClosedCamera(), {"monitor": monitor})
    assert latency(bare).verdict == "skipped"
    none = closed_context(tmp_path, Watched(), {"monitor": monitor | {"photodiode_px": 0}})
    assert "photodiode_px is 0" in latency(none).line


@pytest.mark.parametrize(("filed_ms", "is_changed"), [(5.5, True), (6.2, False)])
def test_a_delay_that_differs_by_less_than_three_errors_stays(tmp_path, filed_ms, is_changed):
    """Edges scatter by 2 ms; the median of some 150 is known to 0.2 ms."""
    monitor = {
        **{"photodiode_px": 12, "refresh_hz": 60.0, "scanout_ms": 0.0},
        "panel_delay_ms": filed_ms,
    }
    seen = Watched(delay_ms=6.5, jitter_ms=2.0)
    outcome = latency(closed_context(tmp_path, seen, {"monitor": monitor}))
    off_ms = abs(outcome.figures["panel_delay_ms"] - filed_ms)
    error_ms = outcome.figures["error_ms"]
    assert error_ms == pytest.approx(0.2, rel=0.3)
    assert off_ms > 0.1
    assert (off_ms >= 3 * error_ms) == is_changed == bool(outcome.changes)


@pytest.mark.parametrize("delay_ms", [-0.04, -0.2])
def test_light_that_is_early_by_its_noise_alone_is_no_delay(tmp_path, delay_ms):
    monitor = {"photodiode_px": 12, "refresh_hz": 60.0, "scanout_ms": 0.0, "panel_delay_ms": 1.0}
    seen = Watched(delay_ms=delay_ms, jitter_ms=0.02)
    context = closed_context(tmp_path, seen, {"monitor": monitor})
    if delay_ms < -0.1:
        assert "before the scan-out could reach it" in refusal(latency, context)
    else:
        assert latency(context).figures["panel_delay_ms"] == 0.0


@pytest.mark.parametrize("is_paced", [True, False])
def test_a_display_is_timed_by_its_own_frames(tmp_path, is_paced):
    camera = ClosedCamera()
    timing = Timing(12.5, 2, is_paced, modes_hz=(60, 80), period_error_ms=0.003)
    camera.gate = lambda file: timing
    camera.forced = ["another rate"]
    outcome = display(closed_context(tmp_path, camera))
    assert outcome.line.startswith("a frame every 12.500 ms, 2 dropped")
    assert outcome.line.endswith("; forced: another rate")
    assert ("paced by software" in outcome.line) == (not is_paced)
    rate = {"refresh_hz": 80.0} if is_paced else {}
    assert outcome.figures == {"period_ms": 12.5, "dropped": 2, "modes_hz": "60 80"} | rate
    assert (outcome.number.value, outcome.number.error) == (12.5, 0.003)
    blind = display(closed_context(tmp_path, ClosedCamera()))
    assert (blind.verdict, blind.line) == (
        "skipped",
        "no display of this program's own (closed camera)",
    )


def test_dots_are_grabbed_in_the_brightest_code_that_does_not_saturate(tmp_path):
    camera = ClosedCamera(power_of(2.2), 100_000.0, saves=True)
    context = closed_context(tmp_path, camera)
    plan = first_dots(context.seen_screen)
    (tmp_path / "dots").mkdir()
    write_plan(tmp_path / "dots" / "plan.csv", plan)
    told: list[str] = []
    found = grab_dots(
        context.file, camera, tmp_path / "dots", None, overwrite=False, tell=told.append
    )
    names = [path.stem for path in found.images]
    assert names == [f"frame_{number:03}" for number in range(plan.frames)]
    assert found.dark.stem == "dark"
    assert {exposure_s for _, exposure_s in camera.taken} == {EXPOSURE_S}
    peaks = [float(camera.images[path].max()) for path in found.images]
    # about a quarter of the light less each time, until the first frame's dots fill 0.6 at most
    assert 0.1 * FULL_DN < peaks[0] < 0.6 * FULL_DN
    saturated = [line for line in told if "saturate the tracker" in line]
    assert len(saturated) == len(camera.taken) - plan.frames - 1 > 0
    assert told[-1] == f"frame_{plan.frames - 1:03}: image {plan.frames} of {plan.frames}"
    again = (context.file, camera, tmp_path / "dots", None)
    assert "has images" in refusal(grab_dots, *again, overwrite=False, tell=told.append)
    longer = grab_dots(
        context.file, camera, tmp_path / "dots", 0.02, overwrite=True, tell=told.append
    )
    assert camera.taken[-1][1] == 0.02
    assert len(longer.images) == plan.frames
    camera.sets_exposure = False
    words = refusal(
        grab_dots, context.file, camera, tmp_path / "dots", 0.02, overwrite=True, tell=told.append
    )
    assert "--exposure" in words


def test_dots_are_watched_without_what_black_glows_and_no_image_of_them_stays(tmp_path):
    """A screen that began to glow after the dark frame, by a 200th of white's light: 2.5 DN
    in each pixel.
    """
    light = {}
    for glow in (0.0, 0.005):
        folder = tmp_path / f"{glow}"
        folder.mkdir()
        camera = ClosedCamera(srgb_response(BITS).light, 5_000.0)
        context = closed_context(folder, camera, known=dict(FOCUSED))
        white = _White(context)
        camera.black = glow
        light[glow] = np.mean([white.read() for _ in range(4)])
        names = sorted(path.name for path in (folder / "images").iterdir())
        assert names == ["dark_000.png", f"white_{WHITE:05}_000.png"]
    # each of 9 pixels at white, in a circle that holds nearly all of it
    lit = int((white._codes > 0).sum())
    seen = lit * 5_000.0 * EXPOSURE_S * RATIO**2
    assert 0.5 * seen < light[0.0] < seen
    assert light[0.005] == pytest.approx(light[0.0], rel=0.02)


def test_dots_that_differ_from_one_to_the_next_far_beyond_their_noise_are_no_map(tmp_path):
    """By 5 % from pixel to pixel: 1.7 % from dot to dot, of which noise is a tenth."""
    uneven = 1 + 0.05 * np.random.default_rng(4).normal(size=SCREEN_PX[::-1])
    outcome = uniformity_of(tmp_path, uneven, None)
    figures = outcome.figures
    assert figures["left_rms_mag"] > max(3 * figures["dot_noise_mag"], 0.01)
    assert outcome.verdict == "failed"
    assert "that is far above their noise: dust, a panel uneven from pixel to pixel" in outcome.line


@pytest.mark.parametrize(
    ("prnu", "noise_dn", "relative"),
    [
        # photons of 40 000 e-
        (0.0, 0.0, 1 / 200),
        # a Gaussian of 0.8 px spreads a dot over 4 pi of its sigma squared
        (0.06, 0.0, math.hypot(1 / 200, 0.06 / math.sqrt(4 * math.pi * 0.64))),
        # and all pixels within 3 px of it
        (0.0, 100.0, math.hypot(1 / 200, 100 * math.sqrt(math.pi) * 3 / 10_000)),
    ],
)
def test_a_dot_is_as_noisy_as_its_photons_its_pixels_response_and_all_in_its_reach(
    prnu, noise_dn, relative
):
    detector = DetectorSettings(gain_e_per_dn=4.0, prnu=prnu)
    noise_mag = dot_noise_mag(10_000.0, noise_dn, 3.0, 0.8, detector)
    assert noise_mag == pytest.approx(MAG_A_RELATIVE * relative)


def test_dots_are_summed_over_the_tracker_s_pixels_in_their_reach(tmp_path):
    context = closed_context(tmp_path, ClosedCamera(), known=dict(FOCUSED))
    dots, images = see_dots(context)
    spacing = spacing_for(context.real_geometry(), SIGMA_PX)
    last = context.looked(images[-1], context.read(context.dark()))
    noise_dn = noisiest_background(last.image).noise
    dn, reach_px = float(np.median(dots.light)), spacing.reach * RATIO
    wanted_mag = dot_noise_mag(dn, noise_dn, reach_px, spacing.sigma_px, context.detector)
    assert dots.noise_mag == pytest.approx(wanted_mag, rel=0.01)
