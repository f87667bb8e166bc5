"""The table of commands, grouped as `hilstar --help` shows them."""

from functools import cache
from importlib import import_module
from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperCommand, TyperGroup, TyperOption

from hilstar.basics.errors import InputError
from hilstar.basics.version import __version__
from hilstar.cli.declare import for_typer

# By their panels, each a file of this folder and its function.
COMMANDS = {
    "Show stars": ("demo", "frame", "serve", "replay"),
    "Attitude streams": ("send", "attitude", "convert", "answers", "fmu", "keys"),
    "Check what is shown": ("simulate", "verify", "compare", "budget", "catalogue", "report"),
    "Test the tracker": ("accept", "assess", "campaign", "tracker", "confront"),
    "Calibrate": ("first_light", "latency", "certify"),
    "Study": ("study", "benchmark"),
    "This machine": ("doctor",),
    "Help": ("help_",),
}
CALIBRATE = (
    "Calibrate a bench: its geometry by dots or attitudes, its monitor by patches, its scale by"
    " stars."
)
SENSOR = "A tracker's sensor for the bench file, from its EMVA 1288 data sheet or its own frames."
OPTICS = (
    "A tracker's glass for `[tracker.optics] psf`: point spread functions by place, colour and"
    " focus."
)
SERVICE = "A run that this machine starts, watches, and starts again."
# The same of files with several commands.
GROUPS = {
    "calibrate": (
        "Calibrate",
        CALIBRATE,
        (
            "dots",
            "geometric",
            "psf",
            "focus",
            "alignment",
            "reference",
            "plan",
            "photometric",
            "scale",
        ),
    ),
    "sensor": ("Calibrate", SENSOR, ("import_", "measure")),
    "optics": ("Calibrate", OPTICS, ("map_", "lens", "zernike")),
    "service": ("This machine", SERVICE, ("install", "uninstall")),
}


VERSION = "--version"


class EarlyEnd(Exception):
    """Carries an EOFError through typer, which would take it for Ctrl-D, print an empty line and
    drop it.
    """

    def __init__(self, error: EOFError) -> None:
        super().__init__(str(error))
        self.error = error


class Commands(TyperGroup):
    """The group of commands, which hands their EOFErrors on."""

    def make_context(self, *arguments: Any, **named: Any) -> Any:
        """Parse the command line. Raises EarlyEnd."""
        try:
            return super().make_context(*arguments, **named)
        except EOFError as error:
            raise EarlyEnd(error) from error

    def invoke(self, ctx: Any) -> Any:
        """Run the command. Raises EarlyEnd."""
        try:
            return super().invoke(ctx)
        except EOFError as error:
            raise EarlyEnd(error) from error


class StatedOnce(TyperCommand):
    """A command that refuses two values where an option takes one."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words after the command's name. Raises InputError."""
        if not ctx.resilient_parsing:  # Tab completes a wrong line, too
            self._refuse_repeated(ctx, args)
        return super().parse_args(ctx, args)

    def _refuse_repeated(self, ctx: Any, args: list[str]) -> None:
        """Refuse (InputError) a second value, of which typer would drop the first in silence."""
        _, _, given = self.make_parser(ctx).parse_args(args=list(args))
        for parameter in self.params:
            if not isinstance(parameter, TyperOption) or parameter.is_flag or parameter.multiple:
                continue
            count = given.count(parameter)
            if count > 1:
                raise InputError(f"{parameter.opts[0]}: is given {count} times; write it once")


def print_version(wanted: bool) -> None:
    """Print the version and exit, if `wanted`."""
    if wanted:
        typer.echo(f"hilstar {__version__}")
        raise typer.Exit


def hilstar(
    _: Annotated[
        bool,
        Option(VERSION, callback=print_version, is_eager=True, help="Print the version and quit."),
    ] = False,
) -> None:
    """Show a star tracker on a bench the stars it would see: attitudes in, frames of code values
    out.
    """


def add(to: typer.Typer, file: str, name: str, panel: str | None = None) -> None:
    """Add the command of a function `name` in a file of this folder."""
    function = getattr(import_module(f"hilstar.cli.{file}"), name)
    to.command(public(name), cls=StatedOnce, rich_help_panel=panel)(for_typer(function))


def public(name: str) -> str:
    """A command's name from its function's: first-light from first_light."""
    return name.strip("_").replace("_", "-")


def names() -> list[str]:
    """The commands and groups, as `hilstar --help` orders them."""
    alone = [public(name) for panel in COMMANDS.values() for name in panel]
    return [*alone, *GROUPS]


def members(group: str) -> list[str]:
    """A group's own commands; none for the name of a command."""
    if group not in GROUPS:
        return []
    _, _, functions = GROUPS[group]
    return [public(name) for name in functions]


@cache
def application(only: str | None = None) -> typer.Typer:
    """The commands of `hilstar`; with `only`, that command or group alone, as importing all of them
    takes 50 ms.
    """
    app = typer.Typer(
        cls=Commands,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",  # "rich" would swallow a table's name, as in [answers]
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(hilstar)
    for panel, files in COMMANDS.items():
        for name in files:
            if only in (None, public(name)):
                add(app, name, name, panel)
    for group, (panel, group_help, functions) in GROUPS.items():
        if only in (None, group):
            members = typer.Typer(help=group_help)
            for name in functions:
                add(members, group, name)
            app.add_typer(members, name=group, rich_help_panel=panel)
    return app


@cache
def built(only: str | None) -> Any:
    """An application as typer runs it."""
    return typer.main.get_command(application(only))


def run(words: list[str]) -> Any:
    """Run a command line; one without a command prints the help, and its exit code is 2.

    Raises EarlyEnd, and what typer and the command raise.
    """
    # no command was given: the help lists them
    if not words or (len(words) == 1 and words[0] in GROUPS):
        run([*words, "--help"])
        return InputError.exit_code
    # the version needs no command, and an unknown word the names of all
    only = words[0] if words[0] in (*names(), VERSION) else None
    return built(only)(words, standalone_mode=False)
