"""The bench file that photographs give of a tracker, against the figures of a made session."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from hilstar.instruments.confront import measured_bench
from hilstar.instruments.confront.background import FixedPattern, SkyLevel
from hilstar.instruments.confront.camera_fit import CameraFit
from hilstar.instruments.confront.images import Photograph
from hilstar.instruments.confront.light import NO_CORRECTION, LightFit
from hilstar.instruments.confront.measured_bench import (
    fixed_camera,
    read_tracker_file,
    write_tracker,
)
from hilstar.instruments.confront.photon_transfer import PixelFit
from hilstar.instruments.confront.run import _judged_by
from hilstar.instruments.confront.star_psf import StarPsf
from hilstar.optics.camera import Camera, Lens
from tests.support.confrontations import a_session, a_shot
from tests.support.psfs import gaussian, sampled

GIVEN = """
[tracker]
aperture_mm = 20.0
focal_length_mm = 19.0
pixel_pitch_um = 5.0
resolution_px = [1280, 960]
quantum_efficiency = 0.5
transmission = 0.8
exposure_s = 0.2
frame_hz = 4.0
[tracker.detector]
read_noise_e = 3.0
"""
SCREEN = """
[monitor]
resolution_px = [2560, 1440]
pixel_pitch_um = 233.0
[collimator]
focal_length_mm = 800.0
"""
SIZE_PX = (640, 480)  # a mosaic's plane: its pixels are twice as wide
CAMERA = Camera(
    SIZE_PX, 1950.0, (321.5, 236.25), np.eye(3), Lens((0.21, -0.4, 0.0), (1.5e-3, -2e-3))
)
GAIN, PEDESTAL_DN, LEVEL_DN, FULL_DN = 0.4, 60.0, 110.0, 4095
PSF = StarPsf(np.array([[0.81], [0.49], [0.1]]), 0.03, 0.05, 2.5, SIZE_PX)
PIXELS = PixelFit(
    gain_e_per_dn=GAIN,
    pedestal_dn=PEDESTAL_DN,
    read_noise_e=4.0,
    step_dn=1.0,
    sigma={"gain_e_per_dn": 0.01},
    points=np.empty((0, 2)),
    pattern=FixedPattern((0.01**2, 5.0**2, 0.0, 0.0), (1e-9, 1e-9, 1.0, 1.0)),
    gain_told=True,
)
# of two photographs; their mean is 1 mag less light than the tracker's keys give
LIGHT = LightFit(np.array([0.7, 1.3]), (0.2, 0.1), NO_CORRECTION, 20.0, 0.1, 1.0)


def session_of(tmp_path, given=GIVEN, *, exposure_s=0.5, t_ns=None, **changed):
    (tmp_path / "given").mkdir(exist_ok=True)
    path = tmp_path / "given" / "bench.toml"
    path.write_text(given)
    file, has_screen = read_tracker_file(path)
    shots = []
    for name, level_dn in (("a.png", LEVEL_DN - 10), ("b.png", LEVEL_DN + 10)):
        dn = np.full((4, 4), level_dn)
        photo = Photograph(Path(name), dn, 1.0, FULL_DN, t_ns, exposure_s=exposure_s)
        velocity_km_s = np.array([1.0, -29.0, 2.0])
        shot = replace(a_shot(0), photo=photo, level=SkyLevel(dn, np.ones_like(dn), 16))
        shot.sky = replace(shot.sky, epoch_jyear=2020.1234567, velocity_km_s=velocity_km_s)
        shots.append(shot)
    fit = CameraFit(CAMERA, (), "focal length and lens", {"k1": 0.0031})
    parts = {"file": file, "shots": tuple(shots), "camera": fit, "pixels": PIXELS, "psf": PSF}
    return a_session(**(parts | {"light": LIGHT} | changed)), has_screen


def written(tmp_path, *args, **changed):
    session, has_screen = session_of(tmp_path, *args, **changed)
    folder = tmp_path / "out"
    folder.mkdir(exist_ok=True)
    path = write_tracker(folder, session, has_screen)
    return path, tomllib.loads(path.read_text())


def test_the_tracker_is_the_fitted_one_in_the_pixels_of_its_plane(tmp_path):
    path, tables = written(tmp_path)
    tracker = tables["tracker"]
    assert tracker["pixel_pitch_um"] == 10.0
    assert tracker["focal_length_mm"] == pytest.approx(19.5)
    assert tracker["resolution_px"] == list(SIZE_PX)
    assert tracker["principal_point_px"] == [321.5, 236.25]
    assert tracker["aperture_mm"] == 20.0
    distortion = (path.parent / "tracker_distortion.toml").read_text()
    assert tomllib.loads(distortion) == {"k1": 0.21, "k2": -0.4, "p1": 1.5e-3, "p2": -2e-3}
    assert "k1 = 0.21  # +- 0.0031\n" in distortion


@pytest.mark.parametrize(("exposure_s", "frame_hz"), [(0.1, 4.0), (0.5, 2.0), (0.7, 1 / 0.7)])
def test_frames_follow_as_given_or_one_exposure_after_the_other(tmp_path, exposure_s, frame_hz):
    path, tables = written(tmp_path, exposure_s=exposure_s)
    assert tables["tracker"]["frame_hz"] == frame_hz
    read_tracker_file(path)  # which refuses exposures that overlap


def test_the_detector_and_the_background_are_in_electrons(tmp_path):
    _, tables = written(tmp_path)
    detector = tables["tracker"]["detector"]
    assert detector == {
        "gain_e_per_dn": GAIN,
        "full_well_e": pytest.approx((FULL_DN - PEDESTAL_DN) * GAIN),
        "bits": 12,
        "offset_dn": PEDESTAL_DN,
        "read_noise_e": pytest.approx(4.0),
        "prnu": pytest.approx(0.01),
        "dsnu_e": pytest.approx(5.0 * GAIN),
    }
    light_e = (LEVEL_DN - PEDESTAL_DN) * GAIN
    assert tables["background"]["electrons_per_px"] == pytest.approx(light_e)


def test_steps_of_several_dn_are_noise_to_a_detector_of_steps_of_one(tmp_path):
    _, tables = written(tmp_path, pixels=replace(PIXELS, step_dn=16.0))
    rounding_dn = math.sqrt((16**2 - 1) / 12)
    noise_e = tables["tracker"]["detector"]["read_noise_e"]
    assert noise_e == pytest.approx(math.hypot(4.0, rounding_dn * GAIN))


@pytest.mark.parametrize(("line", "is_written"), [("", False), ("gain_e_per_dn = 0.9\n", True)])
def test_a_gain_that_nobody_told_is_no_key(tmp_path, line, is_written):
    _, tables = written(tmp_path, GIVEN + line, pixels=replace(PIXELS, gain_told=False))
    assert ("gain_e_per_dn" in tables["tracker"]["detector"]) == is_written


@pytest.mark.parametrize(
    ("fixed", "with_screen", "is_own"),
    [(True, True, True), (True, False, False), (False, True, False), (False, False, False)],
)
def test_a_fixed_camera_before_a_screen_alone_is_judged_by_its_own_file(
    tmp_path, fixed, with_screen, is_own
):
    session, has_screen = session_of(tmp_path, GIVEN + SCREEN * with_screen, fixed=fixed)
    bench, output = tmp_path / "given" / "bench.toml", tmp_path / "out"
    output.mkdir()
    tracker, names = _judged_by(bench, output, session, has_screen=has_screen)
    assert tracker == (bench if is_own else output / "tracker.toml")
    tables = ("index.html", "stars.csv", "sources.csv")
    assert names[:3] == tables
    assert sorted(path.name for path in output.iterdir()) == sorted(names[3:])
    assert (names == tables) is is_own


@pytest.mark.parametrize(("power", "words"), [(1.0, ""), (0.8, "to the power 1.2500.")])
def test_levels_that_were_made_linear_are_told_by_the_power_that_did_it(tmp_path, power, words):
    """A file's levels are a power of the light: the way back is its inverse."""
    text = written(tmp_path, power=power)[0].read_text()
    assert ("made linear" in text) is bool(words)
    assert words in text


def table_of(path):
    return np.loadtxt(path.parent / "tracker_qe.csv", delimiter=",", skiprows=1)


def test_the_efficiency_gives_the_light_that_came(tmp_path):
    """DN of the mean offset times the gain, over what the keys give in a second."""
    path, tables = written(tmp_path)
    share = GAIN * 10**-0.4 / 0.5
    assert tables["tracker"]["exposure_s"] == pytest.approx(0.5)
    assert table_of(path) == pytest.approx(np.array([[300, 0.5 * share], [1100, 0.5 * share]]))
    assert "Aperture and exposure are those that were given.\n" in path.read_text()


def test_more_light_than_an_efficiency_of_one_gives_is_a_longer_exposure(tmp_path):
    light = replace(LIGHT, offsets_mag=np.array([-2.0, -3.0]))
    path, tables = written(tmp_path, light=light, exposure_s=None)
    times = GAIN * 10 / 0.2 * 0.5  # 2.5 mag more, of the file's own exposure
    assert table_of(path)[:, 1] == pytest.approx(1.0)
    assert tables["tracker"]["exposure_s"] == pytest.approx(0.2 * times)
    assert f"exposure_s is {times:.3g} times it" in path.read_text()


def test_a_screen_that_is_not_given_fills_the_field(tmp_path):
    """19.5 mm by pixels of 10 um: 0.164 along 320 px. A collimator whose screen's half width of
    254.88 mm has that tangent, or whose half height of 143.37 mm has 240 px's, which is less.
    """
    path, tables = written(tmp_path)
    by_height_mm = 540 * 0.2655 / (240 / 1950)
    assert by_height_mm < 960 * 0.2655 / (320 / 1950)
    assert tables["collimator"]["focal_length_mm"] == round(0.95 * by_height_mm, 1)
    assert tables["monitor"] == {"resolution_px": [1920, 1080], "pixel_pitch_um": 265.5}
    assert "write your own" in path.read_text()
    path, tables = written(tmp_path, GIVEN + SCREEN)
    assert tables["collimator"] == {"focal_length_mm": 800.0}
    assert tables["monitor"]["resolution_px"] == [2560, 1440]
    assert "write your own" not in path.read_text()


def test_the_sky_is_of_the_photograph_s_date(tmp_path):
    _, tables = written(tmp_path)
    assert tables["sky"] == {
        "epoch_jyear": 2020.123457,
        "observer_velocity_km_s": [1.0, -29.0, 2.0],
        "faintest_v_mag": 10.0,
    }
    bodies = """[sky]
epoch_utc = "2019-05-05T00:00:00Z"
faintest_v_mag = 7.0
bodies = {planets = true}
"""
    _, tables = written(tmp_path, GIVEN + bodies)
    assert tables["sky"]["epoch_utc"] == "2019-05-05T00:00:00Z"
    _, tables = written(tmp_path, GIVEN + bodies, t_ns=1_577_836_800_123_456_789)
    kept = {"bodies": {"planets": True}, "faintest_v_mag": 7.0}
    assert tables["sky"] == {"epoch_utc": "2020-01-01T00:00:00.123Z", **kept}


def test_a_named_file_is_found_from_wherever_the_new_one_lies(tmp_path):
    (tmp_path / "given").mkdir()
    through = tmp_path / "given" / "glass.csv"
    through.write_text("wavelength_nm,value\n300,0.8\n1100,0.8\n")
    given = GIVEN.replace("transmission = 0.8", 'transmission = "glass.csv"')
    _, tables = written(tmp_path, given)
    assert tables["tracker"]["transmission"] == str(through)


def test_what_was_written_is_the_camera_that_photographs_are_held_against(tmp_path):
    path, _ = written(tmp_path)
    file, has_screen = read_tracker_file(path)
    assert has_screen
    held = fixed_camera(file, 1.0)
    assert held.camera.focal_length_px == pytest.approx(1950.0)
    assert held.camera.principal_point_px == (321.5, 236.25)
    assert held.psf.covariance == pytest.approx(PSF.covariance)
    shape = (held.psf.colour, held.psf.wing_share, held.psf.wing_sigma_px)
    assert shape == (0.03, 0.05, 2.5)
    assert held.light.vignetting_mag == (0.2, 0.1)
    assert held.pixels.gain_e_per_dn == GAIN
    assert held.pixels.pattern.rms[0] == pytest.approx(0.01)
    # 2 DN's steps have a variance of 4/12 DN^2, of which 1/12 is the detector's own
    coarse = fixed_camera(file, 2.0)
    assert coarse.pixels.read_noise_e**2 == pytest.approx(16.0 - GAIN**2 / 4)


def test_a_psf_of_samples_is_held_by_its_covariance(tmp_path):
    """A Gaussian that is wider across, in three samples a pixel; its file says nothing of shade."""
    samples = sampled(gaussian(1.1, 0.8), 3, 6).astype(np.float32)
    header = fits.Header({"OVERSAMP": 3})
    fits.PrimaryHDU(samples, header).writeto(tmp_path / "psf.fits")
    bench = tmp_path / "bench.toml"
    wanted = np.array([[1.1**2], [0.8**2], [0.0]])
    bench.write_text(GIVEN.replace("exposure_s", "psf_sigma_px = [1.1, 0.8]\nexposure_s"))
    stated = fixed_camera(read_tracker_file(bench)[0], 1.0)
    np.testing.assert_allclose(stated.psf.covariance, wanted)
    bench.write_text(GIVEN + '[tracker.optics]\npsf = "psf.fits"\n')
    held = fixed_camera(read_tracker_file(bench)[0], 1.0)
    np.testing.assert_allclose(held.psf.covariance, wanted, atol=0.05)
    assert held.psf.size_px == (1280, 960)
    assert held.light.vignetting_mag == (0.0, 0.0)


def test_a_site_is_written_without_its_sky_whose_light_was_measured(tmp_path):
    site = "[site]\nlatitude_deg = 40.0\nlongitude_deg = 10.0\nheight_m = 0\nsky_v_mag_arcsec2 = 20.5\n"
    t_ns = int(np.datetime64("2026-03-20T21:00:00", "ns").astype(np.int64))
    session, _ = session_of(tmp_path, t_ns=t_ns, air=object())
    session = replace(session, file=replace(session.file, text=GIVEN + site))
    tables = measured_bench._tables(session, 0.5, True)
    assert tables["site"] == {"latitude_deg": 40.0, "longitude_deg": 10.0, "height_m": 0}
    assert tomllib.loads(GIVEN + site)["site"]["sky_v_mag_arcsec2"] == 20.5
    assert "site" not in measured_bench._tables(replace(session, air=None), 0.5, True)
