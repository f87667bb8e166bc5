"""Reports whether an attitude is there: none yet, the first, stale, fresh again."""

from __future__ import annotations

from hilstar.attitude.clock.timeline import Attitude
from hilstar.notices import Notices
from hilstar.run.host_clock import HOST_CLOCK, HostClock
from hilstar.units import NS_PER_S

NONE_YET_NS = 2 * NS_PER_S


class AttitudeWatch:
    """Watches the attitude of each frame, before an operator's keys change it."""

    def __init__(self, notices: Notices, clock: HostClock = HOST_CLOCK) -> None:
        self._notices = notices
        self._clock = clock
        self._begun_ns: int | None = None
        self._seen = self._missed = False
        self._stale_ns: int | None = None  # since when, host time

    def see(self, attitude: Attitude | None, stale: bool) -> None:
        """Take the next frame's attitude (None if none has come yet), and whether it is too old."""
        now_ns = self._clock.now_ns()
        if self._begun_ns is None:
            self._begun_ns = now_ns
        for_s = (now_ns - self._begun_ns) / NS_PER_S
        if attitude is None:
            if not self._seen and not self._missed and now_ns - self._begun_ns > NONE_YET_NS:
                self._missed = True
                self._notices.tell("no-attitude", f"no attitude yet, for {for_s:.0f} s: the frames are blank")
            return
        if not self._seen:
            self._seen = True
            self._notices.tell("first-attitude", f"the first attitude has come, after {for_s:.1f} s")
        if stale and self._stale_ns is None:
            self._stale_ns = now_ns
            self._notices.tell("stale", f"the attitude is stale: the newest is {attitude.age_ns / NS_PER_S:.3g} s old")
        elif not stale and self._stale_ns is not None:
            stale_s, self._stale_ns = (now_ns - self._stale_ns) / NS_PER_S, None
            self._notices.tell("fresh", f"the attitude is fresh again, after {stale_s:.1f} s")
