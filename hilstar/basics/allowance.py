"""How much may happen in a time: a token bucket."""

from hilstar.basics.units import NS_PER_S


class Allowance:
    """A token bucket: `burst` at once, then `per_s` each second."""

    def __init__(self, burst: float, per_s: float) -> None:
        self._burst = burst
        self._per_s = per_s
        self._left = burst
        self._last_ns = 0

    def take(self, now_ns: int, count: int = 1) -> bool:
        """Whether `count` more are within it at `now_ns`; they are then taken."""
        if self._last_ns:
            passed_s = max(0, now_ns - self._last_ns) / NS_PER_S
        else:
            passed_s = 0.0
        self._last_ns = now_ns
        self._left = min(self._burst, self._left + passed_s * self._per_s)
        if self._left < count:
            return False
        self._left -= count
        return True
