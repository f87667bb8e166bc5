"""The spatial index hands on every star within the radius."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.sky.catalog import load_catalog
from hilstar.sky.stars import CELL_DEG, PARTS, cell_grid, unit_vectors_icrs
from tests.support.stars import stars_at


@pytest.fixture(scope="module")
def vectors():
    return unit_vectors_icrs(load_catalog(), 2026.0)


def test_every_star_within_the_radius_is_found(vectors, rng):
    grid = cell_grid(vectors)
    axes = rng.normal(size=(60, 3))
    axes[:4] = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [1, -1e-9, 0]]  # poles, and both sides of RA 0
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for axis in axes:
        for radius in (1e-4, 0.05, 0.2, 1.0, 1.5):
            wanted = np.flatnonzero(vectors @ axis >= np.cos(radius))
            found = grid.order[grid.near(axis, radius)]
            times_found = np.bincount(found, minlength=len(vectors))
            assert times_found[wanted].all()
            assert times_found.max() <= 1


@pytest.mark.parametrize("cell_deg", [CELL_DEG, 60.0, 360.0])
@pytest.mark.parametrize("reach_rad", [0.0, 0.1])
def test_every_star_within_the_sides_of_an_image_is_found(rng, cell_deg, reach_rad):
    """Few stars in cells wider than a plane bounds, too: such a cell's middle may be far behind
    a side that a star of it is within.
    """
    for _ in range(300):
        vectors = rng.normal(size=(6, 3))
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        grid = cell_grid(vectors, cell_deg)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        # the sides of a square image of half a radian to either side, and the circle about it
        half = np.tan(0.5)
        edges = np.array([[1, 0, half], [-1, 0, half], [0, 1, half], [0, -1, half]])
        edges = edges / np.hypot(1, half) @ turn
        radius_rad = np.arctan(half * np.sqrt(2))
        is_within = (vectors @ edges.T >= -np.sin(reach_rad)).all(axis=1)
        is_within &= vectors @ turn[2] >= np.cos(radius_rad + reach_rad)
        found = grid.order[grid.near(turn[2], radius_rad, edges, reach_rad)]
        assert np.isin(np.flatnonzero(is_within), found).all()


@pytest.mark.parametrize("reach_rad", [1.55, 2.0, 3.2, 7.0])
def test_a_turn_beyond_the_other_side_of_the_sky_finds_all(vectors, reach_rad):
    grid = cell_grid(vectors)
    places = grid.near(np.array([0.6, 0.0, 0.8]), 1.6, reach_rad=reach_rad)
    assert np.array_equal(places, np.arange(len(vectors)))


def test_few_others_are_found(vectors):
    """The index earns its place: stars found lie within a cell's diagonal, and its margin, of
    the radius.
    """
    grid = cell_grid(vectors)
    axis, radius = np.array([0.6, 0.0, 0.8]), 0.18
    found = grid.order[grid.near(axis, radius)]
    farthest = np.arccos(np.clip((vectors[found] @ axis).min(), -1, 1))
    assert farthest < radius + 2 * np.radians(CELL_DEG) * np.sqrt(2)
    assert len(found) < len(vectors) / 20


def test_stars_of_a_cell_follow_each_other_by_its_parts(vectors):
    """Neighbours in order are neighbours in the sky: within a part's diagonal, not a cell's."""
    grid = cell_grid(vectors)
    inside = np.setdiff1d(np.arange(1, len(vectors)), grid.start)  # not across two cells
    ordered = vectors[grid.order]
    step = np.arccos(np.clip(np.einsum("ij,ij->i", ordered[inside], ordered[inside - 1]), -1, 1))
    assert np.median(step) < np.radians(CELL_DEG / PARTS * np.sqrt(2))
    assert np.array_equal(np.sort(grid.order), np.arange(len(vectors)))


def test_each_star_is_within_its_cell_and_no_cell_is_wider_than_its_diagonal(vectors):
    """Cells at right ascension 0 among them, where the arc tangent jumps."""
    grid = cell_grid(vectors)
    radius = np.arccos(grid.cos_radius)
    assert radius.max() < np.radians(CELL_DEG) * np.sqrt(2)
    cell = np.repeat(np.arange(len(grid.start)), grid.count)
    off = np.linalg.norm(vectors[grid.order] - grid.centre[cell], axis=1)
    assert (2 * np.arcsin(off / 2) < radius[cell]).all()


def test_no_stars_and_one_star():
    assert len(cell_grid(np.empty((0, 3))).near(np.array([1.0, 0, 0]), 1.0)) == 0
    alone = cell_grid(np.array([[0.0, 0.0, 1.0]]))
    assert alone.near(np.array([0.0, 0, 1]), 1e-9).tolist() == [0]
    assert alone.near(np.array([0.0, 0, -1]), 1.0).tolist() == []


@pytest.mark.parametrize("cell_deg", [4.0, 60.0, 180.0])
def test_every_star_within_reach_of_the_edges_planes_is_found_whatever_the_cells(rng, cell_deg):
    vectors = rng.normal(size=(800, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    grid = cell_grid(vectors, cell_deg)
    for reach_rad in (0.0, 0.02, 0.4, 1.3):
        edges = rng.normal(size=(4, 3))
        edges /= np.linalg.norm(edges, axis=1, keepdims=True)
        is_wanted = (vectors @ edges.T >= -np.sin(reach_rad)).all(axis=1)
        is_wanted &= vectors[:, 2] >= np.cos(1.5 + reach_rad)
        wanted = np.flatnonzero(is_wanted)
        found = grid.order[grid.near(np.array([0.0, 0.0, 1.0]), 1.5, edges, reach_rad)]
        assert np.isin(wanted, found).all()


@pytest.mark.parametrize("speed_km_s", [30.0, 3000.0, 10_000.0])
def test_an_observer_that_moves_fast_finds_every_star_that_is_seen_in_the_field(speed_km_s, rng):
    """Ahead of it stars crowd: by aberration they come from 2 degrees outside at a thirtieth of the
    speed of light.
    """
    at_rest = stars_at(rng.normal(size=(20_000, 3)), np.ones(20_000))
    for _ in range(10):
        ahead, axis = rng.normal(size=(2, 3))
        velocity = speed_km_s * ahead / np.linalg.norm(ahead)
        axis /= np.linalg.norm(axis)
        stars = at_rest.seen_at(velocity)
        seen = stars.directions(np.arange(len(stars)))
        for radius_rad in (0.02, 0.3):
            wanted = np.flatnonzero(seen @ axis >= np.cos(radius_rad))
            assert np.isin(wanted, stars.near(axis, radius_rad)).all()
