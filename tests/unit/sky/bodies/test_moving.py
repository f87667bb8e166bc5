"""Bodies among the stars, at any time: what interpolation costs, what moves and what does not."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from hilstar.basics.errors import InputError, MachineError
from hilstar.basics.units import KM_PER_AU
from hilstar.sky.bodies.kernel import Kernel, Viewpoint, apparent_stars
from hilstar.sky.bodies.moving import BodyLight, MovingSky
from hilstar.sky.bodies.orbit import Geocentre, TleOrbit
from hilstar.sky.stars import Stars
from tests.support.refusals import refusal
from tests.support.skies import ALL_BODIES, STATION_TLE, STATION_UTC, moving_sky, utc_ns
from tests.support.stars import stars_at

ARCSEC = np.pi / (180 * 3600)
UTC = "2026-11-21T00:00:00Z"
HOUR_NS = 3600 * 10**9
GEOCENTRE_ARCSEC = 0.022  # UNSEEN_KM_S is 20.6 mas; measured without it: 0.1 mas
# UNSEEN_KM_S again, and `TleOrbit.step_s`: 5e-3 arcsec/s^2 (2 s)^2 / 8 = 2.5 mas
ORBIT_ARCSEC = 0.024
# a minute of the Moon's phase, 0.07 deg by parallax in a low orbit, at 0.03 to 0.04 mag a degree
MAGNITUDE_MAG = 0.003


def sky_of(names: tuple[str, ...] = ALL_BODIES, utc: str = UTC, **more) -> tuple[object, Stars]:
    moving = moving_sky(utc, names, **more)
    return moving, moving.among(stars_at(np.eye(3), np.ones(3)))


def seen_arcsec(stars: Stars, exact: np.ndarray) -> np.ndarray:
    """How far the bodies of `stars` are from unit vectors, arcsec."""
    seen = stars.directions(np.arange(len(stars)))[-len(stars.bodies) :]
    return np.linalg.norm(seen - exact, axis=1) / ARCSEC


@pytest.mark.parametrize(
    ("orbit", "utc", "limit_arcsec"),
    [(None, UTC, GEOCENTRE_ARCSEC), ("tle", STATION_UTC, ORBIT_ARCSEC)],
)
def test_at_any_time_of_a_day_bodies_are_where_an_ephemeris_of_that_moment_has_them(
    orbit, utc, limit_arcsec, rng
):
    def observer():
        return None if orbit is None else TleOrbit(STATION_TLE, "station.tle")

    moving, stars = sky_of(utc=utc, orbit=observer())
    for t_ns in rng.integers(-24 * HOUR_NS, 24 * HOUR_NS, size=12).tolist():
        seen = moving.seen(stars, t_ns)
        then = moving_sky(utc_ns(utc) + t_ns, orbit=observer())
        assert seen_arcsec(seen, then.sight(0).directions).max() < limit_arcsec
        fresh = then.among(stars_at(np.eye(3), np.ones(3)))
        assert np.abs(stars.v_mag - fresh.v_mag)[-len(ALL_BODIES) :].max() < MAGNITUDE_MAG


@pytest.mark.parametrize(("unix", "leap_s"), [(True, 0), (False, 1)])
def test_past_a_leap_second_a_unix_time_is_that_of_the_date(unix, leap_s):
    """Two days from the eve of 2017, whose last minute had 61 s: in days of 86400 s they end with
    the second day, counted in seconds one before. The Moon moves by half an arcsecond in it.
    """
    eve = utc_ns("2016-12-31T00:00:00Z")
    after_ns = 48 * HOUR_NS
    ones = np.ones(1)
    moon = BodyLight(("Moon",), ones, ones)
    moving = MovingSky(Kernel(), Geocentre(), eve, moon, unix=unix)
    then = moving_sky(eve + after_ns - leap_s * 10**9, ("Moon",))
    off = moving.sight(after_ns).seen_km[1] - then.sight(0).seen_km[1]
    assert np.linalg.norm(off) < 0.1


def test_a_parallax_moves_a_star_away_from_where_the_observer_went_and_none_or_less_does_not():
    """A tenth of an arcsecond, seen from an au beside the line of sight; the Sun is far off."""
    place_km = np.array([KM_PER_AU, 0.0, 0.0])
    view = Viewpoint(place_km, np.zeros(3), from_sun_km=np.array([0.0, 1e9 * KM_PER_AU, 0.0]))
    ahead = np.tile([0.0, 1.0, 0.0], (4, 1))
    seen = apparent_stars(ahead, np.array([100.0, 0.0, -100.0, np.nan]), view)
    assert seen[0, 0] / ARCSEC == pytest.approx(-0.1, rel=1e-9)
    assert (seen[1:, 0] == 0.0).all()


def test_stars_follow_the_observer_s_velocity(rng):
    """In a low orbit it turns by 15 km/s in half an hour: 10 arcsec."""
    vectors = rng.normal(size=(50, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    orbit = TleOrbit(STATION_TLE, "station.tle")
    moving = moving_sky(STATION_UTC, (), orbit=orbit)
    far = np.zeros(50)
    stars = moving.among(stars_at(moving.stars_seen(vectors, far), np.ones(50)))
    later = moving.seen(stars, 46 * 60 * 10**9)
    then = moving_sky(utc_ns(STATION_UTC) + 46 * 60 * 10**9, (), orbit=orbit).stars_seen(
        vectors, far
    )
    order = stars.grid.order
    off = np.linalg.norm(later.directions(np.arange(50)) - then[order], axis=1) / ARCSEC
    assert off.max() < ORBIT_ARCSEC
    assert np.linalg.norm(stars.vectors - then[order], axis=1).max() / ARCSEC > 8


def test_a_moment_gives_the_same_light_whatever_came_before(rng):
    moving, stars = sky_of()
    t_ns = 123_456_789_012_345
    seen = moving.seen(stars, t_ns)
    once = stars.vectors.copy(), stars.electrons_per_s.copy(), seen.velocity_km_s.copy()
    for other in rng.integers(-(10**15), 10**15, size=5).tolist():
        moving.seen(stars, other)
    again = moving.seen(stars, t_ns)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(
            once, (again.vectors, again.electrons_per_s, again.velocity_km_s), strict=True
        )
    )


def test_only_bodies_are_rewritten_and_each_is_found_where_it_is():
    moving, stars = sky_of(("Moon", "Jupiter"))
    assert stars.bodies == ("Moon", "Jupiter")
    fixed = stars.vectors[:3].copy()
    moving.seen(stars, 10 * HOUR_NS)
    assert np.array_equal(stars.vectors[:3], fixed)
    for k, name in ((3, "Moon"), (4, "Jupiter")):
        near = stars.grid.near(stars.vectors[k], np.radians(0.01))
        assert stars.designations(near) == [name]
    numbered = np.flatnonzero(stars.hip)
    assert stars.names(np.append(numbered, (3, 4))) == ["", "", "Moon", "Jupiter"]


@pytest.mark.parametrize("beyond_years", [(100, 200), (-200, -300)])
def test_beyond_the_ephemeris_bodies_stand_still_and_one_line_says_so(caplog, beyond_years):
    moving, stars = sky_of(("Moon",))
    for years in beyond_years:
        moving.seen(stars, years * 31_557_600 * 10**9)
    assert np.isfinite(stars.vectors).all()
    assert len(caplog.records) == 1
    assert "epoch_utc" in caplog.text


def test_a_date_beyond_the_ephemeris_is_refused():
    assert "covers 1899-07-30 to 2053-10-08" in refusal(moving_sky, "2060-01-01T00:00:00Z")


def test_without_the_extra_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "skyfield_data", None)
    with pytest.raises(MachineError, match=r"pip install 'hilstar\[bodies\]'"):
        Kernel()


def test_the_moon_is_half_a_degree_wide():
    moving, _ = sky_of(("Moon", "Jupiter"))
    widths = moving.diameters_arcsec(0)
    assert 29 * 60 < widths["Moon"] < 34 * 60
    assert 30 < widths["Jupiter"] < 50


LINES = STATION_TLE.splitlines()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "not one set of two lines"),
        (LINES[1], "not one set of two lines"),
        ("\n".join(LINES[1:] * 2), "not one set of two lines"),
        ("\n".join((LINES[1], LINES[2] + "7")), "not one set of two lines"),
        (
            "\n".join((LINES[1], LINES[2][:-1] + "8")),
            "element line 2: its digits add up to 7, not 8",
        ),
    ],
)
def test_wrong_elements_are_refused(text, words):
    with pytest.raises(InputError, match=words):
        TleOrbit(text, "station.tle")


def test_an_orbit_that_has_ended_is_refused():
    dragged = LINES[1].replace("-11606-4", " 11606-1")[:-1]
    checksum = sum(int(c) if c.isdigit() else c == "-" for c in dragged) % 10
    orbit = TleOrbit(f"{dragged}{checksum}\n{LINES[2]}", "station.tle")
    with pytest.raises(
        InputError, match=r"station.tle: no orbit at 2009-09-20T00:00:00: .*; give newer elements"
    ):
        moving_sky("2009-09-20T00:00:00Z", orbit=orbit)


@pytest.mark.parametrize(("share", "is_wider"), [(0.99, True), (1.01, False)])
def test_the_discs_are_those_of_bodies_wider_than_asked(share, is_wider):
    moving, _ = sky_of(("Moon",))
    width_rad = moving.diameters_arcsec(0)["Moon"] * ARCSEC
    discs = moving.discs(np.array([0.0, 0.0, 1.0]), np.pi, share * width_rad, 0)
    assert [disc.name for disc in discs] == ["Moon"] * is_wider


def test_discs_have_the_bodies_own_shapes_and_come_nearest_first():
    """Radii at the equator and the poles by the IAU's report (Archinal et al. 2018), km."""
    moving, _ = sky_of(("Saturn", "Moon", "Sun", "Jupiter"))
    discs = moving.discs(np.array([0.0, 0.0, 1.0]), np.pi)
    shapes = [(disc.name, disc.equator_km, disc.polar_km) for disc in discs]
    assert shapes == [
        ("Moon", 1737.4, 1737.4),
        ("Sun", 695_700.0, 695_700.0),
        ("Jupiter", 71_492.0, 66_854.0),
        ("Saturn", 60_268.0, 54_364.0),
    ]
    distances_km = moving.distances_km(0)[[1, 2, 3, 0]]
    assert [disc.distance_km for disc in discs] == pytest.approx(distances_km.tolist(), rel=1e-12)
    assert [disc.lunar_share < 1 for disc in discs] == [True, False, False, False]
