"""The picture of a tracker's frame: bright stars are told apart, and nothing is made of noise."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label

from hilstar.twin.pictures import MAX_RADIUS_PX, exposure_picture

FULL = 2900  # DN at which every one of these stars is full


def frame(rng, stars=(), size=200):
    """A frame of noise about 80 DN with stars (row, column, peak DN) of sigma 0.7 px, cut at FULL."""
    rows, columns = np.mgrid[:size, :size]
    light = rng.normal(80, 5, (size, size))
    for row, column, peak in stars:
        light += peak * np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / (2 * 0.7**2))
    return np.clip(np.rint(light), 0, FULL).astype(np.uint16)


def test_saturated_stars_have_discs_that_tell_their_magnitudes(rng):
    peaks = [4000 * 10 ** (0.4 * mag) for mag in range(5)]  # the faintest is full already
    picture = exposure_picture(frame(rng, [(30 + 35 * k, 100, peak) for k, peak in enumerate(peaks)]))
    boxes = [picture[20 + 35 * k : 41 + 35 * k, 90:111] for k in range(5)]
    areas = [int((box > 0.5 * box[10, 10]).sum()) for box in boxes]
    assert areas == sorted(areas)
    assert areas[4] > 4 * areas[0]
    greys = [int(box[10, 10]) for box in boxes]
    assert greys == sorted(greys)
    assert greys[0] < 225 < greys[4] == 255


def test_noise_alone_has_no_discs(rng):
    picture = exposure_picture(frame(rng))
    _, count = label(picture > 200)
    assert count < 20
    assert 0 < np.median(picture[picture > 0]) < 180


def test_any_frame_has_a_picture():
    for dn in (np.zeros((1, 1)), np.full((3, 40), 65535), np.eye(300) * 65535, np.zeros((7, 9))):
        picture = exposure_picture(dn.astype(np.uint16))
        assert picture.shape == dn.shape
        assert picture.dtype == np.uint8


def test_a_star_at_the_edge_is_drawn_as_far_as_the_frame_goes(rng):
    picture = exposure_picture(frame(rng, [(0, 199, 1e6)]))
    assert picture[0, 199] == 255
    assert (picture[:MAX_RADIUS_PX, -MAX_RADIUS_PX:] == 255).mean() > 0.6
    assert (picture == 255).sum() < (MAX_RADIUS_PX + 1) ** 2
