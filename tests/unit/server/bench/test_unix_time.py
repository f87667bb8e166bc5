"""t_ns as Unix time: the same sky as by its UTC, whatever leap seconds there were since 1970."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from astropy.time import Time

from hilstar.basics.errors import InputError
from hilstar.server.bench.bench_file import at_moment, dated, read_bench_file
from hilstar.server.bench.config import parse_config
from hilstar.server.bench.config.bench_config import with_dates
from hilstar.server.bench.star_light import bench_moving
from tests.support.benches import bench_text
from tests.support.satellites import some_orbits
from tests.support.skies import STATION_TLE, moving_sky, utc_ns

ARCSEC = np.pi / (180 * 3600)
DAY_NS = 86_400 * 10**9
MOON = {
    "sky": {"epoch_utc": "unix"},
    "sky.bodies": {"moon": True},
    "spacecraft": {"orbit": "geocentre"},
}
# Cubics of three hours are within 0.1 mas; the start's and another observer's aberration add 2e-9
# of their 20 arcsec.
LIMIT_ARCSEC = 5e-3
LEAP = "2017-01-01T00:00:00"  # a second after 2016-12-31T23:59:60


@pytest.fixture
def moon_file(tmp_path) -> Path:
    path = tmp_path / "bench.toml"
    path.write_text(bench_text(MOON))
    return path


def moon_km(sky, t_ns: int) -> np.ndarray:
    """From the Earth, km, geometric but for light time: no aberration, which is that of the
    start of each sky.
    """
    return sky._seen_from(sky._moment(t_ns, None, None)).seen_km[-1]


@pytest.mark.parametrize(
    "started", ["2016-12-31T09:00:00", "2017-01-01T09:00:00", "2016-12-01T09:00:00"]
)
@pytest.mark.parametrize(
    "utc",
    ["2016-12-31T12:00:00", "2016-12-31T23:59:59.5", LEAP, "2017-01-01T02:00:00.25", "2017-01-20"],
)
def test_before_and_after_a_leap_second_the_moon_is_where_its_utc_has_it(moon_file, started, utc):
    file = dated(read_bench_file(moon_file), None, utc_ns(started))
    sky = bench_moving(file.config, file.folder)
    there, wanted = moon_km(sky, utc_ns(utc)), moon_km(moving_sky(utc_ns(utc), ("Moon",)), 0)
    assert np.linalg.norm(there - wanted) / np.linalg.norm(wanted) < LIMIT_ARCSEC * ARCSEC


def test_a_second_that_unix_time_leaves_out_moves_the_moon_on(moon_file):
    """Half a second before it and half a second after: two seconds; counted on from 1970 it
    would be late by 29.
    """
    file = dated(read_bench_file(moon_file), None, utc_ns(LEAP) - DAY_NS)
    sky, zero = bench_moving(file.config, file.folder), utc_ns(LEAP)
    half = 500_000_000

    def moved_arcsec(begin_ns: int, end_ns: int) -> float:
        a, b = (moon_km(sky, t_ns) for t_ns in (begin_ns, end_ns))
        return float(np.linalg.norm(a / np.linalg.norm(a) - b / np.linalg.norm(b)) / ARCSEC)

    plain = moved_arcsec(zero + 10 * half, zero + 12 * half)
    assert moved_arcsec(zero - half, zero + half) == pytest.approx(2 * plain, rel=0.02)
    counted = moving_sky("1970-01-01T00:00:00Z", ("Moon",))
    a, b = moon_km(sky, zero + half), moon_km(counted, zero + half)
    late_s = np.linalg.norm(a / np.linalg.norm(a) - b / np.linalg.norm(b)) / ARCSEC / plain
    # TAI - UTC was 8.000 s in 1970 and is 37 s from 2017 on (IERS)
    assert late_s == pytest.approx(29, abs=0.01)


def test_satellites_are_where_sgp4_has_them_at_that_utc(tmp_path, rng):
    (tmp_path / "tles.txt").write_text(some_orbits(rng, 3))
    (tmp_path / "station.tle").write_text(STATION_TLE)
    path = tmp_path / "bench.toml"
    path.write_text(
        bench_text(
            MOON
            | {
                "sky.bodies": {"satellites": "tles.txt"},
                "spacecraft": {"orbit": "station.tle"},
            }
        )
    )
    now = utc_ns("2008-09-20T12:30:00")
    file = at_moment(read_bench_file(path), now)
    sky = bench_moving(file.config, file.folder)
    assert file.config.sky.epoch_jyear == pytest.approx(2008.72, abs=0.01)
    assert sky.satellites.place(now) == 3


def test_stars_of_a_live_run_are_of_today(moon_file):
    file = read_bench_file(moon_file)
    assert (
        abs(file.config.sky.epoch_jyear - (2000 + (time.time() / 86_400 - 10_957.5) / 365.25))
        < 0.01
    )
    assert at_moment(file, None) is file


def test_the_hash_of_a_bench_file_does_not_change_with_the_day(moon_file, monkeypatch):
    first = read_bench_file(moon_file)
    monkeypatch.setattr(time, "time_ns", lambda: utc_ns("2031-05-05T00:00:00"))
    later = read_bench_file(moon_file)
    assert first.sha256 == later.sha256
    assert later.config.sky.epoch_jyear == pytest.approx(2031.34, abs=0.01)


def test_a_log_in_another_scale_is_refused(moon_file):
    assert dated(read_bench_file(moon_file), "UTC", 10**18).config.sky.epoch_utc == "unix"
    with pytest.raises(InputError, match='"unix": the times of this log are TAI; write "source"'):
        dated(read_bench_file(moon_file), "TAI", 10**18)


def test_a_log_in_utc_may_cross_a_leap_second(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(bench_text(MOON | {"sky": {"epoch_utc": "source"}}))
    file = dated(read_bench_file(path), "UTC", utc_ns("2016-12-31T22:00:00"))
    sky, utc = bench_moving(file.config, file.folder), utc_ns("2017-01-01T01:00:00")
    wanted = moon_km(moving_sky(utc, ("Moon",)), 0)
    assert (
        np.linalg.norm(moon_km(sky, utc) - wanted) / np.linalg.norm(wanted) < LIMIT_ARCSEC * ARCSEC
    )


@pytest.mark.parametrize(
    ("scale", "ahead_s"),
    # by IERS Bulletin C 69: TAI - UTC is 37 s; GPS = TAI - 19 s, TT = TAI + 32.184 s
    [("UTC", 0.0), ("TAI", 37.0), ("GPS", 18.0), ("TT", 69.184), ("TDB", 69.184)],
)
def test_a_log_s_dates_are_utc_by_the_leap_seconds_of_its_day(scale, ahead_s):
    """Stars stand where they are at the beginning of the UTC's day."""
    sky = {"sky": {"epoch_utc": "source"}}
    config = parse_config(Path("bench.toml"), bench_text(sky))
    first_ns = utc_ns("2026-11-21T00:00:30") + round(ahead_s * 1e9)
    for later_ns in (0, DAY_NS // 2):
        dates = with_dates(config, scale, first_ns + later_ns).sky
        zero = 0 if dates.epoch_utc == "unix" else utc_ns(dates.epoch_utc)
        assert zero == -round(ahead_s * 1e9)
        day = Time("2026-11-21", scale="utc").jyear
        assert dates.epoch_jyear == pytest.approx(day, abs=1e-5)  # minutes; TT is 69 s ahead
