"""The `hilstar` command: words in, calls to the rooms below, words out. No physics, no GL."""

from hilstar.cli.entry import main, run_command

__all__ = ["main", "run_command"]
