"""commands.md from the functions that the commands are: their signatures, typer's options and
their docstrings.
"""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from typer import Typer
from typer.models import ArgumentInfo, OptionInfo, ParameterInfo

from hilstar.basics.errors import InputError, MachineError
from hilstar.cli.app import application

MAX_BOUND = 1e6  # a larger limit only keeps arithmetic within its types; nobody meets it
TYPE_WORDS = {int: "N", float: "X", str: "TEXT", Path: "PATH"}

HEAD = f"""\
# Commands

`hilstar help COMMAND` (or `hilstar COMMAND -h`) prints the same for one command, and `hilstar --version` the version. This page is
generated from the commands themselves (`python tools/make_pages.py`).

Every command that has `--json` then prints one JSON object on stdout and nothing else there. An output named `-`
is stdout, for CSV and TOML alone; what the command says then goes to stderr.

A switch may be repeated. An option that takes one value is given once: a second one is refused.

An option of several commands has one meaning in all of them:

| option | meaning |
|---|---|
| `--frames N` | how many frames |
| `--rate HZ` | how many a second: packets, or answers |
| `--at SECONDS` | the moment, after `[sky] epoch_utc` or in a scenario |
| `--to TARGET` | where packets go |
| `--duration SECONDS` | how long a command runs |
| `--wait SECONDS` | how long it waits for the other side |
| `--feed ENDPOINT` | where frames go to whoever watches |
| `--radec`, `--star`, `--quaternion` | where the camera points |

| exit code | meaning |
|---|---|
| 0 | Done. |
| 1 | `compare`: not the same sky; `verify --strict`: not passed; `first-light`: a failed step; \
`serve` and `replay`: the ledger failed, or with `--strict` the sky was late or wrong. |
| {InputError.exit_code} | The command line or a file was wrong. |
| {MachineError.exit_code} | The machine lacks something, such as OpenGL, or a display or port that a file names, \
or its display went away. |
| 4 | `serve`: the run ended without ever having had an attitude. |
| 128 + N | Ended by signal N: 130 for Ctrl-C. |

A refusal is one line on stderr that says what is wrong, where, and what to write or install instead.

`serve` and `replay` end in order on SIGINT, SIGTERM and SIGHUP, and every other command within a second; a second signal
ends them at once.
"""


@dataclass(frozen=True, slots=True)
class Parameter:
    """An argument or an option of a command, as its page lists it."""

    flags: tuple[str, ...]  # empty for an argument
    value: str  # "N", "OUT.fits"; empty for a flag
    meaning: str
    default: str  # empty where there is none to tell
    required: bool

    @property
    def usage(self) -> str:
        """How it stands on a command line: `BENCH.toml`, `[--seed N]`."""
        words = " ".join(filter(None, (*self.flags[:1], self.value)))
        if self.required or words.startswith("["):
            return words
        return f"[{words}]"

    @property
    def line(self) -> str:
        """Its line of the list."""
        words = " ".join(filter(None, (", ".join(self.flags), self.value)))
        note = ""
        if self.required:
            note = " (required)"
        elif self.default:
            note = f" (default `{self.default}`)"
        return f"- `{words}`{note}: {self.meaning}"


def page() -> str:
    """The page: the commands in the panels of `hilstar --help`."""
    sections: dict[str, list[str]] = {}  # by their panels
    for panel, name, command in commands_of(application()):
        sections.setdefault(panel, []).append(section(name, command))
    parts = [HEAD]
    for panel, texts in sections.items():
        parts += [f"## {panel}\n", *texts]
    return "\n".join(parts)


def commands_of(
    group: Typer, prefix: str = "", panel: str = ""
) -> Iterator[tuple[str, str, Callable[..., Any]]]:
    """Each command's panel, name ("calibrate plan") and function; a group's commands are in its
    own panel.
    """
    for info in group.registered_commands:
        if info.callback is None:
            raise TypeError("a command is a function")
        name = info.name or info.callback.__name__.replace("_", "-")
        yield panel or str(info.rich_help_panel), prefix + name, info.callback
    for inner in group.registered_groups:
        if inner.typer_instance is not None:
            yield from commands_of(
                inner.typer_instance, f"{prefix}{inner.name} ", str(inner.rich_help_panel)
            )


def section(name: str, command: Callable[..., Any]) -> str:
    """The command's part of the page."""
    parameters = sorted(parameters_of(command), key=lambda p: (bool(p.flags), not p.required))
    # an option and its value stay on one line
    words = [parameter.usage.replace(" ", "\0") for parameter in parameters]
    usage = textwrap.fill(
        " ".join(["hilstar", name, *words]),
        width=92,
        subsequent_indent=" " * (len(name) + 9),
        break_long_words=False,
        break_on_hyphens=False,
    ).replace("\0", " ")
    lines = "\n".join(parameter.line for parameter in parameters)
    return f"### hilstar {name}\n\n{inspect.getdoc(command)}\n\n```text\n{usage}\n```\n\n{lines}\n"


def parameters_of(command: Callable[..., Any]) -> Iterator[Parameter]:
    """The arguments and options in the order of the function's signature."""
    for name, parameter in inspect.signature(command).parameters.items():
        info = parameter.default
        if not isinstance(info, ParameterInfo):
            raise TypeError(f"{name}: is neither an option nor an argument of typer's")
        if info.hidden:
            continue
        kind = parameter.annotation
        flags: tuple[str, ...] = ()
        if isinstance(info, OptionInfo):
            flags = tuple(info.param_decls or ())
        value = ""
        if kind is not bool:
            value = info.metavar or type_word(kind, name, info)
        is_required = info.default is ...
        default = "" if is_required else default_text(info.default)
        yield Parameter(flags, value, meaning_of(info), default, is_required)


def type_word(kind: Any, name: str, info: ParameterInfo) -> str:
    """What stands for the value where the option names nothing: its choices, or a word for its
    type.
    """
    if get_origin(kind) in (Union, UnionType):
        kind = next(inner for inner in get_args(kind) if inner is not type(None))
    if get_origin(kind) is Literal:
        return "|".join(map(str, get_args(kind)))
    if isinstance(kind, type) and issubclass(kind, Enum):
        return "|".join(str(choice.value) for choice in kind)
    if isinstance(info, ArgumentInfo):
        return name.upper()
    return TYPE_WORDS[kind]


def meaning_of(info: ParameterInfo) -> str:
    """Its help, with the limits of its value."""
    low = info.min
    high = info.max
    if high is not None and high >= MAX_BOUND:
        high = None
    limits = ""
    if low is not None and high is not None:
        limits = f" {low:g} to {high:g}."
    elif low is not None and low > 0:
        limits = f" {low:g} or more."
    return f"{info.help}{limits}"


def default_text(default: Any) -> str:
    """A default that says something: no flag's False, no None, no empty text."""
    if default is None or default is False or default == "":
        return ""
    if isinstance(default, float):
        return f"{default:g}"
    if isinstance(default, Enum):
        default = default.value
    return str(default)
