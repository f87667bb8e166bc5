"""The first attitude of a live stream, for a look at where it points."""

from __future__ import annotations

import time

from hilstar.attitude.wire.links import StreamLink
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, TimeReply, TimeRequest
from hilstar.errors import InputError

POLL_MS = 50


def first_attitude(link: StreamLink, patience_s: float) -> AttitudeSample:
    """The first attitude that arrives within `patience_s`. Raises InputError where none does, with the last refusal."""
    deadline_s = time.monotonic() + patience_s
    refused = ""
    while time.monotonic() < deadline_s:
        for arrival in link.receive(POLL_MS):
            match arrival.event:
                case AttitudeSample() as sample:
                    return sample
                case TimeRequest(sequence, t1_ns) if link.two_way:  # a sender may wait for the answer before it sends
                    back = arrival.back or link.send
                    back(TimeReply(sequence, t1_ns, arrival.host_ns, time.monotonic_ns()))
                case Refusal(reason, detail):
                    refused = f"; the last message was refused ({reason}: {detail})"
    raise InputError(f"{link.endpoint}: no attitude within {patience_s:g} s{refused}; start the sender, or give --wait S")
