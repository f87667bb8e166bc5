"""Two pictures: error against time in each scene that differs, with the front; and where error and time come from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hilstar.charts import BLUE, GREEN, INK, ORANGE, PURPLE, RED, capital, chart, name_at_side, two_digits, value_bars
from hilstar.study.chain.budget import RSS, WHOLE
from hilstar.study.chain.combinations import QUANTISATIONS
from hilstar.study.chain.table import AUTO, DEFAULT, BudgetRow, Row, StageRow, auto_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS: dict[str, str] = dict(zip(QUANTISATIONS, (PURPLE, ORANGE, GREEN, BLUE), strict=True))
PANEL_INCH, BARS_INCH, TITLE_INCH = 2.7, 1.5, 1.2
FLOOR_SHARE = 1e-3  # of the smallest error: what is 0 has a place on a logarithmic axis
LESS = 0.9  # of the error of the one that was named last: what is worth a name on the front
ALIKE = 1.5  # scenes of one rate are drawn once where auto's error differs by less than this factor
WORDS = {"refresh": "panel's refresh", "codes": "quantisation", "sprites": "cut sprites", WHOLE: "all of it"}
CHOSEN = {DEFAULT: INK, AUTO: RED}


def differing(rows: Sequence[Row]) -> dict[str, list[str]]:
    """The scenes to be drawn, each with those of its rate in which `auto` is as far off."""
    kept: dict[str, list[str]] = {}
    autos: dict[str, Row] = {}
    for scene in dict.fromkeys(row.scene for row in rows):
        mine = [row for row in rows if row.scene == scene]
        own = mine[auto_of(mine)]
        like = [s for s, o in autos.items() if o.rate_deg_s == own.rate_deg_s and _alike(o.error_arcsec, own.error_arcsec)]
        if like:
            kept[like[0]].append(scene)
        else:
            kept[scene], autos[scene] = [], own
    return kept


def _alike(a: float, b: float) -> bool:
    return max(a, b) <= ALIKE * min(a, b)


def draw(path: Path, rows: Sequence[Row], finding: str, machine: str) -> None:
    """Error against time, a panel for each scene that differs. Raises InputError where it cannot be written."""
    scenes = differing(rows)
    note = f"The line is the front: nothing else is as right and as fast. Pale: all other choices. {capital(machine)}."
    with chart(path, finding, len(scenes), note=note, share_x=False, height_inch=TITLE_INCH + PANEL_INCH * len(scenes)) as grid:
        for axes, (scene, alike) in zip(grid, scenes.items(), strict=True):
            own = [row for row in rows if row.scene == scene]
            axes.set_title(f"{scene}, {own[0].stars} stars" + (f" (the same in: {', '.join(alike)})" if alike else ""))
            axes.set(xscale="log", yscale="log", ylabel="star's place, rms [arcsec]")
            _scatter(axes, own)
        grid[-1].set_xlabel("median time of a frame [ms]")


def _scatter(axes: Axes, rows: Sequence[Row]) -> None:
    floor = FLOOR_SHARE * min((row.error_arcsec for row in rows if row.error_arcsec > 0), default=1.0)
    at = [(row.time_ms, max(row.error_arcsec, floor)) for row in rows]
    front = [(row, place) for row, place in zip(rows, at, strict=True) if row.on_front == "true"]
    axes.step(*zip(*(place for _, place in front), strict=True), where="post", color=INK, lw=1.2, zorder=2)
    for row, place in zip(rows, at, strict=True):
        colour, on_front = COLOURS[row.quantisation], row.on_front == "true"
        early, late = max(place[0] - row.noise_ms, place[0] / 2), place[0] + row.noise_ms
        axes.plot([early, late], [place[1]] * 2, color=colour, lw=1.0, alpha=0.4)
        axes.plot(*place, "o", color=colour, ms=6 if on_front else 4, alpha=1 if on_front else 0.35, zorder=3)
    axes.margins(0.06, 0.12)
    for row, place in zip(rows, at, strict=True):
        for name in row.chosen.split():
            axes.plot(*place, "o", color=CHOSEN[name], ms=13 if name == AUTO else 17, mfc="none", mew=1.6, zorder=4)
    named, last, own = [], math.inf, rows[auto_of(rows)]
    for row, place in front:
        if place[1] < LESS * last and not row.chosen:
            named.append((short_words(row, own), place, COLOURS[row.quantisation]))
            last = place[1]
    for row, place in zip(rows, at, strict=True):
        if row.chosen:
            figures = f"{two_digits(row.error_arcsec)} arcsec, {two_digits(row.time_ms)} ms"
            named.append(
                (f"{row.chosen.replace(' ', ', ')}: {figures}", place, CHOSEN[AUTO if AUTO in row.chosen else DEFAULT])
            )
    for name, colour in COLOURS.items():
        if not any(colour == other for *_, other in named):  # the best of what has no place on the front
            best = min(
                (each for each in zip(rows, at, strict=True) if each[0].quantisation == name),
                key=lambda each: each[1][1],
                default=None,
            )
            named += [(short_words(best[0], own), best[1], colour)] if best else []
    name_at_side(axes, named)


def short_words(row: Row, own: Row) -> str:
    """A row's combination where its sprites go without saying, and its depth where it is that of `own`."""
    shallow = ", fewer stars" if row.faintest_v_mag < own.faintest_v_mag else ""
    moving = f", {row.smear}s by {row.prediction}".replace("by held", "held") if row.rate_deg_s else ""
    return f"{row.quantisation}{' + bit stealing' if row.bit_stealing == 'true' else ''}{moving}{shallow}"


def draw_budget(path: Path, rows: Sequence[Row], budget: Sequence[BudgetRow], stages: Sequence[StageRow]) -> None:
    """Where `auto`'s error and time come from, a row of panels for each scene that differs. Raises InputError."""
    scenes = differing(rows)
    last = list(scenes)[-1]
    steps = [part.step for part in budget if part.scene == next(iter(scenes)) and part.step != RSS]
    shown = [step for step in steps if any(p.error_arcsec or p.error_mag for p in budget if p.step == step)]
    none = [WORDS.get(step, step) for step in steps if step not in shown]
    note = "Each step is charged with what it changes when it is added to an exact display" + (
        f"; {' and '.join(none)} change nothing here." if none else "."
    )
    height = TITLE_INCH + BARS_INCH * len(scenes)
    with chart(
        path, _budget_finding(scenes, budget, stages), len(scenes), 3, note=note, share_x=False, height_inch=height
    ) as grid:
        for k, scene in enumerate(scenes):
            parts = {part.step: part for part in budget if part.scene == scene}
            place, light, times = grid[3 * k : 3 * k + 3]
            place.set_title(scene)
            for axes, error, unit in ((place, "error_arcsec", "arcsec"), (light, "error_mag", "mag")):
                values = [getattr(parts[step], error) for step in shown]
                colours = [RED if step == WHOLE else BLUE for step in shown]
                value_bars(axes, [WORDS.get(step, step) for step in shown], values, colours)
                axes.set_xlabel(f"error, rms [{unit}]" if scene == last else "")
            light.set_yticklabels([])
            mine = [one for one in stages if one.scene == scene]
            value_bars(times, [one.stage for one in mine], [one.time_ms for one in mine], PURPLE)
            times.set_xlabel("time of a frame [ms]" if scene == last else "")


def _budget_finding(
    scenes: Sequence[str] | dict[str, list[str]], budget: Sequence[BudgetRow], stages: Sequence[StageRow]
) -> str:
    said = []
    for scene in scenes:
        parts = [part for part in budget if part.scene == scene and part.step not in (RSS, WHOLE)]
        largest = max(parts, key=lambda part: part.error_arcsec if math.isfinite(part.error_arcsec) else math.inf)
        said.append(
            f"{WORDS.get(largest.step, largest.step)} in the {scene}"
            if "field" in scene
            else f"{WORDS.get(largest.step, largest.step)} at {scene}"
        )
    longest = max(stages, key=lambda one: one.time_ms)
    return f"Of auto's error most is {', '.join(said)}; of its time most is {longest.stage}"
