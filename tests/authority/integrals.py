"""Integrals over tabulated curves by adaptive quadrature: written anew, and not with hilstar's."""

from __future__ import annotations

import csv
from itertools import pairwise

import numpy as np
from scipy.integrate import quad

from hilstar.sky.spectrum import DATA_DIR


def read(name: str) -> tuple[np.ndarray, np.ndarray]:
    """The columns of one of hilstar's data files."""
    rows = [
        row
        for row in csv.reader((DATA_DIR / f"{name}.csv").read_text().splitlines())
        if row[0][0].isdigit()
    ]
    return np.array(rows, dtype=float).T


def integral(function, knots_nm: np.ndarray) -> float:
    """Adaptive quadrature over wavelength in nm, between knots."""
    return sum(quad(function, a, b, epsabs=0, epsrel=1e-10)[0] for a, b in pairwise(knots_nm))


def v_mean(spectrum, weighting: str) -> float:
    """The mean of a spectrum through Johnson V."""
    knots, response = read("johnson-v")
    power = 1 if weighting == "photon" else 0

    def r(w: float) -> float:
        return float(np.interp(w, knots, response)) * w**power

    return integral(lambda w: spectrum(w) * r(w), knots) / integral(r, knots)
