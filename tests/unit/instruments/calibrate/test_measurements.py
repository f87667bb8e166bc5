"""Measured patches: a row's light, errors and time by its own exposure, and levels of repeats."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.instruments.calibrate.measurements import (
    check_drift,
    check_levels,
    drift_over_run,
    group_levels,
    read_measurements,
)
from tests.support.refusals import refusal

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


def test_a_code_of_more_bits_than_are_said_is_refused(tmp_path):
    table = table_of(tmp_path, "code,channel,value\n0,w,1\n256,w,9\n")
    told = refusal(read_measurements, table, 8)
    assert "code 256 is outside 8 bits (0 to 255); say --bits" in told
    assert read_measurements(table, 9).bits == 9
    largest = table_of(tmp_path, "code,channel,value\n0,w,1\n255,w,9\n")
    assert read_measurements(largest, 8).bits == read_measurements(largest).bits == 8


@pytest.mark.parametrize(
    ("readings", "clipped"),
    [
        (((200, 9.0), (255, 9.0)), []),
        (((200, 9.0), (255, 9.0), (255, 9.0)), [200, 255]),
        (((255, 9.0), (255, 9.0), (255, 9.0), (200, 8.0)), []),
        (((100, 9.0), (200, 9.0), (255, 9.0), (240, 8.0)), [100, 200, 255]),
    ],
)
def test_an_instrument_is_at_its_limit_where_three_largest_readings_of_several_codes_are_alike(
    tmp_path, readings, clipped
):
    rows = [f"{code},r,{value}" for code, value in readings]
    # another channel's readings have a limit of their own
    text = "\n".join(["code,channel,value", "0,r,1", "255,g,9", *rows, ""])
    measured = read_measurements(table_of(tmp_path, text))
    assert measured.clipped["r"] == clipped
    assert measured.clipped["g"] == []


def test_black_is_the_mean_of_its_readings_in_all_channels(tmp_path):
    text = "code,channel,value\n0,r,1\n0,g,2\n0,w,6\n255,r,20\n255,g,40\n255,w,60\n"
    measured = read_measurements(table_of(tmp_path, text))
    assert measured.channels == ("w", "r", "g")
    for channel, white in (("r", 20.0), ("g", 40.0), ("w", 60.0)):
        levels = group_levels(measured, channel)
        assert (levels.code.tolist(), levels.count.tolist()) == ([0, 255], [3, 1])
        np.testing.assert_allclose(levels.mean, [3.0, white])


def checked(folder, changes, sigma=1.0):
    """Refuse levels of 20 codes that rise by 100 from each to the next, but for `changes` by code,
    each known to `sigma`; the reason, "" for none.
    """
    rows = []
    for number, code in enumerate([*range(0, 247, 13), 255]):
        rows.append(f"{code},w,{changes.get(code, 100.0 * number)},{sigma}")
    text = "\n".join(["code,channel,value,sigma", *rows, ""])
    measured = read_measurements(table_of(folder, text))
    levels = group_levels(measured, "w")
    try:
        check_levels(measured, "w", levels)
    except InputError as error:
        return str(error)
    return ""


def test_light_falls_where_it_does_by_four_errors_of_both_levels(tmp_path):
    """The difference of two levels of 1 is known to 1.41: four of these are 5.66."""
    assert checked(tmp_path, {}) == ""
    assert checked(tmp_path, {130: 895.0}) == ""
    told = checked(tmp_path, {130: 894.0})
    assert "light falls by 0.67 % from code 117 to code 130, beyond the noise" in told


def test_a_top_is_flat_below_where_an_s_curve_differs_from_white_by_its_noise(tmp_path):
    """White of 1900 known to 1 %: by sin^2 it falls by 3 (1 - code / white)^2, four times 1 % at
    11.5 % below white. Code 221 is 13 % below it, and code 234 is 8 %.
    """
    sigma = 19.0 / math.sqrt(2)
    near_white = {221: 1895.0, 234: 1896.0}
    told = checked(tmp_path, near_white, sigma)
    assert "codes 221 to 255 read the same" in told
    assert checked(tmp_path, {234: 1896.0}, sigma) == ""


def test_a_drift_s_error_is_of_what_patches_and_slope_leave_free(tmp_path, rng):
    """Against a line of its own for each of three patches, all of one slope."""
    t_s = np.sort(rng.uniform(0, 50, 14))
    patch = rng.permutation(np.arange(14) % 3)
    light = np.array([10.0, 40.0, 90.0])[patch] * np.exp(0.01 * rng.normal(size=14))
    rows = ["code,channel,value,t_s"]
    for number, value, at_s in zip(patch.tolist(), light.tolist(), t_s.tolist(), strict=True):
        rows.append(f"{(60, 120, 255)[number]},w,{value!r},{at_s!r}")
    measured = read_measurements(table_of(tmp_path, "\n".join([*rows, ""])))
    design = np.column_stack([patch == 0, patch == 1, patch == 2, t_s]).astype(float)
    fitted, squares, *_ = np.linalg.lstsq(design, np.log(light), rcond=None)
    error = math.sqrt(squares[0] / (14 - 4) * np.linalg.inv(design.T @ design)[3, 3])
    span_s = float(np.ptp(t_s))
    assert drift_over_run(measured) == pytest.approx((fitted[3] * span_s, error * span_s))
