"""The detector's fixed pattern: what pixels, columns and rows have in common in photographs of different parts of the sky."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hilstar.arrays import BoolArray, FloatArray

CLIP = 4.0  # sigmas beyond which a pixel of one photograph does not count
FOUND_SIGMAS = 4.0


KINDS = ("response", "offsets_dn", "columns_dn", "rows_dn")
NAMES = ("response of pixels", "offsets of pixels", "of columns", "of rows")


@dataclass(frozen=True, slots=True)
class Pattern:
    """One sigma of the pixels' response, as a share of the light, and of offsets of pixels, of columns and of rows, DN.

    `squares` has the square of each, without what noise adds, and `errors` one sigma of these.
    """

    squares: tuple[float, ...] = (0.0,) * 4
    errors: tuple[float, ...] = (math.inf,) * 4

    @property
    def rms(self) -> tuple[float, ...]:
        """Response, pixels, columns, rows; 0 where it is within FOUND_SIGMAS of its error."""
        return tuple(math.sqrt(s) if s > FOUND_SIGMAS * e else 0.0 for s, e in zip(self.squares, self.errors, strict=True))

    def variance_dn2(self, light_dn: FloatArray) -> FloatArray:
        """Variance of a pixel about its neighbours at a level of light."""
        response, *offsets = self.rms
        return np.asarray((response * light_dn) ** 2 + math.fsum(one**2 for one in offsets))

    def words(self) -> str:
        """What was found, or under what it is (two sigmas)."""
        said = []
        for name, square, error, rms in zip(NAMES, self.squares, self.errors, self.rms, strict=True):
            times, unit = (100, "%") if name == NAMES[0] else (1, "DN")
            found = f"{times * rms:.3g} +- {times * error / (2 * rms):.2g}" if rms else ""
            said.append(f"{name} {found or f'under {times * math.sqrt(max(square, 0.0) + 2 * error):.2g}'} {unit}")
        return ", ".join(said)


NO_PATTERN = Pattern()


def fixed_pattern(photographs: Iterable[tuple[FloatArray, FloatArray, BoolArray]]) -> Pattern | None:
    """The pattern by products of each two of several photographs, whose noise has mean 0; None with fewer than two.

    Each gives its pixels less their smooth level, that level above the pedestal, DN, and which pixels count (height, width).
    Response and offsets are told apart by levels that differ; all is response where they do not.
    """
    pixels, shares, columns, rows, light, inverse = (_Pairs() for _ in range(6))
    for off, level, use in photographs:
        use = use & (np.abs(off) < CLIP * math.sqrt(float((off[use] ** 2).mean()))) & (level > 0)
        off, level = np.where(use, off - off[use].mean(), 0.0), np.where(use, level, 1.0)
        for axis, sums in ((0, columns), (1, rows)):
            count = use.sum(axis=axis)
            sums.add(off.sum(axis=axis) / np.maximum(count, 1), count > use.shape[axis] / 4)
        # neighbours' differences: what is smooth is the sky's or the lens's
        off, use = (off[:, 1:] - off[:, :-1]) / math.sqrt(2), use[:, 1:] & use[:, :-1]
        level = (level[:, 1:] + level[:, :-1]) / 2
        for sums, values in ((pixels, off), (shares, off / level), (light, level), (inverse, 1 / level)):
            sums.add(values, use)
    if pixels.photographs < 2 or not pixels.pairs:
        return None
    (column, column_error), (row, row_error), (both, both_error), (share, share_error) = (
        one.mean() for one in (columns, rows, pixels, shares)
    )
    lit, dim = light.mean()[0], inverse.mean()[0]
    both, share = both - max(column, 0.0), share - max(column, 0.0) * dim
    # both = response^2 lit + offsets^2, share = response^2 + offsets^2 dim
    apart = lit * dim - 1
    response, offset = (both * dim - share) / apart, (share * lit - both) / apart
    response_error, offset_error = (
        math.hypot(both_error * dim, share_error) / apart,
        math.hypot(share_error * lit, both_error) / apart,
    )
    if offset < FOUND_SIGMAS * offset_error:
        response, response_error = both / lit, both_error / lit
    return Pattern((response, offset, column, row), (response_error, offset_error, column_error, row_error))


class _Pairs:
    """The mean product of each two of several arrays, by their sums."""

    def __init__(self) -> None:
        self.photographs = 0
        self._sum = self._squares = self._count = np.zeros(1)

    def add(self, values: FloatArray, use: BoolArray) -> None:
        """One array more; values that do not count are as none."""
        self.photographs += 1
        values = np.where(use, values, 0.0)
        self._sum, self._squares, self._count = self._sum + values, self._squares + values**2, self._count + use

    @property
    def pairs(self) -> float:
        """How many products there are."""
        return float((self._count * (self._count - 1) / 2).sum())

    def mean(self) -> tuple[float, float]:
        """The mean product, and one sigma of it by the values' own variance."""
        product = float((self._sum**2 - self._squares).sum()) / 2 / max(self.pairs, 1.0)
        variance = float(self._squares.sum()) / max(float(self._count.sum()), 1.0)
        return product, variance / math.sqrt(max(self.pairs, 1.0))
