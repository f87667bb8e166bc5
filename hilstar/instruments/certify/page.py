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
from hilstar.basics.html_pages import Markup, drawing_of, escaped, page_of, table_of
from hilstar.instruments.certify.model import THIRDS
from hilstar.server.bench.certificate import Certificate, CertifiedFigure

PRINTED = """<style>@page { size: A4; margin: 16mm } @media print {
body { margin: 0; max-width: none; font-size: 11px }
details { display: block } details > * { display: block } h2 { break-after: avoid }
tr, img, p { break-inside: avoid } }
.banner { border-left: .5rem solid; padding: .5rem 1rem; margin: 1rem 0; font-size: 1.1em }
</style>"""
VERDICTS = {
    True: ("#2e7d32", "Conforms"),
    False: ("#c62828", "Does not conform"),
    None: ("#0b62a4", "Stated, no limits"),
}
SHOWN = ("flux", "place_along", "place_across", "attitude_x", "attitude_y", "attitude_z", "latency")
BARS = ("flux", "place_along", "attitude_x", "star_flux")
MAX_BARS = 6
RULES = {
    "guard-band": "guard band: a figure conforms where its whole 95 % interval is within its limit",
    "simple": (
        "simple acceptance: a figure conforms where its value is within its limit, whatever its"
        " uncertainty"
    ),
}


def write_certificate_page(path: Path, found: Certificate, digest: str) -> None:
    """Write the page of a certificate whose JSON has this SHA-256. Raises InputError where it
    cannot be written.
    """
    colour, verdict = VERDICTS[found.conforms]
    missed = [each for each in found.figures if each.conforms is False]
    why = (
        f": {len(missed)} of {sum(each.conforms is not None for each in found.figures)} figures"
        if missed
        else ""
    )
    body = [
        PRINTED,
        (
            f'<p class="banner" style="border-color:{colour}"><b>{verdict}{why}</b>.'
            f" {escaped(statement(found))}</p>"
        ),
        table_of(_heads(found, digest)),
        (
            "<h2>Figures</h2><p>Worst of each kind and region: value and 95 % interval (coverage"
            " factor k by Student's t).</p>"
        ),
        table_of(
            list(_worst(found)),
            ("quantity", "region", "value", "from", "to", "unit", "k", "dof", "limit", "verdict"),
        ),
        table_of([(name, text) for name, text in found.measurands.items()]),
        "<h2>Budget</h2>",
        *(
            _bars(found, quantity)
            for quantity in BARS
            if any(each.quantity == quantity for each in found.figures)
        ),
        table_of(
            [
                (e.name, e.distribution, e.standard_uncertainty, e.unit, e.dof, e.source)
                for e in found.inputs
            ],
            ("input", "distribution", "standard uncertainty", "unit", "dof", "source"),
        ),
        "<h2>First order against trials</h2>",
        *_both_ways(found),
        "<h2>Not assessed</h2>",
        f"<ul>{''.join(f'<li>{escaped(each)}</li>' for each in found.not_assessed)}</ul>",
        "<h2>Identity</h2>",
        table_of([(f"monitor {key}", str(value)) for key, value in found.monitor.items()]),
        table_of([(f"collimator {key}", str(value)) for key, value in found.collimator.items()]),
        "<h2>Files</h2>",
        table_of(
            [(name, Markup(f"<code>{value}</code>")) for name, value in found.files.items()],
            ("file", "SHA-256"),
        ),
        f"<details><summary>All {len(found.figures)} figures</summary>",
        table_of(
            [
                (
                    e.quantity,
                    e.region,
                    e.star,
                    e.value,
                    e.standard_uncertainty,
                    e.lower,
                    e.upper,
                    e.unit,
                )
                for e in found.figures
            ],
            ("quantity", "region", "HIP", "value", "standard uncertainty", "from", "to", "unit"),
        ),
        "</details>",
    ]
    write_whole(path, page_of(f"Certificate {found.number}", body))


def statement(found: Certificate) -> str:
    """The statement of uncertainty, in a sentence or two."""
    parts = []
    for quantity, words in (
        ("flux", "a star's flux"),
        ("place_along", "its place"),
        ("attitude_x", "attitude across"),
    ):
        half = [
            (each.upper - each.lower) / 2 for each in found.figures if each.quantity == quantity
        ]
        unit = next((each.unit for each in found.figures if each.quantity == quantity), "")
        if half:
            parts.append(f"{words} {np.sqrt(np.mean(np.square(half))):.2g} {unit}")
    late = next((each for each in found.figures if each.quantity == "latency"), None)
    parts += [f"latency {(late.upper - late.lower) / 2:.2g} ms"] if late else []
    return (
        "Expanded uncertainty (95 %), rms over the reference stars:"
        f" {', '.join(parts) or 'nothing could be stated'}."
    )


def _heads(found: Certificate, digest: str) -> Iterator[tuple[object, ...]]:
    yield "number", found.number
    yield "made, valid until", f"{found.made}, {found.valid_until}"
    yield "bench file", Markup(f"{escaped(found.bench)} <code>{found.bench_sha256}</code>")
    yield "read by", found.read_by
    for name in ("who", "where", "ambient", "traceability"):
        yield name, getattr(found, name) or "not stated"
    if found.instrument:
        of = found.instrument
        yield (
            "instrument",
            (
                f"{of['name']}, {of['date']}: U = {of['relative_expanded']:.3g} relative, k ="
                f" {of['k']:g}"
            ),
        )
    yield "decision rule", RULES[found.decision]
    if found.replaces:
        yield "replaces", found.replaces
    yield "certificate.json", Markup(f"SHA-256 <code>{digest}</code>; signing it is the user's")
    yield "hilstar", found.hilstar


def _worst(found: Certificate) -> Iterator[tuple[object, ...]]:
    groups: dict[tuple[str, str], list[CertifiedFigure]] = defaultdict(list)
    for each in found.figures:
        if each.quantity in SHOWN or each.quantity.startswith("star_"):
            groups[each.quantity, each.region].append(each)
    for (quantity, region), members in groups.items():
        worst = max(members, key=lambda each: max(abs(each.lower), abs(each.upper)))
        judged = [each.conforms for each in members if each.conforms is not None]
        verdict = (
            None
            if not judged
            else "conforms"
            if all(judged)
            else f"{judged.count(False)} of {len(judged)} do not"
        )
        dof = "unlimited" if worst.dof is None else f"{worst.dof:.0f}"
        yield (
            quantity,
            region,
            worst.value,
            worst.lower,
            worst.upper,
            worst.unit,
            worst.k,
            dof,
            worst.limit,
            verdict,
        )


def _bars(found: Certificate, quantity: str) -> str:
    """The contributions to a kind of figure, rms over all of its figures, ranked."""
    squares: dict[str, float] = defaultdict(float)
    members = [each for each in found.figures if each.quantity == quantity]
    for each in members:
        for part in each.contributions:
            squares[part.input] += part.standard_uncertainty**2 / len(members)
    ranked = sorted(squares.items(), key=lambda item: -item[1])[:MAX_BARS]
    if not ranked:
        return ""
    total, unit = np.sqrt(sum(squares.values())), members[0].unit
    finding = (
        f"{quantity}: {total:.2g} {unit} standard uncertainty, of which {ranked[0][0]}"
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
    return drawing_of(axes.figure, f"budget of {quantity}")


def _both_ways(found: Certificate) -> Iterator[str]:
    both = [
        each
        for each in found.figures
        if each.by_trials is not None and each.standard_uncertainty > 0
    ]
    if not both:
        return
    ratio = np.array(
        [
            each.by_trials.standard_uncertainty / each.standard_uncertainty
            for each in both
            if each.by_trials
        ]
    )
    stand = (
        "two digits of every figure stand"
        if found.two_digits_stand
        else "the largest number of trials was reached"
    )
    yield (
        f"<p>{found.trials} trials of the whole model ({stand}): their standard uncertainty is"
        f" {ratio.min():.3f} to {ratio.max():.3f} of first order's.</p>"
    )
    apart = [each for each in both if each.by_trials and each.by_trials.differs]
    rows = [
        (e.quantity, e.star or e.region,
         e.value - e.k * e.standard_uncertainty, e.value + e.k * e.standard_uncertainty,
         e.by_trials.lower, e.by_trials.upper, e.by_trials.differs)
        for e in apart[:20] if e.by_trials
    ]  # fmt: skip
    if rows:
        yield (
            f"<p>{len(apart)} figures differ by more than 5 % of the interval; the certificate"
            " states the trials'.</p>"
        )
        yield table_of(
            rows, ("quantity", "of", "first order from", "to", "trials from", "to", "why")
        )
    else:
        yield "<p>No interval differs by more than 5 %.</p>"


def text_lines(found: Certificate, digest: str, folder: Path) -> list[tuple[str, str]]:
    """The certificate as lines of a terminal: name and text."""
    lines = [
        ("number", found.number),
        ("verdict", VERDICTS[found.conforms][1]),
        ("uncertainty", statement(found)),
    ]
    for quantity in SHOWN:
        for region in (*THIRDS, None):
            members = [
                e for e in found.figures if e.quantity == quantity and region in (None, e.region)
            ]
            if not members or (region is None) == (
                quantity in ("flux", "place_along", "place_across")
            ):
                continue
            each = max(members, key=lambda e: max(abs(e.lower), abs(e.upper)))
            half = (each.upper - each.lower) / 2
            # two digits of the uncertainty
            places = max(1 - math.floor(math.log10(half)), 0) if half > 0 else 4
            value = f"{round(each.value, places) + 0.0:+.{places}f}"
            text = f"{value} +- {half:.{places}f} {each.unit} (the worst of {len(members)})"
            lines.append((f"{quantity} {region or ''}".strip(), text))
    lines += [("not assessed", each) for each in found.not_assessed]
    return [
        *lines,
        ("valid until", found.valid_until),
        ("sha256", digest),
        ("page", str(folder / "index.html")),
    ]
