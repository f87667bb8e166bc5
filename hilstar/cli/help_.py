"""hilstar help: the help of a command."""

from typer import Context

from hilstar.basics.errors import InputError
from hilstar.cli.completion import offered
from hilstar.cli.declare import argument, struct


def commands(ctx: Context, incomplete: str) -> list[str]:
    """The commands and groups; after a group its own commands, and after a command nothing."""
    from hilstar.cli.app import members, names

    named = ctx.params.get("command") or ()
    if not named:
        return offered(names)(incomplete)
    if len(named) == 1:
        return offered(members(named[0]))(incomplete)
    return []


@struct
class HelpOptions:
    """The options of `hilstar help`."""

    command: list[str] | None = argument(
        "[COMMAND]...",
        "A command, such as frame or calibrate dots; by default all of them.",
        autocompletion=commands,
    )


def help_(options: HelpOptions) -> None:
    """Show what a command does, and its options, as its --help does."""
    from hilstar.cli.app import GROUPS, run

    words = options.command or []
    command_words = 1
    if words and words[0] in GROUPS:
        command_words = 2
    if len(words) > command_words:
        command = " ".join(words[:command_words])
        raise InputError(
            f"help {' '.join(words)}: names several commands; write hilstar help {command}"
        )
    run([*words, "--help"])
