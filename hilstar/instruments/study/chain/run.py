"""The study of the whole chain: a frame's error against its time for each combination of a bench's
choices, in five scenes.

A combination is on the front unless another of its scene has time and error no larger, and one of
them smaller; two that are equal in both are both on it. Figures are the table's, rounded as they
stand there. `auto` is judged by the run's own noise.
"""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilstar.basics import charts
from hilstar.basics.errors import InputError
from hilstar.basics.files import make_directory
from hilstar.instruments.study.chain.answers import answer_lines
from hilstar.instruments.study.chain.choices import (
    DENSE,
    QUANTISATIONS,
    Parts,
    five_scenes,
    shortened_line,
)
from hilstar.instruments.study.chain.glass import GlassRow, draw_glass, glass_line, glass_rows
from hilstar.instruments.study.chain.measuring import (
    AUTO,
    DEFAULT,
    QUICK,
    RSS,
    WHOLE,
    CombinationRow,
    ErrorPart,
    Rounds,
    SceneMeasurement,
    StageTime,
    error_budget,
    noise_ends_ms,
    said,
)
from hilstar.instruments.study.chain.tracker import StudyTracker
from hilstar.instruments.study.engine import write_rows
from hilstar.instruments.study.sweep import NOT_JUDGED, Load, OtherWork, beaten_by, pareto_front
from hilstar.instruments.study.trials import FrontLook, FrontPoint, draw_front
from hilstar.server.bench.bench_file import BenchFile

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS: dict[str, str] = dict(
    zip(QUANTISATIONS, (charts.PURPLE, charts.ORANGE, charts.GREEN, charts.BLUE), strict=True)
)
PANEL_INCH, BARS_INCH, TITLE_INCH = 2.7, 1.5, 1.2
FLOOR_SHARE = 1e-3  # share of the smallest error at which 0 is drawn on a logarithmic axis
LESS = 0.9  # a point on the front is named if its error is below this share of the last named one's
ALIKE = 1.5  # scenes of one rate are drawn once where auto's error differs by less than this factor
WORDS = {
    "refresh": "panel's refresh",
    "codes": "quantisation",
    "sprites": "cut sprites",
    WHOLE: "all of it",
}
CHOSEN = {DEFAULT: charts.INK, AUTO: charts.RED}
STEP_COLOURS = {WHOLE: charts.RED}  # of bars; the others are blue
CHAIN_LOOK = FrontLook(
    line={"color": charts.INK, "lw": 1.2, "zorder": 2},
    bar={"lw": 1.0, "alpha": 0.4},
    beaten={"ms": 4, "alpha": 0.35},
    ring_pt={charts.RED: 13, charts.INK: 17},
    ring_width=1.6,
)
OUTPUTS = (
    "chain.png",
    "chain.svg",
    "chain_budget.png",
    "chain_budget.svg",
    "chain.csv",
    "chain_budget.csv",
    "chain_time.csv",
    "chain_psf.csv",
)


@dataclass(frozen=True, slots=True)
class ChainStudy:
    """What the study says: a line for each scene, whether `auto` is on every front or within its
    noise, and what to do.

    `right` is None on a busy machine.
    """

    lines: list[str]
    right: bool | None
    answers: list[str]


def rows_of(rows: Sequence[CombinationRow]) -> list[CombinationRow]:
    """The rows of a scene, the fastest first, with their fronts."""
    rows = sorted(rows, key=lambda row: (row.time_ms, row.error_arcsec))
    auto_row = rows[auto_of(rows)]
    by_arcsec = front(rows, "error_arcsec")
    by_mag = front(rows, "error_mag")
    filed = [number for number, row in enumerate(rows) if left_to_effort(row, auto_row)]
    filed_front = front([rows[number] for number in filed], "error_arcsec")
    as_filed = dict(zip(filed, filed_front, strict=True))
    with_fronts: list[CombinationRow] = []
    for number, row in enumerate(rows):
        with_fronts.append(
            replace(
                row,
                on_front=said(by_arcsec[number]),
                on_front_mag=said(by_mag[number]),
                on_front_as_filed=said(as_filed.get(number, False)),
            )
        )
    return with_fronts


def without_fronts(row: CombinationRow) -> CombinationRow:
    """A row without fronts, as times taken on a busy machine tell none."""
    return replace(row, on_front="", on_front_mag="", on_front_as_filed="")


def front(rows: Sequence[CombinationRow], error: str) -> list[bool]:
    """Whether each row is on the front of time and `error`, which is the name of a column."""
    errors = [getattr(row, error) for row in rows]
    times_ms = [row.time_ms for row in rows]
    return list(map(bool, pareto_front(errors, times_ms)))


def auto_of(rows: Sequence[CombinationRow]) -> int:
    """The place of the row that `effort = "auto"` takes."""
    return next(k for k, row in enumerate(rows) if AUTO in row.chosen)


def left_to_effort(row: CombinationRow, own: CombinationRow) -> bool:
    """Whether a row shares with `own` the choices that effort does not make.

    Those are the bench file's and the sender's.
    """
    given = ("bit_stealing", "faintest_v_mag", "prediction")
    return all(getattr(row, name) == getattr(own, name) for name in given)


def beating(
    rows: Sequence[CombinationRow], as_filed: bool = False
) -> tuple[list[CombinationRow], list[CombinationRow]]:
    """The rows that beat `auto` by arcsec and time: beyond the noise, and within it.

    With `as_filed` only those that effort may choose. Beyond the noise are rows faster by more than
    three sigmas of the difference of the medians. Within it this run cannot tell the times apart,
    and chance decides who is on the front.
    """
    auto_row = rows[auto_of(rows)]
    rivals = [row for row in rows if not as_filed or left_to_effort(row, auto_row)]
    errors_arcsec = [row.error_arcsec for row in rivals]
    times_ms = [row.time_ms for row in rivals]
    beats = beaten_by(errors_arcsec, times_ms)[rivals.index(auto_row)]
    beyond: list[CombinationRow] = []
    within: list[CombinationRow] = []
    for row, is_better in zip(rivals, beats, strict=True):
        if not is_better:
            continue
        noise_ms = 3 * math.hypot(auto_row.noise_ms, row.noise_ms)
        if auto_row.time_ms - row.time_ms > noise_ms or not noise_ms:
            beyond.append(row)
        else:
            within.append(row)
    return beyond, within


def scene_line(
    rows: Sequence[CombinationRow],
    budget: Sequence[ErrorPart],
    stages: Sequence[StageTime],
    load: Load,
) -> str:
    """One scene in words: what `auto` chooses, its error and time, and the largest part of each."""
    auto_row = rows[auto_of(rows)]
    stands = NOT_JUDGED if load.busy else standing(rows)
    largest = max(steps_of(budget), key=lambda part: part.error_arcsec)
    longest = max(stages, key=lambda stage: stage.time_ms)
    share = longest.time_ms / max(sum(stage.time_ms for stage in stages), 1e-9)
    stars = f"{auto_row.stars} stars"
    if auto_row.lost:
        stars += f", {auto_row.lost} of them lost"
    errors = f"{auto_row.error_arcsec:.3g} arcsec and {auto_row.error_mag:.2g} mag"
    return (
        f"{auto_row.scene}: {AUTO} ({words(auto_row)}) is {errors} off over {stars}, in"
        f" {auto_row.time_ms:.3g} ms; {stands}; error: {largest.step} {largest.error_arcsec:.2g}"
        f" arcsec; time: {longest.stage} {share:.0%}"
    )


def steps_of(budget: Sequence[ErrorPart], scene: str | None = None) -> list[ErrorPart]:
    """The steps of a budget, without their sums; of one scene where it is given."""
    steps = []
    for part in budget:
        if part.step not in (RSS, WHOLE) and scene in (None, part.scene):
            steps.append(part)
    return steps


def by_scene(rows: Sequence[CombinationRow]) -> dict[str, list[CombinationRow]]:
    """Rows by their scenes, in the order of the table."""
    scenes: dict[str, list[CombinationRow]] = {}
    for row in rows:
        scenes.setdefault(row.scene, []).append(row)
    return scenes


def headline(rows: Sequence[CombinationRow], load: Load) -> str:
    """What the table says of `auto`, as the chart's title; nothing on a busy machine."""
    scenes = by_scene(rows)
    beaten = [name for name, scene_rows in scenes.items() if beating(scene_rows)[0]]
    where = f"in {len(scenes) - len(beaten)} of {len(scenes)} scenes"
    if beaten:
        where += f", not in {', '.join(beaten)}"
    return load.title(
        'The choice of effort = "auto" is on the front of error against time, or within its noise,'
        f" {where}"
    )


def is_right(scenes: Sequence[Sequence[CombinationRow]]) -> bool:
    """Whether in no scene a choice that effort may take beats `auto` beyond the noise."""
    beyond = [beating(rows, as_filed=True)[0] for rows in scenes]
    return not any(beyond)


def standing(rows: Sequence[CombinationRow]) -> str:
    """Whether `auto` is on the front, in words; if not, what beats it and why effort does not take
    that.
    """
    beyond, within = beating(rows)
    auto_row = rows[auto_of(rows)]
    if not beyond and within:
        return f"on the front within the noise: {_compared(auto_row, _nearest(within))}"
    if not beyond:
        return "on the front"
    best = _nearest(beyond)
    text = f"not on the front: {_compared(auto_row, best)}: {why_not(auto_row, best)}"
    filed_beyond, filed_within = beating(rows, as_filed=True)
    if best in filed_beyond:
        return text
    if filed_beyond:
        nearest = _nearest(filed_beyond)
        reason = f"{_compared(auto_row, nearest)}: {why_not(auto_row, nearest)}"
        return f"{text}; nor of what effort may choose: {reason}"
    text += "; on the front of what effort may choose"
    if filed_within:
        text += ", within the noise"
    return text


def words(row: CombinationRow) -> str:
    """A row's combination in a few words."""
    codes = row.quantisation
    if row.bit_stealing == "true":
        codes += " with bit stealing"
    text = f"{codes}, {row.sprite} sprites"
    if row.rate_deg_s:
        text += f", {row.smear}s, {row.prediction}"
    return text


def why_not(own: CombinationRow, other: CombinationRow) -> str:
    """Why `effort = "auto"` does not take a combination that beats it."""
    reasons = []
    if other.bit_stealing != own.bit_stealing:
        reasons.append(
            "bit stealing is the bench file's choice, for a panel whose primaries are known as the"
            " tracker sees them"
        )
    if other.prediction != own.prediction and own.prediction == "held":
        reasons.append("[attitude] max_extrapolation_ms = 0 is the bench file's choice")
    elif other.prediction != own.prediction:
        reasons.append(
            f"prediction by {other.prediction} is the sender's choice (whether its packets have"
            " rates)"
        )
    if other.faintest_v_mag != own.faintest_v_mag:
        reasons.append("the catalogue's depth is the bench file's choice")
    if other.quantisation == "temporal":
        reasons.append(
            "temporal is right over an exposure, and effort asks for light that is right in each"
            " frame"
        )
    elif other.quantisation != own.quantisation:
        reasons.append(
            f"effort compares {own.quantisation} and {other.quantisation} by their worst star at"
            " any sub-pixel phase, not by a field's rms"
        )
    if other.sprite == "coarse" and own.sprite != "coarse":
        reasons.append("coarse sprites are beyond the tolerance")
    elif other.sprite != own.sprite:
        reasons.append("cut sprites save nothing here")
    if other.smear != own.smear:
        reasons.append(f"{other.smear}s instead of {own.smear}s")
    return "; ".join(reasons)


def _nearest(rows: Sequence[CombinationRow]) -> CombinationRow:
    return min(rows, key=lambda row: (row.error_arcsec, row.time_ms))


def _compared(own: CombinationRow, other: CombinationRow) -> str:
    faster_ms = own.time_ms - other.time_ms
    noise_ms = math.hypot(own.noise_ms, other.noise_ms)
    times = f"{faster_ms:.2g} ms faster (noise {noise_ms:.2g} ms)"
    return f"{words(other)} is {other.error_arcsec:.3g} arcsec off and {times}"


def differing(rows: Sequence[CombinationRow]) -> dict[str, list[str]]:
    """The scenes to draw, each with the scenes of the same rate whose error is alike."""
    alike: dict[str, list[str]] = {}
    autos: list[CombinationRow] = []
    for row in rows:
        if AUTO not in row.chosen:
            continue
        like = next((other for other in autos if is_alike(row, other)), None)
        if like is None:
            autos.append(row)
            alike[row.scene] = []
        else:
            alike[like.scene].append(row.scene)
    return alike


def is_alike(row: CombinationRow, other: CombinationRow) -> bool:
    """Whether two scenes have one rate, and errors that differ by less than ALIKE."""
    low, high = sorted((row.error_arcsec, other.error_arcsec))
    return row.rate_deg_s == other.rate_deg_s and high <= ALIKE * low


def draw(
    path: Path, rows: Sequence[CombinationRow], finding: str, machine: str, glass: list[GlassRow]
) -> None:
    """Error against time, a panel for each scene that differs, two for a glass. Raises
    InputError where it cannot write.
    """
    scenes = differing(rows)
    note = f"Pale: choices that another beats. {charts.capital(machine)}."
    if any(row.on_front == "true" for row in rows):
        note = f"The line is the front: nothing else is as right and as fast. {note}"
    count = len(scenes)
    if glass:
        count += 2
    layout: dict[str, Any] = {"share_x": False, "height_inch": TITLE_INCH + PANEL_INCH * count}
    rows_by_scene = by_scene(rows)
    with charts.chart(path, finding, count, note=note, **layout) as grid:
        for axes, (scene, alike) in zip(grid, scenes.items(), strict=False):
            scene_rows = rows_by_scene[scene]
            title = f"{scene}, {scene_rows[0].stars} stars"
            if alike:
                title += f" (the same in: {', '.join(alike)})"
            axes.set(title=title, ylabel="star's place, rms [arcsec]")
            _scatter(axes, scene_rows)
        grid[len(scenes) - 1].set_xlabel("median time of a frame [ms]")
        if glass:
            draw_glass(grid[-2], grid[-1], glass)


def _scatter(axes: "Axes", rows: Sequence[CombinationRow]) -> None:
    """A scene's combinations, with what is chosen ringed."""
    errors = [row.error_arcsec for row in rows if row.error_arcsec > 0]
    floor = FLOOR_SHARE * min(errors, default=1.0)
    points = []
    for row in rows:
        points.append(
            FrontPoint(
                row.time_ms,
                max(row.error_arcsec, floor),
                noise_ends_ms(row.time_ms, row.noise_ms),
                COLOURS[row.quantisation],
                row.on_front == "true",
                tuple(CHOSEN[name] for name in row.chosen.split()),
            )
        )
    draw_front(axes, points, CHAIN_LOOK)
    axes.margins(0.06, 0.12)
    charts.name_at_side(axes, side_names(rows, [point.place for point in points]))


def side_names(
    rows: Sequence[CombinationRow],
    at: Sequence[tuple[float, float]],
) -> charts.SideNames:
    """The names beside a scene's points: of the front, of what is chosen, and of other codes."""
    named: list[tuple[str, tuple[float, float], str]] = []
    last = math.inf
    auto = rows[auto_of(rows)]
    for row, place in zip(rows, at, strict=True):
        if row.on_front == "true" and place[1] < LESS * last and not row.chosen:
            named.append((short_words(row, auto), place, COLOURS[row.quantisation]))
            last = place[1]
    for row, place in zip(rows, at, strict=True):
        if row.chosen:
            named.append((chosen_words(row), place, chosen_colour(row)))
    for quantisation, colour in COLOURS.items():
        points = []
        for row, place in zip(rows, at, strict=True):
            if row.quantisation == quantisation:
                points.append((row, place))
        named_colours = {name[2] for name in named}
        # The best of codes that have no place on the front.
        if points and colour not in named_colours:
            row, place = min(points, key=lambda point: point[1][1])
            named.append((short_words(row, auto), place, colour))
    return named


def chosen_words(row: CombinationRow) -> str:
    """What chooses a row, and its error and time."""
    arcsec = charts.two_digits(row.error_arcsec)
    ms = charts.two_digits(row.time_ms)
    return f"{row.chosen.replace(' ', ', ')}: {arcsec} arcsec, {ms} ms"


def chosen_colour(row: CombinationRow) -> str:
    """The colour of the name of what is chosen."""
    if AUTO in row.chosen:
        return CHOSEN[AUTO]
    return CHOSEN[DEFAULT]


def short_words(row: CombinationRow, own: CombinationRow) -> str:
    """A row's combination for a chart: without its sprites, and with its depth only where that
    differs from `own`.
    """
    text = row.quantisation
    if row.bit_stealing == "true":
        text += " + bit stealing"
    if row.rate_deg_s:
        text += f", {row.smear}s by {row.prediction}".replace("by held", "held")
    if row.faintest_v_mag < own.faintest_v_mag:
        text += ", fewer stars"
    return text


def budget_finding(
    scenes: Sequence[str], budget: Sequence[ErrorPart], stages: Sequence[StageTime], load: Load
) -> str:
    """The largest part of each scene's error, and the longest stage."""
    most = []
    for scene in scenes:
        largest = max(steps_of(budget, scene), key=known_error)
        where = f"in the {scene}" if "field" in scene else f"at {scene}"
        most.append(f"{step_name(largest.step)} {where}")
    longest = max(stages, key=lambda stage: stage.time_ms)
    errors = f"Of auto's error most is {', '.join(most)}"
    return load.title(f"{errors}; of its time most is {longest.stage}", errors)


def known_error(part: ErrorPart) -> float:
    """The error of a part; an unknown one counts as the largest."""
    if math.isfinite(part.error_arcsec):
        return part.error_arcsec
    return math.inf


def step_name(step: str) -> str:
    """A step as a chart names it."""
    return WORDS.get(step, step)


def draw_budget(
    path: Path,
    rows: Sequence[CombinationRow],
    budget: Sequence[ErrorPart],
    stages: Sequence[StageTime],
    load: Load,
) -> None:
    """Where `auto`'s error and time come from, a row of panels for each scene that differs.
    Raises InputError.
    """
    scenes = list(differing(rows))
    with_error = {part.step for part in budget if part.error_arcsec or part.error_mag}
    shown = []
    unchanged = []
    for part in budget:
        if part.scene != scenes[0] or part.step == RSS:
            continue
        if part.step in with_error:
            shown.append(part.step)
        else:
            unchanged.append(step_name(part.step))
    note = "Each step is charged with what it changes when it is added to an exact display"
    if unchanged:
        note += f"; {' and '.join(unchanged)} change nothing here"
    finding = budget_finding(scenes, budget, stages, load)
    layout: dict[str, Any] = {
        "note": load.note(f"{note}."),
        "share_x": False,
        "height_inch": TITLE_INCH + BARS_INCH * len(scenes),
    }
    with charts.chart(path, finding, len(scenes), 3, **layout) as grid:
        for number, scene in enumerate(scenes):
            place, light, times = grid[3 * number : 3 * number + 3]
            place.set_title(scene)
            draw_errors(place, scene, budget, shown, "error_arcsec")
            draw_errors(light, scene, budget, shown, "error_mag")
            light.set_yticklabels([])
            draw_stages(times, [stage for stage in stages if stage.scene == scene])
        place, light, times = grid[-3:]
        place.set_xlabel("error, rms [arcsec]")
        light.set_xlabel("error, rms [mag]")
        times.set_xlabel("time of a frame [ms]")


def draw_errors(
    axes: "Axes", scene: str, budget: Sequence[ErrorPart], steps: Sequence[str], error: str
) -> None:
    """Bars of one error of a scene by step, the whole of it in another colour."""
    by_step = {part.step: part for part in budget if part.scene == scene}
    names = [step_name(step) for step in steps]
    errors = [getattr(by_step[step], error) for step in steps]
    colours = [STEP_COLOURS.get(step, charts.BLUE) for step in steps]
    charts.value_bars(axes, names, errors, colours)


def draw_stages(axes: "Axes", stages: Sequence[StageTime]) -> None:
    """Bars of the times of a scene by stage."""
    names = [stage.stage for stage in stages]
    times_ms = [stage.time_ms for stage in stages]
    charts.value_bars(axes, names, times_ms, charts.PURPLE)


@dataclass(frozen=True, slots=True)
class SceneResult:
    """What was measured of a scene: its rows with their fronts, the parts of auto's error and of
    its time.
    """

    rows: list[CombinationRow]
    budget: list[ErrorPart]
    stages: list[StageTime]


def run(
    file: BenchFile, directory: Path, quick: bool, advance: Callable[[int], object]
) -> ChainStudy:
    """Measure a bench file's scenes; write OUTPUTS into `directory`.

    `advance` hears how many scenes are done. Raises InputError, MachineError.
    """
    results: list[SceneResult] = []
    unmeasured = []
    others = OtherWork()
    with Parts(file) as parts, StudyTracker(parts.own) as tracker:
        scenes = five_scenes(parts.own)
        for number, scene in enumerate(scenes):
            measurement = SceneMeasurement(parts, tracker, scene, QUICK if quick else Rounds())
            if not measurement.star_count:
                unmeasured.append(
                    f"{scene.name}: not measured: no star stands alone and stays in view over the"
                    " exposure"
                )
                continue
            outcomes, stages = measurement.outcomes()
            budget = error_budget(measurement, measurement.marks.auto)
            results.append(SceneResult(rows_of(outcomes), budget, stages))
            advance(number + 1)
        machine = f"{parts.own.renderer.gl_renderer}, {os.cpu_count()} cores"
        shortened = shortened_line(parts.own)
        glass = glass_rows(file, scenes[DENSE], quick)
    if not results:
        raise InputError(
            f"{file.path}: no star stands alone in view in any scene; write a larger [sky]"
            " faintest_v_mag"
        )
    load = others.load()
    notes = [f"times on {machine}"]
    if shortened is not None:
        notes.append(shortened)
    if load.busy:
        notes.append(load.caution)
    make_directory(directory)
    answers = write_chain(directory, results, glass, notes, load)
    lines = []
    for result in results:
        lines.append(scene_line(result.rows, result.budget, result.stages, load))
    lines += unmeasured
    if glass:
        lines.append(glass_line(glass))
    return ChainStudy([*lines, *notes], verdict(results, load), answers)


def verdict(results: Sequence[SceneResult], load: Load) -> bool | None:
    """Whether `auto` is right in every scene; None on a busy machine."""
    if load.busy:
        return None
    return is_right([result.rows for result in results])


def write_chain(
    directory: Path,
    results: Sequence[SceneResult],
    glass: list[GlassRow],
    notes: Sequence[str],
    load: Load,
) -> list[str]:
    """Write the tables and charts of all scenes; what a person can do, a line each."""
    rows: list[CombinationRow] = []
    budget: list[ErrorPart] = []
    stages: list[StageTime] = []
    for result in results:
        rows += result.rows
        budget += result.budget
        stages += result.stages
    if load.busy:
        rows = [without_fronts(row) for row in rows]
    write_rows(directory / "chain.csv", rows)
    write_rows(directory / "chain_budget.csv", budget)
    write_rows(directory / "chain_time.csv", stages)
    if glass:
        write_rows(directory / "chain_psf.csv", glass)
    draw(directory / "chain", rows, headline(rows, load), "; ".join(notes), glass)
    draw_budget(directory / "chain_budget", rows, budget, stages, load)
    return answer_lines(rows, budget, load)
