"""The page of a session, first-light.html: a verdict, a card for each step, and what changed in
the bench file.
"""

import difflib
from collections.abc import Iterator
from pathlib import Path

from hilstar.basics.charts import capital
from hilstar.basics.errors import InputError
from hilstar.basics.files import write_whole
from hilstar.basics.html_pages import (
    Markup,
    banner_of,
    escaped,
    measured,
    page_of,
    picture_of,
    table_of,
)
from hilstar.basics.reading import MAX_TOML_BYTES, read_bytes, read_text
from hilstar.instruments.calibrate.first_light.context import SessionFile, StepRecord
from hilstar.instruments.calibrate.first_light.session import STEPS, SessionStep
from hilstar.server.sync import beat_line

PAGE_FILE = "first-light.html"
MAX_PICTURE_BYTES = 50_000_000
MAX_FILES_LISTED = 12  # per step; the others are counted here, and listed in session.json
STATES = {"done": "ok", "skipped": "warn", "failed": "bad"}
WORDS = {"done": "passed", "skipped": "not measured", "failed": "failed"}


def write_page(folder: Path, session: SessionFile, before: Path) -> Path:
    """Write the page of a session, with its bench file as it was and as it is. Raises InputError
    where it cannot be written.
    """
    bench, records = Path(session.bench), {record.name: record for record in session.steps}
    old, new = (read_text(path, "", MAX_TOML_BYTES).splitlines() for path in (before, bench))
    difference = "\n".join(difflib.unified_diff(old, new, "before", "now", lineterm=""))
    beats = None if session.beat is None else beat_line(session.beat)
    body = [
        _banner(session.steps),
        *(banner_of("bad", "Forced", each) for each in session.forced),
        f'<nav class="steps">{"".join(_link(record) for record in session.steps)}</nav>',
        *(
            _card(folder, step, records[step.name], session)
            for step in STEPS
            if step.name in records
        ),
        '<section class="card"><header><h2>The bench file</h2></header><div class="words">',
        f"<p>{escaped(beats)}</p>" if beats else "",
        f"<pre>{escaped(difference or 'nothing was changed')}</pre></div>",
        (
            f"<details><summary>Details</summary><p>{escaped(bench)}, SHA-256"
            f" <code>{session.bench_sha256}</code></p>"
        ),
        (
            f"<p>hilstar {escaped(session.hilstar)}; images:"
            f" {escaped(session.seen_by)}</p></details></section>"
        ),
    ]
    path = folder / PAGE_FILE
    write_whole(path, page_of(f"First light of {bench.name}", body))
    return path


def _banner(records: list[StepRecord]) -> str:
    by = {verdict: [each.name for each in records if each.verdict == verdict] for verdict in WORDS}
    passed = f"{len(by['done'])} of {len(records)} steps passed"
    missed = f"; not measured: {', '.join(by['skipped'])}" if by["skipped"] else ""
    if by["failed"]:
        return banner_of(
            "bad",
            f"Not ready: {', '.join(by['failed'])} failed",
            f"{passed}{missed}. Each card says what to do.",
        )
    if missed or len(records) < len(STEPS):
        return banner_of("warn", "What was measured is in order", f"{passed}{missed}.")
    return banner_of("ok", "The bench is ready", f"All {len(records)} steps passed.")


def _link(record: StepRecord) -> str:
    words = f"{record.name}: {WORDS[record.verdict]}"
    return (
        f'<a href="#{record.name}" data-state="{STATES[record.verdict]}"><span'
        f' class="chip">{escaped(words)}</span></a>'
    )


def _card(folder: Path, step: SessionStep, record: StepRecord, session: SessionFile) -> str:
    pictures = [_picture(folder / name) for name in record.pictures]
    return "\n".join(
        [
            f'<section class="card{" pictured" if pictures else ""}" id="{record.name}">',
            f'<header data-state="{STATES[record.verdict]}">',
            f"<h2>{escaped(step.name.capitalize())}</h2>",
            f'<span class="chip">{WORDS[record.verdict]}</span></header><div class="words">',
            *_words(step, record, session),
            f"</div>{pictures[0] if pictures else ''}",
            "<details><summary>Details</summary>",
            *_details(record, pictures[1:]),
            "</details></section>",
        ]
    )


def _words(step: SessionStep, record: StepRecord, session: SessionFile) -> Iterator[str]:
    yield f'<p class="small">{escaped(step.measures)}</p>'
    number = record.number
    if number is None:
        absence = "no figure" if record.verdict == "done" else "not known"
        yield f'<p class="number">\N{EM DASH}<small>{absence}</small></p>'
    else:
        value = measured(number.value, number.error, number.unit)
        yield f'<p class="number">{escaped(value)}<small>{escaped(number.of)}</small></p>'
    yield f"<p>{escaped(capital(record.line))}.</p>"
    if record.verdict == "failed":
        again = f"hilstar first-light {Path(session.bench).name} -o SESSION --again {record.name}"
        yield (
            f'<p class="note"><b>What to do:</b> {escaped(step.cure)} Then, as before:'
            f" <code>{escaped(again)}</code></p>"
        )
    if record.changes:
        yield (
            "<p>Set in the bench file:"
            f" {'; '.join(f'<code>{escaped(change.line)}</code>' for change in record.changes)}</p>"
        )


def _details(record: StepRecord, pictures: list[str]) -> Iterator[str]:
    yield f'<p class="small">{escaped(record.ended)}, {record.seconds:.1f} s</p>'
    yield from pictures
    if record.figures:
        yield table_of(((name, value) for name, value in record.figures.items()), digits=6)
    if record.files:
        listed = list(record.files.items())[:MAX_FILES_LISTED]
        more = len(record.files) - len(listed)
        yield table_of((name, Markup(f"<code>{digest}</code>")) for name, digest in listed)
        yield f'<p class="small">and {more} files more, in session.json</p>' if more else ""


def _picture(path: Path) -> str:
    try:
        data = read_bytes(path, "", MAX_PICTURE_BYTES)
    except InputError as error:
        return f"<p>{escaped(error)}</p>"
    return picture_of(data, "svg+xml" if path.suffix == ".svg" else "png", path.stem)
