"""42 in lockstep: a frame for each step of the simulation, which waits for it."""

from __future__ import annotations

import logging
import time

from hilstar.attitude.wire.nasa42.tcp_link import Nasa42Lockstep
from hilstar.bench.frame import Bench
from hilstar.run.lockstep.steps import POLL_MS, Steps
from hilstar.run.loop import FrameLoop, Limit
from hilstar.run.record.ledger import Ledger
from hilstar.run.summary import RunSummary

log = logging.getLogger(__name__)


def serve_nasa42(bench: Bench, link: Nasa42Lockstep, limit: Limit, loop: FrameLoop, ledger: Ledger | None = None) -> RunSummary:
    """Follow 42 up to `limit`, or until a signal; returns the summary. A refused message leaves the last frame."""
    run = Steps(bench, limit, loop, ledger)
    while run.goes_on():
        arrivals = link.receive(POLL_MS)
        if not arrivals:
            loop.idle()
        for arrival in arrivals:
            refusal = run.take(arrival.host_ns, arrival.event, arrival.raw)
            if refusal is not None and run.counts.refused_by[refusal.reason] == 1:
                log.warning("message refused (%s): %s; further ones are only counted", refusal.reason, refusal.detail)
            link.acknowledge()
            run.answered(arrival.host_ns, time.monotonic_ns())
    return run.summary()
