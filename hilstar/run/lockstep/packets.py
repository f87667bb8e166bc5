"""Requests of our own packets: one request is one attitude, one frame, one reply."""

from __future__ import annotations

import time

from hilstar.attitude.wire.packet import TimeReply, TimeRequest
from hilstar.attitude.wire.zmq_links import ZmqLockstep
from hilstar.run.frame_status import StatusMaker
from hilstar.run.lockstep.steps import POLL_MS, Steps
from hilstar.run.loop import FrameLoop
from hilstar.run.summary import RunSummary


def serve_lockstep(link: ZmqLockstep, run: Steps, loop: FrameLoop, statuses: StatusMaker) -> RunSummary:
    """Answer requests up to the limit, or until a signal; returns the summary. A refused request leaves the last frame."""
    while run.goes_on():
        arrival = link.receive(POLL_MS)
        if arrival is None:
            loop.idle()
            continue
        if isinstance(arrival.event, TimeRequest):
            asked = arrival.event
            link.reply_time(TimeReply(asked.sequence, asked.t1_ns, arrival.host_ns, time.monotonic_ns()))
            continue
        refusal = run.take(arrival.host_ns, arrival.event, arrival.raw)
        shown_ns = time.monotonic_ns()
        link.reply(statuses.status(run.last, run.last.t_ns, loop, run.counts, False), shown_ns, refusal)
        run.answered(arrival.host_ns, shown_ns)
    return run.summary()
