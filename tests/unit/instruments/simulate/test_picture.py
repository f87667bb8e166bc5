"""The picture of a tracker's frame: bright stars are told apart, and nothing is made of noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import label

from hilstar.instruments.simulate.eye_picture import (
    MAX_RADIUS_PX,
    _discs,
    exposure_picture,
    sky_under,
)

FULL = 2900  # DN at which every one of these stars is full
SKY_DN, NOISE_DN = 80, 5
SEEN = 150  # a grey that discs of bright stars have, and noise has not


def noisy_frame(rng, stars=(), size=200, across_dn=0, down_dn=0, body_dn=None):
    """A frame of noise about SKY_DN with stars (row, column, peak DN) of sigma 0.7 px, cut at FULL.

    The sky grows by `across_dn` and `down_dn` from edge to edge; `body_dn` (height, width) is of a
    body's light.
    """
    rows, columns = np.mgrid[:size, :size]
    light = rng.normal(SKY_DN, NOISE_DN, (size, size))
    light += across_dn * columns / size + down_dn * rows / size
    if body_dn is not None:
        light += body_dn
    for row, column, peak in stars:
        light += peak * np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / (2 * 0.7**2))
    return np.clip(np.rint(light), 0, FULL).astype(np.uint16)


def picture_of(dn):
    return exposure_picture(dn, FULL)


def disc_pixels(row, column, radius, size=200):
    rows, columns = np.mgrid[:size, :size]
    return np.hypot(rows - row, columns - column) <= radius


def test_a_gradient_of_stray_light_is_no_star(rng):
    """A thousand times the noise from corner to corner, as Rosetta's camera has it: stars alone
    have discs.
    """
    stars = [(60, 50, 1500), (190, 190, 1500), (15, 180, 1500)]
    picture = picture_of(noisy_frame(rng, stars, across_dn=700, down_dn=500))
    _, count = label(picture > SEEN)
    assert count == len(stars)
    corners = [picture[:40, :40], picture[140:180, 140:180]]
    near, far = (float(np.median(corner)) for corner in corners)
    assert abs(near - far) < 20  # the sky is as dark in the brightest corner as in the darkest


def test_a_curved_sky_is_no_star(rng):
    """Vignetting and stray light fall off as a square of the distance from the middle."""
    rows, columns = np.mgrid[:200, :200]
    hill_dn = 800 * (1 - ((rows - 100) ** 2 + (columns - 100) ** 2) / 2e4)
    picture = picture_of(noisy_frame(rng, [(100, 40, 1500)], body_dn=hill_dn))
    _, count = label(picture > SEEN)
    assert count == 1


@pytest.mark.parametrize("size_px", [(272, 288), (288, 272), (150, 203)])
def test_a_slanted_sky_is_its_own_to_the_corners(size_px):
    """By blocks of 17 by 18 px, and by some that leave rows and columns over, without noise."""
    height, width = size_px
    y, x = np.mgrid[:height, :width]
    slanted_dn = 1000 + 5 * x - 3 * y
    assert sky_under(slanted_dn.astype(np.uint16)).level_dn == pytest.approx(slanted_dn, abs=1e-6)


@pytest.mark.parametrize("radius_px", [12, 30, 70])
def test_a_body_has_its_own_size(rng, radius_px):
    """The Moon saturates: discs about its plateau made it a lump, wider by up to 16 px."""
    shape = disc_pixels(100, 100, radius_px)
    picture = picture_of(noisy_frame(rng, [(10, 10, 1500)], body_dn=5000.0 * shape))
    assert np.array_equal(picture[:, 30:] == 255, shape[:, 30:])
    assert picture[10, 10] > SEEN  # and a star beside it is seen


def test_a_body_over_the_frame_is_white(rng):
    picture = picture_of(np.full((200, 300), FULL, np.uint16))
    assert (picture == 255).all()


def test_a_trail_has_no_discs(rng):
    """A star of 40 px of smear is seen as long as it is."""
    trail_dn = 400.0 * (disc_pixels(100, 100, 40) & (np.abs(np.mgrid[:200, :200][0] - 100) <= 1))
    picture = picture_of(noisy_frame(rng, body_dn=trail_dn))
    lit_rows = np.flatnonzero((picture > 100).any(axis=1))
    assert 99 <= lit_rows.min() <= lit_rows.max() <= 101


def test_a_frame_of_noise_is_dark(rng):
    """Nothing at all was stretched until its noise was as bright as stars."""
    picture = picture_of(noisy_frame(rng))
    assert np.percentile(picture, 99) < 80


def test_saturated_stars_have_discs_that_tell_their_magnitudes(rng):
    peaks = [4000 * 10 ** (0.4 * mag) for mag in range(5)]  # the faintest is full already
    picture = picture_of(
        noisy_frame(rng, [(30 + 35 * k, 100, peak) for k, peak in enumerate(peaks)])
    )
    boxes = [picture[20 + 35 * k : 41 + 35 * k, 90:111] for k in range(5)]
    areas = [int((box > 0.5 * box[10, 10]).sum()) for box in boxes]
    assert areas == sorted(areas)
    assert areas[4] > 4 * areas[0]
    greys = [int(box[10, 10]) for box in boxes]
    assert greys == sorted(greys)
    assert greys[0] < 225 < greys[4] == 255


def test_noise_alone_has_no_discs(rng):
    picture = picture_of(noisy_frame(rng))
    _, count = label(picture > 200)
    assert count < 20
    assert 0 < np.median(picture[picture > 0]) < 180


def test_any_frame_has_a_picture():
    for dn in (np.zeros((1, 1)), np.full((3, 40), 65535), np.eye(300) * 65535, np.zeros((7, 9))):
        picture = picture_of(dn.astype(np.uint16))
        assert picture.shape == dn.shape
        assert picture.dtype == np.uint8


def test_a_star_at_the_edge_is_drawn_as_far_as_the_frame_goes(rng):
    picture = picture_of(noisy_frame(rng, [(0, 199, 1e6)]))
    assert picture[0, 199] == 255
    assert (picture[:MAX_RADIUS_PX, -MAX_RADIUS_PX:] == 255).mean() > 0.6
    assert (picture == 255).sum() < (MAX_RADIUS_PX + 1) ** 2


@pytest.mark.parametrize(("share", "radius_px"), [(1.0, 8), (0.5, 5), (0.25, 3)])
def test_a_disc_s_radius_is_of_a_power_of_its_light(rng, share, radius_px):
    """8 px for the brightest, and of a share of its light that to 0.77."""
    assert radius_px == round(MAX_RADIUS_PX * share**0.77)
    picture = picture_of(noisy_frame(rng, [(60, 50, 2500), (120, 130, 2500 * share)]))
    disc = picture[112:129, 122:139]
    wanted = disc_pixels(8, 8, radius_px, size=17)
    assert (disc[wanted] == disc[8, 8]).all()
    assert not (disc[~wanted] == disc[8, 8]).any()


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
@pytest.mark.parametrize(
    ("greys", "row"), [((0.9, 0.4), [0.9] * 7 + [0.4]), ((0.4, 0.9), [0.4] + [0.9] * 7)]
)
def test_of_two_discs_the_brighter_shows(order, greys, row):
    kept = list(order)
    places = (np.array([10, 10])[kept], np.array([10, 13])[kept])
    drawn = _discs((21, 30), places, np.full(2, 4.0), np.array(greys)[kept])
    assert drawn[10, 8:16].tolist() == row


@pytest.mark.parametrize("size_px", [(12, 40), (40, 12)])
def test_a_disc_in_a_corner_of_an_oblong_frame_is_drawn_as_far_as_that_goes(size_px):
    """Of 2 px: three pixels of its middle row and column, and two of those beside."""
    last = np.array(size_px) - 1
    drawn = _discs(size_px, (last[:1], last[1:]), np.array([2.0]), np.array([0.7]))
    corner = drawn[-3:, -3:]
    assert corner.tolist() == [[0, 0, 0.7], [0, 0.7, 0.7], [0.7, 0.7, 0.7]]
    assert np.count_nonzero(drawn) == 6
