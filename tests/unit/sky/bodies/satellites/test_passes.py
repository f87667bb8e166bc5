"""Satellites near an axis: none is missed, all of it depends on the moment alone, and what
cannot be placed is said once.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.sky.bodies.orbit import Geocentre, TleOrbit
from hilstar.sky.bodies.passes import OWN_KM, Cone
from hilstar.sky.bodies.satellites import Swarm, read_satellites, sunlit_share
from hilstar.sky.stars import with_bodies
from tests.support.satellites import (
    V0_E_PER_S,
    element_set,
    satellite_sky,
    some_orbits,
    with_checksum,
)
from tests.support.skies import STATION_TLE, STATION_UTC, utc_ns
from tests.support.stars import stars_at

START = utc_ns(STATION_UTC)
NORTH = np.array([0.0, 0.0, 1.0])
EVERYWHERE = Cone(NORTH, np.pi, 0.0)
S_NS = 10**9
# Measured over three days: 0.24 m in low orbits (the first two kinds of `some_orbits`), 3.2 m in
# the others
LOW_KM, ANY_KM = 4e-4, 5e-3


def test_between_sgp4s_moments_cubics_are_within_half_a_metre_in_low_orbits(rng):
    text = some_orbits(rng, 40)
    swarm = Swarm([one.satrec for one in read_satellites(text, "f", START)])
    lines = text.splitlines()
    sgp4 = [TleOrbit("\n".join(lines[k : k + 3]), "f") for k in range(0, len(lines), 3)]
    for seconds in rng.uniform(0, 86_400, size=20).tolist():
        utc = START + round(seconds * S_NS)
        swarm.move_to(utc)
        exact = np.array([orbit.state(utc)[0] for orbit in sgp4])
        off = np.linalg.norm(swarm.places_km(slice(None), utc) - exact, axis=1).reshape(-1, 5)
        assert off[:, :2].max() < LOW_KM
        assert off.max() < ANY_KM
        cubic = swarm.motion_km(np.arange(40), utc)
        later = cubic[0] + 0.5 * (cubic[1] + 0.5 * (cubic[2] + 0.5 * cubic[3]))
        assert np.allclose(later, swarm.places_km(slice(None), utc, 0.5), rtol=0, atol=1e-9)


def test_the_observer_moves_as_its_orbit_while_an_exposure_lasts(rng):
    """A fall about a point: the Earth's flattening pulls by up to 3 J2 = 0.0033 of that besides."""
    orbit = TleOrbit(STATION_TLE, "station.tle")
    seen = satellite_sky(some_orbits(rng, 5)).passing(EVERYWHERE, 0)
    for seconds in (-10, -3, 3, 10):
        a, b, c, d = seen.observer_km
        place_km = a + seconds * (b + seconds * (c + seconds * d))
        exact_km, _ = orbit.state(START + seconds * S_NS)
        flattening_km = 3.3e-3 * np.linalg.norm(c) * seconds**2
        fourth_order_km = 5e-6
        off_km = np.linalg.norm(place_km - exact_km)
        assert off_km < flattening_km + fourth_order_km


def test_whatever_turns_and_jumps_come_none_in_view_is_missed(rng):
    """Against a look at all of them at each moment; slow turns, jumps of attitude and of time,
    short and long exposures.
    """
    text = some_orbits(rng, 400)
    sky, of_all, t_ns, axis = satellite_sky(text), satellite_sky(text), 0, NORTH
    found = 0
    for step in range(120):
        axis = axis + rng.normal(scale=0.02 if step % 10 else 2.0, size=3)
        axis /= np.linalg.norm(axis)
        t_ns = t_ns + 300_000_000 if step % 15 else int(rng.integers(0, 86_400 * S_NS))
        cone = Cone(axis, 0.2, 0.1 if step % 7 else 1.0, 400.0)
        seen = sky.passing(cone, t_ns)
        near = set() if seen is None else set(seen.index.tolist())
        everything = of_all.passing(EVERYWHERE, t_ns)
        now = np.zeros(len(everything))
        bright = (
            everything.rates_e_per_s(np.arange(len(everything)), now, now) > cone.faintest_e_per_s
        )
        inside = everything.directions(slice(None), now) @ axis > np.cos(cone.radius_rad)
        wanted = set(everything.index[bright & inside].tolist())
        found += len(wanted)
        assert wanted <= near
    assert found > 20


@pytest.mark.parametrize("step_s", [-300, -30])
def test_whichever_way_time_goes_a_fixed_observer_misses_none_along_an_axis(step_s, rng):
    """From the Earth's centre, which is where it was: neither its way nor the axis tells of the
    jump.
    """
    text = some_orbits(rng, 100)
    sky, cone = satellite_sky(text, Geocentre()), Cone(NORTH, 0.3, 0.1)
    of_all = satellite_sky(text, Geocentre())
    found = 0
    for k in range(8):
        t_ns = k * step_s * S_NS
        seen = sky.passing(cone, t_ns)
        near = set() if seen is None else set(seen.index.tolist())
        everything = of_all.passing(EVERYWHERE, t_ns)
        now = np.zeros(len(everything))
        lit = everything.rates_e_per_s(np.arange(len(everything)), now, now) > 0
        inside = everything.directions(slice(None), now) @ NORTH > np.cos(cone.radius_rad)
        wanted = set(everything.index[lit & inside].tolist())
        found += len(wanted)
        assert wanted <= near
    assert found > 5


@pytest.mark.parametrize("leaves", [True, False], ids=["leaves", "enters"])
def test_a_satellite_is_seen_on_the_lit_side_of_a_shadow_s_edge_after_a_look_on_the_other(
    rng, leaves
):
    """Two seconds before it leaves the shadow, or one after it has entered it; what is looked up
    is kept for three.
    """
    text = some_orbits(rng, 5)
    orbit = TleOrbit("\n".join(text.splitlines()[:3]), "f")
    # of the middle of the search: the shadow's edge is known to half a second
    sun_km = satellite_sky(text, Geocentre()).passing(EVERYWHERE, 3000 * S_NS).now.sun_km

    def is_lit(second: int) -> bool:
        place_km = orbit.state(START + second * S_NS)[0]
        return bool(sunlit_share(place_km[None], sun_km)[0] > 0)

    step_s = 30
    begin_s = next(
        second
        for second in range(0, 6000, step_s)
        if is_lit(second) is not leaves and is_lit(second + step_s) is leaves
    )
    edge_s = next(second for second in range(begin_s, 6000) if is_lit(second) is leaves)
    dark_s, lit_s = (edge_s - 2, edge_s + 1) if leaves else (edge_s + 1, edge_s - 2)
    sky = satellite_sky(text, Geocentre())
    cone = Cone(NORTH, np.pi, 0.1)
    for second in (dark_s, lit_s):
        seen = sky.passing(cone, second * S_NS)
        now = np.zeros(len(seen))
        rates = seen.rates_e_per_s(np.arange(len(seen)), now, now)
        assert (0 in seen.index[rates > 0]) is (second == lit_s)


@pytest.mark.parametrize(
    ("fewer", "more"),
    [
        ({"faintest_e_per_s": 1e5}, {"faintest_e_per_s": 0.0}),
        ({"half_s": 0.1}, {"half_s": 200.0}),
        ({"radius_rad": 0.3}, {"radius_rad": 1.2}),
    ],
    ids=["bright and faint", "soon and late", "near and far"],
)
def test_after_a_look_for_few_a_look_for_more_finds_them(rng, fewer, more):
    """As of a frame after an exposure, or the other way round."""
    text = some_orbits(rng, 60)
    sky, cone = satellite_sky(text, Geocentre()), Cone(NORTH, 1.0, 0.1)
    few, many = replace(cone, **fewer), replace(cone, **more)
    found = []
    for one in (few, many, few, many):
        seen = sky.passing(one, 0)
        found.append(set() if seen is None else set(seen.index.tolist()))
    fresh = satellite_sky(text, Geocentre()).passing(many, 0)
    assert found[1] == found[3] == set(fresh.index.tolist())
    assert found[0] == found[2] < found[1]


def test_a_satellite_without_a_place_is_counted_at_each_moment_and_no_other_is():
    """Orbits through the Earth: SGP4 has no place near their perigees (its error 6)."""
    through = [element_set(k, (50.0, 0.0, 0.0, 20.0 * k), 0.6, 9.0) for k in range(1, 10)]
    swarm = Swarm([one.satrec for one in read_satellites("".join(through), "f", START)])
    lost = 0
    for seconds in range(0, 9600, 20):
        utc = START + seconds * S_NS
        swarm.move_to(utc)
        has_none = np.isnan(swarm.places_km(slice(None), utc)).any(axis=1)
        assert ((swarm.error != 0) == has_none).all()
        lost += int(has_none.sum())
    assert 0 < lost < 480 * 9


def test_a_moment_gives_the_same_light_whatever_came_before(rng):
    text = some_orbits(rng, 30)
    sky, t_ns = satellite_sky(text), 1234 * S_NS
    half = np.full(30, 0.05)

    def light(of):
        seen = of.passing(EVERYWHERE, t_ns)
        n = len(seen)
        return (
            seen.index,
            seen.directions(slice(None), half[:n]),
            seen.rates_e_per_s(np.arange(n), -half[:n], half[:n]),
        )

    once = light(sky)
    for other in rng.integers(-(10**14), 10**14, size=5).tolist():
        sky.passing(EVERYWHERE, other)
    assert all(np.array_equal(a, b) for a, b in zip(once, light(sky), strict=True))
    sky.passing(EVERYWHERE, t_ns - 20 * S_NS)  # the step before, from which the next follows
    assert all(np.array_equal(a, b) for a, b in zip(once, light(sky), strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(once, light(satellite_sky(text)), strict=True))


def test_the_observer_itself_is_not_drawn_and_a_line_says_so(caplog):
    """By its number; and by its place, what is docked to it."""
    first, second = STATION_TLE.splitlines()[1:]
    docked = f"MODULE\n{with_checksum(first[:2] + '49044' + first[7:68])}\n{with_checksum(second[:2] + '49044' + second[7:68])}\n"
    ahead = element_set(7, (51.6416, 247.4627, 130.5360, 325.0288 + 3.0), 0.0006703, 15.72125391)
    sky = satellite_sky(f"{STATION_TLE}{docked}{ahead}")
    t_ns = 55 * 60 * S_NS
    for later in (0, 1, 100):
        seen = sky.passing(EVERYWHERE, t_ns + later * S_NS)
        assert seen is None or seen.index.tolist() == [2]
    assert len(caplog.records) == 1
    assert f"within {OWN_KM:g} km" in caplog.text
    assert len(satellite_sky(docked, Geocentre()).passing(EVERYWHERE, t_ns)) == 1


def test_the_observer_s_own_number_is_not_drawn_by_elements_that_place_it_elsewhere(caplog):
    """A list's elements may be weeks older than the bench's: 300 km along the orbit."""
    elsewhere = (51.6416, 247.4627, 130.5360, 325.0288 + 3.0)
    sets = (element_set(number, elsewhere, 0.0006703, 15.72125391) for number in (25544, 7))
    seen = satellite_sky("".join(sets)).passing(EVERYWHERE, 55 * 60 * S_NS)
    assert seen is not None
    assert seen.index.tolist() == [1]
    assert "is the observer itself" in caplog.text


def test_decayed_satellites_are_left_out_with_one_line_and_the_others_stay(rng, caplog):
    """Ones that cannot be, a mean motion of 18 turns a day, among good ones."""
    bad = "".join(
        f"LOST {k}\n" + element_set(50 + k, (51.0, 10.0 * k, 0.0, 0.0), 0.001, 18.0)
        for k in range(3)
    )
    sky = satellite_sky(bad + some_orbits(rng, 5), Geocentre())
    for t_ns in range(0, 200 * S_NS, 7 * S_NS):
        seen = sky.passing(EVERYWHERE, t_ns)
        assert seen is not None
        assert seen.index.min() >= 3
        assert np.isfinite(seen.directions(slice(None), np.zeros(len(seen)))).all()
    assert [record.getMessage()[:60] for record in caplog.records] == [
        "3 of 8 satellites have no place by their elements at this ti"
    ]
    assert "LOST 0" in caplog.text
    assert [sky.satellites_placed(seconds * S_NS) for seconds in (0, 1, 500)] == [5, 5, 5]
    assert satellite_sky(some_orbits(rng, 5)).satellites_placed(0) == 5


@pytest.mark.parametrize("way", [1, -1], ids=["after the elements", "before them"])
def test_elements_of_another_month_are_warned_of_once(caplog, way):
    """At the moment at which they are used, not at that of the start."""
    sky = satellite_sky(some_orbits(np.random.default_rng(1), 4), Geocentre())
    for days in (0, 13, 40, 50, 0):
        sky.passing(EVERYWHERE, way * days * 86_400 * S_NS)
        assert len(caplog.records) == (days >= 40 or bool(caplog.records))
    assert len(caplog.records) == 1
    assert "4 of 4 satellites are more than 14 days from the sky's date (40 at most)" in caplog.text


def test_twenty_thousand_are_read_and_looked_for(rng):
    """The same satellites as one by one, in a list of 20 000."""
    text = some_orbits(rng, 20_000)
    sky = satellite_sky(text)
    seen = sky.passing(Cone(NORTH, 0.2, 0.01), 600 * S_NS)
    lines, few = text.splitlines(), seen.index[:: max(1, len(seen) // 20)]
    alone = satellite_sky(
        "\n".join(line for k in few.tolist() for line in lines[3 * k : 3 * k + 3])
    )
    each = alone.passing(EVERYWHERE, 600 * S_NS)
    names = [alone.satellites.names[k] for k in each.index.tolist()]
    for name, direction in zip(
        names, each.directions(slice(None), np.zeros(len(each))), strict=True
    ):
        (place,) = np.flatnonzero(seen.index == sky.satellites.names.index(name))
        off = np.linalg.norm(seen.directions(np.array([place]), np.zeros(1))[0] - direction)
        assert off < 2e-6  # LOW_KM at 200 km: their steps begin at other moments


def test_an_observer_whose_state_comes_with_the_frame_sees_the_same(rng):
    """The station's own place and velocity, from the Earth's centre."""
    text = some_orbits(rng, 20)
    place, velocity = TleOrbit(STATION_TLE, "station.tle").state(START + 777 * S_NS)
    ours = satellite_sky(text).passing(EVERYWHERE, 777 * S_NS)
    theirs = satellite_sky(text, Geocentre()).passing(EVERYWHERE, 777 * S_NS, velocity, place)
    assert np.array_equal(ours.index, theirs.index)
    which, middle = np.arange(len(ours)), np.zeros(len(ours))
    assert np.array_equal(
        ours.rates_e_per_s(which, middle, middle), theirs.rates_e_per_s(which, middle, middle)
    )
    # none behind the Earth
    assert len(satellite_sky(text, Geocentre()).passing(EVERYWHERE, 777 * S_NS)) > len(ours)


def test_an_observer_that_jumps_misses_none_that_is_near_its_new_place():
    """By 95 km across the line of sight to one at 300 km: 17 degrees, beyond what was looked for."""
    text = element_set(7, (97.0, 252.0, 130.0, 322.0), 0.001, 15.0)
    sky = satellite_sky(text, Geocentre())
    seen = sky.passing(EVERYWHERE, 0)
    assert seen is not None
    place_km = seen.place_km[0, 0]
    up = place_km / np.linalg.norm(place_km)
    across = np.cross(up, NORTH)
    across /= np.linalg.norm(across)
    here_km = place_km + 300.0 * up
    there_km = here_km + 95.0 * across
    axis = place_km - there_km
    cone = Cone(axis / np.linalg.norm(axis), 0.01, 0.0)
    rest = np.zeros(3)
    assert sky.passing(cone, 0, rest, here_km) is None
    found = sky.passing(cone, 0, rest, there_km)
    assert found is not None
    assert found.index.tolist() == [0]
    # and here again, where it is not
    assert sky.passing(cone, 0, rest, here_km) is None


# of two steps of the difference below, 0.05 s: 1e-9 of rounding over 0.1 s, and their squares
RATE_KM_S = 5e-6


def test_a_pass_moves_as_the_passes_of_the_moments_about_it(rng):
    """Where satellites sent what arrives, light time and the Earth's own way included: those that
    come nearer send later. An eccentric one recedes by up to 5 km/s, 1e-4 km/s of its own speed.
    """
    text = some_orbits(rng, 40)
    sky = satellite_sky(text, Geocentre())
    middle_ns, step_ns = 1234 * S_NS, S_NS // 20
    before, seen, after = (sky.passing(EVERYWHERE, middle_ns + k * step_ns) for k in (-1, 0, 1))
    assert before.index.tolist() == seen.index.tolist() == after.index.tolist()
    for cubic in ("seen_km", "place_km"):
        first, middle, last = (getattr(one, cubic) for one in (before, seen, after))
        rate_km_s = (last[0] - first[0]) / (2 * step_ns / S_NS)
        assert np.abs(rate_km_s - middle[1]).max() < RATE_KM_S
    light_s = np.linalg.norm(seen.seen_km[0], axis=1) / 299_792.458
    swarm = Swarm([one.satrec for one in read_satellites(text, "f", START)])
    swarm.move_to(START + middle_ns)
    later_km = swarm.places_km(seen.index, START + middle_ns) - seen.place_km[0]
    assert np.linalg.norm(later_km, axis=1) == pytest.approx(
        np.linalg.norm(seen.place_km[1], axis=1) * light_s, rel=2e-3
    )


def test_what_the_earth_hides_at_a_moment_has_no_light_then(rng):
    """Each a minute before and after a moment: by the height of the line of sight over a round
    Earth, beside the 22 km of its flattening.
    """
    sky = satellite_sky(some_orbits(rng, 60), table="norad\n", utc=STATION_UTC)
    hidden_count = seen_count = 0
    for second in range(0, 6000, 300):
        seen = sky.passing(Cone(NORTH, np.pi, 60.0), second * S_NS)
        every = np.arange(len(seen))
        for after_s in (-60.0, 60.0):
            at = np.full(len(seen), after_s)
            powers = after_s ** np.arange(4)
            observer = np.einsum("k,kx->x", powers, seen.observer_km)
            place = np.einsum("k,knx->nx", powers, seen.place_km)
            way = place - observer
            share = np.clip(-(way @ observer) / np.einsum("ij,ij->i", way, way), 0.0, 1.0)
            height_km = np.linalg.norm(observer + share[:, None] * way, axis=1) - 6378.0
            rates = seen.rates_e_per_s(every, at, at)
            is_hidden = height_km < -25
            assert (rates[is_hidden] == 0).all()
            is_lit = (height_km > 5) & (sunlit_share(place, seen.now.sun_km) == 1)
            assert (rates[is_lit] > 0).all()
            hidden_count += int((is_hidden & (sunlit_share(place, seen.now.sun_km) == 1)).sum())
            seen_count += int(is_lit.sum())
    assert min(hidden_count, seen_count) > 5


def test_light_varies_by_the_time_since_the_sky_s_date_not_since_a_frame():
    """Between 1 + d and 1 - d of the mean, 2 mag apart, largest at 1 s and each 7 s after it."""
    text = element_set(10_000, (97.0, 252.0, 130.0, 322.0), 0.001, 15.0)
    table = "norad,period_s,amplitude_mag,flash_at_s\n10000,7,2,1\n"
    ratio = 10**0.8
    depth = (ratio - 1) / (ratio + 1)
    for seconds in (1.0, 3.2, 715.0, 718.5):
        rates = []
        for rows in (table, "norad\n"):
            seen = satellite_sky(text, Geocentre(), rows).passing(EVERYWHERE, round(seconds * S_NS))
            now = np.zeros(1)
            rates.append(seen.rates_e_per_s(np.array([0]), now, now)[0])
        wanted = 1 + depth * np.cos(2 * np.pi * (seconds - 1.0) / 7.0)
        assert rates[0] / rates[1] == pytest.approx(wanted, rel=1e-5)


def test_satellites_are_written_before_the_bodies_that_come_after_them(rng):
    sky = satellite_sky(some_orbits(rng, 3), Geocentre())
    stars = stars_at(rng.normal(size=(5, 3)), np.ones(5))
    names = sky.satellites.names
    among = with_bodies(with_bodies(stars, names, np.zeros(3), False), ("Moon",), np.zeros(1))
    places = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]])
    sky.satellites.write(among, np.array([2, 0]), places, np.array([V0_E_PER_S, V0_E_PER_S / 100]))
    assert among.vectors[[7, 5]].tolist() == places.tolist()
    assert among.electrons_per_s[[7, 5]].tolist() == [V0_E_PER_S, V0_E_PER_S / 100]
    assert among.v_mag[[7, 5]] == pytest.approx([0.0, 5.0], abs=1e-12)
    for untouched in (*range(5), 6, 8):
        was = 1.0 if untouched < 5 else np.nan
        assert among.electrons_per_s[untouched] == pytest.approx(was, nan_ok=True)


def test_a_satellite_that_meets_the_observer_is_in_the_cone_that_it_flies_into():
    """On the observer's own orbit the other way round, 15 km/s: 28 s before they pass each other it
    is ahead, and within the half minute of an exposure behind.
    """
    other_way = element_set(9, (180 - 51.6416, 247.4627 - 180, 30.0, 100.0), 0.0006, 15.72)
    sky = satellite_sky("MET\n" + other_way)
    every = Cone(np.array([0.0, 0.0, 1.0]), np.pi, 0.0)
    half_s = 30

    def seen_km(second: float) -> np.ndarray | None:
        seen = sky.passing(every, round(second * 1e9))
        return None if seen is None else seen.seen_km[0, 0]

    def range_km(second: float) -> float:
        seen = seen_km(second)
        return np.inf if seen is None else float(np.linalg.norm(seen))

    near_s = min(range(0, 6000, 20), key=range_km)
    meets_s = min(range(near_s - 20, near_s + 21), key=range_km)
    assert range_km(meets_s) < 100
    before = seen_km(meets_s - 28)
    after = seen_km(meets_s + 2)
    assert np.linalg.norm(before) > 12 * 28
    axis = after / np.linalg.norm(after)
    assert before @ axis < 0  # it is still on the other side
    cone = Cone(axis, 0.01, float(half_s))
    # a search of its own, that has kept nothing
    asked = satellite_sky("MET\n" + other_way).passing(cone, (meets_s - 28) * 10**9)
    assert asked is not None
    assert asked.index.tolist() == [0]
