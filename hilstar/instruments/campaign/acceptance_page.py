"""The page of an acceptance, accept.html: each capability with its requirement, figure and verdict,
what was not tested and why, and the ledger; the same as acceptance.csv and JSON.
"""

import math
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import numpy as np

from hilstar.basics.charts import BLUE, MUTED, capital, panels_of, write_csv
from hilstar.basics.files import write_whole
from hilstar.basics.pages import (
    BAD,
    DASH,
    OK,
    WARN,
    Card,
    KeyFigure,
    Verdict,
    drawing_of,
    figures_of,
    page_of,
    paragraph,
    table_of,
)
from hilstar.basics.version import __version__
from hilstar.instruments.assess.bounded_figures import TooFewCases, clopper_pearson, quantile_limits
from hilstar.instruments.assess.star_drawing import star_drawing
from hilstar.instruments.campaign.acceptance_plan import AcceptancePlan
from hilstar.instruments.campaign.acceptance_verdicts import (
    LEDGER,
    NOT_TESTED,
    AcceptedBench,
    ClauseVerdict,
    SetResult,
)
from hilstar.instruments.campaign.answer_figures import star_table
from hilstar.instruments.campaign.plan import STAR_QUANTITIES
from hilstar.instruments.campaign.requirements import MET, NOT_MET, NOT_SHOWN
from hilstar.instruments.campaign.requirements_page import STATES, signed_card, verdict_chip
from hilstar.instruments.campaign.store import file_sha256
from hilstar.instruments.campaign.sweep import NOT_EVEN, STILL, SweepTable, levels_text
from hilstar.server.bench.certificate_file import off_by

PAGE_FILE, CSV_FILE, JSON_FILE = "accept.html", "acceptance.csv", "acceptance.json"
HEADER = (
    *("capability", "requirement", "measured (interval)", "guard band", "margin", "verdict"),
    *("cases", "what is open"),
)
CSV_COLUMNS = (
    *("capability", "of", "quantity", "axis", "condition", "limit", "side", "unit", "confidence"),
    *("value", "low", "high", "guard", "margin", "cases", "verdict", "more_cases", "why", "method"),
    "together",
)
HEADLINES = {
    MET: "Every clause that was tested is met",
    NOT_MET: "A clause is not met",
    NOT_SHOWN: "No clause is broken, and some are not shown",
}
CURES = {
    NOT_MET: "Look at the ledger for the cases at fault, and change the tracker or the limit.",
    NOT_SHOWN: "Run more cases: the table says how many would decide.",
}
METHOD = (
    "Each end of an interval is a one-sided limit at the clause's confidence. Met: the whole"
    " interval keeps the limit, narrowed by the guard band, the bench's own uncertainty (95 %). Not"
    " met: the whole interval breaks the limit, widened by it. Not shown: neither. Margin: from the"
    " interval to the narrowed limit, negative beyond it."
)
TOGETHER = (
    "That every clause is met holds at the clauses' confidence, however many there are, as each has"
    " to be met (Berger 1982). One of many that is not met may be so by chance: it is judged again"
    " with the doubt shared by all clauses (Bonferroni), and the last column says where it is not"
    " shown then."
)
MAY_BE_CHANCE = "may be chance among so many clauses; more cases would tell"
FAILED_HEADER = ("set of cases", "failed", "why")
FAILED_CURE = "Mend what the reasons name, and accept again in another directory."
# what was tested, by the plan's `through`
THROUGH = {
    "tracker": "the bench file's virtual tracker before the sky, no real one",
    "display": "the bench file's virtual tracker before the display as simulated, no real one",
    "bench": "the real tracker before the real display",
}
QUICK = "a few cases for every clause (--quick), no acceptance"
QUANTILES = (0.5, 0.9, 0.95, 0.99)
MAX_ROWS = 5000  # of points in a chart
EDGE_ALPHA = 0.15  # of the band that is an edge's interval


def write_acceptance(
    acceptance: AcceptedBench, results: list[SetResult], verdicts: list[ClauseVerdict], rows: int
) -> dict[str, Any]:
    """Write accept.html, acceptance.csv and acceptance.json; the JSON object. `rows` are those of
    the ledger. Raises InputError.
    """
    folder = acceptance.directory
    summary = summary_of(acceptance, verdicts, rows)
    rows_text = []
    for clause in summary["clauses"]:
        rows_text.append([_plain(clause[name]) for name in CSV_COLUMNS])
    write_csv(folder / CSV_FILE, CSV_COLUMNS, rows_text)
    import msgspec

    packed = msgspec.json.encode(summary)
    write_whole(folder / JSON_FILE, msgspec.json.format(packed, indent=1))
    parts = [figures_of(_counts(verdicts))]
    for card in _cards(acceptance, results, verdicts, rows):
        parts.append(card.html())
    title = f"{acceptance.plan.title}: {acceptance.file.path.name}"
    page = page_of(title, _verdict(verdicts, acceptance.plan), parts)
    write_whole(folder / PAGE_FILE, page)
    return summary


def verdict_of(verdicts: list[ClauseVerdict]) -> str:
    """The verdict of all tested clauses together: the worst."""
    verdict_words = {verdict.word for verdict in verdicts}
    if NOT_MET in verdict_words:
        return NOT_MET
    if NOT_SHOWN in verdict_words or MET not in verdict_words:
        return NOT_SHOWN
    return MET


def summary_of(
    acceptance: AcceptedBench, verdicts: list[ClauseVerdict], rows: int
) -> dict[str, Any]:
    """The JSON object of `hilstar accept`."""
    plan, file = acceptance.plan, acceptance.file
    arcsec, seconds = acceptance.own_error
    own_arcsec = None
    if arcsec is not None:
        across, about = arcsec
        own_arcsec = {"cross": across, "roll": about}
    clauses = [_clause(verdict) for verdict in verdicts]
    untested = []
    for judged in plan.untested:
        untested.append({"capability": judged.capability, "why": judged.why})
    return {
        "title": plan.title,
        "plan": str(plan.path),
        "plan_sha256": plan.sha256,
        "quick": plan.quick,
        "bench": str(file.path),
        "bench_sha256": file.sha256,
        "through": plan.through,
        "hilstar": __version__,
        "verdict": verdict_of(verdicts),
        "cases": rows,
        "bench_off_arcsec": own_arcsec,
        "bench_off_s": seconds,
        "cube_to_boresight": acceptance.cube,
        "clauses": clauses,
        "untested": untested,
    }


def _clause(each: ClauseVerdict) -> dict[str, Any]:
    clause, verdict = each.clause, each.verdict
    axis = ""
    if clause.of_axis:
        axis = clause.axis or "cross"
    side = "minimum"
    if clause.minimum is None:
        side = "maximum"
    row: dict[str, Any] = {
        "capability": clause.capability,
        "of": clause.of,
        "quantity": clause.quantity,
        "axis": axis,
        "condition": clause.condition,
        "limit": clause.limit,
        "side": side,
        "unit": each.unit,
        "confidence": clause.confidence,
        "verdict": each.word,
        "why": each.untested,
        "together": each.together,
    }
    row |= dict.fromkeys(("value", "low", "high", "guard", "margin", "cases", "method"))
    row["more_cases"] = None
    if verdict is not None:
        row["value"] = verdict.value
        row["low"] = verdict.low
        row["high"] = verdict.high
        row["guard"] = verdict.guard
        row["margin"] = verdict.margin
        row["cases"] = verdict.cases
        row["method"] = verdict.method
        row["more_cases"] = verdict.more
    return row


def _plain(value: object) -> object:
    if value is None:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else value


def lines_of(
    acceptance: AcceptedBench, results: list[SetResult], verdicts: list[ClauseVerdict]
) -> list[str]:
    """A line for each clause on the terminal, for what no clause tests, and for failed cases."""
    width = max(len(judged.clause.capability) for judged in verdicts)
    lines = []
    for judged in verdicts:
        head = f"{judged.clause.capability:{width}}  {judged.word:10}"
        if judged.verdict is None:
            lines.append(f"{head}  {judged.untested}")
        else:
            line = f"{head}  {_requirement(judged)}: {_measured(judged)}"
            more = _more(judged)
            if more:
                line = f"{line}; {more}"
            lines.append(line)
    for untested in acceptance.plan.untested:
        lines.append(f"{untested.capability:{width}}  {NOT_TESTED}  {untested.why}")
    for result in results:
        for name, count, why in _failed_rows(result):
            lines.append(f"{name}: {count} cases failed: {why}")
    return lines


def _more(each: ClauseVerdict) -> str:
    """What would show a clause that is not shown, and what one that is not met alone may be; ""
    for another.
    """
    if each.together not in ("", NOT_MET):
        return MAY_BE_CHANCE
    if each.word != NOT_SHOWN or each.verdict is None:
        return ""
    if each.verdict.more:
        return f"about {each.verdict.more} more cases would decide"
    return each.verdict.method if each.verdict.value is None else ""


def _requirement(each: ClauseVerdict) -> str:
    """The limit in words, without the quantity, which the capability names."""
    require = each.clause.require
    side = "at least"
    if require.minimum is None:
        side = "at most"
    limit = f"{require.limit:g} {each.unit}".rstrip()
    limit_text = f"{side} {limit}"
    if require.share:
        percent = 100 * require.share
        limit_text = f"{limit_text} in {percent:g} % of cases"
    if require.condition:
        limit_text = f"{limit_text} where {require.condition}"
    return limit_text


def _measured(each: ClauseVerdict) -> str:
    """The figure with its interval."""
    verdict = each.verdict
    if verdict is None or verdict.value is None:
        return DASH
    if each.clause.quantity == "edge" and None in (verdict.low, verdict.high):
        for end in (STILL, NOT_EVEN):
            if end in verdict.method:
                return f"{end} {_digits(verdict.value)} {each.unit}".rstrip()
    interval = _interval(verdict.low, verdict.high)
    return f"{_digits(verdict.value)} ({interval}) {each.unit}".rstrip()


def _interval(low: float | None, high: float | None) -> str:
    """An interval, one of whose ends may be unknown."""
    if low is not None and high is not None:
        return f"{_digits(low)} to {_digits(high)}"
    if low is not None:
        return f"{_digits(low)} or more"
    if high is not None:
        return f"{_digits(high)} or less"
    return "interval unknown"


def _digits(value: float) -> str:
    """Three digits; large whole numbers without an exponent."""
    if abs(value) >= 1000:
        return f"{float(f'{value:.3g}'):.0f}"
    return f"{value:.3g}"


def _margin(each: ClauseVerdict) -> str | None:
    """How far the limit is kept, and that as a share of it, where that is at most all."""
    verdict = each.verdict
    if verdict is None or verdict.margin is None:
        return None
    limit = abs(each.clause.limit)
    share = ""
    if limit > 0 and abs(verdict.margin) <= limit:
        share = f" ({100 * verdict.margin / limit:.0f} %)"
    return f"{_digits(verdict.margin)} {each.unit}".rstrip() + share


def _verdict(verdicts: list[ClauseVerdict], plan: AcceptancePlan) -> Verdict:
    whole = verdict_of(verdicts)
    counts = []
    for word in (MET, NOT_MET, NOT_SHOWN, NOT_TESTED):
        count = sum(judged.word == word for judged in verdicts)
        if count:
            counts.append(f"{count} {word}")
    counts_text = f"Of {len(verdicts)}: {', '.join(counts)}."
    counts_text = f"{counts_text} Tested: {THROUGH[plan.through]}."
    if plan.quick:
        counts_text = f"{counts_text} {capital(QUICK)}."
    return Verdict(STATES[whole], HEADLINES[whole], counts_text)


def _counts(verdicts: list[ClauseVerdict]) -> Iterator[KeyFigure]:
    for word, state in ((MET, OK), (NOT_MET, BAD), (NOT_SHOWN, WARN), (NOT_TESTED, WARN)):
        count = sum(judged.word == word for judged in verdicts)
        if count or word == MET:
            yield KeyFigure(str(count), word, state if count else WARN)


def _cards(
    acceptance: AcceptedBench, results: list[SetResult], verdicts: list[ClauseVerdict], rows: int
) -> Iterator[Card]:
    yield _clauses(verdicts)
    yield _untested(acceptance, verdicts)
    failed: list[tuple[str, int, str]] = []
    for result in results:
        failed += _failed_rows(result)
    if failed:
        yield Card("Failed cases", words=[table_of(failed, FAILED_HEADER)], cure=FAILED_CURE)
    for result in results:
        if result.levels:
            yield _sweep_card(result, _judged_edge(verdicts, result))
        elif _asked(verdicts, result, ("time-to-first-attitude",)):
            yield _first_attitude(result)
        elif _asked(verdicts, result, STAR_QUANTITIES):
            yield from _star_card(acceptance, result)
    yield _about(acceptance, results, rows)
    yield signed_card()


def _judged_edge(verdicts: list[ClauseVerdict], result: SetResult) -> ClauseVerdict:
    """The first verdict on the edge of a sweep."""
    return next(judged for judged in verdicts if judged.clause.of == result.case_set.name)


def _failed_rows(result: SetResult) -> Iterator[tuple[str, int, str]]:
    """The failed cases of a set: how many by reason."""
    for why, count in result.failed.items():
        yield result.case_set.name, count, why


def _asked(verdicts: list[ClauseVerdict], result: SetResult, quantities: tuple[str, ...]) -> bool:
    """Whether a clause limits one of these quantities of a set."""
    if result.cases is None:
        return False
    name = result.case_set.name
    for judged in verdicts:
        clause = judged.clause
        if clause.of == name and clause.quantity in quantities:
            return True
    return False


def _clauses(verdicts: list[ClauseVerdict]) -> Card:
    rows, methods = [], []
    for judged in verdicts:
        clause, verdict = judged.clause, judged.verdict
        if verdict is None:
            continue
        requirement = _requirement(judged)
        measured = _measured(judged)
        guard = ""
        if verdict.guard:
            guard = f"{verdict.guard:.2g} {judged.unit}"
        figures = (requirement, measured, guard, _margin(judged), verdict_chip(judged.word))
        rows.append((clause.capability, *figures, verdict.cases, _more(judged)))
        methods.append((clause.capability, clause.quantity, verdict.method))
    texts = [table_of(rows, HEADER), paragraph(METHOD, "small"), paragraph(TOGETHER, "small")]
    how = table_of(methods, ("capability", "quantity", "method"))
    cure = CURES.get(verdict_of(verdicts), "")
    return Card("Clauses", words=texts, cure=cure, details=[how])


def _untested(acceptance: AcceptedBench, verdicts: list[ClauseVerdict]) -> Card:
    rows = []
    for judged in verdicts:
        if judged.verdict is None:
            rows.append((judged.clause.capability, judged.untested))
    rows += [(judged.capability, judged.why) for judged in acceptance.plan.untested]
    if not rows:
        return Card("Not tested", words=[paragraph("Every clause of the plan was tested.")])
    return Card("Not tested", words=[table_of(rows, ("capability", "why"))])


def _sweep_card(result: SetResult, judged: ClauseVerdict) -> Card:
    """The share of successes at each level of a sweep, with its interval, and the edge."""
    sweep = result.case_set.sweep
    assert sweep is not None
    levels = list(levels_text(result.levels))
    at, share, ends = [], [], []
    for level, successes, cases in levels:
        if not cases:
            continue
        at.append(level)
        share.append(successes / cases)
        ends.append(clopper_pearson(successes, cases, 0.975))
    bars = np.abs(np.array(ends).T - np.array(share))
    unit = ""
    if sweep.unit:
        unit = f" [{sweep.unit}]"
    finding = _edge_finding(sweep, judged)
    with panels_of(finding) as (axes,):
        edge = judged.verdict
        if edge is not None and edge.low is not None and edge.high is not None:
            axes.axvspan(edge.low, edge.high, color=BLUE, alpha=EDGE_ALPHA, linewidth=0)
        axes.errorbar(at, share, yerr=bars, fmt="o", capsize=3, color=BLUE, ecolor=MUTED)
        axes.axhline(sweep.share, linewidth=0.8, linestyle="--", color=MUTED)
        axes.set_ylim(-0.05, 1.05)
        if sweep.scale == "log":
            axes.set_xscale("log")
        axes.set_xlabel(f"{sweep.key}{unit}")
        axes.set_ylabel("share of cases")
    table = table_of(levels, (f"level{unit}", "successes", "cases"))
    paragraphs = []
    if result.case_set.about:
        paragraphs.append(paragraph(result.case_set.about))
    paragraphs.append(drawing_of(axes.figure, finding))
    return Card(judged.clause.capability, words=paragraphs, details=[table])


def _edge_finding(sweep: SweepTable, judged: ClauseVerdict) -> str:
    """Up to where a sweep's cases are successes, in a line."""
    success = "An attitude"
    if sweep.star_v_mag is not None:
        success = f"Half of the stars to V {sweep.star_v_mag:g}"
    edge = judged.verdict
    if edge is None or edge.value is None:
        return f"{success}: {judged.untested or 'no edge'}"
    if STILL in edge.method:
        return f"{success} even at {_digits(edge.value)} {judged.unit}".rstrip()
    if NOT_EVEN in edge.method:
        return f"{success} is not there even at {_digits(edge.value)} {judged.unit}".rstrip()
    way = "up to"
    if sweep.stop < sweep.start:
        way = "down to"
    return f"{success} {way} {_measured(judged)}"


def _first_attitude(result: SetResult) -> Card:
    """The distribution of the time to the first attitude."""
    assert result.cases is not None
    column = result.cases.numbers["first_attitude_s"]
    # a case without an attitude has waited for ever
    times = np.sort(np.where(np.isfinite(column), column, math.inf))
    count = len(times)
    rows = []
    finding = "Half of the cases have no attitude"
    for share in QUANTILES:
        low, high = quantile_limits(times, share, 0.975)
        place = min(math.ceil(share * count), count) - 1
        value = float(times[place])
        percent = f"{100 * share:g} %"
        rows.append((percent, _seconds(value), _seconds(low), _seconds(high)))
        if math.isfinite(value):
            finding = f"An attitude within {_seconds(value)} s in {percent} of cases"
    known = times[np.isfinite(times)]
    shares = np.arange(1, len(known) + 1) / count
    with panels_of(finding) as (axes,):
        axes.step(known, shares, where="post", color=BLUE)
        axes.set_ylim(0, 1.05)
        axes.set_xlabel("time to the first attitude [s]")
        axes.set_ylabel("share of cases")
    header = ("share of cases", "within [s]", "from (95 %)", "to")
    paragraphs = [drawing_of(axes.figure, finding)]
    paragraphs.append(table_of(rows, header))
    return Card(f"Time to the first attitude: {result.case_set.name}", words=paragraphs)


def _star_card(acceptance: AcceptedBench, result: SetResult) -> Iterator[Card]:
    """Detection against magnitude, and the map of stars' place errors; none without stars."""
    assert result.cases is not None
    try:
        drawing = star_drawing(star_table(result.cases), acceptance.scale.resolution_px)
    except TooFewCases:
        return
    yield Card(f"Single stars: {result.case_set.name}", words=[drawing])


def _seconds(value: float) -> str:
    if math.isfinite(value):
        return f"{value:.4g}"
    return "more than was waited" if value > 0 else DASH


def _about(acceptance: AcceptedBench, results: list[SetResult], rows: int) -> Card:
    plan = acceptance.plan
    file = acceptance.file
    ledger_sha256 = file_sha256(acceptance.directory / LEDGER)
    about: list[tuple[str, str]] = [
        ("plan", f"{plan.path}, sha256 {plan.sha256}"),
        ("judged", f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"),
        ("run of", QUICK if plan.quick else "all cases of the plan"),
        ("bench", f"{file.path}, sha256 {file.sha256}"),
        ("tested", THROUGH[plan.through]),
        ("solver", acceptance.solver_text),
        ("program", f"hilstar {__version__}"),
        ("ledger", f"{rows} cases in {LEDGER}, sha256 {ledger_sha256}"),
    ]
    if acceptance.certificate is not None:
        certificate = acceptance.certificate
        about.append(("certificate", f"{certificate.line}; {off_by(certificate)}"))
    elif acceptance.on_bench:
        about.append(("certificate", "none: the bench's own uncertainty is not taken off"))
    cube = acceptance.cube
    if cube is not None:
        about.append(("cube to boresight", cube.line))
    sets = []
    for result in results:
        cases = sum(count.cases for count in result.levels)
        if result.cases is not None:
            cases = result.cases.cases
        sets.append((result.case_set.name, cases, result.case_set.about))
    table = table_of(sets, ("set of cases", "cases", "what"))
    return Card("Bench, plan and ledger", words=[table_of(about), table])
