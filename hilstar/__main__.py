"""The door to the commands: what they import takes a third of a second, and Ctrl-C may come in it."""

from __future__ import annotations

import sys
from typing import NoReturn

INTERRUPTED = 130


def main() -> NoReturn:
    """Import the commands and run them."""
    try:
        from hilstar.cli import main as run

        run()
    except KeyboardInterrupt:
        print("hilstar: stopped", file=sys.stderr)
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
