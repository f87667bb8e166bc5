"""42 in lockstep: a frame for each step of the simulation, which waits for it."""

from __future__ import annotations

import time

from hilstar.attitude.wire.nasa42 import Nasa42Lockstep
from hilstar.run.lockstep.steps import POLL_MS, Steps
from hilstar.run.loop import FrameLoop
from hilstar.run.summary import RunSummary


def serve_nasa42(link: Nasa42Lockstep, run: Steps, loop: FrameLoop) -> RunSummary:
    """Follow 42 up to the limit, or until a signal; returns the summary. A refused message leaves the last frame."""
    while run.goes_on():
        arrivals = link.receive(POLL_MS)
        if not arrivals:
            loop.idle()
        for arrival in arrivals:
            run.take(arrival.host_ns, arrival.event, arrival.raw)
            link.acknowledge()
            run.answered(arrival.host_ns, time.monotonic_ns())
    return run.summary()
