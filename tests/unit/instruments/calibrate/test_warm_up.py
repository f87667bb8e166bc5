"""Warm-up from planted curves of white: when it is stable, the drift that remains, and how often
the stated errors hold.
"""

import math

import numpy as np
import pytest

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.calibrate.first_light.uniformity import _warm_up_truth
from hilstar.instruments.calibrate.warm_up import (
    MAX_TAU,
    STABLE,
    WarmUp,
    judge_warm_up,
    watch_white,
)
from hilstar.server.bench.config.certify import VirtualSettings
from tests.support.fake_clock import FakeClock

CHANGE, TAU_S = 0.04, 200.0
# its change in ten minutes is 0.2 % then
STABLE_S = TAU_S * math.log(CHANGE * -math.expm1(-600 / TAU_S) / STABLE)
EVERY_S, READINGS = 10.0, 120
# share of trials within two stated errors: 0.95 is expected, and 3 sigma of counting are 0.085
TRIALS, HELD = 60, 0.86


def warm_up_of(kind: str, noise: float, seed: int = 0, readings: int = READINGS) -> WarmUp:
    """A planted curve, with relative noise of each reading, judged."""
    t_s: FloatArray = np.arange(readings, dtype=np.float64) * EVERY_S
    curves: dict[str, FloatArray] = {
        "exponential": 1 + CHANGE * np.exp(-t_s / TAU_S),
        "brightening": 1 - CHANGE * np.exp(-t_s / TAU_S),
        "none": np.ones(readings),
        "never": 1 - t_s / 60_000,  # 1 % in ten minutes
        "slow": 1 + 0.05 * np.exp(-t_s / 3000),
        "step": 1 + 0.01 * (t_s > 0.4 * t_s[-1]),
        "late step": 1 + 0.01 * (t_s > 0.9 * t_s[-1]),
        "two": 1 + 0.05 * np.exp(-t_s / 40) + 0.02 * np.exp(-t_s / 300),
    }
    scattered = 1 + noise * np.random.default_rng(seed).standard_normal(readings)
    return judge_warm_up(t_s, np.asarray(812 * curves[kind] * scattered, dtype=np.float64))


@pytest.mark.parametrize("kind", ["exponential", "brightening"])
def test_an_exponential_is_found_with_its_time_to_stable_white(kind: str) -> None:
    found = warm_up_of(kind, 0.0)
    assert found.law == "exponential" and found.is_stable
    assert found.stable_after_s == pytest.approx(
        STABLE_S, abs=10.0
    )  # where white brightens, "relative to white" differs a little
    assert found.tau_s == pytest.approx(TAU_S, rel=1e-3)
    true = -100 * 3600 * CHANGE / TAU_S * math.exp(-(READINGS - 1) * EVERY_S / TAU_S)
    assert found.drift_percent_per_h == pytest.approx(
        true if kind == "exponential" else -true, rel=0.01
    )


def test_a_warm_monitor_is_stable_from_the_first_reading_on() -> None:
    found = warm_up_of("none", 2e-4)
    assert (found.is_stable, found.stable_after_s, found.stable_after_error_s) == (True, 0.0, 0.0)
    assert abs(found.drift_percent_per_h) < 3 * found.drift_error_percent_per_h < 0.1


@pytest.mark.parametrize(("kind", "drift_percent_per_h"), [("never", -6.12), ("slow", -4.01)])
def test_a_drift_that_does_not_end_is_not_called_stable(
    kind: str, drift_percent_per_h: float
) -> None:
    found = warm_up_of(kind, 2e-4)
    assert not found.is_stable and found.stable_after_s > READINGS * EVERY_S
    assert (
        abs(found.drift_percent_per_h - drift_percent_per_h)
        < 3 * found.drift_error_percent_per_h
        < 0.6
    )
    assert "not" in found.line


def test_noise_of_a_fifth_of_a_percent_leaves_the_stated_errors_true() -> None:
    true = -100 * 3600 * CHANGE / TAU_S * math.exp(-(READINGS - 1) * EVERY_S / TAU_S)
    trials = [warm_up_of("exponential", 2e-3, seed) for seed in range(TRIALS)]
    assert (
        np.mean(
            [abs(each.stable_after_s - STABLE_S) < 2 * each.stable_after_error_s for each in trials]
        )
        > HELD
    )
    assert (
        np.mean(
            [
                abs(each.drift_percent_per_h - true) < 2 * each.drift_error_percent_per_h
                for each in trials
            ]
        )
        > HELD
    )
    assert np.median([each.noise for each in trials]) == pytest.approx(2e-3, rel=0.05)


def test_what_noise_hides_is_not_called_stable() -> None:
    assert (
        sum(warm_up_of("never", 2e-3, seed, readings=40).is_stable for seed in range(TRIALS))
        < 0.05 * TRIALS
    )
    short = warm_up_of("none", 2e-3, readings=20)
    assert not short.is_stable and short.ahead_error > STABLE / 2


def test_readings_before_a_step_are_left_out() -> None:
    found = warm_up_of("step", 2e-4)
    assert found.is_stable and found.from_s > 0.4 * (READINGS - 1) * EVERY_S
    assert abs(found.drift_percent_per_h) < 3 * found.drift_error_percent_per_h
    late = warm_up_of("late step", 2e-4)
    assert (late.law, late.is_stable, math.isinf(late.stable_after_s)) == ("none", False, True)


def test_a_fast_start_is_left_out_before_a_slow_exponential() -> None:
    found = warm_up_of("two", 1e-5)
    assert found.is_stable and found.from_s > 0
    assert found.stable_after_s == pytest.approx(
        300 * math.log(0.02 * -math.expm1(-2) / STABLE), abs=5.0
    )


def test_white_is_watched_until_it_is_stable_on_the_given_clock() -> None:
    clock, rng = FakeClock(), np.random.default_rng(3)

    def read() -> float:
        clock.sleep(0.5)  # an exposure
        return float(
            1 + CHANGE * math.exp(-clock.now_ns() / 1e9 / TAU_S) + 1e-4 * rng.standard_normal()
        )

    t_s, light = watch_white(read, clock.now_ns, clock.sleep)
    assert np.diff(t_s) == pytest.approx(EVERY_S) and len(t_s) == len(light)
    found = judge_warm_up(t_s, light)
    assert found.is_stable and STABLE_S < t_s[-1] < STABLE_S + 100
    assert abs(found.stable_after_s - STABLE_S) < 3 * found.stable_after_error_s + 1


def test_watching_ends_at_the_longest_time() -> None:
    clock = FakeClock()
    t_s, _ = watch_white(
        lambda: 1 + clock.now_ns() / 1e12, clock.now_ns, clock.sleep, longest_s=300.0
    )
    assert t_s[-1] == pytest.approx(300, abs=EVERY_S)


@pytest.mark.parametrize("seed", range(8))
def test_no_time_constant_is_one_that_ends_what_is_tried(seed: int) -> None:
    """A curve that still bends at the end fits an exponential without end: that law is no
    finding.
    """
    t_s = np.arange(60) * 10.0
    bent = 1 + 1e-5 * t_s - 2e-9 * t_s**2
    scattered = bent * (1 + 1e-4 * np.random.default_rng(seed).standard_normal(len(t_s)))
    found = judge_warm_up(t_s, np.asarray(scattered, dtype=np.float64))
    assert found.law != "exponential" or found.tau_s < 0.98 * MAX_TAU * float(t_s[-1])


def test_what_is_ahead_is_bounded_by_student_s_t() -> None:
    """At 95 %, on both sides: 2.571 standard errors of 5 degrees of freedom."""
    found = WarmUp("line", False, 0.01, ahead=-0.003, ahead_error=0.001, dof=5)
    assert found.bound == pytest.approx(0.003 + 2.5706e-3, abs=1e-6)


def test_a_reading_stands_in_the_middle_of_the_time_that_it_takes() -> None:
    clock = FakeClock()

    def read() -> float:
        clock.sleep(4.0)
        return 100.0

    t_s, _ = watch_white(read, clock.now_ns, clock.sleep, 400.0)
    assert t_s[0] == pytest.approx(2.0)
    # the next begins EVERY_S after it began, not after it ended
    assert np.diff(t_s) == pytest.approx(EVERY_S)


def test_a_drift_beyond_the_limit_is_stable_by_no_law_that_is_as_likely() -> None:
    """0.25 % in ten minutes, watched for three: an exponential that ends soon is then as likely as
    the line. White is called stable at 95 %, once in 40 times of this; 60 have 1.5, and 3 sigma are
    3.6.
    """
    t_s = np.arange(20) * EVERY_S
    stable = 0
    for seed in range(60):
        scattered = 1 + 2e-4 * np.random.default_rng(seed).standard_normal(20)
        stable += judge_warm_up(t_s, (1 - 0.0025 / 600 * t_s) * scattered).is_stable
    assert stable <= 5


@pytest.mark.parametrize("cold_percent", [4.0, -4.0])
@pytest.mark.parametrize(("ended_s", "last_s"), [(40.0, 40.0), (100.0, 40.0), (9000.0, 40.0)])
def test_a_planted_warm_up_is_stable_by_its_size_and_never_before_the_watch(
    cold_percent, ended_s, last_s
):
    """`ended_s` of the monitor's time are `last_s` of the watch's."""
    virtual = VirtualSettings(
        warm_up_min=TAU_S / 60, cold_percent=cold_percent, drift_percent_per_h=0.0
    )
    planted = _warm_up_truth(virtual, STABLE, ended_s, last_s)
    stable_s = STABLE_S - (ended_s - last_s)
    if ended_s > STABLE_S:
        stable_s = 0.0
    assert planted["truth_stable_after_s"] == pytest.approx(stable_s)
    drift_percent_per_s = cold_percent / TAU_S * math.exp(-ended_s / TAU_S)
    assert planted["truth_drift_percent_per_h"] == pytest.approx(3600 * drift_percent_per_s)


@pytest.mark.parametrize(
    ("law", "stable_after_s", "words"),
    [
        ("exponential", 900.0, "wait until then, and watch it again"),
        ("exponential", math.inf, "watch it for longer (--warm-up)"),
        # a line within the limit whose noise hides it
        ("line", 0.0, "watch it for longer (--warm-up)"),
        ("none", math.inf, "watch it for longer (--warm-up)"),
    ],
)
def test_only_an_exponential_says_until_when_to_wait(law, stable_after_s, words):
    assert WarmUp(law, False, STABLE, stable_after_s=stable_after_s).cure.startswith(words)


@pytest.mark.parametrize(
    ("law", "is_stable", "stable_after_s", "line"),
    [
        (
            "exponential",
            True,
            900.0,
            "white is stable to 0.2 % after 900 +- 40 s; it drifts by -1.50 +- 0.25 %/h at the end",
        ),
        (
            "line",
            True,
            120.0,
            "white is stable to 0.2 % from the first reading, at 120 s, on; it drifts by -1.50"
            " +- 0.25 %/h at the end",
        ),
        (
            "exponential",
            False,
            900.0,
            "white is not yet stable to 0.2 %: by its exponential it is after 900 +- 40 s; it"
            " drifts by -1.50 +- 0.25 %/h at the end",
        ),
        (
            "line",
            False,
            900.0,
            "white is not shown to be stable to 0.2 %: it drifts by -1.50 +- 0.25 %/h at the end",
        ),
        (
            "none",
            False,
            math.inf,
            "white is not stable to 0.2 %: the last readings follow neither a line nor an"
            " exponential",
        ),
    ],
)
def test_what_was_found_of_white_is_one_sentence(law, is_stable, stable_after_s, line):
    found = WarmUp(law, is_stable, 0.002, stable_after_s, 40.0, -1.5, 0.25, from_s=120.0)
    assert found.line == line


@pytest.mark.parametrize("drift_per_s", [0.0, -4e-7])
def test_where_an_exponential_has_died_away_a_line_tells_the_drift(drift_per_s: float) -> None:
    """Ten time constants before the middle: it says that nothing drifts, for sure; the line's
    error is that of the last half of the readings.
    """
    t_s = np.arange(120) * 10.0
    light = 1 + 0.04 * np.exp(-t_s / 60) + drift_per_s * t_s
    light *= 1 + 2e-4 * np.random.default_rng(4).standard_normal(120)
    judged = judge_warm_up(t_s, light)
    assert judged.law == "exponential"
    fitted, covariance = np.polyfit(t_s[60:], light[60:], 1, cov=True)
    percent_per_h = 100 * 3600 / np.polyval(fitted, t_s[60:].mean())
    assert judged.drift_percent_per_h == pytest.approx(fitted[0] * percent_per_h, rel=1e-3)
    error = math.sqrt(covariance[0, 0]) * percent_per_h
    assert judged.drift_error_percent_per_h == pytest.approx(error, rel=1e-3)
    assert judged.dof == 58
