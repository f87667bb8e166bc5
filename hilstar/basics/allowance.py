"""How much may happen in a time: a token bucket."""

from hilstar.basics.units import NS_PER_S


class Allowance:
    """A token bucket: `burst` at once, then `per_s` each second."""

    def __init__(self, burst: float, per_s: float) -> None:
        self._burst, self._per_s = burst, per_s
        self._left, self._last_ns = burst, 0

    def take(self, now_ns: int, count: int = 1) -> bool:
        """Whether `count` more are within it at `now_ns`; they are then taken."""
        passed_s = max(0, now_ns - self._last_ns) / NS_PER_S if self._last_ns else 0.0
        self._last_ns = now_ns
        self._left = min(self._burst, self._left + passed_s * self._per_s)
        if self._left < count:
            return False
        self._left -= count
        return True
