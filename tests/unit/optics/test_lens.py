"""A camera with a real lens: there and back, at the edges, and where it folds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.display.geometry import monitor_camera
from hilstar.optics.camera import Lens, ResidualField, bounded, field_terms, ray_shifts
from tests.support.refusals import refusal

SIZE = (1920, 1080)
PINHOLE = monitor_camera(SIZE, 57.65, 350.0, np.array([1.0, 0.0, 0.0, 0.0]))
INVERSE_PX = 1e-6
MARGIN_PX = 20.0


def residual_field(rng, degree=5, px=0.4):
    count = (degree + 1) * (degree + 2) // 2
    return ResidualField.of_terms(rng.normal(0, px, count), rng.normal(0, px, count), degree, SIZE)


def lenses(rng):
    tilt = (np.radians(1.0), np.radians(-0.7))
    return [
        Lens((0.6, 0.0, 0.0)),
        Lens((-0.4, 0.1, 0.0), (1e-3, -2e-3)),
        Lens(tilt_rad=tilt),
        Lens(field=residual_field(rng)),
        Lens((0.6, -0.5, 2.0), (-2e-3, 1e-3), tilt, residual_field(rng)),
    ]


@pytest.mark.parametrize("kind", range(5))
def test_the_way_back_ends_where_it_began_over_the_whole_screen(rng, kind):
    camera = bounded(replace(PINHOLE, lens=lenses(rng)[kind]), MARGIN_PX)
    x, y = np.meshgrid(np.linspace(-0.5, SIZE[0] - 0.5, 61), np.linspace(-0.5, SIZE[1] - 0.5, 41))
    again_x, again_y = camera.places_px(*camera.tangents(x.ravel(), y.ravel()))
    assert np.hypot(again_x - x.ravel(), again_y - y.ravel()).max() < INVERSE_PX


@pytest.mark.parametrize("kind", range(5))
def test_every_direction_on_the_screen_is_within_the_cull_and_none_behind_it_comes_back(rng, kind):
    camera = bounded(replace(PINHOLE, lens=lenses(rng)[kind]), MARGIN_PX)
    edge = np.linspace(-0.5 - MARGIN_PX, SIZE[0] - 0.5 + MARGIN_PX, 200)
    u, v = camera.tangents(edge, np.full(200, -0.5 - MARGIN_PX))
    assert np.arctan(np.hypot(u, v)).max() <= camera.field_radius_rad(0.0) * (1 + 1e-9)
    far = camera.lens.max_tangent * np.linspace(1.001, 6.0, 50)
    assert np.isnan(camera.places_px(far, np.zeros(50))[0]).all()


def test_an_ideal_lens_is_the_pinhole():
    camera = bounded(replace(PINHOLE, lens=Lens()), MARGIN_PX)
    rays = PINHOLE.rays(np.array([0.0, 700.0, 1919.0]), np.array([1079.0, 300.0, 0.0]))
    for ours, theirs in zip(camera.project(rays), PINHOLE.project(rays), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_a_tilted_screen_is_what_tracing_rays_onto_the_tilted_plane_gives():
    a, b = np.radians([2.0, -3.0])
    camera = replace(PINHOLE, lens=Lens(tilt_rad=(a, b)))
    u, v = np.array([0.0, 0.1, -0.12, 0.05]), np.array([0.0, -0.06, 0.07, 0.08])
    focal = camera.focal_length_px
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    axes = about_y @ about_x
    rays = np.column_stack([u, v, np.ones(4)])
    hits = rays * (focal * axes[2, 2] / (rays @ axes[:, 2]))[:, None] - [0, 0, focal]
    x, y = camera.places_px(u, v)
    np.testing.assert_allclose(x - camera.principal_point_px[0], hits @ axes[:, 0], atol=1e-8)
    np.testing.assert_allclose(y - camera.principal_point_px[1], hits @ axes[:, 1], atol=1e-8)


def test_the_fields_terms_are_its_values(rng):
    shift = residual_field(rng)
    x, y = rng.uniform(0, SIZE[0], 50), rng.uniform(0, SIZE[1], 50)
    terms = field_terms(x, y, SIZE, 5)
    ones = ResidualField.of_terms(np.ones(terms.shape[1]), np.zeros(terms.shape[1]), 5, SIZE)
    np.testing.assert_allclose(ones.at(x, y)[0], terms.sum(axis=1), atol=1e-12)
    t_x, t_y = (2 * x - SIZE[0] + 1) / SIZE[0], (2 * y - SIZE[1] + 1) / SIZE[1]
    np.testing.assert_allclose(
        shift.at(x, y)[0], np.polynomial.chebyshev.chebval2d(t_x, t_y, shift.x), atol=1e-12
    )


def test_a_lens_that_folds_on_the_screen_is_refused():
    assert "folds" in refusal(bounded, replace(PINHOLE, lens=Lens((-20.0, 0.0, 0.0))), MARGIN_PX)


def test_the_fastest_star_is_as_fast_as_finite_differences_say(rng):
    camera = bounded(replace(PINHOLE, lens=lenses(rng)[4]), MARGIN_PX)
    rate, step_s = np.array([0.1, -0.3, 0.4]), 1e-6
    x, y = np.meshgrid(np.linspace(-0.5, SIZE[0] - 0.5, 41), np.linspace(-0.5, SIZE[1] - 0.5, 31))
    u, v = camera.tangents(x.ravel(), y.ravel())
    seen = np.column_stack([u, v, np.ones_like(u)])
    moved = seen - np.cross(rate, seen) * step_s
    x1, y1 = camera.project(moved)
    fastest = np.nanmax(np.hypot(x1 - x.ravel(), y1 - y.ravel())) / step_s
    assert camera.fastest_px_s(rate) == pytest.approx(fastest, rel=0.02)


def test_decentring_is_brown_s_as_opencv_writes_it(rng):
    """x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), and so with y, p1 and p2."""
    k1, k2, k3, p1, p2 = 0.3, -0.2, 0.1, 0.02, -0.05
    x, y = rng.uniform(-0.3, 0.3, (2, 50))
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent_x, bent_y = Lens((k1, k2, k3), (p1, p2)).bent(x, y)
    np.testing.assert_allclose(bent_x, x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2))
    np.testing.assert_allclose(bent_y, y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y)


def test_an_image_spans_half_a_pixel_beyond_the_centres_of_its_outer_pixels():
    width, height = SIZE
    inside = 1e-9
    x = np.array([-0.5, width - 0.5, 0.0, 0.0])
    y = np.array([0.0, 0.0, -0.5, height - 0.5])
    outward = np.array([[-1, 1, 0, 0], [0, 0, -1, 1]]) * inside
    assert PINHOLE.contains_px(x - outward[0], y - outward[1]).all()
    assert not PINHOLE.contains_px(x + outward[0], y + outward[1]).any()


def test_the_shader_s_map_of_a_lens_runs_from_edge_to_edge_of_the_image():
    camera = bounded(replace(PINHOLE, lens=Lens((0.6, 0.0, 0.0))), MARGIN_PX)
    shifts = ray_shifts(camera)
    width, height = SIZE
    for row, y in ((0, -0.5), (-1, height - 0.5)):
        for column, x in ((0, -0.5), (-1, width - 0.5)):
            place = np.array([x]), np.array([y])
            lens = np.ravel(camera.tangents(*place))
            pinhole = np.ravel(PINHOLE.tangents(*place))
            np.testing.assert_allclose(shifts[row, column], lens - pinhole, rtol=1e-6)


def test_a_lens_that_folds_inside_and_opens_again_at_the_edge_is_refused():
    """r (1 - 260 r^2 + 26000 r^4) falls from r = 0.043 to 0.064: the zeros of 1 - 780 r^2 + 130000
    r^4. The image reaches to 0.18.
    """
    lens = Lens((-260.0, 26_000.0, 0.0))
    assert "folds" in refusal(bounded, replace(PINHOLE, lens=lens), MARGIN_PX)
