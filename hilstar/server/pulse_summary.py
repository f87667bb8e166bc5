"""A run's sync pulses, in words and in its summary."""

import msgspec


class SyncSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The pulses of a run: how many were sent, how many due ones were skipped, and how often the
    line was lost.

    `delay_ms` is the mean from a frame's time stamp to its pulse as this machine asks the line for
    it, `jitter_ms` the standard deviation, `max_delay_ms` the largest; `line_ms` is the mean time
    that the line takes, which comes on top. None without any.
    """

    port: str
    pulses: int
    skipped: int
    lost: int
    delay_ms: float | None
    jitter_ms: float | None
    max_delay_ms: float | None
    line_ms: float | None

    def line(self) -> str:
        """The pulses for a person."""
        told = f"{self.pulses} over {self.port}, {self.skipped} skipped"
        if self.lost:
            told += f", losses of the line: {self.lost}"
        if self.delay_ms is None or self.jitter_ms is None:
            return told
        return (
            f"{told}; {self.delay_ms:.3f} ms after their frames, jitter {self.jitter_ms:.3f} ms"
            " (standard deviation)"
        )
