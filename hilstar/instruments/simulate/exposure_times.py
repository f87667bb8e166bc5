"""When the virtual tracker's exposures begin: one after another at a rate, or as the client of its
camera asks.
"""

from typing import Protocol

from hilstar.basics.units import NS_PER_S
from hilstar.server.gige.camera import GigECamera


class OwnTime(Protocol):
    """A clock of the tracker's own, ns, beside the host's."""

    def of_host(self, host_ns: int) -> int:
        """Its time at a host time."""

    def to_host(self, own_ns: int) -> int:
        """The host's time at a time of its own."""


class ExposureTimes(Protocol):
    """Gives exposures' beginnings, host time, each once it is `done` with the one before."""

    def next_ns(self) -> int | None:
        """When the next exposure begins; None where none is asked for yet."""

    def done(self) -> None:
        """The exposure of `next_ns` is over."""

    def pass_over(self, end_ns: int, now_ns: int) -> int:
        """Go past exposures that should have begun since one ended; how many."""


class FreeExposures:
    """An exposure every period of the tracker's own clock, from `begun_ns` on, host time."""

    def __init__(self, clock: OwnTime, begun_ns: int, period_ns: int) -> None:
        self.period_ns = period_ns
        self._clock = clock
        self._first_ns = clock.of_host(begun_ns)
        self._number = 0

    def next_ns(self) -> int:
        """When the next exposure begins."""
        return self._clock.to_host(self._first_ns + self._number * self.period_ns)

    def done(self) -> None:
        """Go on to the next one."""
        self._number += 1

    def pass_over(self, end_ns: int, now_ns: int) -> int:
        """Go past those that should have begun before now."""
        count = max((now_ns - end_ns) // self.period_ns - 1, 0)
        self._number += count
        return count


class CameraExposures:
    """As the camera's client asks: at its rate, or by its triggers.

    `always` exposes at the rate while no client wants images, for a tracker that answers, too.
    """

    def __init__(self, clock: OwnTime, begun_ns: int, camera: GigECamera, always: bool) -> None:
        self._clock = clock
        self._camera = camera
        self._always = always
        self._begun_ns = begun_ns
        self._rate_hz = 0.0
        self._free = FreeExposures(clock, begun_ns, NS_PER_S)
        self._trigger_ns: int | None = None
        self._newest_ns: int | None = None  # when the last exposure began
        self._streamed = False

    def next_ns(self) -> int | None:
        """When the next exposure begins; None where none is asked for yet."""
        camera = self._camera
        wanted = camera.wanted
        if wanted and camera.settings.triggered:
            if self._trigger_ns is None and (trigger_ns := camera.trigger_ns()) is not None:
                # One that came before the display's first frame has that frame's light.
                self._trigger_ns = max(trigger_ns, self._begun_ns)
            return self._trigger_ns
        if not (wanted or self._always):
            self._streamed = False
            return None
        # A stream begins when it is asked for, and a new rate with the exposure after the last one.
        if camera.settings.rate_hz != self._rate_hz or (wanted and not self._streamed):
            self._rate_hz = camera.settings.rate_hz
            period_ns = round(NS_PER_S / self._rate_hz)
            begin_ns = max(self._begun_ns, camera.started_ns)
            if self._newest_ns is not None and begin_ns <= self._newest_ns:
                begin_ns = self._newest_ns + period_ns
            self._free = FreeExposures(self._clock, begin_ns, period_ns)
        self._streamed = wanted
        return self._free.next_ns()

    def done(self) -> None:
        """Go on to the next one."""
        if self._trigger_ns is not None:
            self._newest_ns = self._trigger_ns
            self._trigger_ns = None
            return
        self._newest_ns = self._free.next_ns()
        self._free.done()

    def pass_over(self, end_ns: int, now_ns: int) -> int:
        """Go past those that should have begun before now; a trigger is never passed over."""
        if self._camera.settings.triggered and self._camera.wanted:
            return 0
        return self._free.pass_over(end_ns, now_ns)
