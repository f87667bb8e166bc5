"""A library spectrum's light of all wavelengths, where its own ends: by the Stefan-Boltzmann law."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.sky.electrons import Library
from hilstar.sky.spectrum import blackbody_exitance_w_m2_m, torres2010_k
from hilstar.sky.synthetic import TORRES_BV_MAG, library_exitance_m

STEFAN_BOLTZMANN_W_M2_K4 = 5.670374419e-8  # CODATA 2018
NM = np.arange(200.0, 1200.5, 2.0)
# the trapezoidal rule over 2 nm, and what lies beyond 10 nm and 0.1 mm
QUADRATURE = 2e-4


def library_of(flux, bv_mag):
    return Library(NM, np.atleast_2d(flux), ("G2V",), np.array([bv_mag]), np.zeros(1))


def body(bv_mag):
    kelvin = float(torres2010_k(np.array([bv_mag]))[0])
    return kelvin, blackbody_exitance_w_m2_m(NM, np.array([[kelvin]]))[0]


@pytest.mark.parametrize("bv_mag", [0.0, 0.65, 1.5])
def test_a_black_body_s_light_is_that_of_stefan_and_boltzmann(bv_mag):
    kelvin, flux = body(bv_mag)
    (whole,) = library_exitance_m(library_of(flux / flux.max(), bv_mag))
    wanted = STEFAN_BOLTZMANN_W_M2_K4 * kelvin**4 / flux.max()
    assert whole == pytest.approx(wanted, rel=QUADRATURE)


@pytest.mark.parametrize("bluer,redder", [(3.0, 1.0), (1.0, 3.0)])
def test_beyond_each_end_stands_the_body_of_that_end(bluer, redder):
    """A body that is three times as bright on one side of 700 nm: all of that side is."""
    kelvin, flux = body(0.65)
    times = np.where(NM < 700.0, bluer, redder)
    (whole,) = library_exitance_m(library_of(flux * times, 0.65))
    nm = np.geomspace(10.0, 700.0, 20_000)
    below = np.trapezoid(blackbody_exitance_w_m2_m(nm, np.array([[kelvin]]))[0], nm) * 1e-9
    above = STEFAN_BOLTZMANN_W_M2_K4 * kelvin**4 - below
    # the step itself lies within one of the nodes' 2 nm
    assert whole == pytest.approx(bluer * below + redder * above, rel=2e-3)


@pytest.mark.parametrize(("end", "beyond_mag"), [(0, -0.5), (1, 0.5)])
def test_a_colour_beyond_torres_s_is_his_last(end, beyond_mag):
    last_mag = TORRES_BV_MAG[end]
    _, flux = body(last_mag)
    at_end = library_exitance_m(library_of(flux, last_mag))
    beyond = library_exitance_m(library_of(flux, last_mag + beyond_mag))
    assert beyond == pytest.approx(at_end, rel=1e-12)
