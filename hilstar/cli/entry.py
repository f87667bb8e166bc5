"""The entry point of the command line: runs a command, and turns each refusal into one line and
an exit code.
"""

import contextlib
import io
import logging
import os
import re
import shlex
import sys
from collections.abc import Mapping
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any, NoReturn

import typer

from hilstar.basics.errors import HilstarError, InputError, MachineError, did_you_mean, shortened
from hilstar.basics.process import interrupts
from hilstar.basics.process.interrupts import finish_stderr, queue_stderr
from hilstar.basics.reading import add_kinds, exists
from hilstar.cli.app import EarlyEnd, run
from hilstar.cli.old_names import with_present_names
from hilstar.cli.options import with_values
from hilstar.server.console.terminal import fail

INTERRUPTED = 130  # typer's exit code of Ctrl-C
LOG_FORMAT = "hilstar: %(message)s"
# longest wait for a slow reader of stderr, without and with a signal
READER_WAITS_S, STOPPED_READER_WAITS_S = 1.0, 0.1
INPUT_ENDINGS = (".toml", ".mcap", ".csv", ".json", ".jsonl", ".fits", ".png", ".aem")
# several numbers, with commas
NUMBER_OPTIONS = ("--radec", "--quaternion", "--slew", "--place", "--mounting", "--reading")
# degrees, or sexagesimal
NUMBER = r"[-+]?(?:\d[\d.:hdms]*|\.\d+)(?:[eE][-+]?\d+)?"
# a word that a shell makes of numbers with spaces between them
NUMBERS = re.compile(rf",|,?{NUMBER}(?:,{NUMBER})*,?")
ELSEWHERE = dict.fromkeys(
    ("display", "displays", "monitors", "screens"), "`hilstar doctor` lists the displays"
)


def main() -> NoReturn:
    """Run the command line. Every refusal is one line on stderr and an exit code."""
    interrupts.install()
    queue_stderr()
    logging.basicConfig(format=LOG_FORMAT, stream=sys.stderr)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a file's name is printed with the bytes that it came with
        sys.stdout.reconfigure(errors="surrogateescape")
    code = run_command(sys.argv[1:])
    finish_stderr(READER_WAITS_S if interrupts.caught() is None else STOPPED_READER_WAITS_S)
    interrupts.leave(code)


def _kinds_of_logs() -> Mapping[bytes, str]:
    """How the kinds of logs begin, and their names: for the refusal of a file of another kind."""
    # 0.1 s, which only a refusal needs
    from hilstar.attitude.logs.log_formats import kinds

    return kinds()


def run_command(words: list[str]) -> int:
    """Run a command line in this process. Returns its exit code; a refusal is one line on
    stderr.
    """
    add_kinds(_kinds_of_logs)
    words = with_values(with_present_names(words))
    try:
        if not writes_to_stdout(words):
            return _run(words)
        if "--json" in words:
            fail(
                "--json and an output to -: both are for stdout; give a name for the output",
                InputError.exit_code,
            )
        with contextlib.redirect_stdout(sys.stderr):  # stdout is the file's alone
            return _run(words)
    except SystemExit as end:  # raised by `fail`
        return end.code if isinstance(end.code, int) else 1


def writes_to_stdout(words: list[str]) -> bool:
    """Whether an option of a command line has the value "-", as in -o - or --truth=-."""
    joined = any(re.fullmatch(r"--[a-z][a-z-]*=-|-o-", word) for word in words)
    return joined or any(
        word == "-" and before.startswith("-") and before != "-" for before, word in pairwise(words)
    )


def _run(words: list[str]) -> int:
    """The exit code of a command. Raises SystemExit where it is refused."""
    try:
        code = int(run(words) or 0)
        sys.stdout.flush()
        if code == INTERRUPTED:  # typer turns Ctrl-C into this code, and says nothing
            fail("stopped", interrupts.exit_code())
        return code
    except HilstarError as error:
        fail(str(error), error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        fail("stopped", interrupts.exit_code())
    except EarlyEnd as end:
        raise end.error from None
    except BrokenPipeError:
        # The reader of our output is gone: there is nobody to tell.
        _let_go_of_stdout()
        return 1
    except Exception as error:
        # typer's usage errors have no public base class in all its versions; they can format
        # themselves.
        if hasattr(error, "format_message"):
            fail(usage_line(error, words), InputError.exit_code)
        _fail_for_the_machine(error)
        raise


def usage_line(error: Any, words: list[str]) -> str:
    """The line for a wrong command line: typer's `error`, and what to write instead."""
    spaced = _spaced_numbers(words) or _spaced_star(words)
    if spaced is not None:
        return spaced
    message = str(error.format_message()).replace("Value error, ", "").rstrip(".")
    message = re.sub(r"a valid int\w*( range)?", "a whole number", message)
    message = re.sub(r"a valid float\w*( range)?", "a number", message)
    context = getattr(error, "ctx", None)
    program = "hilstar"
    if context is not None:
        program = context.command_path
    see = f"(see {program} --help)"
    missing = _missing_file(words)
    if missing is not None and message.startswith("Missing option"):
        return f"{missing}: no such file; give one that is there {see}"
    unknown = re.match(r"No such command '(.*?)'", message)
    if unknown and context is not None:
        advice = _advised_command(unknown[1], context.command)
        return f"No such command '{shortened(unknown[1])}'; {advice} {see}"
    if message.startswith("No such option") and context is not None:
        advice = _advised_option(error.option_name, context.command)
        return f"No such option: {shortened(error.option_name)}; {advice} {see}"
    choice = re.search(r"'([^']*)' is not one of (.*)", message)
    if choice:
        meant = did_you_mean(choice[1], re.findall(r"'(.*?)'", choice[2])).strip()
        if meant:
            message = f"{message}; {meant}"
        return f"{message} {see}"
    return f"{message} {see}"


def _advised_command(name: str, group: Any) -> str:
    """The command of a group that a wrong name means, else all of them."""
    known = list(getattr(group, "commands", {}))
    meant = did_you_mean(name, known).strip()
    return ELSEWHERE.get(name) or meant or f"the commands are {', '.join(known)}"


def _advised_option(name: str, command: Any) -> str:
    """The option of a command that a wrong name means, else all of them."""
    known = []
    for parameter in command.params:
        flags = (*parameter.opts, *parameter.secondary_opts)
        known += [flag for flag in flags if flag.startswith("-")]
    if not known:  # a group's own options are those of its commands
        return "write it after a command"
    return did_you_mean(name, known).strip() or f"its options are {', '.join(known)}"


def _missing_file(words: list[str]) -> str | None:
    """The first input of a command line that is not there, by its ending; None if there is none.

    It is said before an option that is missing too: with another file the option may be another.
    """
    for before, word in pairwise(words):
        if (
            not before.startswith("-")
            and Path(word).suffix.lower() in INPUT_ENDINGS
            and not exists(Path(word))
        ):
            return word
    return None


def _spaced_numbers(words: list[str]) -> str | None:
    """The line for an option whose numbers have spaces between them, such as --radec 84.057 -1.2
    0; None if there is none.
    """
    for k in range(len(words)):
        option, values = _values_after(words, k)
        if option not in NUMBER_OPTIONS:
            continue
        parts = list(takewhile(NUMBERS.fullmatch, values))
        if len(parts) > 1:
            # a shell makes words of "84.057, -1.2, 0" that keep their commas
            joined = ",".join(parts).replace(",", " ")
            numbers = ",".join(joined.split())
            return (
                f"{option} {' '.join(parts)}: write {option} {numbers}, with commas and without"
                " spaces"
            )
    return None


def _values_after(words: list[str], k: int) -> tuple[str, list[str]]:
    """The option that word k is, and the words from its value on, which may be joined to it."""
    option, is_joined, value = words[k].partition("=")
    values = words[k + 1 :]
    if is_joined:
        values = [value, *values]
    return option, values


def _spaced_star(words: list[str]) -> str | None:
    """The line for a star whose name has a space and no quotes, such as --star alpha Lyr; None if
    there is none.
    """
    from hilstar.sky.named_stars import is_star

    for k in range(len(words)):
        option, values = _values_after(words, k)
        name = " ".join(values[:2])
        if option == "--star" and len(values) > 1 and is_star(name.partition(",")[0]):
            return f"--star {name}: write --star {shlex.quote(name)}, with quotes around the name"
    return None


def _fail_for_the_machine(error: Exception) -> None:
    """Refuse in one line what the machine refuses: a full disk, a file that went away, not
    enough memory.
    """
    if isinstance(error, OSError) and error.strerror:
        what = "stdout, or a file that it names"
        if isinstance(error.filename, str | bytes):
            what = os.fsdecode(error.filename)
        else:
            _let_go_of_stdout()
        fail(
            f"{what}: cannot be written or read ({error.strerror}); choose another place",
            InputError.exit_code,
        )
    if isinstance(error, MemoryError):
        fail("not enough memory for this; give smaller files or sizes", MachineError.exit_code)


def _let_go_of_stdout() -> None:
    """Replace stdout, so that Python does not write to it again at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
