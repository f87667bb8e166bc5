"""The table of commands, grouped as `hilstar --help` shows them."""

import copy
import sys
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from hilstar.cli.answers import answers
from hilstar.cli.assess import assess
from hilstar.cli.attitude import attitude
from hilstar.cli.benchmark import benchmark
from hilstar.cli.budget import budget
from hilstar.cli.calibrate import alignment, dots, geometric, photometric, plan, psf, scale
from hilstar.cli.campaign import campaign
from hilstar.cli.catalogue import catalogue
from hilstar.cli.certify import certify
from hilstar.cli.compare import compare
from hilstar.cli.confront import confront
from hilstar.cli.convert import convert
from hilstar.cli.demo import demo
from hilstar.cli.doctor import doctor
from hilstar.cli.first_light import first_light
from hilstar.cli.fmu import fmu
from hilstar.cli.frame import frame
from hilstar.cli.keys import keys
from hilstar.cli.latency import latency
from hilstar.cli.optics import lens, map_, zernike
from hilstar.cli.replay import replay
from hilstar.cli.report import report
from hilstar.cli.send import send
from hilstar.cli.sensor import import_, measure
from hilstar.cli.serve import serve
from hilstar.cli.service import install, uninstall
from hilstar.cli.simulate import simulate
from hilstar.cli.study import study
from hilstar.cli.tracker import tracker
from hilstar.cli.verify import verify
from hilstar.version import __version__

COMMANDS: dict[str, tuple[Callable[..., None], ...]] = {
    "Show stars": (demo, frame, serve, replay),
    "Attitude streams": (send, attitude, convert, answers, fmu, keys),
    "Check what is shown": (simulate, verify, compare, budget, catalogue, report),
    "Test the tracker": (assess, campaign, tracker, confront),
    "Calibrate": (first_light, latency, certify),
    "Study": (study, benchmark),
    "This machine": (doctor,),
}


class EarlyEnd(Exception):
    """Carries an EOFError through typer, which would take it for Ctrl-D, print an empty line and drop it."""

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


class Application(typer.Typer):
    """The commands of `hilstar`. Only the one that is called is built, and once: all of them take 40 ms, a third of a start."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Run a command line, by default this process' own. Raises EarlyEnd."""
        words = arguments[0] if arguments else sys.argv[1:]
        names = [each.name for each in self.registered_commands] + [each.name for each in self.registered_groups]
        return built(self, words[0] if words and words[0] in names else None)(*arguments, **named)

    def with_one(self, name: str | None) -> "Application":
        """The application with only the command or group of this name; whole without a name."""
        if name is None:
            return self
        one = copy.copy(self)
        one.registered_commands = [each for each in self.registered_commands if each.name == name]
        one.registered_groups = [each for each in self.registered_groups if each.name == name]
        return one


@cache
def built(application: Application, name: str | None) -> Any:
    """What typer makes of an application to run one of its commands, or any of them."""
    return typer.main.get_command(application.with_one(name))


app = Application(
    cls=Commands,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",  # "rich" would swallow a table's name, as in [answers]
    context_settings={"help_option_names": ["-h", "--help"]},
)
calibrate = typer.Typer(
    help="Calibrate a bench: its geometry by dots or attitudes, its monitor by patches, its scale by stars."
)
sensor = typer.Typer(help="A tracker's sensor for the bench file, from its EMVA 1288 data sheet or its own frames.")
optics = typer.Typer(help="A tracker's glass for `[tracker.optics] psf`: point spread functions by place, colour and focus.")
service = typer.Typer()


def print_version(wanted: bool) -> None:
    """Print the version and exit, if `wanted`."""
    if wanted:
        typer.echo(f"hilstar {__version__}")
        raise typer.Exit


@app.callback()
def hilstar(
    _: Annotated[
        bool, typer.Option("--version", callback=print_version, is_eager=True, help="Print the version and quit.")
    ] = False,
) -> None:
    """Show a star tracker on a bench the stars it would see: attitudes in, frames of code values out."""


@service.callback()
def of_this_machine() -> None:
    """A run that this machine starts, watches, and starts again."""


for panel, commands in COMMANDS.items():
    for command in commands:
        app.command(command.__name__.replace("_", "-"), rich_help_panel=panel)(command)
for command in (dots, geometric, psf, alignment, plan, photometric, scale):
    calibrate.command()(command)
app.add_typer(calibrate, name="calibrate", rich_help_panel="Calibrate")
sensor.command("import")(import_)
sensor.command()(measure)
app.add_typer(sensor, name="sensor", rich_help_panel="Calibrate")
optics.command("map")(map_)
optics.command()(lens)
optics.command()(zernike)
app.add_typer(optics, name="optics", rich_help_panel="Calibrate")
service.command()(install)
service.command()(uninstall)
app.add_typer(service, name="service", rich_help_panel="This machine")
