"""The door of the command line: what runs a command, and turns each refusal into one line and an exit code."""

from __future__ import annotations

import io
import logging
import os
import re
import sys
from typing import NoReturn

import typer

from hilstar.cli.app import EarlyEnd, app
from hilstar.console.terminal import fail
from hilstar.errors import HilstarError, InputError, MachineError
from hilstar.process import interrupts
from hilstar.process.stderr import finish_stderr, queue_stderr

INTERRUPTED = 130
LOG_FORMAT = "hilstar: %(message)s"
READER_WAITS_S, STOPPED_READER_WAITS_S = 1.0, 0.1  # how long a slow reader of stderr is waited for, without and with a signal
ADDRESS = re.compile(
    r"(\[?[0-9A-Za-z.:-]*\]?:)?\d{1,6}|localhost|\d+(\.\d+){3}|\[[0-9A-Fa-f:.]+\]"
)  # what --console may be followed by
SHARE_OPTIONS = ("--lose", "--corrupt", "--reorder")  # may stand alone
USUAL_SHARE = "5%"
USUAL_ADDRESS = "127.0.0.1:8765"


def with_values(words: list[str]) -> list[str]:
    """The command line with a share after each fault option that stands alone, and an address after --console."""
    complete: list[str] = []
    for k, word in enumerate(words):
        following = "".join(words[k + 1 : k + 2])
        complete.append(word)
        if word in SHARE_OPTIONS and not re.match(r"[\d.]+%?$", following):
            complete.append(USUAL_SHARE)
        if word == "--console" and not ADDRESS.fullmatch(following):
            complete.append(USUAL_ADDRESS)
    return complete


def main() -> NoReturn:
    """Run the command line; every refusal is one line on stderr and the exit code of the design's section 5."""
    interrupts.install()
    queue_stderr()
    logging.basicConfig(format=LOG_FORMAT, stream=sys.stderr)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="surrogateescape")  # a file's name goes out as the bytes that came in
    code = run_command(sys.argv[1:])
    finish_stderr(READER_WAITS_S if interrupts.caught() is None else STOPPED_READER_WAITS_S)
    interrupts.leave(code)


def run_command(words: list[str]) -> int:
    """Run a command line in this process; its exit code, a refusal's one line on stderr."""
    try:
        return _run(with_values(words))
    except SystemExit as end:  # of `fail`
        return end.code if isinstance(end.code, int) else 1


def _run(words: list[str]) -> int:
    """The exit code of a command; SystemExit where it is refused."""
    try:
        code = int(app(words, standalone_mode=False) or 0)
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
        # Whoever read our output has gone: nothing is left to say.
        _let_go_of_stdout()
        return 1
    except Exception as error:
        # typer's usage errors have no public base class in all its versions; they can format themselves.
        message = getattr(error, "format_message", None)
        if message is not None:
            fail(f"{message()} (see hilstar --help)", InputError.exit_code)
        _fail_for_the_machine(error)
        raise


def _fail_for_the_machine(error: Exception) -> None:
    """Refuse what the machine refuses: an output that takes no more, a file that went away, memory that is not there."""
    if isinstance(error, OSError) and error.strerror:
        what = "stdout, or a file that it names"
        if isinstance(error.filename, str | bytes):
            what = os.fsdecode(error.filename)
        else:
            _let_go_of_stdout()
        fail(f"{what}: cannot be written or read ({error.strerror}); choose another place", InputError.exit_code)
    if isinstance(error, MemoryError):
        fail("not enough memory for this; give smaller files or sizes", MachineError.exit_code)


def _let_go_of_stdout() -> None:
    """Python must not try once more at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
