"""One key of a bench file is set, whatever stands around it."""

from __future__ import annotations

import pytest

from hilstar.calibrate.bench_file_edit import with_key


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
