"""Electron rates by MK type and colour: what a star's type says of its spectrum beyond its colour.

A giant and a dwarf of one V-I differ, and no colour that Hipparcos has tells an M8 giant from a
reddened M6. The logarithm of a V = 0 star's rate is interpolated over subclass, luminosity class
and V-I between the library's spectra, bare and behind dust.
"""

import re
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import flux_ratio, magnitude
from hilstar.sky import electrons
from hilstar.sky.catalog import Catalog
from hilstar.sky.facts import facts_of
from hilstar.sky.spectrum import DATA_DIR, read_curve_csv

LETTERS = "OBAFGKM"
TYPE = re.compile(rf"([{LETTERS}])(\d(?:\.\d)?)?(?:[/-]?([{LETTERS}]?)(\d(?:\.\d)?))?")
# after the temperature subclass
CLASS = re.compile(r"(?<![IV])(Iab|Ia\+?|Ib|III|II|IV|I|V)(?![IV])")
CLASSES = {"V": 5.0, "IV": 4.0, "III": 3.0, "II": 2.0}  # the others are supergiants: 1
# Absolute V between dwarfs and giants by subclass (20 is A0), and of supergiants, for types without
# a class. Measured on the catalogue's stars that have both: 99 % of K and M giants to V = 7.5 are
# told right, 95 % of G (tests/authority/test_mk.py).
GIANT_SUBCLASS = (10, 15, 20, 25, 30, 35, 40, 45, 50, 60)
GIANT_MAG = (-3.1, -1.6, -0.75, 0.0, 0.9, 1.5, 2.2, 2.8, 3.5, 4.0)
SUPERGIANT_MAG = -4.5
# a parallax counts as no smaller than this: a star is bright for its distance, or near
MIN_PARALLAX_SIGMAS = 2.0

# Mean extinction of the Galaxy, A/E(B-V) at 1/micrometre: Fitzpatrick 1999 (PASP 111, 63), table 3,
# R = 3.1, a cubic spline.
DUST_PER_UM = (0.0, 0.377, 0.820, 1.667, 1.828, 2.141, 2.433, 3.704, 3.846)
DUST_MAG = (0.0, 0.265, 0.829, 2.688, 3.055, 3.806, 4.315, 6.265, 6.591)
# the reddened copies have it; rates from 0 to 0.8 are interpolated between them and the bare
# spectra
DUST_EBV_MAG = 0.5

# Lengths over which the rates' departures from the trend are alike, in subclasses and classes, and
# in V-I; what a type's departure has for every V-I; the noise of a library star, in units of the
# departures of early types; how much more those of late M stars are, rising over these subclasses.
# Fitted to held-out spectra on four sensors, and rounded.
TYPE_LENGTHS = (10.0, 2.7)
COLOUR_LENGTH_MAG = 1.2
ANY_COLOUR = 0.3
NOISE = 0.13
LATE_SUBCLASS = (55.0, 65.0)
LATE_EXTRA = 1.5
TREND_DEGREE = 3  # of the polynomial in V-I that the rates' logarithms depart from
BLOCK_STARS = 4000  # evaluated at once, which bounds the memory


def luminosity_class(spectral_type: npt.NDArray[np.bytes_]) -> npt.NDArray[np.str_]:
    """The luminosity class in MK types (n,), such as "III" or "Ib": the first where two are
    given, "" where none is.
    """
    classes: list[str] = []
    for text in spectral_type.tolist():
        match = CLASS.search(text.decode())
        classes.append("" if match is None else match[1])
    return np.array(classes, dtype=np.str_)


def read_types(spectral_type: npt.NDArray[np.bytes_]) -> FloatArray:
    """Subclass (0 is O0, 60 is M0) and luminosity class (1 supergiant to 5 dwarf) in MK types (n,),
    shape (n, 2).

    The mean where two are given, NaN for what is not there. A letter without a number has the
    middle of its ten.
    """
    texts, which = np.unique(spectral_type, return_inverse=True)
    types = [_read(text.decode()) for text in texts.tolist()]
    return np.array(types).reshape(-1, 2)[which]


def _read(text: str) -> tuple[float, float]:
    """Subclass and luminosity class of a type; NaN for what is not there."""
    type_match = TYPE.match(text)
    if type_match is None:
        return np.nan, np.nan
    letter, first, other, second = type_match.groups()
    subclasses = [_subclass(letter, first or "5")]
    if first and second:
        subclasses.append(_subclass(other or letter, second))
    subclass = float(np.mean(subclasses))
    without_companion = text.partition("+")[0]
    classes = [CLASSES.get(name, 1.0) for name in CLASS.findall(without_companion)]
    if not classes:
        return subclass, np.nan
    return subclass, float(np.mean(classes))


def _subclass(letter: str, digits: str) -> float:
    """A type's place in the row of all, ten to a letter: A0 is 20."""
    return 10.0 * LETTERS.index(letter) + float(digits)


def star_types(catalog: Catalog) -> FloatArray:
    """Subclass and luminosity class of a catalogue's stars, (n, 2), NaN where their type is none of
    O to M.

    By absolute magnitude, without extinction, where the type has no class; NaN too without a
    parallax.
    """
    facts = facts_of(catalog.hip)
    kind = read_types(facts["spectral_type"])
    least_mas = MIN_PARALLAX_SIGMAS * facts["sigma_parallax_mas"]
    parallax_mas = np.maximum(catalog.parallax_mas, least_mas)
    parallax_mas = np.where(parallax_mas > 0, parallax_mas, np.nan)
    absolute_mag = catalog.v_mag - 10 + 5 * np.log10(parallax_mas)
    dwarf = absolute_mag > np.interp(kind[:, 0], GIANT_SUBCLASS, GIANT_MAG)
    evolved = np.where(absolute_mag < SUPERGIANT_MAG, 1.0, CLASSES["III"])
    by_mag = np.where(dwarf, CLASSES["V"], evolved)
    by_mag[np.isnan(absolute_mag)] = np.nan
    kind[:, 1] = np.where(np.isnan(kind[:, 1]), by_mag, kind[:, 1])
    return kind


@cache
def bare_and_dusty() -> electrons.Library:
    """The library (m stars), and after it the same stars behind dust of DUST_EBV_MAG, whose B-V
    is still that without dust.
    """
    from scipy.interpolate import CubicSpline  # which a bench without types need not load

    bare = electrons.load_library()
    wavelength_nm = bare.wavelength_nm
    curve = CubicSpline(DUST_PER_UM, DUST_MAG, bc_type="natural")
    extinction_mag = DUST_EBV_MAG * curve(1000.0 / wavelength_nm)
    flux = bare.flux * flux_ratio(extinction_mag)
    behind = replace(bare, flux=flux)
    v = read_curve_csv(DATA_DIR / "johnson-v.csv")
    i = read_curve_csv(DATA_DIR / "bessell-i.csv")
    light = electrons.band_mean(behind, v)
    dusty_vi_mag = magnitude(light / electrons.band_mean(behind, i))
    bare_vi_mag = magnitude(electrons.band_mean(bare, v) / electrons.band_mean(bare, i))
    reddening_mag = dusty_vi_mag - bare_vi_mag
    return electrons.Library(
        wavelength_nm=wavelength_nm,
        flux=np.concatenate([bare.flux, flux / light[:, None]]),
        spectral_type=bare.spectral_type * 2,
        bv_mag=np.tile(bare.bv_mag, 2),
        vi_mag=np.concatenate([bare.vi_mag, bare.vi_mag + reddening_mag]),
    )


@dataclass(frozen=True, slots=True)
class TypeTable:
    """Electrons per second of a V = 0 star against its type and V-I, made once per bench.

    ln(rate) is a polynomial `trend` of V-I, and `weight` (k,) times the covariances with the
    `spectra` (k, 3): subclass, class and V-I (universal kriging). Without type or V-I it is that of
    `by_colour`.
    """

    by_colour: electrons.PicklesTable
    trend: FloatArray
    spectra: FloatArray
    weight: FloatArray

    def electrons_per_s(
        self,
        v_mag: FloatArray,
        bv_mag: FloatArray,
        vi_mag: FloatArray,
        kind: FloatArray | None = None,
    ) -> FloatArray:
        """Electron rates of stars (n,) of `kind` (n, 2) as `star_types` gives it.

        A V-I beyond those of the spectra, dusty ones too, counts as their end.
        """
        rate = self.by_colour.electrons_per_s(v_mag, bv_mag, vi_mag)
        if kind is None:
            return rate
        has_type = np.isfinite(kind).all(axis=1)
        known = np.flatnonzero(has_type & np.isfinite(vi_mag))
        kinds, which = np.unique(kind[known], axis=0, return_inverse=True)
        weight = self.weight * _alike_types(kinds, self.spectra)
        library_vi_mag = self.spectra[:, 2]
        vi_mag = np.clip(vi_mag[known], library_vi_mag.min(), library_vi_mag.max())
        for begin in range(0, len(known), BLOCK_STARS):
            part = slice(begin, begin + BLOCK_STARS)
            star = known[part]
            alike = _alike_colours(vi_mag[part], library_vi_mag)
            departure = np.einsum("nk,nk->n", weight[which[part]], alike)
            log_rate = departure + _trend(vi_mag[part]) @ self.trend
            rate[star] = flux_ratio(v_mag[star]) * np.exp(log_rate)
        return rate


def _alike_types(kind: FloatArray, other: FloatArray) -> FloatArray:
    """The part of the covariance of ln(rate) that types have, between (n, 2 or more) and (k, 2
    or more), shape (n, k).
    """
    subclass_length, class_length = TYPE_LENGTHS
    subclass = kind[:, 0]
    other_subclass = other[:, 0]
    late = 1 + LATE_EXTRA * np.interp(subclass, LATE_SUBCLASS, (0.0, 1.0))
    other_late = 1 + LATE_EXTRA * np.interp(other_subclass, LATE_SUBCLASS, (0.0, 1.0))
    subclass_apart = (subclass[:, None] - other_subclass) / subclass_length
    class_apart = (kind[:, 1, None] - other[:, 1]) / class_length
    apart = subclass_apart**2 + class_apart**2
    return np.asarray(late[:, None] * other_late * np.exp(-apart / 2))


def _alike_colours(vi_mag: FloatArray, other_mag: FloatArray) -> FloatArray:
    """The part that V-I (n,) and (k,) have, shape (n, k)."""
    apart = (vi_mag[:, None] - other_mag) / COLOUR_LENGTH_MAG
    return np.asarray(np.exp(-(apart**2) / 2) + ANY_COLOUR)


def _trend(vi_mag: FloatArray) -> FloatArray:
    """The powers (n, TREND_DEGREE + 1) of V-I, the highest first."""
    return np.vander(vi_mag, TREND_DEGREE + 1)


def fit_types(rate: FloatArray) -> TypeTable:
    """Fit the table to the rates of the spectra of `bare_and_dusty`, or to anything else of them
    above zero, shape (m,).
    """
    library = bare_and_dusty()
    kind = read_types(np.array(library.spectral_type, dtype=np.bytes_))
    return fit_spectra(kind, library, rate)


def fit_spectra(kind: FloatArray, library: electrons.Library, rate: FloatArray) -> TypeTable:
    """Fit the table to the rates (m,) of a library's spectra, the first half bare, of `kind` (m,
    2).
    """
    bare = slice(len(rate) // 2)
    covariance = _alike_types(kind, kind) * _alike_colours(library.vi_mag, library.vi_mag)
    covariance[np.diag_indices(len(rate))] += NOISE**2
    trend = _trend(library.vi_mag)
    # The departures' weights are at right angles to the trend.
    terms = TREND_DEGREE + 1
    none = np.zeros((terms, terms))
    system = np.block([[covariance, trend], [trend.T, none]])
    right_side = np.concatenate([np.log(rate), np.zeros(terms)])
    solution = np.linalg.solve(system, right_side)
    weight = solution[: len(rate)]
    coefficients = solution[len(rate) :]
    by_colour = electrons.fit_table(library.bv_mag[bare], library.vi_mag[bare], rate[bare])
    spectra = np.column_stack([kind, library.vi_mag])
    return TypeTable(by_colour, coefficients, spectra, weight)


def tabulate_types(optics: electrons.Optics, photometry: electrons.Photometry) -> TypeTable:
    """The rate table of a bench. Raises InputError as `tabulate_pickles` does."""
    rate = electrons.library_electrons_per_s(bare_and_dusty(), optics, photometry)
    return fit_types(rate)


def class_shares(optics: electrons.Optics, from_nm: float) -> dict[str, float]:
    """The share of a star's electrons that is light from a wavelength on, by spectral class: the
    mean of the library's stars.

    Light beyond the library's 250 to 1600 nm counts for nothing.
    """
    library = electrons.load_library()
    nm = library.wavelength_nm
    photons = library.flux * nm
    detected = photons * optics.quantum_efficiency(nm) * optics.transmission(nm)
    total = np.maximum(detected.sum(axis=1), np.finfo(np.float64).tiny)
    beyond = detected[:, nm >= from_nm].sum(axis=1)
    shares = beyond / total
    classes = np.array([kind[0] for kind in library.spectral_type])
    by_class = {}
    for letter in LETTERS:
        by_class[letter] = float(shares[classes == letter].mean())
    return by_class
