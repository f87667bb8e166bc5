"""Electron rates of stars: DGS (thesis eq. 3.1) and AGS (eq. 3.2), with the corrections that the
functions state.

Both are `10^(-0.4 V)` times the rate at V = 0. For DGS that rate depends on the star's temperature
alone, so it is tabulated once per bench; for AGS it is one number.

Electron rates from real spectra by colour: the Pickles library (Pickles 1998, PASP 110, 863).

Black bodies fail where molecules take over: B-V saturates near 1.5 and turns back, V-I does not. So
the logarithm of a V = 0 star's electron rate is a smooth curve over V-I, with a term in B-V for the
hottest: fitted to the library once per bench. tests/authority/test_pickles.py holds the errors of
held-out stars.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.polynomial import Chebyshev

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import LIGHT_M_S, flux_ratio
from hilstar.sky.spectrum import (
    PLANCK_J_S,
    STEFAN_BOLTZMANN_W_M2_K4,
    TEMPERATURE_SCALES,
    Curve,
    blackbody_exitance_w_m2_m,
    integration_nodes,
    load_curve,
)

VEGA_V0_W_M2_M = 3.631e-2  # Bessell 1998, A&A 333, 231, table A2: 3.631e-9 erg/s/cm2/A at 545 nm
BOLOMETRIC_0_W_M2 = 2.518021002e-8  # IAU 2015 Resolution B2
SUN_TEMPERATURE_K = 5772.0  # IAU 2015 Resolution B3
REFERENCE_TEMPERATURE_K = 9602.0  # the thesis's Vega-like black body, section 3.4

# Where neither the quantum efficiency nor the transmission has a table: the range of silicon.
SILICON_RANGE_NM = (300.0, 1100.0)

# ln(electrons at V = 0) is smooth in 1/T. Degree 40 over this range is within 1e-11 of the integral
# (tests/authority/test_electrons.py holds it to 1e-6 for every star of the catalogue).
TABLE_RANGE_K = (1000.0, 200_000.0)
# results/tradeoff.csv, brightness: as accurate as the integral in a fortieth of its time.
TABLE_DEGREE = 40

BrightnessModel = Literal["dgs", "ags"]
ZeroPoint = Literal["vega", "iau-bolometric"]
Weighting = Literal["energy", "photon"]
PACKAGED_LIBRARY = Path(__file__).resolve().parent / "data" / "pickles.npz"

# Natural cubic splines with knots at equal shares of the library. 7 to 14 knots were tried, without
# B-V and with it up to 0.1, 0.2 and 0.3 mag: from 10 knots on, with B-V, held-out stars are within
# 1 % (median) and 3 % (95 %) for V-I < 2.5 on the built-in sensors and a flat one; beyond 12 knots
# nothing improves.
VI_KNOT_COUNT = 12
# Up to here (about F0) B-V tells supergiants and reddened stars from dwarfs of the same V-I; past
# it, B-V follows the metal lines in the blue and makes the rates of cool supergiants worse.
MAX_BV_TERM_MAG = 0.3
# For stars without V-I. Late M giants have the B-V of K giants and ten times their electrons. The
# fit excludes them: their rates are wrong, and those of the K giants, fifty times as many to V =
# 7.5, are right.
BV_KNOT_COUNT = 5
MAX_BV_FIT_VI_MAG = 2.0
BLOCK_STARS = 2_000  # evaluated at once: their splines' terms stay within a processor's cache


@dataclass(frozen=True, slots=True)
class Optics:
    """The optics and sensor that turn starlight into electrons: aperture, quantum efficiency,
    transmission.
    """

    aperture_mm: float
    quantum_efficiency: Curve
    transmission: Curve

    def __post_init__(self) -> None:
        efficiency_nm = self.quantum_efficiency.wavelength_nm
        if not len(efficiency_nm) and not len(self.transmission.wavelength_nm):
            flat = Curve(np.array(SILICON_RANGE_NM), np.full(2, self.quantum_efficiency.value[0]))
            object.__setattr__(self, "quantum_efficiency", flat)

    @property
    def area_m2(self) -> float:
        """The aperture's area, m2."""
        return np.pi / 4 * (self.aperture_mm * 1e-3) ** 2

    @property
    def range_nm(self) -> tuple[float, float]:
        """The wavelengths that the tracker detects: where both curves have values."""
        low_nm = []
        high_nm = []
        for curve in (self.quantum_efficiency, self.transmission):
            if len(curve.wavelength_nm):
                low_nm.append(curve.wavelength_nm[0])
                high_nm.append(curve.wavelength_nm[-1])
        return max(low_nm), min(high_nm)


def all_channels(channels: Sequence[Optics]) -> Optics:
    """The optics of a tracker that adds up its channels, which differ in quantum efficiency alone.

    A curve may end above zero: the sum has a knot on either side of that step.
    """
    if len(channels) == 1:
        return channels[0]
    curves = [_ranged_efficiency(channel) for channel in channels]
    knots_nm = [curve.wavelength_nm for curve in curves]
    beyond_nm = [np.nextafter(nm[[0, -1]], [0.0, np.inf]) for nm in knots_nm]
    sum_nm = np.unique(np.concatenate([*beyond_nm, *knots_nm]))
    efficiency = np.sum([curve(sum_nm) for curve in curves], axis=0)
    return replace(channels[0], quantum_efficiency=Curve(sum_nm, efficiency))


def _ranged_efficiency(channel: Optics) -> Curve:
    """A channel's quantum efficiency as a curve that has knots: a number's are the ends of what
    the channel detects.
    """
    curve = channel.quantum_efficiency
    if len(curve.wavelength_nm):
        return curve
    return Curve(np.array(channel.range_nm), np.full(2, curve.value[0]))


@dataclass(frozen=True, slots=True)
class Photometry:
    """How a V magnitude becomes a spectral irradiance."""

    zero_point: ZeroPoint = "vega"
    weighting: Weighting = "energy"


def v_band_mean_w_m2_m(temperature_k: float | FloatArray, weighting: Weighting) -> FloatArray:
    """<pi B(T)> through Johnson V, W/m2/m; shape of `temperature_k` (thesis eq. 3.11).

    Bessell's V is an energy response; "photon" multiplies it by lambda once more, as the thesis
    does.
    """
    passband = load_curve("johnson-v", "johnson-v")
    wavelength_nm, weight_m = integration_nodes(passband)
    response = passband(wavelength_nm) * weight_m
    if weighting == "photon":
        response = response * wavelength_nm
    temperature_k = np.asarray(temperature_k, dtype=np.float64)
    spectrum = blackbody_exitance_w_m2_m(wavelength_nm, temperature_k[..., None])
    return np.asarray(spectrum @ response / response.sum())


def reference_mean_w_m2_m(photometry: Photometry) -> float:
    """<F_ref> of a V = 0 star through Johnson V, W/m2/m.

    "vega" is the published band average itself, whatever the weighting. "iau-bolometric" is the
    thesis's: a 9602 K black body with the IAU's bolometric zero point (eq. 3.14, 3.15).
    """
    if photometry.zero_point == "vega":
        return VEGA_V0_W_M2_M
    dilution = BOLOMETRIC_0_W_M2 / (STEFAN_BOLTZMANN_W_M2_K4 * REFERENCE_TEMPERATURE_K**4)
    return float(dilution * v_band_mean_w_m2_m(REFERENCE_TEMPERATURE_K, photometry.weighting))


def electron_response(optics: Optics) -> tuple[FloatArray, FloatArray]:
    """Wavelengths (n,), nm, and weights (n,): a spectrum in W/m2/m there, times the weights,
    sums to electrons/s/m2.
    """
    wavelength_nm, weight_m = integration_nodes(optics.quantum_efficiency, optics.transmission)
    electrons_per_j = wavelength_nm * 1e-9 / (PLANCK_J_S * LIGHT_M_S)
    efficiency = optics.quantum_efficiency(wavelength_nm) * optics.transmission(wavelength_nm)
    return wavelength_nm, efficiency * electrons_per_j * weight_m


def dgs_electrons_per_s(
    temperature_k: float | FloatArray, optics: Optics, photometry: Photometry
) -> FloatArray:
    """Electron rate of a V = 0 black body by direct integration (thesis eq. 3.1); shape of
    `temperature_k`.
    """
    wavelength_nm, response = electron_response(optics)
    temperature_k = np.asarray(temperature_k, dtype=np.float64)
    exitance = blackbody_exitance_w_m2_m(wavelength_nm, temperature_k[..., None])
    mean_w_m2_m = v_band_mean_w_m2_m(temperature_k, photometry.weighting)
    dilution = reference_mean_w_m2_m(photometry) / mean_w_m2_m
    return np.asarray(optics.area_m2 * dilution * (exitance @ response))


def zodiacal_electrons_per_s_arcsec2(
    v_mag_arcsec2: float, optics: Optics, photometry: Photometry
) -> float:
    """Electron rate of zodiacal light per square arcsecond of sky: sunlight of that V surface
    brightness.

    Zodiacal light is a little redder than the Sun: the WFC3 handbook's spectrum gives 5 % more
    photons from 330 to 1100 nm.
    """
    sunlight_e_per_s = dgs_electrons_per_s(SUN_TEMPERATURE_K, optics, photometry)
    return float(flux_ratio(v_mag_arcsec2) * sunlight_e_per_s)


def ags_electrons_per_s(optics: Optics, photometry: Photometry) -> float:
    """Electron rate of any V = 0 star in the average model (thesis eq. 3.2, 3.16, 3.17).

    Every curve is replaced by its mean over the tracker's range, every star by the 9602 K
    reference.
    """
    low_nm, high_nm = optics.range_nm
    wavelength_nm, weight_m = integration_nodes(optics.quantum_efficiency, optics.transmission)
    width_m = (high_nm - low_nm) * 1e-9
    mean_qe = optics.quantum_efficiency(wavelength_nm) @ weight_m / width_m
    mean_transmission = optics.transmission(wavelength_nm) @ weight_m / width_m
    mean_w_m2_m = v_band_mean_w_m2_m(REFERENCE_TEMPERATURE_K, photometry.weighting)
    dilution = reference_mean_w_m2_m(photometry) / mean_w_m2_m
    exitance = blackbody_exitance_w_m2_m(wavelength_nm, REFERENCE_TEMPERATURE_K)
    irradiance_w_m2 = dilution * (exitance @ weight_m)
    mean_wavelength_m = (low_nm + high_nm) / 2 * 1e-9
    photons_per_j = mean_wavelength_m / (PLANCK_J_S * LIGHT_M_S)
    return float(optics.area_m2 * irradiance_w_m2 * photons_per_j * mean_qe * mean_transmission)


def star_temperatures_k(bv_mag: FloatArray, scale: str) -> FloatArray:
    """Temperatures (n,) by a scale of TEMPERATURE_SCALES, held within TABLE_RANGE_K.

    Only `wang2021` reaches the lower end: it gives the carbon star with B-V = 5.46 a temperature of
    296 K.
    """
    low_k, high_k = TABLE_RANGE_K
    return np.clip(TEMPERATURE_SCALES[scale](bv_mag), low_k, high_k)


@dataclass(frozen=True, slots=True)
class RateTable:
    """Electrons per second of a V = 0 star against its temperature, tabulated once per bench."""

    log_rate: Chebyshev

    def electrons_per_s(self, v_mag: FloatArray, temperature_k: FloatArray) -> FloatArray:
        """Electron rates of stars (n,), whose temperatures lie within TABLE_RANGE_K."""
        return np.asarray(flux_ratio(v_mag) * np.exp(self.log_rate(1.0 / temperature_k)))


def tabulate(model: BrightnessModel, optics: Optics, photometry: Photometry) -> RateTable:
    """The rate table of a bench. Raises InputError when the tracker detects no light at all."""
    low_k, high_k = TABLE_RANGE_K
    domain = [1.0 / high_k, 1.0 / low_k]
    if not (dgs_electrons_per_s(REFERENCE_TEMPERATURE_K, optics, photometry) > 0):
        raise InputError(
            "tracker: quantum efficiency times transmission is zero everywhere; no star gives an"
            " electron"
        )
    if model == "ags":
        log_rate_of_all = np.log(ags_electrons_per_s(optics, photometry))
        return RateTable(Chebyshev([log_rate_of_all], domain=domain))

    def log_rate(inverse_k: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.log(dgs_electrons_per_s(1.0 / inverse_k, optics, photometry))

    table = Chebyshev.interpolate(log_rate, TABLE_DEGREE, domain=domain)
    if not np.isfinite(table.coef).all():
        raise InputError(
            "tracker: detects no light of the coolest stars at all; give a quantum efficiency that"
            " reaches 400 nm"
        )
    return RateTable(table)


@dataclass(frozen=True, slots=True)
class Library:
    """Spectra over `wavelength_nm` (k,): relative F_lambda (m, k), and each star's type and
    colours, (m,).

    Flux is 1 in the mean through Johnson V. Colours are synthetic, Johnson B-V and Cousins V-I.
    """

    wavelength_nm: FloatArray
    flux: FloatArray
    spectral_type: tuple[str, ...]
    bv_mag: FloatArray
    vi_mag: FloatArray


@dataclass(frozen=True, slots=True)
class Spline:
    """A natural cubic spline by its coefficients over `natural_basis`; constant beyond its end
    knots.
    """

    knots_mag: FloatArray
    coefficients: FloatArray

    def __call__(self, colour_mag: FloatArray) -> FloatArray:
        """The value at each colour, shape (n,)."""
        return np.asarray(natural_basis(colour_mag, self.knots_mag) @ self.coefficients)


@dataclass(frozen=True, slots=True)
class PicklesTable:
    """Electrons per second of a V = 0 star against its colours, made once per bench.

    ln(rate) = `over_vi`(V-I) + `per_bv` B-V, B-V held to `bv_range_mag`; `over_bv` alone where V-I
    is missing.
    """

    over_vi: Spline
    per_bv: float
    bv_range_mag: tuple[float, float]
    over_bv: Spline

    def electrons_per_s(
        self, v_mag: FloatArray, bv_mag: FloatArray, vi_mag: FloatArray
    ) -> FloatArray:
        """Electron rates of stars, shape (n,); B-V alone where V-I is NaN; a colour beyond the
        library counts as its end.
        """
        log_rate = np.empty(len(v_mag))
        for begin in range(0, len(v_mag), BLOCK_STARS):
            part = slice(begin, begin + BLOCK_STARS)
            vi = vi_mag[part]
            bv = bv_mag[part]
            known = np.isfinite(vi)
            block = log_rate[part]
            bv_term = self.per_bv * np.clip(bv[known], *self.bv_range_mag)
            block[known] = self.over_vi(vi[known]) + bv_term
            block[~known] = self.over_bv(bv[~known])
        return np.asarray(flux_ratio(v_mag) * np.exp(log_rate))


@cache
def load_library() -> Library:
    """The packaged library: 106 stars, 250 to 1600 nm every 0.5 nm (tools/make_pickles.py made
    it).
    """
    with np.load(PACKAGED_LIBRARY) as packed:
        return Library(
            wavelength_nm=packed["wavelength_nm"].astype(np.float64),
            flux=packed["flux"].astype(np.float64),
            spectral_type=tuple(str(name) for name in packed["spectral_type"]),
            bv_mag=packed["bv_mag"],
            vi_mag=packed["vi_mag"],
        )


def tabulate_pickles(optics: Optics, photometry: Photometry) -> PicklesTable:
    """The rate table of a bench.

    Raises InputError when the tracker detects light beyond the library's range, or none of some
    library star.
    """
    library = load_library()
    rate = library_electrons_per_s(library, optics, photometry)
    return fit_table(library.bv_mag, library.vi_mag, rate)


def library_electrons_per_s(library: Library, optics: Optics, photometry: Photometry) -> FloatArray:
    """Electron rate of each library star at V = 0, shape (m,), by direct integration (thesis eq.
    3.1).

    Raises InputError as `tabulate_pickles` does.
    """
    efficiency, transmission = optics.quantum_efficiency, optics.transmission
    _check_range(library, optics)
    nodes_nm, weight_m = integration_nodes(efficiency, transmission, _knots(library))
    electrons_per_j = nodes_nm * 1e-9 / (PLANCK_J_S * LIGHT_M_S)
    response = efficiency(nodes_nm) * transmission(nodes_nm) * electrons_per_j * weight_m
    johnson_v = load_curve("johnson-v", "johnson-v")
    v_mean = band_mean(library, johnson_v, photometry.weighting)
    dilution = reference_mean_w_m2_m(photometry) / v_mean
    detected = library.flux @ _onto_grid(library.wavelength_nm, nodes_nm, response)
    rate = optics.area_m2 * dilution * detected
    if not (rate > 0).all():
        raise InputError(
            'tracker: a star of the Pickles library gives no electron; write spectrum = "blackbody"'
        )
    return np.asarray(rate)


def band_mean(library: Library, passband: Curve, weighting: Weighting = "energy") -> FloatArray:
    """Mean relative F_lambda of each library star through a passband, shape (m,) (thesis eq.
    3.11).
    """
    nodes_nm, weight_m = integration_nodes(passband, _knots(library))
    response = passband(nodes_nm) * weight_m
    if weighting == "photon":
        response = response * nodes_nm
    weights = _onto_grid(library.wavelength_nm, nodes_nm, response)
    return np.asarray(library.flux @ weights / response.sum())


def fit_table(bv_mag: FloatArray, vi_mag: FloatArray, electrons_per_s: FloatArray) -> PicklesTable:
    """Fit the table to stars of V = 0 by least squares in ln(rate); all arrays have shape (m,)."""
    log_rate = np.log(electrons_per_s)
    vi_knots_mag = _knots_at_equal_shares(vi_mag, VI_KNOT_COUNT)
    bv_range_mag = float(bv_mag.min()), MAX_BV_TERM_MAG
    bv_term_mag = np.clip(bv_mag, *bv_range_mag)
    design = np.column_stack([natural_basis(vi_mag, vi_knots_mag), bv_term_mag])
    *over_vi, per_bv = np.linalg.lstsq(design, log_rate)[0]
    plain = vi_mag < MAX_BV_FIT_VI_MAG
    bv_knots_mag = _knots_at_equal_shares(bv_mag[plain], BV_KNOT_COUNT)
    bv_design = natural_basis(bv_mag[plain], bv_knots_mag)
    over_bv = np.array(np.linalg.lstsq(bv_design, log_rate[plain])[0], dtype=np.float64)
    return PicklesTable(
        over_vi=Spline(vi_knots_mag, np.array(over_vi)),
        per_bv=float(per_bv),
        bv_range_mag=bv_range_mag,
        over_bv=Spline(bv_knots_mag, over_bv),
    )


def natural_basis(colour_mag: FloatArray, knots_mag: FloatArray) -> FloatArray:
    """Basis of the natural cubic splines, shape (n, knots) (Hastie et al. 2009, eq. 5.4),
    colours held to the knots' range.
    """
    x = np.clip(colour_mag, knots_mag[0], knots_mag[-1])[:, None]
    # The last knot's own cubic is 0 up to it.
    cubic = np.maximum(x - knots_mag[:-1], 0) ** 3
    d = cubic / (knots_mag[-1] - knots_mag[:-1])
    return np.hstack([np.ones_like(x), x, d[:, :-1] - d[:, -1:]])


def _knots_at_equal_shares(colour_mag: FloatArray, count: int) -> FloatArray:
    """Quantiles, bit for bit NumPy's, whose own import `numpy.ma`: that takes 10 ms."""
    places = np.linspace(0, 1, count) * (len(colour_mag) - 1)
    whole, part = np.divmod(places, 1)
    lower = whole.astype(np.intp)
    upper = np.ceil(whole + part).astype(np.intp)
    rising_mag = np.sort(colour_mag)
    low, high = rising_mag[lower], rising_mag[upper]
    from_low = low + (high - low) * part
    from_high = high - (high - low) * (1 - part)
    return np.asarray(np.where(part < 0.5, from_low, from_high))


def _knots(library: Library) -> Curve:
    """The library's samples as knots, so that its straight lines are integrated exactly."""
    return Curve(library.wavelength_nm, np.zeros_like(library.wavelength_nm))


def _onto_grid(grid_nm: FloatArray, nodes_nm: FloatArray, response: FloatArray) -> FloatArray:
    """Weights on the samples that integrate the straight lines between them as `response` does
    at the nodes.
    """
    interval = np.searchsorted(grid_nm, nodes_nm, side="right") - 1
    lower_node = np.clip(interval, 0, len(grid_nm) - 2)
    share = (nodes_nm - grid_nm[lower_node]) / (grid_nm[lower_node + 1] - grid_nm[lower_node])
    weights = np.bincount(lower_node, response * (1 - share), len(grid_nm))
    return np.asarray(weights + np.bincount(lower_node + 1, response * share, len(grid_nm)))


def _check_range(library: Library, optics: Optics) -> None:
    nodes_nm, _ = integration_nodes(optics.quantum_efficiency, optics.transmission)
    low_nm = library.wavelength_nm[0]
    high_nm = library.wavelength_nm[-1]
    seen_nm = nodes_nm[optics.quantum_efficiency(nodes_nm) * optics.transmission(nodes_nm) > 0]
    if len(seen_nm) and (seen_nm[0] < low_nm or seen_nm[-1] > high_nm):
        raise InputError(
            f"tracker: detects {seen_nm[0]:.0f} to {seen_nm[-1]:.0f} nm, and the Pickles spectra"
            f" run from {low_nm:g} to "
            f'{high_nm:g} nm; write spectrum = "blackbody", or cut the quantum efficiency'
        )
