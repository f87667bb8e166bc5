"""What is said of the orbit and the bodies of a bench: elements of another week, and discs."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.server.bench.bench_file import at_moment, read_bench_file
from hilstar.server.bench.moving_sky import orbit_file, satellite_lines, wide_bodies
from hilstar.server.bench.star_light import bench_moving, bench_stars
from hilstar.sky.stars import unit_vectors_icrs
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


def test_a_near_star_is_seen_from_where_the_observer_is(tmp_path):
    """By its parallax times what of the Earth's place, 0.98 to 1.02 AU, lies across it."""
    path = tmp_path / "bench.toml"
    sky = {"epoch_utc": "2026-03-20T12:00:00", "faintest_v_mag": 2.0}
    path.write_text(bench_text({"sky": sky, "spacecraft": {"orbit": "geocentre"}}))
    file = read_bench_file(path)
    moving = bench_moving(file.config, file.folder)
    stars = bench_stars(file.config, file.folder, moving)
    from_sun = unit_vectors_icrs(stars.catalog, file.config.sky.epoch_jyear)
    far = moving.stars_seen(from_sun, np.zeros(len(from_sun)))
    seen = np.zeros_like(far)
    seen[stars.row] = stars.vectors
    moved_mas = np.linalg.norm(seen - far, axis=1) * ARCSEC_PER_RAD * 1e3
    near = stars.catalog.parallax_mas > 100
    share = moved_mas[near] / stars.catalog.parallax_mas[near]
    assert near.sum() > 5 and share.max() < 1.021 and np.median(share) > 0.5


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
