"""Constellations against those of Astropy (Roman 1987), over the whole sky."""

from __future__ import annotations

import numpy as np
from astropy.coordinates import SkyCoord, get_constellation

from hilstar.basics.rotation import direction_of
from hilstar.sky.constellations import constellation_of

PLACES = 3000
# Astropy precesses by way of the geocentre, with aberration: 20.5 arcsec. Places so near to a
# boundary may be across it.
NEAR_DEG = 2 * 20.5 / 3600
STEPS = [(a * NEAR_DEG, b * NEAR_DEG) for a in (-1, 0, 1) for b in (-1, 0, 1)]


def test_constellations_are_those_of_astropy():
    rng = np.random.default_rng(1)
    ra_deg, dec_deg = rng.uniform(0, 360, PLACES), np.degrees(np.arcsin(rng.uniform(-1, 1, PLACES)))
    named = get_constellation(SkyCoord(ra_deg, dec_deg, unit="deg"))
    expected = [name.strip() for name in named.tolist()]
    found = [
        constellation_of(direction_of(ra, dec)) for ra, dec in zip(ra_deg, dec_deg, strict=True)
    ]
    others = [k for k in range(PLACES) if found[k] != expected[k]]
    assert len(others) < PLACES // 100
    for k in others:
        across = [
            (ra_deg[k] + a / np.cos(np.radians(dec_deg[k])), dec_deg[k] + b) for a, b in STEPS
        ]
        assert expected[k] in {constellation_of(direction_of(*place)) for place in across}
