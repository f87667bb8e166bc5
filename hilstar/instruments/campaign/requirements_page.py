"""The verdicts of a plan's requirements for their readers: requirements.csv, a chart, and one
page that a person can sign.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    RED,
    panels_of,
    png,
    write_csv,
)
from hilstar.basics.files import write_whole
from hilstar.basics.pages import (
    BAD,
    OK,
    WARN,
    Card,
    Markup,
    Verdict,
    drawing_of,
    key_table,
    page_of,
    paragraph,
    table_of,
    value_text,
)
from hilstar.basics.version import __version__
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.case_table import VARY, Columns, read_cases
from hilstar.instruments.campaign.plan import CONDITION, QUANTITY_UNITS, Plan
from hilstar.instruments.campaign.requirements import (
    MET,
    NOT_MET,
    NOT_SHOWN,
    RequirementVerdict,
    bench_error,
    verdicts_of,
)
from hilstar.instruments.campaign.star_motion import with_motion
from hilstar.instruments.campaign.store import file_sha256
from hilstar.server.bench.alignment import cube_to_boresight
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.certificate_file import bench_certificate, off_by

COLUMNS = ("quantity", "axis", "condition", "limit", "bound", "confidence", "cases", "verdict")
COLOURS = {MET: GREEN, NOT_MET: RED, NOT_SHOWN: ORANGE}
STATES = {MET: OK, NOT_MET: BAD, NOT_SHOWN: WARN}
HEADLINES = {
    MET: "All requirements are met",
    NOT_MET: "A requirement is not met",
    NOT_SHOWN: "A requirement is not shown",
}
CURES = {
    MET: "",
    NOT_MET: "Find what costs the most in sensitivity.csv, and change the tracker or the limit.",
    NOT_SHOWN: "Run more cases: the table says how many would decide.",
}
HEADER = (
    "requirement",
    "verdict",
    "measured",
    "bound",
    "confidence",
    "cases",
    "to show it",
    "method",
)
METHOD = (
    "The bound is what the cases support at the stated confidence, one-sided. Met: the bound keeps"
    " the limit. Not met: the bound on the limit's other side breaks it. Not shown: the cases"
    " decide neither. Quantities are those of ECSS-E-ST-60-20C; errors are one sigma an axis,"
    " arcsec, camera axes; times in seconds."
)
# one sigma across, which the chart's bins are too
DRAWN = ("noise", "nea", "fov-error", "pixel-error")
MAX_POINTS, MAX_BINS, MIN_IN_BIN = 4000, 10, 12
# the median of sqrt((x^2 + y^2) / 2), of Gaussian x and y of sigma 1
MEDIAN_OF_SIGMA = float(np.sqrt(np.log(2)))
SIGN = ("Name", "Role", "Date", "Signature")
SIGN_STYLE = "display:inline-block;width:45%;border-bottom:1px solid;margin:2.2em 4% 0 0"


def write_requirements(
    plan: Plan, path: Path, table: Path, file: BenchFile
) -> list[RequirementVerdict]:
    """Write requirements.csv, .html and .png beside a campaign's table; the verdicts. Raises
    InputError.
    """
    cases = read_cases(table)
    tracker = file.config.tracker
    focal_length_px = tracker.focal_length_mm * 1e3 / tracker.pixel_pitch_um
    scale = Scale(focal_length_px, tracker.resolution_px)
    certificate = None
    if plan.through == "bench":
        certificate = bench_certificate(file)
    own_arcsec, own_s = bench_error(file, certificate)
    cases = with_motion(cases, plan.require, file, scale, plan.through)
    verdicts = verdicts_of(plan.require, cases, scale, plan.seed, own_arcsec, own_s)
    rows = []
    for verdict in verdicts:
        summary = summary_of(verdict)
        rows.append([summary[name] for name in COLUMNS])
    csv_file = table.with_name("requirements.csv")
    write_csv(csv_file, COLUMNS, rows)
    figure = _chart(cases, verdicts)
    chart_file = table.with_name("requirements.png")
    write_whole(chart_file, png(figure))
    table_sha256 = file_sha256(table)
    table_text = f"{cases.cases} through {plan.through}, in {table.name}, sha256 {table_sha256}"
    about = [
        ("plan", str(path)),
        ("bench", f"{file.path}, sha256 {file.sha256}"),
        ("cases", table_text),
        ("program", f"hilstar {__version__}"),
    ]
    if certificate is not None:
        about.append(("certificate", f"{certificate.line}; {off_by(certificate)}"))
    cube = cube_to_boresight(file, certificate)
    if cube is not None:
        about.append(("cube to boresight", cube.line))
    cards = [
        _verdicts(verdicts),
        _error_card(figure),
        Card("Campaign", words=[key_table(about)]),
        signed_card(),
    ]
    parts = [card.html() for card in cards]
    page = page_of(f"Requirements of {path.name}", _verdict(verdicts), parts)
    page_file = table.with_name("requirements.html")
    write_whole(page_file, page)
    return verdicts


def signed_card() -> Card:
    """The lines on which a page is signed."""
    lines = [f'<span style="{SIGN_STYLE}">{name}</span>' for name in SIGN]
    return Card("Signed", words=["".join(lines)])


def _verdict(found: list[RequirementVerdict]) -> Verdict:
    whole = verdict_of(found)
    texts = []
    for verdict in (MET, NOT_MET, NOT_SHOWN):
        count = sum(requirement_verdict.verdict == verdict for requirement_verdict in found)
        if count:
            texts.append(f"{count} {verdict}")
    counts = ", ".join(texts)
    return Verdict(STATES[whole], HEADLINES[whole], f"Of {len(found)}: {counts}.")


def _verdicts(found: list[RequirementVerdict]) -> Card:
    """A row for each requirement."""
    rows = []
    for verdict in found:
        more = ""
        if verdict.verdict == NOT_SHOWN and verdict.more:
            more = f"about {verdict.more} more cases"
        require = verdict.require
        chip = verdict_chip(verdict.verdict)
        percent = 100 * require.confidence
        unit = QUANTITY_UNITS[require.quantity]
        value = _figure(verdict.value, unit)
        bound = _figure(verdict.bound, unit)
        figures = (value, bound, f"{percent:g} %", verdict.cases)
        rows.append((require.words, chip, *figures, more, verdict.method))
    texts = [table_of(rows, HEADER), paragraph(METHOD, "small")]
    return Card("Verdicts", words=texts, cure=CURES[verdict_of(found)])


def verdict_chip(verdict: str) -> Markup:
    """A verdict in the colour of its state."""
    state = STATES[verdict]
    return Markup(f'<span class="chip" data-state="{state}">{verdict}</span>')


def _figure(value: float | None, unit: str) -> str | None:
    """A figure of the verdicts' table with its unit; None where it is not known."""
    if value is None or not math.isfinite(value):
        return None
    return value_text(value, unit=unit)


def _error_card(figure: Any) -> Card:
    alt = "error across the boresight against rate, with the requirements"
    return Card("Error against rate", words=[drawing_of(figure, alt)])


def summary_of(each: RequirementVerdict) -> dict[str, Any]:
    """The JSON object of a verdict, with the columns of requirements.csv."""
    require = each.require
    axis = ""
    if require.of_axis:
        axis = require.axis or "cross"
    return {
        "quantity": require.quantity,
        "axis": axis,
        "condition": require.condition,
        "limit": require.limit,
        "bound": each.bound,
        "confidence": require.confidence,
        "cases": each.cases,
        "verdict": each.verdict,
        "value": each.value,
        "more_cases": each.more,
        "method": each.method,
    }


def verdict_of(found: list[RequirementVerdict]) -> str:
    """The verdict of all together: the worst."""
    verdicts = {requirement_verdict.verdict for requirement_verdict in found}
    if NOT_MET in verdicts:
        return NOT_MET
    if NOT_SHOWN in verdicts:
        return NOT_SHOWN
    return MET


def _chart(cases: Columns, found: list[RequirementVerdict]) -> Any:
    """Error across the boresight against rate (or case, where no rate is varied), with the
    requirements of such errors.
    """
    error, rate = _error_and_rate(cases)
    rates = rate[np.isfinite(rate)]
    rated = len(rates) > 0 and bool(np.ptp(rates) > 0)
    at = cases.numbers["case"]
    if rated:
        at = rate
    known = np.isfinite(error) & np.isfinite(at)
    met = sum(verdict.verdict == MET for verdict in found)
    counts = f"{met} of {len(found)} requirements are met"
    note = (
        "Dots: cases about the median. Line: one sigma of each bin. Horizontal: one sigma that a"
        " requirement allows."
    )
    with panels_of(counts, 1, note=note) as (axes,):
        if known.any():
            _draw_cases(axes, at[known], error[known], found, rated)
        axes.set_xlabel("case")
        if rated:
            axes.set_xlabel("rate [deg/s]")
        axes.set_ylabel("error across [arcsec]")
    return axes.figure


def _draw_cases(
    axes: Any, at: FloatArray, error: FloatArray, found: list[RequirementVerdict], rated: bool
) -> None:
    """Draw errors (n,) at rates or cases (n,), their bins, and what requirements allow."""
    count = len(at)
    evenly = np.linspace(0, count - 1, MAX_POINTS).astype(int)
    some = np.unique(evenly)
    axes.plot(at[some], error[some], ".", ms=3, color=MUTED, alpha=0.6, rasterized=True)
    order = np.argsort(at, kind="stable")
    bins = max(1, min(MAX_BINS, count // MIN_IN_BIN))
    middles = []
    sigmas = []
    for rows in np.array_split(order, bins):
        middles.append(float(np.median(at[rows])))
        # wild answers do not move it
        sigmas.append(float(np.median(error[rows])) / MEDIAN_OF_SIGMA)
    axes.plot(middles, sigmas, "o-", color=BLUE)
    low, high = float(at.min()), float(at.max())
    if rated and low > 0 and high > 30 * low:
        axes.set_xscale("log")
    drawn = []
    limits = []
    for verdict in found:
        require = verdict.require
        if require.quantity in DRAWN and (require.axis or "cross") in ("cross", "x", "y"):
            drawn.append(verdict)
            limits.append(require.limit)
    highest = float(np.quantile(error, 0.97))
    top = 1.15 * max(highest, *sigmas, *limits)
    axes.set_ylim(0, top)
    for verdict in drawn:
        begin, end = low, high
        if rated:
            begin, end = _span(verdict.require.condition, low, high)
        _draw_limit(axes, verdict, begin, end)


def _draw_limit(axes: Any, verdict: RequirementVerdict, begin: float, end: float) -> None:
    """Draw the limit of a requirement from one rate or case to another."""
    limit = verdict.require.limit
    axes.plot([begin, end], [limit, limit], color=COLOURS[verdict.verdict], lw=2.2)
    label = f"{verdict.require.quantity} {verdict.verdict}"
    offset_points = (2, 3)
    axes.annotate(
        label,
        (begin, limit),
        offset_points,
        textcoords="offset points",
        fontsize=9,
        color=INK,
    )


def _error_and_rate(cases: Columns) -> tuple[FloatArray, FloatArray]:
    """Each case's error across the boresight about the median, arcsec, and its rate, deg/s (NaN:
    none is varied): (n,) each.
    """
    x = cases.numbers["error_x_arcsec"]
    y = cases.numbers["error_y_arcsec"]
    known = np.isfinite(x) & np.isfinite(y)
    if known.any():
        x = x - np.median(x[known])
        y = y - np.median(y[known])
    error = np.sqrt((x**2 + y**2) / 2)
    squares = []
    for name in cases.varied:
        if name.startswith(f"{VARY}rate_deg_s."):
            squares.append(cases.numbers[name] ** 2)
    if not squares:
        return error, np.full(len(x), np.nan)
    return error, np.sqrt(sum(squares))


def _span(condition: str, low: float, high: float) -> tuple[float, float]:
    """The rates to which a condition confines a requirement, within the chart's."""
    for part in condition.split(" and "):
        match = CONDITION.fullmatch(part)
        if match and match[1].startswith("rate_deg_s.") and match[4]:
            value = float(match[4])
            if match[2] in ("<", "<="):
                high = min(high, value)
            elif match[2] in (">", ">="):
                low = max(low, value)
            elif match[2] == "==":
                low, high = value, value
    return low, high
