"""Where diffuse light is looked for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.optics.layers.diffuse_layer import CELL_PX, _Face, _Part
from hilstar.sky.diffuse import TangentImage

PX_RAD = 1e-4
ROUNDING_PX = 1e-6


@pytest.mark.parametrize("size", [8, 9])
def test_one_lit_pixel_is_the_middle_of_its_light(size):
    """All else is dark, so that the light reaches over the cells alone that touch the pixel."""
    # right, up and ahead of ICRS: no axis is its own opposite
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    image = np.zeros((size, size), dtype=np.float32)
    image[1, 5] = 2.0
    face = _Face(TangentImage(image, axes, 1 / PX_RAD), PX_RAD, 1.0)
    column, row = face.image.places_px(face.middle)
    assert (column, row) == pytest.approx((5.0, 1.0), abs=ROUNDING_PX)
    assert math.acos(face.cos_radius) == pytest.approx(3 * CELL_PX * PX_RAD, rel=1e-6)


def test_no_pixel_has_a_direction_beside_or_behind_the_plane():
    ahead = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.3, 0.2, -1.0]])
    image = TangentImage(np.zeros((5, 5), dtype=np.float32), np.eye(3), 100.0)
    columns, rows = image.places_px(ahead)
    assert (columns[0], rows[0]) == (2.0, 2.0)
    assert np.isnan([columns[1:], rows[1:]]).all()


def test_a_pixel_that_two_faces_hold_is_one_s_alone():
    """On the common edge of two faces of a cube, which both hold: else it would be lit twice."""
    taken = np.zeros((6, 8), dtype=bool)
    taken[0, 0] = True
    first_holds = np.array([[True, True, False], [True, True, True]])
    nothing = np.empty((0, 0), dtype=np.float32)
    first, second = (
        _Part((2, 3), (), nothing, nothing, np.ones((2, 3), dtype=bool)) for _ in range(2)
    )
    first.keep(first_holds, taken)
    assert first.own.tolist() == first_holds.tolist()
    second.keep(np.ones((2, 3), dtype=bool), taken)
    assert second.own.tolist() == (~first_holds).tolist()
    assert taken[3:5, 2:5].all()
    assert taken.sum() == 1 + 6
