"""Stars' spectra through a glass, and where it acts: the virtual tracker, the display's twin,
and benches that have none.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.errors import InputError
from hilstar.basics.units import NS_PER_S
from hilstar.display.geometry import monitor_camera
from hilstar.instruments.campaign.plan import Centroiding, parse_plan
from hilstar.instruments.campaign.run import Campaign
from hilstar.instruments.campaign.session import Session
from hilstar.instruments.campaign.solvers import CENTROIDS, choose_solver
from hilstar.instruments.campaign.tally import attitude_error_arcsec
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.instruments.simulate.exposures import faulty_exposure
from hilstar.instruments.simulate.glass import _in_glass_square, told_psf
from hilstar.instruments.simulate.optics import TwinOptics
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.optics.camera import Camera, Lens
from hilstar.optics.glass.glass_psf import GlassPsf, NodeSpline
from hilstar.optics.glass.psf_file import glass_of, write_glass
from hilstar.optics.psf import GaussianPsf
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.cameras import tracker_camera, tracker_psf
from hilstar.server.bench.glass import Onto, _glass_on_display, say_once
from hilstar.server.bench.scenario import parse_scenario
from hilstar.server.bench.star_glass import BAND_NM, StarGlass
from hilstar.server.bench.star_light import bench_stars
from hilstar.server.bench.star_rates import bench_optics
from hilstar.sky.electrons import electron_response
from hilstar.sky.spectrum import Curve, blackbody_exitance_w_m2_m
from hilstar.tracker.centroiders import psf_places, star_places
from tests.support.benches import ORION_Q, bench_text
from tests.support.campaigns import plan_text
from tests.support.commands import run_hilstar_here
from tests.support.glass import SIDE_PX, WAVELENGTHS_NM, illumination, moments, stack, truth

SHARES = 1e-3  # bands of 25 nm against the integral: measured 4e-4
TRACKER = {
    "resolution_px": [SIDE_PX, SIDE_PX],
    "focal_length_mm": 12,
    "exposure_s": 0.2,
    "transmission": None,
}


usual_glass = cache(lambda: glass_of(stack()))


@pytest.fixture
def glass_file(tmp_path):
    say_once.cache_clear()

    def make(*changes, **glass):
        write_glass(tmp_path / "psf.fits", glass_of(stack(), **glass) if glass else usual_glass())
        tables = {
            "tracker": TRACKER,
            "tracker.optics": {"psf": "psf.fits"},
            "sky": {"spectrum": "blackbody"},
        }
        (tmp_path / "bench.toml").write_text(bench_text(tables, *changes))
        return read_bench_file(tmp_path / "bench.toml")

    return make


def test_a_star_s_shares_are_its_spectrum_times_the_quantum_efficiency(glass_file):
    file = glass_file()
    psf = tracker_psf(file.config.tracker, file.folder)
    stars = bench_stars(file.config, file.folder)
    which = np.array([int(np.abs(stars.bv_mag - bv).argmin()) for bv in (-0.25, 0.0, 0.6, 1.6)])
    found = StarGlass(file, psf).shares(stars, which)
    nm, response = electron_response(bench_optics(file.config.tracker, file.folder))
    for temperature_k, shares in zip(stars.temperature_k[which], found, strict=True):
        light = response * blackbody_exitance_w_m2_m(nm, np.array([temperature_k])[:, None])[0]
        assert shares == pytest.approx(
            light @ NodeSpline(np.array(WAVELENGTHS_NM))(nm) / light.sum(), abs=SHARES
        )
    finer = StarGlass(file, psf, band_nm=BAND_NM / 2).shares(stars, which)
    assert found == pytest.approx(finer, abs=SHARES)


def test_shares_by_hipparcos_number_are_those_of_the_star_in_whatever_order(glass_file):
    """The catalogue has them by declination; light without a number has the mean spectrum."""
    file = glass_file({"sky": {"faintest_v_mag": 3}})
    glass = StarGlass(file, tracker_psf(file.config.tracker, file.folder))
    stars = bench_stars(file.config, file.folder)
    which = np.array([31, 0, 57, 4])
    found = glass.shares_of(stars, np.append(stars.hip[which], 0))
    assert np.array_equal(found, glass.shares(stars, np.append(which, -1)))
    assert np.ptp(found, axis=0).max() > SHARES


GLOW = """seed = 5
[[fault]]
kind = "glow"
name = "lamp"
at_s = 0.5
tracker_px = [3, 40]
electrons_per_s = 500.0
scale_deg = 4.0
"""


def test_stray_light_is_added_to_stars_behind_a_glass_once(glass_file, tmp_path):
    """As the law of its light has it about a place, and nowhere more."""
    with Simulator(glass_file()) as simulator:
        view = simulator.view(np.array(ORION_Q), np.zeros(3))
        plain_e = simulator.expose(view, None).mean_e
        scenario = parse_scenario(tmp_path / "faults.toml", GLOW)
        faults = faulty_exposure(simulator, [view], scenario, NS_PER_S)
        added_e = simulator.expose(view, None, faults=faults).mean_e - plain_e
        rays = simulator.camera.rays(*simulator.camera.grid_px(SIDE_PX))
    lamp = simulator.camera.rays(np.array([3.0]), np.array([40.0]))[0]
    lengths = np.linalg.norm(rays, axis=1) * np.linalg.norm(lamp)
    angle_deg = np.degrees(np.arccos(np.minimum(rays @ lamp / lengths, 1)))
    wanted_e = 0.2 * 500 / (1 + (angle_deg / 4) ** 2)
    share = added_e.ravel() / wanted_e
    assert np.quantile(share, [0.03, 1.0]) == pytest.approx([1.0, 1.0], abs=0.01)
    # what a measured PSF has below 0 is cut, and so is less of the lamp there
    assert plain_e.min() == 0.0 and share.min() < 0.9


@pytest.mark.parametrize("spectrum", ["pickles", "mk"])
def test_every_model_of_spectra_makes_red_stars_redder(glass_file, spectrum):
    file = glass_file({"sky": {"spectrum": spectrum}})
    stars = bench_stars(file.config, file.folder)
    which = np.array([int(np.abs(stars.bv_mag - bv).argmin()) for bv in (0.0, 1.5)])
    blue, red = StarGlass(file, tracker_psf(file.config.tracker, file.folder)).shares(stars, which)
    assert blue.sum() == pytest.approx(1)
    assert red.sum() == pytest.approx(1)
    assert blue[0] > red[0] + 0.1
    added = StarGlass(file, tracker_psf(file.config.tracker, file.folder)).shares(
        stars, np.array([-1])
    )[0]
    assert added.sum() == pytest.approx(1)


def test_the_virtual_tracker_draws_each_star_by_its_place_and_colour(glass_file):
    with Simulator(glass_file({"sky": {"faintest_v_mag": 5}})) as simulator:
        exposure = simulator.expose(simulator.view(np.array(ORION_Q), np.zeros(3)), None)
        shares = {}
        for row in exposure.truth:
            star = int(np.flatnonzero(simulator.stars.hip == row["hip"])[0])
            shares[int(row["hip"])] = simulator.glass.shares(simulator.stars, np.array([star]))[0]
    checked = 0
    table = exposure.truth
    for row in table:
        far = np.hypot(table["x_px"] - row["x_px"], table["y_px"] - row["y_px"])
        if np.sum(far < 20) > 1:
            continue
        column, line = round(row["x_px"]), round(row["y_px"])
        part = exposure.mean_e[line - 7 : line + 8, column - 7 : column + 8]
        if part.shape != (15, 15):
            continue
        wanted = moments(truth(row["x_px"], row["y_px"], shares[int(row["hip"])], 15))
        light = row["electrons_per_s"] * TRACKER["exposure_s"]
        own = moments(part)
        assert own[0] == pytest.approx(
            wanted[0] * light * illumination(row["x_px"], row["y_px"]), rel=2e-3
        )
        assert own[1:3] == pytest.approx(wanted[1:3], abs=5e-3)
        assert column + own[1] == pytest.approx(row["x_centroid_px"], abs=5e-3)
        assert line + own[2] == pytest.approx(row["y_centroid_px"], abs=5e-3)
        assert row["relative_illumination"] == pytest.approx(
            illumination(row["x_px"], row["y_px"]), abs=1e-4
        )
        checked += 1
    assert checked > 8


def test_smear_goes_along_with_it(glass_file):
    """The mean of an exposure that turns is that of many still ones: 64 of them."""
    with Simulator(glass_file({"sky": {"faintest_v_mag": 5}})) as simulator:
        rate = np.radians([1.0, 0.7, 0.0])
        turning = simulator.expose(simulator.view(np.array(ORION_Q), rate), None).mean_e
        still = np.zeros_like(turning)
        motion = simulator.view(np.array(ORION_Q), rate)
        from hilstar.basics.rotation import propagate

        for k in range(64):
            q = propagate(
                motion.q_icrs_to_cam, rate, ((k + 0.5) / 64 - 0.5) * TRACKER["exposure_s"]
            )
            still += simulator.expose(simulator.view(q, np.zeros(3)), None).mean_e / 64
    assert np.abs(turning - still).max() < 2e-3 * turning.max()


def test_the_monitor_s_light_goes_through_the_glass_by_place(glass_file):
    """A monitor pixel of 0.4 tracker pixels has the centroid of the mean PSF of its place, and
    is dimmed as that is.
    """
    file = glass_file()
    tracker, psf = (
        tracker_camera(file.config.tracker, file.folder),
        tracker_psf(file.config.tracker, file.folder),
    )
    monitor = monitor_camera((320, 240), 57.65, 120.0, np.array([1.0, 0.0, 0.0, 0.0]))
    light = np.zeros((240, 320))
    light[200, 20] = 5e4
    with TwinOptics(BenchGeometry(monitor, tracker), psf) as optics:
        image = optics.image_e_per_s(light)
        (x_px,), (y_px,) = optics.geometry.to_tracker(np.array([20.0]), np.array([200.0]))
    part = moments(image[round(y_px) - 9 : round(y_px) + 10, round(x_px) - 9 : round(x_px) + 10])
    (x,), (y,), (dimmed,) = psf.centroids_px(np.array([x_px]), np.array([y_px]), psf.mean_shares)
    assert abs(x - x_px) > 0.02
    assert (round(x_px) + part[1], round(y_px) + part[2]) == pytest.approx((x, y), abs=3e-3)
    assert part[0] == pytest.approx(5e4 * dimmed, rel=1e-3)


def test_a_campaign_varies_the_focus(glass_file, tmp_path):
    glass_file({"tracker.detector": {"gain_e_per_dn": 5, "full_well_e": 70000}})
    write_glass(tmp_path / "psf.fits", glass_of(stack(3, focuses_um=(0.0, 10.0))))
    (tmp_path / "plan.toml").write_text(
        plan_text(
            {"key": "tracker.optics.focus_um", "values": [0.0, 8.0]},
            {"key": "tracker.optics.temperature_k", "minimum": 283.0, "maximum": 303.0},
            {"key": "tracker.optics.decentre_x_um", "values": [0.0, 5.0]},
            cases=2,
        )
    )
    campaign = Campaign(tmp_path / "plan.toml", tmp_path / "out", CENTROIDS, 1.0, False)
    session = Session(campaign.job)  # as a worker has it
    rows = session.run(0, campaign.design.points(0, 2)).rows
    session.close()
    assert [row["status"] for row in rows] == ["done", "done"]
    assert {row["vary.tracker.optics.focus_um"] for row in rows} <= {0.0, 8.0}
    assert rows[0]["bench_sha256"] != rows[1]["bench_sha256"]


def test_a_bench_takes_distortion_and_transmission_of_its_glass_where_it_has_none(
    glass_file, caplog
):
    lens, curve = Lens((0.05, 0.0, 0.0)), Curve(np.array([300.0, 1100.0]), np.array([0.5, 0.5]))
    file = glass_file(lens=lens, transmission=curve)
    assert tracker_camera(file.config.tracker, file.folder).lens.radial == (0.05, 0.0, 0.0)
    assert bench_optics(file.config.tracker, file.folder).transmission(np.array([550.0]))[0] == 0.5
    (file.folder / "flight.toml").write_text("k1 = 1.0\n")
    own = glass_file(
        {"tracker": {"distortion": "flight.toml", "transmission": 0.7}},
        lens=lens,
        transmission=curve,
    )
    assert tracker_camera(own.config.tracker, own.folder).lens.radial == (1.0, 0.0, 0.0)
    assert bench_optics(own.config.tracker, own.folder).transmission(np.array([550.0]))[0] == 0.7
    assert "px from that of [tracker] distortion, which is taken" in caplog.text
    assert "its transmission is not used" in caplog.text


@pytest.mark.parametrize(
    ("star_px", "middle"), [(20.0, 20), (20.4, 20), (20.6, 21), (20.5, 21), (19.5, 20)]
)
def test_a_glass_s_square_is_about_the_pixel_whose_half_sides_hold_the_star(star_px, middle):
    """Of five pixels, the first of which is 1 in a square that is padded by dark: 0 and 6."""
    pixels = np.array([np.arange(15, 27), np.arange(35, 47)])
    squares = _in_glass_square(pixels, np.array([star_px, star_px + 20.0]), 5)
    first = middle - 2
    wanted = [min(max(pixel - first + 1, 0), 6) for pixel in range(15, 27)]
    assert squares.tolist() == [wanted, wanted]
    assert wanted.count(3) == 1


def test_a_told_glass_is_what_is_drawn_about_a_pixel_at_each_star_s_place(glass_file):
    """Four stars in two corners and near the middle of a field that is not symmetric, each in the
    square about a pixel that may be beside the nearest.
    """
    file = glass_file()
    glass = tracker_psf(file.config.tracker, file.folder)
    x_px, y_px = np.array([[30.2, 60.4, 200.6, 225.3], [170.7, 40.1, 90.8, 215.9]])
    rows, columns = np.rint(y_px + 0.3).astype(int), np.rint(x_px - 0.3).astype(int)
    told = told_psf(glass, (rows, columns), 13)(x_px - columns, y_px - rows)
    drawn = glass.image(x_px, y_px, glass.mean_shares, np.ones(4), (SIDE_PX, SIDE_PX))
    for square, row, column in zip(told, rows, columns, strict=True):
        about = drawn[row - 6 : row + 7, column - 6 : column + 7]
        # drawn in float32
        assert square == pytest.approx(about, abs=1e-6)
        assert square.sum() > 0.9


@pytest.mark.parametrize(
    ("resolution_px", "moved_px", "beyond_px"),
    [
        ((SIDE_PX + 44, SIDE_PX), (0, 20), 48),  # a corner: the hypotenuse of 44 and 20
        ((SIDE_PX + 44, SIDE_PX), (30, 0), 30),  # on the left; 14 are left on the right
        ((SIDE_PX, SIDE_PX + 44), (0, 30), 30),
        ((SIDE_PX, SIDE_PX + 44), (20, 0), 48),
    ],
)
def test_how_far_a_detector_reaches_beyond_the_points_is_told_of_its_farthest_corner(
    glass_file, caplog, resolution_px, moved_px, beyond_px
):
    """Points from corner to corner of a square, which the lens moves by its decentre."""
    right_um, down_um = (10.0 * px for px in moved_px)
    tracker = glass_file(
        {
            "tracker": {"resolution_px": resolution_px, "pixel_pitch_um": 10.0},
            "tracker.optics": {"decentre_x_um": right_um, "decentre_y_um": down_um},
        }
    )
    tracker_psf(tracker.config.tracker, tracker.folder)
    assert f"reaches {beyond_px} px beyond the file's points" in caplog.text


def test_a_turned_display_has_the_lens_s_points_and_its_lateral_colour_turned(rng):
    """By 30 degrees, and 1.5 of its pixels to one of the tracker's: both without distortion."""
    turn = Rotation.from_euler("z", 30.0, degrees=True).as_matrix()
    middle_px = (127.5, 100.0)
    tracker = Camera((SIDE_PX, SIDE_PX), 1000.0, middle_px, np.eye(3))
    display = Camera((800, 600), 1500.0, (400.0, 300.0), turn)
    lateral_px = rng.normal(size=usual_glass().lateral_px.shape)
    glass = replace(usual_glass(), lateral_px=lateral_px)
    shown = _glass_on_display(glass, Onto(display, tracker))
    onto_display = 1.5 * turn[:2, :2]
    off_px = glass.places_px - middle_px
    wanted_px = np.array([400.0, 300.0]) + off_px @ onto_display.T
    assert shown.places_px == pytest.approx(wanted_px, abs=2e-6)
    moved_px = lateral_px.reshape(-1, 2) @ onto_display.T
    # `matrix` is by differences, good to 1e-9
    assert shown.lateral_px.reshape(-1, 2) == pytest.approx(moved_px, abs=1e-6)


def test_what_the_file_does_not_cover_is_said(glass_file, caplog):
    wide = glass_file(
        {"tracker": {"resolution_px": [300, SIDE_PX]}, "tracker.optics": {"focus_um": 7.0}}
    )
    assert isinstance(tracker_psf(wide.config.tracker, wide.folder), GlassPsf)
    optics = bench_optics(wide.config.tracker, wide.folder)
    nm = np.arange(250.0, 1200.0, 0.5)
    response = optics.quantum_efficiency(nm) * optics.transmission(nm)
    told = dict(re.findall(r"(under|over) the file's (\d+) nm", caplog.text))
    assert told == {"under": "450", "over": "750"}
    percents = [int(text) for text in re.findall(r"(\d+)% of the light is", caplog.text)]
    for percent, is_beyond in zip(percents, (nm < 450, nm > 750), strict=True):
        assert percent == pytest.approx(100 * response[is_beyond].sum() / response.sum(), abs=0.6)
    for words in (
        "44 px beyond the file's points",
        "focus_um = 7 is beyond",
    ):
        assert words in caplog.text


def test_a_glass_of_one_point_is_the_same_all_over_the_detector_without_a_word(glass_file, caplog):
    file = glass_file()
    write_glass(file.folder / "psf.fits", glass_of(stack(1)))
    psf = tracker_psf(file.config.tracker, file.folder)
    assert isinstance(psf, GlassPsf)
    assert "beyond" not in caplog.text


@pytest.mark.parametrize("psf", ["glass", "gaussian"])
def test_a_fit_of_the_psf_that_it_is_told_finds_the_chief_ray(glass_file, psf):
    """To 6e-3 px between the points of its file (measured 4.6e-3); the Gaussian sees the light
    beside it.
    """
    file = glass_file() if psf == "glass" else None
    glass = tracker_psf(file.config.tracker, file.folder) if file else GaussianPsf((0.6, 0.7))
    rng = np.random.default_rng(3)
    places = rng.uniform(15, SIDE_PX - 15, (2, 40))
    shares = rng.dirichlet(np.ones(4), 40) if file else None
    # not always the nearest
    pixels = np.rint(places[1] + 0.2).astype(int), np.rint(places[0] - 0.2).astype(int)
    offs = places[0] - pixels[1], places[1] - pixels[0]
    stamps = 1e5 * told_psf(glass, pixels, 17, shares)(*offs)

    def off_px(told_shares, told=glass, image=stamps):
        found = psf_places(
            image,
            told_psf(told, pixels, 17, told_shares),
            star_places(image, "window", told.width_px),
        )
        return np.hypot(*(np.stack(found) - np.stack(offs)))

    assert off_px(shares).max() < 1e-4
    assert off_px(shares, image=stamps + rng.normal(0, 30, stamps.shape)).max() < 0.02
    assert np.isfinite(off_px(shares, image=np.zeros_like(stamps))).all()
    if file:
        # about the nearest pixel
        exact = np.stack([truth(x, y, own, 17) for x, y, own in zip(*places, shares, strict=True)])
        pixels = tuple(np.floor(places[::-1] + 0.5).astype(int))
        offs = places[0] - pixels[1], places[1] - pixels[0]
        right, white = off_px(shares, image=exact), off_px(None, image=exact)
        assert (
            right.max()
            < 6e-3
            < white.mean()
            < off_px(None, GaussianPsf(glass.width_px), exact).mean()
        )


def test_a_campaign_s_centroider_fits_the_psf_that_the_plan_tells_it(glass_file):
    """No noise: the right PSF finds stars to a DN's rounding, a wrong one does not, and a focus
    that is off costs more.
    """
    file = glass_file()
    rms = {}
    with Simulator(file) as tracker:
        shot = tracker.expose(tracker.view(np.array(ORION_Q), np.zeros(3)), None)
        for name, keys in (
            ("window", {}),
            ("psf", {"centroider": "psf"}),
            ("mean", {"centroider": "psf", "psf_spectrum": "mean"}),
            ("gaussian", {"centroider": "psf", "psf": "gaussian"}),
            ("file", {"centroider": "psf", "psf": "psf.fits"}),
        ):
            solver = choose_solver("centroids", Centroiding(**keys), file.folder, 60.0, file.folder)
            errors = solver.solve(shot, tracker).star_errors
            bright = errors.v_mag < 6
            assert bright.sum() >= 8
            rms[name] = float(
                np.sqrt(np.mean(errors.dx_px[bright] ** 2 + errors.dy_px[bright] ** 2))
            )
    assert rms["psf"] < 0.02
    assert rms["file"] == pytest.approx(rms["psf"], abs=1e-6)
    assert rms["psf"] < rms["mean"] < rms["gaussian"]
    assert rms["window"] > 5 * rms["psf"]


def test_a_told_psf_without_its_centroider_is_refused(tmp_path):
    for keys in ('psf = "gaussian"', 'centroider = "psf"\npsf_focus_um = 3.0'):
        with pytest.raises(InputError, match=r"\[centroids\] psf"):
            parse_plan(
                tmp_path / "plan.toml", f'bench = "b.toml"\ncases = 1\n[centroids]\n{keys}\n'
            )


def test_verify_names_the_glass_and_the_psf_centroider_mends_it(glass_file, tmp_path):
    """Coma and lateral colour of 0.3 px in the corners: a window has stars beside their chief
    rays.
    """
    found = {}
    for kind in ("window", "psf"):
        glass_file(
            {
                "verify": {"centroider": kind, "centroid_px": 0.05, "flux_mag": 0.5},
                "sky": {"faintest_v_mag": 4.5},
            }
        )
        found[kind] = json.loads(
            run_hilstar_here("verify", tmp_path / "bench.toml", "--fields", "1", "--json").stdout
        )
    assert found["psf"]["centroider"] == "psf"
    assert found["psf"]["centroid_error_px_by"]["psf"]["rms"] < 0.1
    said, mended = (" ".join(found[kind]["reasons"]) for kind in ("window", "psf"))
    assert (
        "the glass of [tracker.optics] psf has centroids" in said
        and '[verify] centroider = "psf" fits it' in said
    )
    assert "chief rays" not in mended


def test_a_warmer_or_decentred_lens_moves_focus_scale_and_place(glass_file):
    """Through the keys' own coefficients; the flight software knows nothing of it, so its
    attitude is off by the decentring.
    """
    still = glass_file()
    write_glass(still.folder / "psf.fits", glass_of(stack(3, focuses_um=(0.0, 10.0))))
    warm = {"temperature_k": 303.0, "focus_um_per_k": 0.6, "focal_length_ppm_per_k": 20.0}
    cameras, psfs = [], []
    for keys in ({"focus_um": 6.0}, warm, {"focus_um": 6.0, "decentre_x_um": 26.0}):
        tables = {
            "tracker": TRACKER,
            "tracker.optics": {"psf": "psf.fits", **keys},
            "sky": {"spectrum": "blackbody"},
        }
        (still.folder / "bench.toml").write_text(bench_text(tables))
        file = read_bench_file(still.folder / "bench.toml")
        cameras.append(tracker_camera(file.config.tracker, file.folder))
        psfs.append(tracker_psf(file.config.tracker, file.folder))
    assert cameras[1].focal_length_px == pytest.approx(
        cameras[0].focal_length_px * (1 + 200e-6), rel=1e-12
    )
    assert cameras[2].principal_point_px[0] == cameras[0].principal_point_px[0] + 2.0
    x, y = np.array([60.0]), np.array([200.0])
    lit = [
        psf.stamps_at(at, y, psf.mean_shares, np.ones(1))
        for psf, at in zip(psfs, (x, x, x + 2), strict=True)
    ]
    assert lit[1] == pytest.approx(lit[0], abs=1e-7)
    assert lit[2] == pytest.approx(lit[0], abs=1e-4)
    with Simulator(file) as tracker:
        shot = tracker.expose(tracker.view(np.array(ORION_Q), np.zeros(3)), None)
        solver = choose_solver("centroids", Centroiding(centroider="psf"), file.folder, 60.0)
        q = solver.solve(shot, tracker).q_icrs_to_cam
    off = attitude_error_arcsec(np.array(ORION_Q), q)
    assert np.abs(off[1]) == pytest.approx(np.degrees(2 * 13e-3 / 12) * 3600, rel=0.02)
    assert np.abs(off[0]) < 20


def test_a_gaussian_has_no_focus_that_a_temperature_could_move(tmp_path):
    (tmp_path / "bench.toml").write_text(bench_text({"tracker.optics": {"focus_um_per_k": 1.0}}))
    done = run_hilstar_here(
        "simulate", tmp_path / "bench.toml", "--radec", "84,0,0", "--png", tmp_path / "a.png"
    )
    assert done.returncode == 2
    assert "focus_um_per_k: a Gaussian has no focus; give psf a file" in done.stderr
