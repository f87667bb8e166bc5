"""The page of a certificate, one file that needs no other and prints on A4: statement,
conformity, budget, identity, files.
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hilstar.basics.charts import BLUE, TEAL, panels_of, value_bars
from hilstar.basics.files import write_whole
from hilstar.basics.pages import (
    BAD,
    OK,
    PLAIN,
    Card,
    KeyFigure,
    Markup,
    Verdict,
    details_of,
    drawing_of,
    escaped,
    figures_of,
    key_table,
    key_words,
    keyed_rows,
    list_of,
    measured,
    page_of,
    paragraph,
    table_of,
    value_text,
)
from hilstar.instruments.certify.model import THIRDS
from hilstar.server.bench.certificate_file import ByTrials, Certificate, CertifiedFigure

VERDICTS = {
    True: (OK, "Conforms"),
    False: (BAD, "Does not conform"),
    None: (PLAIN, "Stated, no limits"),
}
SHOWN = ("flux", "place_along", "place_across", "attitude_x", "attitude_y", "attitude_z", "latency")
FIRST = ("flux", "place_along", "place_across", "attitude_x", "attitude_y", "latency")
BARS = ("flux", "place_along", "attitude_x", "star_flux")
STATED = (
    ("flux", "a star's flux"),
    ("place_along", "its place"),
    ("attitude_x", "attitude across"),
    ("latency", "latency"),
)
MAX_BARS = 6
MAX_APART = 20
TWO_DIGITS = 2  # of a standard uncertainty
QUANTITIES = {
    "flux": "star's flux",
    "place_along": "star's place along x",
    "place_across": "star's place along y",
    "attitude_x": "attitude about x",
    "attitude_y": "attitude about y",
    "attitude_z": "attitude about z",
    "latency": "latency",
    "star_flux": "star's flux against the sky",
    "star_place_along": "star's place along x against the sky",
    "star_place_across": "star's place along y against the sky",
}
RULES = {
    "guard-band": "guard band: a figure conforms where its whole 95 % interval is within its limit",
    "simple": (
        "simple acceptance: a figure conforms where its value is within its limit, whatever its"
        " uncertainty"
    ),
}
WORST_COLUMNS = ("quantity", "region", "value and U (95 %)", "k", "limit", "verdict")
INPUT_COLUMNS = ("input", "distribution", "standard uncertainty", "unit", "dof", "source")
BY_THIRD = ("flux", "place_along", "place_across")
APART_COLUMNS = ("quantity", "of", "first order from", "to", "trials from", "to", "why")
ALL_COLUMNS = ("quantity", "region", "HIP", "value and U (95 %)")
MISSED_CURE = (
    "Mend the bench file's key or the bench where a figure is off, and certify again with --again."
)


def write_certificate_page(path: Path, found: Certificate, digest: str) -> None:
    """Write the page of a certificate whose JSON has this SHA-256. Raises InputError where it
    cannot be written.
    """
    parts = [figures_of(_first(found))]
    parts += [card.html() for card in _cards(found, digest)]
    write_whole(path, page_of(f"Certificate {found.number}", _verdict(found), parts))


def words_of(quantity: str) -> str:
    """A certified quantity as a person reads it."""
    return QUANTITIES.get(quantity, key_words(quantity))


def _verdict(found: Certificate) -> Verdict:
    state, headline = VERDICTS[found.conforms]
    judged = [figure.conforms for figure in found.figures if figure.conforms is not None]
    missed = judged.count(False)
    if missed:
        headline = f"{headline}: {missed} of {len(judged)} figures"
    return Verdict(state, headline, statement(found))


def _first(found: Certificate) -> Iterator[KeyFigure]:
    """The worst figure of each kind that a user asks for first."""
    for quantity in FIRST:
        members = [figure for figure in found.figures if figure.quantity == quantity]
        if members:
            worst = max(members, key=_size)
            yield KeyFigure(_value(worst), f"{words_of(quantity)}, worst of {len(members)}")


def _size(figure: CertifiedFigure) -> float:
    return max(abs(figure.lower), abs(figure.upper))


def _half_width(figure: CertifiedFigure) -> float:
    return (figure.upper - figure.lower) / 2


def _value(figure: CertifiedFigure) -> str:
    """A figure with the half width of its 95 % interval, to two digits of that."""
    return measured(figure.value, _half_width(figure), figure.unit)


def _cards(found: Certificate, digest: str) -> Iterator[Card]:
    yield _figures(found)
    yield Card("Certificate", words=[key_table(_heads(found, digest))])
    if found.cube is not None:
        yield Card("Cube to tracker's boresight", words=[paragraph(found.cube.line)])
    yield _budget(found)
    yield Card("First order against trials", words=list(_both_ways(found)))
    yield Card("Not assessed", words=[list_of(found.not_assessed)])
    identity = []
    for part, keys in (("monitor", found.monitor), ("collimator", found.collimator)):
        identity += [(f"{part}: {name}", text) for name, text in keyed_rows(keys)]
    yield Card("Identity", words=[key_table(identity)])
    files = [(name, Markup(f"<code>{value}</code>")) for name, value in found.files.items()]
    yield Card("Files", words=[table_of(files, ("file", "SHA-256"))])
    rows = []
    for figure in found.figures:
        rows.append((words_of(figure.quantity), figure.region, figure.star, _value(figure)))
    table = table_of(rows, ALL_COLUMNS)
    texts = [details_of(f"{len(found.figures)} figures", table, printed=True)]
    yield Card("All figures", words=texts)


def _figures(found: Certificate) -> Card:
    """The worst figure of each kind and region."""
    measurands = [(words_of(name), text) for name, text in found.measurands.items()]
    texts = [
        paragraph(
            "Worst of each kind and region: value, and half width of its 95 % interval (coverage"
            " factor k by Student's t)."
        ),
        table_of(list(_worst(found)), WORST_COLUMNS, TWO_DIGITS + 1),
        key_table(measurands),
    ]
    cure = ""
    if found.conforms is False:
        cure = MISSED_CURE
    return Card("Figures", words=texts, cure=cure)


def _budget(found: Certificate) -> Card:
    """What the uncertainties are made of."""
    bars = [_bars(found, quantity) for quantity in BARS]
    rows = []
    for budget_input in found.inputs:
        dof = None
        if budget_input.dof is not None:
            dof = value_text(round(budget_input.dof))
        rows.append(
            (
                budget_input.name,
                budget_input.distribution,
                budget_input.standard_uncertainty,
                budget_input.unit,
                dof,
                budget_input.source,
            )
        )
    return Card("Budget", words=[*bars, table_of(rows, INPUT_COLUMNS, TWO_DIGITS)])


def statement(found: Certificate) -> str:
    """The statement of uncertainty, in a sentence or two."""
    parts = []
    for quantity, quantity_text in STATED:
        members = [figure for figure in found.figures if figure.quantity == quantity]
        if members:
            half = np.array([_half_width(figure) for figure in members])
            rms = float(np.sqrt((half**2).mean()))
            parts.append(f"{quantity_text} {rms:.2g} {members[0].unit}")
    return (
        "Expanded uncertainty (95 %), rms over the reference stars:"
        f" {', '.join(parts) or 'nothing could be stated'}."
    )


def _heads(found: Certificate, digest: str) -> Iterator[tuple[object, object]]:
    yield "number", found.number
    yield "made, valid until", f"{found.made}, {found.valid_until}"
    yield "bench file", Markup(f"{escaped(found.bench)} <code>{found.bench_sha256}</code>")
    yield "read by", found.read_by
    for name in ("who", "where", "ambient", "traceability"):
        yield name, getattr(found, name) or "not stated"
    if found.instrument:
        of = found.instrument
        size = f"U = {of['relative_expanded']:.2g} relative, k = {of['k']:g}"
        yield "instrument", f"{of['name']}, {of['date']}: {size}"
    yield "decision rule", RULES[found.decision]
    if found.replaces:
        yield "replaces", found.replaces
    code = f"<code>{digest}</code>"
    yield "certificate.json", Markup(f"SHA-256 {code}; signing it is the user's")
    yield "hilstar", found.hilstar


def _worst(found: Certificate) -> Iterator[tuple[object, ...]]:
    groups: dict[tuple[str, str], list[CertifiedFigure]] = defaultdict(list)
    for figure in found.figures:
        if figure.quantity in SHOWN or figure.quantity.startswith("star_"):
            groups[figure.quantity, figure.region].append(figure)
    for (quantity, region), members in groups.items():
        worst = max(members, key=_size)
        limit = None
        if worst.limit is not None:
            limit = f"{worst.limit:g} {worst.unit}"
        yield words_of(quantity), region, _value(worst), worst.k, limit, _judged(members)


def _judged(members: list[CertifiedFigure]) -> str | None:
    """The verdict on figures of a kind and region; None without limits."""
    judged = [figure.conforms for figure in members if figure.conforms is not None]
    if not judged:
        return None
    if all(judged):
        return "conforms"
    return f"{judged.count(False)} of {len(judged)} do not"


def _bars(found: Certificate, quantity: str) -> str:
    """The contributions to a kind of figure, rms over all of its figures, ranked."""
    squares: dict[str, float] = defaultdict(float)
    members = [figure for figure in found.figures if figure.quantity == quantity]
    for figure in members:
        for part in figure.contributions:
            squares[part.input] += part.standard_uncertainty**2 / len(members)
    ranked = sorted(squares.items(), key=lambda item: -item[1])[:MAX_BARS]
    if not ranked:
        return ""
    total = np.sqrt(sum(squares.values()))
    unit = members[0].unit
    finding = (
        f"{words_of(quantity)}: {total:.2g} {unit} standard uncertainty, of which {ranked[0][0]}"
        f" {np.sqrt(ranked[0][1]):.2g}"
    )
    with panels_of(finding, height_inch=1.1 + 0.3 * len(ranked)) as (axes,):
        colours = [BLUE if k == 0 else TEAL for k in range(len(ranked))]
        value_bars(
            axes,
            [f"{name} [{unit}]" for name, _ in ranked],
            [float(np.sqrt(value)) for _, value in ranked],
            colours,
        )
    return drawing_of(axes.figure, f"budget of {words_of(quantity)}")


def _both_ways(found: Certificate) -> Iterator[str]:
    both = [figure for figure in found.figures if figure.by_trials is not None]
    both = [figure for figure in both if figure.standard_uncertainty > 0]
    if not both:
        return
    ratio = np.array([_trials(figure).standard_uncertainty for figure in both])
    ratio /= [figure.standard_uncertainty for figure in both]
    stand = "the largest number of trials was reached"
    if found.two_digits_stand:
        stand = "two digits of every figure stand"
    yield (
        f"<p>{found.trials} trials of the whole model ({stand}): their standard uncertainty is"
        f" {ratio.min():.3f} to {ratio.max():.3f} of first order's.</p>"
    )
    apart = [figure for figure in both if _trials(figure).differs]
    if not apart:
        yield "<p>No interval differs by more than 5 %.</p>"
        return
    yield (
        f"<p>{len(apart)} figures differ by more than 5 % of the interval; the certificate states"
        " the trials'.</p>"
    )
    rows = []
    for figure in apart[:MAX_APART]:
        drawn = _trials(figure)
        half = figure.k * figure.standard_uncertainty
        ends = figure.value - half, figure.value + half, drawn.lower, drawn.upper
        rows.append((words_of(figure.quantity), figure.star or figure.region, *ends, drawn.differs))
    yield table_of(rows, APART_COLUMNS)


def _trials(figure: CertifiedFigure) -> ByTrials:
    assert figure.by_trials is not None
    return figure.by_trials


def text_lines(found: Certificate, digest: str, folder: Path) -> list[tuple[str, str]]:
    """The certificate as lines of a terminal: name and text."""
    lines = [
        ("number", found.number),
        ("verdict", VERDICTS[found.conforms][1]),
        ("uncertainty", statement(found)),
    ]
    for quantity in SHOWN:
        members = [figure for figure in found.figures if figure.quantity == quantity]
        if quantity in BY_THIRD:
            for region in THIRDS:
                there = [figure for figure in members if figure.region == region]
                lines += _worst_line(f"{quantity} {region}", there)
        else:
            lines += _worst_line(quantity, members)
    if found.cube is not None:
        lines.append(("cube to boresight", found.cube.line))
    lines += [("not assessed", reason) for reason in found.not_assessed]
    lines.append(("valid until", found.valid_until))
    lines.append(("sha256", digest))
    return [*lines, ("page", str(folder / "index.html"))]


def _worst_line(name: str, members: list[CertifiedFigure]) -> Iterator[tuple[str, str]]:
    """A line of the worst of some figures, to two digits of its uncertainty; none without any."""
    if not members:
        return
    worst = max(members, key=_size)
    half = _half_width(worst)
    places = 4
    if half > 0:
        places = max(1 - math.floor(math.log10(half)), 0)
    value = f"{round(worst.value, places) + 0.0:+.{places}f}"
    yield name, f"{value} +- {half:.{places}f} {worst.unit} (the worst of {len(members)})"
