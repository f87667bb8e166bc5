"""What is said of the orbit and the bodies of a bench: elements of another week, and discs."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.server.bench.bench_file import at_moment, read_bench_file
from hilstar.server.bench.moving_sky import orbit_file, satellite_lines, wide_bodies
from hilstar.server.bench.star_light import bench_moving
from tests.support.benches import bench_text
from tests.support.satellites import some_orbits
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


@pytest.mark.parametrize(("day", "old"), [("2008-09-20", False), ("2008-12-31", True)])
def test_elements_of_a_sky_in_unix_time_are_as_old_as_at_the_day_of_its_stars(
    tmp_path, caplog, rng, day, old
):
    """The station's and the satellites' are of 2008-09-20. Of three satellites the table has two,
    and two more that are none of them.
    """
    (tmp_path / "station.tle").write_text(STATION_TLE)
    (tmp_path / "tles.txt").write_text(some_orbits(rng, 3))
    (tmp_path / "seen.csv").write_text("norad,standard_mag\n10000,3\n10002,4\n5,6\n7,8\n")
    path = tmp_path / "bench.toml"
    more = {
        "sky": {"epoch_utc": "unix"},
        "sky.bodies": {"satellites": "tles.txt", "satellite_magnitudes": "seen.csv"},
        "spacecraft": {"orbit": "station.tle"},
    }
    path.write_text(bench_text(more))
    file = at_moment(read_bench_file(path), utc_ns(day))
    sky = bench_moving(file.config, file.folder)
    told = [record.getMessage() for record in caplog.records]
    assert sum("station.tle: its elements are 10" in line for line in told) == old
    assert sum("tles.txt: the elements of 3 of 3 satellites" in line for line in told) == old
    assert len(told) == 2 * old
    (line,) = satellite_lines(sky, utc_ns(day))
    assert line == (
        "satellites: 3 of 3 have a place by their elements; 2 are in [sky.bodies]"
        " satellite_magnitudes"
    )


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
