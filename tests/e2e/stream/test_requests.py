"""Links that answer: a request is heard whenever it was made."""

from __future__ import annotations

import socket
import time

import pytest

from hilstar.attitude.wire.vizard import VizardLive
from hilstar.attitude.wire.zmq_links import ZmqLockstep
from tests.support.waiting import PATIENCE_S
from tests.unit.attitude.wire.test_vizard import follower

CLOSES_WITHIN_S = 0.2  # libzmq closes a socket from a thread of its own


@pytest.mark.parametrize("kind", ["packets", "vizard"])
def test_who_asks_while_the_display_is_prepared_is_not_turned_away(kind: str) -> None:
    """A REQ socket whose request is lost with a connection waits for ever: nothing that was
    connected may be closed.
    """
    anywhere = "tcp://127.0.0.1:*"
    with ZmqLockstep(anywhere) if kind == "packets" else VizardLive(anywhere, follower()) as link:
        address = ("127.0.0.1", int(link.endpoint.rpartition(":")[2]))
        with socket.create_connection(address, timeout=PATIENCE_S) as early:
            time.sleep(CLOSES_WITHIN_S)
            with socket.create_connection(address, timeout=PATIENCE_S):
                early.settimeout(PATIENCE_S)
                greeting = early.recv(64)
        assert greeting.startswith(b"\xff"), "ZMTP's signature, and no end of file"
