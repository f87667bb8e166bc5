"""The trade-off of brightness: the integral over a spectrum."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

import numpy as np
from numpy.polynomial import Chebyshev
from scipy.integrate import quad_vec

from hilstar.arrays import FloatArray
from hilstar.bench.config import SkySettings
from hilstar.sky.catalog import load_catalog
from hilstar.sky.electrons import (
    TABLE_DEGREE,
    TABLE_RANGE_K,
    Optics,
    Photometry,
    RateTable,
    ags_electrons_per_s,
    dgs_electrons_per_s,
    reference_mean_w_m2_m,
    star_temperatures_k,
    tabulate,
)
from hilstar.sky.spectrum import (
    GAUSS_ORDER,
    PLANCK_J_S,
    Curve,
    blackbody_exitance_w_m2_m,
    load_curve,
)
from hilstar.study.shared.brightness import study_optics
from hilstar.study.tradeoff.table import Figure, Trial, Trials
from hilstar.units import LIGHT_M_S, magnitude

SENSOR = "ccd47-20"
ADAPTIVE = "adaptive quadrature"
COLOURS = 3000
STEPS_NM = (1.0, 5.0, 10.0, 20.0)
ORDERS = (1, 2, 3, 4, GAUSS_ORDER)
DEGREES = (5, 10, 20, TABLE_DEGREE)
BV_TABLE_SIZES = (16, 128, 1024)
# quad_vec is asked for this, relative to the largest of all stars' integrals, each near 1 by its own scale.
QUAD = 1e-12
# Two float64 integrals of some hundred terms, each known to about 1e-13, and QUAD's own.
ROUNDING_MAG = 5e-12

# Wavelengths, nm, and weights, m, that integrate a product of curves.
Rule = Callable[..., tuple[FloatArray, FloatArray]]


def brightness(stack: ExitStack, quick: bool) -> Trials:
    """The integral of black bodies through a sensor: error, mag, worst over COLOURS of the catalogue and at the median one."""
    del stack, quick
    optics, bv_mag = study_optics(SENSOR), catalogue_colours()
    kelvin = star_temperatures_k(bv_mag, SkySettings().temperature)
    exact = adaptive_rates(kelvin, optics)
    works = brightness_methods(bv_mag, kelvin, optics)
    trials = []
    for name, work in works.items():
        error = np.abs(magnitude(work() / exact))
        own, exact_one = name == table_name(TABLE_DEGREE), name == ADAPTIVE
        trials.append(Trial(name, float(error.max()), float(np.median(error)), work, own, exact_one))
    return Trials(
        "brightness",
        f"{COLOURS} black bodies, tables included",
        Figure("error of the integral, worst colour", "mag", ROUNDING_MAG),
        Figure("median colour", "mag"),
        "made once, it serves every star of a catalogue, for any curves of the sensor",
        trials,
        f"a bench asks for at most {len(load_catalog())} stars, each once: this time is spent when it is loaded",
    )


def catalogue_colours() -> FloatArray:
    """COLOURS values of B-V, mag, at equal shares of the catalogue, the bluest and the reddest star among them."""
    return np.quantile(load_catalog().bv_mag, np.linspace(0, 1, COLOURS), method="nearest")


def table_name(degree: int) -> str:
    """The name of the method with a Chebyshev table of `degree`."""
    return f"table over 1/T, degree {degree}"


def brightness_methods(bv_mag: FloatArray, kelvin: FloatArray, optics: Optics) -> dict[str, Callable[[], FloatArray]]:
    """Every method by name: rates of V = 0 stars, shape (COLOURS,)."""
    works: dict[str, Callable[[], FloatArray]] = {ADAPTIVE: partial(adaptive_rates, kelvin, optics)}
    works |= {f"trapezoid, {h:g} nm": partial(rates_by, partial(trapezoid, h), kelvin, optics) for h in STEPS_NM}
    works |= {f"Gauss-Legendre, {n} per knot": partial(rates_by, partial(gauss, n), kelvin, optics) for n in ORDERS}
    works |= {table_name(degree): partial(_table_rates, degree, kelvin, optics) for degree in DEGREES}
    works |= {f"straight lines over B-V, {n}": partial(_bv_table_rates, n, bv_mag, optics) for n in BV_TABLE_SIZES}
    works["AGS"] = lambda: np.full(len(kelvin), ags_electrons_per_s(optics, Photometry()))
    return works


def rates_by(rule: Rule, kelvin: FloatArray, optics: Optics) -> FloatArray:
    """Electron rates of V = 0 black bodies (n,) with both integrals by a rule."""
    return _rates(kelvin, optics, lambda integrand, *curves: _by_rule(integrand, *rule(*curves)))


def adaptive_rates(kelvin: FloatArray, optics: Optics) -> FloatArray:
    """Electron rates of V = 0 black bodies (n,) by adaptive quadrature between the curves' knots."""

    def integral(integrand: Callable[[FloatArray], FloatArray], *curves: Curve) -> FloatArray:
        knots = shared_knots(*curves)
        ends = float(knots[0]), float(knots[-1])

        def at(nm: float) -> FloatArray:
            return integrand(np.array([nm]))[:, 0]

        return np.asarray(quad_vec(at, *ends, epsabs=0, epsrel=QUAD, norm="max", points=knots)[0]) * 1e-9

    return _rates(kelvin, optics, integral)


def _rates(kelvin: FloatArray, optics: Optics, integral: Callable[..., FloatArray]) -> FloatArray:
    """Thesis eq. 3.1 with whatever integrates; spectra are scaled to 1 at 550 nm, so that one tolerance fits all stars."""
    passband, curves = load_curve("johnson-v", "johnson-v"), (optics.quantum_efficiency, optics.transmission)
    scale = blackbody_exitance_w_m2_m(np.array([550.0]), kelvin[:, None])

    def spectrum(nm: FloatArray) -> FloatArray:
        return np.asarray(blackbody_exitance_w_m2_m(nm, kelvin[:, None]) / scale)

    v_band = integral(lambda nm: spectrum(nm) * passband(nm), passband)
    width = integral(lambda nm: passband(nm)[None], passband)
    electrons = integral(lambda nm: spectrum(nm) * (curves[0](nm) * curves[1](nm) * nm * 1e-9), *curves)
    per_spectrum = optics.area_m2 * reference_mean_w_m2_m(Photometry()) / (PLANCK_J_S * LIGHT_M_S)
    return np.asarray(per_spectrum * electrons * width / v_band)


def _by_rule(integrand: Callable[[FloatArray], FloatArray], nodes_nm: FloatArray, weight_m: FloatArray) -> FloatArray:
    return np.asarray(integrand(nodes_nm) @ weight_m)


def trapezoid(step_nm: float, *curves: Curve) -> tuple[FloatArray, FloatArray]:
    """Nodes, nm, and weights, m, of the trapezoid rule over the curves' range in steps of at most `step_nm`."""
    knots = shared_knots(*curves)
    nodes = np.linspace(knots[0], knots[-1], int(np.ceil((knots[-1] - knots[0]) / step_nm)) + 1)
    weight = np.full(len(nodes), nodes[1] - nodes[0])
    weight[[0, -1]] /= 2
    return nodes, weight * 1e-9


def gauss(order: int, *curves: Curve) -> tuple[FloatArray, FloatArray]:
    """Nodes, nm, and weights, m, of Gauss-Legendre quadrature between every two knots of the curves."""
    at, weight = np.polynomial.legendre.leggauss(order)
    knots = shared_knots(*curves)
    half = np.diff(knots)[:, None] / 2
    return (knots[:-1, None] + half * (1 + at)).ravel(), (half * weight).ravel() * 1e-9


def shared_knots(*curves: Curve) -> FloatArray:
    """Wavelengths, nm, where one of the curves bends, over the range that all share."""
    low, high = max(c.wavelength_nm[0] for c in curves), min(c.wavelength_nm[-1] for c in curves)
    knots = np.unique(np.concatenate([c.wavelength_nm for c in curves]))
    return np.asarray(knots[(knots >= low) & (knots <= high)])


def _table_rates(degree: int, kelvin: FloatArray, optics: Optics) -> FloatArray:
    if degree == TABLE_DEGREE:
        return tabulate("dgs", optics, Photometry()).electrons_per_s(np.zeros(len(kelvin)), kelvin)
    domain = [1 / TABLE_RANGE_K[1], 1 / TABLE_RANGE_K[0]]
    log_rate = Chebyshev.interpolate(lambda x: np.log(dgs_electrons_per_s(1 / x, optics, Photometry())), degree, domain)
    return RateTable(log_rate).electrons_per_s(np.zeros(len(kelvin)), kelvin)


def _bv_table_rates(size: int, bv_mag: FloatArray, optics: Optics) -> FloatArray:
    at_mag = np.linspace(bv_mag.min(), bv_mag.max(), size)
    rate = dgs_electrons_per_s(star_temperatures_k(at_mag, SkySettings().temperature), optics, Photometry())
    return np.asarray(np.exp(np.interp(bv_mag, at_mag, np.log(rate))))
