"""What else the machine did while a study took times: on a busy machine no time says which way is faster."""

from __future__ import annotations

import os
import resource
from pathlib import Path

BUSY_SHARE = 0.15  # of the machine's cores: a background process of a third of a core, of two; times are then 5 % and more off
STAT = Path("/proc/stat")


class OtherWork:
    """The cores that other processes take from now on; the children of this one are its own."""

    def __init__(self) -> None:
        self._before = self._times_s()

    def cores(self) -> float:
        """How many cores the others took, in the mean since the beginning; 0 where the system does not say."""
        (all_before, busy_before, own_before), (all_now, busy_now, own_now) = self._before, self._times_s()
        passed_s = all_now - all_before  # of all cores together
        others_s = (busy_now - busy_before) - (own_now - own_before)
        return max(others_s, 0.0) / passed_s * (os.cpu_count() or 1) if passed_s > 0 else 0.0

    @staticmethod
    def _times_s() -> tuple[float, float, float]:
        """All time of all cores, the busy part of it, and this process's part of that, s."""
        try:
            ticks = [int(word) for word in STAT.read_text(encoding="ascii").split("\n", 1)[0].split()[1:9]]
        except (OSError, ValueError):
            return 0.0, 0.0, 0.0
        each_s = 1 / os.sysconf("SC_CLK_TCK")
        user, nice, system, idle, waiting, *interrupts = ticks
        busy = user + nice + system + sum(interrupts)
        own = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return (busy + idle + waiting) * each_s, busy * each_s, sum(used.ru_utime + used.ru_stime for used in own)


def is_busy(others_cores: float) -> bool:
    """Whether times are worth nothing beside so much other work."""
    return others_cores > BUSY_SHARE * (os.cpu_count() or 1)


def busy_line(others_cores: float) -> str:
    """What a person has to know of times that were taken beside other work."""
    return (
        f"a busy machine: other processes took {others_cores:.1f} of its {os.cpu_count()} cores meanwhile, so these times name"
        " no winner; run it again when the machine is idle"
    )
