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
from typing import TYPE_CHECKING

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
    said,
)
from hilstar.instruments.study.chain.tracker import StudyTracker
from hilstar.instruments.study.sweep import NOT_JUDGED, Load, OtherWork, beaten_by, pareto_front
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
OUTPUTS = (
    *(f"{name}{ending}" for name in ("chain", "chain_budget") for ending in (".png", ".svg")),
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
    by_arcsec, by_mag = (front(rows, name) for name in ("error_arcsec", "error_mag"))
    filed = [k for k, row in enumerate(rows) if left_to_effort(row, rows[auto_of(rows)])]
    as_filed = dict(zip(filed, front([rows[k] for k in filed], "error_arcsec"), strict=True))
    with_fronts: list[CombinationRow] = []
    for k, row in enumerate(rows):
        with_fronts.append(
            replace(
                row,
                on_front=said(by_arcsec[k]),
                on_front_mag=said(by_mag[k]),
                on_front_as_filed=said(as_filed.get(k, False)),
            )
        )
    return with_fronts


def without_fronts(row: CombinationRow) -> CombinationRow:
    """A row that was timed on a busy machine: on which fronts it is, no time says."""
    return replace(row, on_front="", on_front_mag="", on_front_as_filed="")


def front(rows: Sequence[CombinationRow], error: str) -> list[bool]:
    """Whether each row is on the front of its time and `error`, the name of one of its columns."""
    errors = [getattr(row, error) for row in rows]
    times_ms = [row.time_ms for row in rows]
    return list(map(bool, pareto_front(errors, times_ms)))


def auto_of(rows: Sequence[CombinationRow]) -> int:
    """The place of the row that `effort = "auto"` takes."""
    return next(k for k, row in enumerate(rows) if AUTO in row.chosen)


def left_to_effort(row: CombinationRow, own: CombinationRow) -> bool:
    """Whether a row shares with `own` the choices that belong to the bench file and the sender."""
    given = ("bit_stealing", "faintest_v_mag", "prediction")
    return all(getattr(row, name) == getattr(own, name) for name in given)


def beating(
    rows: Sequence[CombinationRow], as_filed: bool = False
) -> tuple[list[CombinationRow], list[CombinationRow]]:
    """The rows that beat `auto` by arcsec and time, beyond the noise and within it; only those that
    effort may choose.

    Beyond it are those faster by more than three sigmas of the difference of the medians. Else this
    run cannot tell the times apart, and which row is on the front is chance.
    """
    auto_row = rows[auto_of(rows)]
    rivals = [row for row in rows if not as_filed or left_to_effort(row, auto_row)]
    beats = beaten_by([row.error_arcsec for row in rivals], [row.time_ms for row in rivals])[
        rivals.index(auto_row)
    ]
    beyond: list[CombinationRow] = []
    within: list[CombinationRow] = []
    for row in (row for row, does in zip(rivals, beats, strict=True) if does):
        noise_ms = 3 * math.hypot(auto_row.noise_ms, row.noise_ms)
        (beyond if auto_row.time_ms - row.time_ms > noise_ms or not noise_ms else within).append(
            row
        )
    return beyond, within


def scene_line(
    rows: Sequence[CombinationRow],
    budget: Sequence[ErrorPart],
    stages: Sequence[StageTime],
    load: Load,
) -> str:
    """One scene: the choice of `auto`, its error and time, its place relative to the front, and
    the largest part of each.
    """
    auto_row = rows[auto_of(rows)]
    stands = NOT_JUDGED if load.busy else standing(rows)
    steps = [part for part in budget if part.step not in (RSS, WHOLE)]
    largest = max(steps, key=lambda part: part.error_arcsec)
    longest = max(stages, key=lambda one: one.time_ms)
    share = longest.time_ms / max(sum(one.time_ms for one in stages), 1e-9)
    stars = f"{auto_row.stars} stars"
    if auto_row.lost:
        stars += f", {auto_row.lost} of them lost"
    return (
        f"{auto_row.scene}: {AUTO} ({words(auto_row)}) is {auto_row.error_arcsec:.3g} arcsec and"
        f" {auto_row.error_mag:.2g} mag off over {stars}, in {auto_row.time_ms:.3g} ms; {stands};"
        f" error: {largest.step} {largest.error_arcsec:.2g} arcsec; time: {longest.stage}"
        f" {share:.0%}"
    )


def headline(rows: Sequence[CombinationRow], load: Load) -> str:
    """What the whole table says of `auto`; nothing on a busy machine."""
    scenes = []
    for name in dict.fromkeys(row.scene for row in rows):
        scenes.append([row for row in rows if row.scene == name])
    beaten = [auto_rows[0].scene for auto_rows in scenes if beating(auto_rows)[0]]
    where = f"in {len(scenes) - len(beaten)} of {len(scenes)} scenes"
    exceptions_text = f", not in {', '.join(beaten)}" if beaten else ""
    return load.title(
        'The choice of effort = "auto" is on the front of error against time, or within its noise,'
        f" {where}{exceptions_text}"
    )


def standing(rows: Sequence[CombinationRow]) -> str:
    """Whether `auto` is on the front or within its noise; else its better, the reason, and its
    place among effort's choices.
    """
    beyond, within = beating(rows)
    auto_row = rows[auto_of(rows)]
    if not beyond:
        if within:
            return f"on the front within the noise: {_compared(auto_row, _nearest(within))}"
        return "on the front"
    best = _nearest(beyond)
    standing_text = f"not on the front: {_compared(auto_row, best)}: {why_not(auto_row, best)}"
    if best in (own_beyond := beating(rows, as_filed=True)[0]):
        return standing_text
    if own_beyond:
        nearest = _nearest(own_beyond)
        return (
            f"{standing_text}; nor of what effort may choose: {_compared(auto_row, nearest)}:"
            f" {why_not(auto_row, nearest)}"
        )
    return (
        f"{standing_text}; on the front of what effort may"
        f" choose{', within the noise' if beating(rows, as_filed=True)[1] else ''}"
    )


def words(row: CombinationRow) -> str:
    """A row's combination in a few words."""
    if row.bit_stealing == "true":
        stealing = " with bit stealing"
    else:
        stealing = ""
    if row.rate_deg_s:
        moving = f", {row.smear}s, {row.prediction}"
    else:
        moving = ""
    return f"{row.quantisation}{stealing}, {row.sprite} sprites{moving}"


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
        compared = (
            f"effort compares {own.quantisation} and {other.quantisation} by their worst star at"
            " any sub-pixel phase"
        )
        reasons.append(f"{compared}, not by a field's rms")
    if other.sprite != own.sprite:
        coarse = other.sprite == "coarse"
        reasons.append(
            "coarse sprites are beyond the tolerance" if coarse else "cut sprites save nothing here"
        )
    if other.smear != own.smear:
        reasons.append(f"{other.smear}s instead of {own.smear}s")
    return "; ".join(reasons)


def _nearest(rows: Sequence[CombinationRow]) -> CombinationRow:
    return min(rows, key=lambda row: (row.error_arcsec, row.time_ms))


def _compared(own: CombinationRow, other: CombinationRow) -> str:
    faster = own.time_ms - other.time_ms
    noise = math.hypot(own.noise_ms, other.noise_ms)
    return (
        f"{words(other)} is {other.error_arcsec:.3g} arcsec off and {faster:.2g} ms faster (noise"
        f" {noise:.2g} ms)"
    )


def differing(rows: Sequence[CombinationRow]) -> dict[str, list[str]]:
    """The scenes to be drawn, each with those of its rate in which `auto` is as far off."""
    rivals: dict[str, list[str]] = {}
    autos: dict[str, CombinationRow] = {}
    for auto_row in (row for row in rows if AUTO in row.chosen):
        for scene, other in autos.items():
            low, high = sorted((auto_row.error_arcsec, other.error_arcsec))
            if other.rate_deg_s == auto_row.rate_deg_s and high <= ALIKE * low:
                rivals[scene].append(auto_row.scene)
                break
        else:
            rivals[auto_row.scene], autos[auto_row.scene] = [], auto_row
    return rivals


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
    count = len(scenes) + (2 if glass else 0)
    with charts.chart(
        path, finding, count, note=note, share_x=False, height_inch=TITLE_INCH + PANEL_INCH * count
    ) as grid:
        for axes, (scene, alike) in zip(grid, scenes.items(), strict=False):
            scene_rows = [row for row in rows if row.scene == scene]
            axes.set_title(
                f"{scene}, {scene_rows[0].stars} stars"
                + (f" (the same in: {', '.join(alike)})" if alike else "")
            )
            axes.set(xscale="log", yscale="log", ylabel="star's place, rms [arcsec]")
            _scatter(axes, scene_rows)
        grid[len(scenes) - 1].set_xlabel("median time of a frame [ms]")
        if glass:
            draw_glass(grid[-2], grid[-1], glass)


def _scatter(axes: "Axes", rows: Sequence[CombinationRow]) -> None:
    floor = FLOOR_SHARE * min(
        (row.error_arcsec for row in rows if row.error_arcsec > 0), default=1.0
    )
    at = [(row.time_ms, max(row.error_arcsec, floor)) for row in rows]
    front = [(row, place) for row, place in zip(rows, at, strict=True) if row.on_front == "true"]
    if front:
        times_ms, errors = zip(*(place for _, place in front), strict=True)
        axes.step(times_ms, errors, where="post", color=charts.INK, lw=1.2, zorder=2)
    for row, place in zip(rows, at, strict=True):
        colour = COLOURS[row.quantisation]
        on_front = row.on_front == "true"
        early = max(place[0] - row.noise_ms, place[0] / 2)
        late = place[0] + row.noise_ms
        axes.plot([early, late], [place[1]] * 2, color=colour, lw=1.0, alpha=0.4)
        axes.plot(
            *place,
            "o",
            color=colour,
            ms=6 if on_front else 4,
            alpha=1 if on_front else 0.35,
            zorder=3,
        )
    axes.margins(0.06, 0.12)
    for row, place in zip(rows, at, strict=True):
        for name in row.chosen.split():
            axes.plot(
                *place,
                "o",
                color=CHOSEN[name],
                ms=13 if name == AUTO else 17,
                mfc="none",
                mew=1.6,
                zorder=4,
            )
    charts.name_at_side(axes, side_names(rows, at))


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
            arcsec = charts.two_digits(row.error_arcsec)
            ms = charts.two_digits(row.time_ms)
            label = f"{row.chosen.replace(' ', ', ')}: {arcsec} arcsec, {ms} ms"
            named.append((label, place, CHOSEN[AUTO if AUTO in row.chosen else DEFAULT]))
    for quantisation, colour in COLOURS.items():
        points = [
            point for point in zip(rows, at, strict=True) if point[0].quantisation == quantisation
        ]
        # The best of codes that have no place on the front.
        if points and all(colour != other for *_, other in named):
            row, place = min(points, key=lambda point: point[1][1])
            named.append((short_words(row, auto), place, colour))
    return named


def short_words(row: CombinationRow, own: CombinationRow) -> str:
    """A row's combination for a chart: without its sprites, and with its depth only where that
    differs from `own`.
    """
    if row.faintest_v_mag < own.faintest_v_mag:
        shallow = ", fewer stars"
    else:
        shallow = ""
    if row.rate_deg_s:
        moving = f", {row.smear}s by {row.prediction}".replace("by held", "held")
    else:
        moving = ""
    if row.bit_stealing == "true":
        stealing = " + bit stealing"
    else:
        stealing = ""
    return f"{row.quantisation}{stealing}{moving}{shallow}"


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
    scenes = differing(rows)
    last = list(scenes)[-1]
    steps = [part.step for part in budget if part.scene == next(iter(scenes)) and part.step != RSS]
    steps_with_error = {part.step for part in budget if part.error_arcsec or part.error_mag}
    shown = [step for step in steps if step in steps_with_error]
    none = [WORDS.get(step, step) for step in steps if step not in steps_with_error]
    note = "Each step is charged with what it changes when it is added to an exact display"
    if none:
        note += f"; {' and '.join(none)} change nothing here"
    note += "."
    most = []
    for scene in scenes:
        parts = [part for part in budget if part.scene == scene and part.step not in (RSS, WHOLE)]
        largest = max(
            parts,
            key=lambda part: part.error_arcsec if math.isfinite(part.error_arcsec) else math.inf,
        )
        most.append(
            f"{WORDS.get(largest.step, largest.step)} {'in the' if 'field' in scene else 'at'}"
            f" {scene}"
        )
    longest = max(stages, key=lambda one: one.time_ms)
    errors = f"Of auto's error most is {', '.join(most)}"
    finding = load.title(f"{errors}; of its time most is {longest.stage}", errors)
    height = TITLE_INCH + BARS_INCH * len(scenes)
    with charts.chart(
        path, finding, len(scenes), 3, note=load.note(note), share_x=False, height_inch=height
    ) as grid:
        for k, scene in enumerate(scenes):
            by_step = {part.step: part for part in budget if part.scene == scene}
            place, light, times = grid[3 * k : 3 * k + 3]
            place.set_title(scene)
            for axes, error, unit in (
                (place, "error_arcsec", "arcsec"),
                (light, "error_mag", "mag"),
            ):
                values = [getattr(by_step[step], error) for step in shown]
                colours = [charts.RED if step == WHOLE else charts.BLUE for step in shown]
                charts.value_bars(axes, [WORDS.get(step, step) for step in shown], values, colours)
                axes.set_xlabel(f"error, rms [{unit}]" if scene == last else "")
            light.set_yticklabels([])
            scene_stages = [stage for stage in stages if stage.scene == scene]
            stage_names = [stage.stage for stage in scene_stages]
            stage_times_ms = [stage.time_ms for stage in scene_stages]
            charts.value_bars(times, stage_names, stage_times_ms, charts.PURPLE)
            times.set_xlabel("time of a frame [ms]" if scene == last else "")


def run(
    file: BenchFile, directory: Path, quick: bool, advance: Callable[[int], object]
) -> ChainStudy:
    """Measure a bench file's scenes; write OUTPUTS into `directory`.

    `advance` hears how many scenes are done. Raises InputError, MachineError.
    """
    rows: list[CombinationRow] = []
    budget: list[ErrorPart] = []
    stages: list[StageTime] = []
    lines = []
    judged = []
    others = OtherWork()
    with Parts(file) as parts, StudyTracker(parts.own) as tracker:
        scenes = five_scenes(parts.own)
        for number, scene in enumerate(scenes):
            measurement = SceneMeasurement(parts, tracker, scene, QUICK if quick else Rounds())
            if not measurement.star_count:
                lines.append(
                    f"{scene.name}: not measured: no star stands alone and stays in view over the"
                    " exposure"
                )
                continue
            outcomes, parts_of_time = measurement.outcomes()
            chain_rows = rows_of(outcomes)
            parts_of_error = error_budget(measurement, measurement.marks.auto)
            judged.append((chain_rows, parts_of_error, parts_of_time))
            rows = rows + chain_rows
            budget = budget + parts_of_error
            stages = stages + parts_of_time
            advance(number + 1)
        machine = f"{parts.own.renderer.gl_renderer}, {os.cpu_count()} cores"
        shortened = shortened_line(parts.own)
        glass = glass_rows(file, scenes[DENSE], quick)
    if not rows:
        raise InputError(
            f"{file.path}: no star stands alone in view in any scene; write a larger [sky]"
            " faintest_v_mag"
        )
    load = others.load()
    if load.busy:
        rows = [without_fronts(row) for row in rows]
    lines = [*(scene_line(*scene, load) for scene in judged), *lines]
    if glass:
        lines.append(glass_line(glass))
    make_directory(directory)
    for name, records in (
        ("chain", rows),
        ("chain_budget", budget),
        ("chain_time", stages),
        ("chain_psf", glass),
    ):
        if records:
            charts.write_records(directory / f"{name}.csv", records)
    notes = [f"times on {machine}"]
    if shortened is not None:
        notes.append(shortened)
    if load.busy:
        notes.append(load.caution)
    draw(directory / "chain", rows, headline(rows, load), "; ".join(notes), glass)
    draw_budget(directory / "chain_budget", rows, budget, stages, load)
    right = not any(beating(chain_rows, as_filed=True)[0] for chain_rows, _, _ in judged)
    return ChainStudy(
        [*lines, *notes], None if load.busy else right, answer_lines(rows, budget, load)
    )
