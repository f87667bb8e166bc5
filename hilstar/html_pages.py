"""Pages that need no other file: one style, light and dark, with tables and pictures."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence

from hilstar.charts import DARK, GRID, INK, PAPER

DIGITS = 4
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
:root {{ color-scheme: light dark; --ink: {ink}; --paper: {paper}; --rule: {rule}; --note: #fff6df }}
@media (prefers-color-scheme: dark) {{ :root {{
  --ink: {dark_ink}; --paper: {dark_paper}; --rule: {dark_rule}; --note: #3d3520 }} }}
body {{ font: 15px/1.45 sans-serif; max-width: 1020px; margin: 2em auto; padding: 0 1em;
  color: var(--ink); background: var(--paper) }}
table {{ border-collapse: collapse; margin: 1em 0 }}
td, th {{ padding: 3px 14px 3px 0; border-bottom: 1px solid var(--rule); vertical-align: top; text-align: left }}
td.n {{ text-align: right; font-variant-numeric: tabular-nums }}
code, pre {{ font: 13px/1.45 ui-monospace, monospace; overflow-wrap: anywhere; white-space: pre-wrap }}
img {{ max-width: 100% }}
.note, pre {{ background: var(--note); padding: .4em .8em; margin: .4em 0 }}
.verdict {{ color: #fff; border-radius: .3rem; padding: .1rem .5rem }}
.small {{ font-size: .9em; opacity: .75 }}
</style></head><body><h1>{title}</h1>{body}</body></html>
"""
COLOURS = {"ink": INK, "paper": PAPER, "rule": GRID}
COLOURS |= {f"dark_{name}": DARK[colour] for name, colour in COLOURS.items()}


class Markup(str):
    """Text of a page that is HTML already."""

    __slots__ = ()


def page_of(title: str, body: Iterable[str]) -> bytes:
    """A whole page."""
    return PAGE.format(title=escaped(title), body="\n".join(body), **COLOURS).encode(errors="replace")


def escaped(value: object) -> str:
    """A value as text of a page."""
    return value if isinstance(value, Markup) else html.escape(str(value))


def table_of(rows: Iterable[Sequence[object]], header: Sequence[str] = (), digits: int = DIGITS) -> str:
    """A table; None is a dash, and numbers stand at the right."""
    head = "".join(f"<th>{escaped(name)}</th>" for name in header)
    body = "".join(f"<tr>{''.join(_cell(value, digits) for value in row)}</tr>" for row in rows)
    return f"<table>{f'<tr>{head}</tr>' if header else ''}{body}</table>"


def _cell(value: object, digits: int) -> str:
    if isinstance(value, float | int):
        return f'<td class="n">{f"{value:.{digits}g}" if isinstance(value, float) else value}</td>'
    return f"<td>{'-' if value is None else escaped(value)}</td>"


def picture_of(data: bytes, kind: str, alt: str) -> str:
    """A picture of a media type (image/KIND) within the page."""
    return f'<p><img alt="{escaped(alt)}" src="data:image/{kind};base64,{base64.b64encode(data).decode()}"></p>'
