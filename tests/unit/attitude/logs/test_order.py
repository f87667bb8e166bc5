"""Attitudes of a log that come late, and those that come twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.attitude.logs.entries import REORDER_NS, LogEntry, in_order
from hilstar.attitude.wire.packet import AttitudeSample, Refusal

Q = np.array([1.0, 0.0, 0.0, 0.0])
RATE = np.array([0.0, 0.0, 1.0])
SAMPLE = AttitudeSample(0, Q, RATE, 1)


def read(events):
    told: list[tuple[str, str]] = []
    entries = [LogEntry(f":{number}", event) for number, event in enumerate(events)]
    return [entry.where for entry in in_order(entries, told)], told


def at(*times_ns):
    return [replace(SAMPLE, t_ns=t_ns, sequence=k) for k, t_ns in enumerate(times_ns)]


# What waits is let go by what comes a second later; one that is later still stays behind it.
@pytest.mark.parametrize(("late_ns", "is_sorted"), [(REORDER_NS, True), (REORDER_NS + 1, False)])
def test_an_attitude_late_by_at_most_the_limit_is_sorted(late_ns, is_sorted):
    newest_ns = 10 * REORDER_NS
    order, told = read(at(0, newest_ns - late_ns + 1, newest_ns, newest_ns - late_ns))
    assert order == ([":0", ":3", ":1", ":2"] if is_sorted else [":0", ":1", ":3", ":2"])
    assert told == [
        ("log-order", "1 attitudes came out of order, by up to 1 s, and are sorted"),
    ]


def test_nothing_is_told_of_attitudes_in_order():
    assert read(at(0, 1, 2)) == ([":0", ":1", ":2"], [])


def test_a_refusal_comes_after_what_waits():
    order, _ = read([*at(5, 3), Refusal("format", "no attitude"), *at(4)])
    assert order == [":1", ":0", ":2", ":3"]


@pytest.mark.parametrize(
    ("change", "is_dropped"),
    [
        ({"sequence": 2}, True),
        ({"rate_cam_rad_s": RATE * 2}, False),
        ({"rate_cam_rad_s": None}, False),
        ({"q_icrs_to_cam": -Q}, False),
        ({"discontinuity": True}, False),
    ],
)
def test_an_attitude_that_says_nothing_new_is_dropped(change, is_dropped):
    order, told = read([SAMPLE, replace(SAMPLE, **change), replace(SAMPLE, t_ns=1)])
    assert order == ([":0", ":2"] if is_dropped else [":0", ":1", ":2"])
    assert [kind for kind, _ in told] == ["log-repeats"] * is_dropped


def test_two_without_a_rate_are_one():
    without = replace(SAMPLE, rate_cam_rad_s=None)
    assert read([without, without, SAMPLE])[0] == [":0", ":2"]


def test_the_largest_of_several_delays_is_told():
    newest_ns = 10 * REORDER_NS
    _, told = read(at(newest_ns, newest_ns - 8 * 10**8, newest_ns - 10**8))
    assert told == [
        ("log-order", "2 attitudes came out of order, by up to 0.8 s, and are sorted"),
    ]
