"""Intervals of assess, and of calibrations, hold a planted truth as often as stated."""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np
import pytest
from scipy import stats

from hilstar.instruments.assess.budget import _field_interval, _of_fit, intervals_of
from hilstar.instruments.assess.components import NOTHING, Component, Components
from hilstar.instruments.assess.look_alikes import LookAlikes
from tools.interval_coverage import KINDS

TRIALS = 200
# binomial: fewer hold once in 1000
MIN_SHARE = 0.95 - 3 * math.sqrt(0.05 * 0.95 / TRIALS)
# binomial: of 100, 87 and fewer hold once in 680
RUNS, MIN_RUNS_HELD = 100, 88
ANSWERS, FUNCTIONS = 2000, 24
TRUE_ARCSEC = 0.6


def test_the_error_of_a_fit_is_in_the_interval_of_what_repeats() -> None:
    """With the fit held as it is, 55 % of such intervals held."""
    rng = np.random.default_rng(3)
    phase = 2 * np.pi * rng.uniform(size=(ANSWERS, 1)) * np.arange(1, FUNCTIONS // 2 + 1)
    basis = np.sqrt(2 / ANSWERS) * np.concatenate([np.cos(phase), np.sin(phase)], axis=1)
    basis, _ = np.linalg.qr(basis)
    held = 0
    for _ in range(TRIALS):
        true = basis @ rng.standard_normal((FUNCTIONS, 3))
        true *= TRUE_ARCSEC / np.sqrt((true**2).mean(axis=0))
        seen = true + rng.standard_normal(true.shape)
        fitted = basis @ (basis.T @ seen)
        nothing = Component(NOTHING, np.zeros_like(seen), 0.0)
        pixel = Component(NOTHING, fitted, float(FUNCTIONS))
        parts = Components(NOTHING, nothing, pixel, np.ones(3), seen - fitted, 0.0)
        low, high = intervals_of(parts, rng).pixel
        held += low[0] <= TRUE_ARCSEC <= high[0]
    assert held >= MIN_SHARE * TRIALS


@pytest.mark.parametrize("size", [0.0, 1e-3, 4.0])
def test_the_mean_square_of_a_fit_scatters_as_a_noncentral_chi_square(size: float) -> None:
    """Of 24 numbers, each with noise, over 2000 answers with noise of 0.5."""
    of_answer = 0.5**2 / ANSWERS
    variance = _of_fit(np.array([size]), FUNCTIONS, np.array([of_answer]))
    standard = stats.ncx2(FUNCTIONS, size / of_answer).var() if size else 2 * FUNCTIONS
    assert variance == pytest.approx(standard * of_answer**2)


def test_a_field_s_axes_across_are_two_that_err_by_themselves() -> None:
    """A known clock and nothing slow: across, the mean of two mean squares scatters by the root of
    two less than the one about the boresight.
    """
    fov = Component(np.full(3, 4.0), np.ones((ANSWERS, 3)), float(FUNCTIONS))
    known = LookAlikes(np.zeros((ANSWERS, 3, 2)), np.eye(2), np.zeros(3))
    low, high = _field_interval(fov, np.ones(3), known)
    sigma = math.sqrt(4 * 4.0 / ANSWERS + 2 * FUNCTIONS / ANSWERS**2)
    within = 1.96 * sigma * np.array([math.sqrt(0.5), 1.0])
    assert high**2 == pytest.approx(4.0 + within, rel=1e-4)
    assert low**2 == pytest.approx(4.0 - within, rel=1e-4)


@pytest.mark.parametrize(
    "kind", ["calibrate alignment", "calibrate scale", "latency", "assess of cases"]
)
def test_intervals_hold_the_truth_of_planted_trials(kind: str) -> None:
    held = defaultdict(list)
    for number in range(RUNS):
        for figure, holds in KINDS[kind](np.random.default_rng((5, number))):
            held[figure].append(holds)
    assert held
    for figure, each in held.items():
        assert sum(each) >= MIN_RUNS_HELD, figure
