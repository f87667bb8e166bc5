"""The page of an assessment, budget.html: whether the tracker was right, its errors in a card
each, and what to do.
"""

from collections.abc import Iterator, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, INK, MUTED, RED, capital, label_ends, panels_of
from hilstar.basics.files import write_whole
from hilstar.basics.pages import (
    BAD,
    DASH,
    OK,
    WARN,
    Card,
    KeyFigure,
    Markup,
    Verdict,
    details_of,
    drawing_of,
    figures_of,
    key_table,
    list_of,
    measured,
    page_of,
    paragraph,
    side_by_side,
    table_of,
    within,
)
from hilstar.basics.rotation import to_matrix
from hilstar.instruments.assess.assessment import Assessment
from hilstar.instruments.assess.bench_effects import Slice
from hilstar.instruments.assess.bounded_figures import TooFewCases
from hilstar.instruments.assess.budget import Axes
from hilstar.instruments.assess.figure_rows import PARTS, figures_table, limit_text
from hilstar.instruments.assess.places import spread_rows
from hilstar.instruments.assess.report import (
    bench_text,
    display_text,
    further_lines,
    lines_of,
    rows_of,
)
from hilstar.instruments.assess.star_drawing import star_drawing

AVAILABLE = 0.99  # a smaller availability is a warning
MAX_PERCENT = 99.9  # of fewer than all answers: in three digits more are 100
MAX_POINTS = 4000
MAX_ROWS = 200
WRONG_HEIGHT = 0.96  # of the marks of wrong answers, in the panel
BIAS = "bias"
AXES = ("x", "y", "about the boresight")
DIRECTIONS = ("across the boresight", "about the boresight")
ARCSEC = "arcsec"
WRONG_CURE = "Look at these moments in the run's report, and at these rows of the telemetry."
LOST_CURE = "Compare the times of the outages with the run's rates, faults and missed frames."
MISSED_CURE = "See why frames were missed under Pacing in the run's report."
STILL_CURE = "To measure the clock, assess a run that turns at changing rates."
YES = {True: "yes", False: ""}
WRONG_COLUMNS = ("row", "telemetry's time, s", "run time, s", "off by, deg")
OUTAGE_COLUMNS = ("run time, s", "length, s", "lock lost", "rows", "wrong")
LARGEST_CURES = {
    BIAS: Markup(
        "The bias is the largest: <code>hilstar calibrate alignment</code> takes a mounting's turn"
        " out."
    ),
    PARTS["fov"]: (
        "What repeats with the place in the field is the largest: calibrate the tracker's lens."
    ),
    PARTS["pixel"]: (
        "What repeats with the place in the pixel is the largest: look at the centroids, or widen"
        " the point spread function."
    ),
    PARTS["noise"]: "Noise is the largest: it falls with more light, stars or exposure.",
}
SLICE_COLUMNS = (
    "answers",
    "noise across, arcsec",
    "noise about the boresight, arcsec",
    "rms across, arcsec",
    "rms about the boresight, arcsec",
)


def write_page(path: Path, found: Assessment) -> None:
    """Write the page of an assessment as one file that needs no other. Raises InputError."""
    cards = [_budget(found), _answers(found), *_events(found), *_pictured(found)]
    parts = [figures_of(_counts(found)), *(card.html() for card in cards)]
    parts.append(side_by_side([_bias(found), _pixel(found)]))
    beside = [_clock(found), _beside(found)]
    if found.cube is not None:
        beside.append(Card("Cube to tracker's boresight", words=[paragraph(found.cube.line)]))
    parts.append(side_by_side(beside))
    parts += [card.html() for card in (*_further(found), *_slices(found))]
    parts.append(_all_figures(found))
    if found.notes:
        parts.append(Card("Notes", words=[list_of(found.notes)]).html())
    title = f"Error budget: {found.telemetry.path.name} against {found.run.path.name}"
    write_whole(path, page_of(title, verdict_of(found), parts))


def verdict_of(found: Assessment) -> Verdict:
    """Whether the tracker was right throughout: BAD with wrong answers or lost locks, WARN with
    missed frames or an availability under AVAILABLE.
    """
    wrong = len(found.wrong)
    lost = len(found.lock.lost)
    missed = found.run.run.missed
    wrong_text = _counted(wrong, "wrong answer")
    lost_text = _counted(lost, "lost lock")
    missed_text = _counted(missed, "missed frame")
    counts = f"{wrong_text}, {lost_text}, {missed_text}."
    headline = f"The tracker was right in {_percent(found)} of the answers due"
    if wrong or lost:
        return Verdict(BAD, headline, counts)
    if missed or found.lock.availability < AVAILABLE:
        return Verdict(WARN, headline, counts)
    return Verdict(OK, headline, counts)


def _counted(count: int, noun: str) -> str:
    return f"{count or 'no'} {_number_of(count, noun)}"


def _number_of(count: int, noun: str) -> str:
    """The noun in the singular or the plural of a count."""
    if count == 1:
        return noun
    return f"{noun}s"


def _percent(found: Assessment) -> str:
    """The availability; only all of the answers due are 100 %."""
    lock = found.lock
    if lock.right >= lock.due:
        return "100 %"
    percent = min(100 * lock.availability, MAX_PERCENT)
    return f"{percent:.3g} %"


def _counts(found: Assessment) -> Iterator[KeyFigure]:
    """Availability, wrong answers, lost locks, missed frames."""
    lock = found.lock
    state = OK
    if lock.availability < AVAILABLE:
        state = WARN
    cycle = f"availability: {lock.right} of {lock.due} answers due"
    yield KeyFigure(_percent(found), f"{cycle}, one each {1e3 * lock.cycle_s:.4g} ms", state)
    yield _count(len(found.wrong), _number_of(len(found.wrong), "wrong answer"), BAD)
    yield _count(len(lock.lost), _number_of(len(lock.lost), "lost lock"), BAD)
    run = found.run.run
    of = _number_of(run.missed, "missed frame")
    if run.missed:
        share = f"{100 * run.missed_share:.2g} % of the refresh periods"
        of = f"{of}, {share}; {run.held} frames were held for them"
    yield _count(run.missed, of, WARN)


def _count(count: int, of: str, state: str) -> KeyFigure:
    if count:
        return KeyFigure(str(count), of, state)
    return KeyFigure("0", of, OK)


def _answers(found: Assessment) -> Card:
    """The answers over the run, with each wrong one and each outage."""
    lines = dict(lines_of(found))
    rows = [
        ("answers", lines["answers"]),
        ("acquisition", lines["acquisition"]),
        ("missed frames", lines["missed frames"]),
        ("wrong", lines["wrong"]),
    ]
    causes = (
        (found.wrong, WRONG_CURE),
        (found.lock.lost, LOST_CURE),
        (found.run.run.missed, MISSED_CURE),
    )
    cures = [cure for count, cure in causes if count]
    return Card(
        "Answers over the run",
        words=[key_table(rows)],
        picture=_over_time(found),
        cure=" ".join(cures),
    )


def _events(found: Assessment) -> Iterator[Card]:
    """The wrong answers and the outages, folded on the screen."""
    parts = []
    if found.wrong:
        wrong = [astuple(answer) for answer in found.wrong[:MAX_ROWS]]
        table = table_of(wrong, WRONG_COLUMNS)
        parts.append(details_of(_counted(len(found.wrong), "wrong answer"), table, printed=True))
    outages = found.lock.outages
    if outages:
        rows = []
        for outage in outages[:MAX_ROWS]:
            rows.append(
                (outage.start_s, outage.length_s, YES[outage.lost], outage.rows, outage.wrong)
            )
        table = table_of(rows, OUTAGE_COLUMNS)
        parts.append(details_of(_counted(len(outages), "outage"), table, printed=True))
    if parts:
        yield Card("Wrong answers and outages", words=parts)


class BudgetPart(NamedTuple):
    """A part of the budget with its 95 % interval (2, 2): across the boresight, and about it."""

    name: str
    axes: Axes
    interval: FloatArray

    @property
    def half_width(self) -> float:
        """Half of the interval across the boresight."""
        low, high = self.interval[:, 0].tolist()
        return float(high - low) / 2


def _parts(found: Assessment) -> list[BudgetPart]:
    """Bias, field-of-view error, pixel error and noise."""
    parts = found.found
    intervals = parts.intervals
    low, high = intervals.bias
    cross = parts.bias_arcsec[:2]
    half = (high - low) / 2
    across = float(np.hypot(*cross))
    weighted = float(np.hypot(*(cross * half[:2])))
    off = weighted / max(across, 1e-12)  # to first order
    about = abs(float(parts.bias_arcsec[2]))
    off_about = half[2]
    bias = np.array([[across - off, about - off_about], [across + off, about + off_about]])
    return [
        BudgetPart(BIAS, Axes(across, about), bias),
        BudgetPart(PARTS["fov"], parts.fov_arcsec, intervals.fov),
        BudgetPart(PARTS["pixel"], parts.pixel_arcsec, intervals.pixel),
        BudgetPart(PARTS["noise"], found.noise_arcsec, intervals.noise),
    ]


def _budget(found: Assessment) -> Card:
    """What the error is made of, the error about the bias first."""
    parts = [part for part in _parts(found) if part.axes.cross is not None]
    rows = []
    for part in parts:
        rows.append((part.name, _interval(part, 0), _interval(part, 1)))
    cross = np.array([part.axes.cross for part in parts], dtype=float)
    half = np.array([part.half_width for part in parts])
    about_bias = [k for k, part in enumerate(parts) if part.name != BIAS]
    size = float(np.hypot.reduce(cross[about_bias], initial=0.0))
    weighted = (cross * half)[about_bias]
    off = float(np.hypot.reduce(weighted, initial=0.0)) / max(size, 1e-12)
    largest = parts[int(np.argmax(cross))]
    figure = KeyFigure(
        measured(size, off, ARCSEC),
        "error about the bias, one sigma across the boresight; \N{PLUS-MINUS SIGN} at 95 %",
    )
    note = (
        "One sigma an axis; the bias is a constant turn. In brackets: 95 % intervals by the block"
        " bootstrap."
    )
    header = ("part", "across", "about the boresight")
    return Card(
        "What the error is made of",
        figure,
        [table_of(rows, header), paragraph(note, "small")],
        _bars(parts),
        cure=LARGEST_CURES[largest.name],
    )


def _interval(part: BudgetPart, axis: int) -> str | None:
    """A part across the boresight (0) or about it (1), with its 95 % interval."""
    value = (part.axes.cross, part.axes.roll)[axis]
    if value is None:
        return None
    low, high = part.interval[:, axis].tolist()
    return within(value, low, high, ARCSEC)


def _bars(parts: Sequence[BudgetPart]) -> str:
    """The parts beside each other, with their 95 % intervals."""
    names = [part.name for part in parts]
    cross = [float(part.axes.cross or 0.0) for part in parts]
    largest = int(np.argmax(cross))
    size = f"{cross[largest]:.2g} arcsec"
    finding = f"Across the boresight the {names[largest]} is the largest: {size}"
    note = "Bars: one sigma an axis; of the bias its size. Lines: 95 % intervals."
    with panels_of(finding, 1, 2, share_x=False, note=note, height_inch=3.2) as panels:
        heights = range(len(parts))
        labels = names
        sizes = (cross, [float(part.axes.roll or 0.0) for part in parts])
        for k, (axes, name) in enumerate(zip(panels, DIRECTIONS, strict=True)):
            low = [max(float(part.interval[0, k]), 0.0) for part in parts]
            high = [float(part.interval[1, k]) for part in parts]
            axes.barh(heights, sizes[k], color=BLUE, alpha=0.75)
            axes.hlines(heights, low, high, color=INK, lw=1.6)
            axes.set_yticks(heights, labels)
            labels = [""] * len(names)
            axes.invert_yaxis()
            axes.set_xlim(left=0.0)
            axes.grid(visible=False, axis="y")
            axes.set_xlabel(f"{name} [arcsec]")
    return drawing_of(panels[0].figure, "parts of the error, across and about the boresight")


def _bias(found: Assessment) -> Card:
    """The constant turn."""
    low, high = found.found.intervals.bias
    rows = []
    for k, axis in enumerate(AXES):
        value = float(found.found.bias_arcsec[k])
        text = within(value, float(low[k]), float(high[k]), ARCSEC)
        rows.append((axis, text))
    bias = _parts(found)[0]
    assert bias.axes.cross is not None
    figure = KeyFigure(
        measured(bias.axes.cross, bias.half_width, ARCSEC),
        "constant turn across the boresight; \N{PLUS-MINUS SIGN} at 95 %",
    )
    note = paragraph("95 % intervals in brackets.", "small")
    return Card("Bias", figure, [key_table(rows), note])


def _pixel(found: Assessment) -> Card:
    """What repeats with the place in the pixel."""
    parts = found.found
    pixel = parts.components.pixel
    texts = _about(parts.pixel_arcsec, parts.intervals.pixel)
    texts.append(paragraph(f"{capital(pixel.detail or pixel.reason)}.", "small"))
    return Card("Pixel error", _across(parts.pixel_arcsec, parts.intervals.pixel), texts)


def _pictured(found: Assessment) -> Iterator[Card]:
    """Field-of-view error and noise, one sigma an axis."""
    parts = found.found
    intervals = parts.intervals
    picture, reason = _field_map(found)
    texts = _about(parts.fov_arcsec, intervals.fov)
    if reason:
        texts.append(paragraph(f"{capital(reason)}.", "small"))
    figure = _across(parts.fov_arcsec, intervals.fov)
    yield Card("Field-of-view error", figure, texts, picture)
    texts = _about(found.noise_arcsec, intervals.noise)
    texts.append(paragraph(f"Limit of the tracker's stars: {limit_text(found.limit_arcsec)}."))
    figure = _across(found.noise_arcsec, intervals.noise)
    yield Card("Noise", figure, texts, _histogram(found))


def _across(axes: Axes, interval: FloatArray) -> KeyFigure:
    """A part of the budget across the boresight, with its 95 % interval (2, 2)."""
    if axes.cross is None:
        return KeyFigure(DASH, "cannot be told")
    low, high = interval[:, 0].tolist()
    half = (high - low) / 2
    return KeyFigure(
        measured(axes.cross, half, ARCSEC),
        "one sigma across the boresight; \N{PLUS-MINUS SIGN} at 95 %",
    )


def _about(axes: Axes, interval: FloatArray) -> list[str]:
    """A part of the budget about the boresight, with its 95 % interval (2, 2)."""
    if axes.roll is None:
        return []
    low, high = interval[:, 1].tolist()
    return [paragraph(f"About the boresight: {within(axes.roll, low, high, ARCSEC)}.")]


def _clock(found: Assessment) -> Card:
    """The tracker's clock against the run's."""
    clock = found.found.clock
    if not clock.offset_told:
        return Card("Clock", KeyFigure(DASH, "the run does not turn enough"), cure=STILL_CURE)
    offset = measured(1e3 * found.offset_s, 1e3 * clock.sigma_offset_s, "ms")
    drift = "Its rate cannot be told: the run does not turn enough."
    if clock.drift_told:
        rate = measured(1e6 * clock.drift, 1e6 * clock.sigma_drift, "ppm")
        drift = f"Its rate less that of the run: {rate}."
    figure = KeyFigure(offset, "tracker's clock minus the run's, at the run's start")
    return Card("Clock", figure, [paragraph(drift)])


def _further(found: Assessment) -> Iterator[Card]:
    """Reported rates, stamps and single stars, with detection and the map of places."""
    rows = list(further_lines(found))
    if not rows:
        return
    note = paragraph(
        "In brackets: 95 % intervals over stretches of the run. Stars count that stand clear of"
        " brighter ones and of the edges.",
        "small",
    )
    drawing = ""
    if found.further.stars is not None:
        try:
            drawing = star_drawing(found.further.stars, found.run.scale.resolution_px)
        except TooFewCases:
            drawing = ""
    yield Card("Rates, stamps and single stars", words=[key_table(rows), note], picture=drawing)


def _beside(found: Assessment) -> Card:
    """What of the errors is not the tracker's: the display's, the bench's, the glass's."""
    rows = [("display", display_text(found.display))]
    if found.certificate is not None:
        rows.append(("bench", bench_text(found)))
    if found.glass is not None:
        rows.append(("glass", found.glass.line()))
    return Card("What is not the tracker's", words=[key_table(rows)])


def _slices(found: Assessment) -> Iterator[Card]:
    """The errors by rate and by magnitude."""
    for title, name, slices in (
        ("By rate", "rate, deg/s", found.by_rate),
        ("By the field's magnitude", "mean magnitude of the field, V mag", found.by_magnitude),
    ):
        if slices:
            yield Card(title, words=_slice_table(name, slices))


def _slice_table(name: str, slices: Sequence[Slice]) -> list[str]:
    rows = []
    for part in slices:
        errors = astuple(part)[2:]
        rows.append((f"{part.low:.3g} to {part.high:.3g}", *errors))
    return [
        table_of(rows, (name, *SLICE_COLUMNS), 3),
        paragraph("The rms is about the bias.", "small"),
    ]


def _all_figures(found: Assessment) -> str:
    """The rows of budget.csv, folded on the screen."""
    rows = list(rows_of(found))
    details = details_of(f"{len(rows)} figures", figures_table(rows), printed=True)
    return Card("All figures", words=[details]).html()


def _over_time(found: Assessment) -> str:
    """The errors along the run, with what repeats, lost locks and wrong answers."""
    parts = found.found.components
    valid = np.flatnonzero(found.telemetry.valid)
    t_s = found.t_s[valid[found.found.row]]
    some = spread_rows(len(t_s), MAX_POINTS)
    some_s = t_s[some]
    wrong_s = np.array([answer.run_s for answer in found.wrong])
    error = parts.fov.fitted + parts.pixel.fitted + parts.left
    some_error = error[some]
    some_fitted = parts.fov.fitted[some]
    x, y, z = np.sqrt(np.mean(error**2, axis=0))
    across = f"{x:.2g} arcsec rms in x, {y:.2g} in y"
    finding = f"The error about the bias is {across}, {z:.2g} about the boresight"
    note = (
        "Grey: the error. Blue: what of it repeats with the place in the field. Bands: lock lost."
        " Red marks: wrong answers."
    )
    with panels_of(finding, 3, note=note, height_inch=7.0) as panels:
        for axes, name, k in zip(panels, AXES, range(3), strict=True):
            axes.plot(some_s, some_error[:, k], ".", ms=3.5, color=MUTED, rasterized=True)
            axes.plot(
                some_s,
                some_fitted[:, k],
                ".",
                ms=2.5,
                color=BLUE,
                rasterized=True,
                label="repeats",
            )
            for outage in found.lock.lost:
                end_s = outage.start_s + outage.length_s
                axes.axvspan(outage.start_s, end_s, color=MUTED, alpha=0.15, lw=0)
            if found.wrong:
                height = np.full(len(wrong_s), WRONG_HEIGHT)
                place = axes.get_xaxis_transform()
                axes.scatter(wrong_s, height, 25, RED, marker="v", transform=place)
            axes.set_ylabel(f"{name} [arcsec]")
            label_ends(axes)
        panels[-1].set_xlabel("run time [s]")
    return drawing_of(panels[0].figure, "errors over the run")


def _field_map(found: Assessment) -> tuple[str, str]:
    """The map of the field-of-view error, and why there is none."""
    parts = found.found.components
    scale = found.run.scale
    axes = to_matrix(found.found.commanded_q)
    some = spread_rows(len(axes), MAX_POINTS)
    mean = axes[:, 2].mean(axis=0)
    size = float(np.linalg.norm(mean))
    in_field = axes[some] @ (mean / max(size, 1e-9))
    if parts.fov.reason or in_field[:, 2].min() < 0.3:
        reason = (
            parts.fov.reason
            or "the run goes over too much of the sky for one map: see the chart over time"
        )
        return "", f"no map: {reason}"
    place = scale.focal_px * in_field[:, :2] / in_field[:, 2:]
    largest = np.abs(parts.fov.fitted).max(axis=0)
    x, y, z = largest
    finding = f"It is up to {x:.2g} arcsec in x, {y:.2g} in y and {z:.2g} about the boresight"
    with panels_of(finding, 1, 3, share_x=False, height_inch=3.9) as panels:
        for k, (panel, name) in enumerate(zip(panels, AXES, strict=True)):
            value = parts.fov.fitted[some, k]
            limit = max(float(largest[k]), 1e-6)
            look: dict[str, Any] = {
                "cmap": "RdBu_r",
                "vmin": -limit,
                "vmax": limit,
                "rasterized": True,
            }
            drawn = panel.scatter(place[:, 0], place[:, 1], c=value, s=6, edgecolors="none", **look)
            panel.figure.colorbar(
                drawn, ax=panel, orientation="horizontal", label=f"{name} [arcsec]"
            )
            panel.set_aspect("equal", adjustable="datalim")
            panel.set_xlabel("star field x [px]")
            panel.invert_yaxis()
        panels[0].set_ylabel("star field y [px]")
    return drawing_of(panels[0].figure, "field-of-view error over the field"), ""


def _histogram(found: Assessment) -> str:
    """What is left as noise, beside the normal distribution."""
    residual = found.found.components.left
    variance = found.found.components.noise_variance
    sigmas = np.sqrt(variance)
    x, y, z = sigmas
    across = f"{x:.2g} arcsec in x, {y:.2g} in y"
    finding = f"Noise is {across} and {z:.2g} about the boresight, one sigma"
    note = (
        "Bars: what is left when all that repeats is taken away. Line: the normal distribution of"
        " that sigma."
    )
    with panels_of(finding, 1, 3, share_x=False, note=note, height_inch=3.6) as panels:
        for k, (axes, name) in enumerate(zip(panels, AXES, strict=True)):
            sigma = max(float(sigmas[k]), 1e-9)
            edges = np.linspace(-5, 5, 61) * sigma
            axes.hist(residual[:, k], edges.tolist(), density=True, color=BLUE, alpha=0.5)
            area = sigma * np.sqrt(2 * np.pi)
            normal = np.exp(-0.5 * (edges / sigma) ** 2) / area
            axes.plot(edges, normal, color=INK, lw=1.2)
            axes.set_yscale("log")
            axes.set_ylim(1e-6 / sigma, 1 / sigma)
            axes.set_xlabel(f"{name} [arcsec]")
        panels[0].set_ylabel("share [1/arcsec]")
    return drawing_of(panels[0].figure, "noise, and the normal distribution")
