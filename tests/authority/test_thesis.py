"""The figures of docs/thesis.md that no study prints, each against the thesis's (Gravina 2023)
or by its own arithmetic.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from scipy.special import erf

from hilstar.basics.resources import resource_path
from hilstar.basics.units import flux_ratio
from hilstar.instruments.study.rapp import rapp_ratios
from hilstar.optics.psf import GaussianPsf
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import Optics, Photometry, dgs_electrons_per_s, v_band_mean_w_m2_m
from hilstar.sky.facts import facts_of
from hilstar.sky.spectrum import (
    DATA_DIR,
    Curve,
    blackbody_exitance_w_m2_m,
    load_curve,
    read_curve_csv,
)
from hilstar.sky.synthetic import curve_mean, vega, vega_electrons_per_s
from hilstar.tracker.settings import DetectorSettings
from tests.support.claims import holds

PRINTED = 0.006  # half of the last digit of a figure with two decimals, and rounding
# Table 2.3: medians of stars to V = 9, mas and mas/yr; there to Hp = 9, which is 0.1 mag off, and
# moves them by 0.02.
TABLE_2_3 = {
    "ra_mas": 0.77,
    "dec_mas": 0.64,
    "parallax_mas": 0.97,
    "pm_ra_mas_yr": 0.88,
    "pm_dec_mas_yr": 0.74,
}
BRIGHT_V_MAG, MEDIAN_LIMIT = 9.0, 0.025


def test_the_catalogue_s_origins_and_errors_are_tables_2_2_and_2_3():
    catalog = load_catalog()
    facts = facts_of(catalog.hip)
    v, bv = (Counter(facts[name].tolist()) for name in ("v_source", "bv_source"))
    assert len(catalog) == 116_812
    assert (v[b"G"], v[b"H"], v[b"T"], bv[b"G"], bv[b"T"]) == (23_049, 93_354, 409, 41_080, 75_732)
    holds("thesis-bv-error", facts["sigma_bv_mag"].mean())
    bright = catalog.v_mag < BRIGHT_V_MAG
    for name, printed in TABLE_2_3.items():
        median = np.median(facts[f"sigma_{name}"][bright])
        holds(f"thesis-{name}", median)
        assert abs(median - printed) < MEDIAN_LIMIT, name
    assert int((catalog.bv_mag < -0.3).sum()) == 25
    within = (catalog.bv_mag >= 0) & (catalog.bv_mag <= 2)
    holds("bv-from-0", 100 * within.mean())
    within = (catalog.bv_mag >= -0.3) & (catalog.bv_mag <= 2)
    holds("bv-from-0.3", 100 * within.mean())


def test_proper_motion_added_to_right_ascension_is_off_by_up_to_18_arcsec():
    catalog = load_catalog()
    off_mas = 8.75 * np.abs(catalog.pm_ra_cosdec_mas_yr) * (1 - np.cos(np.radians(catalog.dec_deg)))
    holds("motion-added-median", np.median(off_mas))
    holds("motion-added", off_mas.max() / 1000)


def test_vega_is_no_black_body_of_9602_k():
    light, johnson_v = vega(), read_curve_csv(DATA_DIR / "johnson-v.csv")
    nm = np.array([350.0, 400.0, 900.0])
    body = blackbody_exitance_w_m2_m(nm, 9602.0) / v_band_mean_w_m2_m(9602.0, "energy")
    np.testing.assert_allclose(
        light(nm) / curve_mean(light, johnson_v) / body, [0.46, 1.38, 0.76], atol=PRINTED
    )
    optics = Optics(30.0, load_curve("ccd47-20", "qe"), load_curve("n-bk7-10mm", "transmission"))
    more = (
        dgs_electrons_per_s(9602.0, optics, Photometry())
        * flux_ratio(0.03)
        / vega_electrons_per_s(optics, Photometry())
    )
    holds("vega-body", 100 * (float(more) - 1))


def test_a_background_pixel_of_orion_has_the_noise_of_table_4_1_with_its_dimensions_mended():
    detector = DetectorSettings(
        gain_e_per_dn=24, read_noise_e=2, dark_e_per_s=203, dsnu_e_per_s=60, prnu=0.03
    )
    sky_e, seconds = 1170.7, 3.5
    noise = detector.noise(sky_e, seconds)
    assert math.sqrt(noise.prnu_e2) == pytest.approx(35, abs=0.5) and math.sqrt(
        noise.dsnu_e2
    ) == pytest.approx(210)
    assert math.sqrt(noise.total_e2) == pytest.approx(217, abs=0.5)
    assert math.sqrt(noise.quantisation_e2) == pytest.approx(6.9, abs=0.05)
    assert detector.adc_noise_e == pytest.approx(4.93, abs=PRINTED)
    thesis_prnu_e2, thesis_dsnu_e2 = sky_e * 0.03, 60 * seconds
    assert (math.sqrt(thesis_prnu_e2), math.sqrt(thesis_dsnu_e2)) == pytest.approx(
        (5.9, 14.5), abs=0.05
    )
    total_e2 = sky_e + thesis_prnu_e2 + 203 * seconds + thesis_dsnu_e2 + detector.adc_noise_e**2 + 4
    assert math.sqrt(total_e2) == pytest.approx(46, abs=0.5)


def test_the_square_of_4_48_sigma_has_95_percent_and_rosetta_s_pixel_22():
    assert erf(4.48 / 2 / math.sqrt(2)) ** 2 == pytest.approx(0.95, abs=PRINTED)
    shares = [GaussianPsf((sigma, sigma)).peak_share for sigma in (0.80, 0.46)]
    np.testing.assert_allclose(shares, [0.22, 0.52], atol=PRINTED)
    tracker = read_bench_file(resource_path("configs", "rosetta-navcam.toml")).config.tracker
    assert 0.50 <= GaussianPsf(tracker.psf_sigma_px).peak_share <= 0.55  # ESA
    detector = tracker.detector
    assert min(detector.column_noise_e, detector.hot_pixel_fraction, detector.false_stars) > 0


def test_orion_s_circle_of_eq_4_6_reaches_beyond_its_corner():
    half = math.atan(1024 * 0.013 / 2 / 30)
    assert math.degrees(2 * half) == pytest.approx(25.0, abs=0.05)
    assert math.degrees(math.sqrt(2) * half) == pytest.approx(17.7, abs=0.05)
    assert math.degrees(math.atan(math.sqrt(2) * math.tan(half))) == pytest.approx(17.4, abs=0.05)


def test_two_of_the_ratios_of_figure_5_22_depend_on_the_range_of_wavelengths_alone():
    glass, hot_k = load_curve("n-bk7-10mm", "transmission"), np.array([3000.0, 9000.0, 50_000.0])
    kai = load_curve("kai-4021", "qe")
    wide = Curve(
        np.concatenate([[300.0], kai.wavelength_nm, [1050.0]]),
        np.concatenate([[0.2], kai.value, [0.0]]),
    )
    ccd, ours, longer = (
        rapp_ratios(hot_k, Optics(30.0, curve, glass), "energy")
        for curve in (load_curve("ccd47-20", "qe"), kai, wide)
    )
    np.testing.assert_allclose(longer[:2], ccd[:2], rtol=1e-9)
    assert (ours[0, 2], ccd[0, 2]) == pytest.approx((1.02, 1.56), abs=PRINTED)
    for sensor, hot in (("kai", ours[2, 1:] - 1), ("ccd", 1 - ccd[2, 1:])):
        holds(f"rapp-{sensor}-9000", 100 * float(hot[0]))
        holds(f"rapp-{sensor}-50000", 100 * float(hot[1]))
    assert ccd[2, 0] == pytest.approx(1.88, abs=PRINTED)
