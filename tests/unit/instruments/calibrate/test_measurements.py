"""Measured patches: a row's light, errors and time by its own exposure, and levels of repeats."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.instruments.calibrate.measurements import (
    check_drift,
    drift_over_run,
    group_levels,
    read_measurements,
)

TABLE = """code,channel,value,exposure_s,sigma,common_1,common_2,t_s
0,w,2,0.5,0.1,0.02,0.2,10
100,w,30,0.25,0.4,0.1,-0.3,12
100,w,34,0.25,0.3,0.3,-0.1,20
255,w,80,0.1,0.8,0.5,0.4,40
"""


def table_of(folder, text):
    path = folder / "measured.csv"
    path.write_text(text)
    return path


def test_light_and_its_errors_are_of_a_row_s_own_exposure(tmp_path):
    measured = read_measurements(table_of(tmp_path, TABLE))
    assert (measured.bits, measured.code.tolist()) == (8, [0, 100, 100, 255])
    np.testing.assert_allclose(measured.value, [4.0, 120.0, 136.0, 800.0])
    np.testing.assert_allclose(measured.sigma, [0.2, 1.6, 1.2, 8.0])
    np.testing.assert_allclose(measured.common, [[0.04, 0.4], [0.4, -1.2], [1.2, -0.4], [5.0, 4.0]])
    assert measured.time.tolist() == [10.0, 12.0, 20.0, 40.0]
    levels = group_levels(measured, "w")
    np.testing.assert_allclose(levels.mean, [4.0, 128.0, 800.0])
    assert levels.count.tolist() == [1, 2, 1]
    # the error of a mean of two is of their mean variance; what they share does not shrink
    np.testing.assert_allclose(levels.stated, [0.2, math.sqrt((1.6**2 + 1.2**2) / 2 / 2), 8.0])
    np.testing.assert_allclose(levels.common, [[0.04, 0.4], [0.8, -0.8], [5.0, 4.0]])
    plain = read_measurements(table_of(tmp_path, "code,channel,value\n0,w,1\n700,w,9\n"))
    assert (plain.bits, plain.value.tolist(), plain.time.tolist()) == (10, [1.0, 9.0], [0.0, 1.0])
    assert not plain.sigma.any()


# a drift of 0.5 % and more, beyond its noise, is refused
@pytest.mark.parametrize(("per_s", "is_refused"), [(0.0, False), (-1e-4, True), (2e-3, True)])
def test_a_drift_is_the_trend_of_repeats_over_the_whole_run(tmp_path, rng, per_s, is_refused):
    """Two codes in two channels, in turn, at uneven times; black, whose noise is another, counts
    for nothing.
    """
    times = np.sort(rng.uniform(0, 100, 24))
    rows = []
    for number, t_s in enumerate(times.tolist()):
        code, channel, light = ((200, "r", 50.0), (255, "g", 90.0), (0, "w", 0.1))[number % 3]
        value = light * math.exp(per_s * t_s) * (1 + 1e-4 * rng.normal())
        if not code:
            value = light * rng.uniform(0.5, 2)
        rows.append(f"{code},{channel},{value!r},{t_s}")
    text = "\n".join(["code,channel,value,t_s", *rows]) + "\n"
    measured = read_measurements(table_of(tmp_path, text))
    drift, error = drift_over_run(measured)
    span_s = times[-1] - times[0]
    assert drift == pytest.approx(per_s * span_s, abs=4 * error)
    # 16 lit readings of 1e-4 each, spread evenly over the run
    assert error == pytest.approx(1e-4 / math.sqrt(16) * math.sqrt(12), rel=0.5)
    if is_refused:
        with pytest.raises(Exception, match="light drifts by"):
            check_drift(measured)
    else:
        assert check_drift(measured) == drift


def test_what_repeats_scatter_is_beyond_their_stated_errors(tmp_path, rng):
    """Readings of 1 % of noise and of stated errors of 0.6 %, whose levels scatter by both."""
    rows = ["code,channel,value,sigma"]
    for code in (0, 50, 100, 150, 200, 255):
        light = 1e-3 if code == 0 else float(code)
        for _ in range(80):
            value = light * (1 + 0.01 * rng.normal() + 0.006 * rng.normal())
            rows.append(f"{code},w,{value!r},{0.006 * light!r}")
    measured = read_measurements(table_of(tmp_path, "\n".join(rows) + "\n"))
    levels = group_levels(measured, "w")
    assert levels.relative_noise == pytest.approx(0.01, rel=0.15)
    assert levels.additive_noise == 0.0
    # stated errors that are all there is leave no other
    quiet = []
    for row in rows[1:]:
        code, channel, value, sigma = row.split(",")
        quiet.append(",".join((code, channel, value, repr(10 * float(sigma)))))
    over = read_measurements(table_of(tmp_path, "\n".join([rows[0], *quiet]) + "\n"))
    assert group_levels(over, "w").relative_noise == 0.0


def test_stated_errors_are_taken_from_what_two_repeats_scatter(tmp_path):
    """Each code read twice, 2 % apart, by 1 % of stated error: one degree of freedom each."""
    rows = ["code,channel,value,sigma", *["0,w,0.001,0.00001"] * 2]
    for code in range(20, 260, 20):
        for off in (-0.01, 0.01):
            rows.append(f"{min(code, 255)},w,{code * (1 + off)!r},{0.01 * code!r}")
    measured = read_measurements(table_of(tmp_path, "\n".join(rows) + "\n"))
    assert group_levels(measured, "w").relative_noise == pytest.approx(0.01)


def test_a_floor_beside_relative_noise_is_what_faint_levels_scatter_beyond_it(tmp_path, rng):
    """5 % of each reading, and 6 units of all: faint levels of 60 units scatter by 6.7."""
    rows = ["code,channel,value"]
    for code, light in zip(range(0, 120, 10), (*[60.0] * 5, *[6e4] * 7), strict=True):
        scatter = 0.05 * light * rng.normal(size=400) + 6.0 * rng.normal(size=400)
        for value in (light + scatter).tolist():
            rows.append(f"{code},w,{value!r}")
    levels = group_levels(read_measurements(table_of(tmp_path, "\n".join(rows) + "\n")), "w")
    # the scatter of 2000 readings is known to 1.6 %
    assert levels.additive_noise == pytest.approx(6.0, rel=0.07)
    assert levels.relative_noise == pytest.approx(0.05, rel=0.1)


def test_a_cause_without_a_value_in_a_row_does_nothing_to_it(tmp_path):
    text = "code,channel,value,common_1,common_2\n0,w,1,,0.5\n9,w,5,0.25,\n"
    measured = read_measurements(table_of(tmp_path, text))
    assert measured.common.tolist() == [[0.0, 0.5], [0.25, 0.0]]
