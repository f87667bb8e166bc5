"""Curves, temperatures and black bodies where they are easy to get wrong."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.polynomial import Chebyshev

from hilstar.basics.reading import warn_once
from hilstar.sky.electrons import (
    Optics,
    Photometry,
    RateTable,
    band_mean,
    library_electrons_per_s,
    load_library,
    reference_mean_w_m2_m,
    tabulate,
    tabulate_pickles,
)
from hilstar.sky.spectral_types import (
    DUST_EBV_MAG,
    DUST_MAG,
    DUST_PER_UM,
    LETTERS,
    bare_and_dusty,
    class_shares,
)
from hilstar.sky.spectrum import (
    Curve,
    blackbody_exitance_w_m2_m,
    constant_curve,
    integration_nodes,
    load_curve,
    read_curve_csv,
    temperature_ballesteros2012_k,
    temperature_wang2021_k,
    torres2010_k,
)
from tests.support.refusals import refusal

# E. Mamajek's mean dwarf sequence, version 2022.04.16 (Pecaut & Mamajek 2013, ApJS 208, 9): B-V, K;
# A0V, F0V, G2V, K0V, K5V.
PECAUT_MAMAJEK = ((0.000, 9700), (0.295, 7220), (0.650, 5770), (0.816, 5270), (1.150, 4440))
# Two calibrations of one quantity; the dwarfs' and giants' temperatures at one B-V differ by as
# much. Measured: 2.2 %.
SCALES_AGREE = 0.03
# Two supergiants: Deneb (Schiller and Przybilla 2008) and gamma Cygni (Gray 2010). B-V is that of
# Hipparcos; dust makes it 0.05 mag too red, which is 5 % of a temperature.
SUPERGIANTS = ((0.092, 8525), (0.673, 5790))
SUPERGIANTS_AGREE = 0.05


def test_a_black_body_neither_overflows_nor_turns_negative():
    wavelength_nm = np.array([1.0, 100.0, 550.0, 1e6])
    for temperature_k in (10.0, 1500.0, 60_000.0, 1e7):
        exitance = blackbody_exitance_w_m2_m(wavelength_nm, temperature_k)
        assert np.isfinite(exitance).all()
        assert (exitance >= 0).all()


def test_the_source_s_temperature_scale_jumps_at_zero_and_the_default_does_not():
    around = np.array([-1e-9, 0.0])
    # thesis eq. 3.13
    assert temperature_wang2021_k(around) == pytest.approx([9259.8, 8909.7], abs=0.1)
    assert np.diff(temperature_ballesteros2012_k(around))[0] == pytest.approx(0, abs=1e-4)
    # the Sun, Ballesteros 2012
    assert temperature_ballesteros2012_k(np.array([0.65]))[0] == pytest.approx(5778, abs=40)


def test_torres_gives_the_sun_its_temperature():
    """B-V = 0.653 (Ramirez 2012): 5772 K (IAU 2015), within the relation's own 2 %."""
    assert torres2010_k(np.array([0.653]))[0] == pytest.approx(5772, rel=0.02)


def test_torres_agrees_with_pecaut_and_mamajek_and_with_supergiants_spectra():
    bv_mag, kelvin = np.array(PECAUT_MAMAJEK).T
    assert torres2010_k(bv_mag) == pytest.approx(kelvin, rel=SCALES_AGREE)
    bv_mag, kelvin = np.array(SUPERGIANTS).T
    assert torres2010_k(bv_mag, supergiant=True) == pytest.approx(kelvin, rel=SUPERGIANTS_AGREE)


def test_torres_s_polynomials_are_those_of_his_table():
    """Worked out with 40 digits from the coefficients that AJ 140, 1158 prints in table 2."""
    bv_mag = np.array([-0.3, 0.5, 1.0, 1.6])
    dwarfs_k, supergiants_k = (
        [33616.674, 6281.455, 4843.867, 3773.068],
        [39729.425, 6114.788, 4973.049, 3775.676],
    )
    assert torres2010_k(bv_mag) == pytest.approx(dwarfs_k, rel=1e-6)
    assert torres2010_k(bv_mag, supergiant=True) == pytest.approx(supergiants_k, rel=1e-6)


@pytest.mark.parametrize(
    ("first", "last", "nm_per_unit"),
    [
        (0.1, 30.0, 1000.0),
        (0.1, 30.1, None),
        (0.05, 2.0, None),
        (100.0, 5000.0, 1.0),
        (999.0, 5001.0, None),
        (1000.0, 2600.0, 1.0),
        (1000.0, 2601.0, None),  # nm of the infrared, or angstrom of the ultraviolet
        (1999.0, 2500.0, 1.0),
        (2000.0, 2500.0, 0.1),
        (2000.0, 100_000.0, 0.1),
        (2000.0, 100_001.0, None),
        (30.0, 90.0, None),
    ],
)
def test_wavelengths_without_a_unit_are_those_of_sensors_or_refused(
    tmp_path, first, last, nm_per_unit
):
    path = tmp_path / "qe.csv"
    path.write_text(f"wavelength,value\n{first},0.5\n{last},0.25\n")
    if nm_per_unit is None:
        assert "without a unit; write it in the header" in refusal(read_curve_csv, path)
        return
    wanted_nm = np.array([first, last]) * nm_per_unit
    assert read_curve_csv(path).wavelength_nm == pytest.approx(wanted_nm, rel=1e-12)


def test_temperature_scales_are_finite_over_every_colour_of_the_catalogue():
    bv = np.linspace(-0.4, 5.46, 2000)
    for scale in (temperature_ballesteros2012_k, temperature_wang2021_k):
        assert (scale(bv) > 250).all()
        assert (np.diff(scale(bv)) < 0).all()


def test_integration_nodes_integrate_pieces_of_straight_lines():
    a = Curve(np.array([300.0, 413.0, 700.0]), np.array([0.0, 1.0, 0.2]))
    b = Curve(np.array([350.0, 900.0]), np.array([0.5, 0.1]))
    wavelength_nm, weight_m = integration_nodes(a, b)
    fine = np.linspace(350, 700, 3_500_001)
    exact = np.trapezoid(a(fine) * b(fine), fine) * 1e-9
    # Gauss is exact here; the trapezium with 1e-4 nm steps is off by h^2/12 times the slopes: below
    # 1e-12.
    assert a(wavelength_nm) * b(wavelength_nm) @ weight_m == pytest.approx(exact, rel=1e-10)


def test_a_tracker_that_sees_nothing_is_refused():
    dark = Optics(30, constant_curve(0.0), constant_curve(1.0))
    assert "zero everywhere" in refusal(tabulate, "dgs", dark, Photometry())
    apart = Optics(
        30, Curve(np.array([300.0, 400]), np.ones(2)), Curve(np.array([500.0, 600]), np.ones(2))
    )
    assert "share no wavelength" in refusal(tabulate, "dgs", apart, Photometry())


@pytest.mark.parametrize(("low_nm", "high_nm"), [(200.0, 1000.0), (300.0, 1700.0)])
def test_a_tracker_that_sees_more_than_the_library_s_spectra_have_is_refused(low_nm, high_nm):
    wide = Optics(30, Curve(np.array([low_nm, high_nm]), np.ones(2)), constant_curve(1.0))
    line = refusal(tabulate_pickles, wide, Photometry())
    assert f"detects {low_nm:.0f} to {high_nm:.0f} nm, and the Pickles spectra" in line
    assert "run from 250 to 1600 nm" in line


@pytest.mark.parametrize("value", [1.5, 5e-324, 1e-200, 0.0, -1.0, float("nan"), 10**400])
def test_a_share_of_light_is_from_nearly_0_to_1(tmp_path, value):
    assert "from 1e-06 to 1" in refusal(load_curve, value, "[tracker] transmission", tmp_path)


@pytest.mark.parametrize("value", [1e-6, 1.0, 1])
def test_the_smallest_and_the_largest_share_are_taken(tmp_path, value):
    assert load_curve(value, "[tracker] transmission", tmp_path).value == pytest.approx(value)


def test_two_constants_are_taken_over_the_range_of_silicon():
    assert Optics(30, constant_curve(0.6), constant_curve(0.9)).range_nm == (300.0, 1100.0)


@pytest.mark.parametrize(
    ("name", "nm", "share"),
    [
        ("ccd47-20", 600.0, 0.966),  # ULTRACAM's red arm
        ("kai-4021", 500.0, 0.55),
        ("icx285", None, None),
        ("imx249", None, None),
        ("imx250", None, None),
        ("imx252", None, None),
        ("n-bk7-10mm", 500.0, 0.916),  # Schott
        ("johnson-v", 530.0, 1.0),  # Bessell 1990
    ],
)
def test_each_curve_that_a_bench_file_may_name_is_there(name, nm, share):
    curve = load_curve(name, "[tracker] quantum_efficiency")
    assert 0.3 < curve.value.max() <= 1.0
    assert curve.wavelength_nm[0] <= 500 and curve.wavelength_nm[-1] >= 600
    if nm is not None:
        assert curve(np.array([nm]))[0] == pytest.approx(share, abs=5e-4)


NM, VALUES = np.array([380.0, 450.0, 520.0]), np.array([0.05, 0.61, 0.48])
CURVES = {
    "wavelength_nm,value\n380,0.05\n450,0.61\n520,0.48\n": "",
    "380 0.05\n450 0.61\n520 0.48\n": "",
    "wavelength_nm,window,value\n380,0.95,0.05\n450,0.95,0.61\n520,0.95,0.48\n": "not used: window",
    "wavelength_nm,qe_percent\n380,5\n450,61\n520,48\n": (
        "column qe_percent is in percent: its numbers are multiplied by 0.01"
    ),
    "Wavelength [nm];Quantum Efficiency [%]\n380;5\n450;61\n520;48\n": (
        "multiplied by 0.01, to be in 1"
    ),
    "Wavelength (nm),% Transmission\n380,5\n450,61\n520,48\n": "column % Transmission is in %",
    "wavelength (Å)\tQE\n3800\t0.05\n4500\t0.61\n5200\t0.48\n": "multiplied by 0.1, to be in nm",
    "wavelength_um;transmission\n0,380;0,05\n0,450;0,61\n0,520;0,48\n": "with a decimal comma",
    "lambda,T\nnm,%\n380,5\n450,61\n520,48\n": "column T is in %",
    "# wavelength(nm) QE(%)\n380 5\n450 61\n520 48\n": "multiplied by 0.01",
    "# of a survey, measured\n3800 0.05\n4500 0.61\n5200 0.48\n": (
        "without a unit are taken as angstrom"
    ),
    "wavelength,value\n.38,.05\n.45,.61\n.52,.48\n": (
        "from 0.38 to 0.52 without a unit are taken as um"
    ),
}


@pytest.mark.parametrize("text", CURVES)
def test_a_curve_is_read_by_its_header_and_in_its_units(tmp_path, text, caplog):
    warn_once.cache_clear()
    (tmp_path / "qe.csv").write_text(text)
    curve = load_curve("qe.csv", "[tracker] quantum_efficiency", tmp_path)
    assert np.allclose(curve.wavelength_nm, NM, rtol=1e-14)
    assert np.allclose(curve.value, VALUES, rtol=1e-14)
    assert CURVES[text] in caplog.text
    assert bool(caplog.text) == bool(CURVES[text])


def test_a_curve_may_begin_below_what_a_tracker_sees_but_not_end_there(tmp_path):
    (tmp_path / "qe.csv").write_text("wavelength_nm,value\n90,0\n100,0.1\n1100,0.2\n")
    curve = load_curve("qe.csv", "[tracker] quantum_efficiency", tmp_path)
    assert curve.wavelength_nm.tolist() == [90.0, 100.0, 1100.0]


REFUSED = {
    "wavelength_nm,value\n50,0.05\n99,0.01\n": (
        "wavelengths from 50 to 99 nm by its column wavelength_nm, which no tracker sees"
    ),
    "": "at least two rows",
    "wavelength_nm,value\n400,0.5\n": "at least two rows",
    "400,0.5\n300,0.5\n": "do not rise",
    "400,0.5\n400,0.5\n": "do not rise",
    "400,0.5\n500,nan\n": "not a finite number",
    "400,0.5\n500,1.5\n": "fractions from 0 to 1",
    "400,0.5\n500,-0.1\n": "fractions from 0 to 1",
    "400,0.5\n500\n": ":2:",
    "400,half\n": ":1:",
    "wavelength_nm,value\n380,0,07\n450,0,85\n": ":2: 3 cells and 2 columns (a decimal comma",
    "380,0,07\n450,0,85\n": ":1: 3 columns, and no header that says which is which",
    "wavelength_nm,R,G,B\n400,0.1,0.2,0.3\n500,0.1,0.2,0.3\n": (
        ":1: no column value among wavelength_nm, R, G, B"
    ),
    "wavelength_nm,qe,transmission\n400,0.1,0.2\n500,0.1,0.2\n": (
        ":1: column value is there twice (qe, transmission)"
    ),
    "wavelength_nm,qe_percent,tau\n400,1,0.2\n500,1,0.2\n": (
        ":1: column value is there twice (qe_percent, tau)"
    ),
    "wavelength_nm,value [A/W]\n400,0.1\n500,0.1\n": (
        ":1: column value [A/W] is in 'A/W', and 1 is wanted"
    ),
    "wavelength_nm,absorption\n400,0.1\n500,0.1\n": (
        ":1: no column value among wavelength_nm, absorption"
    ),
    "nu [Hz],value\n400,0.1\n500,0.1\n": ":1: no column wavelength_nm among nu [Hz], value",
    "wavelength_nm,value\n3800,0.05\n9800,0.01\n": (
        "wavelengths from 3800 to 9800 nm, which look like angstrom"
    ),
    "wavelength_nm,value\n1.0,0.05\n1.7,0.01\n": (
        "wavelengths from 1 to 1.7 nm, which look like um; write wavelength_um"
    ),
    "wavelength_angstrom,value\n380,0.05\n980,0.01\n": (
        "wavelengths from 38 to 98 nm by its column wavelength_angstrom"
    ),
    "wavelength,value\n1100,0.05\n9800,0.01\n": (
        "wavelengths from 1100 to 9800 without a unit; write it in the header"
    ),
    "wavelength_nm,value\n400,5\n500,61\n": "fractions from 0 to 1",
}


@pytest.mark.parametrize("text", REFUSED)
def test_a_curve_that_is_none_or_may_mean_two_things_is_refused(tmp_path, text):
    (tmp_path / "qe.csv").write_text(text)
    line = refusal(load_curve, "qe.csv", "[tracker] quantum_efficiency", tmp_path)
    assert "qe.csv" in line and REFUSED[text] in line


def test_a_curve_that_is_neither_name_nor_file_is_refused(tmp_path):
    line = refusal(load_curve, "ccd48", "[tracker] quantum_efficiency", tmp_path)
    assert re.search(r"\[tracker\] quantum_efficiency = 'ccd48'.*\"ccd47-20\"", line)


def test_dust_reddens_v_minus_i_as_schlafly_and_finkbeiner_have_it():
    """2011, ApJ 737, 103, table 6, R = 3.1, Landolt's B, V and I: 3.626, 2.742 and 1.505. They
    take their mean over spectra of a cool star, and the library has stars of all types.
    """
    library = bare_and_dusty()
    bare_vi_mag, dusty_vi_mag = library.vi_mag.reshape(2, -1)
    wanted = DUST_EBV_MAG * (2.742 - 1.505) / (3.626 - 2.742)
    assert np.median(dusty_vi_mag - bare_vi_mag) == pytest.approx(wanted, rel=0.05)


def test_photon_weighting_weighs_a_passband_by_the_wavelength():
    """Straight lines between the samples of spectra and passband, summed up every 0.05 nm."""
    library, v = load_library(), load_curve("johnson-v", "johnson-v")
    nm = np.arange(v.wavelength_nm[0], v.wavelength_nm[-1] + 0.01, 0.05)
    response = {"energy": v(nm), "photon": v(nm) * nm}
    for star in (0, 50, 105):
        spectrum = np.interp(nm, library.wavelength_nm, library.flux[star])
        for weighting, weights in response.items():
            wanted = np.trapezoid(spectrum * weights, nm) / np.trapezoid(weights, nm)
            assert band_mean(library, v, weighting)[star] == pytest.approx(wanted, rel=1e-5)


@pytest.mark.parametrize("zero_point", ["vega", "iau-bolometric"])
def test_a_star_s_rate_is_by_its_own_mean_in_the_weighting_that_is_chosen(zero_point):
    """Of one V and another weighting a star's flux is as much larger as the reference's mean is
    beside its own.
    """
    library, v = load_library(), load_curve("johnson-v", "johnson-v")
    optics = Optics(30.0, v, constant_curve(1.0))
    rate, mean, reference = {}, {}, {}
    for weighting in ("energy", "photon"):
        photometry = Photometry(zero_point, weighting)
        rate[weighting] = library_electrons_per_s(library, optics, photometry)
        mean[weighting] = band_mean(library, v, weighting)
        reference[weighting] = reference_mean_w_m2_m(photometry)
    larger = reference["photon"] / reference["energy"]
    wanted = larger * mean["energy"] / mean["photon"]
    assert rate["photon"] / rate["energy"] == pytest.approx(wanted, rel=1e-12)
    assert np.ptp(wanted) > 0.01


def test_a_class_s_light_from_a_wavelength_on_is_all_from_the_first_and_less_the_hotter_it_is():
    """That of the wavelength itself is of it; a constant sensor sees 300 to 1100 nm, both of which
    the library has.
    """
    optics = Optics(30.0, constant_curve(0.5), constant_curve(0.5))
    every = class_shares(optics, 300.0)
    assert every == dict.fromkeys(LETTERS, pytest.approx(1.0, rel=1e-12))
    assert min(class_shares(optics, 1100.0).values()) > 0
    assert class_shares(optics, 1100.5) == dict.fromkeys(LETTERS, 0.0)
    red = list(class_shares(optics, 700.0).values())
    assert (np.diff(red) > 0).all()


def test_dust_dims_each_wavelength_as_fitzpatrick_s_table_has_it():
    """1999, PASP 111, 63, table 3: A / E(B-V) at the anchors of R = 3.1 that the library's 5 nm meet
    within 0.1 nm, where the spline is up to 0.01 off.
    """
    bare = load_library()
    dusty = bare_and_dusty().flux[len(bare.flux) :]
    table = ((600.0, 2.688), (260.0, 6.591), (270.0, 6.265), (1220.0, 0.829))
    places = [int(np.flatnonzero(bare.wavelength_nm == nm)[0]) for nm, _ in table]
    lit = (bare.flux[:, places] > 0).all(axis=1)
    shares = dusty[lit][:, places] / bare.flux[lit][:, places]
    dimmed_mag = -2.5 * np.log10(shares) / DUST_EBV_MAG
    # the library's spectra are kept at one light in V
    relative = dimmed_mag[:, 1:] - dimmed_mag[:, :1]
    wanted = np.array([mag for _, mag in table])
    assert np.abs(relative - (wanted[1:] - wanted[0])).max() < 0.01


def test_a_table_s_rate_is_that_of_v_0_and_a_hundredth_of_it_five_magnitudes_on():
    """Pogson's law; the table is of ln rate by 1 / K, here 1e6 e-/s at 5000 K and 1e4 at 10 000 K."""
    inverse_k = np.array([1 / 10_000, 1 / 5000])
    table = RateTable(Chebyshev.fit(inverse_k, np.log([1e4, 1e6]), 1, domain=inverse_k))
    temperature_k = np.array([5000.0, 10_000.0, 5000.0])
    rates = table.electrons_per_s(np.array([0.0, 5.0, -2.5]), temperature_k)
    assert rates == pytest.approx([1e6, 1e2, 1e7], rel=1e-12)


def test_dust_is_fitzpatricks_at_his_anchors():
    """Table 3 of Fitzpatrick 1999 (PASP 111, 63) for R = 3.1: wavelengths, Angstrom, and
    A / E(B-V).
    """
    angstroms = [26_500, 12_200, 6000, 5470, 4670, 4110, 2700, 2600]
    extinction_mag = [0.265, 0.829, 2.688, 3.055, 3.806, 4.315, 6.265, 6.591]
    assert DUST_PER_UM[1:] == pytest.approx([1e4 / each for each in angstroms], abs=5e-4)
    assert DUST_MAG[1:] == pytest.approx(extinction_mag)
    assert (DUST_PER_UM[0], DUST_MAG[0]) == (0.0, 0.0)
