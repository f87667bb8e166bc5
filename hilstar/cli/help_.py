"""hilstar help: the help of a command."""

from collections.abc import Iterable
from typing import Annotated

from typer import Argument

from hilstar.basics.errors import InputError
from hilstar.cli.completion import offered


def commands() -> Iterable[str]:
    """The commands and groups."""
    from hilstar.cli.app import names

    return names()


def help_(
    command: Annotated[
        list[str] | None,
        Argument(
            metavar="[COMMAND]...",
            help="A command, such as frame or calibrate dots; by default all of them.",
            autocompletion=offered(commands),
        ),
    ] = None,
) -> None:
    """Show what a command does, and its options, as its --help does."""
    from hilstar.cli.app import GROUPS, run

    words = command or []
    commands_named = 2 if words and words[0] in GROUPS else 1
    if len(words) > commands_named:
        named = " ".join(words[:commands_named])
        raise InputError(
            f"help {' '.join(words)}: names several commands; write hilstar help {named}"
        )
    run([*words, "--help"])
