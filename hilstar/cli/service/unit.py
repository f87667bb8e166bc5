"""The systemd unit of a bench: a run that is started again whenever it ends, and watched."""

from __future__ import annotations

import ctypes
import os
import re
import secrets
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from hilstar.errors import InputError, shortened

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
# What a run does not need is taken from it. Left are the network (attitudes, page), real-time priority, devices (GPU, serial
# ports), /tmp (the X server's socket), memory that a compiler writes and runs (OpenGL), and files of yours.
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
# @resources stays: real-time priority, and the cores that threads are kept on.
DENIED_CALLS = "~@clock @cpu-emulation @debug @module @mount @obsolete @privileged @raw-io @reboot @swap"
CLONE_NEWUSER, PR_CAPBSET_DROP = 0x10000000, 24


def can_confine() -> bool:
    """Whether this user may give capabilities up: in a user namespace, which some systems allow to root alone."""
    libc = ctypes.CDLL(None)
    child = os.fork()
    if child == 0:
        may = (os.geteuid() == 0 or libc.unshare(CLONE_NEWUSER) == 0) and libc.prctl(PR_CAPBSET_DROP, 0, 0, 0, 0) == 0
        os._exit(0 if may else 1)
    return os.waitpid(child, 0)[1] == 0


def unit_name(name: str) -> str:
    """The unit of a service of that name. Raises InputError."""
    if NAME.fullmatch(name) is None:
        raise InputError(f"--name {shortened(name)}: write letters, digits, - . or _, such as bench-2")
    return f"hilstar-{name}.service"


def units_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Where systemd looks for this user's units."""
    named = environment.get("XDG_CONFIG_HOME", "")
    return (Path(named) if named.startswith("/") else Path.home() / ".config") / "systemd" / "user"


def unit_text(
    path: Path, bench: Path, options: list[str], confined: bool = True, environment: Mapping[str, str] = os.environ
) -> str:
    """The unit at `path` that serves a bench file with these options of `hilstar serve`, from this folder.

    It gives up its capabilities where it is `confined`, as `can_confine` says whether it may.
    """
    command = [*_hilstar(), "serve", str(bench), *options]
    folder = Path.cwd()
    found = {name: environment[name] for name in DISPLAY_VARIABLES if environment.get(name)}
    return UNIT.format(
        path=path,
        bench=_literal(bench.name),
        command=" ".join(_quoted(word) for word in command),
        folder=_literal(str(folder)),
        display="".join(f"Environment={_quoted(f'{name}={value}')}\n" for name, value in found.items()),
        tokens=_literal(str(path.with_suffix(".env"))),
        confined=CONFINED if confined else "",
        calls=DENIED_CALLS,
    )


def _hilstar() -> list[str]:
    script = shutil.which("hilstar", path=str(Path(sys.executable).parent))
    return [script] if script else [sys.executable, "-m", "hilstar"]


def _literal(text: str) -> str:
    """Text in which systemd sees no specifier. Raises InputError for what a unit cannot hold."""
    if any(not character.isprintable() for character in text):
        raise InputError(f"{shortened(text)!r}: a unit cannot name it; give it a plain name")
    return text.replace("%", "%%")


def _quoted(word: str) -> str:
    """A word of a command line of systemd's."""
    text = _literal(word).replace("\\", "\\\\").replace('"', '\\"').replace("$", "$$")
    return text if re.fullmatch(r"[A-Za-z0-9_@%+=:,./{}-]+", text) else f'"{text}"'


def write_token(path: Path) -> None:
    """Write a new token into a file that only this user can read. Raises OSError where there is one."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(f"HILSTAR_TOKEN={secrets.token_urlsafe(TOKEN_BYTES)}\n")
