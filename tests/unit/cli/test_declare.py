"""Options that are declared once, as the fields of structs."""

import inspect
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from typing import get_type_hints

import pytest
import typer

from hilstar.basics.errors import InputError
from hilstar.cli.app import COMMANDS, GROUPS, application, members, run
from hilstar.cli.declare import argument, for_typer, option, struct, switch
from tests.support.commands import assert_refused, run_hilstar_here

FUNCTIONS = [(name, name) for panel in COMMANDS.values() for name in panel]
FUNCTIONS += [(group, name) for group, (_, _, names) in GROUPS.items() for name in names]


def parameters_of(command):
    """What typer makes of a command's structs, by name."""
    alone = typer.Typer()
    alone.command()(for_typer(command))
    return {parameter.name: parameter for parameter in typer.main.get_command(alone).params}


def values_of(command, *words):
    """The values that a command line gives a command's structs."""
    alone = typer.Typer(add_completion=False)
    alone.command()(for_typer(command))
    typer.main.get_command(alone)(list(words), standalone_mode=False)


@struct
class Shared:
    """Options of several commands."""

    loud: bool = switch("Say more.")
    seed: int = option("SEED", "Seed.", default=7, min=0)


@struct
class Own:
    """Options of one command."""

    log: Path = argument("LOG", "The log.")
    half_px: int | None = option("PX", "Half of a side.")
    output: Path = option("DIR", "The output.", "-o", "--output")


GIVEN: list[tuple[Own, Shared]] = []


def command(own: Own, shared: Shared) -> None:
    """Do it."""
    GIVEN.append((own, shared))


def test_a_field_is_an_option_of_its_name_or_of_its_flags():
    parameters = parameters_of(command)
    assert list(parameters)[:5] == ["log", "half_px", "output", "loud", "seed"]
    assert parameters["half_px"].opts == ["--half-px"]
    assert parameters["output"].opts == ["-o", "--output"]
    assert parameters["loud"].opts == ["--loud"]
    assert not parameters["loud"].secondary_opts


def test_a_field_that_admits_none_is_optional_and_another_without_a_default_is_not():
    parameters = parameters_of(command)
    required = {name for name, parameter in parameters.items() if parameter.required}
    assert required == {"log", "output"}
    assert parameters["seed"].default == 7


def test_a_command_gets_its_structs_filled():
    values_of(command, "a.csv", "-o", "d", "--seed", "3")
    own, shared = GIVEN.pop()
    assert (own.log, own.half_px, own.output) == (Path("a.csv"), None, Path("d"))
    assert (shared.loud, shared.seed) == (False, 3)


def test_two_structs_of_a_command_share_no_name():
    def twice(own: Own, other: Own) -> None:
        """Do it."""

    with pytest.raises(ValueError, match="duplicate parameter name"):
        for_typer(twice)


@pytest.mark.parametrize(("file", "name"), FUNCTIONS)
def test_every_option_of_every_command_is_a_field(file, name):
    function = getattr(import_module(f"hilstar.cli.{file}"), name)
    structs = get_type_hints(function)
    structs.pop("return")
    assert list(structs) == list(inspect.signature(function).parameters)
    assert all(map(is_dataclass, structs.values()))
    # each help has --json at its end
    parameters = list(inspect.signature(for_typer(function)).parameters)
    assert "as_json" not in parameters[:-1]


def test_a_second_value_of_an_option_is_refused(tmp_path):
    words = ["frame", "bench.toml", "--star", "Vega", "--star", "Sirius", "-o", "o.fits"]
    done = run_hilstar_here(*words, cwd=tmp_path)
    assert_refused(done, 2, "--star: is given 2 times; write it once")


def test_an_option_by_two_of_its_names_is_one():
    with pytest.raises(InputError, match="-o: is given 2 times"):
        run(["keys", "-o", "a", "--output=b"])


@pytest.mark.parametrize(
    "words",
    [
        ["keys", "--json", "--json", "--help"],
        ["campaign", "p.toml", "-o", "d", "--console-name", "a", "--console-name", "b", "--help"],
    ],
    ids=lambda words: words[0],
)
def test_a_switch_may_be_repeated_and_so_may_an_option_of_several_values(words, capsys):
    assert not run(words)
    assert "Usage:" in capsys.readouterr().out


def test_help_offers_a_group_s_own_commands():
    # one of its own: a context here has other names of --help than the program's, which it keeps
    command = typer.main.get_command(application("help")).commands["help"]
    (named,) = [parameter for parameter in command.params if parameter.name == "command"]

    def offered(words, incomplete):
        with command.make_context("help", list(words), resilient_parsing=True) as ctx:
            return [item.value for item in named.shell_complete(ctx, incomplete)]

    assert "calibrate" in offered([], "")
    assert offered(["calibrate"], "") == members("calibrate")
    assert offered(["calibrate"], "geo") == ["geometric"]
    assert offered(["frame"], "") == []
    assert offered(["calibrate", "dots"], "") == []
