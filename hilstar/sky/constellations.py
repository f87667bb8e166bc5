"""The constellation in which a place of the sky lies, by the boundaries of the International
Astronomical Union.
"""

import csv
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hilstar.basics.arrays import FloatArray

ZONES = Path(__file__).resolve().parent / "data" / "constellations.csv"
# ICRS components into those of the mean equator and equinox B1875, in which the boundaries were
# drawn (Delporte 1930): Astropy 7, `FK5(equinox="B1875")`.
ICRS_TO_B1875 = np.array(
    [
        [0.9995359306781646, 0.027935194957718956, 0.01214694060282576],
        [-0.027935194678749248, 0.9996097218871833, -0.0001697259184641279],
        [-0.012146941244392463, -0.00016967999661910625, 0.9999262087909806],
    ]
)


class _Zone(NamedTuple):
    from_h: float
    to_h: float
    lowest_deg: float
    name: str


@cache
def _zones() -> tuple[_Zone, ...]:
    """The zones of Roman's table."""
    with ZONES.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(line for line in file if not line.startswith("#"))
        zones = []
        for row in rows:
            from_h, to_h = float(row["from_h"]), float(row["to_h"])
            zones.append(_Zone(from_h, to_h, float(row["lowest_deg"]), row["name"]))
        return tuple(zones)


def constellation_of(direction_icrs: FloatArray) -> str:
    """The name of the constellation in which a direction (3,), a unit vector, lies (Roman 1987)."""
    x, y, z = (ICRS_TO_B1875 @ direction_icrs).tolist()
    hours = float(np.degrees(np.arctan2(y, x)) % 360) / 15
    dec_deg = float(np.degrees(np.arctan2(z, np.hypot(x, y))))
    zones = _zones()
    for zone in zones:
        if zone.from_h <= hours < zone.to_h and dec_deg >= zone.lowest_deg:
            return zone.name
    # the south polar cap, below the lowest of all
    return zones[-1].name
