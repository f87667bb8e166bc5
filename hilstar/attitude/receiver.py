"""A thread that takes messages off a link, decodes them, counts them, and fills a timeline."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass, field
from typing import Protocol

from hilstar.attitude.packet import REASONS, Reason, Refusal, decode
from hilstar.attitude.timeline import ClockOffset, Timeline

POLL_MS = 50
log = logging.getLogger(__name__)


class Link(Protocol):
    """What a road into hilstar offers."""

    def receive(self, timeout_ms: int) -> list[tuple[int, bytes]]:
        """Messages that wait: (host time of arrival in ns, bytes)."""


@dataclass(slots=True)
class PacketCounts:
    """How many messages arrived, and how many of those were refused, by reason."""

    received: int = 0
    refused_by: dict[Reason, int] = field(default_factory=lambda: dict.fromkeys(REASONS, 0))

    @property
    def refused(self) -> int:
        """Messages refused, for whatever reason."""
        return sum(self.refused_by.values())


class Receiver:
    """Runs `link` into `timeline` until closed. Nothing that arrives ends it."""

    def __init__(self, link: Link, timeline: Timeline) -> None:
        self.counts = PacketCounts()
        self.clock = ClockOffset()
        self._link = link
        self._timeline = timeline
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hilstar-receiver", daemon=True)

    def start(self) -> None:
        """Begin to listen."""
        self._thread.start()

    def close(self) -> None:
        """Stop listening; the link itself stays the caller's."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            for host_ns, message in self._link.receive(POLL_MS):
                self._take(host_ns, message)

    def _take(self, host_ns: int, message: bytes) -> None:
        self.counts.received += 1
        event = decode(message)
        if not isinstance(event, Refusal):
            restarts = self._timeline.restarts
            refusal = self._timeline.add(event, host_ns)
            if refusal is None:
                if self._timeline.restarts != restarts:
                    log.warning("the sender's clock went back for good: its stream is taken up anew")
                    self.clock.reset()
                self.clock.observe(event.t_ns, host_ns)
                return
            event = refusal
        self.counts.refused_by[event.reason] += 1
        if self.counts.refused_by[event.reason] == 1:
            log.warning("packet refused (%s): %s; further ones are only counted", event.reason, event.detail)
