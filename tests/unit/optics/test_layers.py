"""What layers of light hide, list and count, on cameras and skies of a few stars."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.optics.camera import Camera
from hilstar.optics.layers.bodies import BodyLayer
from hilstar.optics.layers.truth import sprite_truth
from hilstar.optics.layers.view import Canvas, View
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import join_sprites
from hilstar.sky.bodies.disc import Air, Disc
from hilstar.sky.stars import Stars, with_bodies
from tests.support.stars import sprites_at, stars_at

CAMERA = Camera((96, 80), 500.0, (47.5, 39.5), np.eye(3))
CANVAS = Canvas(CAMERA, GaussianPsf((0.8, 0.8)))
AT_START = View(np.array([1.0, 0.0, 0.0, 0.0]))
AHEAD = np.array([0.0, 0.0, 1.0])
FOOTPRINT = 5


def sky_of(directions: np.ndarray) -> tuple[Stars, object]:
    """Stars in some directions, and a sprite of each, as bright."""
    stars = stars_at(directions, np.ones(len(directions)))
    order = np.argsort(stars.row)
    places = np.column_stack(CAMERA.project(stars.vectors[order]))
    return stars, replace(sprites_at(places, np.ones(len(order)), FOOTPRINT), star=order)


def test_stars_beside_a_limb_are_dimmed_by_the_air_to_its_top():
    """At the tangent heights of an exponential air: exp(-tau e^(-h / H)), tau that of a ray that
    touches the ground (Chapman's limit).
    """
    scale_km, depth, radius_km, distance_km = 8.0, 0.3, 6378.0, 6778.0
    air = Air(scale_km, depth)
    sphere = Disc(
        "Earth", AHEAD, distance_km, radius_km, radius_km, np.array([0.0, 1.0, 0.0]), -AHEAD,
        "lambert", 1.0, 1.0, air,
    )  # fmt: skip
    heights_km = np.array([-50.0, 1.0, 30.0, 50.0, 70.0, 200.0])
    angle = np.arcsin((radius_km + heights_km) / distance_km)
    directions = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    stars, light = sky_of(directions)
    stars = with_bodies(stars, ("Earth",), np.zeros(1))
    layer = BodyLayer(SimpleNamespace(names=("Earth",), discs=lambda *_: [sphere]), CANVAS)
    left = layer.unhidden(light, stars, [sphere], AT_START)
    tau = depth * np.sqrt(2 * np.pi * radius_km / scale_km)
    wanted = np.exp(-tau * np.exp(-np.maximum(heights_km, 0.0) / scale_km))
    wanted[heights_km < 0] = 0.0
    shown = np.zeros(len(heights_km))
    shown[stars.row[left.star]] = left.data["electrons_per_s"]
    assert 0.9 < wanted[3] < wanted[4] < 0.999  # the air's upper parts do dim
    # what lets through under half a percent is not drawn at all
    np.testing.assert_allclose(shown, np.where(wanted < 0.005, 0.0, wanted), rtol=2e-3)


@pytest.mark.parametrize("clipping", [[], [2], [0, 1], [4]])
def test_a_star_of_several_sprites_is_one_row_that_clips_where_any_of_them_does(clipping):
    """Three of one star, one of each of two others; the place is the middle of the light."""
    stars = stars_at(np.eye(3), np.ones(3))
    places = np.array([[10.0, 5.0], [20.0, 5.0], [30.0, 9.0], [50.0, 6.0], [60.0, 7.0]])
    light = sprites_at(places, np.array([1.0, 2.0, 1.0, 5.0, 7.0]), FOOTPRINT)
    light = replace(light, star=np.array([1, 1, 1, 0, 2]), per_star=3)
    rows, star = sprite_truth(stars, light, np.array(clipping, dtype=np.intp))
    assert star.tolist() == [0, 1, 2]
    np.testing.assert_allclose(rows["x_px"], [50.0, 20.0, 60.0], rtol=1e-6)
    np.testing.assert_allclose(rows["y_px"], [6.0, 6.0, 7.0], rtol=1e-6)
    wanted = [star in {light.star[k] for k in clipping} for star in (0, 1, 2)]
    assert rows["clipped"].tolist() == wanted


def test_an_image_without_a_star_has_no_rows():
    stars = stars_at(np.eye(3), np.ones(3))
    rows, star = sprite_truth(stars, join_sprites([], FOOTPRINT), np.empty(0, dtype=np.intp))
    assert (len(rows), len(star)) == (0, 0)
