"""Whether a command line writes to stdout, and how a command ends that is stopped or refused."""

from __future__ import annotations

import errno

import pytest
import typer

from hilstar.basics.errors import InputError, MachineError
from hilstar.cli import entry
from hilstar.cli.entry import writes_to_stdout
from tests.support.commands import run_hilstar_here


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
        ("frame - - -o out.fits", False),
        ("calibrate reference - --", False),
        ("send --spin z,-1", False),
        ("frame --truth=-x", False),
    ],
)
def test_an_output_of_a_dash_is_stdout_after_its_option_or_joined_to_it(words, does):
    assert writes_to_stdout(words.split()) is does


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (KeyboardInterrupt(), 130, "stopped"),
        (typer.Abort(), 130, "stopped"),
        (MemoryError(), 3, "not enough memory for this; give smaller files or sizes"),
        (
            OSError(errno.ENOSPC, "No space left on device", "out.csv"),
            2,
            "out.csv: cannot be written or read (No space left on device); choose another place",
        ),
        (MachineError("no GPU is there"), 3, "no GPU is there"),
        (InputError("bench.toml: is none"), 2, "bench.toml: is none"),
    ],
)
def test_an_end_that_is_no_success_is_one_line_and_its_code(monkeypatch, capsys, error, code, line):
    def run(words):
        raise error

    monkeypatch.setattr(entry, "run", run)
    assert entry.run_command(["doctor"]) == code
    assert capsys.readouterr().err == f"hilstar: {line}\n"


def test_a_missing_input_is_said_before_a_missing_option_and_an_output_is_none(tmp_path):
    (tmp_path / "m.csv").touch()
    words = ("calibrate", "photometric")
    gone = run_hilstar_here(*words, "gone.csv", cwd=tmp_path)
    assert gone.returncode == 2 and "gone.csv: no such file; give one" in gone.stderr
    there = run_hilstar_here(*words, "m.csv", "--plot", "out.png", cwd=tmp_path)
    assert there.returncode == 2
    assert "Missing option" in there.stderr and "out.png" not in there.stderr
