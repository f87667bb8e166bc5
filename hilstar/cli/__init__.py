"""The `hilstar` command: words in, calls to the bench, words out. No physics, no GL."""

from __future__ import annotations

import logging
import os
import re
import sys
from typing import NoReturn

import typer

from hilstar.cli import bench, check, compare, light, run, show, stream
from hilstar.cli.common import app
from hilstar.console import fail
from hilstar.errors import HilstarError, InputError

__all__ = ["app", "bench", "check", "compare", "light", "main", "run", "show", "stream"]

INTERRUPTED = 130
SHARE_OPTIONS = ("--lose", "--corrupt", "--reorder")  # may stand alone
USUAL_SHARE = "5%"


def with_shares(words: list[str]) -> list[str]:
    """The command line with a share after each fault option that stands alone."""
    complete: list[str] = []
    for k, word in enumerate(words):
        following = "".join(words[k + 1 : k + 2])
        complete.append(word)
        if word in SHARE_OPTIONS and not re.match(r"[\d.]+%?$", following):
            complete.append(USUAL_SHARE)
    return complete


def main() -> NoReturn:
    """Run the command line; every refusal is one line on stderr and the exit code of the design's section 5."""
    logging.basicConfig(format="hilstar: %(message)s", stream=sys.stderr)
    try:
        code = app(with_shares(sys.argv[1:]), standalone_mode=False) or 0
        if code == INTERRUPTED:  # typer turns Ctrl-C into this code, and says nothing
            fail("stopped", INTERRUPTED)
        sys.exit(code)
    except HilstarError as error:
        fail(str(error), error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        fail("stopped", INTERRUPTED)
    except BrokenPipeError:
        # Whoever read our output has gone: nothing is left to say, and Python must not try at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        # typer's usage errors have no public base class in all its versions; they can format themselves.
        message = getattr(error, "format_message", None)
        if message is None:
            raise
        fail(f"{message()} (see hilstar --help)", InputError.exit_code)
