"""One key of a bench file is set, whatever stands around it."""

from __future__ import annotations

import pytest

from hilstar.server.bench.bench_file import with_key


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("[monitor]\nbits = 8\n[sky]\n", "[monitor]\nkey = 1.5\nbits = 8\n[sky]\n"),
        ("[monitor]  # ours\nkey = 9 # old\n", "[monitor]  # ours\nkey = 1.5 # old\n"),
        ("[sky]\nkey = 2\n[monitor]", "[sky]\nkey = 2\n[monitor]\nkey = 1.5\n"),
        ("[sky]\n", "[sky]\n\n[monitor]\nkey = 1.5\n"),
        ("[monitor]\nother = 2\n", "[monitor]\nkey = 1.5\n"),
    ],
)
def test_one_key_of_a_bench_file_is_set_and_nothing_else_changes(before, after):
    assert with_key(before, "monitor", "key", 1.5, instead_of=("other",)) == after


@pytest.mark.parametrize(
    ("value", "written"),
    [("exact", 'key = "exact"'), (True, "key = true"), (2.5, "key = 2.5"), (8, "key = 8")],
)
def test_a_key_is_written_as_toml_writes_it(value, written):
    assert (
        with_key('[monitor]\nkey = "round"  # ours\n', "monitor", "key", value)
        == f"[monitor]\n{written}  # ours\n"
    )
