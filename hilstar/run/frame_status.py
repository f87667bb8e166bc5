"""The status that goes back to the sender: which frame its attitudes caused, and how the display is doing."""

from __future__ import annotations

from hilstar.attitude.receiver import PacketCounts
from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.packet import Status
from hilstar.notices import Notices
from hilstar.run.loop import FrameLoop
from hilstar.run.record.ledger import Ledger, LedgerSwitch
from hilstar.run.shown import Shown


class StatusMaker:
    """Makes status packets; missed frames, refused packets and momentary events are reported once each."""

    def __init__(self, ledger: Ledger | LedgerSwitch | None = None) -> None:
        self._ledger = ledger
        self._missed = 0
        self._refused = 0
        self._told: dict[str, int] = {}

    def status(self, shown: Shown, light_t_ns: int, loop: FrameLoop, counts: PacketCounts, synchronised: bool) -> Status:
        """The status after a frame whose light leaves at `light_t_ns` of the sender's clock."""
        missed, refused = loop.tally.missed_frames, counts.refused
        attitude, on_screen = shown.attitude, loop.pacer.operator.look()
        health = {
            protocol.HEALTH_NO_ATTITUDE: shown.missing and not loop.gate.stale,
            protocol.HEALTH_STALE: loop.gate.stale,
            protocol.HEALTH_BLANK: attitude is None,
            protocol.HEALTH_CLOCK_SYNCHRONISED: synchronised,
            protocol.HEALTH_MISSED: missed > self._missed,
            protocol.HEALTH_REFUSED: refused > self._refused,
            protocol.HEALTH_CLIPPED: bool(shown.drawn.clipped_hip),
            protocol.HEALTH_LEDGER_FAILED: self._ledger is not None and self._ledger.failure is not None,
            protocol.HEALTH_OPERATOR_OVERRIDE: bool(on_screen.operator),
            protocol.HEALTH_HIDDEN: bool(on_screen.hidden),
            protocol.HEALTH_SECOND_SENDER: self._happens(loop.notices, "second-sender"),
            protocol.HEALTH_SOURCE_FROZEN: self._happens(loop.notices, "source-frozen"),
        }
        self._missed, self._refused = missed, refused
        return Status(
            health=sum(bit for bit, is_set in health.items() if is_set),
            frame=shown.number,
            light_t_ns=light_t_ns,
            attitude_age_ns=-1 if attitude is None else attitude.age_ns,
            attitude_sequence=0 if attitude is None else attitude.sequence,
            accepted=counts.received - refused,
            refused=refused,
        )

    def _happens(self, notices: Notices, kind: str) -> bool:
        """True while an event lasts, and once after each momentary one."""
        before, self._told[kind] = self._told.get(kind, 0), notices.counts().get(kind, 0)
        return kind in notices.active or self._told[kind] > before
