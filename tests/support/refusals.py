"""Refusals: what is asked for, and the one line that answers."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from hilstar.basics.errors import InputError

MAX_LINE_CHARACTERS = 1000


def line_of(error: InputError) -> str:
    """What an error says: one printable line, and no page."""
    line = str(error)
    assert line.isprintable() and len(line) <= MAX_LINE_CHARACTERS, line
    return line


def refusal(asked: Callable[..., object], *arguments: object, **options: object) -> str:
    """The line by which a call is refused."""
    with pytest.raises(InputError) as caught:
        asked(*arguments, **options)
    return line_of(caught.value)
