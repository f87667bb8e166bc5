"""The budget of trackers whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_rotation_vector, multiply
from hilstar.instruments.assess.budget import (
    DecomposedRun,
    _refuse_few,
    assess_cases,
    assess_run,
    intervals_of,
)
from hilstar.instruments.assess.clock import ClockSolver, coarse_offset
from hilstar.instruments.assess.components import NOTHING, Component, Components
from hilstar.server.record.commanded import Commanded
from tests.support.planted_tracker import (
    ARCSEC_PER_RAD,
    ROLL,
    SCALE,
    Planted,
    Sizes,
    odometer_px,
    plant,
    polynomial,
    scalar_first,
    scan,
    slew,
    still,
)
from tests.support.refusals import refusal

# What the issue of the budget asks for; statistics alone would allow 1 % of noise (17 000 answers)
# and 3 % of pixel error.
WITHIN, PIXEL_WITHIN = 0.10, 0.15
DRIFT_PPM = 1.0
ISSUE = Sizes()
OTHER = Sizes(
    bias=50.0, fov=5.0, pixel=1.5, noise=2.0, drift_ppm=-60.0, offset_s=123_456.7, wild=15
)


def assessed(planted: Planted) -> DecomposedRun:
    commanded = Commanded(planted.frames_s, planted.frames_q)
    coarse = coarse_offset(commanded, planted.tau_s, planted.reported)
    assert coarse is not None
    rng = np.random.default_rng(1)
    return assess_run(commanded, planted.tau_s, planted.reported, coarse, SCALE, rng)


def test_the_planted_tracker_of_the_issue_is_recovered() -> None:
    planted = plant(scan, ISSUE, np.random.default_rng(7))
    found = assessed(planted)
    check_sizes(found, planted, ISSUE)


def test_a_lens_like_field_error_and_a_pixel_error_of_passing_stars_are_recovered_on_a_clock_of_its_own() -> (
    None
):
    planted = plant(
        scan,
        OTHER,
        np.random.default_rng(8),
        fov=lambda place: polynomial(place, 512.0),
        pixel_place=lambda true, _: odometer_px(true),
    )
    check_sizes(assessed(planted), planted, OTHER)


def check_sizes(found: DecomposedRun, planted: Planted, sizes: Sizes) -> None:
    fov = np.sqrt((planted.fov[0] ** 2 + planted.fov[1] ** 2) / 2), planted.fov[2]
    for axis, scale, field in (("cross", 1.0, fov[0]), ("roll", ROLL, fov[1])):
        assert getattr(found.fov_arcsec, axis) == pytest.approx(field, rel=WITHIN)
        assert getattr(found.pixel_arcsec, axis) == pytest.approx(
            scale * sizes.pixel, rel=PIXEL_WITHIN
        )
        assert getattr(found.noise_arcsec, axis) == pytest.approx(scale * sizes.noise, rel=WITHIN)
    # The run does not see whole periods: the field-of-view error has a mean of its own, a few
    # tenths of its rms.
    size = np.linalg.norm(planted.bias)
    np.testing.assert_allclose(found.bias_arcsec, planted.bias, atol=WITHIN * size)
    assert found.clock.drift * 1e6 == pytest.approx(sizes.drift_ppm, abs=DRIFT_PPM)
    assert found.clock.offset_s == pytest.approx(sizes.offset_s, abs=5e-3)
    assert found.wrong.tolist() == planted.wild.tolist()


def test_what_is_not_there_is_not_found() -> None:
    """With noise alone the two parts that repeat are what 17 000 answers and 400 degrees of
    freedom leave by chance.
    """
    found = assessed(plant(scan, Sizes(fov=0.0, pixel=0.0, wild=0), np.random.default_rng(3)))
    # of an rms, where the variance is uncertain by sqrt(2 p) sigma^2 / n
    by_chance = 1.0 * (2 * 400) ** 0.25 / 17_000**0.5
    assert found.fov_arcsec.cross == pytest.approx(0.0, abs=3 * by_chance)
    assert found.pixel_arcsec.cross == pytest.approx(0.0, abs=3 * by_chance)
    assert found.noise_arcsec.cross == pytest.approx(1.0, rel=0.03)
    assert found.wrong.size == 0


def test_a_constant_slew_tells_the_drift_and_not_the_offset() -> None:
    found = assessed(plant(slew, Sizes(fov=0.0, pixel=0.0), np.random.default_rng(4)))
    assert not found.clock.offset_told
    assert found.clock.drift_told
    assert found.clock.drift * 1e6 == pytest.approx(20.0, abs=5 * 1e6 * found.clock.sigma_drift)


def test_a_still_run_tells_bias_and_noise_only() -> None:
    found = assessed(
        plant(still, Sizes(fov=0.0, pixel=0.0), np.random.default_rng(5), seconds=300.0)
    )
    assert not found.clock.offset_told
    assert not found.clock.drift_told
    assert found.fov_arcsec.cross is None
    assert found.pixel_arcsec.roll is None
    assert len(found.notes) == 2
    assert found.noise_arcsec.cross == pytest.approx(1.0, rel=0.05)


def test_cases_all_over_the_sky_have_a_bias_and_noise_and_no_place_that_repeats() -> None:
    rng = np.random.default_rng(6)
    commanded = rng.normal(size=(500, 4))
    commanded /= np.linalg.norm(commanded, axis=1, keepdims=True)
    from scipy.spatial.transform import Rotation

    error = np.array([3.0, -4.0, 30.0]) + [1.0, 1.0, 8.0] * rng.normal(size=(500, 3))
    truth = Rotation.from_quat(np.roll(commanded, -1, axis=1))
    reported = scalar_first(Rotation.from_rotvec(error / ARCSEC_PER_RAD) * truth)
    reported[::50] = np.nan
    reported[7] = commanded[8]
    commanded[13] = np.nan
    found = assess_cases(commanded, reported, SCALE, rng)
    # 4 sigma about the boresight
    np.testing.assert_allclose(found.bias_arcsec, [3.0, -4.0, 30.0], atol=1.5)
    assert found.noise_arcsec.roll == pytest.approx(8.0, rel=0.15)
    assert found.fov_arcsec.cross is None
    assert found.wrong.tolist() == [7]
    assert found.row.tolist() == [k for k in range(500) if k % 50 and k not in (7, 13)]


def test_a_bias_of_two_blocks_has_the_interval_of_student_s_t_with_one_freedom(rng) -> None:
    """Ten answers make two blocks, with means a and b: 12.706 |a - b| / 2 to either side."""
    left = np.repeat([[1.0, -3.0, 0.5], [-1.0, 3.0, -0.5]], 5, axis=0)
    nothing = Component(NOTHING, np.zeros_like(left), 0.0)
    mean = np.array([10.0, 20.0, 30.0])
    parts = Components(mean, nothing, nothing, np.ones(3), left, 0.0)
    low, high = intervals_of(parts, rng).bias
    assert (low + high) / 2 == pytest.approx(mean)
    # a standard deviation of 1000 draws
    assert (high - low) / 2 == pytest.approx(12.706 * np.array([1.0, 3.0, 0.5]), rel=0.1)


def test_answers_while_a_frame_was_held_are_in_no_figure_and_wrong_only_beyond_its_turn() -> None:
    """The field's turn while a frame was held for 0.4 s is not five degrees."""
    planted = plant(scan, Sizes(fov=0.0, pixel=0.0, wild=0), np.random.default_rng(5), seconds=24.0)
    held_s = planted.frames_s[0] + np.array([[8.0, 8.4], [16.0, 16.4]])
    commanded = Commanded(planted.frames_s, planted.frames_q, held_s, np.array([0.4, 0.4]))
    coarse = coarse_offset(commanded, planted.tau_s, planted.reported)
    assert coarse is not None
    reported = planted.reported.copy()
    plain = ClockSolver(commanded, planted.tau_s, reported, SCALE).fit(coarse)
    is_held = plain.moments.held_s > 0
    astray = int(np.flatnonzero(is_held)[2])
    reported[astray] = multiply(from_rotation_vector(np.radians([0, 5.0, 0])), reported[astray])
    found = assess_run(commanded, planted.tau_s, reported, coarse, SCALE, np.random.default_rng(1))
    assert is_held.sum() > 4
    assert found.wrong.tolist() == [astray]
    assert found.held.tolist() == [k for k in np.flatnonzero(is_held).tolist() if k != astray]
    assert not is_held[found.row].any()


def test_few_answers_and_wild_ones_are_refused() -> None:
    planted = plant(scan, Sizes(), np.random.default_rng(5), seconds=60.0)
    rng = np.random.default_rng(1)
    with pytest.raises(InputError, match="answers, and 30 are needed"):
        assess_cases(planted.frames_q[:20], planted.frames_q[:20], SCALE, rng)
    wild = rng.normal(size=(100, 4))
    with pytest.raises(InputError, match="wild"):
        assess_cases(
            planted.frames_q[:100], wild / np.linalg.norm(wild, axis=1, keepdims=True), SCALE, rng
        )


@pytest.mark.parametrize(
    ("known", "held", "used", "words"),
    [
        (29, 0, 29, "29 answers fall into the run, and 30 are needed; give longer telemetry"),
        (60, 31, 29, "31 of 60 answers looked while one was held, and 30 others are needed; run"),
        (60, 31, 29, "run it 1.1 times as long, on a machine with less other work"),
        (50, 30, 20, "run it 1.5 times as long, on a machine with less other work"),
        (40, 40, 0, "run it on a machine with less other work"),
        (60, 0, 30, "half or more of the answers are wild: 30 of 60 agree with one rotation"),
        (90, 30, 30, "30 of 60 agree"),
    ],
)
def test_a_run_s_answers_are_counted_before_they_are_judged(
    known: int, held: int, used: int, words: str
) -> None:
    """Of 100 rows; with one answer more of what was too few none is refused."""

    def first(count: int) -> np.ndarray:
        return np.arange(100) < count

    assert words in refusal(_refuse_few, first(known), first(held), first(used))
    for fewest_known, fewest_held, fewest_used in ((30, 0, 16), (60, 30, 16), (60, 0, 31)):
        _refuse_few(first(fewest_known), first(fewest_held), first(fewest_used))
