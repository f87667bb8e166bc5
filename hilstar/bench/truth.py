"""The truth of an image: which stars are in it, where, and how bright."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray, IntArray
from hilstar.sky.stars import Stars

TRUTH_DTYPE = np.dtype(
    [
        ("hip", "i4"),
        ("x_px", "f8"),
        ("y_px", "f8"),
        ("v_mag", "f8"),
        ("bv", "f8"),
        ("temperature_k", "f8"),
        ("electrons_per_s", "f8"),
        ("drawn", "?"),
        ("clipped", "?"),
        ("variable", "U1"),
        ("range_mag", "f8"),
        ("period_d", "f8"),
        ("double", "U1"),
        ("separation_arcsec", "f8"),
        ("name", "U32"),
    ]
)


def clipped_in(truth: npt.NDArray[np.void]) -> list[int | str]:
    """What clips in a table of TRUTH_DTYPE: HIP numbers, and names of what has none."""
    rows = truth[truth["clipped"]]
    return [name or hip for name, hip in zip(rows["name"].tolist(), rows["hip"].tolist(), strict=True)]


def truth_table(stars: Stars, star: IntArray, x_px: FloatArray, y_px: FloatArray) -> npt.NDArray[np.void]:
    """Rows of TRUTH_DTYPE for the stars at the indices `star` (n,) of `stars`: all drawn, none clipped yet."""
    truth = np.zeros(len(star), dtype=TRUTH_DTYPE)
    truth["hip"], truth["name"] = stars.hip[star], stars.names(star)
    truth["x_px"], truth["y_px"] = x_px, y_px
    truth["v_mag"], truth["bv"] = stars.v_mag[star], stars.bv_mag[star]
    truth["temperature_k"] = stars.temperature_k[star]
    truth["electrons_per_s"] = stars.electrons_per_s[star]
    truth["drawn"] = True
    listed = stars.row[star] >= 0
    row, catalog = stars.row[star[listed]], stars.catalog
    truth["variable"][listed], truth["double"][listed] = catalog.variable[row], catalog.multiple[row]
    for name in ("range_mag", "period_d", "separation_arcsec"):
        truth[name] = np.nan
        # Back to the catalogue's decimals from float32.
        truth[name][listed] = np.round(getattr(catalog, name)[row].astype(np.float64), 3)
    return truth
