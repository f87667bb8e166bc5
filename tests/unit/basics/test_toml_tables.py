"""Tables that are written as TOML and read again, and what a wrong one is told."""

from __future__ import annotations

import tomllib
from datetime import date
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import pytest

from hilstar.basics.toml_tables import Kind, Table, explained, toml_text


class Inner(Table):
    size_px: tuple[int, int] = (8, 8)
    axis: tuple[float, float, float] | None = None
    q: Annotated[tuple[float, float, float, float] | None, "attitude"] = None
    mode: Literal["plain", "packed"] = "plain"
    count: int = 1


class Root(Table):
    name: str
    inner: Inner | None = None
    part: tuple[Inner, ...] = ()


KIND = Kind(Root, "docs/x.md", {"int": "a whole number", "array": "a list"})


def told(text: str) -> str:
    tables = tomllib.loads(text)
    with pytest.raises(msgspec.ValidationError) as caught:
        msgspec.convert(tables, Root)
    return explained(str(caught.value), tables, KIND)


TABLES = {
    "name": 'say "hi"\n',
    "a b": 1,
    "on": True,
    "none": None,
    "large": 1e22,
    "day": date(2026, 11, 30),
    "q": np.array([1.0, -0.5]),
    "rows": [[1, 2], [3, 4]],
    "place": {"x y": 0.1, "inner": {"a.b": 2, "lost": None}, "none": None},
    "e mpty": {"none": None},
    "path": Path("/tmp/a b"),
}


def test_what_is_written_is_read_again():
    text = toml_text(TABLES)
    assert tomllib.loads(text) == {
        "name": 'say "hi"\n',
        "a b": 1,
        "on": True,
        "large": 1e22,
        "day": date(2026, 11, 30),
        "q": [1.0, -0.5],
        "rows": [[1, 2], [3, 4]],
        "place": {"x y": 0.1, "inner": {"a.b": 2}},
        "path": "/tmp/a b",
    }
    assert "rows = [\n    [1, 2],\n    [3, 4],\n]\n" in text
    assert "e mpty" not in text


@pytest.mark.parametrize("value", [{1, 2}, 1j, object()])
def test_what_toml_does_not_have_is_refused(value):
    with pytest.raises(TypeError, match="write text, a number, true or false"):
        toml_text({"key": value})


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (
            'name = "a"\n[inner]\naxis = 5\n',
            "[inner] axis = 5; a list is wanted, such as axis = [0.0, 0.0, 0.0]",
        ),
        (
            'name = "a"\n[inner]\nsize_px = 5\n',
            "[inner] size_px = 5; a list is wanted, such as size_px = [5, 5]",
        ),
        (
            'name = "a"\n[inner]\nq = "up"\n',
            '[inner] q = "up"; a list is wanted, such as q = [1.0, 0.0, 0.0, 0.0]',
        ),
        (
            'name = "a"\n[inner]\ncount = "5"\n',
            '[inner] count = "5"; a whole number is wanted, such as count = 5',
        ),
        (
            'name = "a"\n[inner]\nmode = "loose"\n',
            '[inner] mode = "loose"; "plain" or "packed" is wanted',
        ),
        (
            'name = "a"\n[inner]\nmode = "packd"\n',
            '[inner] mode = "packd"; did you mean packed? "plain" or "packed" is wanted',
        ),
        (
            'name = "a"\n[[part]]\n[[part]]\ncounts = 1\n',
            "[[part]] number 2: unknown key counts; did you mean count?",
        ),
        ("x = 1\n", "unknown key x; known are name, inner, part"),
        ("[inner]\n", "the table [name] is missing; add it (see docs/x.md)"),
    ],
)
def test_a_wrong_key_is_told_by_its_table_with_what_is_wanted(text, line):
    assert told(text) == line
