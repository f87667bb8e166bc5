"""Counting thresholds fast: bits of a positive float rise with its value, so their leading part indexes a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.arrays import Float32Array, IntArray

MANTISSA_BITS = 23
MAX_FINER = 4


@dataclass(frozen=True, slots=True)
class CodeTable:
    """Thresholds, and the code at the lower edge of each bin of the light's leading bits (see encode.frag)."""

    threshold: Float32Array
    first_code: npt.NDArray[np.uint32]
    bin_shift: int
    first_bin: int

    def steps(self) -> npt.NDArray[np.uint32] | None:
        """Each bin in a word: its first code, and the lower bits of its only threshold in `bin_shift` + 1 bits.

        Those are 1 << bin_shift where it has none, which no light reaches. Before the first bin there is an empty one, for all
        light below it. None where a bin has several thresholds.
        """
        bits, none = self.threshold.view(np.uint32), np.uint32(1 << self.bin_shift)
        place, lower = (bits >> np.uint32(self.bin_shift)).astype(np.intp) - self.first_bin, bits & (none - 1)
        asked = (lower > 0) | (place == 0)  # the first code of a later bin counts a threshold at its very edge
        place, lower = place[asked], lower[asked]
        if len(np.unique(place)) < len(place):
            return None
        words = np.full(len(self.first_code), none)
        words[place] = lower
        words |= self.first_code << np.uint32(self.bin_shift + 1)
        return np.concatenate([[none], words])


def code_table(thresholds: Float32Array) -> CodeTable:
    """The table for rising, positive `thresholds`.

    There are as many bins per octave as thresholds, at most 4096, so that few bins hold more than one threshold; up to
    MAX_FINER times as many where then none does.
    """
    bits = min(12, len(thresholds).bit_length())
    tables = (_table(thresholds, MANTISSA_BITS - bits - finer) for finer in range(MAX_FINER.bit_length()))
    first = next(tables)
    return first if first.steps() is not None else next((table for table in tables if table.steps() is not None), first)


def _table(thresholds: Float32Array, shift: int) -> CodeTable:
    first_bin = int(thresholds[0].view(np.int32)) >> shift
    last_bin = int(thresholds[-1].view(np.int32)) >> shift
    edges = (np.arange(first_bin, last_bin + 1, dtype=np.int64) << shift).astype(np.int32).view(np.float32)
    first_code = np.searchsorted(thresholds, edges, side="right").astype(np.uint32)
    first_code[0] = 0
    return CodeTable(thresholds, first_code, shift, first_bin)


class ThresholdCounter:
    """What encode.frag does with a CodeTable, in NumPy: ten times as fast as a binary search of unsorted light."""

    def __init__(self, thresholds: Float32Array) -> None:
        table = code_table(thresholds)
        self._shift, self._first_bin = table.bin_shift, table.first_bin
        self._first = table.first_code.astype(np.intp)
        self._threshold = np.append(thresholds, np.float32(np.inf))

    def count(self, light: Float32Array) -> IntArray:
        """How many thresholds are at or below each light, which is finite and not negative; same shape."""
        place = np.clip((light.view(np.int32) >> self._shift) - self._first_bin, 0, len(self._first) - 1)
        count: IntArray = self._first[place]
        while (more := light >= self._threshold[count]).any():
            count += more
        return count
