"""What the tracker saw of the dots: centroids by frame and pose, from a table."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray, IntArray
from hilstar.errors import InputError
from hilstar.reading import open_lines

MAX_OBSERVED_BYTES = 100_000_000
MAX_ROWS = 1_000_000
NEEDED = ("frame", "x_px", "y_px")
KNOWN = (*NEEDED, "flux", "sigma_px", "pose")
ADVICE = "write a CSV with the columns frame,x_px,y_px and, where known, flux, sigma_px and pose"


@dataclass(frozen=True, slots=True)
class Observed:
    """Centroids in the tracker's image: frame, pose (0 by default) and place in tracker px, (n,) each.

    `sigma_px` (n,) is each one's own error where the table has it, else 1 throughout: then only ratios count.
    """

    frame: IntArray
    pose: IntArray
    x_px: FloatArray
    y_px: FloatArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        return len(self.frame)

    def at(self, chosen: IntArray) -> Observed:
        """Those at places `chosen`, or where a mask is true."""
        return Observed(self.frame[chosen], self.pose[chosen], self.x_px[chosen], self.y_px[chosen], self.sigma_px[chosen])


def read_observed(path: Path) -> Observed:
    """The centroids of a table. Raises InputError with the line of what is no centroid."""
    rows: list[tuple[float, ...]] = []
    with open_lines(path, ADVICE, MAX_OBSERVED_BYTES) as lines:
        reader = csv.reader(lines)
        header = [name.strip() for name in next(reader, [])]
        missing = [name for name in NEEDED if name not in header]
        if missing:
            raise InputError(f"{path}:1: column {missing[0]} is missing; {ADVICE}")
        places = {name: header.index(name) for name in KNOWN if name in header}
        for row in reader:
            if row and not row[0].startswith("#"):
                rows.append(_row(path, reader.line_num, row, places))
            if len(rows) > MAX_ROWS:
                raise InputError(f"{path}: more than {MAX_ROWS} centroids; write fewer frames")
    if not rows:
        raise InputError(f"{path}: has no centroid; {ADVICE}")
    frame, x_px, y_px, sigma_px, pose = np.array(rows).T
    return Observed(frame.astype(np.intp), pose.astype(np.intp), x_px, y_px, sigma_px)


def _row(path: Path, line: int, row: list[str], places: dict[str, int]) -> tuple[float, ...]:
    try:
        cells = {name: row[place].strip() for name, place in places.items()}
        frame, pose = int(cells["frame"]), int(cells.get("pose") or 0)
        x_px, y_px, sigma_px = float(cells["x_px"]), float(cells["y_px"]), float(cells.get("sigma_px") or 1.0)
        if not (all(map(math.isfinite, (x_px, y_px))) and 0 < sigma_px < math.inf and 0 <= frame < 10**6 and 0 <= pose < 1000):
            raise ValueError
    except (ValueError, IndexError) as error:
        wanted = "a frame from 0, finite x_px and y_px, sigma_px above 0 and a pose from 0 are wanted"
        raise InputError(f"{path}:{line}: {','.join(row)[:80]!r}; {wanted}") from error
    return frame, x_px, y_px, sigma_px, pose
