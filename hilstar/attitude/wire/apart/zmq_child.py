"""python -m hilstar.attitude.wire.apart.zmq_child: owns a ZeroMQ socket that takes a stream, and stamps what comes.

It is told where (a JSON object on a line) once the stream is wanted; then the process that shows stars only listens.
"""

from __future__ import annotations

import base64
import contextlib
import json
import time
from pathlib import Path
from typing import Any

from hilstar.attitude.wire.apart.child import Wire, run_child
from hilstar.attitude.wire.apart.records import Kind, pack_message, pack_object
from hilstar.attitude.wire.keys import CurveKeys
from hilstar.attitude.wire.links import LinkCounts
from hilstar.attitude.wire.zmq_links import ZmqReceiver
from hilstar.notices import Notices
from hilstar.process.scheduling import PromptWhileLight

MAX_ORDER_BYTES = 65_536
POLL_MS = 20


class ForwardedNotices(Notices):
    """Hands on what a link tells, for the notices of the process that shows stars; nothing once that is gone."""

    def __init__(self, wire: Wire) -> None:
        super().__init__()
        self.link_counts = LinkCounts()  # the link's own, as soon as there is one
        self._wire = wire

    def tell(self, kind: str, detail: str, who: str = "") -> None:
        """Have it told."""
        self._put("tell", kind, detail, who)

    def mention(self, kind: str, detail: str) -> None:
        """Have it mentioned."""
        self._put("mention", kind, detail)

    def _put(self, *told: str) -> None:
        with contextlib.suppress(EOFError):
            self._wire.put(pack_object(Kind.NOTICE, [told, self.link_counts.summary()]))


def order(link: ZmqReceiver) -> bytes:
    """What the process is told, so that it opens a socket like `link`'s."""
    endpoint, bind, keys = link.opened_as()
    files = [keys.secret_key, keys.server_key, keys.allowed_clients]
    told = {
        "endpoint": endpoint,
        "bind": bind,
        "keys": [None if each is None else str(each.absolute()) for each in files],
        "topic": base64.b64encode(link.topic).decode(),
        "max_part_bytes": link.max_part_bytes,
    }
    return json.dumps(told).encode() + b"\n"


def _ordered(wire: Wire) -> Any:
    said = b""
    while not said.endswith(b"\n"):
        more = wire.socket.recv(MAX_ORDER_BYTES)
        if not more:
            raise EOFError
        said += more
    return json.loads(said)


def _open(told: Any, notices: Notices) -> ZmqReceiver:
    class Ordered(ZmqReceiver):
        topic = base64.b64decode(told["topic"])
        max_part_bytes = told["max_part_bytes"]

    keys = CurveKeys(*(None if each is None else Path(each) for each in told["keys"]))
    return Ordered(told["endpoint"], bind=told["bind"], keys=keys, notices=notices)


def read_socket(wire: Wire) -> None:
    """Stamp and hand on what comes, until the other side is gone (EOFError). Raises InputError where it cannot be opened."""
    wire.sign()
    told = _ordered(wire)
    priority = PromptWhileLight()
    notices = ForwardedNotices(wire)
    with _open(told, notices) as link:
        notices.link_counts = link.link_counts
        counted = link.link_counts.summary()
        empty_ns = time.monotonic_ns()
        while not wire.said(0):
            asked_ns = time.monotonic_ns()
            waits = link.wait_for_message(0)
            if not waits:
                empty_ns = asked_ns
            taken = link.taken(POLL_MS)
            for k, each in enumerate(taken):
                # The newest of those that arrived while this process slept woke it; the others had to wait.
                timely = not waits and k == len(taken) - 1
                wire.put(pack_message(each.host_ns, empty_ns, timely, each.parts))
            if link.link_counts.summary() != counted:
                counted = link.link_counts.summary()
                wire.put(pack_object(Kind.COUNTS, counted))
            priority.tend()
            wire.sign()


if __name__ == "__main__":
    run_child(read_socket)
