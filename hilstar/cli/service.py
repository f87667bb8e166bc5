"""hilstar service: a systemd unit of this user that serves a bench, watched and restarted."""

import getpass
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from hilstar.basics.errors import InputError, cannot_write, shortened
from hilstar.basics.files import refuse_existing, write_whole
from hilstar.cli.old_names import with_present_names
from hilstar.cli.options import BenchFile, Json, Overwrite, with_values
from hilstar.cli.running import UTC_MARK
from hilstar.cli.serve import serve
from hilstar.server.console.terminal import print_found, print_json, say

if TYPE_CHECKING:
    from hilstar.server.console.listener import ListenAddress

TOKEN_BYTES = 32
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


def install(
    bench_file: BenchFile,
    options: Annotated[
        list[str] | None,
        Argument(
            metavar="[-- OPTIONS]",
            help="Options of `hilstar serve`, such as `-- --console --control`.",
        ),
    ] = None,
    name: Annotated[
        str | None, Option(metavar="NAME", help="The service's name; by default the bench file's.")
    ] = None,
    to_stdout: Annotated[
        bool, Option("--print", help="Print the unit, and write nothing.")
    ] = False,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Write a systemd unit of this user that serves a bench: watched, and back within seconds
    whenever it ends.
    """
    from hilstar.server.bench.bench_file import read_bench_file

    read_bench_file(bench_file)
    command_words, console = _checked(bench_file, options or [])
    service = unit_name(name or bench_file.stem)
    path = units_folder() / service
    confined = can_confine()
    text = unit_text(path, bench_file.resolve(), command_words, confined)
    if not confined:
        say(
            "this system gives users no namespace of their own: the unit keeps the capabilities"
            " that systemd gives it"
        )
    fields = {"service": service, "unit": str(path), "confined": confined, "text": text}
    if to_stdout:
        if as_json:
            print_json(fields | {"token_file": None, "written": []})
        else:
            typer.echo(text, nl=False)
        return
    refuse_existing(path, overwrite)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
        tokens = path.with_suffix(".env")
        if console is None or console.is_loopback:
            token_file = None
        else:
            token_file = str(tokens)
        if token_file is not None and not tokens.exists():
            import secrets  # hashes and random numbers, which no other command needs

            with os.fdopen(
                os.open(tokens, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w"
            ) as file:
                file.write(f"HILSTAR_TOKEN={secrets.token_urlsafe(TOKEN_BYTES)}\n")
            say(f"the token of the operator's page is in {tokens}")
    except OSError as error:
        raise cannot_write(path, error) from error
    print_found(as_json, fields | {"token_file": token_file, "written": [str(path)]}, [str(path)])
    say(
        "start it now and whenever you log in: systemctl --user daemon-reload && systemctl --user"
        f" enable --now {service}"
    )
    say(f"at boot as well, with nobody logged in: loginctl enable-linger {getpass.getuser()}")
    say(
        "to be rid of it: hilstar service uninstall"
        f" {service.removeprefix('hilstar-').removesuffix('.service')}"
    )


def uninstall(
    name: Annotated[
        str,
        Argument(
            metavar="NAME",
            help="The service's name, as install printed it; by default the bench file's.",
        ),
    ],
    as_json: Json = False,
) -> None:
    """Stop a service, and delete its unit and its token."""
    bare = name.removesuffix(".toml").removesuffix(".service").removeprefix("hilstar-")
    path = units_folder() / unit_name(bare)
    if not os.path.lexists(path):
        installed = sorted(
            unit_path.stem.removeprefix("hilstar-")
            for unit_path in path.parent.glob("hilstar-*.service")
        )
        if installed:
            there = f"there is {', '.join(installed)}"
        else:
            there = "there is none"
        raise InputError(f"{path}: no such service; {there}")
    stopped = _systemctl("disable", "--now", path.name)
    try:
        for file in (path, path.with_suffix(".env")):
            file.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error
    _systemctl("daemon-reload")
    print_found(as_json, {"unit": str(path), "stopped": stopped}, [str(path)])
    if not stopped:
        say(
            "no systemd of this user was reached: if it still runs, systemctl --user stop"
            f" {path.name}"
        )


def _systemctl(*words: str) -> bool:
    try:
        done = subprocess.run(
            ["systemctl", "--user", *words], capture_output=True, timeout=SYSTEMD_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def _checked(bench_file: Path, options: list[str]) -> "tuple[list[str], ListenAddress | None]":
    from hilstar.server.console.listener import parse_address

    option_words = with_values(with_present_names(["serve", *options])[1:])
    alone = typer.Typer()
    alone.command()(serve)
    try:
        given = (
            typer.main.get_command(alone)
            .make_context("serve", [str(bench_file), *option_words])
            .params
        )
    except Exception as error:  # typer's usage errors have no public base class in all its versions
        message = getattr(error, "format_message", None)
        if message is None:
            raise
        raise InputError(f"the options after --: {message()} (see hilstar serve --help)") from error
    if given["token"] is not None and "HILSTAR_TOKEN" not in os.environ:
        raise InputError(
            "--token: a unit is no place for it; write HILSTAR_TOKEN=... into the .env file beside"
            " the unit"
        )
    if given["ledger"] is not None and UTC_MARK not in str(given["ledger"]):
        raise InputError(
            f"--ledger {given['ledger']}: each start needs a ledger of its own; write"
            f" run-{UTC_MARK}.mcap"
        )
    return option_words, None if given["console"] is None else parse_address(given["console"])


def can_confine() -> bool:
    """Whether this user may drop capabilities: that takes a user namespace, which some systems
    allow only to root.
    """
    import ctypes  # 3 ms, and every command imports this module

    libc = ctypes.CDLL(None)
    child = os.fork()
    if child == 0:
        may = (os.geteuid() == 0 or libc.unshare(CLONE_NEWUSER) == 0) and libc.prctl(
            PR_CAPBSET_DROP, 0, 0, 0, 0
        ) == 0
        os._exit(0 if may else 1)
    return os.waitpid(child, 0)[1] == 0


def unit_name(name: str) -> str:
    """The unit of a service of that name. Raises InputError."""
    if NAME.fullmatch(name) is None:
        raise InputError(
            f"--name {shortened(name)}: write letters, digits, - . or _, such as bench-2"
        )
    return f"hilstar-{name}.service"


def units_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """The folder of this user's systemd units."""
    named = environment.get("XDG_CONFIG_HOME", "")
    return (Path(named) if named.startswith("/") else Path.home() / ".config") / "systemd" / "user"


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
    script = shutil.which("hilstar", path=str(Path(sys.executable).parent))
    command = [
        *([script] if script else [sys.executable, "-m", "hilstar"]),
        "serve",
        str(bench),
        *options,
    ]
    folder = Path.cwd()
    display_variables = {
        name: environment[name] for name in DISPLAY_VARIABLES if environment.get(name)
    }
    return UNIT.format(
        path=path,
        bench=_literal(bench.name),
        command=" ".join(_quoted(word) for word in command),
        folder=_literal(str(folder)),
        display="".join(
            f"Environment={_quoted(f'{name}={value}')}\n"
            for name, value in display_variables.items()
        ),
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
    text = _literal(word).replace("\\", "\\\\").replace('"', '\\"').replace("$", "$$")
    if re.fullmatch(r"[A-Za-z0-9_@%+=:,./{}-]+", text):
        return text
    return f'"{text}"'
