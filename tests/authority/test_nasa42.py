"""42's inertial frame N about the Earth: its own Earth-fixed positions against ERFA's."""

from __future__ import annotations

import erfa
import numpy as np

from tests.support.claims import holds
from tests.support.sources.nasa42 import BEGIN_NS, report

DAY_2024_04_08 = 2_460_408.5
TT_MINUS_UTC_S = 37 + 32.184
SECONDS_PER_DAY = 86_400
# Precession since J2000 is 1220 arcsec in 2024: an N of date would be off by about as much.
OF_DATE_ARCSEC = 1000.0


def angle_arcsec(a, b) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)) * 3600)


def test_n_is_the_equator_and_equinox_of_j2000_and_not_of_date():
    for t_ns, row in report().items():
        utc = (t_ns - BEGIN_NS) / 1e9 / SECONDS_PER_DAY
        tt = utc + TT_MINUS_UTC_S / SECONDS_PER_DAY
        to_earth = erfa.c2t06a(DAY_2024_04_08, tt, DAY_2024_04_08, utc, 0.0, 0.0)
        of_date = erfa.pmat06(DAY_2024_04_08, tt)
        # 42's precession, nutation and sidereal time are of 1980 and take UT1 for UTC; PosN has
        # seven digits.
        holds("nasa42-axes", angle_arcsec(to_earth @ row["posn_m"], row["posw_m"]))
        assert angle_arcsec(to_earth @ of_date.T @ row["posn_m"], row["posw_m"]) > OF_DATE_ARCSEC
