"""The sizes and poles of bodies against the IAU's working group (Archinal et al. 2018, Celest. Mech.
Dyn. Astron. 130:22), whose terms with time are under 0.7 degrees.
"""

from __future__ import annotations

import pytest

from hilstar.sky.bodies.shapes import POLAR_RADII_KM, POLES_DEG, RADII_KM

# Equatorial and polar radius (table 4), km; right ascension and declination of the pole (table 1).
GIANTS = {
    "Jupiter": (71_492, 66_854, 268.056595, 64.495303),
    "Saturn": (60_268, 54_364, 40.589, 83.537),
    "Uranus": (25_559, 24_973, 257.311, -15.175),
    "Neptune": (24_764, 24_341, 299.36, 43.46),
}
ROUND_KM = {"Sun": 695_700, "Moon": 1737.4, "Mercury": 2440.53, "Venus": 6051.8, "Mars": 3396.19}


@pytest.mark.parametrize("name", GIANTS)
def test_a_giant_is_as_flat_and_its_pole_where_the_iau_has_it(name):
    equator_km, pole_km, ra_deg, dec_deg = GIANTS[name]
    assert (RADII_KM[name], POLAR_RADII_KM[name]) == (equator_km, pole_km)
    assert POLES_DEG[name] == pytest.approx((ra_deg, dec_deg), abs=1e-3)


def test_the_other_bodies_are_as_large_as_the_iau_has_them():
    assert {name: RADII_KM[name] for name in ROUND_KM} == ROUND_KM
    assert POLES_DEG.keys() == POLAR_RADII_KM.keys() == GIANTS.keys()
