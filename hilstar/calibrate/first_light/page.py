"""The session on one page that needs nothing beside it: verdicts, figures, pictures, what changed, and hashes."""

from __future__ import annotations

import base64
import difflib
import html
from collections.abc import Iterable, Iterator
from pathlib import Path

from hilstar.calibrate.first_light.records import PAGE_FILE, Figure, Record, SessionFile
from hilstar.errors import InputError
from hilstar.files import write_whole
from hilstar.reading import MAX_TOML_BYTES, read_bytes, read_text
from hilstar.run.sync.advice import beat_line

MAX_PICTURE_BYTES = 50_000_000
MAX_FILES_LISTED = 12  # of a step; the others are counted, and stand in session.json
COLOURS = {"done": "#2e7d32", "skipped": "#8a6d00", "failed": "#c62828"}
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }}
h1 {{ margin-bottom: 0; }} h2 {{ margin-top: 2.5rem; }}
table {{ border-collapse: collapse; margin: 1rem 0; }}
td, th {{ padding: .2rem 1rem .2rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid #e4e4e4; }}
code, pre {{ font: 13px/1.45 ui-monospace, monospace; overflow-wrap: anywhere; }}
pre {{ background: #f6f6f6; padding: .8rem; white-space: pre-wrap; }}
img {{ max-width: 100%; }}
.verdict {{ color: #fff; border-radius: .3rem; padding: .1rem .5rem; font-size: .85em; }}
.small {{ color: #666; font-size: .9em; }}
</style></head><body>
<h1>{title}</h1>
{body}
</body></html>
"""


def write_page(folder: Path, session: SessionFile, before: Path) -> Path:
    """Write the page of a session, with its bench file as it was and as it is. Raises InputError where it cannot be written."""
    bench = Path(session.bench)
    body = [
        f'<p class="small">hilstar {_text(session.hilstar)}; images: {_text(session.seen_by)}</p>',
        _overview(session.steps),
        *(f"<p>{_text(line)}</p>" for line in [None if session.beat is None else beat_line(session.beat)] if line),
        *(part for record in session.steps for part in _step(folder, record)),
        "<h2>The bench file</h2>",
        f"<p>{_text(bench)}, SHA-256 <code>{session.bench_sha256}</code></p>",
        f"<pre>{_text(_difference(before, bench))}</pre>",
    ]
    path = folder / PAGE_FILE
    write_whole(path, PAGE.format(title=f"First light of {_text(bench.name)}", body="\n".join(body)).encode(errors="replace"))
    return path


def _overview(steps: Iterable[Record]) -> str:
    rows = [
        f"<tr><td><a href='#{record.name}'>{record.name}</a></td><td>{_badge(record)}</td><td>{_text(record.line)}</td></tr>"
        for record in steps
    ]
    return f"<table>{''.join(rows)}</table>"


def _badge(record: Record) -> str:
    return f'<span class="verdict" style="background:{COLOURS[record.verdict]}">{record.verdict}</span>'


def _step(folder: Path, record: Record) -> Iterator[str]:
    yield f'<h2 id="{record.name}">{record.name} {_badge(record)}</h2>'
    yield f'<p>{_text(record.line)}</p><p class="small">{_text(record.ended)}, {record.seconds:.1f} s</p>'
    if record.changes:
        yield f"<p>In the bench file: {'; '.join(f'<code>{_text(change.line)}</code>' for change in record.changes)}</p>"
    yield from (_picture(folder / name) for name in record.pictures)
    if record.figures:
        yield _table((name, _figure(value)) for name, value in record.figures.items())
    if record.files:
        listed = list(record.files.items())[:MAX_FILES_LISTED]
        more = len(record.files) - len(listed)
        yield _table((name, f"<code>{digest}</code>") for name, digest in listed)
        yield f'<p class="small">and {more} files more, in session.json</p>' if more else ""


def _table(rows: Iterable[tuple[str, str]]) -> str:
    return f"<table>{''.join(f'<tr><td>{_text(name)}</td><td>{value}</td></tr>' for name, value in rows)}</table>"


def _figure(value: Figure) -> str:
    return _text(f"{value:.6g}" if isinstance(value, float) else value)


def _picture(path: Path) -> str:
    try:
        data = base64.b64encode(read_bytes(path, "", MAX_PICTURE_BYTES)).decode()
    except InputError as error:
        return f"<p>{_text(error)}</p>"
    return f'<p><img alt="{_text(path.stem)}" src="data:image/png;base64,{data}"></p>'


def _difference(before: Path, after: Path) -> str:
    """The bench file's lines that changed, with their neighbours."""
    old, new = (read_text(path, "", MAX_TOML_BYTES).splitlines() for path in (before, after))
    lines = list(difflib.unified_diff(old, new, "before", "now", lineterm=""))
    return "\n".join(lines) or "nothing was changed"


def _text(value: object) -> str:
    return html.escape(str(value))
