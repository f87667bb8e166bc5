"""The matrix of channels by primaries against sums on a fine grid that are not the package's."""

import json

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.basics.resources import resource_path
from hilstar.display.primaries import (
    MATCHING,
    XY_NM,
    _matching_function,
    channel_matrix,
    read_primaries,
    reddest_nm,
)
from hilstar.sky.electrons import Optics
from hilstar.sky.spectrum import Curve, constant_curve, load_curve
from tests.support.benches import bench_text
from tests.support.commands import run_hilstar_here
from tests.support.spectra import NM, PANELS, bump, write_channels, write_panel

GLASS = load_curve("n-bk7-10mm", "n-bk7-10mm")
WHITE_E_PER_S = 3e5
QUADRATURE = 1e-4


PASSBANDS = {"r": (620.0, 50.0), "g": (540.0, 55.0), "b": (460.0, 45.0)}
RGB_NM = np.arange(400.0, 721.0, 10.0)


def optics_of(passbands):
    return {
        name: Optics(
            30.0,
            Curve(RGB_NM, bump(*passband, RGB_NM)) if passband else load_curve("ccd47-20", ""),
            GLASS,
        )
        for name, passband in passbands.items()
    }


@pytest.mark.parametrize("panel", PANELS)
@pytest.mark.parametrize("passbands", [PASSBANDS, {"mono": None}], ids=["rgb", "mono"])
def test_the_matrix_is_that_of_a_sum_over_a_fine_grid(tmp_path, panel, passbands):
    primaries = read_primaries(write_panel(tmp_path / "p.csv", PANELS[panel]))
    channels = optics_of(passbands)
    found = channel_matrix(primaries, channels, WHITE_E_PER_S)
    nm = np.arange(350.0, 850.0, 0.002) + 0.001
    photons = [
        np.interp(nm, NM, spectrum, left=0, right=0) * nm * GLASS(nm) for spectrum in PANELS[panel]
    ]
    seen = [optics.quantum_efficiency(nm) for optics in channels.values()]
    wanted = np.array([[float(p @ q) for p in photons] for q in seen])
    wanted *= WHITE_E_PER_S / wanted.sum()
    np.testing.assert_allclose(found.e_per_s, wanted, rtol=QUADRATURE, atol=1e-7 * WHITE_E_PER_S)
    singular = np.sqrt(np.linalg.eigvalsh(wanted @ wanted.T))
    assert found.condition == pytest.approx(singular[-1] / singular[0], rel=1e-3)
    assert found.channels == tuple(passbands)


@pytest.mark.parametrize("name", ["lcd", "crt", "oled", "laser"])
def test_the_shipped_primaries_are_red_green_and_blue_to_a_mosaic(name):
    found = channel_matrix(
        read_primaries(resource_path("configs", f"primaries-{name}.csv")), optics_of(PASSBANDS), 1.0
    )
    assert (found.e_per_s.argmax(axis=0) == [0, 1, 2]).all() and found.condition < 10


def test_a_primary_beyond_a_channels_passband_gives_it_nothing(tmp_path):
    primaries = read_primaries(
        write_panel(tmp_path / "p.csv", [bump(k, 10) * (abs(NM - k) < 50) for k in (650, 550, 450)])
    )
    channels = {"r": Optics(30.0, Curve(np.array([600.0, 700.0]), np.ones(2)), constant_curve(1.0))}
    (row,) = channel_matrix(primaries, channels, 1.0).e_per_s
    assert (
        row[0] == pytest.approx(1, abs=1e-9)
        and row[2] == 0
        and row[1] == pytest.approx(0, abs=1e-9)
    )
    infrared = {
        "r": Optics(30.0, Curve(np.array([900.0, 1000.0]), np.ones(2)), constant_curve(1.0))
    }
    with pytest.raises(InputError, match="detects none of this light"):
        channel_matrix(primaries, infrared, 1.0)


def test_channels_of_one_colour_have_no_condition_number(tmp_path):
    primaries = read_primaries(write_panel(tmp_path / "p.csv", PANELS["lcd"]))
    assert (
        channel_matrix(
            primaries, optics_of({"r": None, "g": None, "b": PASSBANDS["b"]}), 1.0
        ).condition
        is None
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("wavelength_nm,r,g\n400,1,1\n", "column b is missing"),
        ("wavelength_nm,r,g,b\n400,1,1,1\n390,1,1,1\n", "3: wavelengths do not rise"),
        ("wavelength_nm,r,g,b\n400,1,1,1\n400,1,1,1\n", "3: wavelengths do not rise"),
        ("wavelength_nm,r,g,b\n400,1,-1,1\n", "2: power below 0"),
        ("wavelength_nm,r,g,b\n0.4,1,1,1\n", "2: power below 0, or a wavelength that is not in nm"),
        ("wavelength_nm,r,g,b\n400,1,x,1\n", "g = 'x' is not a finite number"),
        ("wavelength_nm,r,g,b\n400,1,1,0\n500,1,1,0\n", "no light of b"),
        ("wavelength_nm,r,g,b\n", "0 rows, and no light of r, g, b"),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path, text, words):
    path = tmp_path / "p.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as error:
        read_primaries(path)
    assert "\n" not in str(error.value)


@pytest.mark.gpu
def test_the_budget_of_a_bench_has_the_matrix_and_its_condition_number(tmp_path):
    write_panel(tmp_path / "p.csv", PANELS["oled"])
    curves = {name: bump(*passband, RGB_NM) for name, passband in PASSBANDS.items()}
    keys = write_channels(tmp_path, RGB_NM, curves)
    bench = tmp_path / "bench.toml"
    tables = {
        "monitor.primaries": {"file": "p.csv"},
        "render": {"quantisation": "round", "flux_at_white_e_per_s": 3e5},
    }
    bench.write_text(bench_text({"tracker": keys, "sky": {"faintest_v_mag": 5.0}}, tables))
    whole = json.loads(run_hilstar_here("budget", bench, "--json").stdout)
    found, red = whole["primaries"], whole["near_infrared"]
    # 1 % of red at 711 nm
    assert [row["from_nm"] for row in red] == [700.0] * 4 + [710.0] * 4 and red[4][
        "channel"
    ] == "all"
    assert set(red[5]["by_class"]) == set("OBAFGKM")
    wanted = channel_matrix(read_primaries(tmp_path / "p.csv"), optics_of(PASSBANDS), WHITE_E_PER_S)
    digits = 1e-8 * WHITE_E_PER_S  # of the files
    np.testing.assert_allclose(found["e_per_s"], wanted.e_per_s, rtol=1e-6, atol=digits)
    assert found["channels"] == list(keys)[1:] and found["condition"] == pytest.approx(
        wanted.condition, rel=1e-6
    )
    printed = run_hilstar_here("budget", bench).stdout
    assert f"condition number      {wanted.condition:.2f}, electrons of each channel" in printed
    assert (
        f"quantum_efficiency_g  r {wanted.e_per_s[1, 0]:.4g} e-/s, g {wanted.e_per_s[1, 1]:.4g}"
        " e-/s" in printed
    )


@pytest.mark.parametrize(("first", "unit"), [(3800, "angstrom"), (0.38, "um")])
def test_primaries_in_another_unit_than_their_header_states_are_refused(tmp_path, first, unit):
    rows = "".join(f"{first * factor},1,2,3\n" for factor in (1, 1.5, 2))
    (tmp_path / "primaries.csv").write_text(f"wavelength_nm,r,g,b\n{rows}")
    with pytest.raises(InputError, match=f"which look like {unit}|not in nm"):
        read_primaries(tmp_path / "primaries.csv")
    (tmp_path / "primaries.csv").write_text(f"wavelength_{unit},r,g,b\n{rows}")
    assert read_primaries(tmp_path / "primaries.csv")[0].wavelength_nm[2] == pytest.approx(380)


# The CIE 1931 colour matching functions (2 degrees) of 400, 410, ... 700 nm, CIE 015.
CIE_NM = np.arange(400.0, 701.0, 10.0)
CIE_TABLE = """
    .01431 .000396 .06785  .04351 .00121 .2074    .13438 .0040 .6456    .2839 .0116 1.3856
    .34828 .0230 1.74706   .3362 .0380 1.77211    .2908 .0600 1.6692    .19536 .09098 1.28764
    .09564 .13902 .81295   .03201 .20802 .46518   .0049 .3230 .2720     .0093 .5030 .1582
    .06327 .7100 .07825    .1655 .8620 .04216     .2904 .9540 .0203     .43345 .99495 .00875
    .5945 .9950 .0039      .7621 .9520 .0021      .9163 .8700 .00165    1.0263 .7570 .0011
    1.0622 .6310 .0008     1.0026 .5030 .00034    .85445 .3810 .00019   .6424 .2650 .00005
    .4479 .1750 .00002     .2835 .1070 0          .1649 .0610 0         .0874 .0320 0
    .04677 .0170 0         .0227 .00821 0         .01136 .00410 0
"""
CIE_XYZ = np.array(CIE_TABLE.split(), dtype=float).reshape(-1, 3)
# Sums of two or three Gaussians are 0.0138 off, in values up to 1.8.
FIT_OFF = 0.015


def test_the_colour_matching_functions_are_the_cie_s():
    fitted = np.array([_matching_function(lobes) for lobes in MATCHING])
    at_cie = fitted[:, np.isin(XY_NM, CIE_NM)]
    np.testing.assert_allclose(at_cie.T, CIE_XYZ, rtol=0.0, atol=FIT_OFF)


def test_the_reddest_light_is_the_longest_wavelength_with_a_hundredth_of_a_primary_s_power():
    """Of whichever primary; what is fainter is a spectrometer's noise."""
    nm = np.array([400.0, 500.0, 600.0, 700.0, 800.0])
    red = Curve(nm, np.array([0.0, 1.0, 50.0, 0.6, 0.4]))
    blue = Curve(nm, np.array([9.0, 1.0, 0.0, 0.0, 0.1]))
    assert reddest_nm([red]) == 700.0
    assert reddest_nm([red, blue]) == 800.0
    assert reddest_nm([red], least=0.1) == 600.0
