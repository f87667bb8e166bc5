"""Processes that outlive their test, as when a command that was killed had started another: they
are found and ended.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import signal
from pathlib import Path

COMMAND = re.compile(r"-m hilstar\b|hilstar\.(cli|__main__)|bin/hilstar\b")
PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h


def adopt_orphans() -> None:
    """From now on a process whose parent dies is this one's child, and can be found."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def living_children() -> dict[int, str]:
    """The command lines of this process's children that run (dead ones that nobody waited for
    are nothing).
    """
    found = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError, ValueError, IndexError):
            state, parent = stat.read_text().rpartition(")")[2].split()[:2]
            if int(parent) == os.getpid() and state != "Z":
                found[int(stat.parent.name)] = (
                    (stat.parent / "cmdline")
                    .read_bytes()
                    .replace(b"\0", b" ")
                    .decode(errors="replace")
                )
    return found


def end_hilstar_leftovers() -> list[str]:
    """Kill the children that are hilstar's commands; their command lines."""
    left = {
        number: command for number, command in living_children().items() if COMMAND.search(command)
    }
    for number in left:
        with contextlib.suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
    return list(left.values())
