"""Gaussians over a field: their light in pixels against erf and fine sums, and what a fit finds of
planted ones.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.optics import psf_fit
from hilstar.optics.psf_fit import (
    PixelGaussians,
    PointGaussians,
    PointImages,
    cell_quadrature,
    fit_each,
    node_count,
    over_field,
    place_terms,
)

OFFSETS_PX = np.arange(-9.0, 10.0)
NODES_LIMIT = 1.5e-7  # of a peak, as stated beside NODES_FROM
# Nine nodes of Gauss over a pixel, two sigmas wide at the narrowest here.
SHARE_LIMIT = 1e-9
# The middles of 40 x 40 parts of a pixel: the midpoint rule is right to h^2 / 24 of the curvature,
# 1 / sigma^2, of a peak of 0.3.
PARTS, SUM_LIMIT = 40, 3e-5
STEP, SLOPE_LIMIT = 1e-5, 1e-8  # central differences: the step's square, and rounding over the step
FIT_LIMIT = (
    1e-7  # the ridge is 1e-9 of a column, and a variance's column is weaker than the light's
)
NOISE_E, LIGHT_E, STARS = 5.0, 20_000.0, 200
SIGMAS = 4.0  # of a mean of STARS: once in 16 000
TILTED = np.array([[0.6, 0.9, 0.25]])


def gaussians(
    x_px: float, y_px: float, covariance: np.ndarray, side_px: float = 0.0
) -> PixelGaussians:
    """One Gaussian whose middle is at (x, y)."""
    return PixelGaussians(
        (OFFSETS_PX - x_px)[None], (OFFSETS_PX - y_px)[None], covariance, np.array([side_px])
    )


@pytest.mark.parametrize("sigma_px", [(0.4, 0.7), (0.85, 0.85), (2.0, 1.1)])
def test_a_gaussian_along_the_axes_has_the_light_of_its_erfs(sigma_px):
    middle = 0.31, -0.22
    across, down = (
        ndtr((OFFSETS_PX + 0.5 - at) / sigma) - ndtr((OFFSETS_PX - 0.5 - at) / sigma)
        for at, sigma in zip(middle, sigma_px, strict=True)
    )
    covariance = np.array([[sigma_px[0] ** 2, sigma_px[1] ** 2, 0.0]])
    shares = gaussians(*middle, covariance).shares[0]
    assert np.abs(shares - np.outer(down, across)).max() < SHARE_LIMIT


@pytest.mark.parametrize("side_px", [0.0, 1.0, 2.4])
def test_a_tilted_gaussian_of_a_square_has_the_light_of_a_fine_sum(side_px):
    """The pixel convolved with the square is a trapezoid: so is the weight of the parts."""
    (xx, yy, xy), width_px = TILTED[0], 1 + side_px
    steps = ((np.arange(PARTS * 3) + 0.5) / (PARTS * 3) - 0.5) * width_px
    weight = np.clip(width_px / 2 - np.abs(steps), 0, min(1.0, side_px) or 1.0)
    weight = np.ones_like(steps) if side_px == 0 else weight
    weight /= weight.sum()
    for column, row in ((9, 9), (10, 8), (11, 11)):
        x = OFFSETS_PX[column] - 0.2 + steps[None]
        y = OFFSETS_PX[row] - 0.1 + steps[:, None]
        square = (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
        density = np.exp(-square / 2) / (2 * np.pi * np.sqrt(xx * yy - xy * xy))
        expected = weight @ density @ weight
        share = gaussians(0.2, 0.1, TILTED, side_px).shares[0, row, column]
        assert share == pytest.approx(expected, abs=SUM_LIMIT)


def test_weights_of_a_square_sum_to_one_and_a_point_has_the_pixel_s():
    for side_px in (0.0, 0.5, 1.0, 3.0):
        nodes, weights = cell_quadrature(side_px)
        assert weights.sum() == pytest.approx(1.0)
        assert np.abs(nodes).max() < (1 + side_px) / 2
        # a box's variance is its width's square over 12, and those of pixel and square add up
        assert weights @ nodes**2 == pytest.approx((1 + side_px**2) / 12, rel=1e-4)
        assert weights @ nodes == pytest.approx(0.0, abs=1e-12)
        fourth = (1 + side_px**4) / 80 + 6 * side_px**2 / 144
        assert weights @ nodes**4 == pytest.approx(fourth, rel=1e-4)


def test_the_slopes_are_those_of_differences():
    share, *slopes = gaussians(0.2, -0.1, TILTED).slopes(shape=True)
    moved = [
        (gaussians(0.2 + x, -0.1 + y, TILTED).shares, gaussians(0.2 - x, -0.1 - y, TILTED).shares)
        for x, y in ((STEP, 0.0), (0.0, STEP))
    ]
    for change in STEP * np.eye(3):
        both = gaussians(0.2, -0.1, TILTED + change), gaussians(0.2, -0.1, TILTED - change)
        moved.append((both[0].shares, both[1].shares))
    assert share == pytest.approx(gaussians(0.2, -0.1, TILTED).shares, abs=1e-14)
    for slope, (after, before) in zip(slopes, moved, strict=True):
        assert np.abs(slope).max() > 0.05
        assert np.abs(slope - (after - before) / (2 * STEP)).max() < SLOPE_LIMIT


def gaussian_points(rng, covariance, side_px=0.0, level=7.0, noise_e=0.0):
    """STARS images of one covariance at chance places within a pixel, and those places."""
    x_px, y_px = rng.uniform(-0.5, 0.5, (2, STARS))
    sides = np.full(STARS, side_px)
    shares = PixelGaussians(
        OFFSETS_PX - x_px[:, None], OFFSETS_PX - y_px[:, None], covariance, sides
    ).shares
    images = LIGHT_E * shares + level + rng.normal(0, 1, shares.shape) * noise_e
    middle = np.zeros(STARS)
    weight = np.full_like(images, 1 / max(noise_e, 1.0) ** 2)
    points = PointImages(images, weight, middle, middle, sides, has_level=level != 0)
    start = PointGaussians(middle, middle, np.tile([0.5, 0.5, 0.0], (STARS, 1)))
    return points, start, x_px, y_px


@pytest.mark.parametrize("side_px", [0.0, 1.4])
def test_a_planted_gaussian_is_found_to_the_ridge(rng, side_px):
    covariance = np.tile(TILTED, (STARS, 1))
    points, start, x_px, y_px = gaussian_points(rng, covariance, side_px)
    fitted = fit_each(points, start, rounds=15)
    assert fitted.covariance == pytest.approx(covariance, abs=10 * FIT_LIMIT)
    assert fitted.x_px == pytest.approx(x_px, abs=FIT_LIMIT)
    assert fitted.y_px == pytest.approx(y_px, abs=FIT_LIMIT)


def test_one_covariance_of_all_is_that_of_all(rng):
    """A tenth of them are wider, and move no median."""
    covariance = np.tile([9.0, 1.0, 0.0], (STARS, 1))
    covariance[: STARS // 10, :2] += 2.0
    points, start, *_ = gaussian_points(rng, covariance, level=0.0)
    fitted = fit_each(points, start, rounds=15, alike=True)
    assert np.ptp(fitted.covariance, axis=0) == pytest.approx(0.0, abs=1e-12)
    # 19 pixels are 3.2 sigmas to either side: the rest is cut, and not missed
    assert fitted.covariance[0] == pytest.approx([9.0, 1.0, 0.0], abs=1e-5)


def test_noise_moves_a_fit_by_no_more_than_its_own_sigma(rng):
    covariance = np.tile(TILTED, (STARS, 1))
    points, start, x_px, _ = gaussian_points(rng, covariance, noise_e=NOISE_E)
    fitted = fit_each(points, start)
    for off in (fitted.x_px - x_px, *(fitted.covariance - covariance).T):
        assert abs(off.mean()) < SIGMAS * off.std() / np.sqrt(STARS)
        assert off.std() < 0.02


def test_a_field_is_found_beside_a_dot_with_a_neighbour(rng):
    u, v = rng.uniform(-1, 1, (2, STARS))
    terms = place_terms(u, v)
    coefficients = np.array([[0.5, 0.1, 0.0, 0.2, -0.05, 0.1]]).T * np.array([1.0, 0.8, 0.1])
    covariance = terms @ coefficients + rng.normal(0, 1e-4, (STARS, 3))
    covariance[:5] += 0.4  # five dots with neighbours
    robust = over_field(terms, covariance)
    plain = np.linalg.lstsq(terms, covariance, rcond=None)[0]
    off, off_plain = (np.abs(found - coefficients).max() for found in (robust, plain))
    assert off < 1e-3
    assert off_plain > 10 * off


@pytest.mark.parametrize("sigma_cells", [0.0, 0.45, 0.69, 0.7, 1.0, 1.99, 2.0, 30.0])
def test_a_cell_s_light_is_a_gaussian_s_by_few_nodes(sigma_cells):
    """Against the normal distribution; a sigma of 0 has its nodes, too."""
    nodes, weights = cell_quadrature(0.0, node_count(sigma_cells))
    assert weights.sum() == pytest.approx(1, abs=1e-12)
    if not sigma_cells:
        return
    places = np.linspace(-3, 3, 13) * sigma_cells
    density = np.exp(-0.5 * ((places[:, None] + nodes) / sigma_cells) ** 2) @ weights
    light = ndtr((places + 0.5) / sigma_cells) - ndtr((places - 0.5) / sigma_cells)
    light *= sigma_cells * np.sqrt(2 * np.pi)  # of a peak of 1
    assert density == pytest.approx(light, abs=NODES_LIMIT)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_covariance_is_kept_to_that_of_a_gaussian_either_way(sign):
    """Axes of 2 and 1 px: a covariance of 2 px^2 would be a line."""
    wanted = np.array([[4.0, 1.0, sign * 1.5], [4.0, 1.0, sign * 3.0], [-1.0, 4.0, 0.0]])
    kept = psf_fit.bounded(wanted)
    assert kept[0] == pytest.approx(wanted[0])
    assert kept[1] == pytest.approx([4.0, 1.0, sign * 2.0 * psf_fit.MAX_CORRELATION])
    assert kept[2] == pytest.approx([psf_fit.MIN_VARIANCE_PX2, 4.0, 0.0])
