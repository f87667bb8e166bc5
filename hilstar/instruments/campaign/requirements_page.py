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
    NOT_SHOWN: "Run more cases: the table says how many would show it.",
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
    scale = Scale(tracker.focal_length_mm * 1e3 / tracker.pixel_pitch_um, tracker.resolution_px)
    if plan.through == "bench":
        certificate = bench_certificate(file)
    else:
        certificate = None
    if certificate is None:
        bench_arcsec = None
    else:
        bench_arcsec = certificate.attitude_arcsec
    cases = with_motion(cases, plan.require, file, scale)
    verdicts = verdicts_of(plan.require, cases, scale, plan.seed, bench_arcsec)
    rows = []
    for verdict in verdicts:
        summary = summary_of(verdict)
        rows.append([summary[name] for name in COLUMNS])
    write_csv(table.with_name("requirements.csv"), COLUMNS, rows)
    figure = _chart(cases, verdicts)
    write_whole(table.with_name("requirements.png"), png(figure))
    about = [
        ("plan", str(path)),
        ("bench", f"{file.path}, sha256 {file.sha256}"),
        (
            "cases",
            f"{cases.cases} through {plan.through}, in {table.name}, sha256 {file_sha256(table)}",
        ),
        ("program", f"hilstar {__version__}"),
        *([("certificate", f"{certificate.line}; {off_by(certificate)}")] if certificate else []),
    ]
    cube = cube_to_boresight(file, certificate)
    if cube is not None:
        about.append(("cube to boresight", cube.line))
    parts = [_verdicts(verdicts).html(), _error_card(figure).html()]
    parts.append(Card("Campaign", words=[key_table(about)]).html())
    names = "".join(f'<span style="{SIGN_STYLE}">{name}</span>' for name in SIGN)
    parts.append(Card("Signed", words=[names]).html())
    page = page_of(f"Requirements of {path.name}", _verdict(verdicts), parts)
    write_whole(table.with_name("requirements.html"), page)
    return verdicts


def _verdict(found: list[RequirementVerdict]) -> Verdict:
    whole = verdict_of(found)
    texts = []
    for verdict in (MET, NOT_MET, NOT_SHOWN):
        count = sum(requirement_verdict.verdict == verdict for requirement_verdict in found)
        if count:
            texts.append(f"{count} {verdict}")
    return Verdict(STATES[whole], HEADLINES[whole], f"Of {len(found)}: {', '.join(texts)}.")


def _verdicts(found: list[RequirementVerdict]) -> Card:
    """A row for each requirement."""
    rows = []
    for verdict in found:
        more = ""
        if verdict.verdict == NOT_SHOWN and verdict.more:
            more = f"about {verdict.more} more cases"
        chip = f'<span class="chip" data-state="{STATES[verdict.verdict]}">{verdict.verdict}</span>'
        confidence = f"{100 * verdict.require.confidence:g} %"
        unit = QUANTITY_UNITS[verdict.require.quantity]
        figures = (
            _figure(verdict.value, unit),
            _figure(verdict.bound, unit),
            confidence,
            verdict.cases,
        )
        rows.append((verdict.require.words, Markup(chip), *figures, more, verdict.method))
    texts = [table_of(rows, HEADER), paragraph(METHOD, "small")]
    return Card("Verdicts", words=texts, cure=CURES[verdict_of(found)])


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
    return {
        "quantity": require.quantity,
        "axis": (require.axis or "cross") if require.of_axis else "",
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
    rated = bool(np.isfinite(rate).any() and np.ptp(rate[np.isfinite(rate)]) > 0)
    at = rate if rated else cases.numbers["case"]
    known = np.flatnonzero(np.isfinite(error) & np.isfinite(at))
    drawn = [
        verdict
        for verdict in found
        if verdict.require.quantity in DRAWN
        and (verdict.require.axis or "cross") in ("cross", "x", "y")
    ]
    counts = (
        f"{sum(verdict.verdict == MET for verdict in found)} of {len(found)} requirements are met"
    )
    note = (
        "Dots: cases about the median. Line: one sigma of each bin. Horizontal: one sigma that a"
        " requirement allows."
    )
    with panels_of(counts, 1, note=note) as (axes,):
        if len(known):
            some = known[np.unique(np.linspace(0, len(known) - 1, MAX_POINTS).astype(int))]
            axes.plot(at[some], error[some], ".", ms=3, color=MUTED, alpha=0.6, rasterized=True)
            order = known[np.argsort(at[known], kind="stable")]
            bins = np.array_split(order, max(1, min(MAX_BINS, len(order) // MIN_IN_BIN)))
            # wild answers do not move it
            sigma = [float(np.median(error[rows])) / MEDIAN_OF_SIGMA for rows in bins]
            axes.plot([float(np.median(at[rows])) for rows in bins], sigma, "o-", color=BLUE)
            positive = at[known] > 0
            if rated and positive.all() and at[known].max() > 30 * at[known].min():
                axes.set_xscale("log")
            low = float(at[known].min())
            high = float(at[known].max())
            top = 1.15 * max(
                float(np.quantile(error[known], 0.97)),
                *sigma,
                *(verdict.require.limit for verdict in drawn),
            )
            axes.set_ylim(0, top)
            for verdict in drawn:
                begin, end = _span(verdict.require.condition, low, high) if rated else (low, high)
                axes.plot(
                    [begin, end],
                    [verdict.require.limit] * 2,
                    color=COLOURS[verdict.verdict],
                    lw=2.2,
                )
                bar_text = f"{verdict.require.quantity} {verdict.verdict}"
                axes.annotate(
                    bar_text,
                    (begin, verdict.require.limit),
                    (2, 3),
                    textcoords="offset points",
                    fontsize=9,
                    color=INK,
                )
        axes.set_xlabel("rate [deg/s]" if rated else "case")
        axes.set_ylabel("error across [arcsec]")
    return axes.figure


def _error_and_rate(cases: Columns) -> tuple[FloatArray, FloatArray]:
    """Each case's error across the boresight about the median, arcsec, and its rate, deg/s (NaN:
    none is varied): (n,) each.
    """
    x, y = (cases.numbers[f"error_{axis}_arcsec"] for axis in "xy")
    known = np.isfinite(x) & np.isfinite(y)
    if known.any():
        x = x - np.median(x[known])
        y = y - np.median(y[known])
    names = [name for name in cases.varied if name.startswith(f"{VARY}rate_deg_s.")]
    rate = np.full(len(x), np.nan)
    if names:
        rate = np.sqrt(sum(cases.numbers[name] ** 2 for name in names))
    return np.sqrt((x**2 + y**2) / 2), rate


def _span(condition: str, low: float, high: float) -> tuple[float, float]:
    """The rates to which a condition confines a requirement, within the chart's."""
    for part in condition.split(" and "):
        match = CONDITION.fullmatch(part)
        if match and match[1].startswith("rate_deg_s.") and match[4]:
            value = float(match[4])
            low, high = (low, min(high, value)) if match[2] in ("<", "<=") else (low, high)
            low, high = (max(low, value), high) if match[2] in (">", ">=") else (low, high)
            low, high = (value, value) if match[2] == "==" else (low, high)
    return low, high
