"""What a run has to say for itself: the summary of `serve` and `replay`."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.packet import REASONS
from hilstar.attitude.receiver import PacketCounts

NS_PER_MS = 1e6


class SwapStats:
    """When frames were swapped onto a screen, 16 bytes a frame."""

    def __init__(self) -> None:
        self._interval_ms = array("f")
        self._late_ms = array("f")
        self._packet_ms = array("f")
        self._last_ns: int | None = None

    def add(self, swap_ns: int, predicted_ns: int, missed_before: int, received_ns: int | None) -> None:
        """Take in one swap; `received_ns` is when the newest packet behind the frame came, None where none did."""
        if self._last_ns is not None and not missed_before:
            self._interval_ms.append((swap_ns - self._last_ns) / NS_PER_MS)
        self._last_ns = swap_ns
        self._late_ms.append((swap_ns - predicted_ns) / NS_PER_MS)
        if received_ns is not None:
            self._packet_ms.append((swap_ns - received_ns) / NS_PER_MS)

    def summary(self) -> dict[str, Any]:
        """Jitter of the interval between swaps (standard deviation), lateness and packet to swap; {} without a swap."""
        if not self._late_ms:
            return {}
        jitter_ms = float(np.std(np.array(self._interval_ms))) if self._interval_ms else None
        return {
            "pacing_jitter_ms": jitter_ms,
            "swap_late_ms": spread(self._late_ms),
            "packet_to_swap_ms": spread(self._packet_ms),
        }


class RunStats:
    """Figures of each frame, 16 bytes a frame, and what they come to."""

    def __init__(self) -> None:
        self._frame_ms = array("f")
        self._age_ms = array("f")
        self._stars = array("L")
        self._clipped_max = 0
        self.clipped_hip: set[int] = set()
        self.swaps = SwapStats()
        self.missed_frames = 0
        self.stale_frames = 0

    @property
    def frames(self) -> int:
        """Frames drawn so far."""
        return len(self._frame_ms)

    def add(self, frame_ns: int, age_ns: int | None, star_count: int, clipped_hip: tuple[int, ...]) -> None:
        """Take in one frame; `age_ns` is None while no attitude has come."""
        self._frame_ms.append(frame_ns / NS_PER_MS)
        if age_ns is not None:
            self._age_ms.append(age_ns / NS_PER_MS)
        self._stars.append(star_count)
        if clipped_hip:
            self._clipped_max = max(self._clipped_max, len(clipped_hip))
            self.clipped_hip.update(clipped_hip)

    def summary(self, duration_s: float, counts: PacketCounts, gl_renderer: str) -> dict[str, Any]:
        """The JSON object of section 5 of the design; figures without a sample are null."""
        stars = np.array(self._stars)
        return {
            "frames": self.frames,
            "duration_s": duration_s,
            "fps": self.frames / duration_s if duration_s > 0 else None,
            "frame_ms": spread(self._frame_ms),
            "attitude_age_ms": spread(self._age_ms),
            "packets": {
                "received": counts.received,
                "accepted": counts.received - counts.refused,
                "refused": counts.refused,
                "refused_by": {reason: counts.refused_by[reason] for reason in REASONS},
            },
            "stars_drawn": {
                "mean": float(stars.mean()) if len(stars) else None,
                "max": int(stars.max()) if len(stars) else None,
            },
            "clipped": {"max": self._clipped_max, "hip": sorted(self.clipped_hip)},
            "missed_frames": self.missed_frames,
            "stale_frames": self.stale_frames,
            "gl_renderer": gl_renderer,
        }


def spread(values: array[float] | FloatArray) -> dict[str, float | None]:
    """Median, 99th percentile and greatest of some figures; nulls without any."""
    if not len(values):
        return {"p50": None, "p99": None, "max": None}
    p50, p99, top = np.percentile(np.array(values), [50, 99, 100])
    return {"p50": float(p50), "p99": float(p99), "max": float(top)}
