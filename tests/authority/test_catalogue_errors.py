"""Errors of place and motion carried to an epoch, against finite differences of ERFA's starpm; a
bench's zero points.
"""

from __future__ import annotations

import erfa
import numpy as np
import pytest

from hilstar.basics.units import flux_ratio
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import Optics, Photometry
from hilstar.sky.facts import MOTION, facts_of, motion_at
from hilstar.sky.spectrum import DATA_DIR, Curve, constant_curve, load_curve
from hilstar.sky.synthetic import ab_electrons_per_s, colours, vega_electrons_per_s
from tests.support.claims import holds

EPOCHS_JYEAR = (1950.0, 2000.0, 2026.0)
STARS = 300
MAS = np.pi / (180 * 3600 * 1000)
PLACE_DEG = 1e-8  # 36 microarcseconds
# starpm also delays light (v/c of the transverse speed: under 1e-3 for the fastest); differences of
# 1 arcsec round to 1e-6.
SIGMA_LIMIT = 1e-3
STEPS = (1000 * MAS, 1000 * MAS, 10 * MAS, 10 * MAS)
# CALSPEC's Vega behind a CCD47-20, at V = 0: tests/authority/test_pickles.py.
CALSPEC_VEGA_E_PER_S, BINNED_LIMIT = 2.5016e7, 3e-4
# Sun: IAU 2015 zero point and nominal luminosity, V = -26.76 (Torres 2010). G2V of the library is
# within 0.05 mag of its BC.
SUN_BC_MAG, BC_LIMIT_MAG = -0.072, 0.05
TABLE_MAG = 1e-3  # steps of 0.02 nm of a passband that ends in corners, and the table's own 1e-4


def star_pm(start, years, parallax_arcsec):
    """ra, dec, pm_ra (with cos dec) and pm_dec, radians, by ERFA."""
    ra, dec, pm_ra, pm_dec = start
    jd = 2448349.0625  # J1991.25
    found = erfa.starpm(
        ra, dec, pm_ra / np.cos(dec), pm_dec, parallax_arcsec, 0.0, jd, 0.0, jd, years * 365.25
    )
    return np.array([found[0], found[1], found[2] * np.cos(found[1]), found[3]])


@pytest.mark.parametrize("epoch_jyear", EPOCHS_JYEAR)
def test_errors_are_those_of_erfa(epoch_jyear):
    catalog = load_catalog()
    # Every 389th star, and the fastest and the most northern ones.
    fast = np.argsort(-np.hypot(catalog.pm_ra_cosdec_mas_yr, catalog.pm_dec_mas_yr))[:5]
    rows = np.union1d(
        np.arange(0, len(catalog), 389)[: STARS - 10],
        np.append(fast, np.argsort(-np.abs(catalog.dec_deg))[:5]),
    )
    stars = catalog.taken(rows)
    facts = facts_of(stars.hip)
    motion = motion_at(stars, facts, epoch_jyear)
    ours = motion.covariance
    for k in range(len(stars)):
        start = np.array([np.radians(stars.ra_deg[k]), np.radians(stars.dec_deg[k]), 0.0, 0.0])
        start[2:] = stars.pm_ra_cosdec_mas_yr[k] * MAS, stars.pm_dec_mas_yr[k] * MAS
        parallax = max(stars.parallax_mas[k], 0.1) / 1000
        years = epoch_jyear - 1991.25
        ra_rad, dec_rad, *_ = star_pm(start, years, parallax)
        assert motion.ra_deg[k] == pytest.approx(np.degrees(ra_rad), abs=PLACE_DEG)
        assert motion.dec_deg[k] == pytest.approx(np.degrees(dec_rad), abs=PLACE_DEG)
        jacobian = np.empty((4, 4))
        for j, step in enumerate(STEPS):
            pair = []
            for sign in (1, -1):
                moved = start.copy()
                moved[j] += sign * step / (np.cos(start[1]) if j == 0 else 1)
                pair.append(star_pm(moved, years, parallax))
            change = pair[0] - pair[1]
            change[0] = (change[0] + np.pi) % (2 * np.pi) - np.pi
            jacobian[:, j] = change / (2 * step)
        jacobian[0] *= np.cos(star_pm(start, years, parallax)[1])
        sigma = [
            facts[f"sigma_{name}_mas" + ("_yr" if name.startswith("pm") else "")][k]
            for name in MOTION
        ]
        correlation = np.eye(4)
        for i in range(4):
            for j in range(i + 1, 4):
                correlation[i, j] = correlation[j, i] = facts[
                    f"{MOTION[i]}_{MOTION[j]}_correlation"
                ][k]
        theirs = jacobian @ (np.outer(sigma, sigma) * correlation) @ jacobian.T
        assert np.sqrt(np.diag(ours[k])) == pytest.approx(
            np.sqrt(np.diag(theirs)), rel=SIGMA_LIMIT
        ), stars.hip[k]
    if epoch_jyear == EPOCHS_JYEAR[-1]:
        every = facts_of(catalog.hip)
        for name, jyear in (("1991", 1991.25), ("2026", epoch_jyear)):
            variance_mas2 = motion_at(catalog, every, jyear).covariance[:, 0, 0]
            holds(f"place-error-{name}", np.nanmedian(np.sqrt(variance_mas2)))


def test_errors_of_1991_are_the_catalogue_s():
    """HIP 1's row of CDS I/239: 1.32, 0.74, 1.36 and 0.81, correlation 0.32; a star that it does
    not have has none.
    """
    catalog = load_catalog()
    one = catalog.taken(np.flatnonzero(catalog.hip == 1))
    covariance = motion_at(one, facts_of(one.hip), 1991.25).covariance[0]
    assert np.sqrt(np.diag(covariance)) == pytest.approx([1.32, 0.74, 1.36, 0.81])
    assert covariance[0, 1] / (1.32 * 0.74) == pytest.approx(0.32)
    missing = facts_of(np.array([0, 999_999], dtype=np.int32))
    assert np.isnan(missing["sigma_ra_mas"]).all()
    assert missing["spectral_type"].tolist() == [b"", b""]


def test_vega_and_ab_are_zero_points():
    optics = Optics(30.0, load_curve("ccd47-20", "qe"), load_curve("n-bk7-10mm", "transmission"))
    vega = vega_electrons_per_s(optics, Photometry())
    assert vega == pytest.approx(CALSPEC_VEGA_E_PER_S * flux_ratio(0.03), rel=BINNED_LIMIT)
    # AB 0 from 400 to 800 nm, by hand: area F_nu / h ln(800 / 400).
    flat = Optics(20.0, Curve(np.array([400.0, 800.0]), np.ones(2)), constant_curve(1.0))
    assert ab_electrons_per_s(flat) == pytest.approx(
        np.pi * 0.01**2 * 3.631e-23 / 6.62607015e-34 * np.log(2), rel=1e-9
    )


def test_the_sun_s_bolometric_correction():
    colour = colours("pickles", "ballesteros2012", Photometry())["bolometric"]
    assert colour(np.array([0.653]), np.array([0.702]), None)[0] == pytest.approx(
        SUN_BC_MAG, abs=BC_LIMIT_MAG
    )


def planck(nm: np.ndarray, kelvin: float) -> np.ndarray:
    """A black body's exitance, W/m2/m (CODATA 2018)."""
    metre = nm * 1e-9
    h, c, k = 6.62607015e-34, 299_792_458.0, 1.380649e-23
    return 2 * np.pi * h * c**2 / metre**5 / np.expm1(h * c / (metre * k * kelvin))


def kelvin_of(bv_mag: float) -> float:
    """Ballesteros 2012, equation 14."""
    return 4600 * (1 / (0.92 * bv_mag + 1.7) + 1 / (0.92 * bv_mag + 0.62))


def mean_through(name: str, kelvin: float, photons: bool = False) -> float:
    """The mean of a black body through a passband's file, its rows joined by straight lines."""
    lines = (DATA_DIR / f"{name}.csv").read_text().splitlines()
    rows = np.array([line.split(",") for line in lines if line[0].isdigit()], dtype=float)
    nm = np.linspace(rows[0, 0], rows[-1, 0], 20_001)
    response = np.interp(nm, *rows.T) * (nm if photons else 1.0)
    return np.trapezoid(planck(nm, kelvin) * response) / np.trapezoid(response)


@pytest.mark.parametrize("bv_mag", [-0.2, 0.65, 1.5])
def test_a_black_body_has_its_colours_in_each_band(bv_mag):
    """Bessell 1998, table A2: magnitude 0 in W/m2/m. Gaia's G is Vega's, and counts photons."""
    kelvin = kelvin_of(bv_mag)
    by_band = colours("blackbody", "ballesteros2012", Photometry())
    v_mean = mean_through("johnson-v", kelvin) / 3.631e-2
    zeros = {"u": 4.175e-2, "b": 6.32e-2, "r": 2.177e-2, "i": 1.126e-2}

    def colour(name: str) -> float:
        return float(by_band[name](np.array([bv_mag]), np.array([np.nan]), None)[0])

    for band, zero in zeros.items():
        ratio = mean_through(f"bessell-{band}", kelvin) / zero / v_mean
        assert colour(band) == pytest.approx(-2.5 * np.log10(ratio), abs=TABLE_MAG)
    # Vega's own G is 0: two black bodies differ in it by their light alone
    both_k = kelvin, kelvin_of(0.0)
    in_g = [mean_through("gaia-g", k, photons=True) / mean_through("johnson-v", k) for k in both_k]
    white = float(by_band["g"](np.zeros(1), np.array([np.nan]), None)[0])
    wanted_mag = -2.5 * np.log10(in_g[0] / in_g[1])
    assert colour("g") - white == pytest.approx(wanted_mag, abs=TABLE_MAG)
    assert white == pytest.approx(0.0, abs=0.1)
    whole = 5.670374419e-8 * kelvin**4 / 2.518021002e-8
    bolometric_mag = -2.5 * np.log10(whole / v_mean)
    assert colour("bolometric") == pytest.approx(bolometric_mag, abs=TABLE_MAG)
