"""The test sender: a log or a spin at a steady rate, with the faults of a bad cable,
reproducible by a seed.
"""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from hilstar.attitude.clock.timeline import Policy
from hilstar.attitude.logs.entries import log_joins
from hilstar.attitude.logs.log_file import log_timeline
from hilstar.attitude.wire.packet import AttitudeSample, encode
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.process.scheduling import HOST_CLOCK
from hilstar.basics.rotation import from_radec_roll_deg, propagate, rate_between_rad_s
from hilstar.basics.units import NS_PER_S

MAX_RESAMPLED = 10_000_000  # some GB of samples


@dataclass(frozen=True, slots=True)
class Faults:
    """Shares of all packets, 0 to 1, and the maximum delay of a packet."""

    lose: float = 0.0
    corrupt: float = 0.0
    reorder: float = 0.0
    jitter_s: float = 0.0


@dataclass(slots=True)
class SendTally:
    """The fate of the packets: `sent` left intact and in order, `corrupted` and `reordered`
    left, `lost` did not.
    """

    sent: int = 0
    lost: int = 0
    corrupted: int = 0
    reordered: int = 0

    @property
    def total(self) -> int:
        """All packets."""
        return self.sent + self.lost + self.corrupted + self.reordered


class BadCable:
    """Passes packets on; each meets at most one fault."""

    def __init__(
        self, faults: Faults, rng: np.random.Generator, put: Callable[[bytes], object]
    ) -> None:
        self.tally = SendTally()
        self._faults = faults
        self._rng = rng
        self._put = put
        self._held: bytes | None = None

    def delay_s(self) -> float:
        """How late the next packet leaves, uniform up to the jitter."""
        if self._faults.jitter_s:
            return float(self._rng.uniform(0.0, self._faults.jitter_s))
        return 0.0

    def carry(self, packet: bytes) -> None:
        """Send a packet, with its fault if it has one. A packet held back leaves right after the
        next.
        """
        faults = self._faults
        tally = self.tally
        dice = self._rng.random()
        if dice < faults.lose:
            tally.lost += 1
            return
        if dice < faults.lose + faults.corrupt:
            tally.corrupted += 1
            # One to three of its bits flipped, before any framing: a CRC-32 always detects so few.
            bits = np.unpackbits(np.frombuffer(packet, dtype=np.uint8))
            bits[self._rng.choice(len(bits), size=self._rng.integers(1, 4), replace=False)] ^= 1
            self._put(np.packbits(bits).tobytes())
            return
        if dice < faults.lose + faults.corrupt + faults.reorder and self._held is None:
            self._held = packet
            return
        tally.sent += 1
        self._put(packet)
        if self._held is not None:
            held = self._held
            self._held = None
            tally.reordered += 1
            self._put(held)

    def close(self) -> None:
        """Send a packet that is still held back; with none after it, it is in order."""
        if self._held is not None:
            held = self._held
            self._held = None
            self.tally.sent += 1
            self._put(held)


def spin_samples(
    rate_cam_rad_s: FloatArray, rate_hz: float, radec_roll_deg: tuple[float, float, float]
) -> Iterator[AttitudeSample]:
    """A constant turn that never ends, from t = 0."""
    start = from_radec_roll_deg(*radec_roll_deg)
    k = 0
    while True:
        seconds = k / rate_hz
        yield AttitudeSample(
            round(seconds * NS_PER_S), propagate(start, rate_cam_rad_s, seconds), rate_cam_rad_s, k
        )
        k += 1


def log_samples(samples: list[AttitudeSample], rate_hz: float | None) -> Iterator[AttitudeSample]:
    """A log from t = 0: its own samples, or resampled at `rate_hz`. A rate that the log lacks is
    taken from the next step.

    Nothing is known within a gap: before it there is no such rate, and the sample after it is a
    discontinuity.
    """
    joins = log_joins(samples)
    after_gap = {after.t_ns for before, after in pairwise(samples) if before.t_ns in joins.held_ns}
    samples = [
        replace(sample, discontinuity=True) if sample.t_ns in after_gap else sample
        for sample in samples
    ]
    if rate_hz is not None:
        samples = _resampled(samples, rate_hz)
    first_ns = samples[0].t_ns
    for k, sample in enumerate(samples):
        rate = sample.rate_cam_rad_s
        if rate is None and k + 1 < len(samples) and not samples[k + 1].discontinuity:
            after = samples[k + 1]
            seconds = (after.t_ns - sample.t_ns) / NS_PER_S
            rate = rate_between_rad_s(sample.q_icrs_to_cam, after.q_icrs_to_cam, seconds)
        yield AttitudeSample(
            sample.t_ns - first_ns, sample.q_icrs_to_cam, rate, k, sample.discontinuity
        )


def _resampled(samples: list[AttitudeSample], rate_hz: float) -> list[AttitudeSample]:
    """The log at even times; the first sample after a break is marked, and rates are the log's
    where it has rates.
    """
    timeline = log_timeline(samples, Policy(0, NS_PER_S))
    count = int((samples[-1].t_ns - samples[0].t_ns) * rate_hz / NS_PER_S + 1e-6) + 1
    if count > MAX_RESAMPLED:
        raise InputError(
            f"--rate {rate_hz:g}: gives {count} packets for this log; write a lower rate"
        )
    resampled = []
    sample_index = 0
    for k in range(count):
        t_ns = samples[0].t_ns + round(k * NS_PER_S / rate_hz)
        attitude = timeline.at(t_ns)
        if attitude is None:
            continue
        broken = False
        while sample_index < len(samples) and samples[sample_index].t_ns <= t_ns:
            broken |= samples[sample_index].discontinuity
            sample_index += 1
        rate = _rate_between(samples, sample_index, t_ns)
        resampled.append(
            AttitudeSample(t_ns, attitude.q_icrs_to_cam, rate, discontinuity=broken and k > 0)
        )
    return resampled


def _rate_between(samples: list[AttitudeSample], after: int, t_ns: int) -> FloatArray | None:
    before = samples[after - 1]
    if before.rate_cam_rad_s is None or before.t_ns == t_ns or after == len(samples):
        return before.rate_cam_rad_s
    later = samples[after]
    if later.rate_cam_rad_s is None or later.discontinuity:
        return before.rate_cam_rad_s
    part = (t_ns - before.t_ns) / (later.t_ns - before.t_ns)
    return np.asarray((1 - part) * before.rate_cam_rad_s + part * later.rate_cam_rad_s)


def send(
    cable: BadCable,
    samples: Iterator[AttitudeSample],
    stop: threading.Event,
    on_sent: Callable[[int], None] = lambda count: None,
    sender: int = 0,
) -> None:
    """Send each sample at its time, stamped with this machine's monotonic clock, as the sender of
    that number (0: not given).

    A sample never goes out early. A late one goes out at once: only the cable drops any.
    """
    start_ns = time.monotonic_ns()
    for sample in samples:
        due_ns = start_ns + sample.t_ns
        if HOST_CLOCK.wait_until(due_ns + round(cable.delay_s() * NS_PER_S), stop):
            break
        stamped = AttitudeSample(
            due_ns,
            sample.q_icrs_to_cam,
            sample.rate_cam_rad_s,
            sample.sequence,
            sample.discontinuity,
            sender=sender,
        )
        cable.carry(encode(stamped))
        on_sent(cable.tally.total)
    cable.close()
