"""Pages that need no other file: the operator's page's colours, light, dark and on paper, with
cards, tables and pictures.
"""

import base64
import html
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hilstar.basics.charts import svg
from hilstar.basics.palette import declarations

DIGITS = 4
STYLE = Path(__file__).with_suffix(".css")


class Markup(str):
    """Text of a page that is HTML already."""

    __slots__ = ()


def page_of(title: str, body: Iterable[str]) -> bytes:
    """A whole page."""
    shape = "--radius: 12px;"
    style = (
        f":root {{ color-scheme: light dark; {shape} {declarations('light')} }}\n"
        f"@media screen and (prefers-color-scheme: dark) {{ :root {{ {declarations('dark')} }} }}\n"
        f"{STYLE.read_text()}"
    )
    head = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escaped(title)}</title><style>{style}</style></head>"
    )
    text = "\n".join((f"{head}<body><h1>{escaped(title)}</h1>", *body, "</body></html>\n"))
    return text.encode(errors="replace")


def escaped(value: object) -> str:
    """A value as text of a page."""
    return value if isinstance(value, Markup) else html.escape(str(value))


def banner_of(state: str, headline: str, words: object = "") -> str:
    """The verdict of a page; its state is ok, warn or bad."""
    more = f"<span>{escaped(words)}</span>" if words else ""
    return (
        '<div class="health"'
        f' data-state="{state}"><div><strong>{escaped(headline)}</strong>{more}</div></div>'
    )


def measured(value: float, error: float | None, unit: str = "") -> str:
    """A value with its standard error to two digits of that."""
    if error is None or not math.isfinite(error) or error <= 0:
        return f"{value:.4g} {unit}".rstrip()
    digits = 1 - math.floor(math.log10(error))
    both = " \N{PLUS-MINUS SIGN} ".join(
        f"{round(each, digits):,.{max(digits, 0)}f}" for each in (value, error)
    )
    return f"{both.replace(',', chr(0x202F))} {unit}".rstrip()


def table_of(
    rows: Iterable[Sequence[object]], header: Sequence[str] = (), digits: int = DIGITS
) -> str:
    """A table; None is a dash, and numbers stand at the right."""
    head = "".join(f"<th>{escaped(name)}</th>" for name in header)
    body = "".join(f"<tr>{''.join(_cell(value, digits) for value in row)}</tr>" for row in rows)
    return (
        f'<div class="wide-table"><table>{f"<tr>{head}</tr>" if header else ""}{body}</table></div>'
    )


def _cell(value: object, digits: int) -> str:
    if isinstance(value, float | int):
        return f'<td class="n">{f"{value:.{digits}g}" if isinstance(value, float) else value}</td>'
    return f"<td>{'-' if value is None else escaped(value)}</td>"


def picture_of(data: bytes, kind: str, alt: str) -> str:
    """A picture of a media type (image/KIND) within the page."""
    return (
        f'<figure><img alt="{escaped(alt)}"'
        f' src="data:image/{kind};base64,{base64.b64encode(data).decode()}"></figure>'
    )


def drawing_of(figure: Any, alt: str) -> str:
    """A figure of matplotlib's within the page."""
    return picture_of(svg(figure).encode(), "svg+xml", alt)
