"""The attitude at any time, from samples: SLERP between them, bounded prediction past the last.

Times are nanoseconds of the sender's clock; `ClockOffset` carries host time across.
"""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from typing import Literal

from hilstar.arrays import FloatArray
from hilstar.attitude.packet import AttitudeSample, Refusal
from hilstar.attitude.quaternion import propagate, rate_between_rad_s, slerp

NS_PER_MS = 1_000_000
NS_PER_S = 1_000_000_000

# A live timeline keeps this many samples: 40 s at 200 Hz, far more than a frame looks back.
LIVE_CAPACITY = 8192
# A sender that restarts has an earlier clock. After a silence as long as `stale_after`, this many
# refused samples in a row that rise among themselves are taken as the restart they are.
RESTART_SAMPLES = 3

OnStale = Literal["hold", "blank"]


@dataclass(frozen=True, slots=True)
class Attitude:
    """An attitude at one time, how old its newest sample is, and whether that is too old to trust."""

    q_icrs_to_cam: FloatArray
    age_ns: int
    stale: bool


@dataclass(frozen=True, slots=True)
class Policy:
    """What happens past the newest sample: prediction for at most so long, and when it counts as stale."""

    max_extrapolation_ns: int
    stale_after_ns: int


class Timeline:
    """Samples in order of time. One thread may add while another asks."""

    def __init__(self, policy: Policy, capacity: int = LIVE_CAPACITY) -> None:
        self._policy = policy
        self._capacity = capacity
        self._t_ns: list[int] = []
        self._samples: list[AttitudeSample] = []
        self._pending: list[AttitudeSample] = []
        self._newest_host_ns: int | None = None
        self._lock = threading.Lock()
        self.restarts = 0

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, sample: AttitudeSample, host_ns: int | None = None) -> Refusal | None:
        """Append a sample; a time that does not rise is refused. `host_ns` (when it arrived) lets a restart be seen."""
        with self._lock:
            if self._t_ns and sample.t_ns <= self._t_ns[-1]:
                newest_ns = self._t_ns[-1]
                if not self._restarted(sample, host_ns):
                    return Refusal("time", f"t_ns {sample.t_ns} is not after {newest_ns}, which came before it")
            self._pending.clear()
            self._t_ns.append(sample.t_ns)
            self._samples.append(sample)
            self._newest_host_ns = host_ns
            if len(self._samples) > 2 * self._capacity:
                del self._t_ns[: self._capacity], self._samples[: self._capacity]
            return None

    def _restarted(self, sample: AttitudeSample, host_ns: int | None) -> bool:
        if host_ns is None or self._newest_host_ns is None:
            return False
        if self._pending and sample.t_ns <= self._pending[-1].t_ns:
            self._pending.clear()
        self._pending.append(sample)
        silent = host_ns - self._newest_host_ns > self._policy.stale_after_ns
        if not silent or len(self._pending) < RESTART_SAMPLES:
            return False
        self._t_ns.clear()
        self._samples.clear()
        self.restarts += 1
        return True

    def at(self, t_ns: int) -> Attitude | None:
        """The attitude at `t_ns`, or None before any sample has come.

        Before the first sample it is the first; past the newest it is predicted with the sample's rate
        (else that of the last two samples) for at most `max_extrapolation_ns`, and then held.
        """
        with self._lock:
            if not self._samples:
                return None
            i = bisect_right(self._t_ns, t_ns) - 1
            if i < 0:
                return Attitude(self._samples[0].q_icrs_to_cam, 0, False)
            before = self._samples[i]
            age_ns = t_ns - before.t_ns
            if i + 1 < len(self._samples):
                after = self._samples[i + 1]
                if after.discontinuity:
                    return Attitude(before.q_icrs_to_cam, age_ns, False)
                fraction = age_ns / (after.t_ns - before.t_ns)
                return Attitude(slerp(before.q_icrs_to_cam, after.q_icrs_to_cam, fraction), age_ns, False)
            previous = self._samples[i - 1] if i else None
        return self._predict(previous, before, age_ns)

    def _predict(self, previous: AttitudeSample | None, newest: AttitudeSample, age_ns: int) -> Attitude:
        stale = age_ns > self._policy.stale_after_ns
        rate = newest.rate_cam_rad_s
        if rate is None and previous is not None and not newest.discontinuity:
            gap_ns = newest.t_ns - previous.t_ns
            if gap_ns <= self._policy.stale_after_ns:
                rate = rate_between_rad_s(previous.q_icrs_to_cam, newest.q_icrs_to_cam, gap_ns / NS_PER_S)
        if rate is None:
            return Attitude(newest.q_icrs_to_cam, age_ns, stale)
        seconds = min(age_ns, self._policy.max_extrapolation_ns) / NS_PER_S
        return Attitude(propagate(newest.q_icrs_to_cam, rate, seconds), age_ns, stale)


class ClockOffset:
    """Host time minus sender's time, by the least delay of the last few seconds.

    A message is never early, so the smallest (arrival - t_ns) is nearest the truth: it is too large by
    the least one-way delay, which a one-way stream cannot tell.
    """

    WINDOW_NS = 10 * NS_PER_S
    SLOT_NS = NS_PER_S

    def __init__(self) -> None:
        self._slots: deque[tuple[int, int]] = deque()
        self._offset_ns: int | None = None  # one attribute, so that another thread reads a whole value

    def observe(self, t_ns: int, host_ns: int) -> None:
        """Take in one message's time and its arrival."""
        offset_ns = host_ns - t_ns
        slot = host_ns // self.SLOT_NS
        if self._slots and self._slots[-1][0] == slot:
            self._slots[-1] = (slot, min(self._slots[-1][1], offset_ns))
        else:
            self._slots.append((slot, offset_ns))
        while self._slots and (slot - self._slots[0][0]) * self.SLOT_NS > self.WINDOW_NS:
            self._slots.popleft()
        self._offset_ns = min(offset for _, offset in self._slots)

    def reset(self) -> None:
        """Forget the past: the sender's clock has started anew."""
        self._slots.clear()

    def to_sender_ns(self, host_ns: int) -> int:
        """Host time on the sender's clock; before any message, host time itself."""
        offset_ns = self._offset_ns
        return host_ns if offset_ns is None else host_ns - offset_ns
