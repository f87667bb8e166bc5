"""The run as its own process sees it, ten times a second, for the page: read beside the frame loop, which only counts."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hilstar.attitude.clock.rate_check import WRONG
from hilstar.console.feed.messages import AttitudeSeen, ClockSeen, LedgerSeen, RunSeen
from hilstar.errors import printable
from hilstar.run.operator import Overrides

if TYPE_CHECKING:
    from hilstar.bench.faults.desk import FaultDesk
    from hilstar.console.feed.feed import Feed
    from hilstar.notices import Listener, Notices
    from hilstar.run.record.ledger_switch import LedgerSwitch
    from hilstar.run.screen.screen import Screen
    from hilstar.run.shown import Shown

MAX_CLIPPED = 300  # by name; a picture has hundreds of stars
# Events that last and keep a ledger from being written: as `run.record.ledger` tells them.
LEDGER_TROUBLES = {
    "ledger-failed": "cannot be written",
    "ledger-lost": "a file was deleted, truncated or overwritten",
    "ledger-stalled": "the disk accepts nothing",
    "ledger-thin": "the disk is full: frames are not recorded",
}


@dataclass(frozen=True, slots=True)
class Watched:
    """What there is to look at in a run."""

    feed: Feed
    notices: Notices
    ledger: LedgerSwitch
    screen: Screen | None = None
    faults: FaultDesk | None = None

    def listen(self, listener: Listener) -> None:
        """Hand every further event of the run to `listener`."""
        self.notices.listen(listener)

    def tell(self, kind: str, line: str) -> None:
        """Tell of an event of the run."""
        self.notices.tell(kind, line)

    def now(self) -> RunSeen:
        """The run now."""
        running, shown = self.feed.running, self.feed.shown
        if running is None:
            return RunSeen(host_ns=time.monotonic_ns(), ledger=self._ledger())
        tally, operator = running.tally, running.loop.pacer.operator
        aids = operator.aids if isinstance(operator, Overrides) else None
        clock = None if running.clock is None else running.clock()
        return RunSeen(
            host_ns=time.monotonic_ns(),
            alive_ns=running.loop.watch.alive_ns,
            frame=-1 if shown is None else shown.number,
            stale=shown is not None and shown.stale,
            missing=shown is None or shown.missing,
            blank=shown is None or shown.attitude is None,
            stars=0 if shown is None else shown.drawn.star_count,
            clipped=[] if shown is None else list(shown.drawn.clipped_hip[:MAX_CLIPPED]),
            attitude=_attitude(shown),
            clock=None
            if clock is None or clock.mode == "none"
            else ClockSeen(clock.mode, clock.offset_ms, clock.drift_ppm, clock.uncertainty_ms),
            frames=tally.frames,
            missed=tally.missed_frames,
            stale_frames=tally.stale_frames,
            given_up=tally.given_up_frames,
            received=running.packets.received,
            refused={reason: count for reason, count in running.packets.refused_by.items() if count},
            operator={} if aids is None else aids.states(),
            operator_text="" if aids is None else aids.text,
            overlay=0 if aids is None else aids.overlay,
            patch_share=0.0 if aids is None else aids.patch_share,
            hidden="" if shown is None else shown.on_screen.hidden,
            display_lost="" if self.screen is None else self.screen.window.gone or "",
            ledger=self._ledger(),
            faults=[] if self.faults is None else self.faults.on(),
            rates=self.notices.lasting.get(WRONG, ""),
        )

    def _ledger(self) -> LedgerSeen | None:
        ledger = self.ledger.current
        if ledger is None:
            return None
        troubles = [words for kind, words in LEDGER_TROUBLES.items() if kind in self.notices.active]
        return LedgerSeen(printable(str(ledger.path)), ledger.size_bytes, "; ".join(troubles))


def _attitude(shown: Shown | None) -> AttitudeSeen | None:
    attitude = None if shown is None else shown.attitude
    if attitude is None:
        return None
    w, x, y, z = attitude.q_icrs_to_cam.tolist()
    rate = attitude.rate_cam_rad_s
    rate_rad_s = None if rate is None else tuple(rate.tolist())
    return AttitudeSeen((w, x, y, z), rate_rad_s, attitude.age_ns)
