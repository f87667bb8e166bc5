"""The reference of the bench file: nothing is missing in it, and its defaults are those that are
used.
"""

from __future__ import annotations

import json
import re
import tomllib
from typing import Literal, get_args, get_origin

import msgspec
import pytest
from msgspec.structs import FieldInfo

from hilstar.basics.toml_tables import plain
from hilstar.server.bench.config import BenchConfig, read_config
from hilstar.server.bench.config.reference import page, table_in, tables_of
from tests.support.benches import SMALL_BENCH

KEYS = [
    (name, field)
    for name, table in tables_of(BenchConfig, "")
    for field in msgspec.structs.fields(table)
    if table_in(field.type) is None
]


@pytest.fixture(scope="module")
def rows() -> dict[tuple[str, str], tuple[str, str, str]]:
    """By table and key: value, default and meaning, as the page has them."""
    found: dict[tuple[str, str], tuple[str, str, str]] = {}
    table = ""
    for line in page().splitlines():
        if heading := re.match(r"## `\[(.*)\]`$", line):
            table = heading[1]
        elif row := re.match(r"\| `(\w+)` \| (.*?) \| (.*?) \| (.*) \|$", line):
            # the notes below may have tables too
            found.setdefault((table, row[1]), (row[2], row[3], row[4]))
    return found


def test_every_key_has_its_row(rows):
    assert len(KEYS) > 80
    assert set(rows) == {(table, field.name) for table, field in KEYS}


@pytest.mark.parametrize(
    ("table", "field"), KEYS, ids=[f"{table}.{field.name}" for table, field in KEYS]
)
def test_a_row_says_what_the_definition_says(rows, table: str, field: FieldInfo):
    value, default, meaning = rows[table, field.name]
    assert value
    assert meaning.endswith(".")
    assert (default == "**required**") == field.required
    kind = plain(field.type)
    for choice in get_args(kind) if get_origin(kind) is Literal else ():
        assert f"`{choice}`" in value or f'`"{choice}"`' in value
        # A default needs no words where the other choice has them.
        assert isinstance(choice, int) or choice == field.default or f'"{choice}"' in meaning


def test_a_default_in_the_reference_is_the_one_that_is_used(tmp_path, rows):
    """Every default that the page shows as TOML, written into a bench file, changes nothing."""
    keys = {
        table: {key: json.dumps(value) for key, value in given.items()}
        for table, given in tomllib.loads(SMALL_BENCH).items()
    }
    count = 0
    optional = {
        field.name for field in msgspec.structs.fields(BenchConfig) if field.default is None
    }
    for (table, key), (_, default, _) in rows.items():
        # a file without the table is not one with its defaults
        if table.partition(".")[0] in optional:
            continue
        # No background and one of 0 electrons are one light, but two settings.
        if (shown := re.fullmatch(r"`([^`]*)`", default)) and key != "electrons_per_px":
            count += keys.setdefault(table, {}).setdefault(key, shown[1]) == shown[1]
    assert count > 60
    files = tmp_path / "short.toml", tmp_path / "written.toml"
    files[0].write_text(SMALL_BENCH)
    tables = (
        f"[{table}]\n" + "".join(f"{key} = {value}\n" for key, value in own.items())
        for table, own in keys.items()
    )
    files[1].write_text("".join(tables))
    assert read_config(files[0]) == read_config(files[1])
