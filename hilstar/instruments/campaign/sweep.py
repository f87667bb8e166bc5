"""A sweep with an edge: the value of a key at which a tracker stops answering, by bisection.

Both ends come first, then the middle of the widest gap, again and again: that in which the edge is,
and those to the levels that show it. At each level so many cases are run. A case is a success where
at least half of its frames have a right answer, or, with `star_v_mag`, where at least half of the
stars up to that V are reported. The edge is where the share of successes falls below `share`.

**Interval.** Successes are taken to become rarer along the sweep, and nothing else. The edge is
beyond each level whose share is shown to be larger than `share`, and before each level whose share
is shown to be smaller: Clopper and Pearson, with the error shared among the levels (Bonferroni).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from hilstar.basics.errors import InputError
from hilstar.basics.toml_tables import Table
from hilstar.instruments.assess.bounded_figures import BoundedFigure, TooFewCases, clopper_pearson
from hilstar.instruments.campaign.case_table import Columns
from hilstar.instruments.campaign.cases import REPORTED_FRAMES
from hilstar.instruments.campaign.plan import Number

STILL, NOT_EVEN = "still answers at", "does not even answer at"
STAR_V, STAR_DX = "star_v_mag", "star_dx_px"  # columns of a campaign's table
ENDS = 2  # levels before the first middle
LEVEL_CONFIDENCE = 0.95  # by which levels are chosen, whatever the clauses' own
SAME_WIDTH = 1e-9  # gaps that differ by less are equally wide


class SweepTable(Table, frozen=True):
    """[cases.NAME.sweep]: a key from `start`, where the tracker answers, to `stop`, where it does
    not any more.
    """

    key: Annotated[str, Meta(min_length=1, max_length=200)]
    start: Number
    stop: Number
    scale: Literal["linear", "log"] = "linear"
    rounds: Annotated[int, Meta(ge=1, le=20)] = 6
    share: Annotated[float, Meta(ge=0.01, le=0.99)] = 0.5
    whole: bool = False
    star_v_mag: Annotated[float, Meta(ge=-30, le=30)] | None = None
    unit: Annotated[str, Meta(max_length=20)] = ""

    def check(self, where: str) -> None:
        """Refuse (InputError) ends that make no sweep."""
        if self.start == self.stop:
            raise InputError(f"{where}: start and stop are both {self.start:g}; write two numbers")
        if self.scale == "log" and min(self.start, self.stop) <= 0:
            raise InputError(f'{where}: scale = "log" needs numbers above 0; write such ones')

    @property
    def levels(self) -> int:
        """The largest number of levels."""
        return ENDS + self.rounds

    def between(self, first: float, second: float) -> float:
        """The level in the middle of two; of a `whole` key a whole number."""
        if self.scale == "log":
            middle = math.sqrt(first * second)
        else:
            middle = (first + second) / 2
        return float(round(middle)) if self.whole else middle

    def width(self, first: float, second: float) -> float:
        """How far two levels are apart, on the sweep's scale."""
        if self.scale == "log":
            return abs(math.log(second / first))
        return abs(second - first)

    def shown(self, count: "LevelCount", confidence: float) -> tuple[bool, bool]:
        """Whether a level's share is shown to be at least, and to be below, the edge's; the error
        is shared among the levels.
        """
        shared = 1 - (1 - confidence) / self.levels
        low, high = clopper_pearson(count.successes, count.cases, shared)
        return low >= self.share, high < self.share


@dataclass(frozen=True, slots=True)
class LevelCount:
    """How many of a level's cases were successes."""

    level: float
    successes: int
    cases: int

    @property
    def passed(self) -> bool:
        """Whether at least half were."""
        return self.cases > 0 and 2 * self.successes >= self.cases


def counted(level: float, cases: Columns, star_v_mag: float | None = None) -> LevelCount:
    """The successes among the cases of a level, by their attitudes, or by their stars up to a V."""
    if star_v_mag is not None:
        return _with_stars(level, cases, star_v_mag)
    numbers = cases.numbers
    right = np.nan_to_num(numbers["solved"]) - np.nan_to_num(numbers["wrong"])
    frames = np.nan_to_num(numbers["frames"])
    success = (frames > 0) & (2 * right >= frames)
    return LevelCount(level, int(success.sum()), len(success))


def _with_stars(level: float, cases: Columns, star_v_mag: float) -> LevelCount:
    """The cases of which half of the stars up to a V are reported. A case that lit no such star
    does not count; one without a frame that reports stars is none.
    """
    successes = count = 0
    silent = np.nan_to_num(cases.numbers[REPORTED_FRAMES]) == 0
    of_cases = zip(silent.tolist(), cases.lists[STAR_V], cases.lists[STAR_DX], strict=True)
    for is_silent, v_mag, dx_px in of_cases:
        bright = v_mag <= star_v_mag
        lit = int(bright.sum())
        reported = int(np.isfinite(dx_px[bright]).sum())
        count += is_silent or lit > 0
        successes += lit > 0 and 2 * reported >= lit
    return LevelCount(level, successes, count)


def next_level(sweep: SweepTable, counts: list[LevelCount]) -> float | None:
    """The level to run after these, in the order in which they were run; None at the end.

    Three gaps are halved, the widest first: from the farthest level that passed to the first one
    that did not, and from each of these to the one that shows it.
    """
    if len(counts) < ENDS:
        return (sweep.start, sweep.stop)[len(counts)]
    if not counts[0].passed or len(counts) >= sweep.levels:
        return None
    along = sorted({count.level for count in counts}, key=lambda level: abs(level - sweep.start))
    place = {level: k for k, level in enumerate(along)}
    passed = max(place[count.level] for count in counts if count.passed)
    failed = min((place[c.level] for c in counts if not c.passed), default=passed)
    shown = [(place[c.level], sweep.shown(c, LEVEL_CONFIDENCE)) for c in counts]
    beyond = max((at for at, (is_good, _) in shown if is_good), default=0)
    before = min((at for at, (_, is_bad) in shown if is_bad), default=len(along) - 1)
    first, last = min(passed, failed), max(passed, failed)
    widest = 0.0
    best = None
    for low, high in ((first, last), (beyond, first), (last, before)):
        if low >= high:
            continue
        # a level within the gap that was run already leaves the wider part of it
        for k in range(low, high):
            level = sweep.between(along[k], along[k + 1])
            width = sweep.width(along[k], along[k + 1])
            if level not in place and width > widest * (1 + SAME_WIDTH):
                widest, best = width, level
    return best


def edge_figure(sweep: SweepTable, counts: list[LevelCount], confidence: float) -> BoundedFigure:
    """The edge with its one-sided limits. Raises TooFewCases where no case was run."""
    if not counts:
        raise TooFewCases("no level was run", 0)
    cases = sum(count.cases for count in counts)
    # along the sweep: -1 where it goes down
    sense = 1.0 if sweep.stop > sweep.start else -1.0
    beyond, before = -math.inf, math.inf
    good, bad = -math.inf, math.inf
    for count in counts:
        at = sense * count.level
        shown_good, shown_bad = sweep.shown(count, confidence)
        if shown_good:
            beyond = max(beyond, at)
        if shown_bad:
            before = min(before, at)
        if count.passed:
            good = max(good, at)
        else:
            bad = min(bad, at)
    ends = sorted((sense * beyond, sense * before))
    method = f"bisection over {len(counts)} levels, Clopper-Pearson at each"
    if not math.isfinite(good):
        value = sweep.start
        method += f"; {NOT_EVEN} the start"
    elif not math.isfinite(bad):
        value = sweep.stop
        method += f"; {STILL} the stop"
    else:
        value = sweep.between(sense * good, sense * bad)
    return BoundedFigure(value, ends[0], ends[1], cases, method)


def levels_text(counts: list[LevelCount]) -> Iterator[tuple[Any, ...]]:
    """Rows of the levels in their order: level, successes, cases."""
    for count in sorted(counts, key=lambda count: count.level):
        yield count.level, count.successes, count.cases
