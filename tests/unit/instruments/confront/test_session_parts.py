"""What a confrontation makes of photographs before and after its fits, each against a closed form:
places and levels, and the camera that it writes and reads back.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.special import ndtr

from hilstar.basics.errors import InputError
from hilstar.basics.reading import parse_toml
from hilstar.basics.rotation import from_matrix
from hilstar.instruments.confront import run as confront_run
from hilstar.instruments.confront import session as sessions
from hilstar.instruments.confront import star_psf
from hilstar.instruments.confront.background import (
    FixedPattern,
    FoundSources,
    SkyLevel,
    sky_level,
)
from hilstar.instruments.confront.camera_fit import CameraFit, Pointing
from hilstar.instruments.confront.images import Photograph, _planes
from hilstar.instruments.confront.light import LightFit
from hilstar.instruments.confront.lost_in_space import MIN_MATCHED
from hilstar.instruments.confront.measured_bench import (
    PER_PX,
    _absolute,
    _detector,
    _fitted,
    _toml,
    _written_model,
    fixed_camera,
    read_tracker_file,
    vignetting_of,
)
from hilstar.instruments.confront.photographed_sky import DatedSky
from hilstar.instruments.confront.photon_transfer import PixelFit
from hilstar.instruments.confront.run import _base
from hilstar.instruments.confront.session import (
    MAX_TONE_STEP,
    PIVOT_NM,
    WIDE_PX,
    FixedCamera,
    _channel_mag,
    _field,
    _first_camera,
    _linear,
    _middles,
    _reach_px,
    _seen_at,
    _star_light,
    _tone_step,
    _why_not,
    check_focus,
    corrected,
    radius2_of,
)
from hilstar.instruments.confront.star_psf import HALF, MEAN_BV_MAG, Measured, Stamps, fit_psf, join
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile, bench_file_of
from hilstar.sky.catalog import plain_catalog
from hilstar.sky.spectrum import Curve
from tests.support.confrontations import a_session, a_shot, seen_shot, sources_at
from tests.support.planted_sky import rotation_of

TRACKER = """
[tracker]
aperture_mm = 20.0
focal_length_mm = 40.0
pixel_pitch_um = 10.0
resolution_px = [800, 600]
quantum_efficiency = 0.5
exposure_s = 0.2
[tracker.detector]
gain_e_per_dn = 4.0
full_well_e = 16000.0
bits = 12
read_noise_e = 30.0
offset_dn = 60.0
prnu = 0.02
"""
PLACEHOLDERS = (
    "[monitor]\nresolution_px = [1920, 1080]\npixel_pitch_um = 265.5\n[collimator]\nfocal_length_mm"
    " = 1000.0\n"
)
CAMERA = Camera((800, 600), 4000.0, (410.0, 290.0), np.eye(3))
MAG_A_FACTOR_2 = 2.5 * math.log10(2)


def bench(folder, text: str = TRACKER, more: str = "") -> BenchFile:
    """A bench whose screen is of no account."""
    return bench_file_of(folder / "bench.toml", f"{text}{more}\n{PLACEHOLDERS}")


def photograph(dn: np.ndarray, full_dn: float = 4095.0, step_dn: float = 1.0) -> Photograph:
    """A photograph of these levels."""
    return Photograph("photo.fits", dn, step_dn, full_dn, exposure_s=0.5)


def pixels(**changes) -> PixelFit:
    """A detector of 2 e- a DN above 100 DN."""
    made = PixelFit(2.0, 100.0, 6.0, 1.0, {}, np.empty((0, 2)), gain_told=True)
    return replace(made, **changes)


def stamps_of(places_px: np.ndarray, sigma_x_px: float, sigma_y_px: float) -> Stamps:
    """Gaussians of 1000 DN, integrated over pixels by erf."""
    reach = np.arange(-HALF, HALF + 1)
    middle = np.rint(places_px)
    values = []
    for off_x, off_y in places_px - middle:
        across = np.diff(ndtr((np.append(reach, HALF + 1) - 0.5 - off_x) / sigma_x_px))
        down = np.diff(ndtr((np.append(reach, HALF + 1) - 0.5 - off_y) / sigma_y_px))
        values.append(1000 * np.outer(down, across))
    images = np.array(values)
    return Stamps(images, np.ones_like(images), *middle.T, np.full(len(values), 0.65))


def test_a_centre_of_gravity_is_along_its_own_axis():
    places_px = np.array([[100.2, 50.0], [200.0, 80.3], [300.4, 20.7]])
    x_px, y_px = _middles(stamps_of(places_px, 0.6, 0.6))
    # what of a Gaussian is outside of 5 x 5 pixels pulls the centre back: by 0.05 px at most
    np.testing.assert_allclose(x_px, places_px[:, 0], atol=0.05)
    np.testing.assert_allclose(y_px, places_px[:, 1], atol=0.05)


def test_sources_are_from_the_middle_of_the_image():
    sources = sources_at([(399.5, 299.5), (0.0, 0.0), (799.0, 9.0)])
    field = _field(sources, np.array([True, True, False]), photograph(np.zeros((600, 800))))
    np.testing.assert_array_equal(field.places_px, [[0.0, 0.0], [-399.5, -299.5]])
    assert (field.width_px, field.height_px) == (800, 600)


def test_radii_are_from_the_principal_point_in_half_diagonals():
    # half of the diagonal of 800 x 600 px is 500 px
    x_px = np.array([410.0, 410.0 + 500.0, 410.0 + 30.0])
    y_px = np.array([290.0, 290.0, 290.0 - 40.0])
    np.testing.assert_allclose(radius2_of(CAMERA, x_px, y_px), [0.0, 1.0, 0.01])


def test_places_reach_as_far_as_95_percent_of_them_from_the_principal_point():
    angle = np.linspace(0, 2 * math.pi, 101, endpoint=False)
    radius_px = 2.0 * (np.arange(101) * 37 % 101)  # 0 to 200, in another order
    x_px = 410 + radius_px * np.cos(angle)
    y_px = 290 + radius_px * np.sin(angle)
    places = sessions.Places(x_px, y_px, np.ones(101), np.zeros((101, 3)))
    assert _reach_px(CAMERA, places) == pytest.approx(190.0)
    none = sessions.Places(np.empty(0), np.empty(0), np.empty(0), np.empty((0, 3)))
    assert _reach_px(CAMERA, none) == 0.0
    for photographs in ([places, none], [none, places, none]):
        assert sessions._largest_reach_px(CAMERA, photographs) == pytest.approx(190.0)


def test_levels_of_a_power_are_light_again_and_full_scale_stays():
    power = 0.5
    light = np.full((40, 60), 0.01)
    light[7, 9:12] = [0.0, 0.25, 1.0]
    coded = photograph(4095 * light**power, step_dn=2.0)
    linear = _linear(a_shot(0), coded, power)
    np.testing.assert_allclose(linear.photo.dn, 4095 * light)
    # d(light) / d(code) at the sky's: light = code^2, and its code is a tenth
    assert linear.photo.step_dn == pytest.approx(2.0 * 2 * 0.1)
    wanted = sky_level(4095 * light, 2.0 * 2 * 0.1)
    np.testing.assert_allclose(linear.level.level, wanted.level)


def test_an_efficiency_bends_about_550_nm_by_squares_of_the_logarithm():
    curve = Curve(np.array([400.0, 550.0, 700.0]), np.array([0.3, 0.4, 0.2]))
    tilt, bow = 0.5, -0.8
    bent = corrected(curve, (tilt, bow))
    assert bent(np.array([PIVOT_NM]))[0] == pytest.approx(0.4)
    for nm, value in ((400.0, 0.3), (700.0, 0.2)):
        x = math.log(nm / 550.0)
        wanted = value * math.exp(tilt * x + bow * x * x)
        assert bent(np.array([nm]))[0] == pytest.approx(wanted, rel=1e-4)
    steep = corrected(curve, (9.0, 0.0))
    assert steep.value.max() == pytest.approx(1.0)
    # as a whole: the ratio of two wavelengths stays
    ratio = steep(np.array([700.0]))[0] / steep(np.array([550.0]))[0]
    assert ratio == pytest.approx(0.5 * (700 / 550) ** 9, rel=1e-3)
    assert corrected(curve, (0.0, 0.0)) is curve


def test_a_channel_of_a_third_of_the_light_is_fainter_by_it(tmp_path):
    text = TRACKER.replace(
        "quantum_efficiency = 0.5",
        "quantum_efficiency_r = 0.2\nquantum_efficiency_g = 0.3\nquantum_efficiency_b = 0.6",
    )
    file = bench(tmp_path, text)
    columns = np.array([[5.0, 3.0], [0.6, 0.0], [0.7, 0.0]])
    whole = {plane: _channel_mag(file, plane, columns) for plane in ("r", "g1", "g2", "b", "")}
    fainter = 2.5 * math.log10(1.5)
    np.testing.assert_allclose(whole["r"] - whole["g1"], fainter, atol=1e-6)
    np.testing.assert_allclose(whole["g2"] - whole["b"], MAG_A_FACTOR_2, atol=1e-6)
    np.testing.assert_array_equal(whole[""], 0.0)
    grey = bench(tmp_path)
    np.testing.assert_array_equal(_channel_mag(grey, "r", columns), 0.0)


@pytest.mark.parametrize("step_dn", [1.0, 4.0])
def test_a_fixed_camera_is_that_of_its_file(tmp_path, step_dn):
    fixed = fixed_camera(bench(tmp_path, TRACKER), step_dn)
    assert fixed.camera.focal_length_px == pytest.approx(4000.0)
    assert (fixed.pixels.gain_e_per_dn, fixed.pixels.pedestal_dn) == (4.0, 60.0)
    # a pixel's variance at a level, steps of the file included, is the detector's own: read noise
    # and a twelfth of a DN^2, photons, and response
    light_dn = 500.0
    if step_dn == 1.0:
        assert fixed.pixels.read_noise_e == pytest.approx(30.0)
    read_dn2 = (30.0 / 4) ** 2
    variance = read_dn2 + 1 / 12 + light_dn / 4 + (0.02 * light_dn) ** 2
    seen = fixed.pixels.variance_dn2(np.array([60.0 + light_dn]))[0]
    assert seen == pytest.approx(variance)


def session_of(
    file: BenchFile, fitted: PixelFit, photo: Photograph, offset_mag: float = 0.0
) -> sessions.Session:
    """A session of one photograph by a plain camera."""
    light = LightFit(np.full(2, offset_mag), (0.0, 0.0), (0.0, 0.0), 0.0, 0.0, 1.0)
    shots = (replace(a_shot(0), photo=photo),)
    camera = CameraFit(CAMERA, (), "")
    return a_session(file=file, pixels=fitted, shots=shots, light=light, camera=camera)


@pytest.mark.parametrize(("full_dn", "bits"), [(4095.0, 12), (4096.0, 13), (255.0, 8), (65535, 16)])
def test_a_detector_is_written_in_electrons_above_its_pedestal(tmp_path, full_dn, bits):
    pattern = FixedPattern((0.03**2, 0.5**2, 0.0, 0.0), (0.0,) * 4)
    made = pixels(step_dn=4.0, pattern=pattern)
    photo = photograph(np.zeros((2, 2)), full_dn)
    detector = _detector(session_of(bench(tmp_path), made, photo), {})
    assert detector["bits"] == bits
    assert detector["full_well_e"] == pytest.approx((full_dn - 100) * 2)
    assert detector["offset_dn"] == 100.0
    # steps of 4 DN where a detector's are of 1: (16 - 1) / 12 DN^2
    assert detector["read_noise_e"] == pytest.approx(math.sqrt(36 + 15 / 12 * 4))
    assert detector["prnu"] == pytest.approx(0.03)
    assert detector["dsnu_e"] == pytest.approx(1.0)
    unknown = session_of(bench(tmp_path), replace(made, gain_told=False), photo)
    assert "gain_e_per_dn" not in _detector(unknown, {})
    assert _detector(unknown, {"gain_e_per_dn": 2.0})["gain_e_per_dn"] == 2.0


def test_a_psf_s_samples_are_fitted_by_their_own_axes():
    reach = np.arange(-6 * PER_PX, 6 * PER_PX + 1) / PER_PX
    sigma_x_px, sigma_y_px = 1.3, 0.8
    image = np.exp(-0.5 * (reach / sigma_x_px) ** 2) * np.exp(
        -0.5 * (reach[:, None] / sigma_y_px) ** 2
    )
    image /= image.sum()
    psf = _fitted(image[None], PER_PX, np.array([[400.0, 300.0]]), (800, 600))
    core = psf.core(np.array([400.0]), np.array([300.0]), np.array([0.65]))[0]
    share = 1 - psf.wing_share
    wing_px2 = psf.wing_share * psf.wing_sigma_px**2
    variances_px2 = share * core[:2] + wing_px2
    np.testing.assert_allclose(variances_px2, [sigma_x_px**2, sigma_y_px**2], rtol=0.02)


def test_vignetting_is_what_dims_the_corners():
    r2 = np.array([0.0, 0.25, 0.64, 1.0])
    a_mag, b_mag = 0.3, 0.2
    illumination = 10 ** (-0.4 * (a_mag * r2 + b_mag * r2**2))
    assert vignetting_of(illumination, r2) == pytest.approx((a_mag, b_mag))
    assert vignetting_of(illumination[:2], r2[:2]) == (0.0, 0.0)


def test_numbers_in_a_file_s_history_are_the_model_s_whatever_line_they_are_cut_in():
    numbers = {
        "covariance": [[1.0], [2.0], [0.1]],
        "colour": 0.3,
        "wing": [0.2, 3.0],
        "vignetting": [0.4, -0.1],
    }
    text = json.dumps(numbers)
    history = ["PSF of photographs", f"confront: {text[:31]}", f"confront: {text[31:]}", "another"]
    psf, vignetting_mag = _written_model(history, (800, 600))
    assert vignetting_mag == (0.4, -0.1)
    assert psf.covariance.tolist() == numbers["covariance"]
    assert (psf.colour, psf.wing_share, psf.wing_sigma_px) == (0.3, 0.2, 3.0)
    assert psf.size_px == (800, 600)
    assert _written_model(history[:1], (800, 600)) is None
    assert _written_model(history[:2], (800, 600)) is None


def test_tables_are_read_back_as_they_were_with_their_files_wherever_they_lie(tmp_path):
    (tmp_path / "here.csv").touch()
    tables = {
        "tracker": {
            "aperture_mm": 20.0,
            "transmission": "here.csv",
            "optics": {"psf": "x", "map": "here.csv"},
            "resolution_px": [8, 6],
        },
        "sky": {"catalogue": "hipparcos", "bodies": True, "file": "missing.csv"},
    }
    absolute = _absolute(tables, tmp_path)
    there = str((tmp_path / "here.csv").resolve())
    assert absolute["tracker"]["transmission"] == absolute["tracker"]["optics"]["map"] == there
    assert absolute["sky"] == tables["sky"]
    path = tmp_path / "written.toml"
    assert parse_toml(path, "\n".join(_toml(absolute))) == absolute


@pytest.mark.parametrize("has_screen", [False, True])
def test_a_file_of_a_tracker_alone_gets_a_screen_and_says_so(tmp_path, has_screen):
    path = tmp_path / "tracker.toml"
    path.write_text(TRACKER + (PLACEHOLDERS if has_screen else ""))
    file, with_screen = read_tracker_file(path)
    assert with_screen is has_screen
    assert file.config.tracker.focal_length_mm == 40.0


def test_stars_that_are_wide_are_out_of_focus_by_their_median():
    photo = photograph(np.zeros((2, 2)))
    check_focus(photo, np.array([WIDE_PX - 0.1, 2.0, 90.0]))
    with pytest.raises(InputError, match=r"photo\.fits: its stars are .* px wide; focus"):
        check_focus(photo, np.array([WIDE_PX + 0.1, 2.0, 90.0]))


def sources_of(
    length_px: float, width_px: float, trails: int, fwhm_px: float = 3.0
) -> FoundSources:
    """Twenty sources, of which so many are trails of 80 px."""
    sources = sources_at([(0.0, 0.0)] * 20, length_px=length_px, width_px=width_px, fwhm_px=fwhm_px)
    sources.length_px[:trails] = 80.0
    return sources


@pytest.mark.parametrize(
    ("sources", "words"),
    [
        (sources_of(3.0, 2.0, 15), "trails of about 80 px"),
        (sources_of(3.0, 2.0, MIN_MATCHED), "trails of about 80 px"),
        (sources_of(17.0, 4.0, 0), "trails of about 17 px"),
        (sources_of(40.0, 38.0, 0, 39.0), "sources are 39 px wide"),
        (sources_of(3.0, 2.0, 0), "no part of the sky fits them at 11.4 deg of width"),
    ],
)
def test_a_photograph_without_an_attitude_says_what_is_seen(monkeypatch, sources, words):
    tried = []

    def solved(field, base, sky, start):
        tried.append(field.places_px)

    monkeypatch.setattr(sessions, "_solve", solved)
    points = ~sources.trail
    places_px = np.array([[3.0, 4.0], [-5.0, 7.0]])
    field = sessions.SourceField(places_px, 800, 600)
    said = _why_not(field, CAMERA, None, sources, points, None)
    assert words in said
    if "sky fits" in words:
        assert "--radec" in said
        (mirrored,) = tried
        np.testing.assert_array_equal(mirrored, [[-3.0, 4.0], [5.0, 7.0]])
        near = _why_not(field, CAMERA, None, sources, points, np.array([1.0, 0, 0, 0]))
        assert "near --radec" in near
        monkeypatch.setattr(sessions, "_solve", lambda *field_and_sky: "an attitude")
        assert "is mirrored" in _why_not(field, CAMERA, None, sources, points, None)


def test_stars_are_first_seen_at_their_sources():
    shot = a_shot(0)
    shot.sources = sources_at([(1.0, 10.0), (2.0, 20.0), (3.0, 30.0)])
    shot.sky = replace(shot.sky, vectors=np.eye(3))
    places = _seen_at(shot, np.array([2, 0]), np.array([1, 2]))
    assert places.x_px.tolist() == [2.0, 3.0]
    assert places.y_px.tolist() == [20.0, 30.0]
    assert places.sigma_px.tolist() == [0.15, 0.15]
    np.testing.assert_array_equal(places.vectors, np.eye(3)[[2, 0]])


def test_a_camera_is_guessed_of_the_photographs_own_size(tmp_path) -> None:
    """The bench file's where they have its pixels; of a mosaic's planes half as long in pixels."""
    file = bench(tmp_path)
    whole = _base(file, [photograph(np.zeros((600, 800)))])
    assert whole.focal_length_px == pytest.approx(4000.0)
    assert whole.principal_point_px == (399.5, 299.5)
    half = _base(file, [photograph(np.zeros((300, 400)))] * 2)
    assert half.resolution_px == (400, 300)
    assert half.focal_length_px == pytest.approx(2000.0)
    assert half.principal_point_px == (199.5, 149.5)
    with pytest.raises(InputError, match="have different sizes"):
        _base(file, [photograph(np.zeros((300, 400))), photograph(np.zeros((400, 300)))])


def test_planes_of_a_mosaic_are_every_second_pixel_by_their_letters() -> None:
    dn = np.arange(24.0).reshape(4, 6)
    planes = {plane.plane: plane.dn for plane in _planes(photograph(dn), "GRBG")}
    assert list(planes) == ["g1", "r", "b", "g2"]
    assert planes["g1"].tolist() == [[0, 2, 4], [12, 14, 16]]
    assert planes["r"].tolist() == [[1, 3, 5], [13, 15, 17]]
    assert planes["b"].tolist() == [[6, 8, 10], [18, 20, 22]]
    assert planes["g2"].tolist() == [[7, 9, 11], [19, 21, 23]]


def test_stars_of_all_photographs_are_in_one_row_each_with_its_image_and_plane() -> None:
    """Of a mosaic's red and second green planes, and of an image of one plane."""
    stars = {"v_mag": np.array([1.0, 2.0, 3.0]), "bv_mag": np.array([0.1, 0.2, 0.3])}
    catalog = plain_catalog("HIP", 3, stars | {"ra_deg": np.zeros(3), "dec_deg": np.zeros(3)})
    sky = DatedSky(catalog, 2020.0, None, np.eye(3), np.arange(3))
    shots = []
    for number, plane in enumerate(("r", "g2", "")):
        places_px = [(410.0, 290.0), (410.0 + 300 * number, 690.0)]
        shot = seen_shot(places_px, [number, 2], sky=sky, blended=np.array([False, number != 1]))
        dn, sigma_dn = (number + np.array(values) for values in ((10.0, 20.0), (1.0, 2.0)))
        shot.measured = replace(shot.found, dn=dn, sigma_dn=sigma_dn)
        shot.photo = replace(shot.photo, plane=plane)
        shots.append(shot)
    light = _star_light(shots, CAMERA)
    assert light.image.tolist() == [0, 0, 1, 1, 2, 2]
    assert light.plane.tolist() == [1, 1, 2, 2, 0, 0]
    assert light.dn.tolist() == [10.0, 20.0, 11.0, 21.0, 12.0, 22.0]
    assert light.sigma_dn.tolist() == [1.0, 2.0, 2.0, 3.0, 3.0, 4.0]
    assert light.v_mag.tolist() == [1.0, 3.0, 2.0, 3.0, 3.0, 3.0]
    assert light.bv_mag.tolist() == [0.1, 0.3, 0.2, 0.3, 0.3, 0.3]
    assert light.clean.tolist() == [True, False, True, True, True, False]
    # half of the diagonal of 800 x 600 px is 500 px
    assert light.radius2 == pytest.approx([0.0, 0.64, 0.0, 1.0, 0.0, 2.08])


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_step_of_the_power_is_a_secant_s_within_its_limit(sign):
    """Slopes of -1 and -0.01 lead to the root; one of 1 and more leads away from it."""
    secant = _tone_step((0.0, 0.3 * sign), (0.2 * sign, 0.1 * sign))
    assert secant == pytest.approx(0.1 * sign)
    far = _tone_step((0.0, 0.3 * sign), (0.1 * sign, 0.299 * sign))
    assert far == MAX_TONE_STEP * sign
    turned = _tone_step((0.0, 0.1 * sign), (0.1 * sign, 0.2 * sign))
    assert turned == pytest.approx(0.2 * sign)
    far_turned = _tone_step((0.0, 0.1 * sign), (0.1 * sign, 9.0 * sign))
    assert far_turned == MAX_TONE_STEP * sign


def test_a_plane_s_stars_are_fainter_by_its_own_colour_about_the_mean_colour():
    """Of a bench of one channel, whose planes differ by the fit of their colours alone; a colour
    that is not known counts as the mean.
    """
    light = replace(a_session().light, colours=np.array([0.25, -0.5]))
    session = a_session(light=light)
    columns = np.array([[5.0, 6.0, 7.0], [MEAN_BV_MAG + 1, np.nan, MEAN_BV_MAG - 2], [0.7] * 3])
    np.testing.assert_allclose(session.plane_mag(0, columns), [0.25, 0.0, -0.5])
    np.testing.assert_allclose(session.plane_mag(1, columns), [-0.5, 0.0, 1.0])


# V, and places of stars: two that are 5 px apart and differ by 2.9 mag, two by 3.1 mag, two that
# are 6.5 px apart, one that nothing was seen of, and one that is saturated
SKY_STARS = (
    (3.0, 100.2, 50.0),
    (5.9, 105.2, 50.0),
    (3.0, 200.0, 80.3),
    (6.1, 200.0, 85.3),
    (3.0, 300.4, 20.7),
    (3.0, 300.4, 27.2),
    (3.0, 60.0, 90.0),
    (3.0, 30.0, 30.0),
)
SEEN_STARS = (0, 1, 2, 4, 5, 7)
FIELD_PX = (400, 120)


def identified_shot() -> sessions.Shot:
    """A shot whose sources are the seen stars, all of one light but the last, which nearly fills
    the range with the background.
    """
    camera = Camera(FIELD_PX, 4000.0, (199.5, 59.5), np.eye(3))
    v_mag, x_px, y_px = np.array(SKY_STARS).T
    turn = rotation_of(40.0, 20.0, 10.0)
    vectors = camera.rays(x_px, y_px) @ turn
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    count = len(v_mag)
    columns = {"hip": np.arange(count, dtype=np.int32), "v_mag": v_mag}
    catalog = plain_catalog("HIP", count, columns | {"ra_deg": v_mag, "dec_deg": v_mag})
    seen = np.array(SEEN_STARS)
    seen_x_px, seen_y_px = x_px[seen] + 0.5, y_px[seen] - 0.5
    level = np.full(FIELD_PX[::-1], 500.0)
    dn = level.copy()
    dn[30, 30] = 0.975 * 4095
    three = np.full(len(seen), 3.0)
    single = np.zeros(len(seen), dtype=bool)
    sources = FoundSources(seen_x_px, seen_y_px, 10 * three, three, three, three, single)
    q_icrs_to_cam = from_matrix(turn)
    rows = np.arange(count)
    shot = replace(
        a_shot(0),
        photo=photograph(dn),
        level=SkyLevel(level, np.ones_like(level), 16),
        sources=sources,
        sky=DatedSky(catalog, 2020.0, None, vectors, rows),
        pointing=Pointing(q_icrs_to_cam),
    )
    sessions._identify(shot, camera, shot.pointing)
    return shot


def test_stars_are_identified_at_their_sources_with_what_spoils_them():
    """Blended by a star of the catalogue within 6 px that is less than 3 mag fainter, or by another
    source as bright; saturated by all of a pixel's light.
    """
    shot = identified_shot()
    assert sorted(shot.star.tolist()) == list(SEEN_STARS)
    blended = dict(zip(shot.star.tolist(), shot.blended.tolist(), strict=True))
    assert blended == {0: True, 1: True, 2: False, 4: False, 5: False, 7: False}
    saturated = dict(zip(shot.star.tolist(), shot.saturated.tolist(), strict=True))
    assert saturated == {star: star == 7 for star in SEEN_STARS}
    assert shot.clean.sum() == 3
    (middle,) = np.flatnonzero(shot.star == 7)
    # above the background
    assert shot.stamps.values[middle].max() == pytest.approx(0.975 * 4095 - 500)


def test_magnitudes_are_those_of_each_correction(tmp_path):
    """A tilt of ln(wavelength / 550 nm) makes red stars brighter than blue ones."""
    columns = np.array([[3.0, 3.0], [0.0, 1.5], [0.0, 1.6]])
    magnitudes = sessions._Magnitudes(bench(tmp_path), columns)
    plain_mag = magnitudes((0.0, 0.0))
    red_mag = magnitudes((1.0, 0.0))
    assert (red_mag - plain_mag)[1] < (red_mag - plain_mag)[0] - 0.02
    assert magnitudes((0.0, 0.0)).tolist() == plain_mag.tolist()


def test_photographs_share_the_largest_full_scale_and_those_beyond_memory_lie_in_files(
    tmp_path, monkeypatch
):
    """Of 12, 14 and 12 bits; the second one is over what memory holds."""
    monkeypatch.setattr(confront_run, "MEMORY_PX", 1.5 * 80 * 64)
    rows, columns = np.mgrid[:64, :80]
    paths = []
    for number, step in enumerate((4, 15, 4)):
        levels = (step * ((3 * rows + 7 * columns) % 700)).astype(np.uint16)
        paths.append(tmp_path / f"{number}.tiff")
        Image.fromarray(levels).save(paths[-1])
    text = TRACKER.replace("[800, 600]", "[80, 64]")
    photos = confront_run._read(bench(tmp_path, text), paths, None)
    assert [photo.full_dn for photo in photos] == [16383.0] * 3
    assert [photo.step_dn for photo in photos] == [4.0, 15.0, 4.0]
    assert [isinstance(photo.dn, np.memmap) for photo in photos] == [False, True, True]
    with pytest.raises(InputError, match=r"0\.tiff: two images have this name"):
        confront_run._read(bench(tmp_path, text), [paths[0], paths[1], paths[0]], None)


def test_air_masses_of_a_photograph_without_a_site_are_by_its_fitted_zenith():
    shot = a_shot(0)
    at_60_deg = Pointing(shot.pointing.q_icrs_to_cam, (0.0, math.sqrt(3)))
    assert sessions._masses(shot.sky, at_60_deg) == pytest.approx(2.0, rel=0.01)
    assert sessions._masses(shot.sky, shot.pointing) is None


def measured_shot(dn: list[float]) -> sessions.Shot:
    """A shot of stars of these fluxes with 1 DN of noise, the last of which is blended."""
    count = len(dn)
    at = np.arange(count, dtype=float)
    measured = Measured(at, 2 * at, np.array(dn), 0.1 + at, np.ones(count), np.ones(count))
    blended = at == count - 1
    shot = a_shot(0)
    vectors = np.column_stack([at, at, at])
    return replace(
        shot,
        sky=replace(shot.sky, vectors=vectors[::-1]),
        star=np.arange(count)[::-1],
        measured=measured,
        blended=blended,
        saturated=np.zeros(count, dtype=bool),
    )


@pytest.mark.parametrize(
    ("dn", "chosen"),
    [
        # ten sigmas and alone, of which there are enough; else all that are alone; else all
        ([50.0] * MIN_MATCHED + [9.0, 50.0], range(MIN_MATCHED)),
        ([50.0] * (MIN_MATCHED - 1) + [9.0, 50.0], range(MIN_MATCHED)),
        ([50.0, 9.0, 50.0], range(3)),
    ],
)
def test_places_that_count_are_those_of_bright_stars_that_are_alone(dn, chosen):
    places = sessions._places(measured_shot(dn))
    rows = np.array(chosen)
    assert places.x_px.tolist() == rows.tolist()
    assert places.y_px.tolist() == (2 * rows).tolist()
    assert places.sigma_px.tolist() == (0.1 + rows).tolist()
    assert places.vectors[:, 0].tolist() == rows.tolist()


def test_a_psf_is_that_of_the_brightest_stars(monkeypatch):
    """Twelve of 0.8 px, and twelve of a tenth of their light that are twice as wide."""
    monkeypatch.setattr(sessions, "PSF_STARS", 12)
    rng = np.random.default_rng(2)
    places_px = rng.uniform([20, 20], [780, 580], (24, 2))
    narrow = stamps_of(places_px[:12], 0.8, 0.8)
    wide = stamps_of(places_px[12:], 1.6, 1.6)
    stamps = join([replace(wide, values=wide.values / 10), narrow])
    nothing = np.zeros(24, dtype=bool)
    shot = replace(a_shot(0), stamps=stamps, saturated=nothing, blended=nothing)
    photo = replace(shot.photo, dn=np.zeros((600, 800)))
    psf = sessions._psf([replace(shot, photo=photo)], 2.0)
    middle = np.array([399.5]), np.array([299.5])
    assert psf.fwhm_px(*middle)[0] == pytest.approx(2.3548 * math.hypot(0.8, 1 / 12**0.5), rel=0.05)


@pytest.mark.parametrize(("stars", "terms"), [(40, 6), (39, 2), (12, 2), (11, 1)])
def test_a_psf_changes_over_the_field_by_as_much_as_its_stars_tell(stars, terms, monkeypatch):
    """In the first round the wings have a twentieth of the light, of which these stars have none."""
    monkeypatch.setattr(star_psf, "SHAPE_ROUNDS", 1)
    rng = np.random.default_rng(2)
    places_px = rng.uniform([20, 20], [780, 580], (stars, 2))
    psf = fit_psf(stamps_of(places_px, 0.8, 0.9), *places_px.T, (800, 600), 2.0)
    assert psf.covariance.shape == (3, terms)
    assert psf.covariance[:, 0] == pytest.approx([0.64, 0.81, 0.0], abs=0.05 * 0.81)
    # which, with their sigma and the colour, are fitted from the second round on
    assert (psf.colour, psf.wing_share, psf.wing_sigma_px) == (0.0, 0.05, 2.0)


def star_field(count: int, wide: int = 0) -> Photograph:
    """Stars on 100 DN with 2 DN of noise, of which the brightest ones are so many of 5 px."""
    rng = np.random.default_rng(5)
    dn = 100 + 2 * rng.standard_normal((300, 400))
    y_px, x_px = np.mgrid[:300, :400]
    for k in range(count):
        sigma_px = 5.0 if k < wide else 1.0
        peak_dn = 2000.0 if k < wide else 300.0
        radius2_px2 = (x_px - 40 - 60 * (k % 6)) ** 2 + (y_px - 40 - 60 * (k // 6)) ** 2
        dn += peak_dn * np.exp(-radius2_px2 / (2 * sigma_px**2))
    return photograph(dn)


def test_an_attitude_is_tried_from_the_least_count_of_sources_on(tmp_path, monkeypatch):
    """With one less the refusal says what to do about too few."""
    tried = []
    monkeypatch.setattr(sessions, "_solve", lambda field, *where: tried.append(field.places_px))
    with pytest.raises(InputError, match="no part of the sky fits them"):
        sessions.open_shot(bench(tmp_path), star_field(MIN_MATCHED), CAMERA, None)
    # as they are, and then with left and right exchanged
    assert [len(places_px) for places_px in tried] == [MIN_MATCHED, MIN_MATCHED]
    np.testing.assert_array_equal(tried[1], tried[0] * [-1, 1])
    del tried[:]
    with pytest.raises(InputError, match=f"{MIN_MATCHED - 1} sources stand out"):
        sessions.open_shot(bench(tmp_path), star_field(MIN_MATCHED - 1), CAMERA, None)
    assert not tried


@pytest.mark.parametrize(("wide", "is_taken"), [(4, True), (6, False)])
def test_the_ten_brightest_stars_tell_the_focus(wide, is_taken, tmp_path, monkeypatch):
    """Of eighteen that are identified, in any order."""
    solution = replace(a_shot(0).matched, source=np.arange(18)[::-1], star=np.arange(18))
    monkeypatch.setattr(sessions, "_solve", lambda *given: solution)
    photo = star_field(18, wide)
    if is_taken:
        shot = sessions.open_shot(bench(tmp_path), photo, CAMERA, None)
        assert shot.matched.source.tolist() == solution.source.tolist()
    else:
        with pytest.raises(InputError, match="px wide; focus the lens"):
            sessions.open_shot(bench(tmp_path), photo, CAMERA, None)


def test_a_camera_is_fitted_from_the_median_focal_length_of_its_photographs_unless_it_is_fixed():
    focal_px = [2000.0, 2500.0, 2040.0]
    begun = _first_camera(CAMERA, None, focal_px)
    assert (begun.focal_length_px, begun.principal_point_px) == (2040.0, (410.0, 290.0))
    session = a_session()
    fixed_camera = replace(CAMERA, focal_length_px=2222.0)
    fixed = FixedCamera(fixed_camera, session.psf, session.light, session.pixels)
    assert _first_camera(CAMERA, fixed, focal_px) is fixed_camera
