"""The centroider against truth: its S-curves against theory, its scatter against the propagated
noise of the pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ndtr
from scipy.stats import norm

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.tracker.centroids import (
    CentroidSettings,
    LocalBackground,
    estimate_background,
    find_stars,
    s_curves,
)
from hilstar.tracker.detector import Detector
from hilstar.tracker.settings import DetectorSettings

SIGMAS_PX = (0.4, 0.5, 0.55, 0.75, 1.0, 2.0, 3.0)
PHASES_PX = np.linspace(-0.5, 0.5, 24, endpoint=False)
READ_NOISE_E = 10.0
STARS = 900  # in a measured field: 1800 coordinates

# Errors are looked at to 5 of their own sigmas.
SIGMAS = 5.0
# Newton stops at 1e-7 px. At a phase of half a pixel the window's outermost pixels, 4 window sigmas
# out, come and go: a
# star of 3 px has 12 px * 0.133 e-/px * exp(-16) there, over a slope of 1/2: 4e-7 px.
NUMERICAL_PX = 6e-7
# The S-curve is taken out by a straight line between 201 phases: h^2 / 8 times its second
# derivative (2 pi)^2 0.05 px is 6e-6 px at 0.4 px and a 1 px window; its second harmonic, smaller
# but four times as curved, as much again.
CORRECTED_PX = 2e-5
# The prediction is of first order, and taken at the true place: where the S-curve is 0.05 px (0.4
# px, SNR 100) the
# weights at the measured place differ, and 8 seeds lie 3 % lower on average, 0.4 px at SNR 30 as
# much higher. The
# estimate's error, 1 / sqrt(2 * 1800) = 1.7 %, counts 4 times.
SCATTER_TOLERANCE = 0.03 + 4 * 0.017
FIRST_ORDER_SNR = (30.0, 100.0)


def profile(place_px: FloatArray, sigma_px: float, size_px: int) -> FloatArray:
    """Shares of Gaussian stars in the pixels of one axis, shape (n, size_px)."""
    pixel = np.arange(size_px) - np.asarray(place_px)[..., None]
    return ndtr((pixel + 0.5) / sigma_px) - ndtr((pixel - 0.5) / sigma_px)


def star_image(x_px: float, y_px: float, sigma_px: float, size_px: int = 61) -> FloatArray:
    return np.outer(
        profile(np.array(y_px), sigma_px, size_px), profile(np.array(x_px), sigma_px, size_px)
    )


@dataclass(frozen=True)
class Field:
    """A grid of equal stars, each in its own tile, and their true places."""

    mean_e: FloatArray
    x_px: FloatArray
    y_px: FloatArray


def star_field(sigma_px: float, flux_e: float, rng: np.random.Generator, tile_px: int) -> Field:
    side = math.isqrt(STARS)
    phase_x, phase_y = rng.uniform(-0.5, 0.5, (2, STARS))
    middle = tile_px // 2
    shares = (profile(middle + phase, sigma_px, tile_px) for phase in (phase_y, phase_x))
    y, x = shares
    tiles = flux_e * y[:, :, None] * x[:, None, :]
    image = (
        tiles.reshape(side, side, tile_px, tile_px)
        .transpose(0, 2, 1, 3)
        .reshape(side * tile_px, side * tile_px)
    )
    row, column = np.divmod(np.arange(STARS), side)
    return Field(image, column * tile_px + middle + phase_x, row * tile_px + middle + phase_y)


def flux_for(snr: float, sigma_px: float) -> float:
    """Electrons of a star whose matched-filter signal to noise is `snr`: noise-equivalent area 4
    pi (sigma^2 + 1/12).
    """
    area_px = 4 * math.pi * (sigma_px**2 + 1 / 12)
    return (snr**2 + math.sqrt(snr**4 + 4 * snr**2 * area_px * READ_NOISE_E**2)) / 2


@dataclass(frozen=True)
class Errors:
    """What a field of stars gave: errors of the found ones, (n,) in px, with their true place
    within the pixel.
    """

    error_px: FloatArray
    phase_px: FloatArray
    found: float

    @property
    def scatter_px(self) -> float:
        return float(self.error_px.std())

    @property
    def s_curve_px(self) -> float:
        """The amplitude of the part of the error that goes as sin(2 pi phase)."""
        return float(2 * np.mean(self.error_px * np.sin(2 * np.pi * self.phase_px)))


def centroid_errors(sigma_px: float, snr: float, settings: CentroidSettings, seed: int) -> Errors:
    """Errors, x and y together, of the centroids of STARS stars with photon and read noise."""
    rng = np.random.default_rng(seed)
    field = star_field(sigma_px, flux_for(snr, sigma_px), rng, 2 * settings.radius_px + 5)
    image = rng.poisson(field.mean_e) + READ_NOISE_E * rng.standard_normal(field.mean_e.shape)
    found = find_stars(image, settings, LocalBackground(0.0, READ_NOISE_E))
    distance_px = np.hypot(found.x_px - field.x_px[:, None], found.y_px - field.y_px[:, None])
    nearest = distance_px.argmin(axis=1)
    near = distance_px.min(axis=1) < 1 + sigma_px
    true = np.concatenate([field.x_px[near], field.y_px[near]])
    error = np.concatenate([found.x_px[nearest[near]], found.y_px[nearest[near]]]) - true
    return Errors(error, true - np.rint(true), float(near.mean()))


def predicted_scatter_px(sigma_px: float, snr: float, settings: CentroidSettings) -> float:
    """The scatter of the zero of sum w d I: sqrt(sum (w d)^2 V) / |sum I d(w d)/dx|, V = I +
    read noise^2, over phases.
    """
    radius, flux_e = settings.radius_px, flux_for(snr, sigma_px)
    d = np.arange(2 * radius + 1) - radius
    variances = []
    for phase in PHASES_PX:
        image = flux_e * star_image(radius + phase, radius, sigma_px, 2 * radius + 1)
        dx, dy = (d - phase)[None, :], d[:, None]
        weight = np.exp(-0.5 * (dx**2 + dy**2) / settings.window_sigma_px**2)
        slope = (image * weight * (dx**2 / settings.window_sigma_px**2 - 1)).sum()
        variances.append(((weight * dx) ** 2 * (image + READ_NOISE_E**2)).sum() / slope**2)
    return math.sqrt(np.mean(variances))


def bias_px(sigma_px: float, settings: CentroidSettings) -> FloatArray:
    """Error of noiseless stars in x, at PHASES_PX; the y place is another one."""
    biases = []
    for phase in PHASES_PX:
        found = find_stars(
            1e6 * star_image(30 + phase, 30.3, sigma_px), settings, LocalBackground(0.0, 20.0)
        )
        assert len(found) == 1
        biases.append(found.x_px[0] - 30 - phase)
    return np.array(biases)


def window_for(sigma_px: float) -> CentroidSettings:
    """The window that this module advises: the star's sigma, and no less than 1 px."""
    return CentroidSettings(window_sigma_px=max(1.0, sigma_px), threshold_sigma=4.0)


@pytest.mark.parametrize("sigma_px", SIGMAS_PX)
def test_the_plain_windows_s_curve_is_that_of_theory(sigma_px):
    # Alexander and Ng 1991, "Elimination of systematic error in subpixel accuracy centroid
    # estimation": the first
    # harmonic of the sampled first moment; the second is exp(-8 pi^2 sigma^2) / (2 pi).
    settings = CentroidSettings(window="plain", window_radius_px=math.ceil(6 * sigma_px) + 1)
    theory = -np.exp(-2 * np.pi**2 * sigma_px**2) / np.pi * np.sin(2 * np.pi * PHASES_PX)
    second_harmonic = math.exp(-8 * math.pi**2 * sigma_px**2) / (2 * math.pi)
    np.testing.assert_allclose(
        bias_px(sigma_px, settings), theory, rtol=0, atol=second_harmonic + NUMERICAL_PX
    )


@pytest.mark.parametrize("sigma_px", SIGMAS_PX)
def test_the_gaussian_windows_s_curve_is_the_zero_of_its_own_definition(sigma_px):
    settings = window_for(sigma_px)
    pixel, half_px = np.arange(61), settings.window_sigma_px

    def moment(x: float, light: FloatArray) -> float:
        inside = np.abs(pixel - np.rint(x)) <= settings.radius_px
        return float(
            np.sum(light * inside * np.exp(-0.5 * ((pixel - x) / half_px) ** 2) * (pixel - x))
        )

    theory = [
        brentq(
            moment,
            30 + phase - 0.3,
            30 + phase + 0.3,
            args=(profile(np.array(30 + phase), sigma_px, 61),),
            xtol=1e-10,
        )
        - (30 + phase)
        for phase in PHASES_PX
    ]
    np.testing.assert_allclose(bias_px(sigma_px, settings), theory, rtol=0, atol=NUMERICAL_PX)


def test_the_s_curve_of_the_benchs_star_is_what_the_module_says():
    # centroids.py: 0.017 px at 0.55 px and a window of 1 px; two digits are given.
    assert np.abs(bias_px(0.55, CentroidSettings(window_sigma_px=1.0))).max() == pytest.approx(
        0.0165, abs=0.0005
    )


@pytest.mark.parametrize("window", ["gaussian", "plain"])
@pytest.mark.parametrize("sigma_px", SIGMAS_PX)
def test_a_known_star_size_takes_the_s_curve_out(sigma_px, window):
    settings = replace(window_for(sigma_px), psf_sigma_px=(sigma_px, sigma_px), window=window)
    # a narrower square cuts the star's wings, and jumps by what it cuts at half a pixel
    if window == "plain":
        settings = replace(settings, window_radius_px=math.ceil(6 * sigma_px) + 1)
    assert np.abs(bias_px(sigma_px, settings)).max() < CORRECTED_PX


def test_an_elliptical_stars_axes_have_an_s_curve_each():
    settings = replace(window_for(0.5), psf_sigma_px=(0.8, 0.5))
    image = 1e6 * np.outer(profile(np.array(30.21), 0.5, 61), profile(np.array(30.21), 0.8, 61))
    plain, corrected = (
        find_stars(image, s, LocalBackground(0.0, 20.0))
        for s in (replace(settings, psf_sigma_px=None), settings)
    )
    assert abs(plain.y_px[0] - 30.21) > 10 * abs(plain.x_px[0] - 30.21) > 10 * CORRECTED_PX
    assert abs(corrected.x_px[0] - 30.21) < CORRECTED_PX
    assert abs(corrected.y_px[0] - 30.21) < CORRECTED_PX


@pytest.mark.parametrize("snr", FIRST_ORDER_SNR)
@pytest.mark.parametrize("sigma_px", SIGMAS_PX)
def test_the_scatter_is_the_pixels_noise_propagated(sigma_px, snr):
    settings = replace(window_for(sigma_px), psf_sigma_px=(sigma_px, sigma_px))
    errors = centroid_errors(sigma_px, snr, settings, seed=11)
    assert errors.found == 1.0
    assert errors.scatter_px == pytest.approx(
        predicted_scatter_px(sigma_px, snr, settings), rel=SCATTER_TOLERANCE
    )
    # No S-curve is left in the noise: its amplitude's own error is scatter sqrt(2 / n).
    assert abs(errors.s_curve_px) < SIGMAS * errors.scatter_px * math.sqrt(2 / len(errors.error_px))


def test_the_first_column_is_x_and_the_first_pixels_centre_is_nought():
    image = np.zeros((11, 21))
    image[3, 7] = 100.0
    found = find_stars(image, CentroidSettings(window_radius_px=2), LocalBackground(0.0, 1.0))
    assert (found.x_px[0], found.y_px[0]) == (7.0, 3.0)
    # A whole pixel to the right and half a pixel down.
    found = find_stars(
        100 * star_image(12.0, 8.5, 1.0, 21), CentroidSettings(), LocalBackground(0.0, 1.0)
    )
    assert found.x_px[0] == pytest.approx(12.0, abs=NUMERICAL_PX)
    assert found.y_px[0] == pytest.approx(8.5, abs=NUMERICAL_PX)


@pytest.mark.parametrize("window", ["gaussian", "plain"])
def test_a_mirrored_image_has_mirrored_stars(window):
    image = 1e5 * (star_image(20.3, 25.1, 0.8) + 0.5 * star_image(40.7, 33.2, 0.8))
    settings = CentroidSettings(window=window)
    found = find_stars(image, settings, LocalBackground(0.0, 10.0))
    mirrored = find_stars(
        np.ascontiguousarray(image[::-1, ::-1]), settings, LocalBackground(0.0, 10.0)
    )
    np.testing.assert_allclose(60 - mirrored.x_px, found.x_px, atol=NUMERICAL_PX)
    np.testing.assert_allclose(60 - mirrored.y_px, found.y_px, atol=NUMERICAL_PX)


def test_stars_come_brightest_first_with_their_flux_peak_and_pixels():
    fluxes = (2e4, 9e4, 5e4)
    places = ((15.2, 15.4), (45.1, 15.3), (30.2, 44.9))
    image = sum(flux * star_image(*place, 0.8) for flux, place in zip(fluxes, places, strict=True))
    found = find_stars(image + 300.0, CentroidSettings(), LocalBackground(300.0, 10.0))
    # The window is 4 px on each side: at 0.8 px of sigma and 0.45 px off its middle it cuts 4
    # sigmas off, under 1e-5.
    np.testing.assert_allclose(found.flux, sorted(fluxes, reverse=True), rtol=1e-5)
    np.testing.assert_allclose(found.x_px, [45.1, 30.2, 15.2], atol=0.0025)  # the S-curve at 0.8 px
    assert found.peak[0] == pytest.approx(image.max())
    assert found.pixels[0] == (9e4 * star_image(*places[1], 0.8) > 50.0).sum()
    assert not found.at_edge.any()


def test_small_blobs_can_be_left_out():
    image = 1e5 * star_image(30.3, 30.3, 1.0)
    image[10, 10] = 5000.0
    background = LocalBackground(0.0, 10.0)
    assert len(find_stars(image, CentroidSettings(minimum_pixels=1), background)) == 2
    assert len(find_stars(image, CentroidSettings(minimum_pixels=2), background)) == 1


def test_pixels_that_touch_by_a_corner_are_one_star():
    image = np.zeros((20, 20))
    image[10, 10] = image[11, 11] = 50.0
    found = find_stars(
        image, CentroidSettings(window="plain", window_radius_px=3), LocalBackground(0.0, 1.0)
    )
    assert (found.x_px.tolist(), found.y_px.tolist(), found.pixels.tolist()) == (
        [10.5],
        [10.5],
        [2],
    )


def test_stars_whose_windows_leave_the_image_say_so():
    image = 1e5 * (
        star_image(1.0, 30.0, 0.8) + star_image(30.0, 30.0, 0.8) + 0.5 * star_image(30.0, 58.0, 0.8)
    )
    found = find_stars(image, CentroidSettings(), LocalBackground(0.0, 10.0))
    assert found.at_edge[np.argsort(found.x_px)].tolist().count(True) == 2
    assert not found.at_edge[(np.abs(found.x_px - 30) < 1) & (np.abs(found.y_px - 30) < 1)].any()


@pytest.mark.parametrize("image", [np.zeros((20, 30)), np.full((20, 30), 7, dtype=np.uint16)])
def test_an_empty_image_has_no_stars(image):
    found = find_stars(image)
    assert len(found) == 0
    assert found.flux.shape == (0,)


def test_noise_passes_the_threshold_as_often_as_a_normal_law_does():
    noise = np.random.default_rng(5).standard_normal((512, 512))
    expected = norm.sf(3.0) * noise.size
    found = len(find_stars(noise, CentroidSettings(threshold_sigma=3.0), LocalBackground(0.0, 1.0)))
    # Of 354 pixels, 4 * 0.00135 touch another one: 2 blobs fewer.
    assert found == pytest.approx(expected - 2, abs=SIGMAS * math.sqrt(expected))


@pytest.mark.parametrize(("gain_e_per_dn", "noise_e"), [(1.0, 12.0), (24.0, 12.0), (24.0, 40.0)])
def test_the_background_is_found_under_stars_and_to_a_fraction_of_a_dn(gain_e_per_dn, noise_e):
    rng = np.random.default_rng(6)
    sky = 1000.0 + noise_e * rng.standard_normal((300, 300))
    places = rng.uniform(20, 280, (30, 2))
    for x, y in places:
        column, row = int(x) - 10, int(y) - 10
        sky[row : row + 21, column : column + 21] += 1e5 * star_image(x - column, y - row, 0.8, 21)
    image = np.rint(sky / gain_e_per_dn).astype(np.uint16)
    found = estimate_background(image)
    noise_dn = math.hypot(noise_e / gain_e_per_dn, math.sqrt(1 / 12))
    # 30 stars have some 30 pixels each within 3 sigma of the sky, 1 % of all, lifting the level by
    # 1 % of 1.5 sigma and
    # the noise by 2 %. Rounding of 0.5 DN of noise is not even: its first harmonic, exp(-2 pi^2
    # noise^2) / pi, is 0.002 DN. 3 sigma of whole codes cut up to half a code more on one side:
    # 0.0044 / 2 DN.
    assert found.level == pytest.approx(1000.0 / gain_e_per_dn, abs=0.015 * noise_dn + 0.005)
    assert found.noise == pytest.approx(noise_dn, rel=0.04)
    # The same in electrons, which are no whole numbers: most pixels share one value, and only the
    # step tells their noise.
    in_electrons = estimate_background((image - 7.5) * gain_e_per_dn, gain_e_per_dn)
    assert in_electrons.level == pytest.approx((found.level - 7.5) * gain_e_per_dn, rel=1e-9)
    assert in_electrons.noise == pytest.approx(found.noise * gain_e_per_dn, rel=1e-9)


def test_stars_through_the_detector_keep_their_places_and_their_light():
    sigma_px, flux_e = 0.55, 20_000.0
    settings = CentroidSettings(psf_sigma_px=(sigma_px, sigma_px))
    field = star_field(sigma_px, flux_e, np.random.default_rng(8), 2 * settings.radius_px + 9)
    sensor = DetectorSettings(
        gain_e_per_dn=4.0, bits=14, offset_dn=100.0, read_noise_e=READ_NOISE_E, dark_e_per_s=203.0
    )
    detector = Detector(sensor, field.mean_e.shape[::-1])
    found = find_stars(detector.expose(field.mean_e, 0.1, np.random.default_rng(9)), settings)
    assert len(found) == STARS
    distance_px = np.hypot(found.x_px - field.x_px[:, None], found.y_px - field.y_px[:, None]).min(
        axis=1
    )
    # Over noise of 10 e- the signal to noise is 140: first order, 0.0045 px an axis.
    snr = flux_e / math.sqrt(
        flux_e + 4 * math.pi * (sigma_px**2 + 1 / 12) * (READ_NOISE_E**2 + 20.3 + 16 / 12)
    )
    expected_px = predicted_scatter_px(sigma_px, snr, settings) * math.sqrt(2)
    assert math.sqrt(np.mean(distance_px**2)) == pytest.approx(expected_px, rel=SCATTER_TOLERANCE)
    # The level under 81 pixels of window is known to 0.02 of its noise (see above), 11 e-.
    flux_error_e = math.sqrt((flux_e + 81 * 121) / STARS) * SIGMAS + 81 * 0.02 * 11
    assert found.flux.mean() * 4.0 == pytest.approx(flux_e, abs=flux_error_e)


def test_a_window_too_narrow_to_tell_two_places_apart_is_refused():
    with pytest.raises(InputError, match="too narrow"):
        s_curves(CentroidSettings(window_sigma_px=0.4, psf_sigma_px=(0.4, 0.4)))


@pytest.mark.parametrize(
    "image",
    [
        np.zeros(5),
        np.zeros((0, 4)),
        np.full((5, 5), np.nan),
        np.full((5, 5), np.inf),
        np.full((5, 5), "a"),
    ],
)
def test_what_is_no_image_is_refused(image):
    with pytest.raises(InputError, match="centroids"):
        find_stars(image)


@pytest.mark.parametrize(
    "wrong",
    [
        {"threshold_sigma": -1.0},
        {"threshold_sigma": math.nan},
        {"minimum_pixels": 0},
        {"window": "square"},
        {"window_sigma_px": 0.0},
        {"window_radius_px": 0},
        {"iterations": 0},
        {"psf_sigma_px": (0.0, 1.0)},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        CentroidSettings(**wrong)
