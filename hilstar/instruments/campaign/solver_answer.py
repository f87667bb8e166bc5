"""What a solver says of one image."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.server.answers.answer import ReportedStar


@dataclass(frozen=True, slots=True)
class CentroidErrors:
    """Centroids of one image against the truth: counts, and x and y errors (n,), px, measured minus
    true, of matched stars.

    `stars` are on the detector, `matched` of them were found within MATCH_PX, and `false` finds
    belong to no star. Errors are those of stars that are neither clipped, nor at the edge, nor
    crowded; `v_mag` (n,) are their magnitudes, `star` their rows.
    """

    stars: int
    found: int
    matched: int
    false: int
    dx_px: FloatArray
    dy_px: FloatArray
    v_mag: FloatArray
    star: npt.NDArray[np.void]


@dataclass(frozen=True, slots=True)
class SolverAnswer:
    """An attitude, or None and the reason; from the centroider also the centroids' errors.

    `rate_cam_rad_s` (3,) is the reported rate, None where there is none, `stamp_s` the reported
    time of measurement after the middle of the exposure, `stars` the reported stars, None where the
    tracker reports no stars.
    """

    q_icrs_to_cam: FloatArray | None
    why: str = ""
    star_errors: CentroidErrors | None = None
    rate_cam_rad_s: FloatArray | None = None
    stamp_s: float = 0.0
    stars: tuple[ReportedStar, ...] | None = None
