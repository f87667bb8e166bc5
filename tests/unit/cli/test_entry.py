"""Whether a command line writes to stdout."""

from __future__ import annotations

import pytest

from hilstar.cli.entry import writes_to_stdout


@pytest.mark.parametrize(
    ("words", "does"),
    [
        ("frame b.toml -o -", True),
        ("frame b.toml -o-", True),
        ("frame b.toml --truth -", True),
        ("frame b.toml --truth=-", True),
        ("frame b.toml --clipped-stars=-", True),
        ("frame b.toml -o out.fits", False),
        ("frame - -o out.fits", False),
        ("calibrate reference - --", False),
        ("send --spin z,-1", False),
        ("frame --truth=-x", False),
    ],
)
def test_an_output_of_a_dash_is_stdout_after_its_option_or_joined_to_it(words, does):
    assert writes_to_stdout(words.split()) is does
