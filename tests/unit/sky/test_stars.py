"""The stars of a bench: what stays with each when they are parted or joined with bodies, and by
which name it is called.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.rotation import direction_of
from hilstar.sky.catalog import plain_catalog
from hilstar.sky.stars import AirAbove, Stars, make_stars, split_by_rate, with_bodies
from tests.support.stars import stars_at

COUNT = 40
SHARES_BY_BV = np.tile((0.25, 0.75), (57, 1))


def two_channel_stars(rng: np.random.Generator) -> Stars:
    """Stars all over the sky by a survey's catalogue of which every third has a HIP number; the
    light of each says its row: (row + 1) in the first channel, twice that in the second.
    """
    row = np.arange(COUNT)
    columns = {
        "hip": np.where(row % 3 == 1, 1000 + row, 0).astype(np.int32),
        "v_mag": row / 10,
        "bv_mag": row / 100,
        "ra_deg": rng.uniform(0, 360, COUNT),
        "dec_deg": rng.uniform(-90, 90, COUNT),
        "identifier": 7000 + row,
    }
    catalog = plain_catalog("Gaia DR3", COUNT, columns)
    vectors = direction_of(columns["ra_deg"], columns["dec_deg"])
    light = np.column_stack([row + 1.0, 2 * (row + 1.0)])
    stars = make_stars(catalog, vectors, 4000.0 + row, light)
    return replace(stars, colours_by_bv=SHARES_BY_BV, primaries=light[stars.row][:, [0, 1, 1]])


def assert_whole(stars: Stars) -> None:
    """Each star of a catalogue has its own row in each column, and is found where it stands."""
    row, catalog = stars.row, stars.catalog
    assert stars.hip.tolist() == catalog.hip[row].tolist()
    assert stars.v_mag.tolist() == catalog.v_mag[row].tolist()
    assert stars.bv_mag.tolist() == catalog.bv_mag[row].tolist()
    assert stars.temperature_k.tolist() == (4000.0 + row).tolist()
    assert stars.electrons_per_s == pytest.approx(3 * (row + 1.0), rel=1e-15)
    assert stars.colours == pytest.approx(np.tile((1 / 3, 2 / 3), (len(row), 1)), rel=1e-15)
    assert stars.primaries is not None
    assert stars.primaries[:, 0].tolist() == (row + 1.0).tolist()
    places = direction_of(catalog.ra_deg[row], catalog.dec_deg[row])
    assert stars.vectors == pytest.approx(places, abs=1e-15)
    for star in range(len(row)):
        assert star in stars.near(stars.vectors[star], 1e-6)


@pytest.mark.parametrize("is_driven", [False, True])
def test_bright_and_faint_stars_are_all_of_them_once_each_whole(rng, is_driven):
    """A star of just the limit is bright. The two are as an observer at rest without air sees."""
    stars = two_channel_stars(rng)
    drive = np.where(stars.row % 2, 2.0, 1.0) if is_driven else 1.0
    moving = replace(
        stars, velocity_km_s=np.array([0.0, 30.0, 0.0]), air=AirAbove(np.array([0.0, 0, 1]), (0, 0))
    )
    bright, faint = split_by_rate(moving, 60.0, drive)
    driven_e_per_s = np.empty(COUNT)
    driven_e_per_s[stars.row] = stars.electrons_per_s * drive
    assert sorted(bright.row) == np.flatnonzero(driven_e_per_s >= 60.0).tolist()
    assert sorted(faint.row) == np.flatnonzero(driven_e_per_s < 60.0).tolist()
    assert 60.0 in driven_e_per_s
    for part in (bright, faint):
        assert_whole(part)
        assert (part.velocity_km_s, part.air, part.bodies) == (None, None, ())
        assert part.colours_by_bv is SHARES_BY_BV
    all_stars, none = split_by_rate(moving, 3.0)
    assert all_stars is moving
    assert len(none) == 0


def test_bodies_come_after_the_stars_and_after_the_bodies_before_them(rng):
    stars = two_channel_stars(rng)
    swarm = with_bodies(stars, ("S1", "S2"), np.array([0.5, 0.6]), False, np.array([0.1, 0.9]))
    faces = np.array([[0.3, 0.7], [0.4, 0.6], [0.5, 0.5]])
    sky = with_bodies(swarm, ("Moon", "Mars", "Sun"), np.array([0.9, 1.4, 0.65]), colours=faces)
    assert len(sky) == COUNT + 5
    assert sky.bodies == ("S1", "S2", "Moon", "Mars", "Sun")
    assert sky.bv_mag[COUNT:].tolist() == [0.5, 0.6, 0.9, 1.4, 0.65]
    assert sky.colours is not None
    assert sky.colours[COUNT:].tolist() == [[0.1, 0.9], [0.1, 0.9], *faces.tolist()]
    assert sky.colours_by_bv is SHARES_BY_BV
    assert sky.rates_e_per_s.tolist() == stars.electrons_per_s.tolist()
    assert sky.row[COUNT:].tolist() == [-1] * 5
    for column in (sky.v_mag, sky.temperature_k, sky.electrons_per_s, sky.vectors):
        assert np.isnan(column[COUNT:]).all()
    # who moves a body gives its cell its middle; those of the list are in none
    axis = np.array([0.6, 0.0, 0.8])
    sky.grid.centre[-3:] = axis
    found = sky.near(axis, 1e-9)
    assert found[-3:].tolist() == [COUNT + 2, COUNT + 3, COUNT + 4]
    assert len(sky.near(axis, np.pi)) == COUNT + 3
    # to rounding: a body at the end of the radius, and 2e-6 beyond it
    tangent = np.array([0.8, 0.0, -0.6])
    assert COUNT + 2 in sky.near(np.cos(0.1) * axis + np.sin(0.1) * tangent, 0.1)
    assert COUNT + 2 not in sky.near(np.cos(0.1) * axis + np.sin(0.1) * tangent, 0.1 - 2e-6)


def test_a_star_is_called_by_its_number_else_by_its_name_in_its_catalogue(rng):
    """In the order in which they are asked for; a star of no catalogue has no name."""
    stars = two_channel_stars(rng)
    sky = with_bodies(stars, ("Moon", "Mars"), np.zeros(2), colours=np.array([0.5, 0.5]))
    (added,) = np.flatnonzero((sky.row == 9) & (sky.hip == 0))
    sky.row[added] = -1
    asked = np.array([COUNT + 1, *(COUNT - 1 - np.arange(COUNT)), COUNT])
    names, designations = ["Mars"], ["Mars"]
    for star in asked[1:-1].tolist():
        row = int(sky.row[star])
        named = "" if row % 3 == 1 or row < 0 else f"Gaia DR3 {7000 + row}"
        names.append(named)
        designations.append(named or (0 if row < 0 else 1000 + row))
    assert sky.names(asked) == [*names, "Moon"]
    assert sky.designations(asked) == [*designations, "Moon"]


def test_through_air_a_star_just_beyond_a_wide_reach_is_found_where_it_is_bent_most():
    """A field 25 degrees up whose reach goes down to 9: there light is bent by 0.1 degrees, which a
    star of a cell of its own is beyond it.
    """
    up = np.array([0.0, 0.0, 1.0])
    air = AirAbove(up, (2.9e-4, -3.3e-7))
    axis = np.array([np.cos(0.436), 0.0, np.sin(0.436)])
    lowest = 0.436 - 0.08 - 0.2
    altitude = lowest - 0.0017
    vectors = np.array([[np.cos(altitude), 0.0, np.sin(altitude)]])
    stars = replace(stars_at(vectors, np.ones(1)), air=air)
    (seen,) = stars.directions(np.arange(1))
    assert np.arcsin(seen @ up) > lowest
    assert stars.near(axis, 0.08, reach_rad=0.2).tolist() == [0]


@pytest.mark.parametrize(
    ("lowest_rad", "kept", "is_told"),
    [(0.02, [0, 1, 2], False), (0.005, [0, 2], False), (-0.001, [0, 2], True)],
)
def test_a_field_that_reaches_below_the_horizon_is_told_of_once(lowest_rad, kept, is_told, caplog):
    """One that only may touch it, by the largest refraction, has no stars from below."""
    altitudes = np.array([0.3, -0.01, 0.001])
    vectors = np.column_stack([np.cos(altitudes), 0 * altitudes, np.sin(altitudes)])
    air = AirAbove(np.array([0.0, 0.0, 1.0]), (0.0, 0.0))
    for _ in range(2):
        assert air.risen(np.arange(3), vectors, lowest_rad).tolist() == kept
    told = [record.getMessage() for record in caplog.records]
    line = "[site]: the field reaches below the horizon; the stars there are not shown"
    assert told == ([line] if is_told else [])
    # where all of the stars are above it, nothing is missing
    assert air.risen(np.array([2, 0]), vectors, lowest_rad).tolist() == [2, 0]
