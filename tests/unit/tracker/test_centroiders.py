"""Centroiders of every kind, against stars whose place is known."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.tracker.centroiders import (
    SETTLED_PX,
    WIDE,
    Centroider,
    _profile,
    brightest,
    psf_places,
    star_places,
)

SIGMA = (1.05, 0.95)
# Of Gaussians integrated over pixels: sampling's own errors; a box of 5 x 5 cuts wings, one of 3 x
# 3 most of them.
BIAS_PX = {
    "moment": 1e-6,
    "window": 2e-3,
    "wide": 2e-3,
    "fit": 1e-6,
    "psf": 1e-6,
    "box3": 0.3,
    "box5": 0.1,
}


def gaussian_images(places, side=21):
    at = np.arange(side) - side // 2
    share = [
        np.diff(ndtr((np.append(at - 0.5, at[-1] + 0.5) - place[:, None]) / sigma))
        for place, sigma in zip(places, SIGMA, strict=True)
    ]
    return share[1][:, :, None] * share[0][:, None, :]


@pytest.mark.parametrize("kind", get_args(Centroider))
def test_each_finds_a_star_within_its_own_bias(kind, rng):
    places = rng.uniform(-0.5, 0.5, (2, 50))
    x, y = star_places(1e4 * gaussian_images(places), kind, SIGMA)
    assert np.abs([x - places[0], y - places[1]]).max() < BIAS_PX[kind]


@pytest.mark.parametrize("kind", get_args(Centroider))
def test_each_follows_a_small_shift_and_finds_nothing_in_the_dark(kind):
    places = np.array([[0.2, 0.21, 0.0], [-0.3, -0.3, 0.0]])
    images = gaussian_images(places)
    images[2] = 0
    x, y = star_places(images, kind, SIGMA, brightest(gaussian_images(np.zeros((2, 3)))))
    assert 0.003 < x[1] - x[0] < 0.011
    assert abs(y[1] - y[0]) < 1e-3
    assert x[2] == y[2] == 0


def test_noise_alone_and_clipped_stars_keep_every_place_finite(rng):
    for images in (
        rng.normal(0, 1, (40, 15, 15)) + 0.1,
        np.ones((3, 15, 15)),
        np.minimum(gaussian_images(np.zeros((2, 3))), 0.01),
    ):
        for kind in get_args(Centroider):
            assert np.isfinite(star_places(np.maximum(images, 0), kind, SIGMA)).all()


@pytest.mark.parametrize("place_px", [(1.2, 0.0), (-1.2, 0.0), (0.0, 1.2), (0.0, -1.2)])
def test_a_star_that_is_off_along_one_axis_alone_is_followed_to_its_place(place_px):
    """Four of the longest steps from its square's middle; none along the other axis, which does not
    end the fit.
    """
    stamp = gaussian_images(np.array(place_px)[:, None])
    middle = (np.zeros(1), np.zeros(1))
    x, y = psf_places(stamp, lambda *places: gaussian_images(np.stack(places)), middle)
    assert (x[0], y[0]) == pytest.approx(place_px, abs=BIAS_PX["psf"])


def test_where_noise_takes_a_star_s_light_away_a_fit_by_the_psf_stays_at_its_first_place():
    first = (np.array([0.4]), np.array([-0.7]))
    dark = -gaussian_images(np.array([[0.9], [-0.2]]))
    assert psf_places(dark, lambda *places: gaussian_images(np.stack(places)), first) == first


def test_a_fit_ends_at_the_star_that_it_begins_at():
    """Of two that are as bright, three pixels up and down from the middle, and a pixel aside."""
    two = np.array([[1.0, -1.0], [-3.0, 3.0]])
    stamp = gaussian_images(two).sum(axis=0)[None]
    for place_px in two.T:
        near = np.array([place_px[0] - 0.3]), np.array([place_px[1] + 0.4])
        x, y = psf_places(stamp, lambda *places: gaussian_images(np.stack(places)), near)
        assert (x[0], y[0]) == pytest.approx(tuple(place_px), abs=0.05)


@pytest.mark.parametrize(("kind", "wide"), [("window", 1.0), ("wide", WIDE)])
def test_a_window_settles_where_the_light_under_it_is_balanced(kind, wide, rng):
    """A star on a slope, with noise: the moments about its place under the window's own Gaussian,
    wider along y than along x, are 0.
    """
    sigma_px = (1.2, 2.0)
    at = np.arange(-10.0, 11.0)
    slope = 0.01 + 2e-4 * (at[:, None] + 3 * at)
    stamp = gaussian_images(np.array([[0.3], [-0.2]])) + slope + rng.normal(0, 1e-3, (21, 21))
    x, y = star_places(stamp, kind, sigma_px)
    away_x, away_y = at - x[0], at[:, None] - y[0]
    window = np.exp(-0.5 * ((away_x / sigma_px[0]) ** 2 + (away_y / sigma_px[1]) ** 2) / wide**2)
    light = (window * stamp[0]).sum()
    off_px = [(window * stamp[0] * away).sum() / light for away in (away_x, away_y)]
    # steps shrink at least twofold from one to the next
    assert np.abs(off_px).max() < 2 * SETTLED_PX


HOSTILE = {
    "one pixel": lambda rng: np.eye(15)[7][:, None] * np.eye(15)[7],
    "two pixels, apart": lambda rng: np.eye(15)[7][:, None] * (np.eye(15)[2] + np.eye(15)[12]),
    "a row": lambda rng: np.eye(15)[7][:, None] * np.ones(15),
    "a corner": lambda rng: np.eye(15)[0][:, None] * np.eye(15)[0],
    "half of a star, at an edge": lambda rng: (
        gaussian_images(np.zeros((2, 1)), 15)[0] * (np.arange(15) < 7)
    ),
    "two stars, one of them brighter": lambda rng: (
        gaussian_images(np.array([[1.5], [0.0]]), 15)[0]
        + 9 * gaussian_images(np.array([[-1.5], [0.5]]), 15)[0]
    ),
    "clipped flat": lambda rng: np.minimum(1e6 * gaussian_images(np.zeros((2, 1)), 15)[0], 1.0),
    "hardly any light": lambda rng: 1e-29 * gaussian_images(np.zeros((2, 1)), 15)[0],
    "more than a sun": lambda rng: 1e30 * gaussian_images(np.zeros((2, 1)), 15)[0],
    "noise": lambda rng: np.maximum(rng.normal(size=(15, 15)), 0),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", get_args(Centroider))
@pytest.mark.parametrize("sigma", [0.2, 1.0, 4.0])
def test_a_star_that_is_none_has_a_place_on_its_square(kind, sigma, rng):
    images = np.array([make(rng) for make in HOSTILE.values()])
    for x in star_places(images, kind, (sigma, sigma)):
        assert np.isfinite(x).all() and np.abs(x).max() <= 7


def test_a_star_s_shares_change_with_its_place_as_their_slopes_say():
    at, sigma_px, step_px = np.arange(-6.0, 7.0), 0.8, 1e-5
    places = np.array([-0.4, 0.0, 0.3])
    before, slopes = _profile(at, places, sigma_px).swapaxes(0, 1)
    after, _ = _profile(at, places + step_px, sigma_px).swapaxes(0, 1)
    assert slopes == pytest.approx((after - before) / step_px, abs=step_px)


@pytest.mark.parametrize("kind", ["box3", "box5"])
@pytest.mark.parametrize(
    ("stated", "x_px", "y_px"),
    [
        ({}, (0.1 - 0.05) / 1.18, 0.03 / 1.18),  # by a fiftieth
        ({"box_share": 0.0}, (0.1 - 0.05) / 1.18, 0.03 / 1.18),
        ({"box_share": 0.04}, (0.1 - 0.05) / 1.15, 0.0),
        ({"box_share": 0.07}, 0.1 / 1.1, 0.0),
        ({"box_share": 0.2}, 0.0, 0.0),
    ],
)
def test_a_box_s_pixels_count_from_the_stated_share_of_its_brightest_on(kind, stated, x_px, y_px):
    """Four pixels of 1, 0.1 right of it, 0.05 left and 0.03 below, with a brighter one beside the
    box: the mean of those that count.
    """
    star = np.zeros((1, 11, 11))
    star[0, 5, 4:7] = 0.05, 1.0, 0.1
    star[0, 6, 5] = 0.03
    star[0, 5, 9] = 3.0
    middle = np.array([5]), np.array([5])
    x, y = star_places(1e4 * star, kind, SIGMA, middle, **stated)
    assert (x[0], y[0]) == pytest.approx((x_px, y_px), abs=1e-12)
