"""hilstar service: a run that this machine starts, watches and starts again."""

from __future__ import annotations

import getpass
import os
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilstar.cli.options import BenchFile, Overwrite
from hilstar.cli.show.running import UTC_MARK
from hilstar.console.terminal import say
from hilstar.errors import InputError, cannot_write

if TYPE_CHECKING:
    from hilstar.console.listener import ListenAddress

SYSTEMD_S = 30.0  # a run ends within TimeoutStopSec


def install(
    bench_file: BenchFile,
    options: Annotated[
        list[str] | None,
        typer.Argument(metavar="[-- OPTIONS]", help="Options of `hilstar serve`, such as `-- --console --control`."),
    ] = None,
    name: Annotated[str | None, typer.Option(metavar="NAME", help="The service's name; by default the bench file's.")] = None,
    to_stdout: Annotated[bool, typer.Option("--print", help="Print the unit, and write nothing.")] = False,
    overwrite: Overwrite = False,
) -> None:
    """Write a systemd unit of this user that serves a bench: watched, and back within seconds whenever it ends."""
    from hilstar.bench.bench_file import read_bench_file
    from hilstar.cli.service.unit import can_confine, unit_name, unit_text, units_folder, write_token
    from hilstar.files import refuse_existing, write_whole

    read_bench_file(bench_file)
    words, console = _checked(bench_file, options or [])
    service = unit_name(name or bench_file.stem)
    path = units_folder() / service
    confined = can_confine()
    text = unit_text(path, bench_file.resolve(), words, confined)
    if not confined:
        say("this system gives users no namespace of their own: the unit keeps the capabilities that systemd gives it")
    if to_stdout:
        typer.echo(text, nl=False)
        return
    refuse_existing(path, overwrite)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
        tokens = path.with_suffix(".env")
        if console is not None and not console.is_loopback and not tokens.exists():
            write_token(tokens)
            say(f"the token of the operator's page is in {tokens}")
    except OSError as error:
        raise cannot_write(path, error) from error
    typer.echo(str(path))
    say(f"start it now and whenever you log in: systemctl --user daemon-reload && systemctl --user enable --now {service}")
    say(f"at boot as well, with nobody logged in: loginctl enable-linger {getpass.getuser()}")
    say(f"to be rid of it: hilstar service uninstall {service.removeprefix('hilstar-').removesuffix('.service')}")


def uninstall(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="The service's name, as install printed it; by default the bench file's.")
    ],
) -> None:
    """Stop a service, and delete its unit and its token."""
    from hilstar.cli.service.unit import unit_name, units_folder

    bare = name.removesuffix(".toml").removesuffix(".service").removeprefix("hilstar-")
    path = units_folder() / unit_name(bare)
    if not os.path.lexists(path):
        found = sorted(each.stem.removeprefix("hilstar-") for each in path.parent.glob("hilstar-*.service"))
        there = f"there is {', '.join(found)}" if found else "there is none"
        raise InputError(f"{path}: no such service; {there}")
    stopped = _systemctl("disable", "--now", path.name)
    try:
        for file in (path, path.with_suffix(".env")):
            file.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error
    _systemctl("daemon-reload")
    typer.echo(str(path))
    if not stopped:
        say(f"no systemd of this user was reached: if it still runs, systemctl --user stop {path.name}")


def _systemctl(*words: str) -> bool:
    """Whether systemd has done something; False where there is none."""
    try:
        done = subprocess.run(["systemctl", "--user", *words], capture_output=True, timeout=SYSTEMD_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def _checked(bench_file: Path, options: list[str]) -> tuple[list[str], ListenAddress | None]:
    """The options, if `hilstar serve` takes them, and where its page will be. Raises InputError."""
    from hilstar.cli.parsers import with_values
    from hilstar.cli.show.serve import serve
    from hilstar.console.listener import parse_address

    words = with_values(options)
    alone = typer.Typer()
    alone.command()(serve)
    try:
        given = typer.main.get_command(alone).make_context("serve", [str(bench_file), *words]).params
    except Exception as error:  # typer's usage errors have no public base class in all its versions
        message = getattr(error, "format_message", None)
        if message is None:
            raise
        raise InputError(f"the options after --: {message()} (see hilstar serve --help)") from error
    if given["token"] is not None and "HILSTAR_TOKEN" not in os.environ:
        raise InputError("--token: a unit is no place for it; write HILSTAR_TOKEN=... into the .env file beside the unit")
    if given["ledger"] is not None and UTC_MARK not in str(given["ledger"]):
        raise InputError(f"--ledger {given['ledger']}: each start needs a ledger of its own; write run-{UTC_MARK}.mcap")
    return words, None if given["console"] is None else parse_address(given["console"])
