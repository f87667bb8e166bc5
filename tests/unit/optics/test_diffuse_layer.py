"""Where diffuse light is looked for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.display.render.reference import extended_image
from hilstar.optics.camera import Camera
from hilstar.optics.layers.diffuse_layer import CELL_PX, DiffuseLayer, _Face, _Part
from hilstar.optics.layers.star_layer import no_light
from hilstar.optics.layers.view import Canvas, View
from hilstar.optics.psf import GaussianPsf
from hilstar.sky.diffuse import TangentImage
from tests.support.stars import stars_at

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


def test_a_map_is_as_round_and_as_wide_as_the_psf_in_the_mean_of_its_axes():
    """One lit pixel, as large as the camera's and in its middle: a Gaussian of the mean of both
    variances and that of a pixel, 1/12, over which a PSF is summed; in electrons of a pixel's own
    solid angle.
    """
    focal_px, size_px, place_px = 2000.0, (64, 48), (40.0, 20.0)
    camera = Camera(size_px, focal_px, place_px, np.eye(3))
    image = np.zeros((21, 21), dtype=np.float32)
    image[10, 10] = 1e9
    canvas = Canvas(camera, GaussianPsf((0.7, 1.9)))
    layer = DiffuseLayer((TangentImage(image, np.eye(3), focal_px),), canvas)
    stars = stars_at(-np.eye(3), np.ones(3))
    nothing = no_light(canvas.psf.footprint_px)
    seen = layer.add(nothing, stars, View(np.array([1.0, 0.0, 0.0, 0.0])))
    light = extended_image(seen.extended, size_px)
    assert light.sum() == pytest.approx(1e9 / focal_px**2, rel=1e-3)
    y, x = np.indices(light.shape)
    for at, middle in ((x, place_px[0]), (y, place_px[1])):
        assert np.average(at, weights=light) == pytest.approx(middle, abs=1e-3)
        variance = np.average((at - middle) ** 2, weights=light)
        # a filter cut at 4 sigmas has 0.1 % less, and pixels off the axis their own solid angle
        assert variance == pytest.approx((0.7**2 + 1.9**2) / 2 + 1 / 12, rel=5e-3)


@pytest.mark.parametrize(("first_step_share", "words"), [(0.5, "is drawn where"), (2.0, "is not")])
def test_a_monitor_s_map_is_kept_for_an_attitude_of_either_sign_and_said(first_step_share, words):
    """Its brightest pixel beside the screen's first step; q and -q are one attitude."""
    focal_px = 2000.0
    image = np.zeros((20, 20), dtype=np.float32)
    image[5:15, 5:15] = 1e9
    largest = 1e9 / focal_px**2
    camera = Camera((64, 48), focal_px, (31.5, 23.5), np.eye(3))
    step = largest * first_step_share
    canvas = Canvas(camera, GaussianPsf((0.1, 0.1)), first_step_e_per_s=step)
    layer = DiffuseLayer((TangentImage(image, np.eye(3), focal_px),), canvas)
    assert f"has {1 / first_step_share:.3g} of the light" in layer.line()
    assert f"it {words}" in layer.line()
    stars = stars_at(-np.eye(3), np.ones(3))
    q = np.array([0.9999, 0.008, -0.006, 0.01])
    seen = [layer.add(no_light(5), stars, View(sign * q)).extended for sign in (1, -1)]
    assert len(seen[0]) == (1 if first_step_share < 1 else 0)
    assert all(one is other for one, other in zip(*seen, strict=True))


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


@pytest.mark.parametrize("way", [(1, 0), (0, 1), (-1, 0), (0, -1)])
def test_a_face_holds_what_is_within_45_degrees_on_all_four_sides(way):
    """A face of 10 px a tangent about pixel 12, with two more around its edge."""
    face = _Face(TangentImage(np.ones((25, 25), np.float32), np.eye(3), 10.0, 1.0), PX_RAD, 0.5)
    off_px = np.array([0.0, 9.0, 10.0, 11.0, 12.0])
    x_px, y_px = 12.0 + np.outer(way, off_px).astype(np.float32)
    assert face.holds(x_px, y_px).tolist() == [True, True, True, False, False]
