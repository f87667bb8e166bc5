"""Basilisk's broadcast: its PUB socket binds, and hilstar's SUB socket connects. The simulation waits for nobody."""

from __future__ import annotations

from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import Event, Refusal
from hilstar.attitude.wire.vizard.attitude import Follower
from hilstar.attitude.wire.vizard.parts import MAX_UPDATE_BYTES, SIM_UPDATE, check_loopback, update_of
from hilstar.attitude.wire.zmq_stream import ZmqReceiver
from hilstar.notices import Notices


class VizardBroadcast(ZmqReceiver):
    """A SUB socket for SIM_UPDATE messages; other topics (SYNC_SETTINGS) do not arrive. It connects, or binds with `bind`."""

    topic = SIM_UPDATE
    max_part_bytes = MAX_UPDATE_BYTES

    def __init__(self, endpoint: str, follower: Follower, *, bind: bool = False, notices: Notices | None = None) -> None:
        check_loopback(endpoint)
        super().__init__(endpoint, bind=bind, notices=notices)
        self._follower, self.conventions = follower, follower.conventions

    def _arrival(self, host_ns: int, parts: list[bytes]) -> Arrival[Event]:
        message = update_of(parts)
        if message is None:
            refusal = Refusal("format", f"a message of {len(parts)} parts; Basilisk sends SIM_UPDATE and a VizMessage")
            return Arrival(host_ns, refusal, parts[-1])
        return Arrival(host_ns, self._follower.take(message)[0], message)
