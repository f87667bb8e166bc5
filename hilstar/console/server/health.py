"""Whether the sky is right, and since when it is not: the reasons, from the run as it was last seen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from hilstar.console.feed.messages import Pace, RunSeen
from hilstar.units import NS_PER_S

SILENT_NS = 6 * NS_PER_S // 10  # the run is seen ten times a second
HUNG_NS = 4 * NS_PER_S // 10
HUNG_PERIODS = 2.5
UNASKED_NS = 2 * NS_PER_S  # in lockstep, without a request
MANY_MISSED_SHARE = 0.5  # of the last second's frames


@dataclass(frozen=True, slots=True)
class Lately:
    """What frames said lately: when the newest was shown (host time, ns), and which share of the last second's is missing."""

    swap_ns: int = 0
    missed_share: float = 0.0


def reasons(seen: RunSeen | None, now_ns: int, lately: Lately, refresh_hz: float, pace: Pace) -> list[str]:
    """Why the sky is not right; [] where it is. See `Setup.pace`."""
    if seen is None:
        return ["the run has not begun"]
    if now_ns - seen.host_ns > SILENT_NS:
        return [f"the run's process has been silent for {_s(now_ns - seen.host_ns)}"]
    if pace == "session":
        return seen.failed
    of_display, of_attitude = _of_display(seen, now_ns, refresh_hz), _of_attitude(seen, now_ns, lately, pace)
    return [*of_display, *of_attitude, *_of_rest(seen, lately)]


def _of_display(seen: RunSeen, now_ns: int, refresh_hz: float) -> Iterator[str]:
    if seen.display_lost:
        yield f"the display is lost: {seen.display_lost}"
    limit_ns = max(HUNG_NS, HUNG_PERIODS / refresh_hz * NS_PER_S)
    if not seen.alive_ns:
        yield "the run is being prepared"
    elif seen.host_ns - seen.alive_ns > limit_ns:
        yield f"the frame loop has hung for {_s(now_ns - seen.alive_ns)}"


def _of_attitude(seen: RunSeen, now_ns: int, lately: Lately, pace: Pace) -> Iterator[str]:
    if not seen.alive_ns:
        return
    if seen.missing:
        yield "no attitude has come yet"
    elif seen.stale:
        age = "" if seen.attitude is None else f": {_s(seen.attitude.age_ns)} old"
        yield f"the attitude is stale{age}"
    elif pace == "asked" and lately.swap_ns and now_ns - lately.swap_ns > UNASKED_NS:
        yield f"the simulator has asked for no frame for {_s(now_ns - lately.swap_ns)}"


def _of_rest(seen: RunSeen, lately: Lately) -> Iterator[str]:
    if seen.ledger is not None and seen.ledger.failing:
        yield f"the ledger fails: {seen.ledger.failing}"
    if seen.hidden:
        yield f"the window is {seen.hidden}"
    if seen.operator_text:
        yield f"changed by the operator: {seen.operator_text}"
    if seen.rates:
        yield seen.rates
    if seen.faults:
        yield f"a fault is on: {', '.join(seen.faults)}"
    if lately.missed_share > MANY_MISSED_SHARE:
        yield f"frames are missing: {lately.missed_share:.0%} of the last second's"


def _s(time_ns: int) -> str:
    """A duration as the page writes it."""
    s = time_ns / NS_PER_S
    if s < 60:
        return f"{s:.1f} s"
    return f"{int(s // 60)} min {int(s % 60):02d} s" if s < 3600 else f"{int(s // 3600)} h {int(s % 3600 // 60):02d} min"


class Health:
    """Remembers since when the sky is right, or is not (UTC, seconds)."""

    def __init__(self, unix_s: float) -> None:
        self.ok = False
        self.since_s = unix_s
        self.reasons: list[str] = []

    def update(self, found: list[str], unix_s: float) -> None:
        """Take the reasons found now."""
        if (not found) != self.ok:
            self.ok, self.since_s = not found, unix_s
        self.reasons = found
