"""A session's records: session.json, the keys set in the bench file, and the page first-light.html."""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import msgspec

from hilstar.bench.bench_file import BenchFile, read_bench_file, with_key
from hilstar.bench.config import parse_config
from hilstar.errors import InputError, shortened
from hilstar.files import write_whole
from hilstar.html_pages import Markup, escaped, page_of, picture_of, table_of
from hilstar.reading import MAX_TOML_BYTES, NOT_JSON, exists, read_bytes, read_text
from hilstar.run.sync import BeatSummary, beat_line

Verdict = Literal["done", "skipped", "failed"]
Figure = float | int | str
TomlValue = float | int | str | bool | list[int]

MAX_SESSION_BYTES = 20_000_000
MAX_FILE_BYTES = 2_000_000_000
KIND = "hilstar first light 1"
SESSION_FILE = "session.json"
PAGE_FILE = "first-light.html"
ADVICE = "give the directory of a first-light session, or a new one"


class KeyChange(msgspec.Struct, frozen=True, kw_only=True):
    """A key of the bench file that a step sets; `before` is None where it was not written."""

    table: str
    key: str
    before: TomlValue | None
    after: TomlValue

    @property
    def line(self) -> str:
        """The change for a person."""
        before = "not set" if self.before is None else self.before
        return f"[{self.table}] {self.key}: {before} -> {self.after}"


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """The result of a step: one line, figures, files made, pictures for the page, and keys to set."""

    verdict: Verdict
    line: str
    figures: Mapping[str, Figure] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    changes: tuple[KeyChange, ...] = ()


class StepRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A step in session.json: `state_sha256` is of what it depends on, `files` has each file's SHA-256 by its path there."""

    name: str
    verdict: Verdict
    line: str
    exit_code: int
    state_sha256: str
    figures: dict[str, Figure]
    files: dict[str, str]
    pictures: list[str]
    changes: list[KeyChange]
    ended: str
    seconds: float


class SessionFile(msgspec.Struct, frozen=True, kw_only=True):
    """session.json: the bench, where its patterns are seen, and the steps in their order.

    `unfinished` has the state of each interrupted step: while it is the same, the images taken are used again. `beat` is that
    of the tracker's exposures with the display's refresh, measured where it could be; `forced` what --force shows it on.
    """

    kind: str
    hilstar: str
    bench: str
    bench_sha256: str
    seen_by: str
    running: str | None
    steps: list[StepRecord]
    unfinished: dict[str, str] = {}
    beat: BeatSummary | None = None
    forced: list[str] = []


def read_session(folder: Path) -> SessionFile | None:
    """The session in a directory, None where there is none. Raises InputError for a file that is no session."""
    path = folder / SESSION_FILE
    if not exists(path):
        return None
    try:
        found = msgspec.json.decode(read_bytes(path, ADVICE, MAX_SESSION_BYTES), type=SessionFile)
    except NOT_JSON as error:
        raise InputError(f"{path}: is no session ({shortened(error)}); {ADVICE}") from error
    if found.kind != KIND:
        raise InputError(f"{path}: kind = {shortened(repr(found.kind))} and {KIND!r} is wanted; {ADVICE}")
    return found


def write_session(folder: Path, session: SessionFile) -> None:
    """Write session.json, complete or not at all."""
    write_whole(folder / SESSION_FILE, msgspec.json.format(msgspec.json.encode(session)))


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file's bytes. Raises InputError where it cannot be read."""
    return hashlib.sha256(read_bytes(path, ADVICE, MAX_FILE_BYTES)).hexdigest()


INSTEAD_OF = {"flux_at_white_e_per_s": ("brightest_v_mag",)}


def with_changes(file: BenchFile, changes: Sequence[KeyChange]) -> BenchFile:
    """The bench file with the changes, without writing it. Raises InputError where a key cannot be set in this file."""
    text = file.text
    for change in changes:
        text = with_key(text, change.table, change.key, change.after, INSTEAD_OF.get(change.key, ()))
    config = parse_config(file.path, text)
    for change in changes:
        now = getattr(getattr(config, change.table), change.key)
        if (list(now) if isinstance(now, tuple) else now) != change.after:
            raise InputError(f"{file.path}: {change.key} could not be set; write it under [{change.table}] yourself")
    return BenchFile(file.path, text, config, file.sha256)


def rewrite(file: BenchFile, changes: Sequence[KeyChange]) -> BenchFile:
    """Write the changed bench file over the old one, and read it. Raises InputError."""
    if not changes:
        return file
    write_whole(file.path, with_changes(file, changes).text)
    return read_bench_file(file.path)


MAX_PICTURE_BYTES = 50_000_000
MAX_FILES_LISTED = 12  # per step; the others are counted here, and listed in session.json
COLOURS = {"done": "#2e7d32", "skipped": "#8a6d00", "failed": "#c62828"}


def write_page(folder: Path, session: SessionFile, before: Path) -> Path:
    """Write the page of a session, with its bench file as it was and as it is. Raises InputError where it cannot be written."""
    bench = Path(session.bench)
    old, new = (read_text(path, "", MAX_TOML_BYTES).splitlines() for path in (before, bench))
    difference = "\n".join(difflib.unified_diff(old, new, "before", "now", lineterm=""))
    beats = None if session.beat is None else beat_line(session.beat)
    overview = [(Markup(f"<a href='#{each.name}'>{each.name}</a>"), _badge(each), each.line) for each in session.steps]
    body = [
        f'<p class="small">hilstar {escaped(session.hilstar)}; images: {escaped(session.seen_by)}</p>',
        *(f'<p class="verdict" style="background:{COLOURS["failed"]}">Forced: {escaped(each)}</p>' for each in session.forced),
        table_of(overview),
        *([f"<p>{escaped(beats)}</p>"] if beats else []),
        *(part for record in session.steps for part in _step(folder, record)),
        "<h2>The bench file</h2>",
        f"<p>{escaped(bench)}, SHA-256 <code>{session.bench_sha256}</code></p>",
        f"<pre>{escaped(difference or 'nothing was changed')}</pre>",
    ]
    path = folder / PAGE_FILE
    write_whole(path, page_of(f"First light of {bench.name}", body))
    return path


def _badge(record: StepRecord) -> Markup:
    return Markup(f'<span class="verdict" style="background:{COLOURS[record.verdict]}">{record.verdict}</span>')


def _step(folder: Path, record: StepRecord) -> Iterator[str]:
    yield f'<h2 id="{record.name}">{record.name} {_badge(record)}</h2>'
    yield f'<p>{escaped(record.line)}</p><p class="small">{escaped(record.ended)}, {record.seconds:.1f} s</p>'
    if record.changes:
        yield f"<p>In the bench file: {'; '.join(f'<code>{escaped(change.line)}</code>' for change in record.changes)}</p>"
    yield from (_picture(folder / name) for name in record.pictures)
    if record.figures:
        yield table_of(record.figures.items(), digits=6)
    if record.files:
        listed = list(record.files.items())[:MAX_FILES_LISTED]
        more = len(record.files) - len(listed)
        yield table_of((name, Markup(f"<code>{digest}</code>")) for name, digest in listed)
        yield f'<p class="small">and {more} files more, in session.json</p>' if more else ""


def _picture(path: Path) -> str:
    try:
        return picture_of(read_bytes(path, "", MAX_PICTURE_BYTES), "png", path.stem)
    except InputError as error:
        return f"<p>{escaped(error)}</p>"
