"""The colour relation against the library it comes from (leave-one-out), and against CALSPEC's
Vega and Sun.
"""

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import (
    MAX_BV_FIT_VI_MAG,
    PACKAGED_LIBRARY,
    Optics,
    Photometry,
    band_mean,
    dgs_electrons_per_s,
    fit_table,
    library_electrons_per_s,
    load_library,
    tabulate_pickles,
)
from hilstar.sky.spectrum import TEMPERATURE_SCALES, Curve, constant_curve, load_curve
from tests.support.claims import holds

GLASS = load_curve("n-bk7-10mm", "transmission")


def half_curve(low_nm, high_nm):
    return Curve(np.array([low_nm, high_nm]), np.array([0.5, 0.5]))


SENSORS = {
    "ccd47-20": Optics(30.0, load_curve("ccd47-20", "qe"), GLASS),
    "kai-4021": Optics(30.0, load_curve("kai-4021", "qe"), GLASS),
    "flat": Optics(30.0, half_curve(400.0, 1000.0), GLASS),
}
# What a tracker without glass or filter sees, ultraviolet to 1100 nm.
BARE = Optics(30.0, half_curve(300.0, 1100.0), constant_curve(1.0))

REDDEST_VI_MAG = 2.5  # the range that the aims are for: 98.4 % of Hipparcos to V = 7.5

# The aims. Measured: 0.79 and 2.42 % (ccd47-20), 0.58 and 2.57 % (kai-4021), 0.49 and 1.56 %
# (flat).
MEDIAN_LIMIT, P95_LIMIT = 0.010, 0.030
CLAIMED = "ccd47-20"  # the sensor of which the pages tell
# Bare, the aims are out of reach: a third of a B3 star's electrons come from below 390 or above 900
# nm,
# where B, V and I do not look, and the Balmer jump parts supergiants from dwarfs. Measured: 1.23
# and 4.36 %.
BARE_MEDIAN_LIMIT, BARE_P95_LIMIT = 0.013, 0.045
# Past V-I = 2.5 ten spectra are left, dwarfs and giants, and each end is predicted from inside.
# Measured at worst: median 6.5 % (flat), maximum 33 % (flat, M8III, the reddest but none).
RED_MEDIAN_LIMIT, RED_MAX_LIMIT = 0.07, 0.34

# B-V alone cannot tell a K giant from an M giant (every packaged star has V-I). Measured: up to 1.9
# % (ccd47-20), 21 % (flat).
BV_MEDIAN_LIMIT, BV_P95_LIMIT = 0.02, 0.22

# float16 rounds a sample by at most 2^-11 = 4.9e-4, and independently: an integral over hundreds of
# samples by less.
# The weights of a red star gather at few samples and V itself is 170 nm wide. Measured: 3.7e-5.
ROUNDING_LIMIT = 1e-4

# Electrons per second at V = 0 behind these sensors, by hilstar's own integral over CALSPEC's
# alpha_lyr_stis_011 and sun_reference_stis_001 (PyPI pyphot 2.1.1, pyphot/libs), and colours that
# do not come from those spectra:
# Hipparcos for Vega, Ramirez et al. 2012 (ApJ 752, 5) for the Sun, both (B-V, V-I).
CALSPEC = {
    "Vega": ((-0.001, -0.010), {"ccd47-20": 2.5016e7, "kai-4021": 1.02818e7, "flat": 1.41885e7}),
    "Sun": ((0.653, 0.702), {"ccd47-20": 2.78425e7, "kai-4021": 1.00064e7, "flat": 1.75722e7}),
}
# Pickles's fluxes are not CALSPEC's: his G2V has a V-I 0.04 mag redder than the Sun's, and so have
# most of his A to K
# stars against Hipparcos's of the same type. The relation's slope of at most 0.5 per mag makes 2 %
# of that; the
# colours' own 0.01 mag makes 0.5 %. Measured: 1.9 % at worst (Vega, ccd47-20).
CALSPEC_LIMIT = 0.025

SHOWN_V_MAG = 7.5  # what a bench shows by default

# Stars whose two colours disagree (reddened, double, mistyped) may leave the library's range of
# rates. Measured: 9.2 %.
OUTSIDE_LIMIT = 0.10


def leave_one_out(optics, without_vi=False):
    """Relative errors |predicted/true - 1|, shape (m,)."""
    library = load_library()
    rate = library_electrons_per_s(library, optics, Photometry())
    errors = np.empty(len(rate))
    for i in range(len(rate)):
        others = np.arange(len(rate)) != i
        table = fit_table(library.bv_mag[others], library.vi_mag[others], rate[others])
        one = slice(i, i + 1)
        predicted = table.electrons_per_s(
            np.zeros(1),
            library.bv_mag[one],
            np.full(1, np.nan) if without_vi else library.vi_mag[one],
        )
        errors[i] = abs(predicted[0] / rate[i] - 1)
    return errors


@pytest.mark.parametrize("name", SENSORS)
def test_a_star_left_out_is_predicted_within_the_aim(name):
    errors = leave_one_out(SENSORS[name])[load_library().vi_mag < REDDEST_VI_MAG]
    assert np.median(errors) <= MEDIAN_LIMIT
    assert np.percentile(errors, 95) <= P95_LIMIT
    if name == CLAIMED:
        holds("spectrum-by-colour-median", 100 * float(np.median(errors)))
        holds("spectrum-by-colour", 100 * float(np.percentile(errors, 95)))


def test_a_bare_sensor_misses_the_aim_by_no_more_than_stated():
    errors = leave_one_out(BARE)[load_library().vi_mag < REDDEST_VI_MAG]
    assert np.median(errors) <= BARE_MEDIAN_LIMIT
    assert np.percentile(errors, 95) <= BARE_P95_LIMIT


@pytest.mark.parametrize("name", SENSORS)
def test_without_vi_most_stars_are_as_wrong_as_stated(name):
    errors = leave_one_out(SENSORS[name], without_vi=True)[
        load_library().vi_mag < MAX_BV_FIT_VI_MAG
    ]
    assert np.median(errors) <= BV_MEDIAN_LIMIT
    assert np.percentile(errors, 95) <= BV_P95_LIMIT


@pytest.mark.parametrize("name", SENSORS)
def test_the_reddest_stars_are_as_wrong_as_stated(name):
    errors = leave_one_out(SENSORS[name])[load_library().vi_mag >= REDDEST_VI_MAG]
    assert np.median(errors) <= RED_MEDIAN_LIMIT
    assert errors.max() <= RED_MAX_LIMIT
    if name == CLAIMED:
        holds("spectrum-red-median", 100 * float(np.median(errors)))
        holds("spectrum-red", 100 * float(np.percentile(errors, 95)))


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("scale", TEMPERATURE_SCALES)
@pytest.mark.parametrize("red", [False, True])
def test_the_black_body_loses_at_every_colour_and_scale(name, scale, red):
    library = load_library()
    chosen = (library.vi_mag >= REDDEST_VI_MAG) == red
    truth = library_electrons_per_s(library, SENSORS[name], Photometry())
    black = dgs_electrons_per_s(
        TEMPERATURE_SCALES[scale](library.bv_mag), SENSORS[name], Photometry()
    )
    black_errors = np.abs(black / truth - 1)[chosen]
    errors = leave_one_out(SENSORS[name])[chosen]
    for share in (50, 95, 100):
        assert np.percentile(errors, share) < np.percentile(black_errors, share)
    if name == CLAIMED and scale == "ballesteros2012":
        colour = "red" if red else "usual"
        holds(f"black-body-{colour}-median", 100 * float(np.median(black_errors)))
        holds(f"black-body-{colour}", 100 * float(np.percentile(black_errors, 95)))


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("star", CALSPEC)
def test_vega_and_the_sun_give_their_electrons(star, name):
    (bv_mag, vi_mag), rates = CALSPEC[star]
    table = tabulate_pickles(SENSORS[name], Photometry())
    predicted = table.electrons_per_s(np.zeros(1), np.array([bv_mag]), np.array([vi_mag]))[0]
    assert predicted == pytest.approx(rates[name], rel=CALSPEC_LIMIT)


def test_the_packed_spectra_integrate_as_the_originals():
    with np.load(PACKAGED_LIBRARY) as packed:
        exact = packed["check_rates_e_per_s"]
    library = load_library()
    for name, rates in zip(("ccd47-20", "kai-4021"), exact, strict=True):
        optics = Optics(30.0, load_curve(name, name), constant_curve(1.0))
        assert library_electrons_per_s(library, optics, Photometry()) == pytest.approx(
            rates, rel=ROUNDING_LIMIT
        )
    assert band_mean(library, load_curve("johnson-v", "v")) == pytest.approx(
        np.ones(106), rel=ROUNDING_LIMIT
    )


@pytest.mark.parametrize("name", SENSORS)
def test_every_hipparcos_star_gets_a_rate_within_the_library(name):
    catalog = load_catalog()
    rate = library_electrons_per_s(load_library(), SENSORS[name], Photometry())
    table = tabulate_pickles(SENSORS[name], Photometry())
    for vi_mag in (catalog.vi_mag, np.full(len(catalog), np.nan)):
        rates = table.electrons_per_s(np.zeros(len(catalog)), catalog.bv_mag, vi_mag)
        assert np.isfinite(rates).all()
        assert rates.min() >= rate.min() * (1 - OUTSIDE_LIMIT)
        assert rates.max() <= rate.max() * (1 + OUTSIDE_LIMIT)


@pytest.mark.parametrize("name", SENSORS)
def test_a_cool_star_gives_more_electrons_the_redder_it_is(name):
    # Only cool ones: through the ultraviolet a hotter star of the same V gives more.
    vi_mag = np.linspace(1.0, 9.03, 1000)
    rates = tabulate_pickles(SENSORS[name], Photometry()).electrons_per_s(
        0 * vi_mag, 0 * vi_mag + 1.5, vi_mag
    )
    steps = np.diff(rates)
    assert (steps[vi_mag[1:] < load_library().vi_mag.max()] > 0).all()
    assert (steps[vi_mag[:-1] > load_library().vi_mag.max()] == 0).all()


def test_six_stars_that_are_shown_are_redder_than_every_spectrum():
    catalog = load_catalog()
    beyond = (catalog.v_mag <= SHOWN_V_MAG) & (catalog.vi_mag > load_library().vi_mag.max())
    assert catalog.hip[beyond].tolist() == [10826, 21479, 64569, 65835, 67419, 110478]


@pytest.mark.parametrize("name", SENSORS)
def test_the_catalogue_s_two_colours_give_two_rates(name):
    """The rate by V-I against the rate by B-V alone, 95 % of the stars."""
    catalog = load_catalog()
    kept = (catalog.v_mag <= SHOWN_V_MAG) & (catalog.vi_mag < REDDEST_VI_MAG)
    v_mag, bv_mag, vi_mag = (
        column[kept] for column in (catalog.v_mag, catalog.bv_mag, catalog.vi_mag)
    )
    table = tabulate_pickles(SENSORS[name], Photometry())
    by_vi, by_bv = (
        table.electrons_per_s(v_mag, bv_mag, colour)
        for colour in (vi_mag, np.full_like(vi_mag, np.nan))
    )
    holds(f"two-colours-{name}", 100 * np.percentile(np.abs(by_vi / by_bv - 1), 95))
    if name == CLAIMED:
        redder = table.electrons_per_s(v_mag, bv_mag, vi_mag + 0.05)
        changed = np.abs(redder / by_vi - 1)
        holds("redder-median", 100 * np.median(changed))
        holds("redder", 100 * np.percentile(changed, 95))


def test_most_of_hipparcos_s_vi_is_the_usual_one_of_its_bv():
    catalog = load_catalog()
    kept = (catalog.v_mag <= SHOWN_V_MAG) & np.isfinite(catalog.bv_mag)
    bv_mag, vi_mag = catalog.bv_mag[kept], catalog.vi_mag[kept]
    alike = np.array_split(np.argsort(bv_mag, kind="stable"), 200)
    usual = np.interp(
        bv_mag, [np.median(bv_mag[k]) for k in alike], [np.median(vi_mag[k]) for k in alike]
    )
    off_mag = np.abs(vi_mag - usual)[vi_mag < REDDEST_VI_MAG]
    assert np.percentile(off_mag, 67) < 0.006
    assert (off_mag > 0.2).sum() == 881


def test_five_magnitudes_are_a_hundredfold():
    table = tabulate_pickles(SENSORS["ccd47-20"], Photometry())
    bright, faint = table.electrons_per_s(np.array([0.0, 5.0]), np.full(2, 0.6), np.full(2, 0.7))
    assert bright / faint == pytest.approx(100.0)


def test_a_sensor_past_the_spectra_is_refused():
    with pytest.raises(InputError, match="250 to 1600 nm"):
        tabulate_pickles(Optics(30.0, half_curve(400.0, 1700.0), constant_curve(1.0)), Photometry())


def test_a_blind_sensor_is_refused():
    blind = Optics(30.0, Curve(np.array([400.0, 900.0]), np.zeros(2)), constant_curve(1.0))
    with pytest.raises(InputError, match="no electron"):
        tabulate_pickles(blind, Photometry())
