"""The virtual detector: its order of steps, its seeds, and what it does with the extreme and the
wrong.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from msgspec.structs import replace
from scipy import ndimage, stats

from hilstar.basics.errors import InputError
from hilstar.tracker.detector import (
    RAY_DEPTH_UM,
    RAY_E_PER_UM,
    Detector,
    bloom,
    cosmic_rays_e,
    false_stars_e,
)
from hilstar.tracker.settings import MAX_E, DetectorSettings, e2v_dark, silicon_gap_ev
from tests.support.refusals import refusal

SIZE_PX = (160, 128)
SHAPE = (128, 160)
PIXELS = 128 * 160

# A mean of n samples lies 5 of its own sigmas off once in 1.7 million; seeds are fixed, so this is
# a margin, not a flake.
SIGMAS = 5.0
# The relative error of a sigma from n samples is 1 / sqrt(2 n): 0.5 % for the pixels of one frame.
SIGMA_ERROR = SIGMAS / math.sqrt(2 * PIXELS)

EVERYTHING = DetectorSettings(
    gain_e_per_dn=4.0,
    offset_dn=100.0,
    read_noise_e=8.0,
    dark_e_per_s=203.0,
    dsnu_e_per_s=60.0,
    prnu=0.03,
    device_seed=7,
    fixed_pattern="cmos",
    hot_pixel_fraction=0.01,
    dead_pixel_fraction=0.01,
    column_noise_e=10.0,
    cosmic_rays_per_cm2_s=100.0,
    false_stars=5,
    blooming=True,
    quantisation_noise=True,
)


def generator(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def flat_e(level_e: float) -> np.ndarray:
    return np.full(SHAPE, level_e)


def test_same_seeds_give_the_same_image_bit_for_bit():
    first, second = (
        Detector(EVERYTHING, SIZE_PX).expose(flat_e(900.0), 1.0, generator()) for _ in range(2)
    )
    assert first.dtype == np.uint16
    assert first.shape == SHAPE
    np.testing.assert_array_equal(first, second)


def test_another_frame_seed_changes_only_the_frames_noise():
    settings = DetectorSettings(
        gain_e_per_dn=1.0, prnu=0.05, dsnu_e_per_s=200.0, dark_e_per_s=1000.0, bits=16
    )
    detector = Detector(settings, SIZE_PX)
    first, second = (
        detector.expose(flat_e(10_000.0), 1.0, generator(seed)).astype(float) for seed in (1, 2)
    )
    assert (first != second).mean() > 0.9
    # Shot noise of 11 000 e- is 105 e-, the fixed pattern 540 e-: the difference holds the first
    # and not the second.
    shot_e = math.sqrt(11_000.0)
    rounding = 1 / 12
    assert (first - second).std() == pytest.approx(
        math.sqrt(2 * (shot_e**2 + rounding)), rel=SIGMA_ERROR
    )
    assert first.std() > 4 * shot_e


def test_another_device_seed_changes_every_map():
    one, other = (Detector(replace(EVERYTHING, device_seed=seed), SIZE_PX) for seed in (1, 2))
    for name in ("gain_map", "dark_map_e_per_s", "column_e"):
        # Two continuous draws agree nowhere but on the few pixels that are dead, or cut at no dark,
        # in both.
        assert (getattr(one, name) == getattr(other, name)).mean() < 0.01


ONE_MAP = {
    "prnu": ("gain_map", {"prnu": 0.01}),
    "dsnu": ("dark_map_e_per_s", {"dsnu_e_per_s": 10.0}),
    "offset": ("offset_map_e", {"dsnu_e": 5.0}),
    "columns": ("column_e", {"column_noise_e": 5.0}),
    "dark columns": ("dark_map_e_per_s", {"column_dark_e_per_s": 10.0}),
    "hot": ("dark_map_e_per_s", {"hot_pixel_fraction": 0.5}),
    "dead": ("gain_map", {"dead_pixel_fraction": 0.5}),
    "dead rows": ("gain_map", {"dead_row_fraction": 0.5}),
    "dead columns": ("gain_map", {"dead_column_fraction": 0.5}),
}


@pytest.mark.parametrize("pair", list(itertools.combinations(ONE_MAP, 2)), ids=" and ".join)
def test_the_maps_of_two_defects_have_nothing_in_common(pair):
    """A stream of random numbers that two defects share makes one the other's picture."""
    cmos = DetectorSettings(fixed_pattern="cmos", dark_e_per_s=1e4)
    begins = []
    for defect in pair:
        name, setting = ONE_MAP[defect]
        values = getattr(Detector(replace(cmos, **setting), SIZE_PX), name)
        along = values[:, 0] if defect == "dead rows" else values.ravel()
        begins.append(along[: SHAPE[0]])
    correlation = stats.spearmanr(*begins).statistic
    assert abs(correlation) < SIGMAS / math.sqrt(SHAPE[0])


def test_switching_one_defect_on_leaves_the_other_maps_as_they_were():
    plain = Detector(DetectorSettings(prnu=0.03, dark_e_per_s=203.0, dsnu_e_per_s=60.0), SIZE_PX)
    hot = Detector(
        DetectorSettings(prnu=0.03, dark_e_per_s=203.0, dsnu_e_per_s=60.0, hot_pixel_fraction=0.01),
        SIZE_PX,
    )
    np.testing.assert_array_equal(plain.gain_map, hot.gain_map)
    changed = plain.dark_map_e_per_s != hot.dark_map_e_per_s
    assert changed.sum() == pytest.approx(0.01 * PIXELS, abs=SIGMAS * math.sqrt(0.01 * PIXELS))
    assert (hot.dark_map_e_per_s[changed] > plain.dark_map_e_per_s[changed]).all()


def test_the_gain_map_acts_on_light_before_its_shot_noise():
    detector = Detector(DetectorSettings(gain_e_per_dn=1.0, bits=16, prnu=0.3), SIZE_PX)
    first, second = (
        detector.expose(flat_e(5000.0), 0.0, generator(seed)).astype(float) for seed in (1, 2)
    )
    # Before: a variance of 5000 <g>. After: 5000 <g^2>, 9 % more. The variance of 20 480
    # differences is good to 1 %.
    variance_e2 = (first - second).var() / 2 - 1 / 12
    assert variance_e2 == pytest.approx(5000.0, rel=0.045)


@pytest.mark.parametrize("version", [1, 2])
def test_the_gain_map_acts_on_light_alone(version):
    """Dark current of 2500 electrons scatters by its shot noise; gains of 30 % would add 750."""
    settings = DetectorSettings(
        gain_e_per_dn=1.0, bits=16, prnu=0.3, dark_e_per_s=2500.0, noise_version=version
    )
    settings = replace(settings, temperature_k=settings.dark_reference_temperature_k)
    dark = Detector(settings, SIZE_PX).expose(flat_e(0.0), 1.0, generator())
    assert dark.std() == pytest.approx(math.sqrt(2500 + 1 / 12), rel=SIGMA_ERROR)


def test_the_full_well_clips_before_read_noise_and_adc():
    settings = DetectorSettings(
        gain_e_per_dn=1.0, full_well_e=3000.0, bits=16, offset_dn=100.0, read_noise_e=20.0
    )
    image = Detector(settings, SIZE_PX).expose(flat_e(1e6), 1.0, generator()).astype(float)
    # Read noise after the clip is whole; before it, the image would be a constant 3100. No shot
    # noise survives the clip.
    noise_e = math.sqrt(20.0**2 + 1 / 12)
    assert image.mean() == pytest.approx(3100.0, abs=SIGMAS * noise_e / math.sqrt(PIXELS))
    assert image.std() == pytest.approx(noise_e, rel=SIGMA_ERROR)


def test_noise_by_source_is_what_frames_of_that_source_alone_scatter_by():
    bench = DetectorSettings(gain_e_per_dn=0.5, offset_dn=500.0, bits=16)
    rounding_e2 = 0.5**2 / 12
    sources = {
        "shot_e2": ({}, 900.0),
        "dark_e2": ({"dark_e_per_s": 300.0, "temperature_k": 298.0}, 0.0),
        "read_e2": ({"read_noise_e": 12.0}, 0.0),
        "prnu_e2": ({"prnu": 0.2}, 5000.0),
        "dsnu_e2": (
            {
                "dark_e_per_s": 900.0,
                "dsnu_e_per_s": 90.0,
                "fixed_pattern": "cmos",
                "column_noise_e": 80.0,
            },
            0.0,
        ),
        "dsnu_e2 of offsets": ({"dsnu_e": 30.0}, 0.0),
        "reset_e2": ({"sense_capacitance_ff": 2.0, "temperature_k": 250.0}, 0.0),
        "quantisation_e2": ({"quantisation_noise": True}, 0.0),
    }
    for name, (keys, light_e) in sources.items():
        settings = replace(bench, **keys)
        noise = settings.noise(light_e, 2.0)
        assert getattr(noise, name.split()[0]) > 0.7 * noise.total_e2, name
        variance_e2 = (
            Detector(settings, (1280, 128))
            .expose(np.full((128, 1280), light_e), 2.0, generator())
            .var()
            * 0.25
        )
        # 1280 columns give the variance of a column to 4 %; it is at most half of one of these.
        assert variance_e2 == pytest.approx(noise.total_e2, rel=SIGMAS * 0.02), name
    assert bench.noise(0.0, 0.0).total_e2 == pytest.approx(rounding_e2)


@pytest.mark.parametrize("bits", [1, 8, 12, 16])
def test_the_adc_clips_at_its_largest_code_and_at_zero(bits):
    settings = DetectorSettings(gain_e_per_dn=0.1, full_well_e=1e6, bits=bits, read_noise_e=3.0)
    detector = Detector(settings, SIZE_PX)
    assert (detector.expose(flat_e(2e4), 1.0, generator()) == 2**bits - 1).all()
    dark = detector.expose(flat_e(0.0), 1.0, generator())
    assert dark.max() > 0
    # Half of the read noise is below no electrons, and what rounds to 0 (half a DN, 0.05 e-, 0.017
    # sigma): 0.507.
    assert (dark == 0).mean() == pytest.approx(0.507, abs=SIGMAS * 0.5 / math.sqrt(PIXELS))


def test_a_pixel_of_1e9_electrons_is_full_and_its_neighbours_are_not():
    image_e = flat_e(100.0)
    image_e[60, 80] = 1e9
    image = Detector(DetectorSettings(offset_dn=10.0), SIZE_PX).expose(image_e, 0.1, generator())
    assert image[60, 80] == round(70_000 / 24 + 10)
    image[60, 80] = 0
    assert image.max() < 30  # 100 e- are 4 DN over the offset, with 0.4 DN of noise


def test_1e9_electrons_have_their_own_mean_and_shot_noise():
    settings = DetectorSettings(gain_e_per_dn=20_000.0, full_well_e=MAX_E, bits=16)
    image_e = Detector(settings, SIZE_PX).expose(flat_e(1e9), 0.1, generator()) * 20_000.0
    noise_e = math.sqrt(1e9 + 20_000.0**2 / 12)
    assert image_e.mean() == pytest.approx(1e9, abs=SIGMAS * noise_e / math.sqrt(PIXELS))
    assert image_e.std() == pytest.approx(noise_e, rel=SIGMA_ERROR)


def test_no_exposure_and_no_light_give_the_offset_and_nothing_else():
    quiet = replace(EVERYTHING, read_noise_e=0.0, column_noise_e=0.0, quantisation_noise=False)
    image = Detector(quiet, SIZE_PX).expose(flat_e(0.0), 0.0, generator())
    assert (image == 100).all()
    assert (Detector(EVERYTHING, SIZE_PX).expose_noiseless(flat_e(0.0), 0.0) == 100).all()


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64, np.uint16])
def test_electrons_of_every_number_type_give_the_same_image_and_stay_as_they_were(kind):
    image_e = flat_e(300.0).astype(kind)
    image = Detector(EVERYTHING, SIZE_PX).expose(image_e, 0.1, generator())
    Detector(EVERYTHING, SIZE_PX).expose_noiseless(image_e, 0.1)
    np.testing.assert_array_equal(
        image, Detector(EVERYTHING, SIZE_PX).expose(flat_e(300.0), 0.1, generator())
    )
    assert (image_e == 300).all()


def test_noiseless_is_the_rounded_mean_without_fixed_pattern():
    detector = Detector(replace(EVERYTHING, blooming=False), SIZE_PX)
    image_e = generator().uniform(0.0, 20_000.0, SHAPE)
    expected = np.rint((image_e + 203.0 * 2.0) / 4.0 + 100.0).clip(0, 4095)
    np.testing.assert_array_equal(detector.expose_noiseless(image_e, 2.0), expected)


def test_the_noiseless_dark_is_that_of_the_temperature():
    settings = DetectorSettings(dark_e_per_s=400.0, dark_law="ccd47-20", temperature_k=280.0)
    image = Detector(settings, SIZE_PX).expose_noiseless(flat_e(0.0), 10.0)
    dark_e = 4000.0 * e2v_dark("ccd47-20", 280.0) / e2v_dark("ccd47-20", 293.0)
    assert image[0, 0] == round(dark_e / settings.gain_e_per_dn + settings.offset_dn) != 0


def test_a_half_goes_to_the_even_code():
    detector = Detector(DetectorSettings(gain_e_per_dn=2.0, offset_dn=0.0), (4, 1))
    codes = detector.expose_noiseless(np.array([[1.0, 3.0, 5.0, 6.0]]), 1.0)
    assert codes.tolist() == [[0, 2, 2, 3]]


def test_noisy_frames_scatter_around_the_noiseless_one():
    settings = DetectorSettings(
        gain_e_per_dn=2.0, offset_dn=50.0, read_noise_e=6.0, dark_e_per_s=100.0
    )
    detector = Detector(settings, SIZE_PX)
    rng, frames = generator(), 16
    mean = np.mean([detector.expose(flat_e(1000.0), 1.0, rng) for _ in range(frames)])
    # 1100 e- are 550 DN exactly, so nothing is lost by rounding the noiseless frame.
    noise_dn = math.sqrt(1100.0 + 36.0) / 2
    assert detector.expose_noiseless(flat_e(1000.0), 1.0)[0, 0] == 600
    assert mean == pytest.approx(600.0, abs=SIGMAS * noise_dn / math.sqrt(frames * PIXELS))


def test_quantisation_noise_is_roundings_unless_the_thesis_gaussian_is_asked_for():
    ramp_e = np.linspace(1000.0, 50_000.0, PIXELS).reshape(SHAPE)
    detector = Detector(DetectorSettings(gain_e_per_dn=24.0), SIZE_PX)
    error_e = detector.expose_noiseless(ramp_e, 0.0) * 24.0 - ramp_e
    # A ramp over 2042 whole DN: the error is uniform, its sigma gain / sqrt 12, to the 1e-3 of the
    # ramp's ends.
    assert error_e.std() == pytest.approx(24.0 / math.sqrt(12), rel=1e-3)
    added = DetectorSettings(gain_e_per_dn=1.0, offset_dn=100.0, quantisation_noise=True)
    assert added.adc_noise_e == pytest.approx(4.93, abs=0.005)  # table 4.2, two digits
    image = Detector(added, SIZE_PX).expose(flat_e(0.0), 0.0, generator())
    assert image.std() == pytest.approx(math.sqrt(added.adc_noise_e**2 + 1 / 12), rel=SIGMA_ERROR)


def test_dark_is_the_datasheets_at_the_reference_and_falls_with_the_cold():
    for law in ("arrhenius", "diffusion-depletion", "ccd47-20", "e2v-nimo"):
        assert DetectorSettings(dark_law=law).dark_factor == 1.0
        factors = [
            DetectorSettings(dark_law=law, temperature_k=t).dark_factor
            for t in (240.0, 260.0, 280.0, 300.0)
        ]
        assert factors == sorted(factors)
    # The datasheet's own figure at 293 K must be the 1 that it is relative to; its coefficients
    # have 3 digits.
    assert e2v_dark("ccd47-20", 293.0) == pytest.approx(1.0, abs=0.005)
    assert e2v_dark("e2v-nimo", 293.0) == pytest.approx(1.0, abs=0.005)


def test_arrhenius_doubles_over_the_textbook_interval():
    # d ln D / dT = E / (k T^2): 0.56 eV at 293 K gives ln 2 in 9.2 K (taken at the middle of the
    # interval).
    interval_k = math.log(2) * 8.617333e-5 * 293.0**2 / 0.56
    colder, warmer = (
        DetectorSettings(temperature_k=293.0 + side * interval_k / 2).dark_factor
        for side in (-1, 1)
    )
    second_order = (interval_k / 293.0) ** 2
    assert warmer / colder == pytest.approx(2.0, rel=second_order)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_diffusion_and_depletion_follow_the_thesis_equation(share):
    # Eq. 4.12 by itself, both terms scaled to their share of the current at 293 K.
    def terms(kelvin: float) -> np.ndarray:
        gap_kt = (1.17 - 4.73e-4 * kelvin**2 / (kelvin + 636)) / (8.617333262e-5 * kelvin)
        return np.array([kelvin**3 * math.exp(-gap_kt), kelvin**1.5 * math.exp(-gap_kt / 2)])

    for kelvin in (230.0, 263.0, 293.0, 313.0):
        wanted = float(np.array([1 - share, share]) @ (terms(kelvin) / terms(293.0)))
        settings = DetectorSettings(
            dark_law="diffusion-depletion", dark_depletion_share=share, temperature_k=kelvin
        )
        assert settings.dark_factor == pytest.approx(wanted, rel=1e-12)


def test_the_gap_is_silicons_or_the_one_that_is_written():
    assert silicon_gap_ev(300.0) == pytest.approx(1.1245, abs=5e-5)  # Sze
    fixed = DetectorSettings(dark_law="diffusion-depletion", dark_gap_ev=1.2, temperature_k=273.0)
    cold = (273 / 293) ** 1.5 * math.exp(0.6 / 8.617333262e-5 * (1 / 293 - 1 / 273))
    assert fixed.dark_factor == pytest.approx(cold, rel=1e-12)


@pytest.mark.parametrize(
    ("law", "quantile"),
    [
        ("normal", lambda share: stats.norm.ppf(share, 200.0, 60.0)),
        ("gamma", lambda share: stats.gamma.ppf(share, (200 / 60) ** 2, scale=60.0**2 / 200)),
        (
            "log-normal",
            lambda share: stats.lognorm.ppf(
                share, (s := math.sqrt(math.log1p(0.09))), scale=200 * math.exp(-s * s / 2)
            ),
        ),
    ],
)
def test_dark_currents_lie_as_their_law_says_about_one_mean_and_sigma(law, quantile):
    settings = DetectorSettings(dark_e_per_s=200.0, dsnu_e_per_s=60.0, dark_distribution=law)
    dark = Detector(settings, (512, 512)).dark_map_e_per_s
    assert dark.mean() == pytest.approx(200.0, abs=SIGMAS * 60 / 512)
    assert dark.std() == pytest.approx(60.0, rel=0.02)
    for share in (0.01, 0.5, 0.99, 0.999):
        # A quantile's error is sqrt(p (1 - p) / n) over the density there; here as a share.
        error = SIGMAS * math.sqrt(share * (1 - share)) / 512
        assert (dark < quantile(share)).mean() == pytest.approx(share, abs=error)


QUANTILE_SHARES = (0.05, 0.25, 0.5, 0.75, 0.95, 0.99)


@pytest.mark.parametrize(
    ("law", "of"),
    [
        ("normal", stats.norm(200, 40)),
        ("gamma", stats.gamma(4, scale=30)),
        ("log-normal", stats.lognorm(0.6, scale=100)),
    ],
)
def test_a_law_is_fitted_to_measured_quantiles(law, of):
    points = tuple(zip(QUANTILE_SHARES, of.ppf(QUANTILE_SHARES).tolist(), strict=True))
    settings = DetectorSettings(dark_distribution=law, dark_quantiles=points)
    assert (settings.dark_e_per_s, settings.dsnu_e_per_s) == pytest.approx(
        (of.mean(), of.std()), rel=1e-5
    )
    assert replace(settings, prnu=0.01).dark_e_per_s == settings.dark_e_per_s
    rates = Detector(settings, (600, 600)).dark_map_e_per_s
    # A quantile of 360 000 pixels: 1 % of the sigma at 99 %, which is its largest error by five of
    # its own sigmas.
    assert np.quantile(rates, QUANTILE_SHARES) == pytest.approx(
        of.ppf(QUANTILE_SHARES), abs=0.05 * of.std()
    )


@pytest.mark.parametrize(
    ("law", "points", "words"),
    [
        ("gamma", ((0.5, 3.0),), "two points or more"),
        ("gamma", ((0.2, 3.0), (0.1, 4.0)), "both columns rising"),
        ("gamma", ((0.2, 3.0), (0.4, 3.0)), "both columns rising"),
        ("gamma", ((0.0, 1.0), (0.5, 2.0)), "between 0 and 1"),
        ("gamma", ((0.5, 1.0), (1.0, 2.0)), "between 0 and 1"),
        ("log-normal", ((0.2, 0.0), (0.5, 2.0)), "no rate of 0"),
        ("normal", ((0.9, 1.0), (0.99, 200.0)), "mean below 0"),
    ],
)
def test_quantiles_that_no_law_has_are_refused(law, points, words):
    with pytest.raises(InputError, match=words):
        DetectorSettings(dark_distribution=law, dark_quantiles=points)


def test_offsets_of_pixels_stay_whatever_the_exposure_and_the_rows():
    settings = DetectorSettings(gain_e_per_dn=0.1, offset_dn=2000.0, bits=16, dsnu_e=20.0)
    image = (
        Detector(settings, (256, 1024)).expose(np.zeros((1024, 256)), 0.0, generator()) * 0.1
        - 200.0
    )
    np.testing.assert_allclose(image, Detector(settings, (256, 1024)).offset_map_e, atol=0.051)
    assert image.std() == pytest.approx(20.0, rel=0.02)


def test_hot_pixels_have_a_temperature_law_of_their_own():
    cold, warm = (
        DetectorSettings(
            hot_pixel_fraction=1.0,
            hot_pixel_activation_ev=0.3,
            dark_e_per_s=100.0,
            temperature_k=kelvin,
        )
        for kelvin in (263.0, 293.0)
    )
    extra = [
        Detector(one, SIZE_PX).dark_map_e_per_s.astype(float) - 100.0 * one.dark_factor
        for one in (cold, warm)
    ]
    factor = math.exp(0.3 / 8.617333262e-5 * (1 / 293 - 1 / 263))
    assert extra[0].mean() / extra[1].mean() == pytest.approx(factor, rel=1e-4)  # maps are float32
    assert cold.dark_factor < 0.5 * factor


def test_a_columns_dark_current_is_its_own_and_grows_with_the_exposure():
    settings = DetectorSettings(
        dark_e_per_s=500.0, fixed_pattern="cmos", column_dark_e_per_s=50.0, temperature_k=300.0
    )
    dark = Detector(settings, (2000, 8)).dark_map_e_per_s
    assert (dark == dark[0]).all()
    assert dark[0].std() == pytest.approx(
        50.0 * settings.dark_factor, rel=SIGMAS / math.sqrt(2 * 2000)
    )


def test_read_noise_follows_the_readout_frequency():
    white = DetectorSettings(read_noise_e=8.0, readout_hz=4e6)
    assert white.read_noise_now_e == pytest.approx(16.0)  # four times the band
    assert replace(white, readout_hz=1e6).read_noise_now_e == pytest.approx(8.0)
    corner = replace(white, read_noise_corner_hz=1e6)
    # 1/f alone
    assert replace(corner, readout_hz=1.0).read_noise_now_e == pytest.approx(
        8.0 / math.sqrt(2), rel=1e-5
    )
    table = DetectorSettings(read_noise_table=((1e4, 2.0), (1e6, 8.0)), readout_hz=1e5)
    assert table.read_noise_now_e == pytest.approx(4.0)
    for readout_hz, noise_e in table.read_noise_table:
        assert replace(table, readout_hz=readout_hz).read_noise_now_e == pytest.approx(noise_e)
    image = Detector(replace(table, gain_e_per_dn=0.1, offset_dn=500.0, bits=16), SIZE_PX).expose(
        flat_e(0.0), 0.0, generator()
    )
    assert image.std() * 0.1 == pytest.approx(4.0, rel=SIGMA_ERROR)


def test_reset_noise_is_k_t_c():
    # 10 fF at 293 K: sqrt(1.380649e-23 * 293 * 1e-14) C = 6.36e-18 C = 39.7 e-.
    settings = DetectorSettings(
        sense_capacitance_ff=10.0, gain_e_per_dn=1.0, offset_dn=500.0, read_noise_e=30.0
    )
    assert settings.reset_noise_e == pytest.approx(39.70, abs=0.005)
    image = Detector(settings, SIZE_PX).expose(flat_e(0.0), 0.0, generator())
    assert image.std() == pytest.approx(math.hypot(39.7, 30.0), rel=SIGMA_ERROR)
    assert settings.noise(0.0, 1.0).reset_e2 == pytest.approx(39.70**2, rel=1e-3)


def test_dead_pixels_give_the_offset_and_hot_ones_their_share():
    settings = DetectorSettings(
        gain_e_per_dn=1.0,
        bits=16,
        dead_pixel_fraction=0.02,
        hot_pixel_fraction=0.05,
        hot_pixel_e_per_s=5000.0,
    )
    detector = Detector(settings, SIZE_PX)
    image = detector.expose(flat_e(2000.0), 1.0, generator())
    dead = image == 0
    assert dead.sum() == pytest.approx(0.02 * PIXELS, abs=SIGMAS * math.sqrt(0.02 * PIXELS))
    hot = detector.dark_map_e_per_s > 0
    assert hot.sum() == pytest.approx(0.05 * 0.98 * PIXELS, abs=SIGMAS * math.sqrt(0.05 * PIXELS))
    # The exponential law's sigma is its mean.
    assert (image[hot] - 2000.0).mean() == pytest.approx(5000.0, rel=SIGMAS / math.sqrt(hot.sum()))


@pytest.mark.parametrize(("key", "across"), [("dead_row_fraction", 1), ("dead_column_fraction", 0)])
def test_dead_rows_and_columns_are_whole_and_have_their_share(key, across):
    live = DetectorSettings(gain_e_per_dn=1.0, bits=16, dark_e_per_s=50.0, prnu=0.01)
    detector = Detector(replace(live, **{key: 0.2}), SIZE_PX)
    image = detector.expose(flat_e(2000.0), 1.0, generator())
    is_dead = (image == 0).any(axis=across)
    lines = len(is_dead)
    assert is_dead.sum() == pytest.approx(0.2 * lines, abs=SIGMAS * math.sqrt(0.2 * lines))
    dead_lines = np.compress(is_dead, image, axis=1 - across)
    assert not dead_lines.any()
    live_lines = np.compress(~is_dead, detector.gain_map, axis=1 - across)
    whole_lines = np.compress(~is_dead, Detector(live, SIZE_PX).gain_map, axis=1 - across)
    np.testing.assert_array_equal(live_lines, whole_lines)


def test_a_cmos_column_pattern_is_the_same_down_each_column():
    settings = DetectorSettings(
        gain_e_per_dn=0.1,
        full_well_e=5000.0,
        bits=16,
        offset_dn=2000.0,
        fixed_pattern="cmos",
        column_noise_e=20.0,
    )
    image = Detector(settings, (2000, 8)).expose(np.zeros((8, 2000)), 0.0, generator())
    assert (image == image[0]).all()
    assert image[0].std() * 0.1 == pytest.approx(20.0, rel=SIGMAS / math.sqrt(2 * 2000))


def test_a_pixel_is_the_ccd47_20_s_where_no_pitch_is_stated():
    """Teledyne e2v's data sheet: an image area of 13.3 x 13.3 mm, of 1024 x 1024 pixels."""
    device = Detector(DetectorSettings(), (4, 4))
    assert device.pixel_pitch_um * 1024 == pytest.approx(13_300, abs=50)


def test_cosmic_rays_come_at_their_rate_and_leave_their_charge():
    settings = DetectorSettings(cosmic_rays_per_cm2_s=1000.0)
    shape, expected = (410, 640), 1000.0 * 0.410 * 0.640
    image_e = cosmic_rays_e(settings, shape, 1.0, generator(), pixel_pitch_um=10.0)
    labels, found = ndimage.label(image_e, structure=np.ones((3, 3)))
    # Tracks of a few pixels on 262 400: two of 262 touch about as often as 262^2 / 2 * 25 / 262
    # 400 = 3 times.
    assert found == pytest.approx(expected - 3, abs=SIGMAS * math.sqrt(expected))
    charge_e = ndimage.sum_labels(image_e, labels, range(1, found + 1))
    # cos^2 even from 0 to 1: half of the paths are longer than sqrt 2 of the depth. The median's
    # error is
    # 1 / (2 f sqrt n) = 3 %, f = 0.7 the density there.
    # 106 e- a micrometre, in 20 of them
    assert np.median(charge_e) == pytest.approx(math.sqrt(2) * 20 * 388 / 3.66, rel=SIGMAS * 0.03)
    along_axis_e = RAY_DEPTH_UM * RAY_E_PER_UM
    assert along_axis_e == pytest.approx(2120, rel=1e-3)


def test_a_ray_longer_than_the_sensor_leaves_what_its_way_across_is_worth():
    """On a pixel of half a micrometre: no way across from within is longer than sqrt 2 of it, and
    the sine of a ray's slope, of the square root's law, is a half in the mean of its inverse.
    """
    rays, pitch_um = 1000.0, 0.5
    settings = DetectorSettings(cosmic_rays_per_cm2_s=1e6)
    seconds = rays / (1e6 * (pitch_um * 1e-4) ** 2)
    image_e = cosmic_rays_e(settings, (1, 1), seconds, generator(), pixel_pitch_um=pitch_um)
    assert image_e.sum() < rays * math.sqrt(2) * pitch_um * RAY_E_PER_UM * 2


def test_cosmic_rays_reach_the_frame_and_are_off_by_default():
    with_rays = DetectorSettings(cosmic_rays_per_cm2_s=1000.0, gain_e_per_dn=1.0, bits=16)
    assert Detector(with_rays, SIZE_PX).expose(flat_e(0.0), 1.0, generator()).max() > 1000
    assert Detector(DetectorSettings(), SIZE_PX).expose(flat_e(0.0), 1.0, generator()).max() == 0
    # They add to light: the same seed draws them first, and shot noise is what is left.
    lit = Detector(with_rays, SIZE_PX).expose(flat_e(4000.0), 1.0, generator())
    rays_e = cosmic_rays_e(
        with_rays, SHAPE, 1.0, generator(), Detector(with_rays, SIZE_PX).pixel_pitch_um
    )
    assert (lit - rays_e).std() == pytest.approx(math.sqrt(4000 + 1 / 12), rel=SIGMA_ERROR)


def test_false_stars_bring_their_light_and_move_from_frame_to_frame():
    settings = DetectorSettings(false_stars=10, false_star_e_per_s=5000.0)
    rng = generator()
    first, second = (false_stars_e(settings, SHAPE, 0.5, rng) for _ in range(2))
    assert np.count_nonzero((first > 100) & (second > 100)) < 10
    # A reach of 5 sigma cuts 6e-7 of a star along an axis; on this many pixels, none lies over the
    # edge.
    inside = false_stars_e(settings, (2000, 2000), 0.5, generator())
    assert inside.sum() == pytest.approx(10 * 2500.0, rel=2 * 6e-7)
    frame = Detector(replace(settings, gain_e_per_dn=1.0), SIZE_PX).expose(
        flat_e(0.0), 0.5, generator()
    )
    # A star between four pixels gives each less than a quarter of it, 0.4655^2 = 0.2167: 541 e-,
    # with 23 e- of noise.
    assert frame.max() > 540 - SIGMAS * 23


def test_false_stars_lie_on_the_pixels_from_edge_to_edge():
    """All but the light of those within a sigma or so of an edge falls on a lone pixel."""
    settings = DetectorSettings(false_stars=400, false_star_e_per_s=1.0, false_star_sigma_px=0.1)
    assert 320 < false_stars_e(settings, (1, 1), 1.0, generator()).sum() < 360


def test_blooming_keeps_the_charge_within_its_column():
    charge_e = np.full((61, 5), 10.0)
    charge_e[30, 2] = 2010.0
    bloomed = bloom(charge_e, 100.0)
    assert bloomed.max() == 100.0
    np.testing.assert_allclose(bloomed.sum(axis=0), charge_e.sum(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(bloomed[:, [0, 1, 3, 4]], 10.0)
    # 1910 e- over the well, 90 free in each neighbour: 10.6 pixels up and as many down.
    np.testing.assert_array_equal(bloomed[20:41, 2], 100.0)
    np.testing.assert_allclose(bloomed[[19, 41], 2], 65.0)
    np.testing.assert_array_equal(bloomed[:19, 2], 10.0)


def test_blooming_loses_only_what_runs_out_of_the_columns_ends():
    assert (bloom(np.array([[0.0], [1e9], [0.0]]), 50.0) == 50.0).all()


def test_wells_do_not_bloom_by_default():
    image_e = flat_e(0.0)
    image_e[64, 80] = 1e6
    for blooming in (False, True):
        image = Detector(DetectorSettings(blooming=blooming), SIZE_PX).expose(
            image_e, 0.1, generator()
        )
        assert (image[63, 80] > 0) == blooming


@pytest.mark.parametrize(
    ("image_e", "words"),
    [
        (np.full(SHAPE, np.nan), "NaN"),
        (np.where(np.arange(PIXELS).reshape(SHAPE) == 77, np.nan, 5.0), "NaN"),
        (np.where(np.arange(PIXELS).reshape(SHAPE) == 77, -1e-9, 5.0), "negative"),
        (flat_e(np.inf), "inf"),
        (flat_e(1.01e12), "1.01e"),
        (np.zeros((160, 128)), "shape"),
        (np.zeros(SHAPE, dtype=complex), "type"),
    ],
)
def test_wrong_electrons_are_refused_in_one_line(image_e, words):
    detector = Detector(DetectorSettings(dead_pixel_fraction=1.0), SIZE_PX)
    for expose in (
        lambda: detector.expose(image_e, 0.1, generator()),
        lambda: detector.expose_noiseless(image_e, 0.1),
    ):
        with pytest.raises(InputError, match=words) as refusal:
            expose()
        assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("exposure_s", [-0.1, math.nan, math.inf])
def test_wrong_exposures_are_refused(exposure_s):
    with pytest.raises(InputError, match="exposure"):
        Detector(DetectorSettings(), SIZE_PX).expose(flat_e(1.0), exposure_s, generator())


@pytest.mark.parametrize("version", [1, 2])
def test_dark_beyond_what_can_be_drawn_is_refused(version):
    detector = Detector(DetectorSettings(dark_e_per_s=1e6, noise_version=version), SIZE_PX)
    for expose in (
        lambda: detector.expose(flat_e(0.0), 1e7, generator()),
        lambda: detector.expose_noiseless(flat_e(0.0), 1e7),
    ):
        with pytest.raises(InputError, match=r"1e\+13 electrons"):
            expose()


def test_more_rays_than_a_frame_can_hold_are_refused():
    with pytest.raises(InputError, match="cosmic"):
        Detector(DetectorSettings(cosmic_rays_per_cm2_s=1e9), SIZE_PX).expose(
            flat_e(0.0), 10.0, generator()
        )


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"gain_e_per_dn": 0.0}, "gain_e_per_dn"),
        ({"full_well_e": -1.0}, "full_well_e"),
        ({"bits": 17}, "bits = 17; write a number from 1 to 16"),
        ({"read_noise_e": math.nan}, "read_noise_e"),
        ({"dark_e_per_s": math.inf}, "dark_e_per_s"),
        ({"prnu": -0.01}, "prnu"),
        ({"device_seed": -1}, "device_seed"),
        ({"hot_pixel_fraction": 1.5}, "hot_pixel_fraction"),
        ({"temperature_k": -20.0}, "temperature_k"),
        ({"fixed_pattern": "emccd"}, '"ccd" or "cmos"'),
        ({"dark_law": "doubling"}, '"arrhenius" or "diffusion-depletion" or "ccd47-20"'),
        ({"dark_law": "ccd47-20", "temperature_k": 320.0}, "230 to 300 K"),
        (
            {"dark_law": "ccd47-20", "temperature_k": 240.0, "dark_reference_temperature_k": 301.0},
            "dark_reference_temperature_k = 301.*230 to 300 K",
        ),
        ({"column_noise_e": 5.0}, 'fixed_pattern = "cmos"'),
        ({"column_dark_e_per_s": 5.0}, 'fixed_pattern = "cmos"'),
        ({"dark_distribution": "gamma", "dsnu_e_per_s": 5.0}, "write dark_e_per_s above 0"),
        ({"fill_factor": 0.0}, "fill_factor"),
        (
            {"readout_hz": 1e3, "read_noise_table": ((1e4, 3.0), (1e6, 9.0))},
            "within read_noise_table.*10000 to 1e\\+06",
        ),
        (
            {"readout_hz": 2e5, "read_noise_table": ((1e6, 3.0), (1e4, 9.0))},
            "whose frequencies rise",
        ),
        (
            {"readout_hz": 2e4, "read_noise_table": ((1e4, 3.0), (1e4, 4.0), (1e6, 9.0))},
            "whose frequencies rise",
        ),
    ],
)
def test_a_sensor_that_cannot_be_is_refused(wrong, words):
    with pytest.raises(InputError, match=words):
        DetectorSettings(**wrong)


def test_a_sensor_without_pixels_is_refused():
    assert "resolution" in refusal(Detector, DetectorSettings(), (0, 10))


def test_a_frame_transfer_smears_a_column_by_the_share_of_the_exposure_that_a_shift_takes():
    """2 us a row in 0.1 s: each pixel of a column gets 2e-5 of the column's light."""
    light_e = flat_e(0.0)
    light_e[40, 70] = 1e6
    settings = DetectorSettings(shutter="frame-transfer", row_shift_us=2.0)
    detector = Detector(settings, SIZE_PX)
    smeared_e = detector.collected_e(light_e, 0.1) - light_e
    np.testing.assert_allclose(smeared_e[:, 70], 2e-5 * 1e6)
    assert not np.delete(smeared_e, 70, axis=1).any()


def test_a_dead_pixel_has_neither_light_nor_dark_current():
    settings = DetectorSettings(dead_pixel_fraction=0.1, dark_e_per_s=50.0, dsnu_e_per_s=5.0)
    detector = Detector(settings, SIZE_PX)
    is_dead = detector.gain_map == 0
    assert 0.05 < is_dead.mean() < 0.15
    assert not detector.dark_map_e_per_s[is_dead].any()
    assert (detector.dark_map_e_per_s[~is_dead] > 0).all()
