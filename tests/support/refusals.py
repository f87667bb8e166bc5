"""Refusals: what is asked for, and the one line that answers."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from hilstar.basics.errors import InputError

MAX_LINE_CHARACTERS = 1000


def line_of(error: Exception) -> str:
    """What an error says: one printable line, and no page."""
    line = str(error)
    assert line.isprintable() and len(line) <= MAX_LINE_CHARACTERS, line
    return line


def refusal(asked: Callable[..., object], *arguments: object, **options: object) -> str:
    """The line by which a call is refused."""
    with pytest.raises(InputError) as caught:
        asked(*arguments, **options)
    return line_of(caught.value)


def says(line: str, words: str) -> bool:
    """Whether a line has words, where `...` stands for any text between.

    Words that begin with a colon are a place, `:17: ...`, and stand first in the line.
    """
    pattern = ".*".join(map(re.escape, words.split("...")))
    find = re.match if words.startswith(":") else re.search
    return find(pattern, line) is not None


def assert_file_refused(read: Callable[[Path], object], path: Path, words: str) -> None:
    """A file is refused in one line: its path, then the words."""
    line = refusal(read, path)
    assert line.startswith(str(path)), line
    assert says(line.removeprefix(str(path)), words), line
