"""What moves the stars, told from their displacements alone."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.instruments.verify.measure import fit_geometry, on_detector
from hilstar.optics.camera import Camera

FOCAL_PX = 1000.0
TRACKER = Camera((400, 400), FOCAL_PX, (199.5, 199.5), np.eye(3))
LIMIT_PX = 0.1
NOISE_PX = 0.02


def displaced(seen_x, seen_y, moved_from, noise=None):
    """Stars seen at these places (focal lengths), where the sky has them at `moved_from` (x, y)."""
    x, y = (FOCAL_PX * part + 199.5 for part in moved_from(seen_x, seen_y))
    dx, dy = FOCAL_PX * seen_x + 199.5 - x, FOCAL_PX * seen_y + 199.5 - y
    if noise is not None:
        dx, dy = dx + noise[0], dy + noise[1]
    return np.column_stack([x, y, dx, dy])


def test_scale_rotation_and_shift_are_told_apart(rng):
    x, y = rng.uniform(0, 400, (2, 30))
    dx, dy = (
        0.01 * (x - 199.5) - 0.002 * (y - 199.5) + 0.3,
        0.01 * (y - 199.5) + 0.002 * (x - 199.5) - 0.1,
    )
    fit = fit_geometry(np.column_stack([x, y, dx, dy]), TRACKER, LIMIT_PX)
    assert (fit.scale_error, fit.rotation_rad, *fit.offset_px) == pytest.approx(
        (0.01, 0.002, 0.3, -0.1)
    )
    assert (fit.tilt_rad, fit.k1, fit.tilt_px, fit.distortion_px) == ((0, 0), 0, 0, 0)
    assert fit.left < 1e-20


def test_chance_is_explained_by_nothing(rng):
    x, y, dx, dy = *rng.uniform(0, 400, (2, 30)), *rng.normal(size=(2, 30))
    chance = fit_geometry(np.column_stack([x, y, dx, dy]), TRACKER, LIMIT_PX)
    assert 0.7 < chance.left < 1.3  # 60 residuals, 4 unknowns: chi^2 of 56 over 56, sigma 0.19
    assert fit_geometry(np.tile([1.0, 2, 0, 0], (5, 1)), TRACKER, LIMIT_PX) is None


def test_a_lens_far_off_the_axis_is_found_exactly_and_wild_stars_are_not_believed(rng):
    x, y = rng.uniform(-0.2, 0.2, (2, 60))

    def behind(u, v):
        gain = 1.02 * (1 + 0.6 * (u * u + v * v))
        return u * gain + 0.03, v * gain - 0.02

    stars = displaced(x, y, behind)
    stars[3, 2] += 2.5
    fit = fit_geometry(stars, TRACKER, LIMIT_PX)
    assert fit.k1 == pytest.approx(0.6, abs=1e-9)
    assert fit.scale_error == pytest.approx(1 / 1.02 - 1, abs=1e-9)
    assert fit.offset_px == pytest.approx((-30 / 1.02, 20 / 1.02))
    assert fit.tilt_px == 0


def test_noise_alone_names_no_lens_and_no_tilt(rng):
    for _ in range(50):
        x, y = rng.uniform(-0.2, 0.2, (2, 40))
        noise = rng.normal(0, NOISE_PX, (2, 40))
        fit = fit_geometry(
            displaced(x, y, lambda u, v: (1.01 * u, 1.01 * v), noise), TRACKER, LIMIT_PX
        )
        assert max(fit.tilt_px, fit.distortion_px) < LIMIT_PX
        assert fit.scale_error == pytest.approx(1 / 1.01 - 1, abs=1e-4)


def test_what_no_lens_does_is_said_to_be_left(rng):
    x, y = rng.uniform(-0.2, 0.2, (2, 200))
    fit = fit_geometry(
        displaced(x, y, lambda u, v: (1.05 * u + 5e-4 * np.sin(60 * v), 1.05 * v)),
        TRACKER,
        LIMIT_PX,
    )
    assert fit.left_px > 2 * LIMIT_PX


def test_the_detector_ends_with_its_last_pixels_outer_edges():
    """Of 64 x 48 pixels, whose centres are whole numbers: from -0.5 to 63.5 and 47.5."""
    for x_px, y_px, margin_px, are_on in (
        ([-0.6, -0.5, 63.4, 63.5], [9.0] * 4, 0.0, [False, True, True, False]),
        ([9.0] * 4, [-0.6, -0.5, 47.4, 47.5], 0.0, [False, True, True, False]),
        ([1.4, 1.5, 61.4, 61.6], [9.0] * 4, 2.0, [False, True, True, False]),
        ([np.nan, 9.0], [9.0, np.nan], 0.0, [False, False]),
    ):
        found = on_detector(np.array(x_px), np.array(y_px), (64, 48), margin_px)
        assert found.tolist() == are_on


def test_what_is_left_is_corrected_for_the_unknowns_and_its_95th_percentile_is_of_places(rng):
    """Against a least-squares fit of scale, rotation and shift to 20 stars that move by chance."""
    x, y = rng.uniform(0, 400, (2, 20))
    dx, dy = rng.normal(size=(2, 20))
    fit = fit_geometry(np.column_stack([x, y, dx, dy]), TRACKER, LIMIT_PX)
    u, v = x + dx - 199.5, y + dy - 199.5
    ones, none = np.ones(20), np.zeros(20)
    across = np.column_stack([u, -v, ones, none])
    down = np.column_stack([v, u, none, ones])
    design = np.concatenate([across, down])
    back = -np.concatenate([dx, dy])
    rest = back - design @ np.linalg.lstsq(design, back, rcond=None)[0]
    share = (rest @ rest / (40 - 4)) / (back @ back / 40)
    assert fit.left == pytest.approx(share)
    off_px = np.hypot(rest[:20], rest[20:])
    assert fit.left_px == pytest.approx(np.percentile(off_px, 95))


@pytest.mark.parametrize(("off_px", "is_kept"), [(0.8 * LIMIT_PX, True), (2 * LIMIT_PX, False)])
def test_a_star_that_is_off_by_less_than_the_limit_is_not_wild_beside_exact_ones(
    rng, off_px, is_kept
):
    """Of 30 stars one alone is off: it is in what the model leaves, or left out."""
    x, y = rng.uniform(-0.2, 0.2, (2, 30))
    stars = displaced(x, y, lambda u, v: (1.01 * u + 1e-3, 1.01 * v))
    stars[4, 2] += off_px
    fit = fit_geometry(stars, TRACKER, LIMIT_PX)
    assert (fit.left > 1e-7) == is_kept
