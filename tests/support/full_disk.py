"""A limit on the size of files, which stands for a disk without room.

Python would write its compiled modules under the limit as well, and a truncated one stops whoever
imports it afterwards.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

WITHOUT_BYTECODE = {"PYTHONDONTWRITEBYTECODE": "1"}


def limited_environment() -> dict[str, str]:
    """For a process that sets itself a limit."""
    return os.environ | WITHOUT_BYTECODE


@contextmanager
def files_of_at_most(size_bytes: int) -> Iterator[None]:
    """No file of this process grows beyond a size while this is open."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler, bytecode = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        sys.dont_write_bytecode = bytecode
        signal.signal(signal.SIGXFSZ, handler)
