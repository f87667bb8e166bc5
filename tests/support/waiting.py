"""Waiting for what another process or thread does: as short as it takes, and with an end."""

from __future__ import annotations

import time
from collections.abc import Callable

# A machine whose cores are all busy takes seconds to start a command; what never comes costs a failing test this long.
PATIENCE_S = 30.0


def wait_for(holds: Callable[[], object], what: object = "", poll_s: float = 0.05) -> None:
    """Return once `holds()` is true; an AssertionError that says `what` after PATIENCE_S."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline_s, what
        time.sleep(poll_s)
