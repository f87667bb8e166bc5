"""The builder of every page that needs no other file: a verdict, key figures, sections, tables and
pictures.

A page is `page_of` a title, a `Verdict` and parts. A part is HTML: `Card.html`, `figures_of`,
`table_of`, `drawing_of`. A page follows the reader's light or dark, and is light on paper. A run's
report has its own layout and the same palette, light on paper too.
"""

import base64
import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilstar.basics import charts
from hilstar.basics.palette import declarations

DIGITS = 4
MAX_FIGURE_CHARACTERS = 40  # of a figure with its uncertainty; more are a sentence
STYLE = Path(__file__).with_suffix(".css")
SHAPE = "--radius: 12px;"
PLUS_MINUS, DASH, THIN_SPACE = "\N{PLUS-MINUS SIGN}", "\N{EM DASH}", "\N{NARROW NO-BREAK SPACE}"
TIMES = "\N{MULTIPLICATION SIGN}"
# Of keys, the longest first: what a key ends with, and its unit as a page writes it.
KEY_UNITS = (
    ("_percent_per_h", "%/h"),
    ("_cd_m2", "cd/m\N{SUPERSCRIPT TWO}"),
    ("_e_per_s", "e-/s"),
    ("_deg_s", "deg/s"),
    ("_arcsec", "arcsec"),
    ("_percent", "%"),
    ("_deg", "deg"),
    ("_mag", "mag"),
    ("_min", "min"),
    ("_ppm", "ppm"),
    ("_dn", "DN"),
    ("_hz", "Hz"),
    ("_mm", "mm"),
    ("_um", "\N{MICRO SIGN}m"),
    ("_nm", "nm"),
    ("_ms", "ms"),
    ("_px", "px"),
    ("_c", "\N{DEGREE SIGN}C"),
    ("_k", "K"),
    ("_s", "s"),
)
# Parts of keys that a person does not read as words.
KEY_WORDS = {
    "psf": "PSF",
    "p95": "at 95 %",
    "dof": "degrees of freedom",
    "q": "quaternion",
    "gl": "OpenGL",
}
# A table wider than its page is moved by the keyboard, too.
WIDE_TABLE = '<div class="wide-table" tabindex="0" role="group" aria-label="Table">'
UNITS = dict(KEY_UNITS)
MIN_PLAIN = 1e-4  # smaller numbers are written as powers of ten
ERROR = "_error"  # of keys: `drift_error_ms` is the standard error of `drift_ms`
OK, WARN, BAD, PLAIN = "ok", "warn", "bad", "plain"  # the states of verdicts, chips and figures


class Markup(str):
    """Text of a page that is HTML already."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Verdict:
    """The band under a page's title; its state is OK, WARN, BAD or PLAIN."""

    state: str
    headline: str
    words: str = ""

    def html(self) -> str:
        """The band."""
        more = ""
        if self.words:
            more = f"<span>{escaped(self.words)}</span>"
        headline = f"<strong>{escaped(self.headline)}</strong>"
        return f'<div class="health" data-state="{self.state}"><div>{headline}{more}</div></div>'


@dataclass(frozen=True, slots=True)
class KeyFigure:
    """A figure that is seen first: its text with its uncertainty and unit, and what it is of."""

    text: str
    of: str
    state: str = PLAIN

    def html(self) -> str:
        """The figure, over what it is of."""
        of = f"<small>{escaped(self.of)}</small>"
        return f'<p class="number" data-state="{self.state}">{escaped(self.text)}{of}</p>'


@dataclass(frozen=True, slots=True)
class Card:
    """A section of a page: a figure, words and tables at the left, one picture at the right, and
    details that are folded.

    `words`, `picture` and `details` are HTML. `cure` says what to do, where something is to be
    done. A `chip` is a verdict in a word, coloured by `state`.
    """

    title: str
    figure: KeyFigure | None = None
    words: Sequence[str] = ()
    picture: str = ""
    cure: str = ""
    details: Sequence[str] = ()
    chip: str = ""
    state: str = PLAIN
    anchor: str = ""

    def html(self) -> str:
        """The section."""
        parts = [f"<section{self._attributes()}>", self._head()]
        parts.append('<div class="words">')
        if self.figure is not None:
            parts.append(self.figure.html())
        parts += self.words
        if self.cure:
            parts.append(f'<p class="note"><b>What to do:</b> {escaped(self.cure)}</p>')
        parts.append("</div>")
        if self.picture:
            parts.append(self.picture)
        if self.details:
            parts.append(details_of("Details", *self.details))
        parts.append("</section>")
        return "\n".join(parts)

    def _attributes(self) -> str:
        kind = "card"
        if self.picture:
            kind = "card pictured"
        anchor = ""
        if self.anchor:
            anchor = f' id="{escaped(self.anchor)}"'
        return f' class="{kind}"{anchor}'

    def _head(self) -> str:
        chip = ""
        if self.chip:
            chip = f'<span class="chip">{escaped(self.chip)}</span>'
        title = f"<h2>{escaped(self.title)}</h2>"
        return f'<div class="head" data-state="{self.state}">{title}{chip}</div>'


def page_of(title: str, verdict: Verdict, parts: Iterable[str], script: str = "") -> bytes:
    """A whole page in UTF-8: title, verdict and parts in its main landmark; `script` stands
    last.
    """
    head = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escaped(title)}</title><style>{page_style()}</style></head>"
    )
    lines = [f"{head}<body><main><h1>{escaped(title)}</h1>", verdict.html(), *parts, "</main>"]
    if script:
        lines.append(f"<script>{script}</script>")
    lines.append("</body></html>\n")
    return "\n".join(lines).encode(errors="replace")


def page_style() -> str:
    """The style sheet of a page: the palette by the reader's theme, light on paper."""
    light = declarations("light")
    dark = declarations("dark")
    return (
        f":root {{ color-scheme: light dark; {SHAPE} {light} }}\n"
        f"@media screen and (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}\n"
        "@media print { :root { color-scheme: light } }\n"
        f"{STYLE.read_text(encoding='utf-8')}"
    )


def escaped(value: object) -> str:
    """A value as text of a page."""
    if isinstance(value, Markup):
        return value
    return html.escape(str(value)).replace(" +- ", f" {PLUS_MINUS} ")


def key_words(key: str) -> str:
    """A key as a person reads it: `drift_ms` is "drift, ms"."""
    name, ending = split_key(key)
    if ending:
        return f"{_words(name)}, {UNITS[ending]}"
    return _words(name)


def key_name(key: str) -> str:
    """A key as a person reads it, without its unit."""
    return _words(split_key(key)[0])


def split_key(key: str) -> tuple[str, str]:
    """A key without the ending that is its unit, and that ending, "" without one."""
    for ending, _ in KEY_UNITS:
        if key.endswith(ending):
            return key.removesuffix(ending), ending
    return key, ""


def _words(key: str) -> str:
    return " ".join(KEY_WORDS.get(word, word) for word in key.split("_"))


def keyed_rows(figures: Mapping[str, object]) -> list[tuple[str, str]]:
    """Figures by key as rows of a table: the key in words, and its value with error and unit.

    The error of `drift_ms` is `drift_error_ms`, which then has no row. What is empty has none.
    """
    rows = []
    for key, value in figures.items():
        name, ending = split_key(key)
        if f"{name.removesuffix(ERROR)}{ending}" in figures and name.endswith(ERROR):
            continue
        if value is None or value in ("", {}):
            continue
        error = figures.get(f"{name}{ERROR}{ending}")
        rows.append((_words(name), value_text(value, error, UNITS.get(ending, ""))))
    return rows


def value_text(value: object, error: object = None, unit: str = "") -> str:
    """A value as a page writes it: numbers to four digits, or to two of their error; sizes
    as "1920 x 1080".
    """
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        if isinstance(error, (int, float)) and math.isfinite(error) and error > 0:
            return measured(value, error, unit)
        return f"{_number(value)} {unit}".rstrip()
    if isinstance(value, (list, tuple)):
        between = f" {TIMES} " if len(value) == 2 else ", "
        texts = between.join(value_text(part) for part in value)
        return f"{texts} {unit}".rstrip()
    if isinstance(value, Mapping):
        return "; ".join(f"{_words(str(key))} {value_text(part)}" for key, part in value.items())
    return str(value)


def _number(value: float) -> str:
    """A number to four digits, whole ones whole, and very small ones as a power of ten."""
    size = abs(value)
    if math.isfinite(value) and size >= 10**DIGITS:
        digits = DIGITS - 1 - math.floor(math.log10(size))
        return _rounded(value, 0 if isinstance(value, int) else digits)
    if isinstance(value, int):
        return str(value)
    if 0 < size < MIN_PLAIN:
        return charts.two_digits(value)
    return f"{value:.{DIGITS}g}"


def paragraph(text: object, kind: str = "") -> str:
    """A paragraph; its kind is small, note or none."""
    if kind:
        return f'<p class="{kind}">{escaped(text)}</p>'
    return f"<p>{escaped(text)}</p>"


def list_of(items: Iterable[object]) -> str:
    """A list of texts."""
    lines = "".join(f"<li>{escaped(item)}</li>" for item in items)
    return f"<ul>{lines}</ul>"


def side_by_side(cards: Iterable[Card]) -> str:
    """Cards without pictures, two beside each other where there is room."""
    sections = "".join(card.html() for card in cards)
    return f'<div class="pair">{sections}</div>'


def details_of(summary: str, *parts: str, printed: bool = False) -> str:
    """Parts that are folded; on paper they are left out unless they are to be printed."""
    kind = ""
    if printed:
        kind = ' class="printed"'
    return f"<details{kind}><summary>{escaped(summary)}</summary>{''.join(parts)}</details>"


def figures_of(figures: Iterable[KeyFigure]) -> str:
    """Key figures beside each other."""
    tiles = "".join(figure.html() for figure in figures)
    return f'<div class="figures">{tiles}</div>'


def measured(value: float, error: float | None, unit: str = "") -> str:
    """A value with its standard error to two digits of that."""
    if error is None or not math.isfinite(error) or error <= 0:
        return f"{value:.4g} {unit}".rstrip()
    digits = 1 - math.floor(math.log10(error))
    both = f" {PLUS_MINUS} ".join(_rounded(part, digits) for part in (value, error))
    return f"{both} {unit}".rstrip()


def within(value: float, low: float, high: float, unit: str = "") -> str:
    """A value with its interval, to two digits of the interval's half width."""
    half = (high - low) / 2
    if not math.isfinite(half) or half <= 0:
        return f"{value:.4g} {unit}".rstrip()
    digits = 1 - math.floor(math.log10(half))
    shown, first, last = (_rounded(figure, digits) for figure in (value, low, high))
    return f"{shown} ({first} to {last}) {unit}".rstrip()


def _rounded(value: float, digits: int) -> str:
    text = f"{round(value, digits) + 0.0:,.{max(digits, 0)}f}"
    return text.replace(",", THIN_SPACE)


def key_table(rows: Iterable[tuple[object, object]]) -> str:
    """A table of names and texts, without a header; both stand at the left."""
    lines = []
    for name, text in rows:
        lines.append(f'<tr><th scope="row">{escaped(name)}</th><td>{escaped(text)}</td></tr>')
    body = "".join(lines)
    return f'{WIDE_TABLE}<table class="keys">{body}</table></div>'


def table_of(
    rows: Iterable[Sequence[object]], header: Sequence[str] = (), digits: int = DIGITS
) -> str:
    """A table, without the columns that have a header and no value.

    None is an empty cell, and numbers stand at the right.
    """
    table = [list(row) for row in rows]
    columns = range(max((len(row) for row in table), default=0))
    if header:
        columns = range(len(header))
    shown = [column for column in columns if not header or _has_values(table, column)]
    lines = []
    if header:
        cells = "".join(f'<th scope="col">{escaped(header[column])}</th>' for column in shown)
        lines.append(f"<tr>{cells}</tr>")
    for row in table:
        cells = "".join(_cell(row[column], digits) for column in shown if column < len(row))
        lines.append(f"<tr>{cells}</tr>")
    body = "".join(lines)
    return f"{WIDE_TABLE}<table>{body}</table></div>"


def _has_values(table: list[list[object]], column: int) -> bool:
    return any(row[column] is not None and row[column] != "" for row in table)


def _cell(value: object, digits: int) -> str:
    if isinstance(value, float):
        return f'<td class="n">{value:.{digits}g}</td>'
    if isinstance(value, int):
        return f'<td class="n">{value}</td>'
    if value is None:
        return "<td></td>"
    text = escaped(value)
    if PLUS_MINUS in text and len(text) < MAX_FIGURE_CHARACTERS:
        return f'<td class="n">{text}</td>'
    return f"<td>{text}</td>"


def picture_of(data: bytes, kind: str, alt: str) -> str:
    """A picture of a media type (image/KIND) within the page."""
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return f'<figure><img alt="{escaped(alt)}" src="{source}"></figure>'


def drawing_of(figure: Any, alt: str) -> str:
    """A figure of matplotlib's within the page."""
    return picture_of(charts.svg(figure).encode(), "svg+xml", alt)
