"""Stars that the edge of the detector cuts: measured and marked, wherever their centre goes."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.tracker.centroids import (
    CentroidSettings,
    LocalBackground,
    estimate_background,
    find_stars,
    noisiest_background,
)

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
