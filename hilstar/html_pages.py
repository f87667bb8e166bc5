"""Pages that need no other file: the operator's page's colours, light, dark and on paper, with cards, tables and pictures."""

import base64
import html
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

DIGITS = 4
COLOURS = Path(__file__).resolve().parent / "console" / "page" / "page.css"  # their one place
STYLE = """
* { box-sizing: border-box }
body { font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", "DejaVu Sans", sans-serif; max-width: 1180px;
  margin: 0 auto; padding: 20px 16px 40px; color: var(--text); background: var(--ground); overflow-wrap: break-word }
h1 { font-size: 22px; line-height: 1.25; margin: 4px 0 12px } h2 { font-size: 18px; line-height: 1.3; margin: 28px 0 8px }
p { margin: 8px 0 } figure { margin: 10px 0 } a { color: var(--accent) }
.wide-table { overflow-x: auto; margin: 10px 0 } table { border-collapse: collapse }
td, th { padding: 4px 16px 4px 0; border-bottom: 1px solid var(--line); vertical-align: top; text-align: left }
th { color: var(--muted); font-weight: 500 } td.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
code, pre { font: 13px/1.45 ui-monospace, Menlo, monospace; overflow-wrap: anywhere; white-space: pre-wrap }
img { max-width: 100%; height: auto; border-radius: 8px; vertical-align: top }
.note, pre { background: var(--raised); border: 1px solid var(--line); border-radius: 8px; padding: 8px 12px; margin: 8px 0 }
.small { font-size: 13px; color: var(--muted) } .verdict { color: #fff; border-radius: 6px; padding: 1px 8px }
.health { display: flex; gap: 14px; align-items: center; margin: 12px 0; padding: 12px 18px; border-radius: var(--radius);
  color: var(--ok); background: var(--ok-ground); border: 1px solid var(--ok-edge) }
.health strong { display: block; font-size: 20px; line-height: 1.25 } .health span { color: var(--text) }
.health[data-state="bad"], .health[data-state="bad"] span { color: var(--bad-text) }
.health[data-state="bad"] { background: var(--bad-ground); border-color: var(--bad-ground) }
.health[data-state="warn"] { color: var(--warn); background: var(--panel); border-color: var(--warn) }
.chip { font-size: 13px; font-weight: 650; border-radius: 999px; padding: 2px 11px; border: 1px solid; white-space: nowrap }
[data-state="ok"] > .chip { color: var(--ok) } [data-state="warn"] > .chip { color: var(--warn) }
[data-state="bad"] > .chip { color: var(--bad-text); background: var(--bad-ground); border-color: var(--bad-ground) }
.steps { display: flex; flex-wrap: wrap; gap: 8px; margin: 12px 0 } .steps a { text-decoration: none }
.card { background: var(--panel); border: 1px solid var(--line); border-radius: var(--radius); padding: 14px 18px;
  margin: 14px 0; display: grid; gap: 4px 24px; grid-template-columns: minmax(0, 1fr); break-inside: avoid }
.card > header { display: flex; flex-wrap: wrap; gap: 4px 12px; align-items: center; justify-content: space-between }
.card h2 { margin: 0 } .card > .words > :first-child { margin-top: 0 }
.number { font-size: 28px; line-height: 1.2; font-weight: 600; font-variant-numeric: tabular-nums; margin: 10px 0 }
.number small { display: block; font-size: 13.5px; font-weight: 400; color: var(--muted); margin-top: 2px }
details { margin: 8px 0 } summary { cursor: pointer; color: var(--accent) }
@media screen and (min-width: 900px), print { .card.pictured { grid-template-columns: minmax(0, 2fr) minmax(0, 3fr) }
  .card > header, .card > details { grid-column: 1 / -1 } .card figure { margin: 0 } }
@media (max-width: 600px) { body { font-size: 14px; padding: 12px 10px 30px } .card { padding: 12px }
  td, th { padding-right: 10px } }
@media print { @page { size: A4; margin: 14mm } a { color: inherit }
  body { font-size: 12px; padding: 0; max-width: none; background: none } * { print-color-adjust: exact }
  details:not([open]) { display: none } .number { font-size: 20px } .card { padding: 10px 12px }
  .wide-table { overflow: visible } table { font-size: 11px } td, th { padding-right: 8px }
  img, figure, tr, .note, .health { break-inside: avoid } img { max-height: 235mm } h1, h2 { break-after: avoid } }
"""


class Markup(str):
    """Text of a page that is HTML already."""

    __slots__ = ()


def page_of(title: str, body: Iterable[str]) -> bytes:
    """A whole page."""
    dark, light = (
        found.group(1) for found in re.finditer(r"^:root[^{]*\{(.*?)\}", COLOURS.read_text(), re.MULTILINE | re.DOTALL)
    )
    style = f":root {{ color-scheme: light dark; {_plain(dark)} {_plain(light)} }}"  # light lacks what both themes share
    style += f"@media screen and (prefers-color-scheme: dark) {{ :root {{ {_plain(dark)} }} }}{STYLE}"
    head = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escaped(title)}</title><style>{style}</style></head>"
    )
    text = "\n".join((f"{head}<body><h1>{escaped(title)}</h1>", *body, "</body></html>\n"))
    return text.encode(errors="replace")


def _plain(block: str) -> str:
    """The colours of a theme, without its scheme and font."""
    return " ".join(re.findall(r"--[\w-]+: [^;]+;", block))


def escaped(value: object) -> str:
    """A value as text of a page."""
    return value if isinstance(value, Markup) else html.escape(str(value))


def banner_of(state: str, headline: str, words: object = "") -> str:
    """The verdict of a page; its state is ok, warn or bad."""
    more = f"<span>{escaped(words)}</span>" if words else ""
    return f'<div class="health" data-state="{state}"><div><strong>{escaped(headline)}</strong>{more}</div></div>'


def measured(value: float, error: float | None, unit: str = "") -> str:
    """A value with its standard error to two digits of that."""
    if error is None or not math.isfinite(error) or error <= 0:
        return f"{value:.4g} {unit}".rstrip()
    digits = 1 - math.floor(math.log10(error))
    both = " \N{PLUS-MINUS SIGN} ".join(f"{round(each, digits):,.{max(digits, 0)}f}" for each in (value, error))
    return f"{both.replace(',', chr(0x202F))} {unit}".rstrip()


def table_of(rows: Iterable[Sequence[object]], header: Sequence[str] = (), digits: int = DIGITS) -> str:
    """A table; None is a dash, and numbers stand at the right."""
    head = "".join(f"<th>{escaped(name)}</th>" for name in header)
    body = "".join(f"<tr>{''.join(_cell(value, digits) for value in row)}</tr>" for row in rows)
    return f'<div class="wide-table"><table>{f"<tr>{head}</tr>" if header else ""}{body}</table></div>'


def _cell(value: object, digits: int) -> str:
    if isinstance(value, float | int):
        return f'<td class="n">{f"{value:.{digits}g}" if isinstance(value, float) else value}</td>'
    return f"<td>{'-' if value is None else escaped(value)}</td>"


def picture_of(data: bytes, kind: str, alt: str) -> str:
    """A picture of a media type (image/KIND) within the page."""
    return f'<figure><img alt="{escaped(alt)}" src="data:image/{kind};base64,{base64.b64encode(data).decode()}"></figure>'
