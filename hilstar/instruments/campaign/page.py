"""The page of a campaign, campaign.html: whether every case ran, its availability and wrong
answers, its budget, and what costs it.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
    drawing_of,
    escaped,
    figures_of,
    key_table,
    list_of,
    measured,
    page_of,
    paragraph,
    table_of,
)
from hilstar.instruments.assess.figure_rows import FigureRow, figures_table, limit_text

PAGE_FILE = "campaign.html"
MAX_REASONS = 20
ROWS_OF_FIGURES = (
    ("field-of-view error", "field-of-view error across"),
    ("pixel error", "pixel error across"),
    ("noise", "noise across"),
)
COST_COLUMNS = ("parameter", "cost", "smallest", "largest")
FAILED_CURE = "Mend what the reasons name, and run the plan again into another directory."
WRONG_CURE = "Look at the cases whose column `wrong` is over 0, and at what costs the most."


class MeasureCosts(NamedTuple):
    """What costs the most of a measure: the first parameter's cost and what it is of, a row for
    each parameter (COST_COLUMNS), and the chart.
    """

    cost: str
    of: str
    rows: Sequence[tuple[str, ...]]
    chart: Any


def write_campaign_page(
    path: Path,
    summary: Mapping[str, Any],
    budget: Sequence[FigureRow],
    costs: Mapping[str, MeasureCosts],
) -> None:
    """Write the page of a campaign: its JSON object, the rows of budget.csv, and the costs of
    each measure. Raises InputError where it cannot be written.
    """
    parts = [figures_of(_figures(summary, budget))]
    parts += [card.html() for card in _cards(summary, budget, costs)]
    title = f"Campaign of {summary['cases']} cases"
    write_whole(path, page_of(title, verdict_of(summary), parts))


def verdict_of(summary: Mapping[str, Any]) -> Verdict:
    """BAD with wrong answers, WARN where cases failed or an answer is missing, else OK."""
    wrong = summary["wrong"]
    failed = summary["failed"]
    headline = f"The tracker was right in {_percent(summary['availability'])} of the frames"
    counts = f"{summary['cases']} cases, {failed} failed, {wrong} wrong answers."
    if wrong:
        return Verdict(BAD, headline, counts)
    if failed or summary["availability"] < 1:
        return Verdict(WARN, headline, counts)
    return Verdict(OK, headline, counts)


def _percent(share: float) -> str:
    """A share of which only all are 100 %."""
    if share >= 1:
        return "100 %"
    return f"{min(100 * share, 99.99):.4g} %"


def _figures(summary: Mapping[str, Any], budget: Sequence[FigureRow]) -> Iterator[KeyFigure]:
    """Availability, wrong answers, failed cases, and the errors across the boresight."""
    yield KeyFigure(_percent(summary["availability"]), "availability")
    yield _count(summary["wrong"], "wrong answers", BAD)
    yield _count(summary["failed"], "failed cases", WARN)
    across = {row.quantity: row for row in budget if row.axis == "cross"}
    for quantity, of in ROWS_OF_FIGURES:
        row = across.get(quantity)
        if row is not None:
            if row.value is None:
                yield KeyFigure(DASH, f"{of}: cannot be told")
            else:
                yield KeyFigure(_value(row), f"{of}, one sigma; \N{PLUS-MINUS SIGN} at 95 %")


def _count(count: int, of: str, state: str) -> KeyFigure:
    if count:
        return KeyFigure(str(count), of, state)
    return KeyFigure("0", of, OK)


def _value(row: FigureRow) -> str:
    """A row's value with the half width of its interval."""
    assert row.value is not None
    half = None
    if row.low_95 is not None and row.high_95 is not None:
        half = (row.high_95 - row.low_95) / 2
    return measured(row.value, half, row.unit)


def _cards(
    summary: Mapping[str, Any],
    budget: Sequence[FigureRow],
    costs: Mapping[str, MeasureCosts],
) -> Iterator[Card]:
    """What failed, what costs the most, the budget, and the table."""
    if summary["failed"]:
        yield _failures(summary["failed_because"])
    cure = ""
    if summary["wrong"]:
        cure = WRONG_CURE
    for measure, measure_costs in costs.items():
        drawing = drawing_of(measure_costs.chart, f"cost of each parameter in {measure}")
        figure = KeyFigure(measure_costs.cost, measure_costs.of)
        rows = [(_breakable(parameter), *texts) for parameter, *texts in measure_costs.rows]
        table = table_of(rows, COST_COLUMNS)
        yield Card(f"What costs the most: {measure}", figure, [table], drawing, cure)
        cure = ""
    limit = paragraph(f"Limit of the tracker's stars: {limit_text(summary['limit_arcsec'])}.")
    known = [row for row in budget if row.value is not None]
    yield Card("Budget", words=[figures_table(known), limit])
    files = [("table", summary["table"]), ("SHA-256", summary["sha256"])]
    texts = [key_table(files)]
    if summary["notes"]:
        texts.append(list_of(summary["notes"]))
    yield Card("Table and notes", words=texts)


def _breakable(key: str) -> Markup:
    """A dotted key that may be broken behind its dots."""
    return Markup(escaped(key).replace(".", ".<wbr>"))


def _failures(because: Mapping[str, int]) -> Card:
    """The cases that failed, by reason."""
    rows = [(count, reason) for reason, count in list(because.items())[:MAX_REASONS]]
    return Card("Failed cases", words=[table_of(rows, ("cases", "why"))], cure=FAILED_CURE)
