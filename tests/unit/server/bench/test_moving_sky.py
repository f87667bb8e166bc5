"""What is said of the orbit and the bodies of a bench: elements of another week, and discs."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.server.bench.moving_sky import orbit_file, wide_bodies
from tests.support.skies import STATION_TLE, STATION_UTC, utc_ns

DAY_NS = 86_400 * 10**9


@pytest.mark.parametrize(
    ("days", "told"), [(0.0, ""), (6.9, ""), (-6.9, ""), (9.0, "9 days"), (-9.0, "9 days")]
)
def test_elements_of_another_week_are_told_with_their_age(tmp_path, caplog, days, told):
    """The station's are of 264.51782528, five minutes before the moment."""
    path = tmp_path / "station.tle"
    path.write_text(STATION_TLE)
    orbit_file(path, utc_ns(STATION_UTC) + round(days * DAY_NS), False)
    assert bool(caplog.records) is bool(told)
    assert told in caplog.text


def test_bodies_are_told_from_the_widest_on_with_their_pixels():
    """5 arcsec a pixel."""
    diameters_arcsec = {"Mars": 20.0, "Sun": 1920.0, "Ceres": 0.9, "Earth": 3600.0 * 120}
    moving = SimpleNamespace(diameters_arcsec=lambda t_ns: diameters_arcsec)
    px_per_rad = 180 / np.pi * 3600 / 5
    camera = SimpleNamespace(scales_px_rad=lambda: (0.0, px_per_rad))
    assert wide_bodies(moving, camera) == [
        "Earth: 120.0 deg wide, more than 1000 px of the screen; drawn as a disc",
        "Sun: 1920.0 arcsec wide, 384.00 px of the screen; drawn as a disc",
        "Mars: 20.0 arcsec wide, 4.00 px of the screen; drawn as a disc",
    ]
    assert wide_bodies(None, camera) == []
