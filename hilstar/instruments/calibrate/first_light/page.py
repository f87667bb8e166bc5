"""The page of a session, first-light.html: a verdict, a card for each step, and what changed in
the bench file.
"""

import difflib
from collections.abc import Iterator, Sequence
from pathlib import Path

from hilstar.basics.charts import capital
from hilstar.basics.errors import InputError
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
    escaped,
    key_table,
    keyed_rows,
    measured,
    page_of,
    paragraph,
    picture_of,
    table_of,
)
from hilstar.basics.reading import MAX_TOML_BYTES, read_bytes, read_text
from hilstar.instruments.calibrate.first_light.context import SessionFile, StepRecord
from hilstar.instruments.calibrate.first_light.steps import STEPS, SessionStep
from hilstar.server.sync import beat_line

PAGE_FILE = "first-light.html"
MAX_PICTURE_BYTES = 50_000_000
MAX_FILES_LISTED = 12  # per step; the others are counted here, and listed in session.json
MAX_FIGURES_BESIDE = 14  # beside a picture; the others are among the details
STATES = {"done": OK, "skipped": WARN, "failed": BAD}
WORDS = {"done": "passed", "skipped": "not measured", "failed": "failed"}


def write_page(folder: Path, session: SessionFile, before: Path) -> Path:
    """Write the page of a session, with its bench file as it was and as it is. Raises InputError
    where it cannot be written.
    """
    bench = Path(session.bench)
    records = {record.name: record for record in session.steps}
    links = "".join(_link(record) for record in session.steps)
    parts = [Verdict(BAD, "Forced", forced_check).html() for forced_check in session.forced]
    parts.append(f'<nav class="steps" aria-label="Steps">{links}</nav>')
    for step in STEPS:
        if step.name in records:
            parts.append(_card(folder, step, records[step.name], session).html())
    parts.append(_bench_file(session, before).html())
    path = folder / PAGE_FILE
    write_whole(path, page_of(f"First light of {bench.name}", _verdict(session.steps), parts))
    return path


def _bench_file(session: SessionFile, before: Path) -> Card:
    """What changed in the bench file."""
    bench = Path(session.bench)
    old, new = (read_text(path, "", MAX_TOML_BYTES).splitlines() for path in (before, bench))
    difference = "\n".join(difflib.unified_diff(old, new, "before", "now", lineterm=""))
    texts = []
    beats = session.beat and beat_line(session.beat)
    if beats:
        texts.append(paragraph(beats))
    texts.append(f"<pre>{escaped(difference or 'nothing was changed')}</pre>")
    details = (
        f"<p>{escaped(bench)}, SHA-256 <code>{session.bench_sha256}</code></p>",
        paragraph(f"hilstar {session.hilstar}; images: {session.seen_by}"),
    )
    return Card("The bench file", words=texts, details=details)


def _verdict(records: list[StepRecord]) -> Verdict:
    names: dict[str, list[str]] = {verdict: [] for verdict in WORDS}
    for record in records:
        names[record.verdict].append(record.name)
    passed = f"{len(names['done'])} of {len(records)} steps passed"
    missed = ""
    if names["skipped"]:
        missed = f"; not measured: {', '.join(names['skipped'])}"
    if names["failed"]:
        headline = f"Not ready: {', '.join(names['failed'])} failed"
        return Verdict(BAD, headline, f"{passed}{missed}. Each card says what to do.")
    if missed or len(records) < len(STEPS):
        return Verdict(WARN, "What was measured is in order", f"{passed}{missed}.")
    return Verdict(OK, "The bench is ready", f"All {len(records)} steps passed.")


def _link(record: StepRecord) -> str:
    verdict = f"{record.name}: {WORDS[record.verdict]}"
    chip = f'<span class="chip">{escaped(verdict)}</span>'
    return f'<a href="#{record.name}" data-state="{STATES[record.verdict]}">{chip}</a>'


def _card(folder: Path, step: SessionStep, record: StepRecord, session: SessionFile) -> Card:
    pictures = [_picture(folder / name) for name in record.pictures]
    figures = keyed_rows(record.figures)
    beside = figures[:MAX_FIGURES_BESIDE] if pictures else []
    return Card(
        title=step.name.capitalize(),
        figure=_figure(record),
        words=[*_words(step, record), *_figure_table(beside)],
        picture="".join(pictures[:1]),
        cure=_cure(step, record, session),
        details=list(_details(record, pictures[1:], figures[len(beside) :])),
        chip=WORDS[record.verdict],
        state=STATES[record.verdict],
        anchor=record.name,
    )


def _figure(record: StepRecord) -> KeyFigure:
    number = record.number
    if number is not None:
        return KeyFigure(measured(number.value, number.error, number.unit), number.of)
    if record.verdict == "done":
        return KeyFigure(DASH, "no figure")
    return KeyFigure(DASH, "not known")


def _words(step: SessionStep, record: StepRecord) -> Iterator[str]:
    yield paragraph(f"{capital(record.line)}.")
    if record.changes:
        lines = "; ".join(f"<code>{escaped(change.line)}</code>" for change in record.changes)
        yield f"<p>Set in the bench file: {lines}</p>"
    yield paragraph(step.measures, "small")


def _cure(step: SessionStep, record: StepRecord, session: SessionFile) -> str:
    """What to do about a step that failed."""
    if record.verdict != "failed":
        return ""
    again = f"hilstar first-light {Path(session.bench).name} -o SESSION --again {record.name}"
    return Markup(f"{escaped(step.cure)} Then, as before: <code>{escaped(again)}</code>")


def _figure_table(figures: Sequence[tuple[str, str]]) -> Iterator[str]:
    if figures:
        yield key_table(figures)


def _details(
    record: StepRecord, pictures: list[str], figures: Sequence[tuple[str, str]]
) -> Iterator[str]:
    yield paragraph(f"{record.ended}, {record.seconds:.1f} s", "small")
    yield from pictures
    yield from _figure_table(figures)
    listed = list(record.files.items())[:MAX_FILES_LISTED]
    if listed:
        yield table_of((name, Markup(f"<code>{digest}</code>")) for name, digest in listed)
    more = len(record.files) - len(listed)
    if more:
        yield paragraph(f"and {more} files more, in session.json", "small")


def _picture(path: Path) -> str:
    try:
        data = read_bytes(path, "", MAX_PICTURE_BYTES)
    except InputError as error:
        return paragraph(error)
    kind = "png"
    if path.suffix == ".svg":
        kind = "svg+xml"
    return picture_of(data, kind, path.stem)
