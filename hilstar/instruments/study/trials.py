"""Trials: the methods of one step, each with its error and its time; their front, table and chart.

A study of trials makes `Trials` of a step, has them `measured`, and draws and writes them here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hilstar.basics.charts import (
    BLUE,
    MUTED,
    RED,
    SideNames,
    capital,
    chart,
    name_at_side,
    title_lines,
    two_digits,
)
from hilstar.instruments.study.sweep import (
    MAX_ROUNDS,
    NOT_JUDGED,
    Load,
    OtherWork,
    Spent,
    beaten_by,
    in_turn,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LABEL_COLUMNS = 40  # characters along an axis as high as a panel
# In a table: on the front, and the default.
MARKS = {True: "*>", False: "  "}
SHARE = "1"  # the unit of what has none
TITLES = {"psf": "PSF"}  # of a step whose name is an abbreviation
WHOLE_FROM_MS = 999.5  # .3g would say 1.2e+03, and round away what is drawn
MIN_HEIGHT_INCH, HEAD_INCH, NAME_INCH = 4.2, 1.9, 0.17


@dataclass(frozen=True, slots=True)
class Figure:
    """A measure of methods: its name and unit; values below `floor` count as 0."""

    name: str
    unit: str
    floor: float = 0.0


@dataclass(frozen=True, slots=True)
class Trial:
    """A method: its error and a second figure, in the units of its `Trials`, and the work that is
    timed.

    `more` are further figures by the names of their columns. The others are measured against the
    exact one. `measured` adds the median time and its quartiles, ms; `on_front` where no other is
    both as accurate and as fast; and in `beaten` the method that beats the default, and why the
    default stays.
    """

    method: str
    error: float
    second: float
    work: Callable[[], object]
    is_default: bool = False
    is_exact: bool = False
    more: dict[str, float] = field(default_factory=dict)
    time_ms: float = np.nan
    quartiles_ms: tuple[float, float] = (np.nan, np.nan)
    on_front: bool = False
    beaten: str = ""


@dataclass(frozen=True, slots=True)
class Trials:
    """All methods of a step. `work` names the timed work, `why_default` is the reason to keep the
    default where another method beats it.

    `remark` is a caution that the figures do not show. `load` is the work of others while it was
    timed.
    """

    name: str
    work: str
    error: Figure
    second: Figure
    why_default: str
    trials: Sequence[Trial]
    remark: str = ""
    load: Load = field(default_factory=Load)

    @property
    def default(self) -> Trial:
        """The method that hilstar takes."""
        return next(trial for trial in self.trials if trial.is_default)


def measured(step: Trials, budget_s: float) -> Trials:
    """Time the methods of a step in turn, put the fastest first, and judge them."""
    others = OtherWork()
    works = {}
    for trial in step.trials:
        works[trial.method] = partial(called, trial.work)
    times = in_turn(works, MAX_ROUNDS, budget_s / len(works))
    load = others.load()
    timed = []
    for trial in step.trials:
        low, middle, high = quartiles_ms(times[trial.method])
        timed.append(replace(trial, time_ms=middle, quartiles_ms=(low, high)))
    timed.sort(key=lambda trial: trial.time_ms)
    return judged(replace(step, trials=timed, load=load))


def judged(step: Trials) -> Trials:
    """A step whose methods are timed, with its front, and what beats its default.

    On a busy machine no method is on the front, and none is said to beat the default.
    """
    errors = []
    for trial in step.trials:
        errors.append(max(trial.error, step.error.floor))
    times_ms = [trial.time_ms for trial in step.trials]
    # On a busy machine every method counts as beaten: none is on the front.
    beaten = beaten_by(errors, times_ms) | step.load.busy
    trials = []
    for trial, beats in zip(step.trials, beaten, strict=True):
        why = ""
        if trial.is_default and beats.any() and not step.load.busy:
            better = [
                rival for rival, is_better in zip(step.trials, beats, strict=True) if is_better
            ]
            best = min(better, key=lambda rival: rival.time_ms)
            why = f"{beaten_words(trial, best)}; {step.why_default}"
        trials.append(replace(trial, on_front=not beats.any(), beaten=why))
    return replace(step, trials=trials)


def called(work: Callable[[], object], _: int) -> object:
    """Call a work that does not ask for the number of its round."""
    return work()


def quartiles_ms(times: Sequence[Spent]) -> tuple[float, float, float]:
    """The quartiles of wall times, ms, the median in the middle."""
    low, middle, high = np.percentile([taken.wall_ms for taken in times], (25, 50, 75)).tolist()
    return low, middle, high


def beaten_words(default: Trial, best: Trial) -> str:
    """By how much a method beats the default."""
    saved = 100 * (1 - best.time_ms / default.time_ms)
    comparison_text = f"'{best.method}' is no worse and takes {saved:.0f} % less time"
    if best.quartiles_ms[1] >= default.quartiles_ms[0]:
        return f"{comparison_text}, and the quartiles of both overlap"
    return comparison_text


def table_lines(step: Trials) -> list[str]:
    """A step's table for a person, the fastest method first."""
    wide = max(len(row.method) for row in step.trials)
    columns = (
        f"{step.error.name} [{step.error.unit}]",
        f"{step.second.name} [{step.second.unit}]",
        "ms",
    )
    lines = ["", f"{step.name}: {step.work}", f"   {'method':{wide}}  {'   '.join(columns)}"]
    for row in step.trials:
        error = f"{row.error:>{len(columns[0])}.3g} "
        second = f"{row.second:>{len(columns[1])}.3g} "
        marks = MARKS[row.on_front][0] + MARKS[row.is_default][1]
        lines.append(f"{marks} {row.method:{wide}}  {error}  {second} {row.time_ms:.3g}")
    beaten = step.default.beaten
    if step.load.busy:
        lines.append(f"   {NOT_JUDGED}")
    if beaten:
        lines.append(f"   the default: {beaten}")
    if step.remark:
        lines.append(f"   {step.remark}")
    return lines


def finding(step: Trials) -> str:
    """The title of a step's chart; its times only where they can be judged."""
    default = step.default
    exact = next((trial for trial in step.trials if trial.is_exact), None)
    off = f"is off by {said(default.error, step.error)}"
    if default.error <= step.error.floor:
        off = "has no error"
    text = f"{TITLES.get(step.name, step.name)}: '{default.method}' {off}"
    timed = f"{text} in {ms_words(default.time_ms)}"
    if exact is not None:
        timed += f"; '{exact.method}' takes {ms_words(exact.time_ms)}"
    return step.load.title(timed, text)


def ms_words(time_ms: float) -> str:
    """A time as a title says it: three digits, and all whole milliseconds from a second on."""
    if time_ms < WHOLE_FROM_MS:
        return f"{time_ms:.3g} ms"
    return f"{time_ms:.0f} ms"


def said(value: float, figure: Figure) -> str:
    """A figure with its unit; a share has none."""
    if figure.unit == SHARE:
        return two_digits(value)
    return f"{two_digits(value)} {figure.unit}"


@dataclass(frozen=True, slots=True)
class FrontPoint:
    """A choice on a chart of error against time: its place and colour, the ends of its bar, and the
    colours of its rings.
    """

    time_ms: float
    error: float
    ends_ms: tuple[float, float]
    colour: str
    on_front: bool
    rings: tuple[str, ...] = ()

    @property
    def place(self) -> tuple[float, float]:
        """Time and error."""
        return self.time_ms, self.error


@dataclass(frozen=True, slots=True)
class FrontLook:
    """How a chart draws its front, the bars of times, and points that are not on the front.

    `line` is None where the front has no line; `ring_pt` are the diameters of rings by their
    colours.
    """

    line: Mapping[str, Any] | None
    bar: Mapping[str, Any]
    beaten: Mapping[str, Any]
    ring_pt: Mapping[str, float]
    ring_width: float


TRIALS_LOOK: FrontLook = FrontLook(
    line={"color": BLUE, "lw": 1.4},
    bar={"lw": 3.5, "alpha": 0.4, "solid_capstyle": "butt"},
    beaten={},
    ring_pt={RED: 14},
    ring_width=2.0,
)


def draw_front(axes: "Axes", points: Sequence[FrontPoint], look: FrontLook) -> None:
    """Draw error against time on logarithmic axes: the front as a line, and every point with its
    bar and its rings. The points come fastest first.
    """
    front = [point.place for point in points if point.on_front]
    if look.line is not None and len(front) > 1:
        times_ms, errors = zip(*front, strict=True)
        axes.step(times_ms, errors, where="post", **look.line)
    for point in points:
        axes.plot(point.ends_ms, [point.error] * 2, color=point.colour, **look.bar)
        style: dict[str, Any] = {"color": point.colour, "ms": 6, "zorder": 3}
        if not point.on_front:
            style |= look.beaten
        axes.plot(*point.place, "o", **style)
    for point in points:
        for colour in point.rings:
            ring: dict[str, Any] = {"color": colour, "mfc": "none", "mew": look.ring_width}
            axes.plot(*point.place, "o", ms=look.ring_pt[colour], zorder=4, **ring)
    axes.set(xscale="log", yscale="log")


def draw_trials(path: Path, step: Trials, machine: str) -> None:
    """Draw error against time on logarithmic axes: the front as a line, the default ringed,
    every method named at the side.
    """
    height = max(MIN_HEIGHT_INCH, HEAD_INCH + NAME_INCH * len(step.trials))
    note = step.load.note(trials_note(step, machine))
    unit = step.error.unit.replace(SHARE, "share")
    ylabel = title_lines(f"{step.error.name} [{unit}]", LABEL_COLUMNS)
    with chart(path, finding(step), note=note, height_inch=height) as (axes,):
        draw_front(axes, front_points(step), TRIALS_LOOK)
        axes.set(xlabel="median time [ms]", ylabel=ylabel)
        axes.margins(0.06, 0.08)
        if any(trial.error < step.error.floor for trial in step.trials):
            axes.axhline(step.error.floor, color=MUTED, ls=":", lw=1.2)
        name_at_side(axes, side_names(step))


def front_points(step: Trials) -> list[FrontPoint]:
    """The methods of a step as they are drawn, the default ringed."""
    front_count = sum(trial.on_front for trial in step.trials)
    points = []
    for trial in step.trials:
        rings: tuple[str, ...] = ()
        colour = front_colour(trial)
        if trial.is_default:
            rings = (RED,)
            # A default that is alone on the front has the colour of its name.
            if front_count == 1:
                colour = RED
        time_ms, error = place_of(trial, step)
        points.append(FrontPoint(time_ms, error, trial.quartiles_ms, colour, trial.on_front, rings))
    return points


def trials_note(step: Trials, machine: str) -> str:
    """What is drawn, and on which machine."""
    front = " Blue: the front, which nothing else is as right and as fast as."
    if step.load.busy:
        front = ""
    dotted = ""
    if step.error.floor:
        dotted = f" Dotted: {said(step.error.floor, step.error)}, no error below it."
    return (
        f"{capital(step.work)}.{front} Ring: hilstar's default. Bars: quartiles.{dotted} {machine}."
    )


def place_of(trial: Trial, step: Trials) -> tuple[float, float]:
    """Where a method is drawn: its time, ms, and its error, at least the floor."""
    return trial.time_ms, max(trial.error, step.error.floor)


def front_colour(trial: Trial) -> str:
    """The colour of a method's point."""
    if trial.on_front:
        return BLUE
    return MUTED


def side_names(step: Trials) -> SideNames:
    """The names beside the points, the largest error first."""
    falling = sorted(step.trials, key=lambda trial: (-place_of(trial, step)[1], trial.time_ms))
    names = []
    for trial in falling:
        colour = front_colour(trial)
        if trial.is_default:
            colour = RED
        names.append((trial.method, place_of(trial, step), colour))
    return names
