"""A camera with a real lens: there and back, at the edges, and where it folds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.rotation import from_rotation_vector, to_matrix
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


def test_a_pixel_beyond_the_lens_has_no_direction():
    """Of a lens that ends at a tangent of 0.1, up to just beyond it and far from it."""
    camera = replace(PINHOLE, lens=Lens((0.6, 0.0, 0.0), max_tangent=0.1))
    x_px, y_px = replace(PINHOLE, lens=Lens((0.6, 0.0, 0.0))).places_px(
        np.array([0.0, 0.0999, 0.1001, 0.15]), np.zeros(4)
    )
    u, v = camera.tangents(x_px, y_px)
    assert np.isnan(u).tolist() == np.isnan(v).tolist() == [False, False, True, True]


def test_the_terms_of_a_residual_field_rise_first_along_rows_as_files_have_them():
    """T_i of the column times T_j of the row, from -1 at an edge of the outer pixel to 1 at the
    other: T0T0, T0T1, T0T2, T1T0, T1T1, T2T0. A field of each term alone has that term.
    """
    x_px, y_px = np.array([-0.5, 100.0, 1400.25]), np.array([1079.5, 700.0, 13.0])
    u = 2 * (x_px + 0.5) / SIZE[0] - 1
    v = 2 * (y_px + 0.5) / SIZE[1] - 1
    one = np.ones(3)
    wanted = np.column_stack([one, v, 2 * v**2 - 1, u, u * v, 2 * u**2 - 1])
    assert field_terms(x_px, y_px, SIZE, 2) == pytest.approx(wanted, abs=1e-12)


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


def test_an_image_s_edges_are_on_it_and_nowhere_is_not():
    x_px = np.array([-0.5, SIZE[0] - 0.5, -0.51, SIZE[0] - 0.49, 7.0, np.nan, 7.0, 7.0])
    y_px = np.array([SIZE[1] - 0.5, -0.5, 7.0, 7.0, SIZE[1] - 0.49, 7.0, np.nan, -0.51])
    assert PINHOLE.contains_px(x_px, y_px).tolist() == [True] * 2 + [False] * 6


def test_a_lens_that_folds_on_the_screen_is_refused():
    assert "folds" in refusal(bounded, replace(PINHOLE, lens=Lens((-20.0, 0.0, 0.0))), MARGIN_PX)


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


def test_a_field_is_held_beyond_a_tenth_of_half_an_image_on_every_side(rng):
    """Where its polynomials would diverge: as at the nearest place that is 1.1 half images off."""
    field = residual_field(rng)
    half_x, half_y = SIZE[0] / 2, SIZE[1] / 2
    middle_x, middle_y = half_x - 0.5, half_y - 0.5

    def shift_at(x: float, y: float) -> np.ndarray:
        """At a place in half images from the middle."""
        return np.array(
            field.at(np.array([middle_x + x * half_x]), np.array([middle_y + y * half_y]))
        )

    for x, y in ((-1.0, 0.3), (1.0, -0.2)):
        for beside in (shift_at, lambda x, y: shift_at(y, x)):
            edge = beside(1.1 * x, y)
            assert beside(3 * x, y) == pytest.approx(edge)
            assert np.abs(beside(1.05 * x, y) - edge).max() > 1e-4


def test_a_ray_that_runs_along_a_tilted_screen_or_away_from_it_has_no_place():
    """A screen turned by 1 rad about y faces 1 rad to the right: from 0.57 rad to the left on no
    ray meets it.
    """
    lens = Lens(tilt_rad=(0.0, 1.0))
    limit = -np.tan(np.pi / 2 - 1.0)
    u = np.array([limit + 1e-3, limit - 1e-3, -3.0, 3.0])
    right, down = lens.bent(u, np.full(4, 0.2))
    assert np.isfinite(right).tolist() == np.isfinite(down).tolist() == [True, False, False, True]


def test_beyond_its_lens_a_direction_goes_on_straight_from_the_principal_point(rng):
    """As many times as far as the place at the lens's bound, along each direction."""
    lens = Lens((0.3, 0.0, 0.0), (1e-2, -2e-2), max_tangent=0.1)
    camera = replace(PINHOLE, lens=lens, principal_point_px=(700.0, 610.0))
    angle = rng.uniform(0, 2 * np.pi, 20)
    bound = 0.1 * np.array([np.cos(angle), np.sin(angle)])
    centre = np.array(camera.principal_point_px)[:, None]
    at_bound = np.stack(camera.places_px(*(bound * (1 - 1e-9)))) - centre
    for times in (1.5, 4.0):
        beyond = np.stack(camera.places_outward_px(*(times * bound))) - centre
        assert beyond == pytest.approx(times * at_bound, rel=1e-6, abs=1e-5)
    within = np.stack(camera.places_outward_px(*(0.5 * bound)))
    assert within == pytest.approx(np.stack(camera.places_px(*(0.5 * bound))))


def test_the_boresight_is_cam_s_z_or_the_principal_point_where_that_is_behind():
    turned = from_rotation_vector(np.array([0.02, -0.05, 0.4]))
    camera = replace(PINHOLE, cam_to_image=to_matrix(turned))
    u, v, w = camera.cam_to_image @ np.array([0.0, 0.0, 1.0])
    focal_px, (x_px, y_px) = camera.focal_length_px, camera.principal_point_px
    assert camera.boresight_px == pytest.approx((x_px + focal_px * u / w, y_px + focal_px * v / w))
    behind = replace(PINHOLE, cam_to_image=np.diag([1.0, -1.0, -1.0]))
    assert behind.boresight_px == behind.principal_point_px


@pytest.mark.parametrize("lens", [None, Lens((0.6, -0.5, 2.0), (-2e-2, 1e-2), (0.3, -0.5))])
def test_an_image_s_scales_and_solid_angles_are_those_of_small_turns(lens, rng):
    """Pixels to a radian by turns of 1e-5 rad about 24 axes from places up to the edges, where
    this lens has its extremes: they are the two scales, and a pinhole's are those of its axis. A
    pixel's solid angle is that of its four corners, by the excess of their triangles.
    """
    camera = bounded(replace(PINHOLE, lens=lens, principal_point_px=(500.0, 800.0)), MARGIN_PX)
    smallest, largest = camera.scales_px_rad()
    if lens is None:
        assert smallest == largest == camera.focal_length_px
    else:
        edges = camera.rays(*camera.grid_px((17, 9)))
        edges /= np.linalg.norm(edges, axis=1, keepdims=True)
        right = np.cross(edges, [0.3, 0.9, -0.2])
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        per_rad = []
        for angle in np.pi * np.arange(24) / 24:
            aside = np.cos(angle) * right + np.sin(angle) * np.cross(edges, right)
            ends = [camera.project_outward(edges + step * aside) for step in (-5e-6, 5e-6)]
            per_rad.append(np.hypot(*(np.stack(ends[1]) - np.stack(ends[0]))) / 1e-5)
        assert smallest == pytest.approx(np.min(per_rad), rel=5e-3)
        assert largest == pytest.approx(np.max(per_rad), rel=5e-3)
    x, y = rng.uniform(-0.5, np.array(SIZE)[:, None] - 0.5, (2, 300))
    corners = [
        camera.rays(x + right / 2, y + down / 2)
        for right, down in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    corners = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in corners]
    sr = sum(
        np.abs(np.einsum("ni,ni->n", a, np.cross(b, c))) / 2
        for a, b, c in ((corners[0], corners[1], corners[2]), (corners[0], corners[2], corners[3]))
    )
    assert camera.pixel_sr(x, y) == pytest.approx(sr, rel=1e-5)


@pytest.mark.parametrize("rate_rad_s", [(0.03, -0.01, 0.02), (-0.01, 0.03, 0.0), (0.0, 0.0, 0.05)])
def test_a_lens_s_fastest_star_is_as_fast_as_finite_differences_say(rng, rate_rad_s):
    """From places all over the image, its edges among them, through a lens that is nowhere
    symmetric, for a turn of 2 ms. Here the fastest is at the edge, where places are tried.
    """
    lens = Lens((0.6, -0.5, 2.0), (-2e-2, 1e-2), (0.3, -0.5), residual_field(rng))
    camera = bounded(replace(PINHOLE, lens=lens, principal_point_px=(500.0, 800.0)), MARGIN_PX)
    u, v = camera.tangents(*camera.grid_px((65, 49)))
    rays = np.stack([u, v, np.ones_like(u)], axis=1)
    turn = to_matrix(from_rotation_vector(-1e-3 * np.array(rate_rad_s)))
    later = np.stack(camera.project_outward(rays @ turn.T))
    earlier = np.stack(camera.project_outward(rays @ turn))
    fastest = np.hypot(*(later - earlier)).max() / 2e-3
    assert camera.fastest_px_s(np.array(rate_rad_s)) == pytest.approx(fastest, rel=0.01)


def test_by_a_turn_of_a_right_angle_any_direction_may_come_into_view(rng):
    """Of a screen 22 deg to its corner: from a reach of 68 deg on none is culled."""
    around = rng.normal(size=(200, 3))
    reach_rad = np.pi / 2 - PINHOLE.field_radius_rad(MARGIN_PX)
    assert len(PINHOLE.in_view(around, MARGIN_PX, reach_rad + 1e-6)) == 200
    assert len(PINHOLE.in_view(around, MARGIN_PX, reach_rad - 0.1)) < 200


def test_the_field_reaches_to_the_corner_that_is_farthest_from_the_principal_point():
    for middle_px in ((300.0, 200.0), (1500.0, 200.0), (300.0, 900.0), (1500.0, 900.0)):
        camera = replace(PINHOLE, principal_point_px=middle_px)
        corners = [
            camera.rays(np.array([x]), np.array([y]))[0]
            for x in (-0.5 - MARGIN_PX, SIZE[0] - 0.5 + MARGIN_PX)
            for y in (-0.5 - MARGIN_PX, SIZE[1] - 0.5 + MARGIN_PX)
        ]
        farthest_rad = max(np.arctan(np.hypot(u, v)) for u, v, _ in corners)
        assert camera.field_radius_rad(MARGIN_PX) == pytest.approx(farthest_rad)
        # the planes of the image's sides, a margin outside it, pass through two corners each
        along = np.array(corners) @ camera.edges(MARGIN_PX).T
        assert (np.abs(along) < 1e-12).sum(axis=0).tolist() == [2, 2, 2, 2]
        assert along.min() > -1e-12
        # so do those of a lens, but for a side's bow, and it has a direction for each corner
        bowed = bounded(replace(camera, lens=Lens((0.3, 0.0, 0.0))), MARGIN_PX)
        sides = np.linspace(-0.5 - MARGIN_PX, np.array(SIZE) - 0.5 + MARGIN_PX, 33).T
        border = [np.array([x, y]) for x in sides[0] for y in sides[1][[0, -1]]]
        border += [np.array([x, y]) for x in sides[0][[0, -1]] for y in sides[1]]
        within = bowed.rays(*np.array(border).T) @ bowed.edges(MARGIN_PX).T
        assert np.isfinite(within).all()
        assert within.min() > 0
        assert within.min(axis=0).max() < 1e-3


def test_a_wide_field_s_fastest_star_is_as_fast_as_finite_differences_say(rng):
    """Through a corner of 75 deg, of a camera that turns about an axis beside its own."""
    camera = replace(
        PINHOLE, focal_length_px=300.0, principal_point_px=(700.0, 400.0), resolution_px=(1600, 900)
    )
    for rate in ([0.3, -0.2, 0.5], [-0.1, 0.4, -0.6], [0.0, 0.0, 1.0]):
        x, y = np.meshgrid(np.linspace(-0.5, 1599.5, 120), np.linspace(-0.5, 899.5, 80))
        rays = camera.rays(x.ravel(), y.ravel())
        step_s = 1e-6
        before, after = (
            np.stack(camera.project(rays - sign * step_s * np.cross(rate, rays)))
            for sign in (-1, 1)
        )
        fastest = np.hypot(*(after - before)).max() / (2 * step_s)
        assert camera.fastest_px_s(np.array(rate)) == pytest.approx(fastest, rel=0.02)
