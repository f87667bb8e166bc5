"""hilstar service: a systemd unit of this user that serves a bench, watched and restarted."""

import getpass
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hilstar.basics.errors import InputError, cannot_write, shortened
from hilstar.basics.files import refuse_existing, write_whole
from hilstar.cli.declare import argument, for_typer, option, struct, switch
from hilstar.cli.old_names import with_present_names
from hilstar.cli.options import bench_argument, json_option, overwrite_option, with_values
from hilstar.cli.running import UTC_MARK
from hilstar.cli.serve import serve
from hilstar.server.console.terminal import print_found, print_json, say

if TYPE_CHECKING:
    from hilstar.server.console.listener import ListenAddress

TOKEN_BYTES = 32  # as many as `secrets` itself takes by default
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
DISPLAY_VARIABLES = ("DISPLAY", "XAUTHORITY", "WAYLAND_DISPLAY")

UNIT = """\
# {path}: written by hilstar service install; install it again to change it.
[Unit]
Description=hilstar: the sky of {bench}
# However often it fails, it is started again.
StartLimitIntervalSec=0

[Service]
Type=notify
ExecStart={command}
WorkingDirectory={folder}
{display}# HILSTAR_TOKEN of the operator's page, where it has one; readable by you alone.
EnvironmentFile=-{tokens}
Restart=always
RestartSec=200ms
# A wrong command or file is not mended by trying again.
RestartPreventExitStatus=2
TimeoutStartSec=120
# Without a sign of life of the frame loop for so long, it is killed and started again.
WatchdogSec=3
KillMode=mixed
TimeoutStopSec=10
# What a run does not need is taken from it. Left are the network (attitudes, page), real-time
# priority, devices (GPU, serial ports), /tmp (the X server's socket), memory that a compiler writes
# and runs (OpenGL), and files of yours.
{confined}NoNewPrivileges=yes
SystemCallFilter={calls}
SystemCallErrorNumber=EPERM
SystemCallArchitectures=native
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictSUIDSGID=yes
LockPersonality=yes
UMask=0027

[Install]
WantedBy=default.target
"""


CONFINED = """\
PrivateUsers=yes
CapabilityBoundingSet=
"""
# @resources stays: it is needed for real-time priority and for pinning threads to cores.
DENIED_CALLS = (
    "~@clock @cpu-emulation @debug @module @mount @obsolete @privileged @raw-io @reboot @swap"
)
CLONE_NEWUSER, PR_CAPBSET_DROP = 0x10000000, 24
SYSTEMD_S = 30.0  # more than TimeoutStopSec, in which a run ends


@struct
class InstallOptions:
    """The options of `hilstar service install`."""

    bench_file: Path = bench_argument()
    serve_words: list[str] | None = argument(
        "[-- OPTIONS]", "Options of `hilstar serve`, such as `-- --console --control`."
    )
    name: str | None = option("NAME", "The service's name; by default the bench file's.")
    to_stdout: bool = switch("Print the unit, and write nothing.", "--print")
    overwrite: bool = overwrite_option()
    as_json: bool = json_option()


def install(options: InstallOptions) -> None:
    """Write a systemd unit of this user that serves a bench: watched, and back within seconds
    whenever it ends.
    """
    from hilstar.server.bench.bench_file import read_bench_file

    read_bench_file(options.bench_file)
    command_words, console = _checked(options.bench_file, options.serve_words or [])
    service = unit_name(options.name or options.bench_file.stem)
    path = units_folder() / service
    confined = can_confine()
    text = unit_text(path, options.bench_file.resolve(), command_words, confined)
    if not confined:
        say(
            "this system gives users no namespace of their own: the unit keeps the capabilities"
            " that systemd gives it"
        )
    fields: dict[str, Any] = {
        "service": service,
        "unit": str(path),
        "confined": confined,
        "text": text,
    }
    if options.to_stdout:
        if options.as_json:
            print_json(fields | {"token_file": None, "written": []})
        else:
            typer.echo(text, nl=False)
        return
    refuse_existing(path, options.overwrite)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
        token_file = None
        if console is not None and not console.is_loopback:
            token_file = path.with_suffix(".env")
            _make_token(token_file)
    except OSError as error:
        raise cannot_write(path, error) from error
    fields["token_file"] = None if token_file is None else str(token_file)
    fields["written"] = [str(path)]
    print_found(options.as_json, fields, [str(path)])
    say(
        "start it now and whenever you log in: systemctl --user daemon-reload && systemctl --user"
        f" enable --now {service}"
    )
    say(f"at boot as well, with nobody logged in: loginctl enable-linger {user_name()}")
    say(f"to be rid of it: hilstar service uninstall {_bare_name(service)}")


def _make_token(path: Path) -> None:
    """Write a token of the operator's page, which this user alone can read; one that is there
    stays.
    """
    import secrets  # hashes and random numbers, which no other command needs

    if path.exists():
        return
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(f"HILSTAR_TOKEN={secrets.token_urlsafe(TOKEN_BYTES)}\n")
    say(f"the token of the operator's page is in {path}")


def _bare_name(name: str) -> str:
    """A service's name without the ending and the prefix of its unit, or the ending of its bench
    file.
    """
    return name.removesuffix(".toml").removesuffix(".service").removeprefix("hilstar-")


@struct
class UninstallOptions:
    """The options of `hilstar service uninstall`."""

    name: str = argument(
        "NAME", "The service's name, as install printed it; by default the bench file's."
    )
    as_json: bool = json_option()


def uninstall(options: UninstallOptions) -> None:
    """Stop a service, and delete its unit and its token."""
    path = units_folder() / unit_name(_bare_name(options.name))
    if not os.path.lexists(path):
        units = path.parent.glob("hilstar-*.service")
        installed = sorted(_bare_name(unit.name) for unit in units)
        there = "there is none"
        if installed:
            there = f"there is {', '.join(installed)}"
        raise InputError(f"{path}: no such service; {there}")
    stopped = _systemctl("disable", "--now", path.name)
    try:
        for file in (path, path.with_suffix(".env")):
            file.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error
    _systemctl("daemon-reload")
    print_found(options.as_json, {"unit": str(path), "stopped": stopped}, [str(path)])
    if not stopped:
        say(
            "no systemd of this user was reached: if it still runs, systemctl --user stop"
            f" {path.name}"
        )


def _systemctl(*words: str) -> bool:
    """Run systemctl for this user. Returns whether it succeeded."""
    command = ["systemctl", "--user", *words]
    try:
        done = subprocess.run(command, capture_output=True, timeout=SYSTEMD_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def _checked(bench_file: Path, words: list[str]) -> "tuple[list[str], ListenAddress | None]":
    """The options of serve by their present names, and the address of its page, if it has one.
    Raises InputError for what serve refuses, and for what a unit cannot hold.
    """
    from hilstar.server.console.listener import parse_address

    serve_words = with_values(with_present_names(["serve", *words])[1:])
    alone = typer.Typer()
    alone.command()(for_typer(serve))
    command = typer.main.get_command(alone)
    try:
        values = command.make_context("serve", [str(bench_file), *serve_words]).params
    except Exception as error:  # typer's usage errors have no public base class in all its versions
        message = getattr(error, "format_message", None)
        if message is None:
            raise
        raise InputError(f"the options after --: {message()} (see hilstar serve --help)") from error
    if values["token"] is not None and "HILSTAR_TOKEN" not in os.environ:
        raise InputError(
            "--token: a unit is no place for it; write HILSTAR_TOKEN=... into the .env file beside"
            " the unit"
        )
    ledger = values["ledger"]
    if ledger is not None and UTC_MARK not in str(ledger):
        raise InputError(
            f"--ledger {ledger}: each start needs a ledger of its own; write run-{UTC_MARK}.mcap"
        )
    console = None
    if values["console"] is not None:
        console = parse_address(values["console"])
    return serve_words, console


def can_confine() -> bool:
    """Whether this user may drop capabilities: that takes a user namespace, which some systems
    allow only to root.
    """
    import ctypes  # 3 ms, and every command imports this module

    libc = ctypes.CDLL(None)
    child = os.fork()
    if child == 0:
        may_drop = os.geteuid() == 0 or libc.unshare(CLONE_NEWUSER) == 0
        if may_drop and libc.prctl(PR_CAPBSET_DROP, 0, 0, 0, 0) == 0:
            os._exit(0)
        os._exit(1)
    _, status = os.waitpid(child, 0)
    return status == 0


def unit_name(name: str) -> str:
    """The unit of a service of that name. Raises InputError."""
    if NAME.fullmatch(name) is None:
        raise InputError(
            f"--name {shortened(name)}: write letters, digits, - . or _, such as bench-2"
        )
    return f"hilstar-{name}.service"


def units_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """The folder of this user's systemd units. Raises InputError where the user has no home."""
    config = Path(environment.get("XDG_CONFIG_HOME", ""))
    # the standard has a relative path ignored
    if not config.is_absolute():
        try:
            config = Path.home() / ".config"
        except RuntimeError as error:
            raise InputError(
                f"user {user_name()} has no home directory for systemd's units: set HOME, or"
                " XDG_CONFIG_HOME to the folder of settings"
            ) from error
    return config / "systemd" / "user"


def user_name() -> str:
    """Who this is to the machine: a name, or a number where a container has no name for it."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # OSError from Python 3.13 on
        return str(os.getuid())


def unit_text(
    path: Path,
    bench: Path,
    options: list[str],
    confined: bool = True,
    environment: Mapping[str, str] = os.environ,
) -> str:
    """The unit at `path` that serves a bench file with these options of `hilstar serve`, from this
    folder.

    A `confined` one drops its capabilities, if `can_confine`.
    """
    program = [sys.executable, "-m", "hilstar"]
    script = shutil.which("hilstar", path=str(Path(sys.executable).parent))
    if script:
        program = [script]
    command = [*program, "serve", str(bench), *options]
    display = ""
    for name in DISPLAY_VARIABLES:
        if environment.get(name):
            variable = f"{name}={environment[name]}"
            display += f"Environment={_quoted(variable)}\n"
    return UNIT.format(
        path=path,
        bench=_literal(bench.name),
        command=" ".join(_quoted(word) for word in command),
        folder=_literal(str(Path.cwd())),
        display=display,
        tokens=_literal(str(path.with_suffix(".env"))),
        confined=CONFINED if confined else "",
        calls=DENIED_CALLS,
    )


def _literal(text: str) -> str:
    """Text without systemd's specifiers. Raises InputError for what a unit cannot hold."""
    if any(not character.isprintable() for character in text):
        raise InputError(f"{shortened(text)!r}: a unit cannot name it; give it a plain name")
    return text.replace("%", "%%")


def _quoted(word: str) -> str:
    """A word of a unit's command line. Raises InputError."""
    text = _literal(word).replace("\\", "\\\\").replace('"', '\\"').replace("$", "$$")
    if re.fullmatch(r"[A-Za-z0-9_@%+=:,./{}-]+", text):
        return text
    return f'"{text}"'
