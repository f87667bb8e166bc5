"""Basilisk's broadcast: its PUB socket binds, and hilstar's SUB socket connects. The simulation waits for nobody."""

from __future__ import annotations

import time
from collections.abc import Iterable

from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.packet import AttitudeSample, Event, Refusal
from hilstar.attitude.wire.vizard.attitude import Follower
from hilstar.attitude.wire.vizard.parts import MAX_UPDATE_BYTES, SIM_UPDATE, check_loopback, update_of
from hilstar.attitude.wire.zmq_stream import Taken, ZmqReceiver
from hilstar.notices import Notices
from hilstar.units import NS_PER_S

HELD = 2
MAX_HELD_NS = NS_PER_S // 4


class Opening:
    """Holds the very first two attitudes back until a third says how they turn: shown alone they would stand still.

    For MAX_HELD_NS at most. Where another simulation begins later, `clock.jumps` is in doubt about its first ones anyway.
    """

    def __init__(self) -> None:
        self._held: list[Arrival[Event]] = []
        self._opens = True

    def passed(self, arrivals: list[Arrival[Event]], now_ns: int) -> list[Arrival[Event]]:
        """What goes on now, of what arrived and what was held."""
        out: list[Arrival[Event]] = []
        for arrival in arrivals:
            sample = arrival.event
            if not isinstance(sample, AttitudeSample):
                out.append(arrival)
                continue
            if self._opens and sample.rate_cam_rad_s is None and len(self._held) < HELD:
                self._held.append(arrival)
            else:
                out += [*self._released(), arrival]
        if self._held and now_ns - self._held[0].host_ns > MAX_HELD_NS:
            out += self._released()
        return out

    def _released(self) -> list[Arrival[Event]]:
        released, self._held, self._opens = self._held, [], False
        return released


class VizardBroadcast(ZmqReceiver):
    """A SUB socket for SIM_UPDATE messages; other topics (SYNC_SETTINGS) do not arrive. It connects, or binds with `bind`."""

    topic = SIM_UPDATE
    max_part_bytes = MAX_UPDATE_BYTES

    def __init__(self, endpoint: str, follower: Follower, *, bind: bool = False, notices: Notices | None = None) -> None:
        check_loopback(endpoint)
        super().__init__(endpoint, bind=bind, notices=notices)
        self._follower, self.conventions = follower, follower.conventions
        self._opening = Opening()

    def arrivals(self, taken: Iterable[Taken]) -> list[Arrival[Event]]:
        """What messages say; the very first ones are held back for a moment."""
        return self._opening.passed(super().arrivals(taken), time.monotonic_ns())

    def _arrival(self, host_ns: int, parts: list[bytes]) -> Arrival[Event]:
        message = update_of(parts)
        if message is None:
            refusal = Refusal("format", f"a message of {len(parts)} parts; Basilisk sends SIM_UPDATE and a VizMessage")
            return Arrival(host_ns, refusal, parts[-1])
        return Arrival(host_ns, self._follower.take(message)[0], message)
