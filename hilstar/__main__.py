"""The door to the commands: what they import takes a third of a second, and Ctrl-C may come in it."""

from __future__ import annotations

import sys
from typing import NoReturn

from hilstar.process import interrupts
from hilstar.process.stderr import finish_stderr

READER_WAITS_S = 0.1  # for a reader of stderr that sleeps


def main() -> NoReturn:
    """Import the commands and run them."""
    try:
        interrupts.install()
        from hilstar.cli import main as run

        run()
    except KeyboardInterrupt:
        print("hilstar: stopped", file=sys.stderr)
        finish_stderr(READER_WAITS_S)
        interrupts.leave(interrupts.exit_code())


if __name__ == "__main__":
    main()
