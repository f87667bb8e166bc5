"""What a session has done so far, as session.json keeps it: a record of each step, with its figures, files and hashes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import msgspec

from hilstar.errors import InputError, shortened
from hilstar.files import write_whole
from hilstar.reading import NOT_JSON, exists, read_bytes
from hilstar.run.sync.advice import BeatSummary

Verdict = Literal["done", "skipped", "failed"]
Figure = float | int | str
TomlValue = float | int | str | bool | list[int]

MAX_SESSION_BYTES = 20_000_000
MAX_FILE_BYTES = 2_000_000_000
KIND = "hilstar first light 1"
SESSION_FILE = "session.json"
PAGE_FILE = "first-light.html"
ADVICE = "give the directory of a first-light session, or a new one"


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """A key of the bench file that a step has set; `before` is None where it had not been written."""

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
class Outcome:
    """What a step came to: one line, its figures, the files that it made, pictures for the page, and keys to set."""

    verdict: Verdict
    line: str
    figures: Mapping[str, Figure] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    changes: tuple[Change, ...] = ()


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """A step in session.json.

    `state_sha256` covers what the step depends on; `files` has the SHA-256 of each by its path relative to the session.
    """

    name: str
    verdict: Verdict
    line: str
    exit_code: int
    state_sha256: str
    figures: dict[str, Figure]
    files: dict[str, str]
    pictures: list[str]
    changes: list[Change]
    ended: str
    seconds: float


class SessionFile(msgspec.Struct, frozen=True, kw_only=True):
    """session.json: the bench, where its patterns are seen, and the steps in their order.

    `unfinished` has, by step, the state in which images were taken that a further attempt need not take again. `beat` is
    that of the tracker's exposures with the display's refresh, as measured where it was.
    """

    kind: str
    hilstar: str
    bench: str
    bench_sha256: str
    seen_by: str
    running: str | None
    steps: list[Record]
    unfinished: dict[str, str] = {}
    beat: BeatSummary | None = None

    def step(self, name: str) -> Record | None:
        """The record of a step, None before it ran."""
        return next((record for record in self.steps if record.name == name), None)


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
