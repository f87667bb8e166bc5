"""-h and --version, on every command and group."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator

import pytest
from typer import Typer

import hilstar
from hilstar.basics.errors import InputError
from hilstar.cli.app import application, run
from tests.support.benches import ROOT
from tests.support.commands import assert_refused, run_hilstar_here


def lines_of(group: Typer) -> Iterator[list[str]]:
    """The words of every group and command."""
    yield []
    for info in group.registered_commands:
        yield [info.name or getattr(info.callback, "__name__", "")]
    for inner in group.registered_groups:
        for words in lines_of(inner.typer_instance):
            yield [str(inner.name), *words]


LINES = list(lines_of(application()))


def test_there_are_commands_and_groups():
    assert len(LINES) > 15
    assert ["calibrate"] in LINES
    assert ["calibrate", "plan"] in LINES


@pytest.mark.parametrize("words", LINES, ids=" ".join)
@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_help_is_there(words, flag, capsys):
    assert not run([*words, flag])
    usage = next(line for line in capsys.readouterr().out.splitlines() if "Usage:" in line)
    typed = usage.partition(" [OPTIONS]")[0].split()
    assert typed[len(typed) - len(words) :] == words


@pytest.mark.parametrize("words", LINES, ids=" ".join)
def test_an_option_says_what_its_value_is(words, capsys):
    """Not of which type it is; a limit that nobody meets is no help either."""
    assert not run([*words, "--help"])
    shown = capsys.readouterr().out
    options = shown.partition("─ Options ─")[2]
    for word in ("range>", "<int", "<float", "<str", "<path", "INTEGER", "FLOAT", "9223372"):
        assert word not in options


def test_a_seed_that_no_file_can_hold_is_refused():
    with pytest.raises(InputError, match=f"--seed {2**63}: write 0 to {2**63 - 1}"):
        run(["simulate", "bench.toml", "--radec", "0,0,0", "--seed", str(2**63)])


@pytest.mark.parametrize(
    "words", [[], ["frame"], ["calibrate"], ["calibrate", "dots"]], ids=" ".join
)
def test_help_of_a_command_is_what_its_option_prints(words, capsys):
    assert not run([*words, "--help"])
    by_option = capsys.readouterr().out
    assert not run(["help", *words])
    assert capsys.readouterr().out == by_option


def test_help_of_no_command_says_which_was_meant(tmp_path):
    assert_refused(run_hilstar_here("help", "fram", cwd=tmp_path), 2, "did you mean frame?")


@pytest.mark.parametrize("words", [["frame", "verify"], ["calibrate", "dots", "psf"]], ids=" ".join)
def test_help_of_several_commands_is_refused(words, tmp_path):
    done = run_hilstar_here("help", *words, cwd=tmp_path)
    assert_refused(done, 2, f"names several commands; write hilstar help {' '.join(words[:-1])}")


def test_the_version_is_the_package_s(capsys):
    assert not run(["--version"])
    assert capsys.readouterr().out == f"hilstar {hilstar.__version__}\n"


def test_the_version_stands_in_one_place():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["hatch"]["version"]["path"] == "hilstar/basics/version.py"


def test_help_shows_the_name_of_a_table(capsys):
    """Rich takes [word] for markup, and shows nothing of it."""
    assert not run(["answers", "--help"])
    assert "by [answers]" in capsys.readouterr().out
