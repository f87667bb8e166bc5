"""The formats of attitude logs: how each is told, read and written.

A format is one file and one entry point of the group `hilstar.log_formats`, whose object is a
`LogFormat`. hilstar's own stand in its pyproject.toml, and any installed package may add more.

1. The content of a file says which format reads it, the ending of its name which one writes it.
2. Of formats that take a file, the one that looks closest counts: first those with a magic number
   and a test of their own, then those with a magic number, then those with a test. The one with
   neither (CSV) has what nobody else takes.
3. hilstar's own formats come before those of other packages.
4. A format declares the statements of the user that its reader uses; any other is refused by name
   before the file is read.
"""

import importlib.util
import logging
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import IO, NamedTuple

from hilstar.attitude.logs.entries import OPTIONS, LogReading, Stated
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.errors import InputError, MachineError, shortened
from hilstar.basics.reading import HEAD_BYTES, open_lines, open_regular

GROUP = "hilstar.log_formats"
PACKAGE = "hilstar"
MAX_LOG_BYTES = 500_000_000
# Every statement: of a format that refuses its files with advice of its own.
ALL_STATEMENTS = frozenset(OPTIONS)
NOTHING_STATED = Stated()
log = logging.getLogger(__name__)


class LogHead(NamedTuple):
    """The beginning of a log: its first bytes, none of a directory."""

    path: Path
    head: bytes

    @property
    def word(self) -> str:
        """The first word of a text's first line that is no comment; "" where there is none."""
        with open_lines(self.path, readable(), MAX_LOG_BYTES, whole_lines=False) as lines:
            for line in lines:
                fields = line.split(maxsplit=1)
                if fields and fields[0] != "COMMENT" and not fields[0].startswith(("#", "//")):
                    return fields[0]
        return ""


class Writing(NamedTuple):
    """How a log is written: the ending of its name, and the scale of its times (None: unknown)."""

    ending: str
    scale: str | None = None


Reader = Callable[[Path, Stated], AbstractContextManager[LogReading]]
Writer = Callable[[IO[bytes], Sequence[AttitudeSample], Writing], None]


@dataclass(frozen=True, slots=True)
class LogFormat:
    """A format of logs.

    `name` is what a file of it is in a message ("a SPICE CK"), `listed` its name in the list of
    what hilstar reads ("" where it reads none). `read` opens a file; it raises InputError, and
    MachineError where the format's library is not installed. `uses` are the fields of `Stated` that
    it uses. `magic` are the first bytes of such files; `begins` tells one where these do not.
    `write` writes a file of one of `endings`.
    """

    name: str
    read: Reader
    listed: str = ""
    uses: frozenset[str] = frozenset()
    magic: tuple[bytes, ...] = ()
    begins: Callable[[LogHead], bool] | None = None
    endings: tuple[str, ...] = ()
    write: Writer | None = None
    # A run's bench file says nothing anew of its own ledger.
    of_ledgers: bool = False

    def takes(self, beginning: LogHead) -> bool:
        """Whether a file is of this format by its beginning. Raises InputError."""
        if self.begins is not None:
            return self.begins(beginning)
        return not self.magic or beginning.head.startswith(self.magic)

    @property
    def closeness(self) -> tuple[bool, bool]:
        """The key by which formats are tried, the one that looks closest first."""
        return (not self.magic, self.begins is None)


@lru_cache(maxsize=1)
def log_formats() -> tuple[LogFormat, ...]:
    """Every format, in the order in which they are tried.

    A format of another package that cannot be loaded is left out with a warning. Raises
    MachineError where hilstar's own are missing.
    """
    own_formats: list[LogFormat] = []
    others: list[LogFormat] = []
    for entry, is_own in _registered():
        loaded = entry.load() if is_own else _loaded(entry)
        if loaded is not None:
            (own_formats if is_own else others).append(loaded)
    if not own_formats:
        missing = "hilstar's own log formats are not registered"
        raise MachineError(f"{missing}; install hilstar again: pip install hilstar")
    return tuple(sorted([*own_formats, *others], key=lambda each: each.closeness))


def _registered() -> Iterator[tuple[EntryPoint, bool]]:
    """Each entry point of the group, and whether it is hilstar's own.

    A checkout's own formats are those of the pyproject.toml beside it: what an older installation
    of it has registered may be out of date.
    """
    checkout = _of_checkout(Path(__file__).resolve().parents[3] / "pyproject.toml")
    for entry in checkout:
        yield entry, True
    for entry in entry_points(group=GROUP):
        is_own = entry.dist is not None and entry.dist.name == PACKAGE
        if not (is_own and checkout):
            yield entry, is_own


def _of_checkout(path: Path) -> list[EntryPoint]:
    """The entry points in the pyproject.toml of a checkout; none where there is none."""
    if not path.is_file():
        return []
    project = tomllib.loads(path.read_text(encoding="utf-8")).get("project", {})
    if project.get("name") != PACKAGE:
        return []
    values = project["entry-points"][GROUP]
    return [EntryPoint(name, value, GROUP) for name, value in values.items()]


def _loaded(entry: EntryPoint) -> LogFormat | None:
    """The format of another package; None, with a warning, where it is none."""
    try:
        loaded = entry.load()
    except Exception as error:  # another package's code raises what it likes
        loaded = error
    if isinstance(loaded, LogFormat):
        return loaded
    if entry.dist is None:
        package = "a package"
    else:
        package = entry.dist.name
    log.warning(
        "the log format %s of %s (%s) is no LogFormat, and is left out: %s",
        entry.name,
        package,
        entry.value,
        shortened(loaded),
    )
    return None


def readable() -> str:
    """What hilstar reads, for a message."""
    names = [form.listed for form in log_formats() if form.listed]
    return f"hilstar reads {', '.join(names[:-1])} and {names[-1]}"


def kinds() -> dict[bytes, str]:
    """What a file is by its first bytes, of every format that has a magic number."""
    kind_of_magic: dict[bytes, str] = {}
    for form in log_formats():  # of formats with one magic number the last takes any such file
        kind_of_magic |= dict.fromkeys(form.magic, form.name)
    return kind_of_magic


def format_of(path: Path) -> LogFormat:
    """The format that reads a file. Raises InputError for a file that is no log."""
    head = b""
    if not path.is_dir():
        with open_regular(path, readable()) as file:
            head = file.read(HEAD_BYTES)
    beginning = LogHead(path, head)
    return next(form for form in log_formats() if form.takes(beginning))


def check_stated(path: Path, stated: Stated) -> LogFormat:
    """The format of a log. Raises InputError for a statement that the format does not use, and for
    a file that is no log.
    """
    log_format = format_of(path)
    for name, written in stated:
        by_bench = written != OPTIONS[name]
        if name in log_format.uses or (log_format.of_ledgers and by_bench):
            continue  # what a run's bench file says of its packets, its ledger has already done
        if name == "convention":
            reason = " has a convention of its own"
        else:
            reason = " does not use it"
        raise InputError(f"{path}: {written}: {log_format.name}{reason}; leave it out")
    return log_format


def writer_of(path: Path) -> tuple[Writer, str]:
    """The writer of a name's ending, and that ending. Raises InputError for any other ending."""
    ending = path.suffix.lower()
    endings: list[str] = []
    for form in log_formats():
        if form.write is None:
            continue
        if ending in form.endings:
            return form.write, ending
        endings += form.endings
    raise InputError(f"{path}: not a log's name; end it in one of {', '.join(endings)}")


def require(library: str, extra: str, what: str) -> None:
    """Refuse (MachineError) to go on without a library that hilstar's `extra` installs."""
    if importlib.util.find_spec(library) is None:
        raise MachineError(f"{what}; reading it needs {library}: pip install 'hilstar[{extra}]'")
