"""The statistics of cases: limits against all that could be tried, errors against leaving one case
out, and fits whose own share in their residuals is known.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.assess.bounded_figures import TooFewCases, quantile_limits, ratios
from hilstar.instruments.assess.case_fits import (
    CaseFit,
    largest_size,
    refuse_few,
    root_mean,
)
from hilstar.instruments.assess.rate_figures import RATE_NOISE, RateTable, rate_figure
from hilstar.instruments.assess.time_figures import (
    _jitter_weights,
    stamp_jitter,
    time_figure,
)

CONFIDENCE = 0.95


@pytest.mark.parametrize("confidence", [0.55, 0.9, 0.96, 0.999])
@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_a_quantile_s_limits_are_the_nearest_values_that_hold(share: float, confidence: float):
    """Value k of n in order is above the quantile where fewer than k are below it: all are tried."""
    for n in (1, 7, 14, 59, 300):
        order = np.arange(1, n + 1)
        below = stats.binom.cdf(order - 1, n, share)
        low = order[below <= 1 - confidence]
        high = order[below >= confidence]
        wanted = (low[-1] if len(low) else -math.inf, high[0] if len(high) else math.inf)
        assert quantile_limits(order[::-1].astype(float), share, confidence) == wanted


def test_a_ratio_s_error_is_what_leaving_out_each_case_changes(rng: np.random.Generator):
    sums = rng.normal(3.0, 1.0, (2, 9))
    weights = rng.lognormal(0.0, 1.0, (2, 9))
    value, error = ratios(sums, weights)
    assert value == pytest.approx(sums.sum(axis=1) / weights.sum(axis=1))
    changes = []
    for k in range(9):
        without = np.delete(sums, k, 1).sum(axis=1) / np.delete(weights, k, 1).sum(axis=1)
        changes.append(without - value)
    assert error == pytest.approx(np.sqrt((np.array(changes) ** 2).sum(axis=0)))


def case_fit(value: float, sigma: float, freedom: float) -> CaseFit:
    none = np.zeros(1)
    columns = np.array([value]), np.array([[sigma**2]]), np.array([freedom])
    return CaseFit(*columns, none, none, 20)


def test_of_several_axes_any_one_may_be_the_largest():
    """5 +- 0.1 of 19 degrees of freedom, beside two that are small: a third of the doubt each."""
    fits = [case_fit(1.0, 0.1, 19), case_fit(-5.0, 0.1, 19), case_fit(0.0, 0.1, 19)]
    figure = largest_size(fits, 0, CONFIDENCE, "")
    assert (figure.value, figure.cases) == (5.0, 20)
    assert figure.low == pytest.approx(5 - 0.1 * stats.t.isf(0.05 / 3, 19))
    assert figure.high == pytest.approx(5 + 0.1 * stats.t.isf(0.05, 19))
    # an axis that is less well known may be larger than that which is seen to be
    fits[0] = case_fit(1.0, 9.0, 19)
    assert largest_size(fits, 0, CONFIDENCE, "").high == pytest.approx(
        1 + 9 * stats.t.isf(0.05, 19)
    )


def squares_of(count: int) -> FloatArray:
    """Mean squares about 4 that have no tails."""
    return np.linspace(2.0, 6.0, count)


@pytest.mark.parametrize("confidence", [0.9, 0.975])
def test_the_upper_end_of_few_cases_noise_is_skew_as_a_variance_is(confidence, rng):
    """t standard errors on the scale of logarithms; below, on that of the variance itself."""
    squares = squares_of(8)
    figure = root_mean(squares, np.ones(8), np.arange(8), confidence, rng)
    without = [np.delete(squares, k).mean() - 4 for k in range(8)]
    wide = stats.t.ppf(confidence, 7) * math.sqrt(float((np.array(without) ** 2).sum()))
    assert figure.value == pytest.approx(2.0)
    assert figure.high == pytest.approx(2 * math.exp(wide / 8))
    assert figure.low <= math.sqrt(4 - wide) + 1e-9


def test_cases_without_weight_tell_nothing_of_a_noise(rng: np.random.Generator):
    """Of sixteen cases eight have no frames: as of eight."""
    squares = np.concatenate([squares_of(8), np.zeros(8)])
    weights = np.repeat([1.0, 0.0], 8)
    eight = root_mean(squares_of(8), np.ones(8), np.arange(8), 0.975, rng)
    sixteen = root_mean(squares, weights, np.arange(16), 0.975, rng)
    assert sixteen.value == pytest.approx(eight.value)
    # by the bootstrap, which draws fewer of the eight, it is wider at most
    assert sixteen.high >= eight.high * (1 - 1e-9)
    assert sixteen.low <= eight.low + 1e-9


def rates_at_rest(errors_deg_s: FloatArray) -> RateTable:
    """A case a row, at rest."""
    still = np.zeros_like(errors_deg_s)
    return RateTable(np.arange(len(still)), still, errors_deg_s, still)


def test_the_noise_of_rates_at_rest_is_their_standard_deviation(rng: np.random.Generator):
    """About the mean of ten cases: what that takes of the scatter is given back."""
    errors = rng.normal([0.5, -0.3, 1.0], 0.1, (10, 3))
    for axes in ([0], [0, 1], [2]):
        figure = rate_figure(RATE_NOISE, rates_at_rest(errors), axes, CONFIDENCE, rng)
        variance = errors[:, axes].var(axis=0, ddof=1).mean()
        assert figure.value == pytest.approx(math.sqrt(variance))


def test_a_scale_and_a_lag_are_told_about_axes_that_all_turn(rng: np.random.Generator):
    rates = np.zeros((12, 3))
    rates[:, 0] = np.linspace(-1, 1, 12)
    rates[:, 2] = 0.5
    noise = 1e-3 * rng.standard_normal((12, 3))
    errors = 0.02 * rates - 0.03 * rates**2 + noise
    table = RateTable(np.arange(12), rates, errors, rates**2)
    for quantity, size in (("rate-scale", 0.02), ("rate-lag", 0.03)):
        figure = rate_figure(quantity, table, [0], CONFIDENCE, rng)
        assert figure.value == pytest.approx(size, rel=0.1)
    for axes in ([1], [2], [0, 1]):
        with pytest.raises(TooFewCases, match="no case turns at several rates about that axis"):
            rate_figure("rate-scale", table, axes, CONFIDENCE, rng)
        with pytest.raises(TooFewCases, match="no case accelerates about that axis"):
            rate_figure("rate-lag", table, axes, CONFIDENCE, rng)


@pytest.mark.parametrize("cases", [7, 8])
def test_eight_cases_are_enough(cases: int):
    case = np.repeat(np.arange(cases), 3)
    if cases == 8:
        refuse_few(case, "rate")
        return
    with pytest.raises(TooFewCases, match="7 cases tell it, and 8 are needed") as few:
        refuse_few(case, "rate")
    assert (few.value.cases, few.value.more) == (7, 1)


def stamp(rates_deg_s: FloatArray, rng: np.random.Generator, quantity: str = "time-bias"):
    """A figure of stamps by errors of an arcsec at rates (n, 3), a case a row."""
    errors = rng.standard_normal(rates_deg_s.shape)
    return time_figure(quantity, np.arange(len(errors)), errors, rates_deg_s, CONFIDENCE, rng)


def test_a_slew_of_one_sense_and_rest_are_no_slews_of_both_signs(rng: np.random.Generator):
    rates = np.zeros((20, 3))
    rates[::2, 1] = 0.5
    with pytest.raises(TooFewCases, match="slews of both signs") as few:
        stamp(rates, rng)
    assert few.value.cases == 20
    # two senses, each about its own axis
    across = np.zeros((20, 3))
    across[::2, 0], across[1::2, 1] = 0.5, -0.5
    with pytest.raises(TooFewCases, match="slews of both signs"):
        stamp(across, rng)
    rates[::4, 1] = -0.5
    assert stamp(rates, rng).high < 0.01
    # about the boresight alone it shows in no place of a star
    about = np.zeros((20, 3))
    about[:, 2] = np.tile([0.5, -0.5], 10)
    with pytest.raises(TooFewCases, match="slews across the boresight"):
        stamp(about, rng, "time-jitter")


def test_each_axis_counts_by_its_own_noise(rng: np.random.Generator):
    """Errors about the boresight are a hundred times as large, and slews are about x and it."""
    rates = np.zeros((200, 3))
    rates[:, 0] = rates[:, 2] = np.tile([0.2, -0.2], 100)
    errors = rng.standard_normal((200, 3)) * [1.0, 1.0, 100.0] + 3600 * 0.01 * rates
    figure = time_figure("time-bias", np.arange(200), errors, rates, CONFIDENCE, rng)
    # 1 arcsec over 720 arcsec/s and the root of 200
    assert figure.value == pytest.approx(0.01, abs=4 * 1 / 720 / math.sqrt(200))
    assert figure.high - figure.low < 4 * 1.96 / 720 / math.sqrt(200)


def test_a_jitter_has_back_what_the_fit_of_bias_and_stamp_took_of_it():
    """Slews of one speed in all directions, without other noise: the mean over jitters is that of
    each slew's own, by the projection that the fit is; to 1 / n^2.
    """
    count = 48
    angle = 2 * np.pi * np.arange(count) / (count // 4)
    rates = 5.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    design = np.zeros((2 * count, 3))
    design[:count, 0] = design[count:, 1] = 1.0
    design[:, 2] = rates.T.ravel()
    left = np.eye(2 * count) - design @ np.linalg.pinv(design)
    jitter = np.zeros((2 * count, count))
    jitter[:count] = np.diag(rates[:, 0])
    jitter[count:] = np.diag(rates[:, 1])
    residuals = left @ jitter
    # one slew's jitter at a time: their squares add up, as independent ones do
    variances = []
    for one in residuals.T:
        residual = np.append(one.reshape(2, -1).T, np.zeros((count, 1)), axis=1)
        padded = np.append(rates, np.zeros((count, 1)), axis=1)
        variances.append(jitter_square(residual, padded))
    assert math.fsum(variances) == pytest.approx(1.0, abs=12 / count**2)


def jitter_square(residual: FloatArray, rates: FloatArray) -> float:
    """The square of the jitter, s^2, that residuals (n, 3) at rates (n, 3) show, slews alike."""
    figure = stamp_jitter(
        residual, rates, np.arange(len(rates)), CONFIDENCE, np.random.default_rng(1)
    )
    return figure.value**2


def test_slews_weigh_by_how_well_they_tell_a_jitter():
    """The variance of an excess is that of two squares, along the slew and across it. Without a
    jitter, as far as its excess is 0 or less, fast slews count by their squares; beside a large
    one every slew tells the same.
    """
    square = np.array([1.0, 4.0, 100.0])
    none = _jitter_weights(np.array([-1.0, 0.5, -2.0]), square, 3.0)
    assert none / none[0] == pytest.approx(square)
    large = _jitter_weights(1e4 * square, square, 3.0)
    assert large / large[0] == pytest.approx(1 / square, rel=1e-3)
    even = _jitter_weights(2.0 * square, square, 3.0)
    assert even == pytest.approx(square / ((3 + 2 * square) ** 2 + 3.0**2))
