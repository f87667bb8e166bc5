"""What readings tell of a bench: how rough its codes are, which dots count, what structure of the
dots does to sums of light.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.instruments.certify.bench_readings import DotReadings
from hilstar.instruments.certify.estimates import (
    Evenness,
    LightDeviation,
    Surface,
    _fit_without_wild,
    evenness,
    surface,
)
from hilstar.instruments.certify.structure import Cells, Structure
from hilstar.optics.camera import field_terms
from hilstar.server.bench.bench_file import bench_file_of
from tests.support.benches import bench_text

SIZE_PX = (1920, 1080)
CODES, BENCHES = 40, 10
# The variance of `CODES` in `BENCHES` is known to sqrt(2 / n), of squares that their neighbours
# share twice that; four of these.
ROUGH_ERROR = 4 * math.sqrt(4 / (CODES * BENCHES))
# of a mean over a cell of 2 by 2 dots, 24 px, in a structure of 160 px: its square over 24, thrice
CELL_ERROR = 3 * (24 / 160) ** 2 / 24


def read_light(value: np.ndarray) -> LightDeviation:
    """Light by codes at steps of 0.2 in its log, hardly with any noise."""
    count = len(value)
    none = np.zeros((count, 0))
    return LightDeviation(
        log_light=0.2 * np.arange(1 - count, 1),
        value=value,
        factors=1e-6 * np.eye(count),
        dof=30.0,
        noise=1e-6,
        dark_factors=none,
        dark_dof=5.0,
        dark=0.0,
        lasting_factors=none,
        lasting=Structure(np.ones(1), np.zeros(1), 1.0, math.inf),
        square_px=(0, 0, 1),
        common_factors=none,
        beside=None,
    )


def test_a_code_between_those_read_is_as_rough_as_they_are_and_the_spline_through_them(rng):
    off = 0.01
    squares = []
    for _ in range(BENCHES):
        read = read_light(1.0 + off * rng.standard_normal(CODES))
        between = (read.log_light[1:] + read.log_light[:-1])[3:-3] / 2
        of_spline = (read.weights(between) ** 2).sum(axis=1)
        squares.append(read.rough(between) ** 2 / (1 + of_spline))
    assert np.mean(squares) == pytest.approx(off**2, rel=ROUGH_ERROR)


def test_a_dot_that_is_wild_along_one_axis_does_not_count(rng):
    x = np.linspace(-1, 1, 60)
    terms = np.column_stack([np.ones(60), x])
    values = terms @ [[2.0, -1.0], [3.0, 0.5]] + rng.normal(0, 0.01, (60, 2))
    values[17, 0] += 5.0
    values[41, 1] -= 5.0
    _, _, usable = _fit_without_wild(terms, values, np.ones(60, dtype=bool))
    assert np.flatnonzero(~usable).tolist() == [17, 41]


def test_dots_that_are_too_bright_or_too_dim_tell_nothing_of_a_screen_s_evenness(tmp_path, rng):
    """Of 400 dots of 1 % of noise, half and twice the light, and one without any."""
    file = bench_file_of(tmp_path / "bench.toml", bench_text({}))
    width_px, height_px = file.config.monitor.resolution_px
    grid = np.meshgrid(np.linspace(20, width_px - 21, 20), np.linspace(20, height_px - 21, 20))
    x_px, y_px = (places_px.ravel() for places_px in grid)
    light = np.exp(0.01 * rng.standard_normal(400))
    light[[37, 251, 318]] = [0.5, 2.0, 0.0]
    found = evenness(file, DotReadings(x_px, y_px, x_px, y_px, light))
    assert found.cells.count.sum() == 397
    assert math.sqrt(found.structure.noise_variance) == pytest.approx(0.01, rel=0.2)


def quartic(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of dots (n,) all over the screen, and values (n, 2) that go with the fourth power."""
    drawn = np.random.default_rng(4)
    x_px, y_px = (drawn.uniform(0, side, count) for side in SIZE_PX)
    u, v = x_px / 960 - 1, y_px / 540 - 1
    noise = drawn.normal(0, 1e-4, (2, count))
    return x_px, y_px, (np.stack([u**4, u * v**3]) + noise).T


@pytest.mark.parametrize(("dots", "degree"), [(24, 2), (59, 2), (60, 4), (111, 4)])
def test_a_surface_takes_four_dots_a_term(dots, degree):
    """Six terms of degree 2, 15 of degree 4, 28 of degree 6, which has nothing to add."""
    x_px, y_px, values = quartic(dots + 3)
    values[:3, 1] = np.nan  # dots that were not seen
    fit = surface(x_px, y_px, values, (2, 4, 6), SIZE_PX)
    assert fit.degree == degree
    terms = (degree + 1) * (degree + 2) // 2
    assert fit.dof == 2 * (dots - terms)
    rest = (values - fit.terms(x_px, y_px) @ fit.value)[3:]
    assert fit.noise == pytest.approx(math.sqrt(float((rest**2).sum()) / fit.dof))
    few = quartic(23)
    with pytest.raises(InputError, match="23 dots are seen and 24 are needed"):
        surface(*few, (2, 4, 6), SIZE_PX)


def test_structure_moves_a_sum_of_light_by_what_it_is_there_less_what_the_fit_makes_of_the_dots():
    """Four dots to a cell, and every dot by itself: sums and fits by the correlation of all."""
    lattice = np.meshgrid(np.arange(5, 345, 10.0), 12.0 * np.arange(30))
    x_px, y_px = (grid.ravel() for grid in lattice)
    length_px, variance = 160.0, 0.09
    terms = field_terms(x_px, y_px, SIZE_PX, 2)
    solve = np.linalg.pinv(terms)
    even = Evenness(
        Surface(2, SIZE_PX, np.zeros((6, 1)), np.eye(6), 10.0, 1.0),
        Cells(x_px, y_px),
        solve,
        Structure(np.array([length_px]), np.array([variance]), 1.0, 9.0),
    )
    star_px = np.array([100.0, 250.0, 30.0]), np.array([50.0, 310.0, 330.0])
    shares = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.4], [1.0, -0.5, -0.5]])

    factors = even.scatter(*star_px, shares)

    by_dot = -shares @ field_terms(*star_px, SIZE_PX, 2) @ solve
    weights = np.concatenate([shares, by_dot], axis=1)
    at_x, at_y = np.append(star_px[0], x_px), np.append(star_px[1], y_px)
    apart_px2 = (at_x[:, None] - at_x) ** 2 + (at_y[:, None] - at_y) ** 2
    wanted = variance * weights @ np.exp(-apart_px2 / (2 * length_px**2)) @ weights.T
    largest = variance * float((shares**2).sum(axis=1).max())
    np.testing.assert_allclose(factors.T @ factors, wanted, atol=CELL_ERROR * largest)
    # what a fit to the dots makes of it takes most of what a star has
    assert wanted[0, 0] < 0.5 * variance
