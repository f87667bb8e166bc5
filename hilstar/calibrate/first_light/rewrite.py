"""Keys of the bench file set by a session: comments kept, the new file read again before it takes the old one's place."""

from __future__ import annotations

from collections.abc import Iterable

from hilstar.bench.bench_file import BenchFile, read_bench_file
from hilstar.bench.bench_file_edit import with_key
from hilstar.calibrate.first_light.records import Change
from hilstar.errors import InputError
from hilstar.files import write_whole

INSTEAD_OF = {"flux_at_white_e_per_s": ("brightest_v_mag",)}


def with_changes(file: BenchFile, changes: Iterable[Change]) -> BenchFile:
    """The bench file as it would be with the changes, written nowhere.

    Raises InputError where a key cannot be set in this file.
    """
    text = file.text
    for change in changes:
        text = with_key(text, change.table, change.key, change.after, INSTEAD_OF.get(change.key, ()))
    return _checked(file, text, changes)


def _checked(file: BenchFile, text: str, changes: Iterable[Change]) -> BenchFile:
    """The bench of `text`. Raises InputError where it does not say what was to be set."""
    from hilstar.bench.config import parse_config

    config = parse_config(file.path, text)
    for change in changes:
        now = getattr(getattr(config, change.table), change.key)
        if (list(now) if isinstance(now, tuple) else now) != change.after:
            raise InputError(f"{file.path}: {change.key} could not be set; write it under [{change.table}] yourself")
    return BenchFile(file.path, text, config, file.sha256)


def rewrite(file: BenchFile, changes: Iterable[Change]) -> BenchFile:
    """Write the changed bench file in the old one's place. Raises InputError."""
    changes = tuple(changes)
    if not changes:
        return file
    write_whole(file.path, with_changes(file, changes).text)
    return read_bench_file(file.path)
