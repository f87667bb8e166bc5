"""The stretches of time that one interval of one segment answers for: of two segments at one time, SPICE takes the later."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.ck.segments import Coverage, Segment


@dataclass(frozen=True, slots=True)
class Piece:
    """Ticks from `start` to `stop` of a segment; `epochs` (n,) are the times strictly within at which it holds attitudes."""

    segment: Segment
    start: float
    stop: float
    epochs: FloatArray


def pieces_of(covered: list[tuple[Segment, Coverage]]) -> list[Piece]:
    """The pieces of the segments of one structure, in order of time; segments come in the file's order."""
    owners = [(segment, cover.epochs, *span) for segment, cover in covered for span in cover.intervals.tolist()]
    if not owners:
        return []
    bounds = np.unique(np.array([owner[2:] for owner in owners]))
    owner_of_cell = np.full(len(bounds), -1)  # the cell k is from bound k to bound k + 1; the last one stays empty
    owner_of_point = np.full(len(bounds), -1)
    for index, (_, _, start, stop) in enumerate(owners):
        cells = slice(*np.searchsorted(bounds, [start, stop]))
        owner_of_cell[cells] = index
        if start == stop:
            owner_of_point[cells.start] = index
    begins = np.flatnonzero(np.diff(owner_of_cell, prepend=-1))
    ends = np.append(begins[1:], len(bounds) - 1)
    found = []
    for k, end in zip(begins.tolist(), ends.tolist(), strict=True):
        if owner_of_cell[k] >= 0:
            found.append(_piece(owners[owner_of_cell[k]], float(bounds[k]), float(bounds[end])))
    for k in np.flatnonzero(owner_of_point >= 0).tolist():
        if owner_of_cell[k] < 0 and (k == 0 or owner_of_cell[k - 1] < 0):
            found.append(_piece(owners[owner_of_point[k]], float(bounds[k]), float(bounds[k])))
    return sorted(found, key=lambda piece: piece.start)


def _piece(owner: tuple[Segment, FloatArray, float, float], start: float, stop: float) -> Piece:
    segment, epochs = owner[:2]
    within = slice(int(np.searchsorted(epochs, start, "right")), int(np.searchsorted(epochs, stop, "left")))
    return Piece(segment, start, stop, epochs[within])
