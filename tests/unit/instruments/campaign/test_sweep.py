"""A sweep with an edge: levels by bisection, and an interval that holds whatever the curve."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.instruments.campaign.case_table import Columns
from hilstar.instruments.campaign.sweep import (
    LevelCount,
    SweepTable,
    counted,
    edge_figure,
    next_level,
)

CASES = 16
TRIES = 150
# binomial: of 150 intervals at 95 % each way, 133 and fewer hold once in 690
MIN_HELD = 134


def swept(
    sweep: SweepTable, edge: float, width: float, rng: np.random.Generator
) -> list[LevelCount]:
    """The levels of a tracker whose share of answers falls by a logistic curve of log level."""
    counts: list[LevelCount] = []
    sense = 1 if sweep.stop > sweep.start else -1
    while (level := next_level(sweep, counts)) is not None:
        off = sense * math.log(level / edge) / width
        share = 1 / (1 + math.exp(min(off, 700.0)))
        counts.append(LevelCount(level, int(rng.binomial(CASES, share)), CASES))
    return counts


@pytest.mark.parametrize(("start", "stop"), [(0.1, 10.0), (10.0, 0.1)])
def test_a_sharp_edge_is_bracketed_as_closely_as_the_rounds_allow(
    start: float, stop: float, rng: np.random.Generator
) -> None:
    sweep = SweepTable(key="k", start=start, stop=stop, scale="log", rounds=7)
    counts = swept(sweep, 2.0, 1e-6, rng)
    assert len(counts) == sweep.levels
    found = edge_figure(sweep, counts, 0.95)
    # a hundredfold range, halved seven times on its logarithm: 100^(1/128)
    assert found.low < 2.0 < found.high and found.high / found.low == pytest.approx(1.037, abs=1e-3)
    assert found.low <= found.value <= found.high


@pytest.mark.parametrize("width", [0.02, 0.1, 0.5])
def test_limits_hold_at_their_confidence(width: float, rng: np.random.Generator) -> None:
    sweep = SweepTable(key="k", start=0.1, stop=10.0, scale="log", rounds=7)
    held = np.zeros(2)
    for _ in range(TRIES):
        found = edge_figure(sweep, swept(sweep, 1.5, width, rng), 0.95)
        held += found.low <= 1.5, found.high >= 1.5
    assert (held >= MIN_HELD).all()


def test_an_edge_that_is_not_reached_has_an_open_end(rng: np.random.Generator) -> None:
    sweep = SweepTable(key="k", start=1.0, stop=10.0, rounds=4)
    beyond = edge_figure(sweep, swept(sweep, 1e6, 0.01, rng), 0.95)
    assert beyond.low == 10.0 and beyond.high == math.inf and "at the stop" in beyond.method
    before = edge_figure(sweep, swept(sweep, 1e-6, 0.01, rng), 0.95)
    assert before.high == 1.0 and before.low == -math.inf and "at the start" in before.method


def test_where_it_still_answers_at_the_stop_levels_before_it_show_how_far() -> None:
    sweep = SweepTable(key="k", start=1.0, stop=9.0, rounds=3)
    counts = [LevelCount(1.0, 16, 16), LevelCount(9.0, 10, 16)]
    assert next_level(sweep, counts) == 5.0
    counts.append(LevelCount(5.0, 16, 16))
    assert next_level(sweep, counts) == 7.0
    assert edge_figure(sweep, counts, 0.95).low == 5.0


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_a_whole_key_takes_whole_numbers_and_ends_between_two(
    scale: Any, rng: np.random.Generator
) -> None:
    sweep = SweepTable(key="k", start=1, stop=9, scale=scale, whole=True, rounds=12)
    counts = swept(sweep, 6.5, 1e-6, rng)
    assert all(count.level == int(count.level) for count in counts)
    assert len(counts) < sweep.levels
    found = edge_figure(sweep, counts, 0.95)
    assert (found.low, found.high) == (6.0, 7.0)


def test_a_star_is_kept_where_half_of_the_bright_ones_are_reported() -> None:
    """Of five cases: all reported, one of two, none, no bright star lit, no frame with stars."""
    v_mag = [[2.0, 3.0, 6.0], [2.0, 3.0], [2.0], [6.0], []]
    off_px = [[0.1, 0.2, np.nan], [0.1, np.nan], [np.nan], [0.1], []]
    lists = {}
    for name, values in (("star_v_mag", v_mag), ("star_dx_px", off_px)):
        lists[name] = [np.array(row) for row in values]
    numbers = {"star_frames": np.array([1.0, 1.0, 1.0, 1.0, np.nan])}
    assert counted(7.0, Columns(5, numbers, {}, lists), 4.0) == LevelCount(7.0, 2, 4)


def test_a_level_without_a_case_that_counts_does_not_pass() -> None:
    assert not LevelCount(1.0, 0, 0).passed


def test_a_case_is_a_success_where_half_of_its_frames_are_right() -> None:
    """Wrong attitudes are none; a case without a frame is no success."""
    frames = np.array([4.0, 4.0, 4.0, 5.0, 0.0, np.nan, 4.0])
    solved = np.array([2.0, 1.0, 4.0, 2.0, 0.0, np.nan, np.nan])
    wrong = np.array([0.0, 0.0, 3.0, 0.0, 0.0, np.nan, 0.0])
    numbers = {"frames": frames, "solved": solved, "wrong": wrong}
    count = counted(2.5, Columns(len(frames), numbers, {}))
    assert (count.level, count.successes, count.cases) == (2.5, 1, 7)
    assert [LevelCount(1.0, *pair).passed for pair in ((2, 4), (1, 4), (0, 0))] == [
        True,
        False,
        False,
    ]


@pytest.mark.parametrize(
    ("start", "stop", "scale", "is_taken"),
    [
        (1.0, 2.0, "log", True),
        (2.0, 1.0, "log", True),
        (1.0, 0.0, "log", False),
        (0.0, 1.0, "log", False),
        (1.0, -2.0, "log", False),
        (-2.0, 1.0, "log", False),
        (1.0, -2.0, "linear", True),
        (-2.0, 1.0, "linear", True),
        (1.0, 1.0, "linear", False),
    ],
)
def test_a_sweep_by_factors_has_both_ends_above_0(start, stop, scale, is_taken) -> None:
    sweep = SweepTable(key="key", start=start, stop=stop, scale=scale)
    if is_taken:
        sweep.check("set")
        return
    with pytest.raises(InputError, match=r"^set: "):
        sweep.check("set")


@pytest.mark.parametrize(
    ("successes", "cases", "told"),
    [
        (7, 7, (False, False)),  # 0.5^7 is more than a part of eight of 5 %
        (8, 8, (True, False)),
        (0, 7, (False, False)),
        (0, 8, (False, True)),
        (15, 16, (True, False)),
        (9, 16, (False, False)),
    ],
)
def test_a_level_shows_its_share_with_its_part_of_the_doubt(successes, cases, told) -> None:
    sweep = SweepTable(key="k", start=1.0, stop=9.0, rounds=6)
    assert sweep.shown(LevelCount(3.0, successes, cases), 0.95) == told


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_an_edge_is_between_the_farthest_level_that_passed_and_the_nearest_that_did_not(
    sense: float,
) -> None:
    """In whatever order they were run."""
    sweep = SweepTable(key="k", start=sense, stop=9 * sense, rounds=3)
    counts = [
        LevelCount(sense * level, successes, 16)
        for level, successes in ((1.0, 16), (9.0, 0), (5.0, 2), (3.0, 14), (7.0, 1))
    ]
    found = edge_figure(sweep, counts, 0.95)
    assert found.value == 4.0 * sense
    assert sorted((sense * found.low, sense * found.high)) == [3.0, 5.0]
    assert found.cases == 80


@pytest.mark.parametrize(("scale", "level"), [("log", 10**0.5), ("linear", 65.811)])
def test_the_widest_gap_is_halved_on_the_sweep_s_own_scale(scale: str, level: float) -> None:
    """Passed at 10 and failed at 31.6, of which neither is sure. By factors the widest gap is that
    from 1 to 10, by numbers that from 31.6 to 100.
    """
    sweep = SweepTable(key="k", start=1.0, stop=100.0, scale=scale, rounds=6)  # type: ignore[arg-type]
    counts = [LevelCount(1.0, 16, 16), LevelCount(100.0, 0, 16)]
    counts += [LevelCount(10.0, 9, 16), LevelCount(10**1.5, 7, 16)]
    assert next_level(sweep, counts) == pytest.approx(level, abs=1e-3)
