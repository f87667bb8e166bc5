"""From a catalogue's own passbands to Johnson V, B-V and Cousins V-I, by published relations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial.polynomial import polyval

from hilstar.arrays import FloatArray
from hilstar.sky.catalog import load_catalog

# BT - VT to V - VT, and to (B - V) - (BT - VT) in the blue and in the red: Mamajek, Meyer and Liebert 2002, AJ 124, 1670,
# appendix C, with the sign of the erratum (2006, AJ 131, 2360). For -0.25 < BT - VT < 2; beyond, the offsets of the ends.
TYCHO_RANGE_MAG, TYCHO_RED_MAG = (-0.25, 2.0), 0.5
V_FROM_VT = (9.7e-4, -0.1334, 0.05486, -0.01998)
BV_BLUE, BV_RED = (-0.006, -0.1069, 0.1459), (0.0, -0.007813, -0.1489, 0.03384)

# BP - RP to G - V and to G - I: Riello et al. 2021, A&A 649, A3, table C.2 (Gaia DR3 documentation, table 5.9), scatter 0.030
# and 0.038 mag, for -0.5 < BP - RP < 4.5; beyond, the values of the ends.
GAIA_RANGE_MAG = (-0.5, 4.5)
G_LESS_V = (-0.02704, 0.01424, -0.2156, 0.01426)
G_LESS_I = (0.01753, 0.76, -0.0991)

# V - I to B - V: the median of Hipparcos' stars in bins of this width and at least so many.
BIN_MAG, MIN_STARS = 0.05, 20


def from_tycho(bt_mag: FloatArray, vt_mag: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Johnson V and B-V, shape (n,), of Tycho's BT and VT."""
    colour = bt_mag - vt_mag
    held = np.clip(colour, *TYCHO_RANGE_MAG)
    offset = np.where(held < TYCHO_RED_MAG, polyval(held, BV_BLUE), polyval(held, BV_RED))
    return vt_mag + polyval(held, V_FROM_VT), colour + offset


def from_gaia(g_mag: FloatArray, bp_rp_mag: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Johnson V and Cousins V-I, shape (n,), of Gaia's G and BP-RP (DR3)."""
    held = np.clip(bp_rp_mag, *GAIA_RANGE_MAG)
    g_less_v = polyval(held, G_LESS_V)
    return g_mag - g_less_v, polyval(held, G_LESS_I) - g_less_v


def bv_from_vi(vi_mag: FloatArray) -> FloatArray:
    """The B-V, shape (n,), that Hipparcos' stars of that V-I have in the median; the colours of its ends beyond them."""
    return np.asarray(np.interp(vi_mag, *_bv_along_vi()))


@cache
def _bv_along_vi() -> tuple[FloatArray, FloatArray]:
    stars = load_catalog()
    known = np.isfinite(stars.vi_mag)
    bv_mag, vi_mag = stars.bv_mag[known], stars.vi_mag[known]
    order = np.argsort(vi_mag, kind="stable")
    bins, start = np.unique(np.round(vi_mag[order] / BIN_MAG), return_index=True)
    parts = zip(bins * BIN_MAG, np.split(bv_mag[order], start[1:]), strict=True)
    full = [(vi, float(np.median(part))) for vi, part in parts if len(part) >= MIN_STARS]
    return np.array([vi for vi, _ in full]), np.array([bv for _, bv in full])


Converted = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class Route:
    """One way from a table's magnitudes to V, B-V and V-I, (n,) each, V-I NaN where it is not known."""

    roles: tuple[str, ...]
    words: str
    convert: Callable[..., Converted]


def _given(v: FloatArray, bv: FloatArray) -> Converted:
    return v, bv, np.full(len(v), np.nan)


def _by_vi(v: FloatArray, vi: FloatArray) -> Converted:
    return v, bv_from_vi(vi), vi


def _by_tycho(vt: FloatArray, bt: FloatArray) -> Converted:
    v, bv = from_tycho(bt, vt)
    return v, bv, np.full(len(v), np.nan)


def _by_gaia(g: FloatArray, bp_rp: FloatArray) -> Converted:
    return _by_vi(*from_gaia(g, bp_rp))


# The best first.
ROUTES = (
    Route(("v_mag", "bv_mag"), "V and B-V as given", _given),
    Route(("v_mag", "vi_mag"), "V and V-I as given, B-V of Hipparcos' stars of that V-I", _by_vi),
    Route(("v_mag", "b_mag"), "B and V as given", lambda v, b: _given(v, b - v)),
    Route(("vt_mag", "bt_mag"), "V and B-V from Tycho's BT and VT (Mamajek et al. 2002)", _by_tycho),
    Route(("g_mag", "bp_rp_mag"), "V and V-I from Gaia's G, BP and RP (Riello et al. 2021)", _by_gaia),
    Route(
        ("g_mag", "bp_mag", "rp_mag"),
        "V and V-I from Gaia's G, BP and RP (Riello et al. 2021)",
        lambda g, bp, rp: _by_gaia(g, bp - rp),
    ),
)
