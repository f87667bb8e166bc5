"""A tracker that reports attitudes from the stars that it sees on a bench: Wahba's problem by
Markley's SVD (1988).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import from_matrix
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.server.bench.frame import Bench

HEADER = "qw,qx,qy,qz,tw,tx,ty,tz"


def reported(bench: Bench, true: BenchGeometry, q_icrs_to_cam: FloatArray) -> FloatArray:
    """The attitude (4,) that fits best to where the tracker sees a frame's stars, of the bench
    as it truly stands.
    """
    truth = bench.frame(q_icrs_to_cam).truth
    order = np.argsort(bench.stars.hip)
    catalogue = bench.stars.vectors[
        order[np.searchsorted(bench.stars.hip, truth["hip"], sorter=order)]
    ]
    seen = true.tracker.rays(*true.to_tracker(truth["x_px"], truth["y_px"]))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(seen.T @ catalogue)
    return from_matrix(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def write_pairs(
    path: Path, commanded: Iterable[FloatArray], reported: Iterable[FloatArray]
) -> Path:
    """A table of pairs, with every bit."""
    rows = [
        ",".join(map(repr, [*c.tolist(), *t.tolist()]))
        for c, t in zip(commanded, reported, strict=True)
    ]
    path.write_text("\n".join([HEADER, *rows]) + "\n")
    return path
