"""Stars that the edge of the detector cuts: measured and marked, wherever their centre goes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.tracker.centroids import (
    CentroidSettings,
    LocalBackground,
    estimate_background,
    find_stars,
    noisiest_background,
    s_curves,
    squares,
    star_widths,
)
from tests.support.refusals import refusal

SIZE_PX = 40
BACKGROUND = LocalBackground(0.0, 1.0)
# the sums of a turned window run the other way round; Newton's iteration ends within 1e-7
SAME_PX = 1e-6


@pytest.mark.parametrize("window", ["gaussian", "plain"])
def test_a_centre_that_leaves_the_image_is_measured_alike_at_all_four_edges(window):
    """A star on the last row, and a pixel under the background on the row within: the moment
    points out of the image.
    """
    image = np.zeros((SIZE_PX, SIZE_PX))
    image[0, 19:22] = 30.0, 100.0, 50.0
    image[1, 20] = -120.0
    turned = [
        find_stars(
            np.rot90(image, k), CentroidSettings(window=window, window_sigma_px=1.3), BACKGROUND
        )
        for k in range(4)
    ]
    assert turned[0].y_px[0] < -0.5
    for k, star in enumerate(turned):
        assert len(star) == 1 and star.at_edge[0]
        x_px, y_px = star.x_px[0], star.y_px[0]
        for _ in range(k):  # back: rot90 takes (x, y) to (y, last - x)
            x_px, y_px = SIZE_PX - 1 - y_px, x_px
        assert (x_px, y_px) == pytest.approx((turned[0].x_px[0], turned[0].y_px[0]), abs=SAME_PX)
        assert star.flux[0] == pytest.approx(turned[0].flux[0], rel=1e-6)


def test_the_noise_of_the_noisier_parts_is_found_beside_a_clipped_one():
    """A third of the image has noise of 2 DN; the median deviation of the whole is 0."""
    rng = np.random.default_rng(4)
    image = np.zeros((256, 384))
    image[:, :128] = np.rint(rng.normal(0, 2.0, (256, 128)))
    found = noisiest_background(image)
    # 32 blocks of 1024 pixels: each is known to 2 %, and the 90th percentile lies among the upper
    # third of them.
    assert found.noise == pytest.approx(2.0, rel=0.06)
    assert found.level == 0
    assert noisiest_background(np.zeros((40, 40)), 5.0).noise == pytest.approx(5 / np.sqrt(12))


@pytest.mark.parametrize("sigma_dn", [0.4, 0.6, 1.0, 2.5])
def test_noise_of_about_a_step_is_found_with_that_of_the_rounding(sigma_dn, rng):
    """Of a frame in whole DN: sqrt(sigma^2 + 1/12), known to 2 % in each of 64 blocks, of which the
    90th percentile lies 1.3 of that above the middle. Half a step hides a median deviation of 0.
    """
    found = noisiest_background(np.rint(rng.normal(100.0, sigma_dn, (256, 256))))
    assert 0.97 < found.noise / np.sqrt(sigma_dn**2 + 1 / 12) < 1.09


@pytest.mark.parametrize("shape", [(64, 64), (63, 65)])  # an even number of pixels, and an odd one
def test_the_background_of_whole_numbers_is_that_of_their_pixels(shape):
    """Counted value by value, as DN are, and pixel by pixel, as electrons are: the same, but for
    the order of a sum.
    """
    image = np.random.default_rng(5).poisson(20.0, shape).astype(np.uint16)
    image[3:6, 3:6] = 4000
    counted, by_pixel = (
        estimate_background(image),
        estimate_background(image.astype(np.float64), step=1.0),
    )
    assert counted.level == pytest.approx(by_pixel.level, rel=1e-12)
    assert counted.noise == pytest.approx(by_pixel.noise, rel=1e-12)


@pytest.mark.parametrize("shape", [(30, 60), (60, 30)])
def test_a_star_is_at_the_edge_where_its_window_leaves_a_wide_or_a_tall_image(shape):
    """The window reaches 3 px: its middle pixel is on the first or last three rows or columns."""
    height, width = shape
    settings = CentroidSettings(window_sigma_px=1.3, window_radius_px=3)

    def is_at_edge(x: int, y: int) -> bool:
        image = np.zeros(shape)
        image[y, x] = 100.0
        (star,) = find_stars(image, settings, BACKGROUND).at_edge
        return bool(star)

    middle_x, middle_y = width // 2, height // 2
    for x in (2, 3, width - 4, width - 3):
        assert is_at_edge(x, middle_y) == (x in (2, width - 3))
    for y in (2, 3, height - 4, height - 3):
        assert is_at_edge(middle_x, y) == (y in (2, height - 3))


# What pixels leave of a Gaussian's second moments, where they sample it well; narrower stars scatter
# with their place in the pixel.
WIDTH_PX, NARROW_WIDTH_PX = 2e-3, 0.02


@pytest.mark.parametrize(
    ("sigma_px", "tolerance_px"),
    [(0.8, NARROW_WIDTH_PX), (1.0, WIDTH_PX), (1.4, WIDTH_PX), (2.5, WIDTH_PX), (4.0, WIDTH_PX)],
)
def test_a_star_s_width_is_its_sigma_with_that_of_a_pixel(rng, sigma_px, tolerance_px):
    pixel = np.arange(SIZE_PX + 1) - 0.5
    x_px, y_px = 19.5 + rng.uniform(0, 1, (2, 8))
    for x, y in zip(x_px.tolist(), y_px.tolist(), strict=True):
        across = np.diff(ndtr((pixel - x) / sigma_px))
        down = np.diff(ndtr((pixel - y) / sigma_px))
        image = 7.0 + 5e4 * down[:, None] * across
        (width_px,) = star_widths(image, 7.0, np.array([x]), np.array([y]))
        assert width_px == pytest.approx(np.sqrt(sigma_px**2 + 1 / 12), abs=tolerance_px)


def test_a_place_without_a_star_has_no_width():
    image = np.zeros((SIZE_PX, SIZE_PX))
    image[20, 20] = -5.0
    widths_px = star_widths(image, 0.0, np.array([20.0, 5.0]), np.array([20.0, 5.0]))
    assert np.isnan(widths_px).all()


@pytest.mark.parametrize("aside_px", [(3, 0), (0, 3), (-3, 0), (0, -3), (3, -3)])
def test_a_plain_window_that_walks_off_leaves_the_blob_s_own_place(aside_px):
    """Along one axis or both: from star to brighter star, 3 px apart, a window of 4 px about the
    first is 6 px off; about the second it ends on the third, which is within its window.
    """
    image = np.zeros((SIZE_PX, SIZE_PX))
    places = np.array([20, 18]) + np.outer(np.arange(3), aside_px)
    for (x, y), peak in zip(places, (30.0, 900.0, 27000.0), strict=True):
        image[y, x] = peak
    settings = CentroidSettings(window="plain", window_radius_px=4)
    found = find_stars(image, settings, BACKGROUND)
    order = np.argsort(found.peak)
    at_px = np.column_stack([found.x_px, found.y_px])[order]
    assert at_px[0] == pytest.approx(places[0], abs=SAME_PX)
    assert at_px[1:] == pytest.approx(places[[2, 2]], abs=0.2)


@pytest.mark.parametrize("way", [(1, 0), (0, 1), (-1, 0), (0, -1)])
@pytest.mark.parametrize(("gap_px", "times"), [(3, 3.0), (4, 10.0)])
def test_a_gaussian_window_that_walks_off_leaves_the_blob_s_own_place(way, gap_px, times):
    """Along one axis: of four stars, each brighter than the one before, each is where it is, though
    steps of the first two would end on the last. That one's own window has a neighbour's light,
    which draws its middle by 0.16 px at most.
    """
    image = np.zeros((SIZE_PX, SIZE_PX))
    places = np.array([20, 18]) + np.outer(np.arange(4) * gap_px, way)
    for k, (x, y) in enumerate(places):
        image[y, x] = 30.0 * times**k
    settings = CentroidSettings(window_sigma_px=1.5, window_radius_px=5)
    found = find_stars(image, settings, BACKGROUND)
    order = np.argsort(found.peak)
    at_px = np.column_stack([found.x_px, found.y_px])[order]
    assert at_px == pytest.approx(places, abs=0.2)


@pytest.mark.parametrize("dtype", [np.uint8, np.float64])
def test_the_level_of_an_even_count_of_pixels_is_the_mean_of_the_middle_two(dtype):
    image = np.repeat(np.array([[10], [20]], dtype), 4, axis=1)
    assert noisiest_background(image).level == 15.0


@pytest.mark.parametrize(("value", "stars"), [(15, 0), (16, 1)])
def test_a_pixel_of_whole_numbers_on_the_threshold_is_no_star(value, stars):
    image = np.full((SIZE_PX, SIZE_PX), 10, np.uint16)
    image[20, 20] = value
    settings = CentroidSettings(threshold_sigma=5.0, minimum_pixels=1)
    assert len(find_stars(image, settings, LocalBackground(10.0, 1.0))) == stars


def test_a_star_as_wide_as_the_window_has_no_width():
    flat = np.ones((SIZE_PX, SIZE_PX))
    assert np.isnan(star_widths(flat, 0.0, np.array([20.0]), np.array([20.0])))


@pytest.mark.parametrize("is_down", [False, True])
def test_a_gaussian_window_that_leaves_along_one_axis_leaves_the_blob_s_own_place(is_down):
    """Beside a star 30 times as bright, 3 px off, the window (2 px) has its moment at 3 s / (1 + s)
    = 2.72 px, s = 30 exp(-9 / 8), and no slope: a step is ten times that, onto the third star.
    """
    image = np.zeros((60, 60))
    places = np.array([[20, 18], [23, 18], [47, 18]])
    image[18, places[:, 0]] = 30.0, 900.0, 27000.0
    if is_down:
        image = image.T
        places = places[:, ::-1]
    found = find_stars(image, CentroidSettings(window_sigma_px=2.0), BACKGROUND)
    order = np.argsort(found.peak)
    at_px = np.column_stack([found.x_px, found.y_px])[order]
    assert at_px[0] == pytest.approx(places[0], abs=SAME_PX)
    assert at_px[2] == pytest.approx(places[2], abs=SAME_PX)


@pytest.mark.parametrize("dark_px", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_window_without_light_leaves_the_blob_s_own_place(dark_px):
    """A pixel beside the star takes more than the star gives: the window (2 px) sums to 30 - 100
    exp(-1 / 8) = -58, and a step by that would be 2.4 px towards the dark, within the window.
    """
    image = np.zeros((SIZE_PX, SIZE_PX))
    right, down = dark_px
    image[18, 20] = 30.0
    image[18 + down, 20 + right] = -100.0
    found = find_stars(image, CentroidSettings(window_sigma_px=2.0, iterations=1), BACKGROUND)
    assert (found.x_px[0], found.y_px[0]) == pytest.approx((20, 18), abs=SAME_PX)


def test_the_noisier_parts_of_a_wide_image_are_those_of_the_same_image_on_its_side(rng):
    """Glow over a tenth of its columns: as noisy as it is, whichever way its blocks lie."""
    image = np.full((96, 960), 100, dtype=np.uint16)
    image[:, 700:796] = np.rint(rng.normal(130, 9.0, (96, 96)))
    upright, on_its_side = noisiest_background(image), noisiest_background(image.T)
    assert upright.level == on_its_side.level == 100
    assert upright.noise == pytest.approx(on_its_side.noise, rel=1e-6)


@pytest.mark.parametrize(
    ("threshold_sigma", "dn", "is_found"),
    [(3.4, 104, True), (3.4, 103, False), (3.0, 103, False), (3.0, 104, True)],
)
@pytest.mark.parametrize("kind", [np.uint16, np.int32, np.float64])
def test_a_pixel_is_a_star_s_from_the_first_code_over_the_threshold(
    threshold_sigma, dn, is_found, kind
):
    image = np.full((31, 33), 100, dtype=kind)
    image[15, 16] = dn
    settings = CentroidSettings(threshold_sigma=threshold_sigma, minimum_pixels=1)
    stars = find_stars(image, settings, LocalBackground(100.0, 1.0))
    assert len(stars) == is_found
    if is_found:
        assert (stars.peak[0], stars.pixels[0]) == (dn - 100, 1)


def test_settings_and_images_that_are_no_numbers_are_refused():
    line = refusal(CentroidSettings, threshold_sigma=np.inf)
    assert line == "centroids: threshold_sigma = inf; write a number from 0 up"
    assert "type bool, shape (9, 9)" in refusal(find_stars, np.zeros((9, 9), dtype=bool))
    assert "shape (9,)" in refusal(find_stars, np.zeros(9))
    assert "NaN or infinite" in refusal(find_stars, np.full((9, 9), np.inf))


def test_a_square_is_about_the_nearest_pixel_and_dark_beyond_each_edge():
    """Of an image whose rows are not its columns: pixel (x, y) has 10 y + x, over a level of 1."""
    height, width = 5, 7
    image = 10.0 * np.arange(height)[:, None] + np.arange(width)
    x_px, y_px = np.array([2.6, 0.4, 5.7]), np.array([1.6, -0.4, 4.3])
    values, dx_px, dy_px = squares(image, 1.0, x_px, y_px, 1)
    assert values[0].tolist() == [[11.0, 12.0, 13.0], [21.0, 22.0, 23.0], [31.0, 32.0, 33.0]]
    assert values[1].tolist() == [[0.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 9.0, 10.0]]
    assert values[2].tolist() == [[34.0, 35.0, 0.0], [44.0, 45.0, 0.0], [0.0, 0.0, 0.0]]
    assert dx_px[0, 0] == pytest.approx([-0.6, 0.4, 1.4])
    assert dy_px[0, :, 0] == pytest.approx([-0.6, 0.4, 1.4])


def test_each_axis_has_the_s_curve_of_its_own_sigma():
    """Those of a star that is turned by a quarter are exchanged; a narrow one has the larger bias.
    A window that is too narrow for one axis alone is refused.
    """
    x, y = s_curves(CentroidSettings(psf_sigma_px=(0.5, 0.9)))
    turned_x, turned_y = s_curves(CentroidSettings(psf_sigma_px=(0.9, 0.5)))
    assert turned_y.measured_px == pytest.approx(x.measured_px, abs=1e-9)
    assert turned_x.bias_px == pytest.approx(y.bias_px, abs=1e-9)
    assert np.abs(x.bias_px).max() > 10 * np.abs(y.bias_px).max()
    for sigma_px in ((0.3, 1.0), (1.0, 0.3)):
        narrow = CentroidSettings(window_sigma_px=0.5, psf_sigma_px=sigma_px)
        assert "window_sigma_px = 0.5 is too narrow for" in refusal(s_curves, narrow)
    s_curves(CentroidSettings(window_sigma_px=0.5, psf_sigma_px=(1.0, 1.0)))
