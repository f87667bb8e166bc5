"""Percentiles, mean and deviation of a figure over a run of any length, in memory that does not
grow.
"""

import math

import msgspec
import numpy as np

from hilstar.basics.arrays import FloatArray

MIN_SIZE, MAX_SIZE = 1e-6, 1e9
STEP = 0.002  # the width of a bin, relative to the value: how exactly a percentile is known
BINS = math.ceil(math.log(MAX_SIZE / MIN_SIZE) / STEP)


def _times(value: float | None, factor: float) -> float | None:
    if value is None:
        return None
    return value * factor


class Percentiles(msgspec.Struct, frozen=True):
    """Median, 99th percentile and maximum of a figure; None without a value."""

    p50: float | None
    p99: float | None
    max: float | None

    def times(self, factor: float) -> "Percentiles":
        """The same in another unit."""
        return Percentiles(
            _times(self.p50, factor), _times(self.p99, factor), _times(self.max, factor)
        )


class RunningStatistics:
    """Percentiles, maximum, mean and standard deviation of values of either sign.

    Values are counted in bins 0.2 % wide; those within 1e-6 of 0 count as 0. The maximum is exact.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(2 * BINS + 1, dtype=np.int64)
        self.count = 0
        self.max = -math.inf
        self._mean = self._squares = 0.0

    def add(self, value: float) -> None:
        """Count one value."""
        self.count += 1
        self.max = max(self.max, value)
        step = value - self._mean
        self._mean += step / self.count
        self._squares += step * (value - self._mean)  # Welford 1962
        size = abs(value)
        if size < MIN_SIZE:
            place = 0
        else:
            place = min(BINS, 1 + int(math.log(size / MIN_SIZE) / STEP))
        self._counts[BINS + place if value >= 0 else BINS - place] += 1

    def add_all(self, values: FloatArray) -> None:
        """Count values (n,)."""
        if not len(values):
            return
        count = self.count + len(values)
        step = float(values.mean()) - self._mean
        # Chan 1979
        self._squares += (
            float(((values - values.mean()) ** 2).sum())
            + step**2 * self.count * len(values) / count
        )
        self._mean += step * len(values) / count
        self.count, self.max = count, max(self.max, float(values.max()))
        place = (
            (1 + np.log(np.maximum(np.abs(values) / MIN_SIZE, 1.0)) / STEP)
            .astype(np.intp)
            .clip(max=BINS)
        )
        place[np.abs(values) < MIN_SIZE] = 0
        np.add.at(self._counts, BINS + np.where(values >= 0, place, -place), 1)

    @property
    def mean(self) -> float | None:
        """The mean of all values; None without a value."""
        return self._mean if self.count else None

    @property
    def deviation(self) -> float | None:
        """The standard deviation; None for fewer than two values."""
        if self.count > 1:
            return math.sqrt(self._squares / self.count)
        return None

    def percentile(self, percent: float) -> float | None:
        """The value at `percent` of the sorted values, within 0.1 %; None without a value."""
        if not self.count:
            return None
        rank = max(1, math.ceil(percent / 100 * self.count))
        place = int(np.searchsorted(np.cumsum(self._counts), rank)) - BINS
        if place == 0:
            size = 0.0
        else:
            size = MIN_SIZE * math.exp((abs(place) - 0.5) * STEP)
        return min(math.copysign(size, place), self.max)

    def percentiles(self) -> Percentiles:
        """Median, 99th percentile and maximum."""
        return Percentiles(
            self.percentile(50), self.percentile(99), self.max if self.count else None
        )
