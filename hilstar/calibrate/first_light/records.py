"""A session's records: session.json, and the keys set in the bench file."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import msgspec

from hilstar.bench.bench_file import BenchFile, read_bench_file, with_key
from hilstar.bench.config import parse_config
from hilstar.errors import InputError, shortened
from hilstar.files import write_whole
from hilstar.reading import NOT_JSON, exists, read_bytes
from hilstar.run.sync import BeatSummary

Verdict = Literal["done", "skipped", "failed"]
Figure = float | int | str
TomlValue = float | int | str | bool | list[int]

MAX_SESSION_BYTES = 20_000_000
MAX_FILE_BYTES = 2_000_000_000
KIND = "hilstar first light 1"
SESSION_FILE = "session.json"
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


class StepNumber(msgspec.Struct, frozen=True):
    """The one figure of a step: value, standard error (None for a count or a figure without one), unit, and what it is."""

    value: float
    error: float | None
    unit: str
    of: str


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """The result of a step: one line, figures, files made, pictures for the page, keys to set, and its one figure."""

    verdict: Verdict
    line: str
    figures: Mapping[str, Figure] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    changes: tuple[KeyChange, ...] = ()
    number: StepNumber | None = None


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
    number: StepNumber | None = None


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
