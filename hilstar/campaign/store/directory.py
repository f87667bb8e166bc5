"""A campaign's directory: one campaign, one writer, and the files in it."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import Any

import msgspec

from hilstar.campaign.store.journal import Journal
from hilstar.errors import InputError, cannot_read, shortened
from hilstar.files import make_directory, open_lock, write_whole
from hilstar.reading import NOT_JSON, read_bytes

ABOUT, LOCK, JOURNAL, TABLE = "campaign.json", "campaign.lock", "journal", "cases.parquet"
MAX_ABOUT_BYTES = 50_000_000
ANOTHER = "write another directory after -o, or delete this one"


class About(msgspec.Struct, frozen=True):
    """Whose campaign it is: all that its rows depend on."""

    plan: dict[str, Any]
    bench_sha256: str
    files_sha256: str
    solver: str
    images: bool
    identity: dict[str, str]


class Directory:
    """The directory of a campaign, held against a second driver; free it with `close`. Raises InputError where one has it."""

    def __init__(self, path: Path) -> None:
        self.path = make_directory(path)
        self._lock = _locked(path / LOCK)

    @property
    def table(self) -> Path:
        """The table's path."""
        return self.path / TABLE

    def claim(self, about: About) -> None:
        """Be of this campaign from now on. Raises InputError where the directory is another's, or holds another's files."""
        place = self.path / ABOUT
        if not place.exists():
            for name in (TABLE, JOURNAL):
                if (self.path / name).exists():
                    raise InputError(f"{self.path / name}: is there already, and no {ABOUT} says whose it is; {ANOTHER}")
            write_whole(place, msgspec.json.format(msgspec.json.encode(about), indent=1))
            return
        try:
            before = msgspec.json.decode(read_bytes(place, ANOTHER, MAX_ABOUT_BYTES), type=About)
        except NOT_JSON as error:
            raise cannot_read(place, "it is no campaign's", ANOTHER) from error
        now = msgspec.json.decode(msgspec.json.encode(about), type=About)
        if self.table.exists():  # whose rows are not run again, whatever this machine is
            now = msgspec.structs.replace(now, identity=before.identity)
        if before != now:
            raise InputError(f"{self.path}: holds another campaign: {_changed(before, about)}; {ANOTHER}")

    def journal(self, cases: int) -> Journal:
        """The journal of rows that have come so far."""
        return Journal(self.path / JOURNAL, cases)

    def close(self) -> None:
        """Let the directory go."""
        os.close(self._lock)


def _locked(path: Path) -> int:
    fd = open_lock(path)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(fd)
        raise InputError(
            f"{path.parent}: another campaign is running in it; wait for its end, or write another directory"
        ) from error
    return fd


def _changed(before: About, now: About) -> str:
    """The first thing that differs, in words."""
    said = msgspec.to_builtins(before), msgspec.to_builtins(now)
    tables = [("plan", "the plan's "), ("identity", "this machine's ")]
    for table, words in tables:
        for key in sorted(set(said[0][table]) | set(said[1][table])):
            old, new = (part[table].get(key) for part in said)
            if old != new:
                return f"{words}{key} was {shortened(_json(old))} and is {shortened(_json(new))}"
    for key, words in (("bench_sha256", "its bench file"), ("files_sha256", "its log or scenario"), ("solver", "--solver")):
        if said[0][key] != said[1][key]:
            return f"{words} was {shortened(said[0][key])} and is {shortened(said[1][key])}"
    return "--images was another"


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()
