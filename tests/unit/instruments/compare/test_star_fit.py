"""The least-squares problem of all stars, against the same by dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.display.render.reference import linear_image
from hilstar.instruments.compare.star_fit import (
    StarTemplates,
    blend_distance_px,
    bright_pixels,
    describes,
    nameless_seeds,
    names_at,
    star_psf,
)
from hilstar.optics.layers.truth import TRUTH_DTYPE
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import pack_sprites

SIZE_PX = 40, 30
ROUNDING = 1e-14  # of sums of some hundred float64 products, all below 1
SIGMA_PX = 0.85, 0.7


def test_normal_matrix_and_fit_are_those_of_the_columns(rng):
    """Stars that overlap, that stand alone, and that the image's edge cuts."""
    places = np.concatenate([rng.uniform(-3, 43, (60, 1)), rng.uniform(-3, 33, (60, 1))], axis=1)
    templates = StarTemplates(places, GaussianPsf(SIGMA_PX), SIZE_PX[::-1])
    columns = np.stack([templates.image(unit).ravel() for unit in np.eye(180)], axis=1)
    assert np.abs(templates.normal.toarray() - columns.T @ columns).max() < ROUNDING
    assert np.abs(templates.in_view - columns[:, ::3].sum(axis=0)).max() < ROUNDING
    image = columns @ rng.uniform(1, 2, 180)
    alone = StarTemplates(
        np.array([[8.2, 9.7], [30.1, 20.4]]), GaussianPsf(SIGMA_PX), SIZE_PX[::-1]
    )
    dense = np.stack([alone.image(unit).ravel() for unit in np.eye(6)], axis=1)
    wanted = np.linalg.lstsq(dense, image, rcond=None)[0].reshape(2, 3)
    assert np.allclose(alone.fit(image.reshape(30, 40)), wanted, rtol=1e-10)


def test_a_table_of_stars_a_few_pixels_away_is_that_of_another_sky(rng):
    """A blend's distance decides, not the image's size."""
    size_px = 200, 150
    psf = GaussianPsf((0.85, 0.85))
    grid = np.arange(15, 200, 24.0), np.arange(15, 150, 24.0)
    x, y = (part.ravel() + rng.uniform(-0.4, 0.4, part.size) for part in np.meshgrid(*grid))
    flux = np.full(len(x), 1e4)
    sprites = pack_sprites(x, y, flux, np.arange(len(x)), size_px, psf.footprint_px)
    image = linear_image(sprites, size_px, psf)
    table = np.zeros(len(x), dtype=TRUTH_DTYPE)
    table["x_px"], table["y_px"], table["electrons_per_s"] = x, y, flux
    assert describes(table, image)
    table["x_px"] += 12.0
    assert not describes(table, image)


def test_the_sigma_of_an_image_is_that_of_most_of_its_bright_stars(rng):
    """The brightest one is a double star, and another runs over the image's edge."""
    size_px = 160, 120
    psf = GaussianPsf((0.85, 0.7))
    grid = np.arange(20, 160, 24.0), np.arange(20, 120, 24.0)
    x, y = (part.ravel() + rng.uniform(-0.4, 0.4, part.size) for part in np.meshgrid(*grid))
    x[3] = -0.3
    flux = np.full(len(x), 1e4)
    flux[:2] = 2e4
    x[1], y[1] = x[0] + 1.2, y[0] + 0.4
    sprites = pack_sprites(x, y, flux, np.arange(len(x)), size_px, psf.footprint_px)
    assert star_psf(linear_image(sprites, size_px, psf)).sigma_px == pytest.approx(
        psf.sigma_px, rel=1e-3
    )


def test_a_star_of_a_table_has_its_number_or_a_body_s_name():
    table = np.zeros(3, dtype=TRUTH_DTYPE)
    table["x_px"], table["y_px"] = [10.0, 20.0, 30.0], [5.0, 6.0, 7.0]
    table["hip"], table["name"] = [32349, 0, 91262], ["", "Mars", ""]
    places_px = np.array([[30.5, 7.5], [20.0, 6.9], [10.0, 6.1], [11.2, 5.0]])
    assert names_at(places_px, table, 1.0) == [(91262,), ("Mars",), (), ()]
    assert names_at(places_px, None, 1.0) == names_at(places_px, table[:0], 1.0) == [()] * 4
    assert names_at(places_px[:0], table, 1.0) == []


def test_bright_pixels_are_places_x_and_y_brightest_first():
    image = np.zeros((20, 30))
    image[4, 25], image[11, 7], image[11, 8] = 5.0, 9.0, 3.0
    places = bright_pixels(image, np.full(image.shape, 1.0))
    assert places.tolist() == [[7.0, 11.0], [25.0, 4.0]]


# 1.5 sigmas of the wider axis, and never under 1.25 px
@pytest.mark.parametrize(
    ("width_px", "distance_px"),
    [((0.5, 0.6), 1.25), ((0.9, 0.5), 1.35), ((0.5, 0.9), 1.35), ((2.0, 2.0), 3.0)],
)
def test_two_stars_are_one_blend_by_the_psf_s_width(width_px, distance_px):
    psf = GaussianPsf(width_px)
    assert blend_distance_px(psf) == pytest.approx(distance_px)
    places_px = np.array([[10.0, 10.0], [10.0 + 0.99 * distance_px, 10.0]])
    assert len(nameless_seeds(places_px, psf).places_px) == 1
    places_px[1, 0] = 10.0 + 1.01 * distance_px
    assert len(nameless_seeds(places_px, psf).places_px) == 2
