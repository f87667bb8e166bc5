"""The parts of an error that is written as a function of where a star is."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.assess.components import (
    EDGES,
    LOCAL,
    SOUGHT,
    Phases,
    _best_of,
    _component,
    _stretches,
    best_direction,
    components_of,
)
from tests.support.claims import holds
from tests.support.planted_tracker import SCALE, attitude, scalar_first, scan, star_px, waves

# From 4000 answers the noise is known to 0.7 %, and a pixel error of 0.6 of it to 1.5 %. A star
# whose direction
# is found to 0.01 px blurs a saw's jump by as much: 1 % of its power, which is 2 % of the noise for
# a saw of 1.5 of it.
PIXEL_WITHIN, NOISE_WITHIN = 0.04, 0.05
WIDE_SAW, WIDE_SAW_PX = 2.0, 100.0  # sigmas of the noise, and px of the field


def saw(phase_px):
    """Of rms 1, with a jump where the phase is a whole number."""
    return np.sqrt(12) * (phase_px % 1 - 0.5)


def saws(place):
    """A tracker that rounds to whole pixels is off by a saw of the place within the pixel."""
    return np.stack([saw(place[:, 0]), saw(place[:, 1] + 0.3), saw(place[:, 0] + 0.1)], axis=1)


def steps(place):
    """Off one way over a part of each pixel, the other way over the rest."""
    x, y = place.T % 1
    error = np.stack(
        [np.where(x < 0.4, 1.0, -1.0), np.where((y + 0.3) % 1 < 0.5, 1.0, -1.0), saw(x + 0.1)],
        axis=1,
    )
    return (error - error.mean(axis=0)) / error.std(axis=0)


@pytest.mark.parametrize("size", [0.6, 1.5])
@pytest.mark.parametrize("shape", [saws, steps])
def test_a_pixel_error_that_jumps_from_pixel_to_pixel_is_recovered_whole(shape, size) -> None:
    """Five harmonics of a saw leave 33 % of its size to the noise, which was 12 % too large for
    a saw of 1.5 of it.
    """
    rng = np.random.default_rng(2)
    true = attitude(scan, np.arange(0.0, 600.0, 0.15))
    error = size * shape(star_px(true, true[0]))
    found = components_of(error + rng.normal(size=error.shape), scalar_first(true), SCALE)
    assert np.sqrt(found.pixel.variance[:2].mean()) == pytest.approx(size, rel=PIXEL_WITHIN)
    assert np.sqrt(found.noise_variance) == pytest.approx([1.0, 1.0, 1.0], rel=NOISE_WITHIN)
    assert found.pixel.detail.endswith(EDGES)


def test_a_jump_between_wide_saws_counts_as_noise() -> None:
    """Saws of 100 px of the field, twice the noise: sharper than the waves of the fit."""
    rng = np.random.default_rng(2)
    true = attitude(scan, np.arange(0.0, 600.0, 0.15))
    error = WIDE_SAW * saws(star_px(true, true[0]) / WIDE_SAW_PX)
    found = components_of(error + rng.normal(size=error.shape), scalar_first(true), SCALE)
    size = np.sqrt(found.fov.variance[:2].mean())
    holds("saw-lost", 100 * (1 - size / WIDE_SAW))
    holds("saw-noise", 100 * (np.sqrt(found.noise_variance[:2].mean()) - 1))


def test_smooth_waves_and_noise_alone_have_no_jumps() -> None:
    rng = np.random.default_rng(3)
    true = attitude(scan, np.arange(0.0, 600.0, 0.15))
    for size in (0.0, 1.0):
        error = size * waves(star_px(true, true[0]))
        found = components_of(error + rng.normal(size=error.shape), scalar_first(true), SCALE)
        assert not found.pixel.detail.endswith(EDGES)
        assert np.sqrt(found.noise_variance) == pytest.approx([1.0, 1.0, 1.0], rel=NOISE_WITHIN)


def test_the_noise_that_a_fit_takes_up_is_no_part_of_its_variance(rng) -> None:
    """30 functions of 200 answers take up 0.15 of the noise's variance, and 0.5 beside an error of
    that.
    """
    basis, _ = np.linalg.qr(rng.normal(size=(200, 30)))
    functions = SimpleNamespace(fit=lambda wanted: basis @ (basis.T @ wanted), freedom=30.0)
    for variance in (0.0, 0.5):
        found = []
        for _ in range(30):
            error = np.sqrt(variance * 200 / 30) * basis @ rng.normal(size=(30, 3))
            noisy = error + rng.normal(size=error.shape)
            found.append(_component(functions, noisy, 0.0).variance)
        # a variance of 30 functions is known to a quarter, and that of 90 of them to 0.03
        assert np.mean(found) == pytest.approx(variance, abs=0.06)


def test_functions_that_take_all_freedom_leave_noise_and_variance_finite(rng) -> None:
    """Six of seven answers, about their mean: what is left counts as of one."""
    basis, _ = np.linalg.qr(rng.normal(size=(7, 6)))
    functions = SimpleNamespace(fit=lambda wanted: basis @ (basis.T @ wanted), freedom=6.0)
    error = rng.normal(size=(7, 3))
    fitted = functions.fit(error)
    left = ((error - fitted) ** 2).sum(axis=0)
    wanted = np.maximum(((fitted**2).sum(axis=0) - 6 * left) / 7, 0.0)
    assert wanted.any()
    assert _component(functions, error, 0.0).variance == pytest.approx(wanted)


def test_where_the_sky_stands_all_about_the_mean_is_noise(rng) -> None:
    error = rng.normal(size=(40, 3)) + np.array([5.0, -3.0, 20.0])
    still = np.tile([0.6, 0.0, 0.8, 0.0], (40, 1))
    found = components_of(error, still, SCALE)
    assert found.mean == pytest.approx(error.mean(axis=0))
    assert found.noise_variance == pytest.approx(error.var(axis=0, ddof=1))
    assert "moved by 0 px only" in found.fov.reason and "moved by 0 px only" in found.pixel.reason


def test_a_field_that_moved_by_less_than_two_pixels_tells_no_pixel_error(rng) -> None:
    """By a wave within a pixel of twice the noise, along a row of the detector."""
    error = rng.normal(size=(600, 3))
    for moved_px, told in ((1.9, False), (30.0, True)):
        off_px = np.linspace(0.0, moved_px, len(error))
        turn = np.zeros((len(error), 3))
        turn[:, 1] = np.arctan(off_px / SCALE.focal_px)
        q = scalar_first(Rotation.from_rotvec(turn))
        wave = 2.8 * np.sin(2 * np.pi * off_px)[:, None]
        found = components_of(error + wave, q, SCALE)
        assert (found.pixel.reason == "") == told
        if not told:
            assert found.pixel.reason == (
                "the star field moved by 1.9 px only: pixel error cannot be told from bias"
            )


def test_the_noise_of_few_answers_has_the_freedom_that_is_left_by_the_fits() -> None:
    """Of 24 runs' axes with some 130 numbers each the mean is known to 0.025; 150 for the freedom
    would be 0.1 too little.
    """
    true = attitude(scan, np.arange(0.0, 600.0, 4.0))
    found = []
    for seed in range(8):
        error = np.random.default_rng(seed).normal(size=(len(true), 3))
        parts = components_of(error, scalar_first(true), SCALE)
        found.append(parts.noise_variance)
        # a wave that bumps fit spans four spacings, each of which is a quarter more than the last
        over_px = float(re.findall(r"repeats over (\d+) px", parts.fov.detail)[0])
        steps_up = np.log(over_px / (4 * 20.0)) / np.log(1.25)
        assert steps_up == pytest.approx(round(steps_up), abs=0.05)
    assert np.mean(found) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("shape", [saws, steps])
def test_jumps_within_a_pixel_are_found_of_a_thousand_answers(shape) -> None:
    """Of three times the noise, which a thousand answers know to 2 %: within three of it."""
    rng = np.random.default_rng(2)
    true = attitude(scan, np.arange(0.0, 600.0, 0.6))
    error = 3.0 * shape(star_px(true, true[0]))
    found = components_of(error + rng.normal(size=error.shape), scalar_first(true), SCALE)
    assert np.sqrt(found.pixel.variance) == pytest.approx([3.0] * 3, rel=0.06)
    assert np.sqrt(found.noise_variance) == pytest.approx([1.0] * 3, rel=0.07)
    assert found.pixel.detail.endswith(EDGES)


def test_fields_on_two_sides_of_the_sky_have_phases_of_their_own() -> None:
    """No direction is before both; what is found, what repeats over the field and the rest make up
    the whole.
    """
    rng = np.random.default_rng(2)
    t_s = np.arange(0.0, 600.0, 0.5)
    here = attitude(scan, t_s)
    ra_deg, dec_deg, roll_deg = scan(t_s)
    there = attitude(lambda t: (ra_deg + 180, dec_deg + 10, roll_deg), t_s)
    places = np.concatenate([star_px(here, here[0]), star_px(there, there[len(t_s) // 2])])
    error = 2.0 * waves(places)
    both = Rotation.concatenate([here, there])
    found = components_of(error + rng.normal(size=error.shape), scalar_first(both), SCALE)
    assert found.pixel.detail.startswith(LOCAL)
    assert (found.pixel.variance > 0.3).all()
    whole = found.pixel.variance + found.fov.variance + found.noise_variance
    # 2400 answers know a variance to 3 %, and errors that noise adds to by chance to as much
    assert whole == pytest.approx((error**2).mean(axis=0) + 1, rel=0.1)


@pytest.mark.parametrize(
    ("chances", "known", "sought"), [(3, False, False), (9, True, False), (18, True, True)]
)
def test_a_direction_that_was_sought_has_to_explain_more_than_one_that_is_known(
    chances, known, sought
):
    """A wave whose power is so many times the scatter of noise's own, the root of six times twelve
    harmonics: six and twelve are sure.
    """
    rng = np.random.default_rng(12)
    count = 900
    place_px = rng.uniform(0, 50, (count, 2))
    wave = np.sin(2 * np.pi * place_px[:, 0])
    about = rng.standard_normal((count, 3))
    about[:, 0] += np.sqrt(2 * chances * np.sqrt(6 * 12) / count) * wave
    for name, is_found in (("the phase of a test", known), (SOUGHT, sought)):
        waves_found, component, best = _best_of([Phases(name, place_px)], about, 0.0)
        assert (waves_found is not None) is is_found
        assert (best is not None and best.name == name) is is_found
        assert component.detail == (name if is_found else "")


@pytest.mark.parametrize(
    ("rolled_cells", "cell_px", "starts"),
    [
        # 256 answers at most while the mount does not roll, where a cell is a pixel and more
        (0.0, 4.0, [0, 256, 512, 768]),
        (0.0, 0.5, [0]),
        # and 16 at least: of a roll over a quarter of a cell in ten
        (0.025, 4.0, list(range(0, 1000, 20))),
    ],
)
def test_stretches_end_with_a_roll_over_a_quarter_of_a_cell(rolled_cells, cell_px, starts):
    total = 1000 if not rolled_cells else 200
    # in the middle of a step, so that no rounding decides
    roll_rad = (np.arange(total) + 0.5) * rolled_cells / cell_px
    first, rows = _stretches(roll_rad, cell_px, total)
    assert first.tolist() == [start for start in starts if start < total]
    assert rows.tolist() == list(range(total))


def test_whole_stretches_over_all_of_a_run_stand_for_it():
    """Half of eight stretches of 256 answers: each one's first row among those that are taken."""
    first, rows = _stretches(np.zeros(2048), 4.0, 1024)
    assert first.tolist() == [0, 256, 512, 768]
    taken = rows.reshape(4, 256)
    assert (taken - taken[:, :1] == np.arange(256)).all()
    assert (taken[:, 0] % 256 == 0).all()
    assert taken[0, 0] == 0 and taken[-1, 0] >= 1536


def test_a_star_beside_the_mean_boresight_is_sought_where_no_axis_of_the_sky_is_near() -> None:
    """Five degrees from (1, 1, 1), of a field of 5.4 about boresights up to 0.6 degrees off."""

    def motion(t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        turn = 2 * np.pi * t_s
        return 45 + 0.6 * np.sin(turn / 391), 35.26 + 0.5 * np.cos(turn / 271), 0 * t_s

    true = attitude(motion, np.arange(0.0, 600.0, 1.5))
    axes = true.as_matrix()
    to_icrs = attitude(lambda t_s: (45 + 0 * t_s, 35.26 + 0 * t_s, 0 * t_s), np.zeros(1)).inv()
    off = np.tan(np.radians([3.5, -3.6]))
    star = to_icrs.apply([*off, 1.0])[0] / np.hypot(1.0, np.hypot(*off))
    in_cam = axes @ star
    x, y = SCALE.focal_px * in_cam[:, :2].T / in_cam[:, 2]
    error = np.cos(2 * np.pi * np.stack([x, y, x], axis=1))
    found = best_direction(error, axes, SCALE)
    assert found is not None
    # a place some whole pixels beside it has nearly the same phases
    assert np.linalg.norm(found - star) * SCALE.focal_px < 5.0
