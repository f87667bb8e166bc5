"""The traced bench and the planted dots of the study of geometric calibration, by closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.calibrate.geometric.dots import DotPlan
from hilstar.instruments.study import geometry
from hilstar.instruments.study.geometry import (
    DotFaults,
    TracedBench,
    observed_dots,
    turned,
)
from hilstar.optics.camera import Camera

SIZE_PX = (400, 300)
UPRIGHT = {
    "lens_tilt_deg": (0.0, 0.0),
    "lens_shift_mm": (0.0, 0.0),
    "screen_tilt_deg": (0.0, 0.0, 0.0),
    "screen_shift_mm": (0.0, 0.0),
}


def test_a_turn_is_about_x_then_y_then_z():
    assert turned(90, 0) @ [0, 1, 0] == pytest.approx([0, 0, 1])
    assert turned(0, 90) @ [0, 0, 1] == pytest.approx([1, 0, 0])
    assert turned(0, 0, 90) @ [1, 0, 0] == pytest.approx([0, 1, 0])
    # about x first: z goes to -y, which a turn about z then takes to x
    assert turned(90, 0, 90) @ [0, 0, 1] == pytest.approx([1, 0, 0])


@pytest.mark.parametrize("focal_mm", [350.0, 200.0])
def test_an_upright_doublet_has_its_focal_length_and_its_axis_in_the_middle(focal_mm):
    bench = TracedBench(focal_mm=focal_mm, to_lens_mm=60.0, **UPRIGHT)
    slope = 1e-4
    x, y = bench.places_px(np.array([[0.0, 0.0, 1.0], [slope, 0.0, 1.0], [0.0, slope, 1.0]]))
    assert (x[0], y[0]) == pytest.approx((959.5, 539.5), abs=1e-6)
    # a design of thin glass: the focal length is a percent off at most, and alike along both axes
    focal_px = focal_mm / bench.pitch_mm
    assert (x[1] - x[0]) / slope == pytest.approx(focal_px, rel=0.02)
    assert y[2] - y[0] == pytest.approx(x[1] - x[0], rel=1e-9)


def test_a_screen_that_is_moved_moves_the_image_the_other_way():
    direction = np.array([[0.0, 0.0, 1.0]])
    x, y = TracedBench(**UPRIGHT).places_px(direction)
    shifted = TracedBench(**UPRIGHT | {"screen_shift_mm": (0.5, -0.3)})
    moved_x, moved_y = shifted.places_px(direction)
    assert (moved_x - x)[0] == pytest.approx(-0.5 / shifted.pitch_mm)
    assert (moved_y - y)[0] == pytest.approx(0.3 / shifted.pitch_mm)
    # the screen turned about z turns the image the other way
    turn = TracedBench(**UPRIGHT | {"screen_tilt_deg": (0.0, 0.0, 2.0)})
    at = np.array([[0.01, 0.0, 1.0]])
    straight_x, _ = TracedBench(**UPRIGHT).places_px(at)
    x, y = turn.places_px(at)
    reach_px = straight_x[0] - 959.5
    assert x[0] - 959.5 == pytest.approx(reach_px * np.cos(np.radians(2)))
    assert y[0] - 539.5 == pytest.approx(-reach_px * np.sin(np.radians(2)))


def test_directions_are_those_whose_rays_meet_the_pixels():
    bench = TracedBench()
    x, y = (part.ravel() for part in np.meshgrid([0.0, 700.0, 1919.0], [0.0, 400.0, 1079.0]))
    found_x, found_y = bench.places_px(bench.directions(x, y))
    np.testing.assert_allclose(found_x, x, atol=1e-6)
    np.testing.assert_allclose(found_y, y, atol=1e-6)


def plan_of(x_px, y_px, frames: int) -> DotPlan:
    """Dots that are lit in every other frame, in turn."""
    lit = (np.arange(len(x_px))[:, None] + np.arange(frames)) % 2 == 0
    return DotPlan(x_px, y_px, lit)


def test_planted_dots_are_seen_in_their_frames_with_their_noise(rng):
    x, y = rng.uniform(1, 398, 900), rng.uniform(1, 298, 900)
    x[0], y[1] = 400.0, -1.0  # beyond the edge
    plan = plan_of(x, y, 4)
    exact = observed_dots(plan, x, y, SIZE_PX, DotFaults(0.0, 0.0, 0.0), rng)
    for frame in range(4):
        of_frame = exact.frame == frame
        dots = np.flatnonzero(plan.lit[:, frame])
        dots = dots[dots > 1]
        np.testing.assert_array_equal(exact.x_px[of_frame], x[dots])
        np.testing.assert_array_equal(exact.y_px[of_frame], y[dots])
    noisy = observed_dots(plan, x, y, SIZE_PX, DotFaults(0.3, 0.0, 0.0), rng)
    off = np.concatenate([noisy.x_px - exact.x_px, noisy.y_px - exact.y_px])
    assert off.std() == pytest.approx(0.3, rel=0.06)
    assert off.mean() == pytest.approx(0.0, abs=0.02)
    fewer = observed_dots(plan, x, y, SIZE_PX, DotFaults(0.0, 0.2, 0.1), rng)
    total = len(exact.x_px)
    known = set(zip(exact.x_px.tolist(), exact.y_px.tolist(), strict=True))
    true = [place in known for place in zip(fewer.x_px.tolist(), fewer.y_px.tolist(), strict=True)]
    assert sum(true) == pytest.approx(0.8 * total, abs=4 * np.sqrt(0.16 * total))
    false_mean = 0.1 * 0.8 * total
    assert len(true) - sum(true) == pytest.approx(false_mean, abs=4 * np.sqrt(false_mean))
    # false ones are anywhere on the detector, whose sides differ
    false = ~np.array(true)
    assert 300 < fewer.x_px[false].max() < 400 and fewer.y_px[false].max() < 300


def test_a_star_s_error_is_how_far_it_is_shown_from_its_traced_place():
    """A camera whose principal point is 3 px to the right and 4 px down of the true one's."""
    true = Camera(SIZE_PX, 1000.0, (199.5, 149.5), np.eye(3))
    off = replace(true, principal_point_px=(202.5, 153.5))
    x_px, y_px = geometry.star_places_px(SIZE_PX)
    errors_arcsec = geometry.off_arcsec(off, x_px, y_px, true.rays(x_px, y_px))
    assert len(errors_arcsec) == geometry.STARS
    np.testing.assert_allclose(errors_arcsec, 5 * ARCSEC_PER_RAD / 1000, rtol=1e-9)
    # all over the screen, from edge to edge of its outermost pixels
    for place_px, side_px in zip((x_px, y_px), SIZE_PX, strict=True):
        ends = place_px.min(), place_px.max()
        assert ends == pytest.approx((-0.5, side_px - 0.5), abs=side_px / 400)


@pytest.mark.parametrize("tilt_deg", [(4.0, 2.5), (-1.0, 3.0)])
def test_a_ray_along_a_lens_s_own_axis_goes_straight_through_it(tilt_deg):
    """Of a lens that is tilted and shifted so that its axis runs through the pupil."""
    axis = turned(*tilt_deg)[:, 2]
    vertex = axis / axis[2] * 60.0
    lens = {"lens_tilt_deg": tilt_deg, "lens_shift_mm": tuple(vertex[:2])}
    bench = TracedBench(**UPRIGHT | lens)
    at, ray = bench.behind_lens(np.array([3.0 * axis, axis]))
    for number in range(2):
        np.testing.assert_allclose(ray[number], axis, atol=1e-12)
        np.testing.assert_allclose(np.cross(at[number], axis), 0, atol=1e-9)
    thick_mm = sum(geometry.THICKNESS_MM) * 350.0 / geometry.DESIGN_FOCAL_MM
    assert at[0] @ axis == pytest.approx(np.linalg.norm(vertex) + thick_mm)
    x, y = bench.places_px(axis[None])
    to_screen_mm = 60.0 + (geometry.BACK_FOCUS_MM * 3.5 + thick_mm)
    screen_px = axis[:2] / axis[2] * to_screen_mm / bench.pitch_mm
    assert (x[0] - 959.5, y[0] - 539.5) == pytest.approx(tuple(screen_px))


def outcome_of(model: str, held_out: float, rms: float, largest: float):
    return geometry.CalibrationOutcome(20, 60, 0.02, model, 1000, held_out, rms, largest)


def test_a_model_fails_by_its_worst_star_and_is_chosen_by_held_out_dots():
    """Whatever the stars say, which a lab does not know."""
    near = outcome_of("near", 2.0, 0.25, 0.99)
    worse = outcome_of("worse", 1.5, 0.5, 1.5)
    pinhole = outcome_of("a pinhole", 9.0, 120.4, 300.0)
    assert geometry.line_of(near) == (
        "near: stars 0.25 arcsec rms, 0.99 maximum; held-out dots 2 rms"
    )
    assert geometry.line_of(worse).endswith("held-out dots 1.5 rms; FAILS: over 1 arcsec")
    assert geometry.models_finding([pinhole, near, worse], 5432.1) == (
        "Uncalibrated stars are off by 5432 arcsec rms, by a pinhole 120, by the model that"
        " held-out dots choose (worse) 0.5"
    )
