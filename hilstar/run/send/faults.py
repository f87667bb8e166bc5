"""The faults of a bad cable, reproducible by a seed: packets lost, corrupted, out of order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Faults:
    """Shares of all packets, 0 to 1, and the maximum delay of a packet."""

    lose: float = 0.0
    corrupt: float = 0.0
    reorder: float = 0.0
    jitter_s: float = 0.0


@dataclass(slots=True)
class Tally:
    """The fate of the packets: `sent` left intact and in order, `corrupted` and `reordered` left, `lost` did not."""

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

    def __init__(self, faults: Faults, rng: np.random.Generator, put: Callable[[bytes], None]) -> None:
        self.tally = Tally()
        self._faults = faults
        self._rng = rng
        self._put = put
        self._held: bytes | None = None

    def delay_s(self) -> float:
        """How late the next packet leaves, uniform up to the jitter."""
        return float(self._rng.uniform(0.0, self._faults.jitter_s)) if self._faults.jitter_s else 0.0

    def carry(self, packet: bytes) -> None:
        """Send a packet, with its fault if it has one. A packet held back leaves right after the next."""
        faults, tally = self._faults, self.tally
        dice = self._rng.random()
        if dice < faults.lose:
            tally.lost += 1
            return
        if dice < faults.lose + faults.corrupt:
            tally.corrupted += 1
            self._put(self._corrupted(packet))
            return
        if dice < faults.lose + faults.corrupt + faults.reorder and self._held is None:
            self._held = packet
            return
        tally.sent += 1
        self._put(packet)
        if self._held is not None:
            held, self._held = self._held, None
            tally.reordered += 1
            self._put(held)

    def close(self) -> None:
        """Send a packet that is still held back; with none after it, it is in order."""
        if self._held is not None:
            held, self._held = self._held, None
            self.tally.sent += 1
            self._put(held)

    def _corrupted(self, packet: bytes) -> bytes:
        """One to three of its bits flipped, before any framing: a CRC-32 always detects so few."""
        bits = np.unpackbits(np.frombuffer(packet, dtype=np.uint8))
        bits[self._rng.choice(len(bits), size=self._rng.integers(1, 4), replace=False)] ^= 1
        return np.packbits(bits).tobytes()
