"""Rolling shutters and frame-transfer smear: each row by brute force, stars and a scanning
display in closed form.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.basics.rotation import from_radec_roll_deg, propagate, to_matrix
from hilstar.basics.units import NS_PER_S
from hilstar.display.geometry import monitor_camera
from hilstar.display.render.reference import linear_image
from hilstar.instruments.campaign.display_tracker import DisplayTracker
from hilstar.instruments.simulate.shutter import RowBeat, rolled
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.instruments.simulate.twin import Twin, exposure_phase_s
from hilstar.optics.exposure_motion import Motion
from hilstar.optics.layers.layers import light_of
from hilstar.optics.layers.star_layer import StarLayer
from hilstar.optics.layers.view import Canvas, View
from hilstar.optics.psf import MAX_CUT, GaussianPsf
from hilstar.optics.scan import Scan
from hilstar.server.bench.bench_file import bench_file_of, read_bench_file
from hilstar.server.bench.frame import Bench
from hilstar.server.sync import Exposures, seen_at
from hilstar.tracker.detector import Detector
from hilstar.tracker.settings import DetectorSettings
from tests.support.bench_files import filed_bench
from tests.support.benches import ORION_Q, TWIN, bench_text
from tests.support.commands import run_hilstar_here
from tests.support.satellites import element_set
from tests.support.skies import STATION_TLE, STATION_UTC
from tests.support.stars import stars_at

IDENTITY = np.array([1.0, 0, 0, 0])
SIZE, ROW_S, EXPOSURE_S = (160, 120), 2e-4, 0.05
CAMERA = monitor_camera(SIZE, 13.0, 70.0, IDENTITY)
PSF = GaussianPsf((0.85, 0.6))
STEPS = 400
ROLLING = {"tracker.detector": {"shutter": "rolling", "row_time_us": 40.0}}
# three whole refreshes of a screen that scans out in nearly one, before rows that are exposed
# nearly at once
ROW_US, SCANOUT_MS, WHOLE_EXPOSURE_S = 1.0, 16.0, 0.05
VEGA_ALONE = {
    "tracker": {"exposure_s": WHOLE_EXPOSURE_S},
    "tracker.detector": {"shutter": "rolling", "row_time_us": ROW_US},
    "sky": {"faintest_v_mag": 0.2},
    "monitor": {"scanout_ms": SCANOUT_MS},
}
SCAN_OUT_TOLERANCE_PX = 0.03  # of 0.4 px that a screen's scan-out is worth


def star_on_pixel(x, y, z=CAMERA.focal_length_px):
    """A star of one electron per second at a pixel when the middle row is in the middle of its
    exposure.
    """
    at = np.array([[x - CAMERA.principal_point_px[0], y - CAMERA.principal_point_px[1], z]])
    return stars_at(at @ CAMERA.cam_to_image, np.ones(1))


def rolling_image(stars, rate, direction=1):
    view = View(
        IDENTITY, rate, scan=Scan((0, direction), SIZE[1] * ROW_S, EXPOSURE_S), exposed=True
    )
    return linear_image(
        light_of(Canvas(CAMERA, PSF), [StarLayer(Canvas(CAMERA, PSF))], stars, view), SIZE, PSF
    )


@pytest.mark.parametrize(
    ("rate_deg_s", "direction"), [((1.0, 0, 0), 1), ((-2.0, 0.5, 0), 1), ((1.0, -1.0, 20.0), -1)]
)
def test_each_row_has_its_own_exposure(rate_deg_s, direction):
    """Row by row the mean of instants of that row's own time: light, and places along both axes."""
    rate, stars = np.radians(np.array(rate_deg_s)), star_on_pixel(60.3, 30.6)
    exact, at = np.zeros(SIZE[::-1]), Motion(IDENTITY, rate, EXPOSURE_S)
    for row in range(10, 100):
        late_s = direction * (row - (SIZE[1] - 1) / 2) * ROW_S
        seconds = late_s + ((np.arange(STEPS) + 0.5) / STEPS - 0.5) * EXPOSURE_S
        places = CAMERA.project(at.icrs_to_image(seconds, CAMERA) @ stars.vectors[0])
        across, down = (
            np.diff(ndtr((np.arange(size + 1) - 0.5 - place[:, None]) / sigma))
            for size, place, sigma in zip(SIZE, places, PSF.sigma_px, strict=True)
        )
        exact[row] = down[:, row] @ across / STEPS
    found = rolling_image(stars, rate, direction)
    assert found.sum() == pytest.approx(exact.sum(), rel=2e-5)
    y, x = np.indices(found.shape)
    for place in (x, y):
        assert (found * place).sum() / found.sum() == pytest.approx(
            (exact * place).sum() / exact.sum(), abs=5e-4
        )
    # A PSF is not sheared by the rows that it covers: 0.04 px a row here.
    assert np.abs(found - exact).max() < 0.02 * exact.max()


def test_a_star_that_runs_with_the_rows_is_exposed_for_longer():
    """Closed form: with v px/s down the rows and t s a row, light grows by 1 / (1 - v t), and y
    by y t v / (1 - v t).
    """
    rate = np.radians(np.array([2.0, 0, 0]))
    # On the axis across the turn a star moves at f times the rate, but for 1 + tan^2.
    speed = np.sign(drawn_y(1e-3) - 59.5) * rate[0] * CAMERA.focal_length_px
    for y_px in (30.0, 59.5, 90.0):
        image, share = rolling_image(star_on_pixel(79.5, y_px), rate), speed * ROW_S
        assert image.sum() == pytest.approx(1 / (1 - share), rel=1e-4 + MAX_CUT)
        centre = (image.sum(axis=1) @ np.arange(SIZE[1])) / image.sum()
        assert centre - 59.5 == pytest.approx((y_px - 59.5) / (1 - share), abs=3e-3)


def drawn_y(seconds):
    """Where the star of the middle is after a time."""
    turned = CAMERA.cam_to_image @ to_matrix(
        propagate(IDENTITY, np.radians(np.array([2.0, 0, 0])), seconds)
    )
    return CAMERA.project(star_on_pixel(79.5, 59.5).vectors @ turned.T)[1][0]


def test_a_rolling_truth_is_where_the_light_is_and_a_still_one_is_global_bit_for_bit(tmp_path):
    shots = {}
    for name, tables in (("global", {}), ("rolling", ROLLING)):
        (tmp_path / f"{name}.toml").write_text(
            bench_text({"tracker": {"resolution_px": [128, 512]}, **tables})
        )
        with Simulator(read_bench_file(tmp_path / f"{name}.toml")) as tracker:
            still, turning = (
                tracker.view(np.array(ORION_Q), np.radians(rate))
                for rate in (np.zeros(3), np.array([2.0, 0, 0]))
            )
            shots[name] = [tracker.expose(view, None) for view in (still, turning)]
    assert (shots["global"][0].mean_e == shots["rolling"][0].mean_e).all()
    shot = shots["rolling"][1]
    inside = shot.truth[
        (np.abs(shot.truth["x_px"] - 64) < 50) & (np.abs(shot.truth["y_px"] - 256) < 225)
    ]
    row = inside[0]
    x, y = round(float(row["x_px"])), round(float(row["y_px"]))
    light = shot.mean_e[y - 22 : y + 23, x - 8 : x + 9]
    light = np.maximum(light - np.median(shot.mean_e) - 0.01 * light.max(), 0)
    centre = (light.sum(axis=1) @ np.arange(y - 22, y + 23)) / light.sum()
    assert centre == pytest.approx(float(row["y_px"]), abs=0.1)
    before = shots["global"][1].truth
    moved = row["y_px"] - before[before["name"] == row["name"]]["y_px"][0]
    assert abs(moved) == pytest.approx(
        abs(row["y_px"] - 255.5) * 2.0 * np.pi / 180 * 5385 * 40e-6, rel=0.05
    )


def test_a_scanning_display_makes_the_stripes_of_the_closed_form(tmp_path):
    """A screen lit for 4 ms of each 16.7, exposures of 2.4 refreshes: each row's glow by its own
    phase.
    """
    tables = {
        "tracker": {"resolution_px": [64, 480], "exposure_s": 0.04},
        "monitor": {"hold_ms": 4.0, "calibration": "lcd-example"},
        "sky": {"faintest_v_mag": 3.0},
    }
    means = {}
    for name, extra in (("global", {}), ("rolling", ROLLING)):
        (tmp_path / f"{name}.toml").write_text(bench_text({**tables, **extra}))
        tracker = DisplayTracker(read_bench_file(tmp_path / f"{name}.toml"))
        view = View.exposure(np.array(ORION_Q), np.zeros(3), 0.04)
        means[name] = tracker.expose(view, None).mean_e
        geometry, scan = tracker._optics.geometry, rolled(view, tracker.config.tracker).scan
        screen = tracker._bench.scan
        tracker.close()
    x, y = np.full(480, 2.0), np.arange(480.0)
    on_screen = geometry.to_monitor(x, y)
    assert (on_screen[1] > 0).all()
    late_s = scan.late_s(x, y, (64, 480)) - screen.late_s(*on_screen, (320, 240))
    # The middle rows of both begin together.
    wanted = seen_at(Exposures(60.0, 0.04, lit_s=4e-3), late_s * 60.0).light
    assert wanted.max() > 1.2 and wanted.min() < 0.9
    assert means["rolling"][:, 2] / means["global"][:, 2] == pytest.approx(wanted, abs=1e-6)
    # verify's twin has the same rows: triggered as that exposure, free at another phase each time.
    for trigger, alike in (("external", True), ("free", False)):
        path = tmp_path / f"{trigger}.toml"
        tracked = {**tables["tracker"], "trigger": trigger}
        path.write_text(bench_text({**tables, "tracker": tracked, **ROLLING}))
        with Twin(read_bench_file(path)) as twin:
            first, second = (twin.field(np.array(ORION_Q), number) for number in (0, 1))
        for field, same in ((first, alike), (second, alike)):
            assert np.allclose(field.shown_e + field.under_e, means["rolling"], rtol=1e-5) == same
        assert np.allclose(first.under_e, second.under_e, rtol=1e-5) == alike
        assert first.sky_e == pytest.approx(second.sky_e)


def test_a_moving_star_behind_a_rolling_shutter_sees_the_frames_of_its_own_rows(tmp_path):
    """The light of the stars of a turning display adds up, and their streaks lie where the sky's
    do.
    """
    (tmp_path / "bench.toml").write_text(
        bench_text(TWIN, ROLLING, {"sky": {"faintest_v_mag": 3.5}, "render": {"motion": "on"}})
    )
    file, centres, sums = read_bench_file(tmp_path / "bench.toml"), [], []
    display = DisplayTracker(file)
    with Simulator(file) as sky:
        for tracker in (sky, display):
            shot = tracker.expose(
                sky.view(np.array(ORION_Q), np.radians(np.array([1.0, 0, 0]))), None
            )
            light = shot.mean_e - np.median(shot.mean_e)
            light[light < 0.003 * light.max()] = 0
            sums.append(light.sum())
            centres.append((light.sum(axis=1) @ np.arange(400)) / light.sum())
    display.close()
    assert sums[1] == pytest.approx(sums[0], rel=0.05)
    assert centres[1] == pytest.approx(centres[0], abs=0.5)


@pytest.mark.parametrize("motion", ["on", "off"])
def test_a_still_picture_is_late_by_the_scan_out_which_drawing_along_the_path_takes_away(
    tmp_path, motion
):
    """A turn about the image's y axis moves a star above the middle by f tan(rate t). Its rows of
    the screen light early, so that more of each exposure is of later frames: without motion it
    stands where it will be by that time.
    """
    q = from_radec_roll_deg(279.2347, 38.7837 - 5.0, 0.0)
    display = DisplayTracker(
        filed_bench(tmp_path, TWIN, VEGA_ALONE, {"render": {"motion": motion}})
    )
    centres = []
    for rate_deg_s in (0.0, 2.0):
        view = View.exposure(q, np.radians(np.array([0.0, rate_deg_s, 0.0])), WHOLE_EXPOSURE_S)
        light_e = display.expose(view, None).mean_e
        light_e -= np.median(light_e)
        light_e[light_e < 0.003 * light_e.max()] = 0
        y, x = np.indices(light_e.shape)
        centres.append((light_e * x).sum() / light_e.sum())
        y_px = (light_e * y).sum() / light_e.sum()
    display.close()
    above_px = y_px - 199.5
    assert above_px < -160
    tracker_late_s = above_px * ROW_US * 1e-6
    screen_late_s = above_px * (120 / 0.05765) / (25 / 0.013) / 480 * SCANOUT_MS * 1e-3
    seconds = tracker_late_s if motion == "on" else tracker_late_s - screen_late_s
    moved_px = -25 / 0.013 * np.tan(np.radians(2.0) * seconds)
    assert centres[1] - centres[0] == pytest.approx(moved_px, abs=SCAN_OUT_TOLERANCE_PX)


@pytest.mark.parametrize(("motion", "later_s"), [("on", 0.0), ("off", 0.5 / 60)])
def test_each_frame_before_a_rolling_shutter_has_the_sky_of_its_own_time(
    tmp_path, monkeypatch, motion, later_s
):
    """The first of them begins with the exposure of the middle row; one that stands still shows
    the sky of the middle of its refresh.
    """
    drawn = []
    draw = Bench.draw

    def seen(bench, q, frame, rate_rad_s, t_ns):
        drawn.append((t_ns, q))
        return draw(bench, q, frame, rate_rad_s, t_ns=t_ns)

    monkeypatch.setattr(Bench, "draw", seen)
    tables = {
        "tracker": {"resolution_px": [64, 400]},
        "sky": {"faintest_v_mag": 0.2},
        "render": {"motion": motion, "quantisation": "round"},
    }
    display = DisplayTracker(filed_bench(tmp_path, tables, ROLLING))
    q, rate_rad_s, at_ns = np.array(ORION_Q), np.radians([0.3, 1.0, -0.5]), 7 * NS_PER_S
    display.expose(View.exposure(q, rate_rad_s, 3 / 60, at_ns), None)
    display.close()
    since_s = np.array([t_ns - at_ns for t_ns, _ in drawn]) / NS_PER_S
    frames = (since_s - later_s + 1.5 / 60) * 60
    assert frames == pytest.approx(np.arange(len(frames)) + round(frames[0]), abs=1e-6)
    # rows lie 8 ms before and after the middle one: some see the frame before, some that after
    assert round(frames[0]) <= -1 and round(frames[-1]) >= 3
    for t_s, (_, shown_q) in zip(since_s, drawn, strict=True):
        assert shown_q == pytest.approx(propagate(q, rate_rad_s, t_s), abs=1e-9)


@pytest.mark.parametrize("has_satellites", [False, True])
def test_a_tracker_at_rest_sees_a_new_picture_of_each_frame_where_satellites_pass(
    tmp_path, monkeypatch, has_satellites
):
    """Before a rolling shutter; a sky without them is drawn once."""
    drawn_ns = []
    draw = Bench.draw

    def seen(bench, q, frame, rate_rad_s, t_ns):
        drawn_ns.append(t_ns)
        return draw(bench, q, frame, rate_rad_s, t_ns=t_ns)

    monkeypatch.setattr(Bench, "draw", seen)
    (tmp_path / "station.tle").write_text(STATION_TLE)
    (tmp_path / "tles.txt").write_text("S\n" + element_set(5, (10.0, 0.0, 0.0, 0.0), 0.001, 14.0))
    tables = {
        "tracker": {"resolution_px": [64, 400]},
        "sky": {"faintest_v_mag": 0.2, "epoch_utc": STATION_UTC},
        "spacecraft": {"orbit": "station.tle"},
        "render": {"quantisation": "round"},
    }
    if has_satellites:
        tables["sky.bodies"] = {"satellites": "tles.txt"}
    display = DisplayTracker(filed_bench(tmp_path, tables, ROLLING))
    view = View.exposure(np.array(ORION_Q), np.zeros(3), 3 / 60, 7 * NS_PER_S)
    display.expose(view, None)
    display.close()
    if not has_satellites:
        assert len(drawn_ns) == 1
        return
    # rows lie 8 ms before and after the middle one: five frames and those that begin within
    assert len(drawn_ns) >= 5
    assert np.diff(drawn_ns) == pytest.approx(NS_PER_S / 60, abs=1)


def test_frame_transfer_smears_each_column_by_its_light(tmp_path):
    settings = DetectorSettings(
        shutter="frame-transfer", row_shift_us=2.0, gain_e_per_dn=1.0, bits=16
    )
    light = np.zeros((50, 40))
    light[20, 7], light[3, 9] = 60_000.0, 20_000.0
    seen = Detector(settings, (40, 50)).expose_noiseless(light, 0.01)
    smear = light.sum(axis=0) * 2e-6 / 0.01
    assert (seen == np.rint(light + smear)).all()
    assert seen[40, 7] == 12
    plain = Detector(DetectorSettings(gain_e_per_dn=1.0, bits=16), (40, 50))
    assert (plain.expose_noiseless(light, 0.01) == np.rint(light)).all()
    tables = {
        "tracker.detector": {"shutter": "frame-transfer", "row_shift_us": 5.0},
        "background": {"electrons_per_px": 3000, "gradient_electrons_across": [300, 0]},
    }
    (tmp_path / "bench.toml").write_text(bench_text(TWIN, tables))
    with Twin(read_bench_file(tmp_path / "bench.toml")) as twin:
        seen = twin.detected_dn(twin.field(np.array(ORION_Q), 0), np.random.default_rng(1))
        rows, exposure_s = seen.shape[0], twin.config.tracker.exposure_s
        step_e = twin.config.tracker.detector.gain_e_per_dn
    # 60 e- that the mean background's smear would leave
    smeared_e = 3000 * rows * 5e-6 / exposure_s
    assert abs(np.median(seen) * step_e) < 0.2 * smeared_e


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        (
            {"shutter": "rolling"},
            'row_time_us = 0 with shutter = "rolling"; write row_time_us above 0',
        ),
        (
            {"row_shift_us": 2.0},
            (
                'row_shift_us = 2 with shutter = "global"; write row_shift_us = 0, or shutter ='
                ' "frame-transfer"'
            ),
        ),
        ({"shutter": "curtain"}, "shutter"),
        ({"shutter": "rolling", "row_time_us": 1e4}, "shorten row_time_us or turn more slowly"),
    ],
)
def test_a_wrong_shutter_is_one_line(tmp_path, keys, said):
    (tmp_path / "bench.toml").write_text(bench_text({"tracker.detector": keys}))
    done = run_hilstar_here(
        f"simulate {tmp_path}/bench.toml --radec 84,0,0 --slew 2,0,0 --png {tmp_path}/a.png"
    )
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("hold_s", [0.004, 0.01])
def test_the_frames_of_an_exposure_of_whole_refreshes_have_all_of_its_light(hold_s):
    """Of a screen whose rows flash, or are lit all the time."""
    period_s = 0.01
    rows = Scan((0, 1), 0.02, 3 * period_s)
    beat = RowBeat(rows, Scan((0, 1), 0.009, hold_s), period_s, phase_s=0.0013)
    screen_s, row_s = np.array([-0.0045, 0.0, 0.0045]), np.array([-0.01, 0.0031, 0.01])
    shares = sum(beat.shares(frame, screen_s, row_s) for frame in beat.frames)
    np.testing.assert_allclose(shares, 1.0, rtol=1e-12)


@pytest.mark.parametrize("direction", ["down", "up"])
def test_rows_are_exposed_in_the_order_that_the_bench_file_says_in_microseconds(
    tmp_path, direction
):
    """100 rows of 40 us: the first and the last are exposed 3.96 ms apart, about the middle."""
    detector = {"shutter": "rolling", "row_time_us": 40.0, "row_direction": direction}
    tracker = filed_bench(
        tmp_path, {"tracker": {"resolution_px": [80, 100]}, "tracker.detector": detector}
    ).config.tracker
    view = rolled(View(IDENTITY, np.zeros(3)), tracker)
    late_s = view.scan.late_s(np.array([3.0, 3.0, 70.0]), np.array([0.0, 99.0, 49.5]), (80, 100))
    first_s = -99 / 2 * 40e-6 if direction == "down" else 99 / 2 * 40e-6
    assert late_s == pytest.approx([first_s, -first_s, 0.0], abs=1e-9)


def test_a_triggered_exposure_begins_with_its_frame_and_a_free_one_anywhere_in_it():
    """From the middle of an exposure of 30 ms, at 50 Hz."""

    def phases_s(trigger: str) -> list[float]:
        text = bench_text({"tracker": {"trigger": trigger, "exposure_s": 0.03}})
        tracker = bench_file_of(Path("bench.toml"), text).config.tracker
        return [exposure_phase_s(tracker, 50.0, frame) for frame in range(200)]

    assert set(phases_s("external")) == {-0.015}
    free_s = np.sort(phases_s("free"))
    assert free_s[0] == 0.0 and free_s[-1] < 0.02
    # 200 moments fill a refresh evenly: none is farther from the next than three 200ths of it
    assert np.diff(free_s).max() < 3 * 0.02 / 200
