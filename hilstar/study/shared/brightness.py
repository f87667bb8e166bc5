"""The tracker that the studies of brightness share, and the error of a spectrum that is told from a star's colours."""

from __future__ import annotations

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.sky.electrons import Optics, fit_table, load_library
from hilstar.sky.spectrum import load_curve

APERTURE_MM = 30.0
GLASS = "n-bk7-10mm"
MAX_RELIABLE_VI_MAG = 2.5


def study_optics(sensor: str) -> Optics:
    """A sensor behind an aperture of 30 mm and 10 mm of N-BK7."""
    return Optics(APERTURE_MM, load_curve(sensor, sensor), load_curve(GLASS, GLASS))


def held_out_errors(rates: FloatArray) -> FloatArray:
    """Relative error (m,) of each library star's rate by a table fitted to the others, each star held out in turn."""
    library = load_library()
    errors = np.empty(len(rates))
    for k in range(len(rates)):
        rest = np.arange(len(rates)) != k
        table = fit_table(library.bv_mag[rest], library.vi_mag[rest], rates[rest])
        one = table.electrons_per_s(np.zeros(1), library.bv_mag[k : k + 1], library.vi_mag[k : k + 1])
        errors[k] = one[0] / rates[k] - 1
    return errors
