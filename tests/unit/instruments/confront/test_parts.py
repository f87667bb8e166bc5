"""The parts of a confrontation, each against a closed form: the PSF and its derivatives, stars that
are measured by it, the light of several photographs, and what of a scatter is told apart.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ndtr

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.confront import judge
from hilstar.instruments.confront.camera_fit import Pointing
from hilstar.instruments.confront.excess import Part, _by_law, _rest, _taken
from hilstar.instruments.confront.judge import StarRow, defects, light_at
from hilstar.instruments.confront.light import (
    MEAN_BV_MAG,
    LightFit,
    StarLight,
    fit_light,
    with_extinction,
)
from hilstar.instruments.confront.session import Session, _apart, _middles, within_image
from hilstar.instruments.confront.star_psf import (
    HALF,
    Measured,
    Stamps,
    StarPsf,
    _shape,
    _ShapeLoss,
    cut_stamps,
    field_terms,
    measure,
)
from hilstar.server.bench.bench_file import bench_file_of
from tests.support.confrontations import TRACKER, a_light, a_session, a_shot, a_star

WIDE_PX, HIGH_PX = SIZE_PX = (640, 480)
MIDDLE_PX = (319.5, 239.5)  # pixel (0, 0) is the centre of the top-left one
PSF = StarPsf(
    covariance=np.array(
        [[0.9, 0.2, 0.1, -0.05, 0.03, 0.02], [0.7, 0.1, 0, 0, 0, 0], [0.1] + [0] * 5]
    ),
    colour=0.1,
    wing_share=0.1,
    wing_sigma_px=2.5,
    size_px=SIZE_PX,
)
# By central differences of 1e-5: their own error is 1e-10 of the function and 1e-11 by rounding.
STEP, SLOPE_ERROR = 1e-5, 1e-8
GAIN = 0.8
NO_GAUSSIAN = 0.01  # one of 1 px of sigma over a pixel, and cut by a stamp of 11
FWHM_STEP_PX = 0.01  # of the radii at which a PSF's light is looked at
MAG_A_RELATIVE = 2.5 / math.log(10)


def test_field_terms_are_about_the_middle_of_the_image():
    half = math.hypot(*SIZE_PX) / 2
    x_px = np.array([MIDDLE_PX[0], -0.5, WIDE_PX - 0.5, MIDDLE_PX[0]])
    y_px = np.array([MIDDLE_PX[1], MIDDLE_PX[1], MIDDLE_PX[1], HIGH_PX - 0.5])
    u, v = WIDE_PX / 2 / half, HIGH_PX / 2 / half
    assert field_terms(x_px, y_px, SIZE_PX) == pytest.approx(
        np.array(
            [
                [1, 0, 0, 0, 0, 0],
                [1, u * u, -u, 0, u * u, 0],
                [1, u * u, u, 0, u * u, 0],
                [1, v * v, 0, v, -v * v, 0],
            ]
        )
    )


def offsets_px(x_px: float, y_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets of a stamp's columns and rows from a star in it, px, (1, side) each."""
    reach = np.arange(-HALF, HALF + 1.0)
    return reach[None] - x_px, reach[None] - y_px


def test_a_psf_s_slopes_are_those_of_its_shares():
    place = np.array([100.0]), np.array([400.0])
    core = PSF.core(*place, np.array([1.2]))

    def shares(x=0.2, y=-0.3, core=core, psf=PSF):
        return psf.on_pixels(*offsets_px(x, y), core)[0]

    share, by_x, by_y = PSF.on_pixels(*offsets_px(0.2, -0.3), core)
    assert by_x == pytest.approx(
        (shares(x=0.2 + STEP) - shares(x=0.2 - STEP)) / (2 * STEP), abs=SLOPE_ERROR
    )
    assert by_y == pytest.approx(
        (shares(y=-0.3 + STEP) - shares(y=-0.3 - STEP)) / (2 * STEP), abs=SLOPE_ERROR
    )
    same, by_shape = PSF.by_shape(*offsets_px(0.2, -0.3), core)
    assert same == pytest.approx(share)
    for k in range(3):
        step = STEP * np.eye(3)[k]
        numeric = (shares(core=core + step) - shares(core=core - step)) / (2 * STEP)
        assert by_shape[k] == pytest.approx(numeric, abs=SLOPE_ERROR)
    for k, name in enumerate(("wing_share", "wing_sigma_px"), start=3):
        more = replace(PSF, **{name: getattr(PSF, name) + STEP})
        less = replace(PSF, **{name: getattr(PSF, name) - STEP})
        numeric = (shares(psf=more) - shares(psf=less)) / (2 * STEP)
        assert by_shape[k] == pytest.approx(numeric, abs=SLOPE_ERROR)


def test_stars_are_measured_where_they_stand_with_their_light_over_any_level():
    """A Gaussian of 1 and 1.3 px, by the normal distribution's integral, in an image that is not
    square.
    """
    sigma_x, sigma_y, level_dn = 1.0, 1.3, 3.0
    places_px = np.array([[40.3, 20.8], [90.0, 12.5], [15.6, 33.1]])
    flux_dn = np.array([5000.0, 800.0, 20_000.0])
    x, y = np.arange(120.0), np.arange(50.0)
    image = np.full((50, 120), level_dn)
    for (x_px, y_px), dn in zip(places_px, flux_dn, strict=True):
        across = ndtr((x + 0.5 - x_px) / sigma_x) - ndtr((x - 0.5 - x_px) / sigma_x)
        down = ndtr((y + 0.5 - y_px) / sigma_y) - ndtr((y - 0.5 - y_px) / sigma_y)
        image += dn * np.outer(down, across)
    covariance = np.array([[sigma_x**2], [sigma_y**2], [0.0]])
    psf = StarPsf(covariance, 0.0, 0.0, 2.0, (120, 50))
    start_px = places_px + np.array([0.4, -0.3])
    stamps = cut_stamps(image, np.ones_like(image), *start_px.T, np.zeros(3))
    measured = measure(stamps, psf, *start_px.T, GAIN)
    # quadrature in a pixel is right to 1e-3 of its light
    assert measured.places_px == pytest.approx(places_px, abs=2e-3)
    assert measured.dn == pytest.approx(flux_dn, rel=2e-3)
    # Winick 1986, in so much even noise that stars add none
    noise_dn = 1e4
    even = replace(stamps, variance=np.full_like(stamps.variance, noise_dn**2))
    sigma_px = measure(even, psf, *start_px.T, GAIN).sigma_px
    wide2_px2 = np.array([sigma_x**2, sigma_y**2]) + 1 / 12
    axis_px = noise_dn * np.sqrt(8 * np.pi * wide2_px2 * np.sqrt(wide2_px2.prod()))
    one_axis_px = np.sqrt((axis_px**2).mean()) / flux_dn
    assert sigma_px == pytest.approx(one_axis_px, rel=NO_GAUSSIAN)
    # centres of gravity of 5 x 5 pixels lose what lies beyond: they start within a third of a pixel
    assert np.column_stack(_middles(stamps)) == pytest.approx(places_px, abs=0.34)


def test_places_are_within_the_outermost_pixels_centres():
    x = np.array([0.0, 2.1, WIDE_PX - 3.1, WIDE_PX - 2.9, np.nan, 5.0])
    y = np.array([5.0, 5.0, 5.0, 5.0, 5.0, HIGH_PX - 2.9])
    assert within_image(x, y, SIZE_PX, 2.0).tolist() == [False, True, True, False, False, False]


def stars_of(rng: np.random.Generator, offsets_mag, vignetting_mag) -> StarLight:
    """Stars of V = 2 to 6 on several photographs, with noise of a thousandth."""
    count = 60 * len(offsets_mag)
    image = np.repeat(np.arange(len(offsets_mag)), 60)
    v_mag = rng.uniform(2, 6, count)
    radius2 = rng.uniform(0, 1, count)
    a, b = vignetting_mag
    mag = v_mag + np.array(offsets_mag)[image] + a * radius2 + b * radius2**2
    dn = 10 ** (-0.4 * mag) * (1 + 1e-3 * rng.standard_normal(count))
    every = np.ones(count, dtype=bool)
    plane = np.zeros(count, dtype=np.intp)
    return StarLight(image, dn, 1e-3 * dn, v_mag, np.zeros(count), radius2, every, plane)


OFFSETS_MAG, VIGNETTING_MAG = (-12.0, -11.4, -11.9), (0.3, 0.2)
# 60 stars of 0.001 mag each, and four columns that share them
LIGHT_ERROR_MAG = 0.002


def test_the_light_of_photographs_is_their_offsets_and_one_vignetting(rng):
    stars = stars_of(rng, OFFSETS_MAG, VIGNETTING_MAG)
    fit = fit_light(stars, 3, lambda correction: stars.v_mag)
    assert fit.offsets_mag == pytest.approx(OFFSETS_MAG, abs=LIGHT_ERROR_MAG)
    shade = fit.illumination(np.array([0.0, 0.5, 1.0]))
    assert -2.5 * np.log10(shade) == pytest.approx([0, 0.2, 0.5], abs=LIGHT_ERROR_MAG)
    assert fit.linearity == pytest.approx(1, abs=LIGHT_ERROR_MAG)
    # the third photograph has less light than the first by 0.1 mag
    shares = fit.shares()
    assert shares[2] / shares[0] == pytest.approx(10**-0.04, rel=LIGHT_ERROR_MAG)
    assert shares[0] > shares[2] > shares[1]
    assert np.log10(shares).sum() == pytest.approx(0, abs=1e-12)
    assert fit.shares(-12.0)[0] == pytest.approx(1, rel=2 * LIGHT_ERROR_MAG)


def test_a_camera_that_is_held_leaves_its_vignetting_out_of_the_offsets(rng):
    stars = stars_of(rng, OFFSETS_MAG, VIGNETTING_MAG)
    held = LightFit(np.zeros(1), VIGNETTING_MAG, (0.0, 0.0), 12.0, 0.0, 1.0)
    fit = fit_light(stars, 3, lambda correction: stars.v_mag, held)
    assert fit.offsets_mag == pytest.approx(OFFSETS_MAG, abs=LIGHT_ERROR_MAG)
    assert (fit.vignetting_mag, fit.zero_point_mag) == (VIGNETTING_MAG, 12.0)
    # what each star should have, without its photograph's offset
    assert fit.mag + fit.offsets_mag[stars.image] == pytest.approx(
        stars.instrument_mag, abs=5 * LIGHT_ERROR_MAG
    )


def test_extinction_is_what_offsets_grow_by_with_an_air_mass(rng):
    masses, mag_a_mass = (1.0, 1.4, 2.0), 0.21
    stars = stars_of(rng, tuple(-12 + mag_a_mass * mass for mass in masses), (0.0, 0.0))
    fit = fit_light(stars, 3, lambda correction: stars.v_mag)
    told = with_extinction(fit, stars, masses, known=False)
    assert told.extinction_mag == pytest.approx(mag_a_mass, abs=2 * LIGHT_ERROR_MAG)
    assert "extinction_mag_per_air_mass" in told.sigma
    beyond = with_extinction(fit, stars, masses, known=True)
    assert "extinction_beyond_table_mag_per_air_mass" in beyond.sigma
    # masses that are alike, or not known, tell none
    for few in ((1.0, 1.1, 1.2), (1.0, None, 2.0)):
        assert with_extinction(fit, stars, few, known=False).extinction_mag is None


def test_photographs_of_one_sky_tell_no_pattern_of_the_pixels():
    """The third is of the first one's sky, however far the second is."""
    off_deg = math.degrees(20 / 3000)  # 20 px of a focal length of 3000 px
    shots = []
    for ra_deg in (0.0, off_deg, 0.0, off_deg):
        pointing = Pointing(from_radec_roll_deg(ra_deg, 0.0, 0.0))
        shots.append(replace(a_shot(0), pointing=pointing, focal_length_px=3000.0))
    assert _apart(shots) == [0, 1]


def test_the_light_at_a_place_is_of_its_row_and_column():
    image = np.zeros((20, 50))
    image[6:11, 33:38] = 2.0
    image[5], image[:, 32] = 100.0, 100.0
    assert light_at(image, 35.4, 7.6) == 25 * 2.0


def row_of(dn: float, **changes) -> StarRow:
    star = a_star("", 1, 4.0, (10.0, 20.0), dn=dn, dn_predicted=100.0)
    return replace(star, **changes)


def test_a_star_with_less_light_than_predicted_is_fainter():
    row = row_of(50.0)
    assert row.off_mag == pytest.approx(2.5 * math.log10(2))
    assert row.off_px == (0.25, -0.125)
    assert row.counted
    assert math.isnan(row_of(-3.0).off_mag)
    for change in (
        {"dn": -3.0},
        {"v_mag": 6.6},
        {"flags": ("saturated",)},
        {"flags": ("dim region",)},
    ):
        assert not replace(row, **change).counted
    assert replace(row, flags=("variable",)).counted


def session_of(
    masses: tuple[float | None, ...], height_m: float | None, exposures_s=(None,)
) -> Session:
    """What Young's law is asked for: 20 mm, 0.2 s, at a height, and photographs' exposures."""
    shots = []
    for exposure_s in exposures_s:
        shot = a_shot(0)
        shots.append(replace(shot, photo=replace(shot.photo, exposure_s=exposure_s)))
    site = ""
    if height_m is not None:
        site = f"[site]\nlatitude_deg = 5.0\nlongitude_deg = 7.0\nheight_m = {height_m}\n"
        site += '[sky]\nepoch_utc = "2026-11-21T00:00:00Z"\n'
    file = bench_file_of(Path("bench.toml"), TRACKER + site)
    return a_session(file=file, light=replace(a_light(), masses=masses), shots=tuple(shots))


@pytest.mark.parametrize(("height_m", "down"), [(None, 1.0), (0.0, 1.0), (8000.0, math.exp(-1))])
def test_scintillation_by_law_is_youngs_in_magnitudes(height_m, down):
    """Young 1967: 0.09 D^(-2/3) X^1.75 exp(-h / 8 km) / sqrt(2 t) of the light, D in cm."""
    part = _by_law(session_of((1.0, 2.0, None), height_m))
    relative = 0.09 * 2 ** (-2 / 3) * 1.5**1.75 * down / math.sqrt(2 * 0.2)
    assert part.rms == pytest.approx(MAG_A_RELATIVE * relative, rel=1e-12)


def test_scintillation_is_that_of_the_photographs_exposure_where_they_state_one():
    stated = _by_law(session_of((1.0,), None, exposures_s=(2.0, None, 2.0)))
    assert stated.rms == pytest.approx(_by_law(session_of((1.0,), None)).rms / math.sqrt(10))
    assert "2 s" in stated.how


def test_scintillation_without_an_air_mass_is_not_known():
    part = _by_law(session_of((None, None), 0.0))
    assert math.isnan(part.rms)
    rest = _rest(0.25, [Part("a", 0.3, ""), Part("b", 0.0, ""), part])
    assert rest.rms == pytest.approx(0.4)
    assert _rest(0.01, [Part("a", 0.3, "")]).rms == 0.0


def test_what_columns_take_is_their_own_and_not_that_of_chance(rng):
    """A sine of amplitude 0.2 has a mean square of 0.02; random columns take none on average."""
    count = 4000
    phase = rng.uniform(0, 2 * np.pi, count)
    columns = np.column_stack([np.cos(phase), np.sin(phase)])
    noise = 0.1 * rng.standard_normal(count)
    # of the mean square: noise times the wave, 2 x 0.1 x 0.14 over the root of the count
    assert _taken(columns, 0.2 * np.sin(phase + 1) + noise + 7.0) == pytest.approx(0.02, abs=0.002)
    taken = [_taken(rng.standard_normal((40, 10)), rng.standard_normal(40)) for _ in range(200)]
    # 10 of 39 degrees of freedom would be 0.26 of 1; what is cut at 0 leaves a part of its spread
    assert np.mean(taken) < 0.08


def test_pixels_that_are_bright_or_dark_in_all_photographs_are_defects_and_stars_are_not():
    """A star has a third of its peak beside it; one that a sharp lens has on one pixel moves on."""
    photographs = []
    for number in range(4):
        sigmas = np.zeros((20, 24))
        sigmas[3, 5] = 50.0  # hot
        sigmas[15, 2] = -8.0  # dead
        sigmas[12, 9] = -8.0  # dead, beside a star
        sigmas[9:12, 8:11] = 20.0
        sigmas[10, 9] = 60.0
        sigmas[6, 12 + 2 * number] = 40.0
        sigmas[17, 20] = 30.0 * (number != 0)  # hot in three of four
        sigmas[1, 20] = 30.0 * (number > 1)
        photographs.append(sigmas)
    hot, dead = defects(photographs, have_moved=True)
    assert np.argwhere(hot).tolist() == [[3, 5], [17, 20]]
    assert np.argwhere(dead).tolist() == [[12, 9], [15, 2]]


def test_where_stars_stand_still_a_hot_pixel_shares_nothing_in_any_photograph():
    """A star of which a fifth is beside its pixel is hot where stars moved, and none where not,
    whichever photograph is the last.
    """
    star = np.zeros((9, 9))
    star[4, 4], star[4, 5] = 100.0, 20.0
    alone = np.zeros((9, 9))
    alone[4, 4] = 100.0
    assert defects([star, star], have_moved=True)[0][4, 4]
    for photographs in ([star, alone], [alone, star]):
        assert not defects(photographs, have_moved=False)[0].any()
    assert defects([alone, alone], have_moved=False)[0][4, 4]


def test_planes_of_a_mosaic_have_a_colour_each(rng):
    """Red stars are brighter to red by 0.2 mag a mag of B-V, and fainter to blue by 0.3; green is
    the tracker's own.
    """
    planes = (1, 2, 3)
    colours_mag = np.array([-0.2, 0.0, 0.3])
    stars = stars_of(rng, OFFSETS_MAG, (0.0, 0.0))
    bv_mag = rng.uniform(-0.2, 1.6, len(stars.v_mag))
    about_mean = bv_mag - MEAN_BV_MAG
    plane = np.array(planes)[stars.image]
    dn = stars.dn * 10 ** (-0.4 * colours_mag[stars.image] * about_mean)
    stars = replace(stars, bv_mag=bv_mag, plane=plane, dn=dn, sigma_dn=1e-3 * dn)
    fit = fit_light(stars, 3, lambda correction: stars.v_mag)
    assert fit.colours == pytest.approx(colours_mag, abs=2 * LIGHT_ERROR_MAG)
    expected = dict(zip("rgb", colours_mag.tolist(), strict=True))
    assert fit.colour_terms == pytest.approx(expected, abs=2 * LIGHT_ERROR_MAG)
    assert fit.offsets_mag == pytest.approx(OFFSETS_MAG, abs=LIGHT_ERROR_MAG)


# Hipparcos is complete to V = 7.3 + 1.1 |sin b| (ESA SP-1200): as deep at either galactic pole.
@pytest.mark.parametrize(
    ("latitude_deg", "complete_v_mag"), [(90.0, 8.4), (-90.0, 8.4), (30.0, 7.85), (-30.0, 7.85)]
)
def test_a_catalogue_is_complete_by_the_latitude_s_size(latitude_deg, complete_v_mag):
    pole = judge.GALACTIC_POLE
    on_equator = np.cross(pole, [0.0, 0.0, 1.0])
    on_equator /= np.linalg.norm(on_equator)
    latitude = math.radians(latitude_deg)
    boresight = math.sin(latitude) * pole + math.cos(latitude) * on_equator
    found_mag = judge.complete_v_mag(boresight)
    assert found_mag == pytest.approx(complete_v_mag, abs=1e-5)  # of the pole's digits


def test_stars_beyond_a_catalogue_are_those_of_the_counts_less_its_own():
    """Ten stars to V = 8 are 10 x 10^0.9 to V = 10, of which the catalogue has 15, and two fainter."""
    v_mag = np.array([8.0] * 10 + [9.0] * 4 + [10.0] + [11.0] * 2)
    expected_stars = judge.stars_beyond(v_mag, 8.0, 10.0, 0.45)
    assert expected_stars == pytest.approx(10 * 10**0.9 - 15)
    assert judge.stars_beyond(v_mag, 8.0, 9.0, 0.1) == 0.0


def test_a_dim_region_flags_stars_that_were_seen_in_it():
    rows = [row_of(50.0), row_of(50.0, hip=2, flags=("double",)), row_of(0.0, flags=("missing",))]
    flagged = judge.flagged_dim(rows, lambda row: row.hip == 2 or row.dn == 0.0)
    assert [row.flags for row in flagged] == [(), ("double", "dim region"), ("missing",)]


def test_an_exposure_s_dn_are_its_electrons_by_the_gain():
    """100 e- a second are 12.5 DN in half a second at 4 e- a DN."""
    offset_mag = judge.dn_offset_mag(0.5, 4.0)
    assert -2.5 * math.log10(100) + offset_mag == pytest.approx(-2.5 * math.log10(12.5))
    assert math.isfinite(judge.dn_offset_mag(0.0, 4.0))


def test_a_core_is_widened_by_colour_and_stays_an_ellipse():
    """Covariances of 1 and 0.5 px^2 that are 1.4 times as large at a magnitude more of B-V; what
    leans is at most 0.9 of the root of both, to either side.
    """
    middle = np.array([MIDDLE_PX[0]]), np.array([MIDDLE_PX[1]])
    for lean, kept in ((0.2, 0.2), (5.0, 0.9 * math.sqrt(0.5)), (-5.0, -0.9 * math.sqrt(0.5))):
        psf = StarPsf(np.array([[1.0], [0.5], [lean]]), 0.4, 0.0, 2.0, SIZE_PX)
        assert psf.core(*middle, np.array([np.nan])) == pytest.approx(np.array([[1, 0.5, kept]]))
        red = psf.core(*middle, np.array([MEAN_BV_MAG + 1.0]))
        assert red == pytest.approx(1.4 * np.array([[1, 0.5, kept]]))


@pytest.mark.parametrize("wing_share", [0.0, 0.3, 0.6])
def test_a_psf_is_as_wide_as_core_and_wings_together_at_half_of_their_peak(wing_share):
    """Round Gaussians of 0.8 px^2, by the mean of 1 and 0.6, and of 2 px, each with a pixel's twelfth
    of a px^2: SciPy's root of their sum.
    """
    psf = StarPsf(np.array([[1.0], [0.6], [0.1]]), 0.0, wing_share, 2.0, SIZE_PX)
    variances = np.array([0.8, 4.0]) + 1 / 12
    peaks = np.array([1 - wing_share, wing_share]) / variances

    def over_half(radius_px: float) -> float:
        light = peaks * np.exp(-(radius_px**2) / (2 * variances))
        return float(light.sum() - peaks.sum() / 2)

    wanted_px = 2 * brentq(over_half, 0.0, 12.0)
    middle = np.array([MIDDLE_PX[0]]), np.array([MIDDLE_PX[1]])
    assert psf.fwhm_px(*middle)[0] == pytest.approx(wanted_px, abs=2 * FWHM_STEP_PX)


def test_a_pixel_weighs_by_background_photons_and_one_hundredth_of_its_own_light():
    """1000 DN at 0.5 e- a DN beside 100 DN^2: 2000 and 10^2 more."""
    stamps = cut_stamps(np.zeros((20, 30)), np.full((20, 30), 100.0), *np.full((3, 1), 12.0))
    weight = stamps.weight(np.full((1, 2 * HALF + 1, 2 * HALF + 1), 1000.0), 0.5)
    assert weight == pytest.approx(1 / (100 + 2000 + 100))


@pytest.mark.parametrize(("x_px", "y_px"), [(1.0, 8.0), (28.0, 8.0), (15.0, 1.0), (15.0, 18.0)])
def test_pixels_beyond_each_edge_of_an_image_do_not_count(x_px, y_px):
    """A star one pixel from an edge of 30 by 20 px: four rows or columns of its eleven are beyond."""
    at = np.array([x_px]), np.array([y_px]), np.zeros(1)
    stamps = cut_stamps(np.ones((20, 30)), np.ones((20, 30)), *at)
    side = 2 * HALF + 1
    assert int(np.isfinite(stamps.variance).sum()) == side * (side - HALF + 1)
    assert stamps.values.sum() == side * (side - HALF + 1)


def test_stars_of_a_psf_have_no_residuals_by_it_but_its_priors_and_slopes_by_each_number(rng):
    """Colour and wings, too. Of the priors, of one sigma a number, those of the field's coefficients
    alone are off; wings are held where they were.
    """
    covariance = np.array([[0.9, 0.2], [0.7, -0.1], [0.1, 0.05]])
    psf = replace(PSF, covariance=covariance)
    places_px = rng.uniform([30, 30], [600, 440], (5, 2))
    nothing = np.zeros((5, 2 * HALF + 1, 2 * HALF + 1))
    middle_px = np.rint(places_px)
    stamps = Stamps(nothing, nothing + 4.0, *middle_px.T, rng.uniform(-0.2, 1.8, 5))
    dx, dy = stamps.offsets(*places_px.T)
    core = psf.core(*places_px.T, stamps.bv_mag)
    flux_dn = np.array([500.0, 800.0, 2000.0, 3000.0, 900.0])
    shown = flux_dn[:, None, None] * psf.on_pixels(dx, dy, core)[0] + 7.0
    one = np.ones(5)
    at = Measured(*places_px.T, flux_dn, one, one, one)
    seen = replace(stamps, values=shown)
    loss = _ShapeLoss(seen, at, psf, GAIN, wide=True)
    start = loss.start
    off = loss.residuals(start)
    pixels = nothing.size
    assert off[:pixels] == pytest.approx(0.0, abs=1e-6)
    assert off[pixels:] == pytest.approx([0.2, -0.1, 0.05, 0.0, 0.0])
    slopes = loss.slopes(start, off)
    for number in range(len(start)):
        step = STEP * np.eye(len(start))[number]
        wanted = (loss.residuals(start + step) - loss.residuals(start - step)) / (2 * STEP)
        within = 1e-5 * np.abs(wanted).max()
        assert slopes[:, number] == pytest.approx(wanted, abs=within)
    # of another PSF only the core moves, until colour and wings are fitted, too
    other = replace(psf, colour=0.1, wing_share=0.2)
    first = _shape(seen, at, other, GAIN, wide=False)
    assert (first.colour, first.wing_share, first.wing_sigma_px) == (0.1, 0.2, psf.wing_sigma_px)
    assert np.abs(first.covariance - covariance).max() > 0.01
    then = _shape(seen, at, first, GAIN, wide=True)
    assert abs(then.wing_share - psf.wing_share) < 0.02
